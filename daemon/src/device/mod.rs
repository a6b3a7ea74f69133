//! Cameras, projectors and trigger controllers behind blocking, object-safe traits; [`open`] is the only place that names concrete types.

pub mod config;
pub mod dlpc350;
pub mod exposure;
pub mod frame;
pub mod gv3_usb;
mod in_use;
mod paced;
pub mod plugged;
pub mod proven_camera;
pub mod recorded;
pub mod serial_trigger;
pub mod sim;
#[cfg(all(feature = "v4l", target_os = "linux"))]
pub mod v4l_camera;
mod v4l_config;

use crate::light::{Calibration, LightError, Limits, PatternSequence, Processing};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

pub use config::{Backend, CameraConfig, ProjectorConfig, RigConfig};
pub use exposure::{Exposure, ExposureFeed};
pub use frame::{Frame, PatternIndex};
pub use paced::PacedCamera;
pub use proven_camera::ProvenCamera;
pub use recorded::{Pace, RecordedConfig};
pub use serial_trigger::{TriggerBackend, TriggerConfig};
pub use v4l_config::{ControlValue, ExposureControl, PixelFormat, TriggerControl, V4lConfig};

/// Why a device did not do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// A setting that cannot work.
    #[error("{field}: {reason}")]
    Config {
        /// Dotted path of the field, as in the rig's TOML file.
        field: String,
        /// What was found and what to do.
        reason: String,
    },
    /// A file that cannot be read.
    #[error("{path}: {reason}")]
    File {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        reason: String,
    },
    /// No frame before the deadline.
    #[error("no picture before the deadline: {0}")]
    Timeout(String),
    /// A call out of order.
    #[error("{0}")]
    State(&'static str),
    /// The device is gone.
    #[error("{0} is disconnected")]
    Disconnected(String),
    /// Nothing more will come.
    #[error("{0} has ended")]
    Ended(String),
    /// Anything else that the device reports.
    #[error("{0}")]
    Failed(String),
}

impl DeviceError {
    /// An error about `field` of the rig's configuration.
    pub(crate) fn config(field: impl Into<String>, reason: impl Into<String>) -> Self {
        Self::Config { field: field.into(), reason: reason.into() }
    }
}

impl From<LightError> for DeviceError {
    fn from(error: LightError) -> Self {
        match error {
            LightError::Field { field, reason } => Self::Config { field, reason },
            LightError::Toml(reason) => Self::Config { field: "calibration".into(), reason },
        }
    }
}

/// What a camera is.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraInfo {
    /// Maker and model.
    pub model: String,
    /// Serial number.
    pub serial: String,
    /// Columns of the sensor.
    pub width_px: u32,
    /// Rows of the sensor.
    pub height_px: u32,
    /// Shortest time between two pictures, nanoseconds.
    pub min_period_nanos: u64,
    /// Waits for whoever reads it, as virtual time and files do; a live sensor goes on without its reader.
    pub waits_for_reader: bool,
}

/// What starts an exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TriggerSource {
    /// The projector's trigger line, once a pattern.
    Projector,
    /// The camera's own clock.
    Internal {
        /// Time between pictures, nanoseconds.
        period_nanos: u64,
    },
}

/// How a camera is to work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CameraSettings {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Exposure, nanoseconds.
    pub exposure_nanos: u64,
    /// What starts an exposure.
    pub trigger: TriggerSource,
}

/// A camera.
pub trait Camera: Send {
    /// What it is.
    fn info(&self) -> CameraInfo;
    /// Sets it up and returns what was really set.
    ///
    /// # Errors
    /// [`DeviceError::Config`] for a setting it cannot even approximate.
    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError>;
    /// Begins a run; triggers from now on give frames.
    ///
    /// # Errors
    /// [`DeviceError::State`] before [`Camera::configure`].
    fn start(&mut self) -> Result<(), DeviceError>;
    /// Waits for the next frame.
    ///
    /// # Errors
    /// [`DeviceError::Timeout`] when none came before `deadline`; the run goes on.
    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError>;
    /// Ends the run.
    ///
    /// # Errors
    /// [`DeviceError::Disconnected`] when the camera is gone.
    fn stop(&mut self) -> Result<(), DeviceError>;
}

/// What a projector is.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectorInfo {
    /// Maker and model.
    pub model: String,
    /// Serial number.
    pub serial: String,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Shortest time a pattern can be shown, nanoseconds.
    pub min_period_nanos: u64,
    /// Plays a loaded sequence by itself, with a trigger at every pattern.
    pub hardware_sequence: bool,
}

/// When the patterns of a sequence are shown; the sequence repeats without a pause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SequenceTiming {
    /// Time from one pattern to the next, nanoseconds.
    pub picture_period_nanos: u64,
    /// Exposure within it, nanoseconds.
    pub exposure_nanos: u64,
}

impl SequenceTiming {
    /// Time from one frame set to the next, nanoseconds.
    pub fn set_period_nanos(&self, pattern_count: usize) -> u64 {
        self.picture_period_nanos.saturating_mul(pattern_count as u64)
    }

    /// Checks that the exposure fits into the period.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field.
    pub fn validate(&self) -> Result<(), DeviceError> {
        if !(100_000..=10_000_000_000).contains(&self.picture_period_nanos) {
            let reason = format!("{} is outside 100000 (0.1 ms) ..= 10000000000 (10 s)", self.picture_period_nanos);
            return Err(DeviceError::config("timing.picture_period_nanos", reason));
        }
        if self.exposure_nanos == 0 || self.exposure_nanos > self.picture_period_nanos {
            let reason =
                format!("{} does not fit into the period of {}", self.exposure_nanos, self.picture_period_nanos);
            return Err(DeviceError::config("timing.exposure_nanos", reason));
        }
        Ok(())
    }
}

/// A projector.
pub trait Projector: Send {
    /// What it is.
    fn info(&self) -> ProjectorInfo;
    /// Stores a sequence for [`Projector::play`] and [`Projector::show`].
    ///
    /// # Errors
    /// [`DeviceError::Config`] for a sequence it cannot show.
    fn load(&mut self, sequence: &PatternSequence) -> Result<(), DeviceError>;
    /// Shows the sequence over and over, with a trigger in the middle of every pattern, until [`Projector::stop`].
    ///
    /// # Errors
    /// [`DeviceError::State`] before [`Projector::load`]; [`DeviceError::Config`] for a timing it cannot keep.
    fn play(&mut self, timing: &SequenceTiming) -> Result<(), DeviceError>;
    /// Shows one pattern until told otherwise.
    ///
    /// # Errors
    /// [`DeviceError::State`] when no such pattern is loaded.
    fn show(&mut self, pattern: PatternIndex) -> Result<(), DeviceError>;
    /// Goes dark.
    ///
    /// # Errors
    /// [`DeviceError::Disconnected`] when the projector is gone.
    fn stop(&mut self) -> Result<(), DeviceError>;
    /// What it reports while it plays: every exposure, or at least that it began anew; `None` when it never does by itself.
    fn exposures(&self) -> Option<ExposureFeed> {
        None
    }
}

/// What a trigger controller is.
#[derive(Debug, Clone, PartialEq)]
pub struct TriggerInfo {
    /// Model.
    pub model: String,
    /// Serial number.
    pub serial: String,
    /// Shortest time between two pulses, nanoseconds.
    pub min_period_nanos: u64,
}

/// What a trigger controller reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TriggerEvent {
    /// A pulse began.
    Pulse {
        /// Pulses before it since it was armed.
        counter: u64,
        /// When, on the controller's clock, nanoseconds.
        time_nanos: u64,
    },
    /// A pulse came late or not at all.
    Overrun {
        /// Its number.
        counter: u64,
    },
    /// The controller began anew; nothing is fired until it is armed again.
    Restarted,
}

/// A trigger controller: it fires the pulses that projector and camera follow, and counts them.
pub trait Trigger: Send {
    /// What it is.
    fn info(&self) -> TriggerInfo;
    /// Fires pulses from number 0 on, at the timing that is returned, until [`Trigger::disarm`]. Camera and projector must
    /// be ready before.
    ///
    /// # Errors
    /// [`DeviceError::Config`] for a timing it cannot keep, [`DeviceError::Disconnected`] when it is gone.
    fn arm(&mut self, timing: &SequenceTiming) -> Result<SequenceTiming, DeviceError>;
    /// What happens from now on; ends the receiver of the call before. What a full receiver has no room for is lost.
    fn events(&mut self) -> Receiver<TriggerEvent>;
    /// Fires no more; returns how many pulses there were.
    ///
    /// # Errors
    /// [`DeviceError::Disconnected`] when it is gone.
    fn disarm(&mut self) -> Result<u64, DeviceError>;
}

/// The opened devices of a rig and what is needed to use them.
pub struct Rig {
    /// The camera.
    pub camera: Box<dyn Camera>,
    /// The projector.
    pub projector: Box<dyn Projector>,
    /// The trigger controller, if there is one: armed when camera and projector are ready, disarmed before they are stopped.
    pub trigger: Option<Box<dyn Trigger>>,
    /// Geometry.
    pub calibration: Calibration,
    /// Patterns of one scan.
    pub sequence: PatternSequence,
    /// When they are shown.
    pub timing: SequenceTiming,
    /// How long a recording waits without a picture before it ends.
    pub silence_limit: Duration,
    /// Limits for reconstruction.
    pub limits: Limits,
    /// Choices for reconstruction.
    pub processing: Processing,
}

/// Opens the devices that a configuration names.
///
/// # Errors
/// [`DeviceError`] naming the field or the device.
pub fn open(config: &RigConfig) -> Result<Rig, DeviceError> {
    config.validate()?;
    let calibration = config.calibration()?;
    let processing = config.processing.read();
    let processing = processing.map_err(|e| DeviceError::config("processing.gamma_file", e.to_string()))?;
    let (camera, projector): (Box<dyn Camera>, Box<dyn Projector>) =
        match (config.camera.backend, config.projector.backend) {
            (Backend::Simulated, Backend::Simulated) => {
                let world = Arc::new(Mutex::new(sim::SimWorld::new(config)?));
                (Box::new(sim::SimCamera::new(Arc::clone(&world))), Box::new(sim::SimProjector::new(world)))
            }
            (Backend::Recorded, Backend::Recorded) => {
                let deck = Arc::new(Mutex::new(recorded::Deck::open(config)?));
                let camera = recorded::RecordedCamera::new(Arc::clone(&deck));
                (Box::new(camera), Box::new(recorded::RecordedProjector::new(deck)))
            }
            (Backend::Simulated, Backend::Gv3Usb) if config.projector.is_simulated() => {
                let (camera, projector) = gv3_usb::open_simulated(config)?;
                (Box::new(camera), Box::new(projector))
            }
            (Backend::Simulated, Backend::Gv3Usb) => {
                let reason =
                    "a simulated camera sees no real light; take a real camera, or the transport \"simulated\"";
                return Err(DeviceError::config("camera.backend", reason));
            }
            (Backend::Simulated, Backend::Dlpc350) => {
                let (camera, projector) = dlpc350::open_simulated(config, config.projector.dlpc350()?)?;
                (Box::new(camera), Box::new(projector))
            }
            (Backend::V4l, Backend::Gv3Usb) => (open_v4l(config)?, Box::new(gv3_usb::open(&config.projector)?)),
            (Backend::V4l, Backend::Dlpc350) => {
                (open_v4l(config)?, Box::new(dlpc350::Dlpc350Projector::open(config.projector.dlpc350()?)?))
            }
            // A simulated projector lights nothing that a real camera sees; with it a camera can be tried alone.
            (Backend::V4l, Backend::Simulated) => {
                let world = Arc::new(Mutex::new(sim::SimWorld::new(config)?));
                (open_v4l(config)?, Box::new(sim::SimProjector::new(world)))
            }
            (Backend::Gv3Usb, _) => return Err(DeviceError::config("camera.backend", "gv3_usb is a projector")),
            (Backend::Dlpc350, _) => return Err(DeviceError::config("camera.backend", "dlpc350 is a projector")),
            (_, Backend::V4l) => return Err(DeviceError::config("projector.backend", "v4l is no projector")),
            (Backend::Recorded, _) | (_, Backend::Recorded) => {
                let reason = "camera and projector must both be recorded, or neither";
                return Err(DeviceError::config("projector.backend", reason));
            }
        };
    let mut trigger = serial_trigger::open(config)?;
    let reports = trigger.as_mut().map(|trigger| trigger.events());
    let exposures = projector.exposures();
    let camera = if config.camera.backend == Backend::V4l || reports.is_some() || exposures.is_some() {
        let period_nanos = config.timing.picture_period_nanos;
        Box::new(ProvenCamera::new(camera, reports, exposures, period_nanos, config.sequence.patterns.len()))
    } else {
        camera
    };
    Ok(Rig {
        camera,
        projector,
        trigger,
        calibration,
        sequence: config.sequence.clone(),
        timing: config.timing,
        silence_limit: Duration::from_secs(config.silence_limit_seconds.into()),
        limits: config.limits,
        processing,
    })
}

#[cfg(all(feature = "v4l", target_os = "linux"))]
fn open_v4l(config: &RigConfig) -> Result<Box<dyn Camera>, DeviceError> {
    Ok(Box::new(v4l_camera::V4lCamera::open(config)?))
}

#[cfg(not(all(feature = "v4l", target_os = "linux")))]
fn open_v4l(_config: &RigConfig) -> Result<Box<dyn Camera>, DeviceError> {
    Err(DeviceError::config("camera.backend", "v4l is not part of this build; build for Linux with the feature v4l"))
}
