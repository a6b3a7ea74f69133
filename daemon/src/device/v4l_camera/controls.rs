//! Controls by name, each read back after it was set.

use super::driver_call;
use super::kernel::{Control, controls, menu};
use crate::device::{CameraSettings, ControlValue, DeviceError, TriggerSource, V4lConfig};
use std::collections::BTreeMap;
use tracing::warn;
use v4l::Device;
use v4l::control::Value;

// Standard controls, as in linux/v4l2-controls.h.
const GAIN: u32 = 0x0098_0913;
const ANALOGUE_GAIN: u32 = 0x009e_0903;
const EXPOSURE_AUTO: u32 = 0x009a_0901;
const EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
const EXPOSURE_AUTO_MANUAL: i64 = 1;
/// Unit of the standard exposure control.
const EXPOSURE_ABSOLUTE_NANOS: u64 = 100_000;

/// A control that was set, with what the camera says it is now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SetControl {
    /// The camera's name of it.
    pub name: String,
    /// What was asked for.
    pub wanted: i64,
    /// What the camera says; `None` of one that cannot be read.
    pub set: Option<i64>,
}

/// Sets up a camera and tells what it made of it, and the exposure in nanoseconds if it can be set at all.
pub(super) fn apply(
    device: &Device,
    config: &V4lConfig,
    want: &CameraSettings,
) -> Result<(Vec<SetControl>, Option<u64>), DeviceError> {
    let known = controls(device);
    let mut panel = Panel { device, known: &known, done: Vec::new() };
    for (name, value) in &config.controls {
        panel.set_named(&format!("camera.v4l.controls.\"{name}\""), name, value)?;
    }
    if let Some(gain) = config.gain {
        let control = panel.standard(GAIN).or_else(|| panel.standard(ANALOGUE_GAIN));
        let control = control.ok_or_else(|| panel.missing("camera.v4l.gain", "gain"))?;
        panel.set("camera.v4l.gain", control, gain)?;
    }
    if let Some(trigger) = &config.trigger {
        let value = match want.trigger {
            TriggerSource::Projector => &trigger.external,
            TriggerSource::Internal { .. } => &trigger.internal,
        };
        panel.set_named("camera.v4l.trigger", &trigger.control, value)?;
    }
    let exposure_nanos = panel.set_exposure(config, want.exposure_nanos)?;
    Ok((panel.done, exposure_nanos))
}

struct Panel<'a> {
    device: &'a Device,
    known: &'a [Control],
    done: Vec<SetControl>,
}

impl<'a> Panel<'a> {
    fn standard(&self, id: u32) -> Option<&'a Control> {
        self.known.iter().find(|control| control.id == id)
    }

    fn named(&self, field: &str, name: &str) -> Result<&'a Control, DeviceError> {
        find(self.known, name).ok_or_else(|| self.missing(field, name))
    }

    fn missing(&self, field: &str, name: &str) -> DeviceError {
        let names: Vec<&str> = self.known.iter().map(|control| control.name.as_str()).collect();
        let names = if names.is_empty() { "none".to_owned() } else { names.join("; ") };
        DeviceError::config(field, format!("the camera has no control \"{name}\"; it has: {names}"))
    }

    fn set_named(&mut self, field: &str, name: &str, value: &ControlValue) -> Result<(), DeviceError> {
        let control = self.named(field, name)?;
        let number = match value {
            ControlValue::Number(number) => *number,
            ControlValue::Switch(is_on) => i64::from(*is_on),
            ControlValue::Item(item) => item_value(field, item, &menu(self.device, control))?,
        };
        self.set(field, control, number)
    }

    /// Sets a control and reads it back; a driver that rounds is told of, not refused.
    fn set(&mut self, field: &str, control: &Control, wanted: i64) -> Result<(), DeviceError> {
        check(field, control, wanted)?;
        let value = if control.is_switch { Value::Boolean(wanted != 0) } else { Value::Integer(wanted) };
        driver_call(|| self.device.set_control(v4l::Control { id: control.id, value }))
            .map_err(|e| DeviceError::config(field, format!("the camera refuses {wanted}: {e}")))?;
        let set = driver_call(|| self.device.control(control.id)).ok().and_then(|control| match control.value {
            Value::Integer(number) => Some(number),
            Value::Boolean(is_on) => Some(i64::from(is_on)),
            _ => None,
        });
        if set != Some(wanted) {
            warn!(control = control.name, wanted, ?set, "the camera keeps another value than the one asked for");
        }
        self.done.push(SetControl { name: control.name.clone(), wanted, set });
        Ok(())
    }

    fn set_exposure(&mut self, config: &V4lConfig, wanted_nanos: u64) -> Result<Option<u64>, DeviceError> {
        let field = "camera.v4l.exposure";
        let (control, unit_nanos) = match &config.exposure {
            Some(exposure) => (self.named(field, &exposure.control)?, exposure.unit_nanos),
            None => match self.standard(EXPOSURE_ABSOLUTE) {
                Some(control) => (control, EXPOSURE_ABSOLUTE_NANOS),
                None => {
                    warn!("the camera has no standard exposure control; its own exposure is kept");
                    return Ok(None);
                }
            },
        };
        if let Some(auto) = self.standard(EXPOSURE_AUTO).filter(|auto| !is_named(&config.controls, &auto.name)) {
            self.set(field, auto, EXPOSURE_AUTO_MANUAL)?;
        }
        let units = i64::try_from((wanted_nanos + unit_nanos / 2) / unit_nanos).unwrap_or(i64::MAX);
        self.set(field, control, nearest(control, units))?;
        let set = self.done.last().and_then(|done| done.set).unwrap_or(units);
        Ok(Some(u64::try_from(set).unwrap_or(0).saturating_mul(unit_nanos)))
    }
}

/// The nearest value that a control can take.
fn nearest(control: &Control, value: i64) -> i64 {
    let value = value.clamp(control.minimum, control.maximum.max(control.minimum));
    let step = i64::try_from(control.step.max(1)).unwrap_or(i64::MAX);
    value - value.wrapping_sub(control.minimum).checked_rem(step).unwrap_or(0)
}

fn check(field: &str, control: &Control, wanted: i64) -> Result<(), DeviceError> {
    let Control { name, minimum, maximum, .. } = control;
    if control.is_read_only {
        return Err(DeviceError::config(field, format!("\"{name}\" can only be read")));
    }
    if !(*minimum..=*maximum).contains(&wanted) {
        let reason = format!("{wanted} is outside {minimum} ..= {maximum}, the range of \"{name}\"");
        return Err(DeviceError::config(field, reason));
    }
    Ok(())
}

fn item_value(field: &str, item: &str, items: &[(i64, String)]) -> Result<i64, DeviceError> {
    let found = items.iter().find(|(_, name)| plain(name) == plain(item));
    found.map(|(value, _)| *value).ok_or_else(|| {
        let names: Vec<&str> = items.iter().map(|(_, name)| name.as_str()).collect();
        let names = if names.is_empty() { "no menu".to_owned() } else { names.join("; ") };
        DeviceError::config(field, format!("no item \"{item}\"; it has: {names}"))
    })
}

fn find<'a>(known: &'a [Control], name: &str) -> Option<&'a Control> {
    known.iter().find(|control| plain(&control.name) == plain(name))
}

fn is_named(controls: &BTreeMap<String, ControlValue>, name: &str) -> bool {
    controls.keys().any(|key| plain(key) == plain(name))
}

/// Letters and digits, in lower case.
fn plain(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn control(name: &str, range: [i64; 2], step: u64) -> Control {
        let [minimum, maximum] = range;
        let name = name.to_owned();
        Control { id: 1, name, is_switch: false, is_menu: false, is_read_only: false, minimum, maximum, step }
    }

    #[test]
    fn names_are_found_however_they_are_written() {
        let known = [control("Gain", [0, 10], 1), control("Exposure Time, Absolute", [1, 10_000], 1)];
        for name in ["Exposure Time, Absolute", "exposure_time_absolute", "EXPOSURE TIME ABSOLUTE"] {
            assert_eq!(find(&known, name), Some(&known[1]));
        }
        assert_eq!(find(&known, "exposure"), None);
    }

    #[test]
    fn the_nearest_value_is_one_the_control_has() {
        let exposure = control("Exposure", [3, 5000], 10);
        assert_eq!([0, 3, 12, 13, 4999, 9000].map(|v| nearest(&exposure, v)), [3, 3, 3, 13, 4993, 4993]);
        assert_eq!(nearest(&control("odd", [i64::MIN, i64::MAX], 0), 7), 7);
        assert_eq!(nearest(&control("empty", [5, 1], 1), 7), 5);
    }

    #[test]
    fn what_cannot_be_set_says_why() {
        let error = |result: Result<(), DeviceError>| result.unwrap_err().to_string();
        let gain = control("Gain", [0, 480], 1);
        assert!(check("camera.v4l.gain", &gain, 480).is_ok());
        let range = error(check("camera.v4l.gain", &gain, 481));
        assert_eq!(range, "camera.v4l.gain: 481 is outside 0 ..= 480, the range of \"Gain\"");
        let fixed = Control { is_read_only: true, ..gain };
        assert!(error(check("camera.v4l.gain", &fixed, 1)).contains("only be read"));
        let items = [(0, "Auto Mode".to_owned()), (1, "Manual Mode".to_owned())];
        assert_eq!(item_value("f", "manual mode", &items).unwrap(), 1);
        assert!(item_value("f", "off", &items).unwrap_err().to_string().contains("Auto Mode; Manual Mode"));
    }
}
