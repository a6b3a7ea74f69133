//! How phases become coordinates, beyond what the pattern sequence itself says.

use super::GammaTable;
use serde::{Deserialize, Serialize};

/// How fringe orders are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Unwrap {
    /// By the sequence: Gray code, coarser fringes, beats; what those leave open, by the working range.
    #[default]
    Auto,
    /// One burst and the working range, see [`super::geometric`]: three pictures a scan.
    Geometric,
    /// One burst, pixel by pixel over the picture, see [`super::spatial`]; pieces of surface whose place in depth the working
    /// range does not settle are left out.
    Spatial,
}

/// What is done about motion between the pictures of a frame set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MotionCorrection {
    /// Nothing.
    #[default]
    None,
    /// Phases are solved with the rate of change since the frame set before, see [`super::motion`].
    PhaseRate,
}

/// Choices of a rig or of one reconstruction.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Processing {
    /// How fringe orders are found.
    pub unwrap: Unwrap,
    /// What is done about motion; needs consecutive frame sets.
    pub motion: MotionCorrection,
    /// Phase errors of the projector's response, taken away from every phase.
    pub gamma: Option<GammaTable>,
}
