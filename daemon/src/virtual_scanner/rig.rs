//! What the virtual devices share: a clock, a trigger line, and the pictures on their way out of the camera.
//!
//! The rig's time goes with the wall's, or slower, but never ahead of the host: a pulse waits until the camera's last pictures
//! have been fetched. So a host that is slow, or a simulator, sees the same pictures as a fast one.

use super::LightCrafter;
use crate::device::sim::{FaultKind, Gv3Device, Light};
use crate::device::{PatternIndex, RigConfig};
use gv3_codec::GreyPicture;
use gv3_protocol::gv3::CONTROL_RESET;
use gv3_protocol::trigger::TriggerModel;
use std::collections::{BTreeSet, VecDeque};
use std::str::FromStr;
use std::time::{Duration, Instant};

/// Pictures that wait in the camera; a pulse waits while there are so many.
const CAMERA_PICTURES: usize = 2;
/// How late a pulse may come before the time in between is taken out of the rig's time.
const MAX_LATE: Duration = Duration::from_millis(20);
/// Standing still is told whenever so much more of it has come together.
const TOLD_NANOS: u64 = 10_000_000;
/// How often the rig looks for what its hosts have changed.
const IDLE: Duration = Duration::from_millis(4);
/// How long a stalled transfer stands.
const STALL: Duration = Duration::from_secs(1);
/// Gain of the camera that changes nothing.
pub const UNIT_GAIN: u16 = 16;

/// A virtual device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum DeviceKind {
    /// USB video class.
    Camera,
    /// The gv3 vendor protocol.
    Projector,
    /// A serial port (CDC-ACM) with the trigger's line protocol.
    Trigger,
}

/// What goes wrong on a cable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CableFault {
    /// A picture of the camera goes wrong.
    Picture(FaultKind),
    /// Half a picture arrives.
    Short,
    /// A cable is pulled, and put back after a second.
    Unplugged(DeviceKind),
    /// The projector falls back to showing its video input, or goes dark where it has none.
    WrongMode,
}

/// A fault and the pulse it comes with, counted from the start of the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PulseFault {
    /// What happens.
    pub fault: CableFault,
    /// When.
    pub pulse: u64,
}

impl FromStr for PulseFault {
    type Err = String;

    /// `lost@40`, `short@41`, `unplug-camera@100`.
    fn from_str(text: &str) -> Result<Self, String> {
        let (kind, pulse) = text.split_once('@').ok_or("a fault is KIND@PULSE, as in lost@40")?;
        let fault = match kind {
            "lost" => CableFault::Picture(FaultKind::Lost),
            "doubled" => CableFault::Picture(FaultKind::Doubled),
            "late" => CableFault::Picture(FaultKind::Late),
            "saturated" => CableFault::Picture(FaultKind::Saturated),
            "stalled" => CableFault::Picture(FaultKind::Stalled),
            "short" => CableFault::Short,
            "wrong-mode" => CableFault::WrongMode,
            "unplug-camera" => CableFault::Unplugged(DeviceKind::Camera),
            "unplug-projector" => CableFault::Unplugged(DeviceKind::Projector),
            "unplug-trigger" => CableFault::Unplugged(DeviceKind::Trigger),
            _ => {
                return Err(format!(
                    "{kind}: a fault is lost, doubled, late, saturated, stalled, short, wrong-mode, unplug-camera, unplug-projector or unplug-trigger"
                ));
            }
        };
        let pulse = pulse.parse().map_err(|_| format!("{pulse} is no number of a pulse"))?;
        Ok(Self { fault, pulse })
    }
}

/// A picture in the camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// The image.
    pub image: GreyPicture,
    /// Middle of its exposure, the rig's time.
    pub time_nanos: u64,
    /// Only half of it is sent.
    pub is_short: bool,
}

/// The camera's part of the rig.
#[derive(Debug)]
pub struct CameraLink {
    /// Exposure, as the host has set it.
    pub exposure_nanos: u64,
    /// Gain times [`UNIT_GAIN`].
    pub gain: u16,
    pictures: VecDeque<Picture>,
    /// Counts streams; none while there is none.
    stream: Option<u64>,
    streams: u64,
    stalled_until: Option<Instant>,
}

impl CameraLink {
    /// Begins a stream, without what is left of another.
    pub fn begin(&mut self) {
        self.streams += 1;
        self.stream = Some(self.streams);
        self.pictures.clear();
        self.stalled_until = None;
    }

    /// Ends it.
    pub fn end(&mut self) {
        self.stream = None;
        self.pictures.clear();
    }

    /// The next picture for the host, unless its exposure is still to come.
    fn take(&mut self, clock_nanos: u64) -> Option<Picture> {
        if self.stalled_until.is_some_and(|until| Instant::now() < until) {
            return None;
        }
        self.stalled_until = None;
        if self.pictures.front()?.time_nanos > clock_nanos { None } else { self.pictures.pop_front() }
    }
}

/// A pulse on the camera's trigger line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pulse {
    /// Pulses before it in its run.
    pub number: u64,
    /// When, the rig's time.
    pub time_nanos: u64,
    /// Since the first pulse of its run; the scene moves with this.
    pub run_nanos: u64,
    /// Time to the next.
    pub period_nanos: u64,
    /// What the projector shows, and how many patterns it has.
    pub shown: Option<(PatternIndex, u16)>,
    /// Exposure of the camera; none when it does not stream.
    pub exposure_nanos: Option<u64>,
    /// What the command line wants to go wrong.
    pub fault: Option<CableFault>,
    stream: Option<u64>,
}

/// What the clock does next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Nothing for so long.
    Wait(Duration),
    /// A pulse comes.
    Pulse(Pulse),
}

/// Who fires the camera's pulses.
#[derive(Debug)]
enum TriggerLine {
    /// The projector, with every exposure.
    Projector,
    /// The controller; the projector steps with it.
    Controller,
}

/// The devices and their common time.
#[derive(Debug)]
pub struct VirtualRig {
    /// The projector.
    pub projector: Gv3Device,
    /// The device that the projector is driven as, where it is not by the vendor protocol.
    pub light_crafter: Option<LightCrafter>,
    /// The trigger controller.
    pub trigger: TriggerModel,
    /// The camera.
    pub camera: CameraLink,
    line: TriggerLine,
    clock_nanos: u64,
    /// A wall time and the rig's time at it.
    begin: (Instant, u64),
    slower: f64,
    /// How long its time has stood still, in all.
    stood_nanos: u64,
    /// Start of the run and pulses in it.
    run: Option<(u64, u64)>,
    /// When the projector began to play, and its steps since; a projector that begins anew begins with its first pattern.
    steps: (u64, u64),
    pulses: u64,
    faults: Vec<PulseFault>,
    pulled: BTreeSet<DeviceKind>,
}

impl VirtualRig {
    /// A rig at its time 0. `slower` is wall time over the rig's; with a controller its pulses trigger the camera.
    pub fn new(config: &RigConfig, has_controller: bool, slower: f64, faults: Vec<PulseFault>) -> Self {
        let size_px = [config.sequence.width_px, config.sequence.height_px];
        let camera = CameraLink {
            exposure_nanos: config.timing.exposure_nanos,
            gain: UNIT_GAIN,
            pictures: VecDeque::new(),
            stream: None,
            streams: 0,
            stalled_until: None,
        };
        Self {
            projector: Gv3Device::simulated(size_px, "virtual-projector-1"),
            light_crafter: None,
            trigger: TriggerModel::new("virtual-trigger-1"),
            camera,
            line: if has_controller { TriggerLine::Controller } else { TriggerLine::Projector },
            clock_nanos: 0,
            begin: (Instant::now(), 0),
            slower,
            stood_nanos: 0,
            run: None,
            steps: (0, 0),
            pulses: 0,
            faults,
            pulled: BTreeSet::new(),
        }
    }

    /// The rig's time.
    pub fn clock_nanos(&self) -> u64 {
        self.clock_nanos
    }

    /// The camera streams.
    pub fn is_streaming(&self) -> bool {
        self.camera.stream.is_some()
    }

    /// The camera's next picture, at a wall time.
    pub fn take_picture(&mut self, now: Instant) -> Option<Picture> {
        self.tick(now);
        self.camera.take(self.clock_nanos)
    }

    /// Someone has pulled the cable of a device since this was last asked.
    pub fn take_unplug(&mut self, kind: DeviceKind) -> bool {
        self.pulled.remove(&kind)
    }

    /// The projector as after power-on.
    pub fn reset_projector(&mut self) {
        // Its own reset is one that it knows.
        let _ = self.projector.handle_control([0x41, CONTROL_RESET, 0, 0, 0, 0, 0, 0], &[]);
    }

    /// Brings the clock, and the devices with it, up to the wall's time, but not beyond the next pulse.
    pub fn tick(&mut self, now: Instant) {
        let until = self.next_pulse_nanos().unwrap_or(u64::MAX).saturating_sub(1);
        self.set_clock(self.wall_nanos(now).min(until));
    }

    fn set_clock(&mut self, nanos: u64) {
        self.clock_nanos = self.clock_nanos.max(nanos);
        self.projector.advance_to(self.clock_nanos);
        // The controller's pulses are taken one by one in `step`.
        if self.trigger.next_pulse_nanos().is_none_or(|next| next > self.clock_nanos) {
            let _ = self.trigger.advance(self.clock_nanos);
        }
    }

    fn wall_nanos(&self, now: Instant) -> u64 {
        let since = now.saturating_duration_since(self.begin.0).as_secs_f64() / self.slower;
        self.begin.1 + (since * 1e9) as u64
    }

    fn wall_until(&self, nanos: u64, now: Instant) -> Duration {
        let missing = nanos.saturating_sub(self.wall_nanos(now));
        Duration::from_nanos((missing as f64 * self.slower) as u64)
    }

    fn next_pulse_nanos(&self) -> Option<u64> {
        match (&self.line, self.projector.light()) {
            (TriggerLine::Controller, _) => self.trigger.next_pulse_nanos(),
            (TriggerLine::Projector, Light::Playing { timing, start_nanos }) => {
                let fired = self.run.filter(|run| run.0 == start_nanos).map_or(0, |run| run.1);
                Some(start_nanos + fired * timing.period_nanos)
            }
            (TriggerLine::Projector, _) => None,
        }
    }

    /// What happens at a wall time. To be called again after what it says.
    pub fn step(&mut self, now: Instant) -> Step {
        let Some(next) = self.next_pulse_nanos() else {
            self.run = None;
            self.tick(now);
            return Step::Wait(IDLE);
        };
        if self.wall_nanos(now) < next {
            self.tick(now);
            return Step::Wait(self.wall_until(next, now).min(IDLE));
        }
        if self.is_streaming() && self.camera.pictures.len() >= CAMERA_PICTURES {
            // Time stands until the host has fetched one.
            self.tick(now);
            self.stand(now, next);
            return Step::Wait(IDLE);
        }
        if Duration::from_nanos(self.wall_nanos(now) - next) > MAX_LATE {
            self.stand(now, next);
        }
        self.set_clock(next);
        Step::Pulse(self.pulse(next))
    }

    /// Takes the time since `next` was due out of the rig's time.
    fn stand(&mut self, now: Instant, next: u64) {
        let before_nanos = self.stood_nanos;
        self.stood_nanos += self.wall_nanos(now).saturating_sub(next);
        self.begin = (now, next);
        if self.stood_nanos / TOLD_NANOS != before_nanos / TOLD_NANOS {
            tracing::warn!(stood_ms = self.stood_nanos / 1_000_000, "the host is slow: the rig's time stood still");
        }
    }

    /// The pulse that is due.
    fn pulse(&mut self, time_nanos: u64) -> Pulse {
        let playing = match self.projector.light() {
            Light::Playing { timing, start_nanos } => Some((timing.period_nanos, start_nanos)),
            _ => None,
        };
        let (first, number, period_nanos) = match &self.line {
            TriggerLine::Projector => {
                let (period_nanos, start_nanos) = playing.unwrap_or((1, time_nanos));
                let fired = self.run.filter(|run| run.0 == start_nanos).map_or(0, |run| run.1);
                (start_nanos, fired, period_nanos)
            }
            TriggerLine::Controller => {
                let counter = self.trigger.advance(time_nanos).map_or(0, |pulse| u64::from(pulse.counter));
                let first = self.run.filter(|_| counter > 0).map_or(time_nanos, |run| run.0);
                let next = self.trigger.next_pulse_nanos().unwrap_or(time_nanos);
                (first, counter, next - time_nanos)
            }
        };
        self.run = Some((first, number + 1));
        let shown = self.shown();
        let fault = self.fault();
        let run_nanos = time_nanos - first;
        let exposure_nanos = self.is_streaming().then_some(self.camera.exposure_nanos);
        Pulse { number, time_nanos, run_nanos, period_nanos, shown, exposure_nanos, fault, stream: self.camera.stream }
    }

    /// What the projector shows at a pulse; it steps with every one.
    fn shown(&mut self) -> Option<(PatternIndex, u16)> {
        let count = self.projector.patterns_in_order().count() as u16;
        match self.projector.light() {
            Light::Dark => None,
            Light::Still(pattern) => Some((PatternIndex(pattern), count)),
            Light::Playing { start_nanos, .. } => {
                let steps = if self.steps.0 == start_nanos { self.steps.1 } else { 0 };
                self.steps = (start_nanos, steps + 1);
                Some((PatternIndex((steps % u64::from(count.max(1))) as u16), count))
            }
        }
    }

    fn fault(&mut self) -> Option<CableFault> {
        let found = self.faults.iter().find(|f| f.pulse == self.pulses).map(|f| f.fault);
        self.pulses += 1;
        match (found, &mut self.light_crafter) {
            (Some(CableFault::Unplugged(kind)), _) => drop(self.pulled.insert(kind)),
            (Some(CableFault::WrongMode), Some(device)) => device.lose_mode(&mut self.projector),
            (Some(CableFault::WrongMode), None) => self.reset_projector(),
            _ => {}
        }
        found
    }

    /// Puts a pulse's picture into the camera, unless its stream has ended.
    pub fn deliver(&mut self, pulse: &Pulse, picture: Picture, count: usize) {
        if self.camera.stream == pulse.stream && self.is_streaming() {
            self.camera.pictures.extend(std::iter::repeat_n(picture, count));
        }
    }

    /// The camera's transfers stand still for a while.
    pub fn stall_camera(&mut self) {
        self.camera.stalled_until = Some(Instant::now() + STALL);
    }

    /// Pulls a cable.
    pub fn pull(&mut self, kind: DeviceKind) {
        self.pulled.insert(kind);
    }
}
