//! HID reports to a projector and back.

use super::config::Dlpc350Config;
use gv3_protocol::dlpc350::{PRODUCT_ID, Report, VENDOR_ID};
use std::fmt;
use std::time::Duration;

/// Why a report did not get through.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// Nothing came in time.
    #[error("no answer within {} ms", .0.as_millis())]
    Timeout(Duration),
    /// The device is gone.
    #[error("disconnected")]
    Disconnected,
    /// Anything else.
    #[error("{0}")]
    Failed(String),
}

/// A cable to a HID device whose reports are 64 bytes and have no numbers.
pub trait HidLink: Send {
    /// Sends a report.
    ///
    /// # Errors
    /// [`LinkError::Disconnected`] when the device is gone, [`LinkError::Failed`] otherwise.
    fn write_report(&mut self, report: &Report) -> Result<(), LinkError>;
    /// Waits for the next report.
    ///
    /// # Errors
    /// [`LinkError::Timeout`] when none came in time; a report of another length is [`LinkError::Failed`].
    fn read_report(&mut self, timeout: Duration) -> Result<Report, LinkError>;
    /// Lets time pass for the device.
    fn pause(&mut self, time: Duration) {
        std::thread::sleep(time);
    }
}

/// Opens the cable, and opens it again after the device was unplugged.
pub trait HidOpener: Send {
    /// The device, as messages name it.
    fn name(&self) -> String;
    /// Opens the cable.
    ///
    /// # Errors
    /// [`LinkError::Failed`] with what to do: not found, no rights, in use.
    fn open(&mut self) -> Result<Box<dyn HidLink>, LinkError>;
}

/// The projector that a configuration means.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Wanted {
    serial: Option<String>,
    bus_path: Option<String>,
}

impl Wanted {
    pub(super) fn new(config: &Dlpc350Config) -> Self {
        Self { serial: config.serial.clone(), bus_path: config.bus_path.clone() }
    }

    /// The one that is meant among those found; `place` gives bus path and serial number.
    ///
    /// # Errors
    /// [`LinkError::Failed`] when there is none, or more than one.
    pub(super) fn choose<T>(&self, found: Vec<T>, place: impl Fn(&T) -> [String; 2]) -> Result<T, LinkError> {
        let is_meant = |one: &T| {
            let [bus_path, serial] = place(one);
            self.serial.as_ref().is_none_or(|wanted| *wanted == serial)
                && self.bus_path.as_ref().is_none_or(|wanted| *wanted == bus_path)
        };
        if found.is_empty() {
            let reason = format!("not found (USB {VENDOR_ID:04x}:{PRODUCT_ID:04x}); is it plugged in and switched on?");
            return Err(LinkError::Failed(reason));
        }
        let list: Vec<String> = found.iter().map(|one| format!("{:?}", place(one))).collect();
        let mut meant: Vec<T> = found.into_iter().filter(is_meant).collect();
        match (meant.pop(), meant.len()) {
            (Some(one), 0) => Ok(one),
            (one, more) => Err(LinkError::Failed(format!(
                "{} of {} match; set bus_path or serial of projector.dlpc350 to one of {}",
                more + usize::from(one.is_some()),
                list.len(),
                list.join(", ")
            ))),
        }
    }
}

impl fmt::Display for Wanted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&self.bus_path, &self.serial) {
            (Some(bus_path), _) => write!(f, "LightCrafter 4500 at {bus_path}"),
            (None, Some(serial)) => write!(f, "LightCrafter 4500 {serial}"),
            (None, None) => f.write_str("LightCrafter 4500"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_projector_meant_is_chosen() {
        let choose = |serial: Option<&str>, bus_path: Option<&str>, found: &[[&'static str; 2]]| {
            let wanted = Wanted { serial: serial.map(Into::into), bus_path: bus_path.map(Into::into) };
            wanted
                .choose(found.to_vec(), |one| one.map(String::from))
                .map(|[bus_path, _]| bus_path)
                .map_err(|e| e.to_string())
        };
        let two = [["1-3", "LCR3"], ["1-4.2", ""]];
        assert_eq!(choose(Some("LCR3"), None, &two).unwrap(), "1-3");
        assert_eq!(choose(None, Some("1-4.2"), &two).unwrap(), "1-4.2");
        assert_eq!(choose(None, None, &two[1..]).unwrap(), "1-4.2");
        let which = choose(None, None, &two).unwrap_err();
        assert!(which.starts_with("2 of 2 match") && which.contains(r#"["1-4.2", ""]"#), "{which}");
        assert!(choose(Some("LCR3"), Some("1-4.2"), &two).unwrap_err().starts_with("0 of 2 match"));
        let none = choose(None, None, &[]).unwrap_err();
        assert!(none.contains("0451:6401") && none.contains("plugged in"), "{none}");
    }
}
