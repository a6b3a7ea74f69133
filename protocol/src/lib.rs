//! What crosses a cable or a file boundary: the session container and raw recordings.
//!
//! [`session`] writes, reads, verifies and recovers session files; SESSION.md is their byte-by-byte description.
//! [`raw`] does the same for the camera's pictures; RAW.md describes it.
//! [`dlpc350`] is the command set of a projector by Texas Instruments; DLPC350.md describes what gv3 uses of it.
//! No maths, no devices: payloads of the codec pass through as byte slices.
#![forbid(unsafe_code)]

mod atomic_file;
pub mod dlpc350;
pub mod raw;
pub mod session;

pub use atomic_file::AtomicFile;
