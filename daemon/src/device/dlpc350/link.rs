//! HID reports to a projector and back.

use gv3_protocol::dlpc350::Report;
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
