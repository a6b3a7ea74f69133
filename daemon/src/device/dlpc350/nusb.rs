//! HID reports by nusb, past the kernel's HID driver, which gets the interface back afterwards.

use super::link::{HidLink, HidOpener, LinkError, Wanted};
use gv3_protocol::dlpc350::{PRODUCT_ID, REPORT_BYTES, Report, VENDOR_ID};
use nusb::descriptors::TransferType;
use nusb::transfer::{Buffer, Completion, Direction, In, Interrupt, Out, TransferError};
use nusb::{DeviceInfo, Endpoint, ErrorKind, Interface, MaybeFuture};
use std::time::Duration;

/// The interface that takes commands.
const INTERFACE: u8 = 0;
/// How long the projector may take to take a report.
const WRITE_TIMEOUT: Duration = Duration::from_secs(2);

/// Opens the USB device that a configuration means.
pub(super) struct NusbOpener(pub(super) Wanted);

impl HidOpener for NusbOpener {
    fn name(&self) -> String {
        self.0.to_string()
    }

    fn open(&mut self) -> Result<Box<dyn HidLink>, LinkError> {
        let devices = nusb::list_devices().wait().map_err(|e| LinkError::Failed(format!("USB devices: {e}")))?;
        let is_ours = |d: &DeviceInfo| (d.vendor_id(), d.product_id()) == (VENDOR_ID, PRODUCT_ID);
        let found: Vec<_> = devices.filter(is_ours).map(|d| (bus_path(&d), d)).collect();
        let place = |one: &(String, DeviceInfo)| [one.0.clone(), one.1.serial_number().unwrap_or_default().into()];
        let (_, info) = self.0.choose(found, place)?;
        Ok(Box::new(NusbLink::open(&info).map_err(opening)?))
    }
}

fn bus_path(info: &DeviceInfo) -> String {
    let ports: Vec<String> = info.port_chain().iter().map(u8::to_string).collect();
    format!("{}-{}", info.bus_id().trim_start_matches('0'), ports.join("."))
}

fn opening(error: nusb::Error) -> LinkError {
    match error.kind() {
        ErrorKind::Disconnected => LinkError::Disconnected,
        ErrorKind::PermissionDenied => LinkError::Failed(format!(
            "{error}; give your user access with `sudo gv3 install-udev`, then plug it in again"
        )),
        ErrorKind::Busy => LinkError::Failed(format!("{error}; in use by another program: end that one")),
        _ => LinkError::Failed(error.to_string()),
    }
}

/// Two interrupt endpoints.
struct NusbLink {
    input: Endpoint<Interrupt, In>,
    output: Endpoint<Interrupt, Out>,
    /// Released last, so that the kernel's driver finds the endpoints idle.
    _interface: Interface,
}

impl NusbLink {
    fn open(info: &DeviceInfo) -> Result<Self, nusb::Error> {
        let device = info.open().wait()?;
        let interface = device.detach_and_claim_interface(INTERFACE).wait()?;
        let address = |direction, usual| {
            let descriptor = interface.descriptor();
            let mut endpoints = descriptor.iter().flat_map(|d| d.endpoints());
            let found = endpoints.find(|e| e.direction() == direction && e.transfer_type() == TransferType::Interrupt);
            found.map_or(usual, |e| e.address())
        };
        let (input, output) = (address(Direction::In, 0x81), address(Direction::Out, 0x01));
        Ok(Self { input: interface.endpoint(input)?, output: interface.endpoint(output)?, _interface: interface })
    }
}

/// The bytes of a transfer, or why there are none.
fn finish(completion: Completion, timeout: Duration) -> Result<Vec<u8>, LinkError> {
    match completion.status {
        Ok(()) => Ok(completion.buffer.into_vec()),
        Err(TransferError::Cancelled) => Err(LinkError::Timeout(timeout)),
        Err(TransferError::Disconnected) => Err(LinkError::Disconnected),
        Err(error) => Err(LinkError::Failed(format!("USB transfer: {error}"))),
    }
}

impl HidLink for NusbLink {
    fn write_report(&mut self, report: &Report) -> Result<(), LinkError> {
        finish(self.output.transfer_blocking(report.to_vec().into(), WRITE_TIMEOUT), WRITE_TIMEOUT).map(drop)
    }

    fn read_report(&mut self, timeout: Duration) -> Result<Report, LinkError> {
        // A transfer that outlives its call brings its report to the next one.
        if self.input.pending() == 0 {
            self.input.submit(Buffer::new(REPORT_BYTES));
        }
        let completion = self.input.wait_next_complete(timeout).ok_or(LinkError::Timeout(timeout))?;
        let bytes = finish(completion, timeout)?;
        let found = bytes.len();
        bytes.try_into().map_err(|_| LinkError::Failed(format!("report of {found} bytes, expected {REPORT_BYTES}")))
    }
}
