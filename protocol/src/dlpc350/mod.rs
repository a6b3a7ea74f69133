//! The TI DLPC350's USB commands (LightCrafter 4500), without input or output: bytes in, bytes out (DLPC350.md).
//!
//! [`Request`] and [`Reply`] are the framing, each [`Register`] is a command with its payload.
//!
//! ```
//! use gv3_protocol::dlpc350::{Playback, Reply, Register, Request};
//! # fn main() -> Result<(), gv3_protocol::dlpc350::Dlpc350Error> {
//! let request = Request::write(1, &Playback::Start);
//! assert_eq!(&request.reports()?[0][..7], [0x40, 1, 3, 0, 0x24, 0x1a, 2]);
//!
//! let reply = Reply::parse(&[&[0xc0, 7, 1, 0, 2][..], &[0; 59]].concat())?;
//! assert_eq!((reply.sequence, Playback::decode(&reply.data)?), (7, Playback::Start));
//! # Ok(())
//! # }
//! ```

mod error;
mod light;
mod mode;
mod packet;
mod pattern;
mod register;
mod status;
mod timing;

pub use error::{Dlpc350Error, Result};
pub use light::{LedCurrent, LedEnable, TriggerDelay, TriggerOut1, TriggerOut2};
pub use mode::{DisplayMode, Input, InputSource, Mailbox, PatternSource, Playback, Power, TriggerMode};
pub use packet::{Reply, Report, Request, RequestAssembler, RequestKind};
pub use pattern::{BitDepth, ImageLut, Leds, LutControl, LutEntry, MailboxOffset, PatternLut, StartTrigger};
pub use register::Register;
pub use status::{
    FirmwareTag, FlashImageCount, HardwareStatus, MainStatus, SystemStatus, Validate, Validation, Version,
};
pub use timing::ExposurePeriod;

/// USB vendor: Texas Instruments.
pub const VENDOR_ID: u16 = 0x0451;
/// USB product: DLPC350.
pub const PRODUCT_ID: u16 = 0x6401;
/// Length of every HID report, bytes.
pub const REPORT_BYTES: usize = 64;
/// Most bytes of a message behind its four header bytes: command and payload.
pub const MAX_MESSAGE_BYTES: usize = 512;
/// Most bytes of a reply's data.
pub const MAX_REPLY_BYTES: usize = REPORT_BYTES - 4;
/// Columns of the mirror array (diamond pixels).
pub const WIDTH_PX: u32 = 912;
/// Rows of the mirror array.
pub const HEIGHT_PX: u32 = 1140;
/// Most entries of the pattern table.
pub const MAX_PATTERNS: usize = 128;
/// Most entries of the image table.
pub const MAX_IMAGES: usize = 64;
/// Bit planes of one image, in flash or in a video frame.
pub const IMAGE_PLANES: usize = 24;
/// Bit planes the projector holds ready; beyond them every image costs a buffer load of up to 200 ms.
pub const BUFFER_PLANES: usize = 48;
