//! A recording as the stages see it: how it is coded, where it goes, what became of it.

use super::record::RecordError;
use crate::light::RejectedPixels;
use crate::measure::{binary_bytes, obj_bmp_bytes};
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
    pub uncoded: Uncoded,
    pub time: Duration,
}

/// What scans would take without coding.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Uncoded {
    scans: u64,
    /// As float32 vertices, u32 triangles and 8-bit texture, bytes.
    pub binary_bytes: u64,
    /// Of one scan in [`COUNT_EVERY`]: the same, and bytes as OBJ and BMP files.
    counted: [u64; 2],
}

/// Scans from one whose text is counted to the next: counting takes milliseconds, and neighbours are much alike.
const COUNT_EVERY: u64 = 50;

impl Uncoded {
    /// With one more scan.
    #[must_use]
    pub fn and(mut self, scan: &Scan) -> Self {
        let bytes = binary_bytes(scan);
        if self.scans.is_multiple_of(COUNT_EVERY) {
            self.counted = [self.counted[0] + bytes, self.counted[1] + obj_bmp_bytes(scan)];
        }
        self.scans += 1;
        self.binary_bytes += bytes;
        self
    }

    /// As OBJ and BMP files, bytes; scans whose text was not counted take in proportion to their binary form.
    pub fn obj_bmp_bytes(&self) -> u64 {
        let [binary, text] = self.counted;
        (self.binary_bytes as f64 * text as f64 / binary.max(1) as f64).round() as u64
    }
}

impl AddAssign for Uncoded {
    fn add_assign(&mut self, other: Self) {
        self.scans += other.scans;
        self.binary_bytes += other.binary_bytes;
        self.counted = [self.counted[0] + other.counted[0], self.counted[1] + other.counted[1]];
    }
}

impl AddAssign for Encoded {
    fn add_assign(&mut self, other: Self) {
        self.scans += other.scans;
        self.keyframes += other.keyframes;
        self.unusable += other.unusable;
        self.uncoded += other.uncoded;
        self.time += other.time;
    }
}

/// Bytes of a group's payloads.
pub(super) fn payload_bytes(group: &EncodedGroup) -> u64 {
    (group.geometry.len() + group.texture.as_ref().map_or(0, Vec::len)) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use gv3_codec::GreyPicture;
    use gv3_codec::mesh::TriMesh;

    /// A strip of so many quads; its texts differ in length.
    fn strip(quads: u32) -> Scan {
        let corner = |i: u32| Vec3::new((i / 2) as f32 * 0.7 - 90.0, (i % 2) as f32, -600.0);
        let quad = |i: u32| [[2 * i, 2 * i + 2, 2 * i + 1], [2 * i + 1, 2 * i + 2, 2 * i + 3]];
        let positions_mm: Vec<Vec3> = (0..2 * quads + 2).map(corner).collect();
        let uv = Some(positions_mm.iter().map(|p| [p.y * 0.5, 0.25]).collect());
        let mesh = TriMesh { positions_mm, triangles: (0..quads).flat_map(quad).collect(), uv };
        Scan { tick: 0, time_nanos: 0, mesh, texture: Some(GreyPicture::filled(33, 20, 7)) }
    }

    #[test]
    fn one_scan_stands_for_its_neighbours_and_what_is_alike_is_exact() {
        let scan = strip(400);
        let alike = (0..25).fold(Uncoded::default(), |all, _| all.and(&scan));
        assert_eq!(alike.binary_bytes, 25 * (802 * 12 + 800 * 12 + 660));
        assert_eq!(alike.obj_bmp_bytes(), 25 * obj_bmp_bytes(&scan));
        let scans: Vec<Scan> = (0..120).map(|i| strip(300 + 2 * i)).collect();
        let all = scans.iter().fold(Uncoded::default(), Uncoded::and);
        let exact: u64 = scans.iter().map(obj_bmp_bytes).sum();
        assert!(all.obj_bmp_bytes().abs_diff(exact) * 100 < exact, "{} of {exact}", all.obj_bmp_bytes());
        let mut halves = scans[..50].iter().fold(Uncoded::default(), Uncoded::and);
        halves += scans[50..].iter().fold(Uncoded::default(), Uncoded::and);
        assert_eq!((halves, Uncoded::default().obj_bmp_bytes()), (all, 0));
    }
}
