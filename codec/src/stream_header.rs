//! Stream header: what holds for all groups of a run.

use crate::bits::bytes::{ByteReader, put_varint};
use crate::shot::steps::Steps;
use crate::{CodecError, Result};

/// Newest payload format this build reads.
pub const FORMAT_VERSION: u16 = 2;

/// Coding mode of a run and its steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Mode {
    /// The published scheme: decimated keyframes, conformal matching, natural spline through the keyframes. Since version 1.
    Seed {
        /// Quantizer step of positions, millimetres, 2^-20 to 2^10.
        position_step_mm: f32,
    },
    /// Shots on the conformal disk, corrected in the camera's view. Since version 2.
    Shots(Steps),
}

impl Mode {
    /// Name on the command line and in metadata.
    pub fn name(self) -> &'static str {
        match self {
            Mode::Seed { .. } => "seed",
            Mode::Shots(_) => "default",
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
        match self.mode {
            Mode::Seed { position_step_mm: step } if !(1.0 / 1_048_576.0..=1024.0).contains(&step) => {
                Err(CodecError::Stream(format!("position step is {step} mm; 2^-20 to 1024 are allowed")))
            }
            Mode::Seed { .. } => Ok(()),
            Mode::Shots(steps) => match steps.out_of_range() {
                None => Ok(()),
                Some((name, value, most)) => {
                    Err(CodecError::Stream(format!("{name} is {value}; 1 to {most} are allowed")))
                }
            },
        }
    }

    /// Quantizer step of positions of the seed mode.
    ///
    /// # Errors
    /// [`CodecError::Stream`] in other modes.
    pub fn position_step_mm(&self) -> Result<f32> {
        match self.mode {
            Mode::Seed { position_step_mm } => Ok(position_step_mm),
            _ => Err(CodecError::Stream("a group of the seed mode in a run of another mode".into())),
        }
    }

    /// Steps of the default mode.
    ///
    /// # Errors
    /// [`CodecError::Stream`] in other modes.
    pub fn steps(&self) -> Result<Steps> {
        match self.mode {
            Mode::Shots(steps) => Ok(steps),
            Mode::Seed { .. } => Err(CodecError::Stream("a group of shots in a run of the seed mode".into())),
        }
    }

    /// Bytes as in FORMAT.md, "Stream header".
    pub fn encode(&self) -> Vec<u8> {
        let (version, mode) = match self.mode {
            Mode::Seed { .. } => (1_u16, 0),
            Mode::Shots(_) => (2, 1),
        };
        let mut out = version.to_le_bytes().to_vec();
        out.push(mode);
        out.push(self.keyframe_interval);
        put_varint(&mut out, self.scan_period_nanos);
        match self.mode {
            Mode::Seed { position_step_mm } => out.extend_from_slice(&position_step_mm.to_le_bytes()),
            Mode::Shots(steps) => steps.encode(&mut out),
        }
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
        let mode_at = reader.clone();
        let mode = reader.u8()?;
        let (keyframe_interval, scan_period_nanos) = (reader.u8()?, reader.varint()?);
        let mode = match mode {
            0 if version == 1 => Mode::Seed { position_step_mm: reader.f32()? },
            1 if version == 2 => Mode::Shots(Steps::decode(&mut reader)?),
            other => {
                return Err(mode_at.error(format!(
                    "mode {other} in version {version}; version 1 has mode 0 (seed), version 2 has mode 1 (shots)"
                )));
            }
        };
        let header = Self { mode, keyframe_interval, scan_period_nanos };
        reader.finish()?;
        header.validate()?;
        Ok(header)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: StreamHeader = StreamHeader {
        mode: Mode::Seed { position_step_mm: 0.0625 },
        keyframe_interval: 10,
        scan_period_nanos: 33_333_333,
    };

    #[test]
    fn golden_bytes_and_back() {
        let bytes = HEADER.encode();
        assert_eq!(bytes, [1, 0, 0, 10, 0xd5, 0xc0, 0xf2, 0x0f, 0, 0, 0x80, 0x3d]);
        assert_eq!(StreamHeader::decode(&bytes).unwrap(), HEADER);
    }

    #[test]
    fn the_default_mode_has_its_steps_and_a_version_of_its_own() {
        let header = StreamHeader { mode: Mode::Shots(Steps::default()), ..HEADER };
        let mut bytes = header.encode();
        assert_eq!(bytes, [2, 0, 1, 10, 0xd5, 0xc0, 0xf2, 0x0f, 2, 4, 38, 77, 100, 64, 38, 10]);
        assert_eq!(StreamHeader::decode(&bytes).unwrap(), header);
        bytes[0] = 1;
        assert!(StreamHeader::decode(&bytes).unwrap_err().to_string().contains("mode 1"));
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
        bytes[0] = 3;
        assert_eq!(StreamHeader::decode(&bytes), Err(CodecError::NewerVersion { found: 3, supported: 2 }));
        let mut bytes = HEADER.encode();
        bytes[3] = 0;
        assert!(StreamHeader::decode(&bytes).unwrap_err().to_string().contains("keyframe interval"));
    }
}
