//! One file of a raw recording: a header with the configuration, then blocks.

use super::block::{FaultCode, HEAD_BYTES, Head, Kind, MARKER, RawStamp, RawTotals, decode_pixels, decode_totals};
use super::{FORMAT_VERSION, MAX_CONFIGURATION_BYTES};
use crate::session::bytes::Bytes;
use zstd::bulk::Decompressor;

/// What every segment begins with. The first byte is no text, the last two show a transfer that changed line ends.
pub(super) const MAGIC: [u8; 8] = *b"\x89gv3raw\n";
/// Length of the fixed part of a segment's header.
pub(super) const HEADER_BYTES: usize = 36;

/// A picture with its stamp.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawPicture {
    /// When and as what it was taken.
    pub stamp: RawStamp,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Grey levels row by row; empty when only stamps were asked for.
    pub pixels: Vec<u8>,
}

/// What a recording holds at one place.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RawItem {
    /// A picture.
    Picture(RawPicture),
    /// What the camera answered in place of a picture.
    Fault {
        /// Kind of fault.
        code: FaultCode,
        /// When, on the host's clock, nanoseconds.
        host_time_nanos: u64,
        /// The camera's words.
        message: String,
    },
    /// The clean end.
    End(RawTotals),
    /// Bytes that are no intact block.
    Damage {
        /// Where they begin, bytes from the start of the segment.
        offset: u64,
        /// How many there are.
        bytes: u64,
        /// What was found.
        reason: String,
    },
}

/// Why a file is no segment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SegmentError {
    /// Another kind of file, or a header that is not intact.
    Header(String),
    /// A newer version of the format.
    Newer(u16),
}

/// A segment's header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SegmentHeader {
    /// Position in the recording, from 0.
    pub number: u32,
    /// Start of the recording, nanoseconds since 1970-01-01 UTC; the same in all its segments.
    pub created_unix_nanos: u64,
    /// The rig's configuration with sequence and calibration, a TOML document.
    pub configuration: String,
}

impl SegmentHeader {
    /// The header's bytes. The configuration is at most [`MAX_CONFIGURATION_BYTES`] long, which the writer has checked.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let text = self.configuration.as_bytes();
        let mut out = Vec::with_capacity(HEADER_BYTES + text.len());
        out.extend_from_slice(&MAGIC);
        out.extend_from_slice(&FORMAT_VERSION.to_le_bytes());
        out.extend_from_slice(&[0; 2]);
        out.extend_from_slice(&self.number.to_le_bytes());
        out.extend_from_slice(&self.created_unix_nanos.to_le_bytes());
        out.extend_from_slice(&(text.len() as u32).to_le_bytes());
        out.extend_from_slice(&crc32fast::hash(text).to_le_bytes());
        let crc = crc32fast::hash(&out);
        out.extend_from_slice(&crc.to_le_bytes());
        out.extend_from_slice(text);
        out
    }

    /// Reads a header; also where the first block lies.
    ///
    /// # Errors
    /// [`SegmentError`] when it is not intact.
    pub fn decode(bytes: &[u8]) -> Result<(Self, usize), SegmentError> {
        let wrong = |reason: &str| SegmentError::Header(reason.to_owned());
        if bytes.get(..8) != Some(&MAGIC[..]) {
            return Err(wrong("it does not begin as a segment does"));
        }
        let mut b = Bytes(&bytes[8..]);
        let short = || wrong("the file ends in its header");
        let (version, reserved) = (b.u16().ok_or_else(short)?, b.u16().ok_or_else(short)?);
        if version > FORMAT_VERSION {
            return Err(SegmentError::Newer(version));
        }
        let (number, created_unix_nanos) = (b.u32().ok_or_else(short)?, b.u64().ok_or_else(short)?);
        let (length, text_crc) = (b.u32().ok_or_else(short)?, b.u32().ok_or_else(short)?);
        if b.u32().ok_or_else(short)? != crc32fast::hash(&bytes[..HEADER_BYTES - 4]) {
            return Err(wrong("the header's checksum is wrong"));
        }
        if version == 0 || reserved != 0 || length > MAX_CONFIGURATION_BYTES {
            return Err(wrong("the header's fields are out of range"));
        }
        let text = b.slice(length as usize).ok_or_else(short)?;
        if crc32fast::hash(text) != text_crc {
            return Err(wrong("the configuration's checksum is wrong"));
        }
        let configuration = std::str::from_utf8(text).map_err(|_| wrong("the configuration is no text"))?.to_owned();
        Ok((Self { number, created_unix_nanos, configuration }, HEADER_BYTES + length as usize))
    }
}

/// A segment in memory, read block by block; whatever its bytes are, reading ends.
pub struct Segment {
    header: SegmentHeader,
    bytes: Vec<u8>,
    at: usize,
    decompressor: Decompressor<'static>,
}

impl Segment {
    /// Takes a segment's bytes.
    ///
    /// # Errors
    /// [`SegmentError`] when the header is not intact.
    pub fn new(bytes: Vec<u8>) -> Result<Self, SegmentError> {
        let (header, at) = SegmentHeader::decode(&bytes)?;
        let decompressor = Decompressor::new().map_err(|e| SegmentError::Header(format!("zstd: {e}")))?;
        Ok(Self { header, bytes, at, decompressor })
    }

    /// The header.
    #[must_use]
    pub fn header(&self) -> &SegmentHeader {
        &self.header
    }

    /// The next item, `None` at the end; pixels are left out unless `wants_pixels`, and then not checked beyond the checksum.
    pub fn next(&mut self, wants_pixels: bool) -> Option<RawItem> {
        if self.at >= self.bytes.len() {
            return None;
        }
        let start = self.at;
        let taken = Head::decode(&self.bytes[start..]).and_then(|head| {
            let end = start + HEAD_BYTES + head.payload_bytes as usize;
            if end > self.bytes.len() {
                return Err(format!(
                    "the file ends {} bytes into a block of {}",
                    self.bytes.len() - start,
                    end - start
                ));
            }
            Ok((head, end))
        });
        let (head, end) = match taken {
            Ok(taken) => taken,
            Err(reason) => return Some(self.damage(start, self.next_head(start + 1), reason)),
        };
        self.at = end;
        match self.content(&head, start + HEAD_BYTES..end, wants_pixels) {
            Ok(item) => Some(item),
            Err(reason) => Some(self.damage(start, end, reason)),
        }
    }

    fn content(&mut self, head: &Head, at: std::ops::Range<usize>, wants_pixels: bool) -> Result<RawItem, String> {
        let payload = &self.bytes[at];
        let found = crc32fast::hash(payload);
        if found != head.payload_crc {
            return Err(format!("payload checksum {found:08x}, {:08x} expected", head.payload_crc));
        }
        match head.kind {
            Kind::Picture => {
                let pixels = match wants_pixels {
                    true => decode_pixels(head, payload, &mut self.decompressor)?,
                    false => Vec::new(),
                };
                let [width_px, height_px] = head.size_px.map(u32::from);
                Ok(RawItem::Picture(RawPicture { stamp: head.stamp, width_px, height_px, pixels }))
            }
            Kind::Fault => {
                let message = std::str::from_utf8(payload).map_err(|_| "the message is no text")?.to_owned();
                Ok(RawItem::Fault { code: head.fault_code(), host_time_nanos: head.stamp.host_time_nanos, message })
            }
            Kind::End => decode_totals(payload).map(RawItem::End).ok_or_else(|| "short".into()),
        }
    }

    fn damage(&mut self, start: usize, end: usize, reason: String) -> RawItem {
        self.at = end;
        RawItem::Damage { offset: start as u64, bytes: (end - start) as u64, reason }
    }

    /// Where the next intact head lies, or the end.
    fn next_head(&self, from: usize) -> usize {
        let is_head = |at: &usize| self.bytes[*at..].starts_with(&MARKER) && Head::decode(&self.bytes[*at..]).is_ok();
        (from..self.bytes.len()).find(is_head).unwrap_or(self.bytes.len())
    }
}
