//! `[camera.v4l]`: which V4L2 camera, and how it is set up.

use super::DeviceError;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// How the camera sends its pixels; all of them become 8-bit grey.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum PixelFormat {
    /// 8-bit grey, taken as it is.
    #[default]
    Grey,
    /// 10 bits in 16, little-endian: the upper 8 are kept.
    Y10,
    /// 12 bits in 16, little-endian: the upper 8 are kept.
    Y12,
    /// 16 bits, little-endian: the upper 8 are kept.
    Y16,
    /// YUV 4:2:2: luma; 16..=235 is spread to 0..=255 unless the driver says that luma has its full range.
    Yuyv,
    /// A JPEG a picture: its luma. Lossy; fringes suffer.
    Mjpeg,
}

impl PixelFormat {
    /// V4L2's code.
    pub fn fourcc(self) -> [u8; 4] {
        match self {
            Self::Grey => *b"GREY",
            Self::Y10 => *b"Y10 ",
            Self::Y12 => *b"Y12 ",
            Self::Y16 => *b"Y16 ",
            Self::Yuyv => *b"YUYV",
            Self::Mjpeg => *b"MJPG",
        }
    }
}

/// Value of a control: a number, a switch, or the name of a menu's item.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ControlValue {
    /// Of a switch.
    Switch(bool),
    /// Of a number, or a menu's index.
    Number(i64),
    /// Of a menu, by the item's name.
    Item(String),
}

/// The control that sets the exposure, where it is not the standard one in units of 100 microseconds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExposureControl {
    /// Its name.
    pub control: String,
    /// Its unit, nanoseconds.
    pub unit_nanos: u64,
}

/// The control that makes the camera wait for its trigger line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TriggerControl {
    /// Its name.
    pub control: String,
    /// Value for exposures started by the trigger line.
    pub external: ControlValue,
    /// Value for exposures by the camera's own clock.
    pub internal: ControlValue,
}

/// Which V4L2 camera, and how it is set up. Of `device`, `name`, `serial` and `bus` those that are given must all fit, and fit
/// one camera only; with none of them the only camera is taken. Names of controls are compared by letters and digits alone, in
/// either case: "Exposure Time, Absolute" is `exposure_time_absolute`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct V4lConfig {
    /// Device node, or a link to it such as /dev/v4l/by-id/...; node numbers change from start to start.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub device: Option<PathBuf>,
    /// Part of the camera's name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Serial number of the USB device.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub serial: Option<String>,
    /// Where it is plugged in, as V4L2 tells it: "usb-0000:00:14.0-1"; the beginning is enough.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bus: Option<String>,
    /// How pixels are sent.
    pub pixel_format: PixelFormat,
    /// Buffers that the driver fills in turn: how many pictures the reader may be behind before one is lost.
    pub buffers: u32,
    /// Gain in the camera's units; the camera's own setting is kept without it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain: Option<i64>,
    /// What sets the exposure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<ExposureControl>,
    /// What makes it wait for the trigger line; the camera's own setting is kept without it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trigger: Option<TriggerControl>,
    /// Further controls, set before the others.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub controls: BTreeMap<String, ControlValue>,
}

impl Default for V4lConfig {
    fn default() -> Self {
        Self {
            device: None,
            name: None,
            serial: None,
            bus: None,
            pixel_format: PixelFormat::Grey,
            buffers: 8,
            gain: None,
            exposure: None,
            trigger: None,
            controls: BTreeMap::new(),
        }
    }
}

impl V4lConfig {
    /// Checks ranges.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field.
    pub fn validate(&self) -> Result<(), DeviceError> {
        if !(2..=32).contains(&self.buffers) {
            return Err(DeviceError::config("camera.v4l.buffers", format!("{} is outside 2 ..= 32", self.buffers)));
        }
        if let Some(unit) = self.exposure.as_ref().map(|e| e.unit_nanos).filter(|u| !(1..=1_000_000_000).contains(u)) {
            let reason = format!("{unit} is outside 1 ..= 1000000000");
            return Err(DeviceError::config("camera.v4l.exposure.unit_nanos", reason));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documented_table_is_read() {
        let text = r#"
            name = "fringe camera"
            pixel_format = "Y10"
            gain = 16
            exposure = { control = "exposure", unit_nanos = 1000 }
            trigger = { control = "Trigger Mode", external = 1, internal = "Off" }
            [controls]
            "White Balance, Automatic" = false
            brightness = 128
        "#;
        let config: V4lConfig = toml::from_str(text).unwrap();
        config.validate().unwrap();
        assert_eq!((config.pixel_format, config.buffers), (PixelFormat::Y10, 8));
        assert_eq!(config.trigger.as_ref().unwrap().internal, ControlValue::Item("Off".into()));
        assert_eq!(config.controls["White Balance, Automatic"], ControlValue::Switch(false));
        assert_eq!(config.controls["brightness"], ControlValue::Number(128));
        assert_eq!(toml::from_str::<V4lConfig>(&toml::to_string(&config).unwrap()).unwrap(), config);
        assert!(toml::from_str::<V4lConfig>("colour = 1").is_err());
        let error = V4lConfig { buffers: 1, ..config }.validate().unwrap_err().to_string();
        assert!(error.starts_with("camera.v4l.buffers"), "{error}");
    }
}
