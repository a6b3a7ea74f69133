//! Transfers by libusb, through rusb.

use super::transport::{UsbEndpoint, UsbError, UsbPipes, UsbPlace, UsbSelector, UsbTransport};
use gv3_protocol::gv3::{PRODUCT_ID, VENDOR_ID};
use rusb::{
    Context, Device, DeviceDescriptor, DeviceHandle, Direction, Recipient, RequestType, TransferType, UsbContext,
};
use std::time::Duration;

/// A device opened by libusb.
pub struct RusbTransport {
    place: UsbPlace,
    pipes: UsbPipes,
    handle: DeviceHandle<Context>,
}

impl RusbTransport {
    /// Finds the device and claims its interface.
    ///
    /// # Errors
    /// [`UsbError`] saying what is plugged in, or which right is missing.
    pub fn open(selector: &UsbSelector) -> Result<Self, UsbError> {
        let listing = |e: rusb::Error| UsbError::Failed(format!("USB devices: {e}"));
        let context = Context::new().map_err(listing)?;
        let mut found = Vec::new();
        for device in context.devices().map_err(listing)?.iter() {
            let Ok(descriptor) = device.device_descriptor() else { continue };
            if (descriptor.vendor_id(), descriptor.product_id()) == (VENDOR_ID, PRODUCT_ID) {
                // The serial number has to be asked of the device itself; without the right to, the place will do.
                let handle = device.open();
                found.push((place(&device, &descriptor, handle.as_ref().ok()), (device, handle)));
            }
        }
        let (place, (device, handle)) = selector.pick(found)?;
        let opening = |e: rusb::Error| match e {
            rusb::Error::Access => UsbError::no_rights(&place),
            rusb::Error::NoDevice => UsbError::Disconnected,
            rusb::Error::Busy => UsbError::in_use(&place),
            _ => UsbError::Failed(format!("{place}: {e}")),
        };
        let handle = handle.map_err(opening)?;
        let pipes =
            pipes(&device).ok_or_else(|| UsbError::Failed(format!("{place}: no interface of a gv3 projector")))?;
        handle.claim_interface(pipes.interface).map_err(opening)?;
        Ok(Self { place, pipes, handle })
    }

    /// A failed transfer; a halted endpoint is cleared.
    fn failed(&self, address: Option<u8>, error: rusb::Error) -> UsbError {
        match (error, address) {
            (rusb::Error::Timeout, _) => UsbError::Timeout,
            (rusb::Error::NoDevice, _) => UsbError::Disconnected,
            (rusb::Error::Pipe, None) => UsbError::Stall,
            (rusb::Error::Pipe, Some(address)) => match self.handle.clear_halt(address) {
                Ok(()) => UsbError::Stall,
                Err(e) => UsbError::Failed(format!("a halted endpoint cannot be cleared: {e}")),
            },
            (other, _) => UsbError::Failed(format!("USB transfer: {other}")),
        }
    }

    fn send(&self, bytes: &[u8], timeout: Duration) -> Result<(), UsbError> {
        let written = self.handle.write_bulk(self.pipes.out, bytes, at_least_1_ms(timeout));
        match written.map_err(|e| self.failed(Some(self.pipes.out), e))? {
            all if all == bytes.len() => Ok(()),
            _ => Err(UsbError::Timeout),
        }
    }
}

/// libusb takes less than a millisecond for no timeout at all.
fn at_least_1_ms(timeout: Duration) -> Duration {
    timeout.max(Duration::from_millis(1))
}

fn place(device: &Device<Context>, descriptor: &DeviceDescriptor, handle: Option<&DeviceHandle<Context>>) -> UsbPlace {
    let serial = handle.and_then(|h| h.read_serial_number_string_ascii(descriptor).ok());
    UsbPlace::new(&device.bus_number().to_string(), &device.port_numbers().unwrap_or_default(), serial)
}

fn pipes(device: &Device<Context>) -> Option<UsbPipes> {
    let configuration = device.active_config_descriptor().ok()?;
    configuration.interfaces().find_map(|interface| {
        let setting = interface.descriptors().next()?;
        let endpoint = |e: rusb::EndpointDescriptor<'_>| UsbEndpoint {
            address: e.address(),
            kind: match e.transfer_type() {
                TransferType::Control => 0,
                TransferType::Isochronous => 1,
                TransferType::Bulk => 2,
                TransferType::Interrupt => 3,
            },
            // Bits above these count the packets a microframe.
            packet_bytes: usize::from(e.max_packet_size() & 0x7ff),
        };
        let endpoints: Vec<UsbEndpoint> = setting.endpoint_descriptors().map(endpoint).collect();
        UsbPipes::of_interface(setting.interface_number(), setting.class_code(), &endpoints)
    })
}

impl UsbTransport for RusbTransport {
    fn place(&self) -> &UsbPlace {
        &self.place
    }

    fn control_in(&self, request: u8, length: u16, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let kind = rusb::request_type(Direction::In, RequestType::Vendor, Recipient::Interface);
        let mut bytes = vec![0; length.into()];
        let index = self.pipes.interface.into();
        let read = self.handle.read_control(kind, request, 0, index, &mut bytes, at_least_1_ms(timeout));
        bytes.truncate(read.map_err(|e| self.failed(None, e))?);
        Ok(bytes)
    }

    fn control_out(&self, request: u8, timeout: Duration) -> Result<(), UsbError> {
        let kind = rusb::request_type(Direction::Out, RequestType::Vendor, Recipient::Interface);
        let index = self.pipes.interface.into();
        let written = self.handle.write_control(kind, request, 0, index, &[], at_least_1_ms(timeout));
        written.map(drop).map_err(|e| self.failed(None, e))
    }

    fn write(&self, message: &[u8], timeout: Duration) -> Result<(), UsbError> {
        self.send(message, timeout)?;
        if self.pipes.needs_empty_packet(message.len()) {
            self.send(&[], timeout)?;
        }
        Ok(())
    }

    fn read(&self, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let mut bytes = vec![0; self.pipes.reply_bytes()];
        let read = self.handle.read_bulk(self.pipes.reply, &mut bytes, at_least_1_ms(timeout));
        bytes.truncate(read.map_err(|e| self.failed(Some(self.pipes.reply), e))?);
        Ok(bytes)
    }

    fn read_event(&self, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let mut bytes = vec![0; self.pipes.packet_bytes[2]];
        let read = self.handle.read_interrupt(self.pipes.event, &mut bytes, at_least_1_ms(timeout));
        bytes.truncate(read.map_err(|e| self.failed(Some(self.pipes.event), e))?);
        Ok(bytes)
    }
}
