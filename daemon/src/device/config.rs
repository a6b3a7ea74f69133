//! A rig's configuration: which devices, which patterns, when, and with what calibration.

use super::dlpc350::Dlpc350Config;
use super::gv3_usb::UsbTransportKind;
use super::recorded::{RecordedConfig, stored_config};
use super::{CameraSettings, DeviceError, SequenceTiming, TriggerConfig, TriggerSource, V4lConfig};
use crate::device::sim::{SceneConfig, SimConfig};
use crate::files::{ProcessingConfig, SessionsConfig};
use crate::light::{Calibration, Distortion, Intrinsics, LightError, Limits, PatternSequence, Rigid};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Kind of device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// In process, no hardware.
    Simulated,
    /// A raw recording, as `[recorded]` names it.
    Recorded,
    /// A projector that speaks the gv3 vendor protocol over USB.
    #[serde(rename = "gv3_usb")]
    Gv3Usb,
    /// A camera behind Video4Linux, as `[camera.v4l]` names it.
    V4l,
    /// A TI LightCrafter 4500 projector, as `[projector.dlpc350]` names it.
    Dlpc350,
}

/// The camera of a rig.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Kind of device.
    pub backend: Backend,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Which V4L2 camera, and how it is set up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub v4l: Option<V4lConfig>,
}

/// The projector of a rig.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProjectorConfig {
    /// Kind of device.
    pub backend: Backend,
    /// Who does the transfers of a USB projector; nusb when nothing is said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transport: Option<UsbTransportKind>,
    /// Serial number of the USB projector meant, where there are several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub serial: Option<String>,
    /// Where the USB projector meant is plugged in: bus and ports as in `3-1.2`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bus_path: Option<String>,
    /// Which LightCrafter 4500, and how it is set up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dlpc350: Option<Dlpc350Config>,
}

impl ProjectorConfig {
    /// A projector that needs no more said.
    pub fn of(backend: Backend) -> Self {
        Self { backend, transport: None, serial: None, bus_path: None, dlpc350: None }
    }

    /// Whether it is a USB projector in this process.
    pub fn is_simulated(&self) -> bool {
        self.transport == Some(UsbTransportKind::Simulated)
    }

    /// The settings of a LightCrafter 4500.
    ///
    /// # Errors
    /// [`DeviceError::Config`] when there are none.
    pub fn dlpc350(&self) -> Result<&Dlpc350Config, DeviceError> {
        self.dlpc350.as_ref().ok_or_else(|| DeviceError::config("projector.dlpc350", "missing for this backend"))
    }

    /// Only gv3 projectors have a transport, a serial number and a place; a LightCrafter has a table of its own.
    fn validate(&self) -> Result<(), DeviceError> {
        let fields = [
            ("projector.transport", self.transport.is_some()),
            ("projector.serial", self.serial.is_some()),
            ("projector.bus_path", self.bus_path.is_some()),
        ];
        if let Some((field, _)) = fields.into_iter().find(|(_, is_given)| *is_given && self.backend != Backend::Gv3Usb)
        {
            return Err(DeviceError::config(field, "only for the backend \"gv3_usb\"; remove it"));
        }
        self.dlpc350.as_ref().map_or(Ok(()), Dlpc350Config::validate)
    }
}

/// Everything about a rig, as in its TOML file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigConfig {
    /// Name shown to people.
    pub name: String,
    /// Calibration file (TOML, JSON or OpenCV's YAML); a relative path starts at the rig's file. Either this or `calibration`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration_file: Option<PathBuf>,
    /// How long a recording waits without a picture, say while a device is unplugged, before it ends; seconds.
    #[serde(default = "default_silence_limit_seconds", skip_serializing_if = "is_default_silence_limit")]
    pub silence_limit_seconds: u32,
    /// The camera.
    pub camera: CameraConfig,
    /// The projector.
    pub projector: ProjectorConfig,
    /// The trigger controller, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trigger: Option<TriggerConfig>,
    /// When patterns are shown.
    pub timing: SequenceTiming,
    /// Limits for reconstruction.
    #[serde(default)]
    pub limits: Limits,
    /// Choices for reconstruction.
    #[serde(default, skip_serializing_if = "ProcessingConfig::is_default")]
    pub processing: ProcessingConfig,
    /// The simulated world, for simulated devices.
    #[serde(default)]
    pub sim: SimConfig,
    /// The recording, for recorded devices.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recorded: Option<RecordedConfig>,
    /// Where the daemon records to, and for how long it keeps what it recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sessions: Option<SessionsConfig>,
    /// Patterns of one scan.
    pub sequence: PatternSequence,
    /// Calibration in place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<Calibration>,
}

fn default_silence_limit_seconds() -> u32 {
    60
}

fn is_default_silence_limit(seconds: &u32) -> bool {
    *seconds == default_silence_limit_seconds()
}

impl RigConfig {
    /// The built-in simulated scanner: 640x480 at 180 pictures/s, 30 scans/s, a talking head at 600 mm.
    pub fn simulated() -> Self {
        let calibration = simulated_calibration();
        let projector_size_px = [calibration.projector.width_px, calibration.projector.height_px];
        Self {
            name: "simulated scanner".into(),
            calibration_file: None,
            camera: CameraConfig { backend: Backend::Simulated, width_px: 640, height_px: 480, v4l: None },
            projector: ProjectorConfig::of(Backend::Simulated),
            trigger: None,
            timing: SequenceTiming { picture_period_nanos: 5_555_556, exposure_nanos: 5_000_000 },
            silence_limit_seconds: default_silence_limit_seconds(),
            limits: Limits::default(),
            processing: ProcessingConfig::default(),
            sim: SimConfig::default(),
            recorded: None,
            sessions: None,
            // 264 px is the shortest whole multiple of 22 px that the working range allows; a ratio of 12 leaves five sigma
            // of the low phase to half a fringe at the least modulation of the mask.
            sequence: PatternSequence::two_frequency(projector_size_px, 264.0, 22.0, 3),
            calibration: Some(calibration),
        }
    }

    /// The rig of a raw recording, played back.
    ///
    /// # Errors
    /// [`DeviceError::File`] when there is no recording or its configuration cannot be read.
    pub fn recorded(recorded: RecordedConfig) -> Result<Self, DeviceError> {
        stored_config(recorded)
    }

    /// Reads and checks a rig's file.
    ///
    /// # Errors
    /// [`DeviceError::File`] with line and column, or [`DeviceError::Config`] naming the field.
    pub fn read(path: &Path) -> Result<Self, DeviceError> {
        let file_error = |reason: String| DeviceError::File { path: path.to_path_buf(), reason };
        let text = std::fs::read_to_string(path).map_err(|e| file_error(e.to_string()))?;
        let mut config: Self = toml::from_str(&text).map_err(|e| file_error(e.to_string()))?;
        if let (Some(file), Some(folder)) = (&config.calibration_file, path.parent()) {
            config.calibration_file = Some(folder.join(file));
        }
        config.processing.start_at(path);
        if let Some(folder) = path.parent() {
            match &mut config.sim.scene {
                SceneConfig::Obj(file) => *file = folder.join(&file),
                SceneConfig::Sequence(sequence) => sequence.folder = folder.join(&sequence.folder),
                _ => {}
            }
        }
        if let (Some(recorded), Some(folder)) = (&mut config.recorded, path.parent()) {
            recorded.path = folder.join(&recorded.path);
        }
        if let (Some(sessions), Some(folder)) = (&mut config.sessions, path.parent()) {
            sessions.directory = folder.join(&sessions.directory);
        }
        config.validate()?;
        Ok(config)
    }

    /// The calibration, from its file or in place.
    ///
    /// # Errors
    /// [`DeviceError`] when there is none, two, or one that cannot work.
    pub fn calibration(&self) -> Result<Calibration, DeviceError> {
        match (&self.calibration_file, &self.calibration) {
            (Some(path), None) => {
                let file_error = |reason: String| DeviceError::File { path: path.clone(), reason };
                let text = std::fs::read_to_string(path).map_err(|e| file_error(e.to_string()))?;
                let camera_px = [self.camera.width_px, self.camera.height_px];
                let sizes_px = [camera_px, [self.sequence.width_px, self.sequence.height_px]];
                let found: Result<_, LightError> = Calibration::from_text(&text, || Ok(sizes_px));
                found.map_err(|e| file_error(e.to_string()))
            }
            (None, Some(calibration)) => {
                calibration.validate()?;
                Ok(*calibration)
            }
            (None, None) => Err(DeviceError::config("calibration", "missing; give calibration_file or [calibration]")),
            (Some(_), Some(_)) => {
                Err(DeviceError::config("calibration_file", "given beside [calibration]; remove one of the two"))
            }
        }
    }

    /// Settings for the rig's camera.
    pub fn camera_settings(&self) -> CameraSettings {
        CameraSettings {
            width_px: self.camera.width_px,
            height_px: self.camera.height_px,
            exposure_nanos: self.timing.exposure_nanos,
            trigger: TriggerSource::Projector,
        }
    }

    /// Checks every part and that they fit together.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the first field that cannot work.
    pub fn validate(&self) -> Result<(), DeviceError> {
        self.sequence.validate()?;
        self.timing.validate()?;
        self.limits.validate()?;
        self.projector.validate()?;
        self.sim.validate(self.sequence.patterns.len())?;
        self.sessions.as_ref().map_or(Ok(()), SessionsConfig::validate)?;
        self.camera.v4l.as_ref().map_or(Ok(()), V4lConfig::validate)?;
        self.trigger.as_ref().map_or(Ok(()), |trigger| trigger.validate(&self.timing))?;
        let calibration = self.calibration()?;
        let pairs = [
            ("camera.width_px", self.camera.width_px, calibration.camera.width_px),
            ("camera.height_px", self.camera.height_px, calibration.camera.height_px),
            ("sequence.width_px", self.sequence.width_px, calibration.projector.width_px),
            ("sequence.height_px", self.sequence.height_px, calibration.projector.height_px),
        ];
        for (field, found, calibrated) in pairs {
            if found != calibrated {
                return Err(DeviceError::config(field, format!("{found}, but the calibration is for {calibrated}")));
            }
        }
        Ok(())
    }
}

/// True geometry of the simulated scanner: baseline 160 mm, both lenses aimed at a point 600 mm before the camera.
fn simulated_calibration() -> Calibration {
    let camera = Intrinsics {
        width_px: 640,
        height_px: 480,
        fx_px: 1180.0,
        fy_px: 1180.0,
        cx_px: 321.3,
        cy_px: 238.6,
        distortion: Distortion { k1: -0.09, k2: 0.05, p1: 3e-4, p2: -2e-4, k3: 0.0 },
    };
    let projector = Intrinsics {
        width_px: 912,
        height_px: 1140,
        fx_px: 2600.0,
        fy_px: 2600.0,
        cx_px: 455.5,
        cy_px: 569.5,
        distortion: Distortion { k1: -0.03, k2: 0.0, p1: 1e-4, p2: 1e-4, k3: 0.0 },
    };
    // A turn by the angle whose tangent is 160 / 600; the square root is the same on every machine, sine and cosine are not.
    let [sine, cosine] = [160.0, 600.0].map(|side: f64| side / f64::sqrt(160.0 * 160.0 + 600.0 * 600.0));
    let rotation = DMat3::from_cols(DVec3::new(cosine, 0.0, -sine), DVec3::Y, DVec3::new(sine, 0.0, cosine));
    let centre_mm = DVec3::new(160.0, 0.0, 0.0);
    Calibration { camera, projector, projector_from_camera: Rigid::new(rotation, -(rotation * centre_mm)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::{Direction, Pattern};

    #[test]
    fn toml_round_trip() {
        let config = RigConfig::simulated();
        config.validate().unwrap();
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<RigConfig>(&text).unwrap(), config);
    }

    #[test]
    fn the_example_rig_is_the_built_in_one() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/simulated.toml");
        assert_eq!(RigConfig::read(&path).unwrap(), RigConfig::simulated());
    }

    #[test]
    fn a_calibration_file_is_found_beside_the_rig() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = RigConfig::simulated();
        let calibration = config.calibration.take().unwrap();
        config.calibration_file = Some("calibration.toml".into());
        let rig = folder.path().join("rig.toml");
        std::fs::write(&rig, toml::to_string(&config).unwrap()).unwrap();
        let missing = RigConfig::read(&rig).unwrap_err().to_string();
        assert!(missing.contains("calibration.toml"), "{missing}");
        std::fs::write(folder.path().join("calibration.toml"), calibration.to_toml().unwrap()).unwrap();
        assert_eq!(RigConfig::read(&rig).unwrap().calibration().unwrap(), calibration);
        std::fs::write(folder.path().join("calibration.toml"), calibration.to_opencv()).unwrap();
        assert_eq!(RigConfig::read(&rig).unwrap().calibration().unwrap(), calibration);
    }

    #[test]
    fn errors_name_the_field() {
        let error = |change: fn(&mut RigConfig)| {
            let mut config = RigConfig::simulated();
            change(&mut config);
            config.validate().unwrap_err().to_string()
        };
        assert!(error(|c| c.camera.width_px = 320).starts_with("camera.width_px"));
        assert!(error(|c| c.timing.exposure_nanos = 9_000_000).starts_with("timing.exposure_nanos"));
        assert!(error(|c| c.calibration = None).starts_with("calibration"));
        assert!(
            error(|c| c.sequence.patterns[4] = Pattern::sinusoid(f64::NAN, 0.0, Direction::Columns))
                .contains("patterns[4].period_px")
        );
        assert!(error(|c| c.limits.depth.far_mm = 10.0).starts_with("depth.far_mm"));
        assert!(error(|c| c.sim.electrons_per_level = 0.0).starts_with("sim.electrons_per_level"));
    }
}
