//! What the driver needs of USB, whoever does it.

use crate::device::DeviceError;
use gv3_protocol::gv3::INTERFACE_CLASS;
#[cfg(any(feature = "nusb", feature = "rusb"))]
use gv3_protocol::gv3::{PRODUCT_ID, VENDOR_ID};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::time::Duration;

/// Who does the transfers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UsbTransportKind {
    /// The crate `nusb`: Linux' usbfs, macOS' IOKit and WinUSB spoken to directly. The one to use.
    #[default]
    Nusb,
    /// The crate `rusb`: libusb, built in. For systems that nusb does not know (the BSDs), for kernels or controllers on which
    /// nusb misbehaves, and to tell a fault of the device from one of the transport.
    Rusb,
    /// The simulated projector in this process, through the same bytes; the camera must be simulated, too.
    Simulated,
}

/// Why a transfer failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UsbError {
    /// Nothing came or went in time.
    #[error("no answer in time")]
    Timeout,
    /// The device refused the transfer; a halted endpoint is already cleared.
    #[error("the device stalled the transfer")]
    Stall,
    /// The device is unplugged, or was plugged in anew since.
    #[error("disconnected")]
    Disconnected,
    /// There is no such device.
    #[error("{0}")]
    NotFound(String),
    /// Anything else, with what to do about it.
    #[error("{0}")]
    Failed(String),
}

impl UsbError {
    /// As an error of `device`.
    pub(super) fn of(self, device: &str) -> DeviceError {
        match self {
            Self::Timeout => DeviceError::Timeout(format!("{device} does not answer")),
            Self::Disconnected => DeviceError::Disconnected(device.into()),
            Self::NotFound(reason) | Self::Failed(reason) => DeviceError::Failed(reason),
            Self::Stall => DeviceError::Failed(format!("{device} stalls")),
        }
    }

    /// The device is there, but may not be opened.
    #[cfg(any(feature = "nusb", feature = "rusb"))]
    pub(super) fn no_rights(place: &UsbPlace) -> Self {
        Self::Failed(format!("{place}: no rights; install udev/70-gv3.rules as its first lines say, or plug in again"))
    }

    /// Another program has claimed it.
    #[cfg(any(feature = "nusb", feature = "rusb"))]
    pub(super) fn in_use(place: &UsbPlace) -> Self {
        Self::Failed(format!("{place}: in use by another program; end that one"))
    }
}

/// Which of several devices is meant.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct UsbSelector {
    /// Serial number of the USB descriptor.
    pub serial: Option<String>,
    /// Where it is plugged in, as [`UsbPlace::bus_path`].
    pub bus_path: Option<String>,
}

impl UsbSelector {
    /// Picks from what is plugged in.
    ///
    /// # Errors
    /// [`UsbError::NotFound`] for none, [`UsbError::Failed`] for several.
    #[cfg(any(feature = "nusb", feature = "rusb"))]
    pub(super) fn pick<T>(&self, found: Vec<(UsbPlace, T)>) -> Result<(UsbPlace, T), UsbError> {
        let fits = |place: &UsbPlace| {
            self.serial.as_ref().is_none_or(|wanted| place.serial.as_ref() == Some(wanted))
                && self.bus_path.as_ref().is_none_or(|wanted| place.bus_path == *wanted)
        };
        let all: Vec<String> = found.iter().map(|(place, _)| place.to_string()).collect();
        let mut fitting: Vec<_> = found.into_iter().filter(|(place, _)| fits(place)).collect();
        match (fitting.len(), fitting.pop(), &all[..]) {
            (1, Some(one), _) => Ok(one),
            (0, _, []) => {
                let reason =
                    format!("no projector with USB identifiers {VENDOR_ID:04x}:{PRODUCT_ID:04x} is plugged in");
                Err(UsbError::NotFound(reason))
            }
            (0, _, all) => Err(UsbError::NotFound(format!("{self} is not plugged in; there is {}", all.join(", ")))),
            (_, _, all) => {
                let reason = format!("several projectors: {}; give projector.serial or bus_path", all.join(", "));
                Err(UsbError::Failed(reason))
            }
        }
    }
}

impl std::fmt::Display for UsbSelector {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match (&self.serial, &self.bus_path) {
            (None, None) => write!(f, "the projector"),
            (Some(serial), None) => write!(f, "the projector {serial}"),
            (None, Some(path)) => write!(f, "the projector at {path}"),
            (Some(serial), Some(path)) => write!(f, "the projector {serial} at {path}"),
        }
    }
}

/// A device that is plugged in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsbPlace {
    /// Bus and ports: `3-1.2` is port 2 of the hub at port 1 of bus 3, as Linux names it.
    pub bus_path: String,
    /// Serial number, if it has one that can be read.
    pub serial: Option<String>,
}

impl UsbPlace {
    /// The place of a device by its bus and the ports on the way to it.
    #[cfg(any(feature = "nusb", feature = "rusb"))]
    pub(super) fn new(bus: &str, ports: &[u8], serial: Option<String>) -> Self {
        let ports: Vec<String> = ports.iter().map(u8::to_string).collect();
        let bus = bus.trim_start_matches('0');
        Self { bus_path: format!("{bus}-{}", ports.join(".")), serial }
    }
}

impl std::fmt::Display for UsbPlace {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "projector {} at {}", self.serial.as_deref().unwrap_or("without serial number"), self.bus_path)
    }
}

/// The interface of a projector and its endpoints, as its descriptors say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UsbPipes {
    /// Number of the interface.
    pub interface: u8,
    /// Address of the bulk endpoint to the device.
    pub out: u8,
    /// Address of the bulk endpoint to the host.
    pub reply: u8,
    /// Address of the interrupt endpoint.
    pub event: u8,
    /// wMaxPacketSize of `out`, `reply` and `event`.
    pub packet_bytes: [usize; 3],
}

/// What an endpoint's descriptor says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UsbEndpoint {
    /// Address; the top bit is set towards the host.
    pub address: u8,
    /// Lowest two bits of bmAttributes: 2 bulk, 3 interrupt.
    pub kind: u8,
    /// wMaxPacketSize.
    pub packet_bytes: usize,
}

impl UsbPipes {
    /// The pipes of an interface; `None` when it is not one of a projector: vendor class with bulk both ways and interrupt in.
    pub fn of_interface(interface: u8, class: u8, endpoints: &[UsbEndpoint]) -> Option<Self> {
        let find = |kind: u8, is_in: bool| {
            endpoints.iter().find(|e| e.kind == kind && (e.address & 0x80 != 0) == is_in && e.packet_bytes > 0)
        };
        let (out, reply, event) = (find(2, false)?, find(2, true)?, find(3, true)?);
        (class == INTERFACE_CLASS).then_some(Self {
            interface,
            out: out.address,
            reply: reply.address,
            event: event.address,
            packet_bytes: [out.packet_bytes, reply.packet_bytes, event.packet_bytes],
        })
    }

    /// Whether a transfer of so many bytes needs a zero-length packet to end it.
    pub fn needs_empty_packet(&self, bytes: usize) -> bool {
        bytes.is_multiple_of(self.packet_bytes[0])
    }

    /// Length to ask for so that one transfer holds any reply: whole packets, or the controller reports an overflow.
    pub fn reply_bytes(&self) -> usize {
        const LONGEST_REPLY: usize = 512;
        LONGEST_REPLY.next_multiple_of(self.packet_bytes[1])
    }
}

/// An opened device. The three pipes may be used at once by different threads; each is used by one.
pub trait UsbTransport: Send + Sync {
    /// Where it is.
    fn place(&self) -> &UsbPlace;
    /// Vendor request to the interface, device to host, with value 0; at most `length` bytes come back.
    ///
    /// # Errors
    /// [`UsbError`]; a stall means that the device does not know the request.
    fn control_in(&self, request: u8, length: u16, timeout: Duration) -> Result<Vec<u8>, UsbError>;
    /// Vendor request to the interface, host to device, with value 0 and no data.
    ///
    /// # Errors
    /// As [`Self::control_in`].
    fn control_out(&self, request: u8, timeout: Duration) -> Result<(), UsbError>;
    /// Sends one message as one transfer, with a zero-length packet behind it where it fills its last packet.
    ///
    /// # Errors
    /// [`UsbError`]; what was sent of the message is unknown then.
    fn write(&self, message: &[u8], timeout: Duration) -> Result<(), UsbError>;
    /// What one transfer of the reply endpoint brings, possibly nothing.
    ///
    /// # Errors
    /// [`UsbError::Timeout`] when nothing came.
    fn read(&self, timeout: Duration) -> Result<Vec<u8>, UsbError>;
    /// What one transfer of the event endpoint brings.
    ///
    /// # Errors
    /// [`UsbError::Timeout`] when nothing came; no event is lost by it.
    fn read_event(&self, timeout: Duration) -> Result<Vec<u8>, UsbError>;
}

/// Finds the device again and opens it; used at the beginning and after every disconnection.
pub type UsbOpener = Box<dyn Fn() -> Result<Arc<dyn UsbTransport>, UsbError> + Send + Sync>;

/// The opener of a transport.
///
/// # Errors
/// [`DeviceError::Config`] for a transport that this build leaves out.
pub(super) fn opener(kind: UsbTransportKind, selector: UsbSelector) -> Result<UsbOpener, DeviceError> {
    match kind {
        #[cfg(feature = "nusb")]
        UsbTransportKind::Nusb => Ok(Box::new(move || Ok(Arc::new(super::nusb::NusbTransport::open(&selector)?)))),
        #[cfg(feature = "rusb")]
        UsbTransportKind::Rusb => Ok(Box::new(move || Ok(Arc::new(super::rusb::RusbTransport::open(&selector)?)))),
        other => {
            let reason = format!("{other:?} cannot open {selector}: it is simulated, or left out of this build");
            Err(DeviceError::config("projector.transport", reason))
        }
    }
}
