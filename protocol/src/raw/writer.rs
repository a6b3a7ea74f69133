//! Writes a raw recording, block by block, segment by segment.

use super::block::{BlockEncoder, FaultCode, RawStamp, RawTotals};
use super::error::{RawError, Result, io_error};
use super::segment::SegmentHeader;
use super::{
    MAX_CONFIGURATION_BYTES, MAX_PICTURE_PX, MAX_SIDE_PX, SEGMENT_PICTURES, SEGMENT_TARGET_BYTES, segment_name,
};
use crate::atomic_file::sync_folder_of;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Writes a recording into a folder of its own. Every call leaves whole blocks behind; a finished segment is on disk
/// (fdatasync) before the next begins.
pub struct RawWriter {
    folder: PathBuf,
    header: SegmentHeader,
    path: PathBuf,
    file: File,
    encoder: BlockEncoder,
    segment_bytes: u64,
    segment_pictures: u32,
    bytes: u64,
    pictures: u64,
    has_failed: bool,
}

impl RawWriter {
    /// Begins a recording in `folder`, which is made if need be and must be empty. `configuration` is the rig's TOML with
    /// sequence and calibration; `created_unix_nanos` the start, nanoseconds since 1970-01-01 UTC.
    ///
    /// # Errors
    /// [`RawError::Exists`] when the folder holds anything; [`RawError::Usage`] for a configuration too long;
    /// [`RawError::Io`] as the system reports.
    pub fn create(folder: &Path, configuration: &str, created_unix_nanos: u64) -> Result<Self> {
        if configuration.len() > MAX_CONFIGURATION_BYTES as usize {
            let found = configuration.len();
            return Err(RawError::Usage(format!(
                "a configuration of {found} bytes, the limit is {MAX_CONFIGURATION_BYTES}"
            )));
        }
        fs::create_dir_all(folder).map_err(io_error(folder, "create the folder"))?;
        let mut entries = fs::read_dir(folder).map_err(io_error(folder, "open the folder"))?;
        if entries.next().is_some() {
            return Err(RawError::Exists { path: folder.to_path_buf() });
        }
        let header = SegmentHeader { number: 0, created_unix_nanos, configuration: configuration.to_owned() };
        let (path, file, bytes) = begin_segment(folder, &header)?;
        Ok(Self {
            folder: folder.to_path_buf(),
            header,
            encoder: BlockEncoder::new().map_err(io_error(&path, "set up the compressor for"))?,
            path,
            file,
            segment_bytes: bytes,
            segment_pictures: 0,
            bytes,
            pictures: 0,
            has_failed: false,
        })
    }

    /// Bytes written so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Pictures written so far.
    #[must_use]
    pub fn pictures(&self) -> u64 {
        self.pictures
    }

    /// Adds a picture of `size_px`, row by row.
    ///
    /// # Errors
    /// [`RawError::Usage`] for a picture beyond the limits or after a failure; [`RawError::Io`] when the disk fails; what was
    /// written before stays readable.
    pub fn picture(&mut self, stamp: &RawStamp, size_px: [u32; 2], pixels: &[u8]) -> Result<()> {
        let [width, height] = size_px;
        let side = |n: u32| u16::try_from(n).ok().filter(|n| (1..=MAX_SIDE_PX).contains(n));
        let (Some(w), Some(h)) = (side(width), side(height)) else {
            return Err(RawError::Usage(format!("a picture of {width} x {height} pixels, sides go to {MAX_SIDE_PX}")));
        };
        if width * height > MAX_PICTURE_PX || pixels.len() != (width * height) as usize {
            let found = pixels.len();
            return Err(RawError::Usage(format!("{found} pixels for {width} x {height}, at most {MAX_PICTURE_PX}")));
        }
        self.check()?;
        if self.segment_pictures >= SEGMENT_PICTURES || self.segment_bytes >= SEGMENT_TARGET_BYTES {
            self.next_segment().inspect_err(|_| self.has_failed = true)?;
        }
        let block = self.encoder.picture(stamp, [w, h], pixels).map_err(io_error(&self.path, "compress for"))?;
        let written = write(&mut self.file, block, &self.path);
        self.note(written)?;
        self.pictures += 1;
        self.segment_pictures += 1;
        Ok(())
    }

    /// Adds what the camera answered in place of a picture.
    ///
    /// # Errors
    /// As [`picture`](Self::picture).
    pub fn fault(&mut self, code: FaultCode, host_time_nanos: u64, message: &str) -> Result<()> {
        self.check()?;
        let written = write(&mut self.file, self.encoder.fault(code, host_time_nanos, message), &self.path);
        self.note(written)
    }

    /// Ends the recording; everything is on disk when this returns.
    ///
    /// # Errors
    /// As [`picture`](Self::picture).
    pub fn finish(mut self, dropped_by_queue: u64) -> Result<RawTotals> {
        self.check()?;
        let totals = RawTotals { pictures: self.pictures, dropped_by_queue };
        write(&mut self.file, self.encoder.end(&totals), &self.path)?;
        self.file.sync_all().map_err(io_error(&self.path, "write"))?;
        Ok(totals)
    }

    fn check(&self) -> Result<()> {
        if self.has_failed { Err(RawError::Usage("it failed before; begin another one".into())) } else { Ok(()) }
    }

    fn note(&mut self, written: Result<u64>) -> Result<()> {
        let bytes = written.inspect_err(|_| self.has_failed = true)?;
        self.bytes += bytes;
        self.segment_bytes += bytes;
        Ok(())
    }

    fn next_segment(&mut self) -> Result<()> {
        self.file.sync_data().map_err(io_error(&self.path, "write"))?;
        self.header.number += 1;
        let (path, file, bytes) = begin_segment(&self.folder, &self.header)?;
        (self.path, self.file, self.segment_bytes, self.segment_pictures) = (path, file, bytes, 0);
        self.bytes += bytes;
        Ok(())
    }
}

fn begin_segment(folder: &Path, header: &SegmentHeader) -> Result<(PathBuf, File, u64)> {
    let path = folder.join(segment_name(header.number));
    let mut file = OpenOptions::new().write(true).create_new(true).open(&path).map_err(io_error(&path, "create"))?;
    let bytes = write(&mut file, &header.encode(), &path)?;
    sync_folder_of(&path).map_err(io_error(&path, "create"))?;
    Ok((path, file, bytes))
}

fn write(file: &mut File, bytes: &[u8], path: &Path) -> Result<u64> {
    file.write_all(bytes).map_err(io_error(path, "write"))?;
    Ok(bytes.len() as u64)
}
