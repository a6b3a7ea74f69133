//! A DLPC350 byte by byte: HID reports in, HID reports out, no clock, no threads.
//!
//! [`Dlpc350Emulator::output_report`] takes what the host writes to endpoint 0x01, [`Dlpc350Emulator::input_report`] gives
//! what it reads from endpoint 0x81; [`DEVICE_DESCRIPTOR`], [`CONFIGURATION_DESCRIPTOR`], [`REPORT_DESCRIPTOR`] and
//! [`STRINGS`] are what it takes to be enumerated (full speed, control transfers are the server's business; SET_IDLE
//! may be acknowledged and forgotten). [`Dlpc350Emulator::shown`] tells what light it would make. It has the real
//! one's known traps: it starts only when validation was followed by reading the three status registers, it needs a second
//! start after video mode, it refuses changes while a sequence runs, and video hot-plug throws it back to video mode.
//!
//! ```
//! use gv3::device::dlpc350::emulator::{Dlpc350Emulator, Shown};
//! use gv3_protocol::dlpc350::{DisplayMode, Register, Reply, Request};
//! # fn main() -> Result<(), gv3_protocol::dlpc350::Dlpc350Error> {
//! let mut device = Dlpc350Emulator::new();
//! device.output_report(&Request::read::<DisplayMode>(5).reports()?[0]);
//! let reply = Reply::parse(&device.input_report().unwrap())?;
//! assert_eq!((reply.sequence, DisplayMode::decode(&reply.data)?), (5, DisplayMode::Video));
//! assert_eq!((device.input_report(), device.shown()), (None, Shown::Video));
//! # Ok(())
//! # }
//! ```

use super::link::{HidLink, HidOpener, LinkError};
use gv3_protocol::dlpc350::{
    BitDepth, DisplayMode, Dlpc350Error, ExposurePeriod, FirmwareTag, FlashImageCount, HardwareStatus, ImageLut, Input,
    InputSource, LedCurrent, LedEnable, LutControl, LutEntry, MAX_IMAGES, MAX_PATTERNS, Mailbox, MailboxOffset,
    MainStatus, PRODUCT_ID, PatternLut, PatternSource, Playback, Power, Register, Reply, Report, Request,
    RequestAssembler, RequestKind, SystemStatus, TriggerDelay, TriggerMode, TriggerOut1, TriggerOut2, VENDOR_ID,
    Validate, Validation, Version,
};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// HID report descriptor: one input and one output report of 64 bytes, without numbers, of the vendor's own usage page.
pub const REPORT_DESCRIPTOR: [u8; 25] = [
    0x06, 0x00, 0xff, 0x09, 0x01, 0xa1, 0x01, 0x15, 0x00, 0x26, 0xff, 0x00, 0x75, 0x08, 0x95, 0x40, 0x09, 0x02, 0x81,
    0x02, 0x09, 0x03, 0x91, 0x02, 0xc0,
];
/// Manufacturer, product and serial number: string descriptors 1 to 3.
pub const STRINGS: [&str; 3] = ["Texas Instruments", "DLPC350", "LCR3"];
/// USB device descriptor.
pub const DEVICE_DESCRIPTOR: [u8; 18] = {
    let ([vendor_0, vendor_1], [product_0, product_1]) = (VENDOR_ID.to_le_bytes(), PRODUCT_ID.to_le_bytes());
    [18, 1, 0x00, 0x02, 0, 0, 0, 64, vendor_0, vendor_1, product_0, product_1, 0x00, 0x02, 1, 2, 3, 1]
};
/// USB configuration, interface 0, HID and endpoint descriptors (0x81 in, 0x01 out, interrupt, 64 bytes, 1 ms).
pub const CONFIGURATION_DESCRIPTOR: [u8; 41] = [
    9,
    2,
    41,
    0,
    1,
    1,
    0,
    0xc0,
    50, // configuration
    9,
    4,
    0,
    0,
    2,
    3,
    0,
    0,
    0, // interface
    9,
    0x21,
    0x11,
    0x01,
    0,
    1,
    0x22,
    REPORT_DESCRIPTOR.len() as u8,
    0, // HID
    7,
    5,
    0x81,
    3,
    64,
    0,
    1, // in
    7,
    5,
    0x01,
    3,
    64,
    0,
    1, // out
];

/// Period of the emulated video input: 60 Hz.
const VIDEO_FRAME_US: u64 = 16_667;
/// Replies that nobody fetches before the oldest is forgotten.
const MOST_REPLIES: usize = 16;

/// What goes wrong with the next request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// It is refused and not done.
    Nack,
    /// It is lost: neither done nor answered.
    Lost,
    /// It is done, but the answer is lost.
    Unanswered,
    /// An answer to some earlier request comes first.
    StaleReply,
    /// It is done, but the answer is of bytes without sense.
    Garbage,
    /// The cable is pulled.
    Unplug,
}

/// One pattern as shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ShownPattern {
    /// Flash image; `None` when it comes from video.
    pub image: Option<u8>,
    /// Which planes of it, and how.
    pub entry: LutEntry,
}

/// What light the projector makes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shown {
    /// None.
    Dark,
    /// Its input as pictures.
    Video,
    /// A pattern sequence.
    Patterns {
        /// In order.
        patterns: Vec<ShownPattern>,
        /// When.
        timing: ExposurePeriod,
        /// Over and over, or once.
        repeats: bool,
    },
}

/// The emulated projector.
#[derive(Debug, Clone)]
pub struct Dlpc350Emulator {
    requests: RequestAssembler,
    replies: VecDeque<Report>,
    faults: VecDeque<Fault>,
    is_connected: bool,
    flash_images: u8,
    state: State,
}

/// What a power cycle resets.
#[derive(Debug, Clone)]
struct State {
    power: Power,
    input: InputSource,
    mode: DisplayMode,
    source: PatternSource,
    trigger: TriggerMode,
    timing: ExposurePeriod,
    lut: LutControl,
    mailbox: Mailbox,
    offset: usize,
    patterns: Vec<Option<LutEntry>>,
    images: Vec<u8>,
    trigger_1: TriggerOut1,
    trigger_2: TriggerOut2,
    leds: LedEnable,
    current: LedCurrent,
    playback: Playback,
    verdict: Option<Validation>,
    busy_reads: u8,
    status_reads: u8,
    ignores_next_start: bool,
}

impl State {
    fn new() -> Self {
        Self {
            power: Power::Normal,
            input: InputSource { input: Input::Parallel, port_width: 1 },
            mode: DisplayMode::Video,
            source: PatternSource::Video,
            trigger: TriggerMode::VerticalSync,
            timing: ExposurePeriod { exposure_us: 0, period_us: 0 },
            lut: LutControl { patterns: 1, repeats: false, trigger_2_every: 1, images: 1 },
            mailbox: Mailbox::Closed,
            offset: 0,
            patterns: vec![None; MAX_PATTERNS],
            images: vec![0; MAX_IMAGES],
            trigger_1: TriggerOut1 { inverted: false, rising: TriggerDelay::ZERO, falling: TriggerDelay::ZERO },
            trigger_2: TriggerOut2 { inverted: false, rising: TriggerDelay::ZERO },
            leds: LedEnable { rgb: [false; 3], by_sequencer: true },
            current: LedCurrent { rgb: [104, 135, 130] },
            playback: Playback::Stop,
            verdict: None,
            busy_reads: 0,
            status_reads: 0,
            ignores_next_start: false,
        }
    }
}

/// A refusal.
struct Nack;

impl From<Dlpc350Error> for Nack {
    fn from(_: Dlpc350Error) -> Self {
        Self
    }
}

impl Default for Dlpc350Emulator {
    fn default() -> Self {
        Self::new()
    }
}

impl Dlpc350Emulator {
    /// A projector just switched on: video mode, two images in flash.
    pub fn new() -> Self {
        Self {
            requests: RequestAssembler::default(),
            replies: VecDeque::new(),
            faults: VecDeque::new(),
            is_connected: true,
            flash_images: 2,
            state: State::new(),
        }
    }

    /// The same with another number of images in flash.
    pub fn with_flash_images(self, flash_images: u8) -> Self {
        Self { flash_images, ..self }
    }

    /// Takes a report from the host.
    pub fn output_report(&mut self, report: &Report) {
        // The real one says nothing to a message whose length cannot be.
        if let (true, Ok(Some(request))) = (self.is_connected, self.requests.push(report)) {
            self.handle(&request);
        }
    }

    /// The next report for the host, if there is one.
    pub fn input_report(&mut self) -> Option<Report> {
        self.replies.pop_front()
    }

    /// Lets the next request go wrong; several faults are met in the order given.
    pub fn inject(&mut self, fault: Fault) {
        self.faults.push_back(fault);
    }

    /// Whether it is plugged in.
    pub fn is_connected(&self) -> bool {
        self.is_connected
    }

    /// Plugs it in again, switched on anew; flash keeps its images.
    pub fn plug_in(&mut self) {
        *self = Self::new().with_flash_images(self.flash_images);
    }

    /// What the board's own controller does when a video cable is plugged in: back to video mode.
    pub fn hot_plug_video(&mut self) {
        self.state.playback = Playback::Stop;
        self.state.mode = DisplayMode::Video;
        self.state.ignores_next_start = true;
    }

    /// What light it makes.
    pub fn shown(&self) -> Shown {
        let state = &self.state;
        match (state.power, state.mode, state.playback) {
            (Power::Normal, DisplayMode::Video, _) => Shown::Video,
            (Power::Normal, DisplayMode::PatternSequence, Playback::Start | Playback::Pause) => {
                Shown::Patterns { patterns: self.patterns(), timing: state.timing, repeats: state.lut.repeats }
            }
            _ => Shown::Dark,
        }
    }

    /// Current of the LEDs as set.
    pub fn led_current(&self) -> LedCurrent {
        self.state.current
    }

    /// The trigger outputs as set.
    pub fn trigger_outputs(&self) -> (TriggerOut1, TriggerOut2) {
        (self.state.trigger_1, self.state.trigger_2)
    }

    fn patterns(&self) -> Vec<ShownPattern> {
        let state = &self.state;
        let count = usize::from(state.lut.images);
        let mut swaps = 0usize;
        let entries = state.patterns.iter().take(usize::from(state.lut.patterns)).flatten();
        let shown = entries.map(|entry| {
            swaps += usize::from(entry.swaps_buffer);
            let image = state.images[swaps.saturating_sub(1) % count];
            ShownPattern { image: (state.source == PatternSource::Flash).then_some(image), entry: *entry }
        });
        shown.collect()
    }

    fn handle(&mut self, request: &Request) {
        let fault = self.faults.pop_front();
        match fault {
            Some(Fault::Lost) => return,
            Some(Fault::Unplug) => {
                self.is_connected = false;
                self.replies.clear();
                return;
            }
            _ => {}
        }
        let is_read = request.kind == RequestKind::Read;
        let done = match (fault, is_read) {
            (Some(Fault::Nack), _) => Err(Nack),
            (_, true) => self.read(request.command),
            (_, false) => self.write(request.command, &request.payload).map(|()| Vec::new()),
        };
        let reply = match done {
            Ok(data) => Reply { is_read, is_nack: false, sequence: request.sequence, data },
            Err(Nack) => Reply { is_read, is_nack: true, sequence: request.sequence, data: Vec::new() },
        };
        match fault {
            Some(Fault::Unanswered) => {}
            Some(Fault::Garbage) => self.reply([0xff; 64]),
            _ if request.kind == RequestKind::WriteUnanswered => {}
            _ => {
                if fault == Some(Fault::StaleReply) {
                    self.reply(Reply { sequence: reply.sequence.wrapping_sub(1), ..reply.clone() }.encode());
                }
                self.reply(reply.encode());
            }
        }
    }

    fn reply(&mut self, report: Report) {
        if self.replies.len() == MOST_REPLIES {
            self.replies.pop_front();
        }
        self.replies.push_back(report);
    }

    fn read(&mut self, command: u16) -> Result<Vec<u8>, Nack> {
        let state = &mut self.state;
        let is_lit = state.power == Power::Normal;
        let is_running = state.playback == Playback::Start || state.mode == DisplayMode::Video;
        Ok(match command {
            HardwareStatus::COMMAND => {
                state.status_reads |= 1;
                HardwareStatus { is_initialized: true, ..HardwareStatus::default() }.encode()
            }
            SystemStatus::COMMAND => {
                state.status_reads |= 2;
                SystemStatus { memory_ok: true }.encode()
            }
            MainStatus::COMMAND => {
                state.status_reads |= 4;
                MainStatus { is_parked: !is_lit, is_running: is_running && is_lit, is_frozen: false }.encode()
            }
            Validation::COMMAND if state.busy_reads > 0 => {
                state.busy_reads -= 1;
                Validation { is_busy: true, ..Validation::default() }.encode()
            }
            Validation::COMMAND => state.verdict.ok_or(Nack)?.encode(),
            Version::COMMAND => {
                let [application, interface] = [0x0404_0000, 0x0100_0000];
                Version { application, interface, software: 0, sequencer: 0 }.encode()
            }
            FirmwareTag::COMMAND => FirmwareTag("gv3 emulated LightCrafter".into()).encode(),
            FlashImageCount::COMMAND => FlashImageCount(self.flash_images).encode(),
            _ => return state.setting(command),
        })
    }

    fn write(&mut self, command: u16, payload: &[u8]) -> Result<(), Nack> {
        let state = &mut self.state;
        match command {
            Playback::COMMAND => return self.play(Playback::decode(payload)?),
            Validate::COMMAND => return self.validate(),
            DisplayMode::COMMAND => {
                let mode = DisplayMode::decode(payload)?;
                state.ignores_next_start |= state.mode != mode && mode == DisplayMode::PatternSequence;
                if mode != state.mode {
                    state.playback = Playback::Stop;
                }
                state.mode = mode;
            }
            Power::COMMAND => state.power = Power::decode(payload)?,
            InputSource::COMMAND => state.input = InputSource::decode(payload)?,
            TriggerOut1::COMMAND => state.trigger_1 = TriggerOut1::decode(payload)?,
            TriggerOut2::COMMAND => state.trigger_2 = TriggerOut2::decode(payload)?,
            LedEnable::COMMAND => state.leds = LedEnable::decode(payload)?,
            LedCurrent::COMMAND => state.current = LedCurrent::decode(payload)?,
            _ => return self.write_sequence(command, payload),
        }
        Ok(())
    }

    /// What may not change while a sequence runs, and has to be validated afterwards.
    fn write_sequence(&mut self, command: u16, payload: &[u8]) -> Result<(), Nack> {
        let state = &mut self.state;
        if state.playback != Playback::Stop {
            return Err(Nack);
        }
        match command {
            PatternSource::COMMAND => state.source = PatternSource::decode(payload)?,
            TriggerMode::COMMAND => state.trigger = TriggerMode::decode(payload)?,
            ExposurePeriod::COMMAND => state.timing = ExposurePeriod::decode(payload)?,
            LutControl::COMMAND => state.lut = LutControl::decode(payload)?,
            Mailbox::COMMAND => state.mailbox = Mailbox::decode(payload)?,
            MailboxOffset::COMMAND => state.offset = usize::from(MailboxOffset::decode(payload)?.0),
            PatternLut::COMMAND => state.write_table(payload)?,
            _ => return Err(Nack),
        }
        state.verdict = None;
        Ok(())
    }

    fn validate(&mut self) -> Result<(), Nack> {
        let state = &self.state;
        if state.mailbox != Mailbox::Closed || state.playback != Playback::Stop {
            return Err(Nack);
        }
        let shown = self.patterns();
        let deepest = shown.iter().map(|p| p.entry.depth).max_by_key(|depth| depth.bits());
        let least_us = deepest.map_or(0, BitDepth::min_exposure_us);
        let ExposurePeriod { exposure_us, period_us } = state.timing;
        let is_cut = state.source == PatternSource::Video && u64::from(period_us) * shown.len() as u64 > VIDEO_FRAME_US;
        let is_wrong = |p: &ShownPattern| {
            usize::from(p.entry.pattern) >= p.entry.depth.patterns_per_image()
                || p.image.is_some_and(|image| image >= self.flash_images)
        };
        let verdict = Validation {
            exposure_invalid: state.timing.check(least_us).is_err() || is_cut,
            pattern_invalid: shown.len() < usize::from(state.lut.patterns) || shown.iter().any(is_wrong),
            gap_too_short: (1..230).contains(&period_us.saturating_sub(exposure_us)),
            ..Validation::default()
        };
        self.state.verdict = Some(verdict);
        self.state.busy_reads = 2;
        self.state.status_reads = 0;
        Ok(())
    }

    fn play(&mut self, playback: Playback) -> Result<(), Nack> {
        let state = &mut self.state;
        if playback == Playback::Start {
            let is_valid = state.verdict.is_some_and(|v| !v.exposure_invalid && !v.pattern_invalid);
            let is_refused = state.power == Power::Standby || state.mode == DisplayMode::Video;
            if is_refused {
                return Err(Nack);
            }
            let is_ignored = std::mem::take(&mut state.ignores_next_start) && state.source == PatternSource::Video;
            if !is_valid || state.status_reads != 7 || is_ignored {
                return Ok(());
            }
        }
        state.playback = playback;
        Ok(())
    }
}

impl State {
    /// What was set.
    fn setting(&self, command: u16) -> Result<Vec<u8>, Nack> {
        Ok(match command {
            Power::COMMAND => self.power.encode(),
            InputSource::COMMAND => self.input.encode(),
            DisplayMode::COMMAND => self.mode.encode(),
            PatternSource::COMMAND => self.source.encode(),
            Playback::COMMAND => self.playback.encode(),
            TriggerMode::COMMAND => self.trigger.encode(),
            ExposurePeriod::COMMAND => self.timing.encode(),
            LutControl::COMMAND => self.lut.encode(),
            TriggerOut1::COMMAND => self.trigger_1.encode(),
            TriggerOut2::COMMAND => self.trigger_2.encode(),
            LedEnable::COMMAND => self.leds.encode(),
            LedCurrent::COMMAND => self.current.encode(),
            _ => return Err(Nack),
        })
    }

    fn write_table(&mut self, payload: &[u8]) -> Result<(), Nack> {
        match self.mailbox {
            Mailbox::Patterns => {
                let entries = PatternLut::decode(payload)?.0;
                let places = self.patterns.get_mut(self.offset..self.offset + entries.len()).ok_or(Nack)?;
                places.iter_mut().zip(entries).for_each(|(place, entry)| *place = Some(entry));
            }
            Mailbox::Images => {
                let images = ImageLut::decode(payload)?.0;
                let places = self.images.get_mut(self.offset..self.offset + images.len()).ok_or(Nack)?;
                places.copy_from_slice(&images);
            }
            Mailbox::Closed | Mailbox::VariableExposure => return Err(Nack),
        }
        Ok(())
    }
}

/// The cable to an emulated projector, and what opens it. Clones share the projector.
#[derive(Debug, Clone, Default)]
pub struct EmulatedLink {
    device: Arc<Mutex<Dlpc350Emulator>>,
}

impl EmulatedLink {
    /// A cable to `device`.
    pub fn new(device: Dlpc350Emulator) -> Self {
        Self { device: Arc::new(Mutex::new(device)) }
    }

    /// The projector at the other end.
    pub fn device(&self) -> MutexGuard<'_, Dlpc350Emulator> {
        self.device.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl HidLink for EmulatedLink {
    fn write_report(&mut self, report: &Report) -> Result<(), LinkError> {
        let mut device = self.device();
        if !device.is_connected() {
            return Err(LinkError::Disconnected);
        }
        device.output_report(report);
        Ok(())
    }

    /// Does not wait: what is not there will not come.
    fn read_report(&mut self, timeout: Duration) -> Result<Report, LinkError> {
        let mut device = self.device();
        match device.input_report() {
            Some(report) => Ok(report),
            None if device.is_connected() => Err(LinkError::Timeout(timeout)),
            None => Err(LinkError::Disconnected),
        }
    }

    fn pause(&mut self, _time: Duration) {}
}

impl HidOpener for EmulatedLink {
    fn name(&self) -> String {
        "emulated DLPC350".into()
    }

    fn open(&mut self) -> Result<Box<dyn HidLink>, LinkError> {
        if !self.device().is_connected() {
            return Err(LinkError::Disconnected);
        }
        Ok(Box::new(self.clone()))
    }
}
