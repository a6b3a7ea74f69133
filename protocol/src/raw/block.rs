//! One block of a segment: a head of fixed length with a checksum of its own, then a payload.

use super::{MAX_PICTURE_PX, MAX_SIDE_PX, MAX_TEXT_BYTES, filter};
use crate::session::bytes::Bytes;
use zstd::bulk::{Compressor, Decompressor};
use zstd::zstd_safe::CParameter;

/// Length of a block's head.
pub(super) const HEAD_BYTES: usize = 56;
/// What every block's head begins with; the kind follows.
pub(super) const MARKER: [u8; 3] = *b"gv3";
const STORED: u8 = 0;
const PREDICTED: u8 = 1;
/// Payload of the end block.
const END_BYTES: u32 = 16;

/// When and as what a picture was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RawStamp {
    /// Triggers since the run began.
    pub sequence: u64,
    /// Pattern that the trigger counter says was shown.
    pub pattern: u16,
    /// Middle of the exposure on the sensor's clock, nanoseconds.
    pub device_time_nanos: u64,
    /// Arrival on the host's clock, nanoseconds.
    pub host_time_nanos: u64,
    /// Length of the exposure, nanoseconds.
    pub exposure_nanos: u64,
}

/// What a camera answered in place of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum FaultCode {
    /// Nothing came in time.
    Timeout = 1,
    /// The camera was gone.
    Disconnected = 2,
    /// Anything else.
    Other = 3,
}

/// Counts at the clean end of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct RawTotals {
    /// Pictures written.
    pub pictures: u64,
    /// Pictures that the writer's queue had no room for.
    pub dropped_by_queue: u64,
}

/// What a block holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Kind {
    Picture = b'P',
    Fault = b'F',
    End = b'E',
}

/// A block's head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Head {
    pub kind: Kind,
    pub payload_bytes: u32,
    pub stamp: RawStamp,
    pub size_px: [u16; 2],
    pub code: u8,
    pub payload_crc: u32,
}

impl Head {
    pub fn encode(&self) -> [u8; HEAD_BYTES] {
        let mut out = [0; HEAD_BYTES];
        out[..3].copy_from_slice(&MARKER);
        out[3] = self.kind as u8;
        out[4..8].copy_from_slice(&self.payload_bytes.to_le_bytes());
        let times =
            [self.stamp.sequence, self.stamp.device_time_nanos, self.stamp.host_time_nanos, self.stamp.exposure_nanos];
        for (to, value) in out[8..40].chunks_exact_mut(8).zip(times) {
            to.copy_from_slice(&value.to_le_bytes());
        }
        for (to, value) in out[40..46].chunks_exact_mut(2).zip([self.stamp.pattern, self.size_px[0], self.size_px[1]]) {
            to.copy_from_slice(&value.to_le_bytes());
        }
        out[46] = self.code;
        out[48..52].copy_from_slice(&self.payload_crc.to_le_bytes());
        let crc = crc32fast::hash(&out[..52]);
        out[52..].copy_from_slice(&crc.to_le_bytes());
        out
    }

    /// Reads a head and checks every rule that needs no payload.
    pub fn decode(bytes: &[u8]) -> Result<Self, String> {
        let head = bytes
            .first_chunk::<HEAD_BYTES>()
            .ok_or_else(|| format!("the file ends {} bytes into a block's head", bytes.len()))?;
        if head[..3] != MARKER {
            return Err("no block begins here".into());
        }
        let mut fields = Bytes(&head[52..]);
        let (found, expected) = (crc32fast::hash(&head[..52]), fields.u32().unwrap_or(0));
        if found != expected {
            return Err(format!("head checksum {found:08x}, {expected:08x} expected"));
        }
        let kind = match head[3] {
            b'P' => Kind::Picture,
            b'F' => Kind::Fault,
            b'E' => Kind::End,
            other => return Err(format!("unknown kind of block {other:#04x}")),
        };
        if head[47] != 0 {
            return Err("the reserved byte 47 is not 0".into());
        }
        Self::fields(kind, head).filter(Self::is_sound).ok_or_else(|| "the head's fields contradict each other".into())
    }

    fn fields(kind: Kind, head: &[u8; HEAD_BYTES]) -> Option<Self> {
        let mut b = Bytes(&head[4..]);
        let payload_bytes = b.u32()?;
        let (sequence, device_time_nanos, host_time_nanos, exposure_nanos) = (b.u64()?, b.u64()?, b.u64()?, b.u64()?);
        let (pattern, width, height, code, _) = (b.u16()?, b.u16()?, b.u16()?, b.u8()?, b.u8()?);
        let stamp = RawStamp { sequence, pattern, device_time_nanos, host_time_nanos, exposure_nanos };
        Some(Self { kind, payload_bytes, stamp, size_px: [width, height], code, payload_crc: b.u32()? })
    }

    fn is_sound(&self) -> bool {
        let [width, height] = self.size_px.map(u32::from);
        match self.kind {
            Kind::Picture => {
                let sides = 1..=u32::from(MAX_SIDE_PX);
                let pixels = width * height;
                sides.contains(&width)
                    && sides.contains(&height)
                    && pixels <= MAX_PICTURE_PX
                    && match self.code {
                        STORED => self.payload_bytes == pixels,
                        PREDICTED => (1..pixels).contains(&self.payload_bytes),
                        _ => false,
                    }
            }
            Kind::Fault => (1..=3).contains(&self.code) && self.payload_bytes <= MAX_TEXT_BYTES && width + height == 0,
            Kind::End => self.code == 0 && self.payload_bytes == END_BYTES && width + height == 0,
        }
    }

    pub fn fault_code(&self) -> FaultCode {
        match self.code {
            1 => FaultCode::Timeout,
            2 => FaultCode::Disconnected,
            _ => FaultCode::Other,
        }
    }
}

/// Makes blocks; keeps its buffers.
pub(super) struct BlockEncoder {
    compressor: Compressor<'static>,
    residuals: Vec<u8>,
    block: Vec<u8>,
}

impl BlockEncoder {
    pub fn new() -> std::io::Result<Self> {
        let mut compressor = Compressor::new(1)?;
        // Residuals are noise: matches shorter than seven bytes are chance, and a table of 64 entries finds the long ones
        // (flat background) at half the time of the level's own.
        compressor.set_parameter(CParameter::HashLog(6))?;
        compressor.set_parameter(CParameter::MinMatch(7))?;
        compressor.include_checksum(false)?;
        compressor.include_contentsize(true)?;
        Ok(Self { compressor, residuals: Vec::new(), block: Vec::new() })
    }

    /// The block of a picture. `pixels` are `width * height`, which the caller has checked.
    pub fn picture(&mut self, stamp: &RawStamp, size_px: [u16; 2], pixels: &[u8]) -> std::io::Result<&[u8]> {
        self.residuals.resize(pixels.len(), 0);
        filter::residuals(pixels, usize::from(size_px[0]), &mut self.residuals);
        self.block.clear();
        self.block.resize(HEAD_BYTES + zstd::zstd_safe::compress_bound(pixels.len()), 0);
        let coded = self.compressor.compress_to_buffer(&self.residuals, &mut self.block[HEAD_BYTES..])?;
        let (code, length) = if coded < pixels.len() {
            (PREDICTED, coded)
        } else {
            self.block[HEAD_BYTES..HEAD_BYTES + pixels.len()].copy_from_slice(pixels);
            (STORED, pixels.len())
        };
        self.block.truncate(HEAD_BYTES + length);
        Ok(self.finish(Kind::Picture, *stamp, size_px, code))
    }

    /// The block of a fault; a message too long is cut.
    pub fn fault(&mut self, code: FaultCode, host_time_nanos: u64, message: &str) -> &[u8] {
        let mut end = message.len().min(MAX_TEXT_BYTES as usize);
        while !message.is_char_boundary(end) {
            end -= 1;
        }
        self.payload(&message.as_bytes()[..end]);
        self.finish(Kind::Fault, RawStamp { host_time_nanos, ..RawStamp::default() }, [0, 0], code as u8)
    }

    /// The block of a clean end.
    pub fn end(&mut self, totals: &RawTotals) -> &[u8] {
        let mut payload = [0; END_BYTES as usize];
        payload[..8].copy_from_slice(&totals.pictures.to_le_bytes());
        payload[8..].copy_from_slice(&totals.dropped_by_queue.to_le_bytes());
        self.payload(&payload);
        self.finish(Kind::End, RawStamp::default(), [0, 0], 0)
    }

    fn payload(&mut self, bytes: &[u8]) {
        self.block.clear();
        self.block.resize(HEAD_BYTES, 0);
        self.block.extend_from_slice(bytes);
    }

    fn finish(&mut self, kind: Kind, stamp: RawStamp, size_px: [u16; 2], code: u8) -> &[u8] {
        let payload = &self.block[HEAD_BYTES..];
        let payload_crc = crc32fast::hash(payload);
        let head = Head { kind, payload_bytes: payload.len() as u32, stamp, size_px, code, payload_crc };
        self.block[..HEAD_BYTES].copy_from_slice(&head.encode());
        &self.block
    }
}

/// Pixels of a picture block whose payload has the right checksum.
pub(super) fn decode_pixels(
    head: &Head,
    payload: &[u8],
    decompressor: &mut Decompressor<'static>,
) -> Result<Vec<u8>, String> {
    if head.code == STORED {
        return Ok(payload.to_vec());
    }
    let [width, height] = head.size_px.map(usize::from);
    let mut pixels = vec![0; width * height];
    let length = decompressor.decompress_to_buffer(payload, &mut pixels[..]).map_err(|e| format!("zstd: {e}"))?;
    if length != pixels.len() {
        return Err(format!("{length} residuals, {width} x {height} expected"));
    }
    filter::undo(&mut pixels, width);
    Ok(pixels)
}

/// Counts of an end block.
pub(super) fn decode_totals(payload: &[u8]) -> Option<RawTotals> {
    let mut bytes = Bytes(payload);
    Some(RawTotals { pictures: bytes.u64()?, dropped_by_queue: bytes.u64()? })
}
