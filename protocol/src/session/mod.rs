//! The session file: an MCAP file of profile `gv3`, one chunk a group (SESSION.md).
//!
//! Writing leaves every finished group on disk before the next one starts, so a killed writer loses at most the
//! group it was writing:
//! ```
//! use gv3_protocol::session::{GroupRecord, MetadataGroup, SessionFile, SessionMetadata, SessionReader, SessionWriter};
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("scan.gv3");
//! let metadata = SessionMetadata::new("default", "gv3 0.1.0", 1_700_000_000_000_000_000);
//! let mut writer = SessionWriter::create(SessionFile::create(&path, false)?, &metadata)?;
//! writer.write_stream(b"stream header of the codec")?;
//! writer.write_group(GroupRecord {
//!     first_tick: 0,
//!     key_tick: 0,
//!     time_nanos: 5_000_000,
//!     geometry: b"group payload",
//!     texture: None,
//!     events: &[],
//! })?;
//! writer.finish(&MetadataGroup::new().with("scans", 1))?;
//!
//! let mut reader = SessionReader::open(&path)?;
//! assert_eq!(reader.read_group(0)?.geometry, b"group payload");
//! # Ok(())
//! # }
//! ```
//!
//! Reading trusts no byte. The parsers of the `mcap` crate are not used for it: they reserve the length a string
//! claims (up to 4 GiB) before reading it, and slice short attachment records without a check. The few records a
//! session needs are parsed here, with their offsets, limits first.

pub(crate) mod bytes;
mod chunk;
pub mod envelope;
mod error;
mod event;
mod metadata;
mod reader;
mod recover;
mod scanner;
mod sink;
mod source;
mod summary;
mod verify;
mod writer;

pub use error::{Result, SessionError};
pub use event::{Event, EventKind, Telemetry};
pub use metadata::{MetadataGroup, SessionMetadata, key};
pub use reader::{ByteTotals, GroupEntry, SessionReader, SessionState, StoredGroup, StreamEntry};
pub use recover::{LostSpan, RecoverReport, recover, recover_source};
pub use sink::{SessionFile, SyncData};
pub use verify::{Problem, VerifyReport, verify, verify_source};
pub use writer::{GroupRecord, SessionWriter};

/// MCAP profile in the header record of a session.
pub const PROFILE: &str = "gv3";
/// Newest session format this build reads, and the one it writes (`format_version` in `gv3.session`).
pub const FORMAT_VERSION: u32 = 1;
/// Longest chunk record read or written, bytes: everything of one group.
pub const CHUNK_LIMIT: u64 = 256 << 20;
/// Longest metadata record read or written, bytes.
pub const METADATA_LIMIT: u64 = 16 << 20;
/// Longest summary section read, bytes: about two million groups.
pub const SUMMARY_LIMIT: u64 = 256 << 20;
/// Longest header record read, bytes.
pub const HEADER_LIMIT: u64 = 64 << 10;

/// A channel of a session. Identifiers are part of the format, so a group stays readable when the chunk that
/// carries the channel records is lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Channel {
    /// MCAP channel and schema identifier.
    pub id: u16,
    pub topic: &'static str,
    pub schema: &'static str,
    /// JSON schema of the messages; `None` for binary payloads, whose layout no schema language describes.
    pub json_schema: Option<&'static str>,
}

pub(crate) const STREAM: Channel = Channel { id: 1, topic: "/gv3/stream", schema: "gv3.Stream", json_schema: None };
pub(crate) const GROUP: Channel = Channel { id: 2, topic: "/gv3/group", schema: "gv3.Group", json_schema: None };
pub(crate) const TEXTURE: Channel = Channel { id: 3, topic: "/gv3/texture", schema: "gv3.Texture", json_schema: None };
pub(crate) const EVENT: Channel =
    Channel { id: 4, topic: "/gv3/event", schema: "gv3.Event", json_schema: Some(event::EVENT_SCHEMA) };
pub(crate) const TELEMETRY: Channel =
    Channel { id: 5, topic: "/gv3/telemetry", schema: "gv3.Telemetry", json_schema: Some(event::TELEMETRY_SCHEMA) };
pub(crate) const CHANNELS: [Channel; 5] = [STREAM, GROUP, TEXTURE, EVENT, TELEMETRY];
