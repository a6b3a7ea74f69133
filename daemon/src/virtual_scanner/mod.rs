//! The simulated scanner as USB devices that a host's own drivers take for real: camera, projector and trigger controller.
//!
//! All three live in one [`VirtualRig`]; one thread, the [`RigClock`], moves its time and renders what the camera sees.

mod cdc_acm;
mod light_crafter;
mod projector;
mod rig;
mod uvc;

pub use cdc_acm::SerialTrigger;
pub use light_crafter::{HidProjector, LightCrafter};
pub use projector::VendorProjector;
pub use rig::{CableFault, CameraLink, DeviceKind, Picture, Pulse, PulseFault, Step, UNIT_GAIN, VirtualRig};
pub use uvc::UvcCamera;

use crate::device::sim::{FaultKind, SimWorld};
use crate::device::{DeviceError, PatternIndex, RigConfig, SequenceTiming};
use crate::light::{Direction, PatternSequence};
use crate::usb_device::connection::{Bell, SharedDevice};
use gv3_codec::GreyPicture;
use gv3_protocol::gv3::{Axis, Request, Timing};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What the virtual projector is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum ProjectorKind {
    /// The gv3 vendor protocol.
    #[default]
    Gv3,
    /// A TI LightCrafter 4500 that has the rig's patterns in its flash.
    Dlpc350,
}

/// How the virtual devices behave.
#[derive(Debug, Clone)]
pub struct VirtualConfig {
    /// The devices.
    pub devices: Vec<DeviceKind>,
    /// What the projector is.
    pub projector: ProjectorKind,
    /// The camera delivers this size instead of the rig's.
    pub camera_size_px: Option<[u32; 2]>,
    /// Wall time over the rig's.
    pub slower: f64,
    /// The rig's sequence plays by itself while the camera streams; for a camera without a projector.
    pub plays_itself: bool,
    /// What goes wrong.
    pub faults: Vec<PulseFault>,
}

impl Default for VirtualConfig {
    fn default() -> Self {
        let devices = vec![DeviceKind::Camera, DeviceKind::Projector, DeviceKind::Trigger];
        let projector = ProjectorKind::default();
        Self { devices, projector, camera_size_px: None, slower: 1.0, plays_itself: false, faults: Vec::new() }
    }
}

/// The devices of a rig and the clock that moves them.
pub struct VirtualScanner {
    /// The devices asked for, in that order.
    pub devices: Vec<(DeviceKind, SharedDevice)>,
    /// Their clock, to be run by a thread of its own.
    pub clock: RigClock,
}

impl VirtualScanner {
    /// The devices of a rig's configuration, whatever backends it names.
    ///
    /// # Errors
    /// [`DeviceError::Config`] for a rig that cannot work.
    pub fn new(config: &RigConfig, settings: &VirtualConfig, bell: Arc<Bell>) -> Result<Self, DeviceError> {
        let world = SimWorld::new(config)?;
        let has_controller = settings.devices.contains(&DeviceKind::Trigger);
        let mut rig = VirtualRig::new(config, has_controller, settings.slower, settings.faults.clone());
        rig.light_crafter = (settings.projector == ProjectorKind::Dlpc350).then(|| LightCrafter::new(config));
        let rig = Arc::new(Mutex::new(rig));
        let size_px = settings.camera_size_px.unwrap_or([config.camera.width_px, config.camera.height_px]);
        if size_px.iter().any(|side| !(1..=4096).contains(side)) {
            let reason = format!("{} x {}, but a side has 1 ..= 4096", size_px[0], size_px[1]);
            return Err(DeviceError::config("camera.width_px", reason));
        }
        let device = |kind: &DeviceKind| -> Result<(DeviceKind, SharedDevice), DeviceError> {
            let rig = Arc::clone(&rig);
            let device: SharedDevice = match kind {
                DeviceKind::Camera => {
                    Arc::new(Mutex::new(UvcCamera::new(rig, size_px, config.timing.picture_period_nanos)))
                }
                DeviceKind::Projector => {
                    projector(settings.projector, rig).ok_or(DeviceError::State("the projector has no descriptors"))?
                }
                DeviceKind::Trigger => Arc::new(Mutex::new(SerialTrigger::new(rig))),
            };
            Ok((*kind, device))
        };
        let devices = settings.devices.iter().map(device).collect::<Result<_, _>>()?;
        let order: Vec<usize> = (0..config.sequence.patterns.len()).collect();
        let own_show = settings.plays_itself.then(|| show_requests(&config.sequence, &order, &config.timing));
        Ok(Self { devices, clock: RigClock { world, rig, bell, own_show, is_showing: false } })
    }
}

fn projector(kind: ProjectorKind, rig: Arc<Mutex<VirtualRig>>) -> Option<SharedDevice> {
    Some(match kind {
        ProjectorKind::Gv3 => Arc::new(Mutex::new(VendorProjector::new(rig)?)),
        ProjectorKind::Dlpc350 => Arc::new(Mutex::new(HidProjector::new(rig)?)),
    })
}

/// Requests that make a projector of the vendor protocol play patterns of a sequence in an order.
fn show_requests(sequence: &PatternSequence, order: &[usize], timing: &SequenceTiming) -> Vec<u8> {
    let mut requests = Vec::new();
    for (position, &index) in order.iter().enumerate() {
        let pattern = &sequence.patterns[index];
        let axis = match pattern.direction {
            Direction::Columns => Axis::Columns,
            Direction::Rows => Axis::Rows,
        };
        requests.push(Request::Pattern {
            index: position as u16,
            axis,
            levels: pattern.levels(sequence.length_px(index)),
        });
    }
    requests.push(Request::Order((0..order.len() as u16).collect()));
    let SequenceTiming { picture_period_nanos: period_nanos, exposure_nanos } = *timing;
    requests.push(Request::Timing(Timing { period_nanos, exposure_nanos }));
    requests.extend([Request::Arm, Request::Start]);
    requests.iter().enumerate().flat_map(|(i, r)| r.message(i as u16).encode()).collect()
}

/// Moves the rig's time and renders its pictures.
pub struct RigClock {
    world: SimWorld,
    rig: Arc<Mutex<VirtualRig>>,
    bell: Arc<Bell>,
    own_show: Option<Vec<u8>>,
    is_showing: bool,
}

impl RigClock {
    /// The rig.
    pub fn rig(&self) -> MutexGuard<'_, VirtualRig> {
        self.rig.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs for ever.
    pub fn run(mut self) {
        loop {
            let wait = self.step(Instant::now());
            if !wait.is_zero() {
                std::thread::sleep(wait);
            }
        }
    }

    /// Does what is due at a wall time; returns how long nothing will be.
    pub fn step(&mut self, now: Instant) -> Duration {
        self.show();
        let pulse = {
            let mut rig = self.rig();
            match rig.step(now) {
                Step::Wait(wait) => {
                    drop(rig);
                    // Replies and events may have become due.
                    self.bell.ring();
                    return wait;
                }
                Step::Pulse(pulse) => pulse,
            }
        };
        let rig = self.rig.lock().unwrap_or_else(PoisonError::into_inner);
        self.world.follow(&rig.projector);
        drop(rig);
        self.expose(&pulse);
        self.bell.ring();
        Duration::ZERO
    }

    /// Begins and ends the show of a projector that has no host.
    fn show(&mut self) {
        let Some(requests) = &self.own_show else { return };
        let mut rig = self.rig.lock().unwrap_or_else(PoisonError::into_inner);
        if rig.is_streaming() != self.is_showing {
            self.is_showing = rig.is_streaming();
            rig.reset_projector();
            if self.is_showing {
                rig.projector.write_out(requests);
            }
        }
    }

    /// Renders a pulse's picture, if the camera wants one, and gives it to the camera.
    fn expose(&mut self, pulse: &Pulse) {
        let Some(exposure_nanos) = pulse.exposure_nanos else { return };
        let count = pulse.shown.map_or(1, |shown| shown.1.max(1));
        let own = self.world.fault_at(pulse.number, count).map(CableFault::Picture);
        let fault = pulse.fault.or(own);
        let kind = match fault {
            Some(CableFault::Picture(kind)) => Some(kind),
            _ => None,
        };
        match kind {
            Some(FaultKind::Lost) => return,
            Some(FaultKind::Unplugged) => return self.rig().pull(DeviceKind::Camera),
            Some(FaultKind::Stalled) => self.rig().stall_camera(),
            _ => {}
        }
        let is_late = kind == Some(FaultKind::Late);
        let late_nanos = if is_late { pulse.period_nanos * 6 / 10 } else { 0 };
        let shown = pulse.shown.map(|(p, count)| PatternIndex((p.0 + u16::from(is_late)) % count.max(1)));
        let true_nanos = if kind == Some(FaultKind::Saturated) { exposure_nanos * 8 } else { exposure_nanos };
        let mut image = self.world.expose(pulse.run_nanos + late_nanos, shown, true_nanos, pulse.number);
        let mut rig = self.rig();
        amplify(&mut image, rig.camera.gain);
        let is_short = fault == Some(CableFault::Short);
        let picture = Picture { image, time_nanos: pulse.time_nanos + late_nanos, is_short };
        rig.deliver(pulse, picture, if kind == Some(FaultKind::Doubled) { 2 } else { 1 });
    }
}

/// Digital gain, saturating.
fn amplify(image: &mut GreyPicture, gain: u16) {
    if gain != UNIT_GAIN {
        for pixel in &mut image.pixels {
            *pixel = (u32::from(*pixel) * u32::from(gain) / u32::from(UNIT_GAIN)).min(255) as u8;
        }
    }
}
