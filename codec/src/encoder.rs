//! Encoder of a run in either mode: one scan in, a group out whenever a keyframe closes it.

use crate::mesh::repair::RepairReport;
use crate::seed::{self, GivenCounts, GivenLandmark};
use crate::shot::encoder as shots;
use crate::shot::pictures::GroupPictures;
#[cfg(doc)]
use crate::shot::pictures::PictureEncoder;
use crate::{CodecError, Result, Scan, Stamp, StreamHeader};

/// A group ready to be stored.
#[derive(Debug, Clone)]
pub struct EncodedGroup {
    /// Stamp of the group's first scan.
    pub first: Stamp,
    /// Stamp of the keyframe that closes it.
    pub key: Stamp,
    /// Scans in the group, keyframe included.
    pub scans: usize,
    /// Payload "group".
    pub geometry: Vec<u8>,
    /// Payload "texture".
    pub texture: Option<Vec<u8>>,
    /// What a [`PictureEncoder`] is to make the texture of, after [`Encoder::defer_pictures`].
    pub pictures: Option<Box<GroupPictures>>,
    /// What became of the landmarks given for the keyframe.
    pub landmarks: GivenCounts,
    /// What the parts of its geometry cost, in the default mode.
    pub cost: Option<shots::GroupCost>,
}

/// What became of a scan.
#[derive(Debug, Default)]
pub struct Pushed {
    /// The group it closed, if it was a keyframe.
    pub group: Option<EncodedGroup>,
    /// What had to be mended before it could be a keyframe.
    pub repair: Option<RepairReport>,
    /// Why a keyframe was due but this scan could not be one; the next scan is tried.
    pub not_key: Option<CodecError>,
}

/// Settings of a run.
#[derive(Debug, Clone, PartialEq)]
pub enum EncoderConfig {
    /// Of the seed mode.
    Seed(seed::EncoderConfig),
    /// Of the default mode.
    Shots(shots::ShotConfig),
}

impl EncoderConfig {
    /// The default mode's settings for scans of one period.
    pub fn new(scan_period_nanos: u64) -> Self {
        Self::Shots(shots::ShotConfig::new(scan_period_nanos))
    }

    /// Written before the first group.
    pub fn header(&self) -> StreamHeader {
        match self {
            Self::Seed(config) => config.header,
            Self::Shots(config) => config.header(),
        }
    }

    /// Error that is worth correcting, mm; of the default mode.
    pub fn tolerance_mm(&self) -> Option<f64> {
        match self {
            Self::Seed(_) => None,
            Self::Shots(config) => Some(config.tolerance_mm),
        }
    }
}

/// Encoder of one run.
pub enum Encoder {
    /// In the seed mode.
    Seed(Box<seed::Encoder>),
    /// In the default mode.
    Shots(Box<shots::Encoder>),
}

impl Encoder {
    /// An encoder that has seen nothing.
    ///
    /// # Errors
    /// [`CodecError::Stream`] naming a setting out of range.
    pub fn new(config: EncoderConfig) -> Result<Self> {
        Ok(match config {
            EncoderConfig::Seed(config) => Self::Seed(Box::new(seed::Encoder::new(config)?)),
            EncoderConfig::Shots(config) => Self::Shots(Box::new(shots::Encoder::new(config)?)),
        })
    }

    /// Stream header of the run.
    pub fn header(&self) -> StreamHeader {
        match self {
            Self::Seed(encoder) => encoder.header(),
            Self::Shots(encoder) => encoder.header(),
        }
    }

    /// Whether scans between keyframes are corrected by what motion does not explain, for the groups to come; the seed mode
    /// never does.
    pub fn set_corrects_between(&mut self, corrects_between: bool) {
        if let Self::Shots(encoder) = self {
            encoder.set_corrects_between(corrects_between);
        }
    }

    /// Leaves the pictures of the groups to come to a [`PictureEncoder`], which may work in another thread; the seed mode codes
    /// them itself nevertheless.
    pub fn defer_pictures(&mut self) {
        if let Self::Shots(encoder) = self {
            encoder.defer_pictures();
        }
    }

    /// Takes the next scan.
    ///
    /// # Errors
    /// [`CodecError::Stream`] when its tick does not follow, [`CodecError::Mesh`] when it is no mesh at all; the scan is
    /// then not part of the run.
    pub fn push(&mut self, scan: Scan) -> Result<Pushed> {
        self.push_with_landmarks(scan, &[])
    }

    /// As [`Self::push`], with landmarks on the scan.
    ///
    /// # Errors
    /// As [`Self::push`].
    pub fn push_with_landmarks(&mut self, scan: Scan, given: &[GivenLandmark]) -> Result<Pushed> {
        match self {
            Self::Seed(encoder) => encoder.push_with_landmarks(scan, given),
            Self::Shots(encoder) => encoder.push(scan),
        }
    }

    /// Ends the run: the scans since the last keyframe are closed by the last of them as a keyframe.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when that scan cannot be a keyframe.
    pub fn finish(self) -> Result<Option<EncodedGroup>> {
        match self {
            Self::Seed(encoder) => encoder.finish(),
            Self::Shots(encoder) => encoder.finish(),
        }
    }
}
