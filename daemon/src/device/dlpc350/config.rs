//! `[projector.dlpc350]` of a rig's file.

use crate::device::DeviceError;
use gv3_protocol::dlpc350::{BitDepth, LedCurrent, Leds, TriggerDelay, TriggerOut1, TriggerOut2};
use serde::{Deserialize, Serialize};

/// How the projector is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LinkKind {
    /// The kernel's HID driver, `/dev/hidraw*`.
    #[default]
    Hidraw,
    /// Past the kernel's driver, through usbfs; while open, the hidraw node is gone.
    Usb,
    /// No hardware: the emulated projector, to rehearse a rig.
    Emulated,
}

/// Where the patterns are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Source {
    /// In images that were written to the projector's flash with TI's tools; gv3 never writes flash.
    Flash,
    /// In the bit planes of the picture on the projector's video input.
    Video,
}

/// Colour of the light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Light {
    /// All LEDs at once.
    #[default]
    White,
    /// Red alone.
    Red,
    /// Green alone.
    Green,
    /// Blue alone.
    Blue,
}

impl Light {
    pub(super) fn leds(self) -> Leds {
        let is = |colour| self == colour || self == Self::White;
        Leds { rgb: [is(Self::Red), is(Self::Green), is(Self::Blue)] }
    }
}

/// TRIG_OUT_1, high while a pattern is exposed: the camera's trigger. Delays are from -20 046 to 2787 ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TriggerOut1Config {
    /// Low while a pattern is exposed instead.
    pub inverted: bool,
    /// From the start of the exposure, nanoseconds.
    pub rising_nanos: i32,
    /// From the end of the exposure, nanoseconds.
    pub falling_nanos: i32,
}

/// TRIG_OUT_2, a pulse at the first pattern of every sequence: tells a trigger controller which pattern is which.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TriggerOut2Config {
    /// A low pulse instead.
    pub inverted: bool,
    /// From the start of the exposure, nanoseconds, from -20 046 to 2787.
    pub rising_nanos: i32,
}

/// A LightCrafter 4500.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dlpc350Config {
    /// How it is reached.
    #[serde(default)]
    pub link: LinkKind,
    /// Serial number, where several are plugged in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub serial: Option<String>,
    /// Where it is plugged in, bus and ports as in `1-4.2`, where several are plugged in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bus_path: Option<String>,
    /// Where the patterns are.
    pub source: Source,
    /// Bits of the patterns' levels: 1, 4, 7 or 8.
    pub bit_depth: u8,
    /// Flash images that hold the patterns, in order; for flash.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub flash_images: Vec<u8>,
    /// Frame rate of the video input; for video.
    #[serde(default = "default_video_hz")]
    pub video_hz: f64,
    /// Colour of the light.
    #[serde(default)]
    pub light: Light,
    /// Current of the red, green and blue LED, 0 least to 255 most.
    #[serde(default = "default_led_current")]
    pub led_current: [u8; 3],
    /// Most current of all shining LEDs together, amperes.
    #[serde(default = "default_led_limit_a")]
    pub led_limit_a: f64,
    /// Shortest exposure at this bit depth, microseconds, in place of the guide's; the projector still has the last word.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_exposure_us: Option<u32>,
    /// The camera's trigger.
    #[serde(default)]
    pub trigger_out_1: TriggerOut1Config,
    /// The start of a sequence.
    #[serde(default)]
    pub trigger_out_2: TriggerOut2Config,
}

fn default_video_hz() -> f64 {
    60.0
}

fn default_led_current() -> [u8; 3] {
    [60; 3]
}

/// What the evaluation board's supply is said to bear.
fn default_led_limit_a() -> f64 {
    4.3
}

impl Dlpc350Config {
    /// A projector with patterns of `bit_depth` in flash images 0, 1, 2...
    pub fn flash(bit_depth: u8, images: u8) -> Self {
        Self {
            link: LinkKind::Hidraw,
            serial: None,
            bus_path: None,
            source: Source::Flash,
            bit_depth,
            flash_images: (0..images).collect(),
            video_hz: default_video_hz(),
            light: Light::White,
            led_current: default_led_current(),
            led_limit_a: default_led_limit_a(),
            min_exposure_us: None,
            trigger_out_1: TriggerOut1Config::default(),
            trigger_out_2: TriggerOut2Config::default(),
        }
    }

    /// Checks every field.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field.
    pub fn validate(&self) -> Result<(), DeviceError> {
        self.depth()?;
        self.triggers()?;
        self.check_current()?;
        if self.source == Source::Flash && !(1..=64).contains(&self.flash_images.len()) {
            let reason = format!("{} images, expected 1 to 64", self.flash_images.len());
            return Err(DeviceError::config("projector.dlpc350.flash_images", reason));
        }
        if !(10.0..=250.0).contains(&self.video_hz) {
            return Err(DeviceError::config(
                "projector.dlpc350.video_hz",
                format!("{}, expected 10 to 250", self.video_hz),
            ));
        }
        Ok(())
    }

    fn check_current(&self) -> Result<(), DeviceError> {
        if !(self.led_limit_a > 0.0 && self.led_limit_a.is_finite()) {
            let reason = format!("{}, expected more than 0", self.led_limit_a);
            return Err(DeviceError::config("projector.dlpc350.led_limit_a", reason));
        }
        let shining = self.light.leds().rgb;
        let amperes: f64 =
            self.current().amperes().iter().zip(shining).filter(|(_, is_on)| *is_on).map(|(a, _)| a).sum();
        if amperes > self.led_limit_a {
            let reason = format!(
                "{:?} is {amperes:.2} A in all, more than led_limit_a = {}; lower the currents",
                self.led_current, self.led_limit_a
            );
            return Err(DeviceError::config("projector.dlpc350.led_current", reason));
        }
        Ok(())
    }

    pub(super) fn current(&self) -> LedCurrent {
        LedCurrent { rgb: self.led_current }
    }

    /// The depths whose place among an image's planes is known from more than one source.
    pub(super) fn depth(&self) -> Result<BitDepth, DeviceError> {
        let depth = BitDepth::new(self.bit_depth).filter(|_| matches!(self.bit_depth, 1 | 4 | 7 | 8));
        depth.ok_or_else(|| {
            DeviceError::config("projector.dlpc350.bit_depth", format!("{}, expected 1, 4, 7 or 8", self.bit_depth))
        })
    }

    pub(super) fn least_exposure_us(&self) -> Result<u32, DeviceError> {
        Ok(self.min_exposure_us.unwrap_or(self.depth()?.min_exposure_us()))
    }

    pub(super) fn triggers(&self) -> Result<(TriggerOut1, TriggerOut2), DeviceError> {
        let delay = |field: &str, nanos| {
            TriggerDelay::from_nanos(nanos).map_err(|_| {
                DeviceError::config(format!("projector.dlpc350.{field}"), format!("{nanos} is outside -20046 to 2787"))
            })
        };
        let (one, two) = (self.trigger_out_1, self.trigger_out_2);
        let one = TriggerOut1 {
            inverted: one.inverted,
            rising: delay("trigger_out_1.rising_nanos", one.rising_nanos)?,
            falling: delay("trigger_out_1.falling_nanos", one.falling_nanos)?,
        };
        let rising = delay("trigger_out_2.rising_nanos", two.rising_nanos)?;
        Ok((one, TriggerOut2 { inverted: two.inverted, rising }))
    }
}
