//! Reads a raw recording from front to back, and checks it.

use super::block::RawTotals;
use super::error::{RawError, Result, io_error};
use super::segment::{RawItem, RawPicture, Segment, SegmentError};
use super::{FORMAT_VERSION, MAX_SEGMENT_BYTES, segment_number};
use std::fs;
use std::path::{Path, PathBuf};

/// A recording opened for reading, one segment in memory at a time.
pub struct RawReader {
    folder: PathBuf,
    /// Number and path of every segment, in order.
    segments: Vec<(u32, PathBuf)>,
    first: super::SegmentHeader,
    next: usize,
    current: Option<Segment>,
}

impl RawReader {
    /// Whether `path` is a folder with a segment in it.
    #[must_use]
    pub fn is_recording(path: &Path) -> bool {
        fs::read_dir(path).is_ok_and(|mut entries| {
            entries.any(|e| e.is_ok_and(|e| e.file_name().to_str().and_then(segment_number).is_some()))
        })
    }

    /// Opens a recording's folder. The configuration is that of the first segment whose header is intact.
    ///
    /// # Errors
    /// [`RawError::NotARecording`] when there is no segment, or none with an intact header; [`RawError::NewerVersion`];
    /// [`RawError::Io`].
    pub fn open(folder: &Path) -> Result<Self> {
        let mut segments = Vec::new();
        for entry in fs::read_dir(folder).map_err(io_error(folder, "open the folder"))? {
            let entry = entry.map_err(io_error(folder, "read the folder"))?;
            segments.extend(entry.file_name().to_str().and_then(segment_number).map(|n| (n, entry.path())));
        }
        segments.sort_unstable();
        let wrong = |reason: String| RawError::NotARecording { path: folder.to_path_buf(), reason };
        let mut reason = "no pictures_000000.gv3raw in it".to_owned();
        for (_, path) in &segments {
            match Segment::new(read_segment(path)?) {
                Ok(segment) => {
                    let first = segment.header().clone();
                    return Ok(Self { folder: folder.to_path_buf(), segments, first, next: 0, current: None });
                }
                Err(SegmentError::Newer(found)) => {
                    let supported = FORMAT_VERSION;
                    return Err(RawError::NewerVersion { path: path.clone(), found, supported });
                }
                Err(SegmentError::Header(found)) => reason = format!("{}: {found}", path.display()),
            }
        }
        Err(wrong(reason))
    }

    /// The rig's configuration with sequence and calibration, a TOML document.
    #[must_use]
    pub fn configuration(&self) -> &str {
        &self.first.configuration
    }

    /// Start of the recording, nanoseconds since 1970-01-01 UTC.
    #[must_use]
    pub fn created_unix_nanos(&self) -> u64 {
        self.first.created_unix_nanos
    }

    /// The folder.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Number of segments.
    #[must_use]
    pub fn segments(&self) -> usize {
        self.segments.len()
    }

    /// Begins again at the first picture.
    pub fn rewind(&mut self) {
        (self.next, self.current) = (0, None);
    }

    /// The next item and the segment it is in, `None` at the end; pixels are left out unless `wants_pixels`. Damage is an
    /// item, so that what is intact behind it is read too.
    ///
    /// # Errors
    /// [`RawError::Io`] when the disk fails.
    pub fn next(&mut self, wants_pixels: bool) -> Result<Option<(&Path, RawItem)>> {
        loop {
            if let Some(item) = self.current.as_mut().and_then(|segment| segment.next(wants_pixels)) {
                return Ok(Some((&self.segments[self.next - 1].1, item)));
            }
            self.current = None;
            let Some((number, path)) = self.segments.get(self.next) else { return Ok(None) };
            let expected = self.next.checked_sub(1).map_or(0, |last| self.segments[last].0.saturating_add(1));
            self.next += 1;
            let bytes = read_segment(path)?;
            let length = bytes.len() as u64;
            let mut problem = None;
            match Segment::new(bytes) {
                Ok(segment) => {
                    let head = segment.header();
                    if head.number != *number || head.created_unix_nanos != self.first.created_unix_nanos {
                        problem = Some((length, "the segment belongs elsewhere by its header".to_owned()));
                    } else {
                        if *number != expected {
                            problem = Some((0, format!("segments {expected} to {} are missing before it", number - 1)));
                        }
                        self.current = Some(segment);
                    }
                }
                Err(SegmentError::Header(reason)) => problem = Some((length, reason)),
                Err(SegmentError::Newer(version)) => problem = Some((length, format!("raw format {version}"))),
            }
            if let Some((bytes, reason)) = problem {
                return Ok(Some((&self.segments[self.next - 1].1, RawItem::Damage { offset: 0, bytes, reason })));
            }
        }
    }
}

fn read_segment(path: &Path) -> Result<Vec<u8>> {
    let metadata = fs::metadata(path).map_err(io_error(path, "open"))?;
    if !metadata.is_file() || metadata.len() > MAX_SEGMENT_BYTES {
        let reason = format!("no regular file of at most {MAX_SEGMENT_BYTES} bytes");
        return Err(RawError::NotARecording { path: path.to_path_buf(), reason });
    }
    fs::read(path).map_err(io_error(path, "read"))
}

/// Something wrong with a recording.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct RawProblem {
    /// Segment concerned.
    pub path: PathBuf,
    /// Where, bytes from its start.
    pub offset: u64,
    /// How many bytes.
    pub bytes: u64,
    /// What was found.
    pub reason: String,
}

/// What a walk over a recording found.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct RawReport {
    /// Segments.
    pub segments: usize,
    /// Intact pictures.
    pub pictures: u64,
    /// Their pixels, bytes.
    pub pixel_bytes: u64,
    /// The segments on disk, bytes.
    pub bytes: u64,
    /// Sensor time of the first and the last picture, nanoseconds.
    pub device_time_nanos: Option<[u64; 2]>,
    /// Pictures missing by their sequence numbers.
    pub missing_pictures: u64,
    /// Faults recorded.
    pub faults: u64,
    /// Counts of a clean end; none when the recording was cut off.
    pub end: Option<RawTotals>,
    /// What is wrong; at most 1000 entries.
    pub problems: Vec<RawProblem>,
}

impl RawReport {
    /// Whether nothing is wrong; a recording that was cut off between two blocks is not.
    #[must_use]
    pub fn ok(&self) -> bool {
        self.problems.is_empty() && self.end.is_some_and(|end| end.pictures == self.pictures)
    }
}

/// Walks over a recording; decodes every picture if `decodes`, checks checksums in any case.
///
/// # Errors
/// As [`RawReader::open`]; damage is not an error but a problem in the report.
pub fn verify_raw(folder: &Path, decodes: bool) -> Result<RawReport> {
    /// Longest list of problems kept.
    const PROBLEM_LIMIT: usize = 1000;
    let mut reader = RawReader::open(folder)?;
    let mut report = RawReport {
        segments: reader.segments(),
        pictures: 0,
        pixel_bytes: 0,
        bytes: reader.segments.iter().filter_map(|(_, path)| Some(fs::metadata(path).ok()?.len())).sum(),
        device_time_nanos: None,
        missing_pictures: 0,
        faults: 0,
        end: None,
        problems: Vec::new(),
    };
    let mut last_sequence = None;
    while let Some((path, item)) = reader.next(decodes)? {
        match item {
            RawItem::Picture(picture) => report.add(&picture, &mut last_sequence),
            RawItem::Fault { .. } => report.faults += 1,
            RawItem::End(totals) => report.end = Some(totals),
            RawItem::Damage { offset, bytes, reason } if report.problems.len() < PROBLEM_LIMIT => {
                report.problems.push(RawProblem { path: path.to_path_buf(), offset, bytes, reason });
            }
            RawItem::Damage { .. } => {}
        }
    }
    Ok(report)
}

impl RawReport {
    fn add(&mut self, picture: &RawPicture, last_sequence: &mut Option<u64>) {
        self.pictures += 1;
        self.pixel_bytes += u64::from(picture.width_px) * u64::from(picture.height_px);
        let time = picture.stamp.device_time_nanos;
        self.device_time_nanos = Some([self.device_time_nanos.map_or(time, |t| t[0]), time]);
        let sequence = picture.stamp.sequence;
        if let Some(last) = *last_sequence {
            self.missing_pictures =
                self.missing_pictures.saturating_add(sequence.saturating_sub(last).saturating_sub(1));
        }
        *last_sequence = Some(last_sequence.unwrap_or(0).max(sequence));
    }
}
