//! Stream header: what holds for all groups of a run.

use crate::bits::bytes::{ByteReader, put_varint};
use crate::{CodecError, Result};

/// Newest payload format this build writes and reads.
pub const FORMAT_VERSION: u16 = 1;

/// Coding mode of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Mode {
    /// The published scheme: decimated keyframes, conformal matching, natural spline through the keyframes.
    #[default]
    Seed,
}

impl Mode {
    /// Name on the command line and in metadata.
    pub fn name(self) -> &'static str {
        match self {
            Mode::Seed => "seed",
        }
    }
}

/// Parameters of a run, coded once before its groups.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamHeader {
    /// How groups are coded.
    pub mode: Mode,
    /// Ticks from keyframe to keyframe, 1 to 255.
    pub keyframe_interval: u8,
    /// Nanoseconds of one tick, 1 to 10^12.
    pub scan_period_nanos: u64,
    /// Quantizer step of positions, millimetres, 2^-20 to 2^10.
    pub position_step_mm: f32,
}

const MAX_PERIOD_NANOS: u64 = 1_000_000_000_000;

impl StreamHeader {
    /// Checks the ranges that FORMAT.md gives.
    ///
    /// # Errors
    /// [`CodecError::Stream`] naming the field.
    pub fn validate(&self) -> Result<()> {
        if self.keyframe_interval == 0 {
            return Err(CodecError::Stream("keyframe interval is 0; 1 to 255 scans are allowed".into()));
        }
        if !(1..=MAX_PERIOD_NANOS).contains(&self.scan_period_nanos) {
            return Err(CodecError::Stream(format!(
                "scan period is {} ns; 1 to 10^12 are allowed",
                self.scan_period_nanos
            )));
        }
        if !(1.0 / 1_048_576.0..=1024.0).contains(&self.position_step_mm) {
            return Err(CodecError::Stream(format!(
                "position step is {} mm; 2^-20 to 1024 are allowed",
                self.position_step_mm
            )));
        }
        Ok(())
    }

    /// Bytes as in FORMAT.md, "Stream header".
    pub fn encode(&self) -> Vec<u8> {
        let mut out = FORMAT_VERSION.to_le_bytes().to_vec();
        out.push(0);
        out.push(self.keyframe_interval);
        put_varint(&mut out, self.scan_period_nanos);
        out.extend_from_slice(&self.position_step_mm.to_le_bytes());
        out
    }

    /// Reads a header.
    ///
    /// # Errors
    /// [`CodecError::NewerVersion`], [`CodecError::Payload`] for bytes that do not fit, [`CodecError::Stream`] for values
    /// out of range.
    pub fn decode(bytes: &[u8]) -> Result<Self> {
        let mut reader = ByteReader::new(bytes, "stream header");
        let version = reader.u16()?;
        if version > FORMAT_VERSION {
            return Err(CodecError::NewerVersion { found: version.into(), supported: FORMAT_VERSION.into() });
        }
        if version == 0 {
            return Err(reader.error("format version 0; versions begin at 1"));
        }
        match reader.u8()? {
            0 => {}
            other => return Err(reader.error(format!("mode {other}; 0 (seed) is defined"))),
        }
        let header = Self {
            mode: Mode::Seed,
            keyframe_interval: reader.u8()?,
            scan_period_nanos: reader.varint()?,
            position_step_mm: reader.f32()?,
        };
        reader.finish()?;
        header.validate()?;
        Ok(header)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: StreamHeader = StreamHeader {
        mode: Mode::Seed,
        keyframe_interval: 10,
        scan_period_nanos: 33_333_333,
        position_step_mm: 0.0625,
    };

    #[test]
    fn golden_bytes_and_back() {
        let bytes = HEADER.encode();
        assert_eq!(bytes, [1, 0, 0, 10, 0xd5, 0xc0, 0xf2, 0x0f, 0, 0, 0x80, 0x3d]);
        assert_eq!(StreamHeader::decode(&bytes).unwrap(), HEADER);
    }

    #[test]
    fn every_prefix_and_one_byte_more_fail() {
        let bytes = HEADER.encode();
        for n in 0..bytes.len() {
            assert!(StreamHeader::decode(&bytes[..n]).is_err(), "{n}");
        }
        assert!(StreamHeader::decode(&[&bytes[..], &[0]].concat()).is_err());
    }

    #[test]
    fn newer_versions_and_bad_fields_are_named() {
        let mut bytes = HEADER.encode();
        bytes[0] = 2;
        assert_eq!(StreamHeader::decode(&bytes), Err(CodecError::NewerVersion { found: 2, supported: 1 }));
        let mut bytes = HEADER.encode();
        bytes[3] = 0;
        assert!(StreamHeader::decode(&bytes).unwrap_err().to_string().contains("keyframe interval"));
    }
}
