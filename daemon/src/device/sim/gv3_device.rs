//! A projector that speaks the gv3 vendor protocol (GV3.md), the device's side of it: bytes in, bytes out, no I/O, no clock.
//!
//! Who serves it (in this process, or over USB/IP) does what a USB controller does:
//! - every control transfer goes to [`Gv3Device::handle_control`], standard requests included;
//! - what arrives at [`Gv3Device::OUT`] goes to [`Gv3Device::write_out`];
//! - while a transfer waits at [`Gv3Device::IN`], [`Gv3Device::read_in`] is asked with its length: `None` leaves it waiting,
//!   anything else ends it, and an empty answer is a zero-length packet;
//! - while a transfer waits at [`Gv3Device::EVENTS`], [`Gv3Device::poll_events`] is asked, at least every 10 ms;
//! - time is told with [`Gv3Device::advance_to`] before each of these, in nanoseconds since power-on;
//! - what shines is in [`Gv3Device::light`] and [`Gv3Device::patterns_in_order`]; `SimWorld::follow` has a scene lit by it.
//!
//! Unplugging it and plugging it in again is a new device.

use super::gv3_descriptors as usb;
use gv3_protocol::gv3::{
    Axis, BodyError, CONTROL_IDENTIFY, CONTROL_RESET, Decoder, DeviceFault, DeviceState, Event, Exposure, FaultEvent,
    Identity, Message, Refusal, Reply, Request, Status, Timing,
};
use std::collections::VecDeque;

/// Events that wait to be fetched.
const EVENT_QUEUE: usize = 64;
/// Replies that wait to be fetched; a host has one request in flight.
const REPLY_QUEUE: usize = 4;

/// A control request that the device does not know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stall;

/// What the projector shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Light {
    /// Nothing.
    Dark,
    /// The pattern at one position of the set.
    Still(u16),
    /// Sets one after the other.
    Playing {
        /// When.
        timing: Timing,
        /// Middle of the first exposure on the device's clock, nanoseconds.
        start_nanos: u64,
    },
}

/// A pattern as it was sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredPattern {
    /// What the levels follow.
    pub axis: Axis,
    /// Levels, 0 dark to 255 bright.
    pub levels: Vec<u8>,
}

/// The projector.
#[derive(Debug)]
pub struct Gv3Device {
    identity: Identity,
    timing_step_nanos: u64,
    bulk_packet_bytes: u16,
    clock_nanos: u64,
    state: DeviceState,
    fault: Option<DeviceFault>,
    patterns: Vec<Option<StoredPattern>>,
    patterns_number: u64,
    order: Vec<u16>,
    timing: Option<Timing>,
    start_nanos: u64,
    /// Position shown in the state `Showing`.
    still: u16,
    triggers: u64,
    events: VecDeque<Vec<u8>>,
    event_sequence: u16,
    events_lost: u64,
    decoder: Decoder,
    replies: VecDeque<Vec<u8>>,
    /// The request answered last, and the reply.
    last: Option<(Message, Vec<u8>)>,
    /// Halted endpoints: OUT, IN, EVENTS.
    halted: [bool; 3],
    configuration: u8,
}

impl Gv3Device {
    /// Address of the bulk endpoint that takes requests.
    pub const OUT: u8 = usb::OUT;
    /// Address of the bulk endpoint that gives replies.
    pub const IN: u8 = usb::IN;
    /// Address of the interrupt endpoint that gives events.
    pub const EVENTS: u8 = usb::EVENTS;

    /// A projector just powered on.
    pub fn new(identity: Identity) -> Self {
        Self {
            identity,
            timing_step_nanos: 1,
            bulk_packet_bytes: usb::HIGH_SPEED_PACKET_BYTES,
            clock_nanos: 0,
            state: DeviceState::Idle,
            fault: None,
            patterns: Vec::new(),
            patterns_number: 0,
            order: Vec::new(),
            timing: None,
            start_nanos: 0,
            still: 0,
            triggers: 0,
            events: VecDeque::new(),
            event_sequence: 0,
            events_lost: 0,
            decoder: Decoder::default(),
            replies: VecDeque::new(),
            last: None,
            halted: [false; 3],
            configuration: 0,
        }
    }

    /// A projector of a size, with the limits of the simulated one.
    pub fn simulated(size_px: [u32; 2], serial: &str) -> Self {
        // A size beyond the protocol's is one that no pattern can be sent for.
        let [width_px, height_px] = size_px.map(|side| u16::try_from(side).unwrap_or(u16::MAX));
        Self::new(Identity {
            firmware_version: 0x0100,
            width_px,
            height_px,
            max_patterns: 256,
            max_order: 1024,
            min_period_nanos: 5_000_000,
            max_period_nanos: 10_000_000_000,
            model: "gv3 simulated projector".into(),
            serial: serial.into(),
        })
    }

    /// The same, but with times that are whole multiples of a step above 0.
    #[must_use]
    pub fn with_timing_step_nanos(self, timing_step_nanos: u64) -> Self {
        Self { timing_step_nanos: timing_step_nanos.max(1), ..self }
    }

    /// The same, but at full speed with bulk packets of 8, 16, 32 or 64 bytes.
    #[must_use]
    pub fn with_bulk_packet_bytes(self, bulk_packet_bytes: u16) -> Self {
        Self { bulk_packet_bytes: bulk_packet_bytes.max(1), ..self }
    }

    /// What it says of itself.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// What it shows now.
    pub fn light(&self) -> Light {
        match (self.state, self.timing) {
            (DeviceState::Showing, _) => Light::Still(self.still),
            (DeviceState::Running, Some(timing)) => Light::Playing { timing, start_nanos: self.start_nanos },
            _ => Light::Dark,
        }
    }

    /// The patterns of a set in the order shown.
    pub fn patterns_in_order(&self) -> impl Iterator<Item = &StoredPattern> {
        self.order.iter().filter_map(|index| self.patterns.get(usize::from(*index))?.as_ref())
    }

    /// Changes whenever [`Self::patterns_in_order`] does.
    pub fn patterns_number(&self) -> u64 {
        self.patterns_number
    }

    /// Tells the time, nanoseconds since power-on; it never goes back.
    pub fn advance_to(&mut self, now_nanos: u64) {
        self.clock_nanos = self.clock_nanos.max(now_nanos);
        let (DeviceState::Running, Some(timing)) = (self.state, self.timing) else { return };
        let Some(since) = self.clock_nanos.checked_sub(self.start_nanos) else { return };
        let due = since / timing.period_nanos + 1;
        let count = self.order.len() as u64;
        while self.triggers < due && self.events.len() < EVENT_QUEUE {
            let (trigger, position) = (self.triggers, (self.triggers % count) as u16);
            self.triggers += 1;
            self.send(&Event::Exposure(Exposure {
                trigger,
                set: trigger / count,
                position,
                pattern: self.order[usize::from(position)],
                device_time_nanos: self.start_nanos + trigger * timing.period_nanos,
                exposure_nanos: timing.exposure_nanos,
            }));
        }
        let lost = due.saturating_sub(self.triggers);
        self.triggers += lost;
        self.events_lost += lost;
        self.event_sequence = self.event_sequence.wrapping_add(lost as u16);
    }

    fn send(&mut self, event: &Event) {
        if self.events.len() < EVENT_QUEUE {
            self.events.push_back(event.message(self.event_sequence).encode());
        } else {
            self.events_lost += 1;
        }
        self.event_sequence = self.event_sequence.wrapping_add(1);
    }

    /// Something breaks: the projector goes dark and says so.
    pub fn fail(&mut self, fault: DeviceFault) {
        self.state = DeviceState::Fault;
        self.fault = Some(fault);
        self.send(&Event::Fault(FaultEvent { fault, device_time_nanos: self.clock_nanos }));
    }

    /// What a transfer at [`Self::EVENTS`] gets at a time: one event, or nothing yet.
    pub fn poll_events(&mut self, now_nanos: u64) -> Option<Vec<u8>> {
        self.advance_to(now_nanos);
        self.events.pop_front()
    }

    /// Takes bytes that arrived at [`Self::OUT`].
    pub fn write_out(&mut self, bytes: &[u8]) {
        self.decoder.push(bytes);
        while let Some(message) = self.decoder.next_message() {
            let reply = match &self.last {
                Some((last, reply)) if *last == message => reply.clone(),
                _ => {
                    let result = Request::decode(&message).and_then(|request| self.obey(request));
                    let reply = Request::reply(&message, result).encode();
                    self.last = Some((message, reply.clone()));
                    reply
                }
            };
            if self.replies.len() == REPLY_QUEUE {
                self.replies.pop_front();
            }
            self.replies.push_back(reply);
        }
    }

    /// What a transfer of `max` bytes at [`Self::IN`] gets: a reply or the next part of it, a zero-length packet behind a reply
    /// that filled its packets, or nothing yet.
    pub fn read_in(&mut self, max: usize) -> Option<Vec<u8>> {
        let packet_bytes = usize::from(self.bulk_packet_bytes);
        let reply = self.replies.front_mut()?;
        let part: Vec<u8> = reply.drain(..max.min(reply.len())).collect();
        // A packet that is not full ends the reply; else an empty one has to, unless it went with this transfer.
        if reply.is_empty() && (part.len() < max || !part.len().is_multiple_of(packet_bytes) || part.is_empty()) {
            self.replies.pop_front();
        }
        Some(part)
    }

    /// A control transfer; the answer to a device-to-host request is at most as long as it asks.
    ///
    /// # Errors
    /// [`Stall`] for a request that the device does not know.
    pub fn handle_control(&mut self, setup: [u8; 8], _data: &[u8]) -> Result<Vec<u8>, Stall> {
        const VENDOR_IN: u8 = 0xc1;
        const VENDOR_OUT: u8 = 0x41;
        let [kind, request, value_low, value_high, index, _, length_low, length_high] = setup;
        let mut answer = match (kind, request) {
            (VENDOR_IN, CONTROL_IDENTIFY) => self.identity.encode(),
            (VENDOR_OUT, CONTROL_RESET) => {
                self.reset();
                Vec::new()
            }
            // GET_DESCRIPTOR
            (0x80, 6) => usb::descriptor(value_high, value_low, &self.identity, self.bulk_packet_bytes).ok_or(Stall)?,
            // GET_CONFIGURATION, GET_INTERFACE, GET_STATUS of device, interface and endpoint
            (0x80, 8) => vec![self.configuration],
            (0x81, 10) => vec![0],
            (0x80, 0) => vec![1, 0],
            (0x81, 0) => vec![0, 0],
            (0x82, 0) => vec![u8::from(self.halted[endpoint(index)?]), 0],
            // SET_CONFIGURATION
            (0x00, 9) if value_low <= 1 => {
                self.configuration = value_low;
                self.halted = [false; 3];
                self.reset();
                Vec::new()
            }
            // CLEAR_FEATURE and SET_FEATURE of an endpoint's halt
            (0x02, 1 | 3) if value_low == 0 => {
                self.halted[endpoint(index)?] = request == 3;
                Vec::new()
            }
            // SET_ADDRESS, SET_INTERFACE to the only setting
            (0x00, 5) => Vec::new(),
            (0x01, 11) if value_low == 0 => Vec::new(),
            _ => return Err(Stall),
        };
        answer.truncate(usize::from(u16::from_le_bytes([length_low, length_high])));
        Ok(answer)
    }

    /// Whether transfers at an endpoint are to be stalled.
    pub fn is_halted(&self, address: u8) -> bool {
        endpoint(address).is_ok_and(|i| self.halted[i])
    }

    /// The power goes: dark, and of no more use.
    pub fn power_off(&mut self) {
        self.reset();
    }

    /// Back to the state after power-on; the clock goes on, and a fault stays.
    fn reset(&mut self) {
        self.forget();
        self.state = if self.fault.is_some() { DeviceState::Fault } else { DeviceState::Idle };
        self.events.clear();
        self.replies.clear();
        self.decoder = Decoder::default();
        (self.last, self.event_sequence, self.events_lost, self.triggers) = (None, 0, 0, 0);
    }

    fn forget(&mut self) {
        self.patterns.clear();
        self.order.clear();
        self.timing = None;
        self.patterns_number += 1;
    }

    /// State without light.
    fn dark(&self) -> DeviceState {
        if self.order.is_empty() { DeviceState::Idle } else { DeviceState::Ready }
    }

    fn obey(&mut self, request: Request) -> Result<Reply, BodyError> {
        use DeviceState::{Armed, Fault, Idle, Ready, Running, Showing};
        match (request, self.state) {
            (Request::Status, _) => return Ok(Reply::Status(self.status())),
            (Request::ClearFault, Fault) => {
                self.fault = None;
                self.state = self.dark();
            }
            (Request::ClearFault, _) | (Request::Stop, Fault) => {}
            (_, Fault) => return Err(refused(Refusal::Fault, "clear the fault first")),
            (Request::Stop, _) => self.state = self.dark(),
            (Request::Clear, Idle | Ready) => {
                self.forget();
                self.state = Idle;
            }
            (Request::Pattern { index, axis, levels }, Idle) => self.store(index, StoredPattern { axis, levels })?,
            (Request::Order(order), Idle | Ready) => {
                self.check_order(&order)?;
                self.order = order;
                self.patterns_number += 1;
                self.state = Ready;
            }
            (Request::Timing(timing), Idle | Ready) => return self.set_timing(timing).map(Reply::Timing),
            (Request::Arm, Ready) if self.timing.is_none() => {
                return Err(refused(Refusal::State, "no timing was given"));
            }
            (Request::Arm, Ready) => {
                (self.triggers, self.events_lost, self.event_sequence) = (0, 0, 0);
                self.events.clear();
                self.state = Armed;
            }
            (Request::Start, Armed) => {
                let period_nanos = self.timing.map_or(0, |timing| timing.period_nanos);
                self.start_nanos = self.clock_nanos.saturating_add(period_nanos);
                self.state = Running;
            }
            (Request::Show(position), Ready | Showing) => {
                if usize::from(position) >= self.order.len() {
                    return Err(field(0, "position", format!("{position} of {}", self.order.len())));
                }
                self.still = position;
                self.state = Showing;
            }
            (request, state) => {
                return Err(refused(Refusal::State, &format!("{} while {state:?}", request.name())));
            }
        }
        Ok(Reply::Done)
    }

    fn store(&mut self, index: u16, pattern: StoredPattern) -> Result<(), BodyError> {
        if index >= self.identity.max_patterns {
            return Err(field(0, "index", format!("{index}, there is room for {}", self.identity.max_patterns)));
        }
        let expected = match pattern.axis {
            Axis::Columns => self.identity.width_px,
            Axis::Rows => self.identity.height_px,
        };
        let found = pattern.levels.len();
        if found != usize::from(expected) {
            return Err(BodyError::Length { field: "pattern", found: 4 + found, expected: 4 + usize::from(expected) });
        }
        let index = usize::from(index);
        self.patterns.resize(self.patterns.len().max(index + 1), None);
        self.patterns[index] = Some(pattern);
        Ok(())
    }

    fn check_order(&self, order: &[u16]) -> Result<(), BodyError> {
        if order.len() > usize::from(self.identity.max_order) {
            let (found, expected) = (2 * order.len(), 2 * usize::from(self.identity.max_order));
            return Err(BodyError::Length { field: "order", found, expected });
        }
        let is_stored = |index: &u16| self.patterns.get(usize::from(*index)).is_some_and(Option::is_some);
        match order.iter().position(|index| !is_stored(index)) {
            Some(i) => Err(field(2 * i, "order", format!("pattern {} is not stored", order[i]))),
            None => Ok(()),
        }
    }

    fn set_timing(&mut self, wanted: Timing) -> Result<Timing, BodyError> {
        let step = self.timing_step_nanos;
        let [period_nanos, exposure_nanos] =
            [wanted.period_nanos, wanted.exposure_nanos].map(|nanos| nanos.saturating_add(step / 2) / step * step);
        let range = self.identity.min_period_nanos..=self.identity.max_period_nanos;
        if !range.contains(&period_nanos) {
            return Err(field(0, "period_nanos", format!("{period_nanos} is outside {range:?}")));
        }
        if exposure_nanos == 0 || exposure_nanos > period_nanos {
            let reason = format!("{exposure_nanos} does not fit into the period of {period_nanos}");
            return Err(field(8, "exposure_nanos", reason));
        }
        let timing = Timing { period_nanos, exposure_nanos };
        self.timing = Some(timing);
        Ok(timing)
    }

    fn status(&self) -> Status {
        Status {
            state: self.state,
            fault: self.fault,
            pattern_count: self.patterns.iter().flatten().count() as u16,
            order_count: self.order.len() as u16,
            triggers: self.triggers,
            device_time_nanos: self.clock_nanos,
            events_lost: self.events_lost,
            board_millidegrees: Some(if self.fault == Some(DeviceFault::Temperature) { 91_000 } else { 41_500 }),
            light_millidegrees: None,
        }
    }
}

/// Place of an endpoint in the list of halted ones.
fn endpoint(address: u8) -> Result<usize, Stall> {
    [usb::OUT, usb::IN, usb::EVENTS].iter().position(|a| *a == address).ok_or(Stall)
}

fn refused(refusal: Refusal, text: &str) -> BodyError {
    BodyError::Refused { refusal, text: text.into() }
}

fn field(offset: usize, field: &'static str, reason: String) -> BodyError {
    BodyError::Field { offset, field, reason }
}
