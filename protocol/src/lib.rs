//! What crosses a cable or a file boundary: the session container, raw recordings and device protocols.
//!
//! [`session`] writes, reads, verifies and recovers session files; SESSION.md is their byte-by-byte description.
//! [`raw`] does the same for the camera's pictures; RAW.md describes it.
//! [`dlpc350`] is the command set of a projector by Texas Instruments; DLPC350.md describes what gv3 uses of it.
//! [`gv3`] is the vendor protocol of projectors; GV3.md describes it.
//! [`trigger`] speaks with a serial trigger controller; TRIGGER.md describes it.
//! No maths, no devices: payloads of the codec pass through as byte slices.
#![forbid(unsafe_code)]

mod atomic_file;
pub mod dlpc350;
pub mod gv3;
pub mod raw;
pub mod session;
pub mod trigger;

pub use atomic_file::AtomicFile;
