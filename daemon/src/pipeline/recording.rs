//! A recording as the stages see it: how it is coded, where it goes, what became of it.

use super::record::RecordError;
use crate::light::RejectedPixels;
use gv3_codec::{EncodedGroup, EncoderConfig, Scan, StreamHeader};
use gv3_protocol::session::{Event, MetadataGroup};
use std::ops::AddAssign;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::Duration;

/// Looks at every scan before it is encoded.
pub type ScanObserver = Box<dyn FnMut(&Scan) -> Result<(), String> + Send>;

/// Where coded groups go: one file after the other.
pub trait GroupSink: Send {
    /// Begins the first file, or the next one.
    ///
    /// # Errors
    /// [`RecordError::Session`] when it cannot be made.
    fn begin(&mut self, header: &StreamHeader) -> Result<(), RecordError>;
    /// Writes a group with the events since the one before; durable when this returns.
    ///
    /// # Errors
    /// [`RecordError::Session`] when it cannot be written.
    fn group(&mut self, group: &EncodedGroup, events: &[Event]) -> Result<(), RecordError>;
    /// Closes the file with events after its last group, and statistics.
    ///
    /// # Errors
    /// [`RecordError::Session`] when it cannot be closed or is not what was written.
    fn end(&mut self, events: &[Event], statistics: &MetadataGroup) -> Result<(), RecordError>;
    /// What all files hold.
    fn closed(&self) -> Closed;
}

/// What a recording left.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize)]
pub struct Closed {
    /// Files in their order.
    pub files: Vec<PathBuf>,
    /// Bytes in them.
    pub bytes: u64,
}

/// When a recording goes on in a new file; at the keyframe at or after either limit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SegmentLimits {
    /// Scan periods.
    pub periods: Option<u64>,
    /// Bytes of groups.
    pub bytes: Option<u64>,
}

/// How far a recording is; written by the stages.
#[derive(Debug, Default)]
pub struct Progress {
    /// Scans encoded so far, in groups on disk or not.
    pub encoded: Arc<AtomicU64>,
    /// Scans on disk.
    pub scans: AtomicU64,
    /// Keyframes on disk.
    pub keyframes: AtomicU64,
    /// Bytes of groups coded, on disk or on their way there.
    pub coded_bytes: AtomicU64,
    /// Bytes of groups on disk.
    pub bytes: AtomicU64,
    /// Files begun.
    pub segments: AtomicU64,
    /// Sensor time of the first scan and of the last keyframe on disk, nanoseconds.
    pub first_nanos: AtomicU64,
    /// See `first_nanos`.
    pub last_nanos: AtomicU64,
}

/// What the stages need to begin a recording.
pub struct Recording {
    /// How scans are coded; every file is coded by an encoder of its own.
    pub encoder: EncoderConfig,
    /// When files end.
    pub limits: SegmentLimits,
    /// Called with every scan.
    pub observer: ScanObserver,
    /// Where groups go.
    pub sink: Box<dyn GroupSink>,
    /// Kept up to date.
    pub progress: Arc<Progress>,
    /// Set when a stage fails: nothing more is recorded, and the recording is to be ended.
    pub abort: Arc<AtomicBool>,
}

/// What the reconstruction of a recording did.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Rebuilt {
    pub sets: u64,
    pub rejected: RejectedPixels,
    pub time: Duration,
}

/// What the encoding did, of one file or of all.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Encoded {
    pub scans: u64,
    pub keyframes: u64,
    pub unusable: u64,
    pub time: Duration,
}

impl AddAssign for Encoded {
    fn add_assign(&mut self, other: Self) {
        self.scans += other.scans;
        self.keyframes += other.keyframes;
        self.unusable += other.unusable;
        self.time += other.time;
    }
}

/// Bytes of a group's payloads.
pub(super) fn payload_bytes(group: &EncodedGroup) -> u64 {
    (group.geometry.len() + group.texture.as_ref().map_or(0, Vec::len)) as u64
}
