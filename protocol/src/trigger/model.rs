//! A controller in memory: the protocol's reference, behind pseudo-terminals in tests and inside simulated scanners.
//!
//! Bytes in, bytes out, and a clock that its owner moves; no threads, no sleeping, bounded memory.

use super::{Answer, ArmSettings, Command, Event, Identity, LineReader, Message, Refusal, Request, State, Status};
use super::{MAX_WORD_BYTES, PROTOCOL_VERSION};

/// Output that waits for the line, bytes; events beyond it are lost and counted, replies are kept.
const MAX_EVENT_BYTES: usize = 4096;
/// Output beyond which replies are not kept either: the host does not listen.
const MAX_OUTPUT_BYTES: usize = 8192;
/// From `fire` to the first pulse, nanoseconds: time for the reply to go out first.
pub const FIRE_DELAY_NANOS: u64 = 1_000_000;
/// Resolution of the model's timer, nanoseconds; periods and widths are rounded to it.
pub const TIMER_NANOS: u64 = 500;

/// A pulse on the trigger line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TriggerPulse {
    /// Pulses before it since the controller was armed.
    pub counter: u32,
    /// When it begins on the model's clock, nanoseconds.
    pub time_nanos: u64,
    /// Its length, nanoseconds.
    pub width_nanos: u64,
}

#[derive(Debug, Clone, Copy)]
struct Firing {
    /// Pulses still to fire; none when it goes on until disarmed.
    left: Option<u32>,
    next_nanos: u64,
}

/// A controller that keeps the protocol.
#[derive(Debug, Clone)]
pub struct TriggerModel {
    identity: Identity,
    reader: LineReader,
    output: Vec<u8>,
    now_nanos: u64,
    armed: Option<ArmSettings>,
    firing: Option<Firing>,
    fired: u32,
    lost_events: u32,
    last_reply: Option<(u16, Answer)>,
}

impl TriggerModel {
    /// A controller just switched on, at time 0 of its clock: it announces itself. Characters of the serial number that the
    /// protocol does not allow are left out.
    #[must_use]
    pub fn new(serial: &str) -> Self {
        let allowed = serial.chars().filter(|c| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-'));
        let mut serial: String = allowed.take(MAX_WORD_BYTES).collect();
        if serial.is_empty() {
            serial.push('0');
        }
        let (model, min_period_nanos) = ("model".to_owned(), super::request::MIN_PERIOD_NANOS);
        let mut new = Self {
            identity: Identity { version: PROTOCOL_VERSION, model, serial, min_period_nanos },
            reader: LineReader::default(),
            output: Vec::new(),
            now_nanos: 0,
            armed: None,
            firing: None,
            fired: 0,
            lost_events: 0,
            last_reply: None,
        };
        new.event(Event::Boot { version: PROTOCOL_VERSION });
        new
    }

    /// Its clock, nanoseconds.
    #[must_use]
    pub fn now_nanos(&self) -> u64 {
        self.now_nanos
    }

    /// When the next pulse is due, nanoseconds of its clock; `None` when it is not firing.
    #[must_use]
    pub fn next_pulse_nanos(&self) -> Option<u64> {
        self.firing.map(|firing| firing.next_nanos)
    }

    /// Takes bytes from the host, in pieces of any length, at the present time of the clock.
    pub fn receive(&mut self, bytes: &[u8]) {
        let mut requests = Vec::new();
        self.reader.feed(bytes, |line| requests.push(line.map(|body| (Request::id_of(body), Request::decode(body)))));
        for request in requests {
            match request {
                Ok((_, Ok(Request { id, command }))) => self.answer(id, Some(command)),
                Ok((Ok(id), Err(_))) => self.answer(id, None),
                Ok((Err(_), _)) | Err(_) => self.event(Event::Reject),
            }
        }
    }

    /// Moves the clock towards `until_nanos`: to the next pulse, which is returned, or to the end. To be called until it
    /// returns `None`. A clock never goes back.
    pub fn advance(&mut self, until_nanos: u64) -> Option<TriggerPulse> {
        let due = self.firing.zip(self.armed).filter(|(firing, _)| firing.next_nanos <= until_nanos);
        let Some((mut firing, settings)) = due else {
            self.now_nanos = self.now_nanos.max(until_nanos);
            return None;
        };
        self.now_nanos = self.now_nanos.max(firing.next_nanos);
        let pulse =
            TriggerPulse { counter: self.fired, time_nanos: firing.next_nanos, width_nanos: settings.width_nanos };
        if pulse.counter.is_multiple_of(settings.report_every) {
            self.event(Event::Pulse { counter: pulse.counter, time_nanos: pulse.time_nanos });
        }
        self.fired = self.fired.saturating_add(1);
        firing.next_nanos = firing.next_nanos.saturating_add(settings.period_nanos);
        firing.left = firing.left.map(|left| left - 1);
        // The counter's range ends a run that has no other end.
        let is_over = firing.left == Some(0) || self.fired == u32::MAX;
        self.firing = (!is_over).then_some(firing);
        if is_over {
            self.event(Event::Done { fired: self.fired, time_nanos: firing.next_nanos });
        }
        Some(pulse)
    }

    /// Takes up to `most` bytes for the host, in order.
    pub fn take_output(&mut self, most: usize) -> Vec<u8> {
        let rest = self.output.split_off(most.min(self.output.len()));
        std::mem::replace(&mut self.output, rest)
    }

    /// Answers a request; one whose command is not understood, too.
    fn answer(&mut self, id: u16, command: Option<Command>) {
        let answer = match &self.last_reply {
            Some((last, answer)) if *last == id => answer.clone(),
            _ => command.map_or(Answer::Refused(Refusal::Syntax), |command| self.perform(command)),
        };
        self.last_reply = Some((id, answer.clone()));
        let line = Message::Reply { id, answer }.encode();
        if self.output.len() + line.len() <= MAX_OUTPUT_BYTES {
            self.output.extend_from_slice(line.as_bytes());
        }
    }

    fn perform(&mut self, command: Command) -> Answer {
        match command {
            Command::Hello => Answer::Hello(self.identity.clone()),
            Command::Time => Answer::Time(self.now_nanos),
            Command::Arm(wanted) => self.arm(wanted),
            Command::Fire { count } => self.fire(count),
            Command::Disarm => {
                (self.armed, self.firing) = (None, None);
                Answer::Disarm(self.fired)
            }
            Command::Status => Answer::Status(Status {
                state: match (self.armed, self.firing) {
                    (_, Some(_)) => State::Firing,
                    (Some(_), None) => State::Armed,
                    (None, None) => State::Idle,
                },
                fired: self.fired,
                lost_events: self.lost_events,
                time_nanos: self.now_nanos,
            }),
        }
    }

    fn arm(&mut self, wanted: ArmSettings) -> Answer {
        if self.firing.is_some() {
            return Answer::Refused(Refusal::State);
        }
        if let Err(field) = wanted.validate() {
            return Answer::Refused(Refusal::Range(field));
        }
        let rounded = |nanos: u64| (nanos + TIMER_NANOS / 2) / TIMER_NANOS * TIMER_NANOS;
        let period_nanos = rounded(wanted.period_nanos);
        let width_nanos = rounded(wanted.width_nanos).min(period_nanos - TIMER_NANOS);
        let settings = ArmSettings { period_nanos, width_nanos, ..wanted };
        (self.armed, self.fired, self.lost_events) = (Some(settings), 0, 0);
        Answer::Arm(settings)
    }

    fn fire(&mut self, count: u32) -> Answer {
        if self.armed.is_none() || self.firing.is_some() || self.fired > 0 {
            return Answer::Refused(Refusal::State);
        }
        let next_nanos = self.now_nanos.saturating_add(FIRE_DELAY_NANOS);
        self.firing = Some(Firing { left: (count > 0).then_some(count), next_nanos });
        Answer::Fire(next_nanos)
    }

    fn event(&mut self, event: Event) {
        let line = Message::Event(event).encode();
        if self.output.len() + line.len() <= MAX_EVENT_BYTES {
            self.output.extend_from_slice(line.as_bytes());
        } else {
            self.lost_events = self.lost_events.saturating_add(1);
        }
    }
}
