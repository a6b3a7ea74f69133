//! Structured light: patterns out, pictures in, surface out. Knows no device and no clock.

pub mod absolute;
pub mod board;
pub mod calibrate;
pub mod calibration;
mod calibration_json;
mod calibration_opencv;
mod calibration_text;
pub mod chessboard;
mod chessboard_corners;
mod chessboard_grid;
pub mod dither;
mod field;
pub mod gamma;
pub mod geometric;
pub mod gray_code;
pub mod grid_mesh;
pub mod homography;
pub mod intersect;
pub mod mask;
pub mod motion;
mod opencv_yaml;
pub mod pattern;
mod pattern_text;
pub mod phase;
pub mod processing;
pub mod projector_corners;
mod schemes;
pub mod spatial;
pub mod triangulate;
pub mod unwrap;

use serde::{Deserialize, Serialize};

pub use absolute::AbsoluteDecoder;
pub use board::{Board, BoardView};
pub use calibration::{Calibration, Distortion, Intrinsics, Rigid};
pub use calibration_text::CalibrationFormat;
pub use chessboard::{ChessboardError, find_chessboard};
pub use gamma::GammaTable;
pub use geometric::MinimumPhase;
pub use gray_code::{GrayCodes, GrayDecoder};
pub use grid_mesh::{GridMesher, MeshLimits};
pub use intersect::{Intersector, ProjectorCoordinates, epipolar_distance_px};
pub use mask::{MaskLimits, PixelMask, RejectedPixels, Rejection};
pub use motion::MotionCorrector;
pub use pattern::{Direction, Pattern, PatternKind, PatternSequence};
pub use phase::{PhaseExtractor, WrappedPhase};
pub use processing::{MotionCorrection, Processing, Unwrap};
pub use projector_corners::{UnreadCorners, projector_corners};
pub use triangulate::{PointGrid, Triangulator};
pub use unwrap::Unwrapper;

/// A setting or a calibration that cannot work.
#[derive(Debug, thiserror::Error, Clone, PartialEq)]
pub enum LightError {
    /// A field holds a value that cannot be used.
    #[error("{field}: {reason}")]
    Field {
        /// Dotted path of the field, as in the TOML file.
        field: String,
        /// What was found and what to do.
        reason: String,
    },
    /// Text that is no TOML, or no TOML of this kind.
    #[error("{0}")]
    Toml(String),
}

impl LightError {
    /// An error about `field`.
    pub(crate) fn field(field: impl Into<String>, reason: impl Into<String>) -> Self {
        Self::Field { field: field.into(), reason: reason.into() }
    }
}

/// Working range: distances from the camera along its axis that the scanner measures, mm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthRange {
    /// Nearest depth kept, mm.
    pub near_mm: f64,
    /// Farthest depth kept, mm.
    pub far_mm: f64,
}

impl Default for DepthRange {
    fn default() -> Self {
        Self { near_mm: 510.0, far_mm: 690.0 }
    }
}

impl DepthRange {
    /// Checks 0 < near < far.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the limit.
    pub fn validate(&self) -> Result<(), LightError> {
        if !(self.near_mm > 0.0 && self.near_mm.is_finite()) {
            return Err(LightError::field("depth.near_mm", format!("{} is no distance above zero", self.near_mm)));
        }
        if !(self.far_mm > self.near_mm && self.far_mm.is_finite()) {
            return Err(LightError::field("depth.far_mm", format!("{} is not beyond near_mm", self.far_mm)));
        }
        Ok(())
    }
}

/// What a pixel and a triangle must fulfil to become part of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Limits on the fringe signal.
    pub mask: MaskLimits,
    /// Working range.
    pub depth: DepthRange,
    /// Limits on triangles.
    pub mesh: MeshLimits,
}

impl Limits {
    /// Checks every limit.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the first limit that cannot work.
    pub fn validate(&self) -> Result<(), LightError> {
        self.mask.validate()?;
        self.depth.validate()?;
        self.mesh.validate()
    }
}
