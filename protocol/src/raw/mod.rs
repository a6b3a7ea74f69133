//! Raw recordings: every picture as the camera gave it, lossless, with what is needed to replay it (RAW.md).
//!
//! ```
//! use gv3_protocol::raw::{RawItem, RawReader, RawStamp, RawWriter};
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let parent = tempfile::tempdir()?;
//! # let folder = parent.path().join("raw");
//! let mut writer = RawWriter::create(&folder, "name = \"rig\"", 1_700_000_000_000_000_000)?;
//! writer.picture(&RawStamp { sequence: 7, ..RawStamp::default() }, [3, 2], &[1, 2, 3, 4, 5, 6])?;
//! writer.finish(0)?;
//!
//! let mut reader = RawReader::open(&folder)?;
//! let Some((_, RawItem::Picture(picture))) = reader.next(true)? else { panic!() };
//! assert_eq!((picture.stamp.sequence, picture.pixels), (7, vec![1, 2, 3, 4, 5, 6]));
//! # Ok(())
//! # }
//! ```

mod block;
mod error;
pub mod filter;
mod reader;
mod segment;
mod writer;

pub use block::{FaultCode, RawStamp, RawTotals};
pub use error::{RawError, Result};
pub use reader::{RawProblem, RawReader, RawReport, verify_raw};
pub use segment::{RawItem, RawPicture, Segment, SegmentError, SegmentHeader};
pub use writer::RawWriter;

/// Newest raw format this build reads, and the one it writes.
pub const FORMAT_VERSION: u16 = 1;
/// Longest configuration, bytes.
pub const MAX_CONFIGURATION_BYTES: u32 = 1 << 20;
/// Longest side of a picture.
pub const MAX_SIDE_PX: u16 = 16_384;
/// Most pixels of a picture, so that its block fits into a segment twice over.
pub const MAX_PICTURE_PX: u32 = 1 << 26;
/// Longest message of a fault, bytes.
pub const MAX_TEXT_BYTES: u32 = 4096;
/// Longest segment read, bytes.
pub const MAX_SEGMENT_BYTES: u64 = 256 << 20;
/// Pictures after which a writer begins the next segment: about a second of the fastest camera.
pub const SEGMENT_PICTURES: u32 = 180;
/// Bytes after which a writer begins the next segment.
pub const SEGMENT_TARGET_BYTES: u64 = 64 << 20;

/// File name of a segment.
fn segment_name(number: u32) -> String {
    format!("pictures_{number:06}.gv3raw")
}

/// Number of a segment by its file name.
fn segment_number(name: &str) -> Option<u32> {
    let digits = name.strip_prefix("pictures_")?.strip_suffix(".gv3raw")?;
    (digits.len() >= 6 && digits.bytes().all(|b| b.is_ascii_digit())).then(|| digits.parse().ok())?
}
