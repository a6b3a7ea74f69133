//! The gv3 vendor protocol between a host and a projector (GV3.md), without I/O.
//!
//! ```
//! use gv3_protocol::gv3::{Decoder, Request};
//! let bytes = Request::Show(2).message(7).encode();
//! let mut decoder = Decoder::default();
//! decoder.push(b"noise before it");
//! decoder.push(&bytes);
//! let message = decoder.next_message().ok_or("no message")?;
//! assert_eq!((Request::decode(&message)?, decoder.damaged_bytes()), (Request::Show(2), 15));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod error;
mod event;
mod identity;
mod message;
mod request;
mod status;

pub use error::{BodyError, Refusal};
pub use event::{Event, Exposure, FaultEvent};
pub use identity::Identity;
pub use message::{Decoder, Message};
pub use request::{Axis, Reply, Request, Timing};
pub use status::{DeviceFault, DeviceState, Status};

/// Version of the protocol.
pub const VERSION: u8 = 1;
/// Test identifiers of pid.codes.
pub const VENDOR_ID: u16 = 0x1209;
/// Test identifiers of pid.codes.
pub const PRODUCT_ID: u16 = 0x0001;
/// Class of the interface: vendor specific.
pub const INTERFACE_CLASS: u8 = 0xff;
/// Subclass of the interface: `G`.
pub const INTERFACE_SUBCLASS: u8 = 0x47;
/// Protocol of the interface: that of [`VERSION`].
pub const INTERFACE_PROTOCOL: u8 = VERSION;
/// Vendor request to the interface, device to host: [`Identity`].
pub const CONTROL_IDENTIFY: u8 = 0x01;
/// Vendor request to the interface, host to device, no data: back to the state after power-on.
pub const CONTROL_RESET: u8 = 0x02;
/// Most levels of a pattern.
pub const MAX_LEVELS: usize = 16_384;
/// Most positions of a set.
pub const MAX_ORDER: usize = 1024;
/// Longest payload of a message: that of a pattern.
pub const MAX_PAYLOAD_BYTES: usize = MAX_LEVELS + 4;
/// Bytes of a message besides its payload.
pub const FRAMING_BYTES: usize = 16;
/// Longest event, so that it is one packet on every USB speed.
pub const MAX_EVENT_BYTES: usize = 64;
