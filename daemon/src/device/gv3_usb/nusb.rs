//! Transfers by nusb.

use super::transport::{UsbEndpoint, UsbError, UsbPipes, UsbPlace, UsbSelector, UsbTransport};
use crate::device::in_use::IN_USE;
use crate::device::plugged::{PluggedProjector, missing_rights};
use gv3_protocol::gv3::{PRODUCT_ID, VENDOR_ID};
use nusb::transfer::{
    Buffer, Bulk, BulkOrInterrupt, Completion, ControlIn, ControlOut, ControlType, EndpointDirection, In, Interrupt,
    Out, Recipient, TransferError,
};
use nusb::{Device, DeviceInfo, Endpoint, ErrorKind, Interface, MaybeFuture};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// How long an interface that was just closed here may still be busy: nusb gives it back when the transfers that waited have
/// been cancelled, in a thread of its own.
const RELEASE_TIME: Duration = Duration::from_secs(2);
const RELEASE_RETRY: Duration = Duration::from_millis(20);
/// Transfers that wait for events at once, so that the device is asked without a gap.
const EVENT_TRANSFERS: usize = 4;

/// A device opened by nusb.
pub struct NusbTransport {
    place: UsbPlace,
    pipes: UsbPipes,
    interface: Interface,
    out: Mutex<Endpoint<Bulk, Out>>,
    reply: Mutex<Endpoint<Bulk, In>>,
    event: Mutex<Endpoint<Interrupt, In>>,
}

impl NusbTransport {
    /// Finds the device and claims its interface.
    ///
    /// # Errors
    /// [`UsbError`] saying what is plugged in, or which right is missing.
    pub fn open(selector: &UsbSelector) -> Result<Self, UsbError> {
        let devices = nusb::list_devices().wait().map_err(|e| UsbError::Failed(format!("USB devices: {e}")))?;
        let is_ours = |d: &DeviceInfo| (d.vendor_id(), d.product_id()) == (VENDOR_ID, PRODUCT_ID);
        let with_place = |d: DeviceInfo| (place(&d), d);
        let (place, info) = selector.pick(devices.filter(is_ours).map(with_place).collect())?;
        let opening = |e: nusb::Error| opening(&place, e.kind(), &e.to_string());
        let device = info.open().wait().map_err(opening)?;
        let pipes =
            pipes(&device).ok_or_else(|| UsbError::Failed(format!("{place}: no interface of a gv3 projector")))?;
        let interface = claim(&device, pipes.interface).map_err(opening)?;
        Ok(Self {
            out: Mutex::new(interface.endpoint(pipes.out).map_err(opening)?),
            reply: Mutex::new(interface.endpoint(pipes.reply).map_err(opening)?),
            event: Mutex::new(interface.endpoint(pipes.event).map_err(opening)?),
            interface,
            pipes,
            place,
        })
    }
}

/// Claims an interface, once it is free.
fn claim(device: &Device, interface: u8) -> Result<Interface, nusb::Error> {
    let until = Instant::now() + RELEASE_TIME;
    loop {
        match device.claim_interface(interface).wait() {
            Err(error) if error.kind() == ErrorKind::Busy && Instant::now() < until => {
                std::thread::sleep(RELEASE_RETRY);
            }
            claimed => return claimed,
        }
    }
}

/// The gv3 projectors that are plugged in, each opened for a moment to see whether that is allowed.
///
/// # Errors
/// [`UsbError::Failed`] when the system does not list its USB devices.
pub(in crate::device) fn plugged() -> Result<Vec<PluggedProjector>, UsbError> {
    let devices = nusb::list_devices().wait().map_err(|e| UsbError::Failed(format!("USB devices: {e}")))?;
    let ours = devices.filter(|d| (d.vendor_id(), d.product_id()) == (VENDOR_ID, PRODUCT_ID));
    let mut found: Vec<_> = ours
        .map(|info| {
            let UsbPlace { bus_path, serial } = place(&info);
            let problem = info.open().wait().err().map(|error| match error.kind() {
                ErrorKind::PermissionDenied => missing_rights(),
                _ => error.to_string(),
            });
            let (serial, speed) = (serial.unwrap_or_default(), info.speed().map(|s| format!("{s:?}").to_lowercase()));
            PluggedProjector { backend: "gv3_usb", serial, bus_path, node: None, speed, problem }
        })
        .collect();
    found.sort_by(|a, b| a.bus_path.cmp(&b.bus_path));
    Ok(found)
}

/// The kernel lets one program claim an interface.
fn opening(place: &UsbPlace, kind: ErrorKind, error: &str) -> UsbError {
    match kind {
        ErrorKind::PermissionDenied => UsbError::no_rights(place),
        ErrorKind::Disconnected => UsbError::Disconnected,
        ErrorKind::Busy => UsbError::Failed(format!("{place}: {IN_USE}")),
        _ => UsbError::Failed(format!("{place}: {error}")),
    }
}

fn place(info: &DeviceInfo) -> UsbPlace {
    UsbPlace::new(info.bus_id(), info.port_chain(), info.serial_number().map(str::to_owned))
}

fn pipes(device: &Device) -> Option<UsbPipes> {
    let configuration = device.active_configuration().ok()?;
    configuration.interfaces().find_map(|interface| {
        let setting = interface.first_alt_setting();
        let endpoints: Vec<UsbEndpoint> = setting
            .endpoints()
            .map(|e| UsbEndpoint { address: e.address(), kind: e.attributes() & 3, packet_bytes: e.max_packet_size() })
            .collect();
        UsbPipes::of_interface(setting.interface_number(), setting.class(), &endpoints)
    })
}

fn lock<T>(pipe: &Mutex<T>) -> MutexGuard<'_, T> {
    pipe.lock().unwrap_or_else(PoisonError::into_inner)
}

fn usb_error(error: TransferError) -> UsbError {
    match error {
        TransferError::Cancelled => UsbError::Timeout,
        TransferError::Stall => UsbError::Stall,
        TransferError::Disconnected => UsbError::Disconnected,
        other => UsbError::Failed(format!("USB transfer: {other}")),
    }
}

/// What a transfer brought; a halted endpoint is cleared. Data that came before a timeout counts.
fn finish<T: BulkOrInterrupt, D: EndpointDirection>(
    endpoint: &mut Endpoint<T, D>,
    completion: Completion,
) -> Result<Vec<u8>, UsbError> {
    match completion.status {
        Ok(()) => Ok(completion.buffer.into_vec()),
        Err(TransferError::Cancelled) if D::DIR == nusb::transfer::Direction::In && completion.actual_len > 0 => {
            Ok(completion.buffer.into_vec())
        }
        Err(TransferError::Stall) => {
            // The host controller may clear a halt only when nothing is pending.
            endpoint.cancel_all();
            while endpoint.pending() > 0 {
                endpoint.wait_next_complete(Duration::from_secs(1));
            }
            let cleared = endpoint.clear_halt().wait();
            cleared.map_err(|e| UsbError::Failed(format!("a halted endpoint cannot be cleared: {e}")))?;
            Err(UsbError::Stall)
        }
        Err(error) => Err(usb_error(error)),
    }
}

impl UsbTransport for NusbTransport {
    fn place(&self) -> &UsbPlace {
        &self.place
    }

    fn control_in(&self, request: u8, length: u16, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let control = ControlIn {
            control_type: ControlType::Vendor,
            recipient: Recipient::Interface,
            request,
            value: 0,
            index: self.pipes.interface.into(),
            length,
        };
        self.interface.control_in(control, timeout).wait().map_err(usb_error)
    }

    fn control_out(&self, request: u8, timeout: Duration) -> Result<(), UsbError> {
        let control = ControlOut {
            control_type: ControlType::Vendor,
            recipient: Recipient::Interface,
            request,
            value: 0,
            index: self.pipes.interface.into(),
            data: &[],
        };
        self.interface.control_out(control, timeout).wait().map_err(usb_error)
    }

    fn write(&self, message: &[u8], timeout: Duration) -> Result<(), UsbError> {
        let mut out = lock(&self.out);
        let completion = out.transfer_blocking(message.into(), timeout);
        finish(&mut out, completion)?;
        if self.pipes.needs_empty_packet(message.len()) {
            let completion = out.transfer_blocking(Buffer::new(0), timeout);
            finish(&mut out, completion)?;
        }
        Ok(())
    }

    fn read(&self, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let mut reply = lock(&self.reply);
        let completion = reply.transfer_blocking(Buffer::new(self.pipes.reply_bytes()), timeout);
        finish(&mut reply, completion)
    }

    fn read_event(&self, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let mut event = lock(&self.event);
        while event.pending() < EVENT_TRANSFERS {
            event.submit(Buffer::new(self.pipes.packet_bytes[2]));
        }
        // A transfer that does not complete now stays pending and brings its event to the next call.
        let completion = event.wait_next_complete(timeout).ok_or(UsbError::Timeout)?;
        finish(&mut event, completion)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_projector_that_another_program_has_is_said_to_be_in_use() {
        let place = UsbPlace::new("3", &[1, 2], None);
        let error = opening(&place, ErrorKind::Busy, "claiming failed").to_string();
        assert_eq!(error, format!("{place}: {IN_USE}"));
        assert_eq!(opening(&place, ErrorKind::Disconnected, "").to_string(), UsbError::Disconnected.to_string());
    }
}
