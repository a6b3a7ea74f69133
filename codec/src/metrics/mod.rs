//! How far replayed scans are from the scans that came in: distances both ways, normals, coverage, texture; and, where
//! it is known, from the truth and its points.
//!
//! Distances run from points to the other surface, not to its vertices, so that they do not depend on how finely the
//! other side is triangulated: from every vertex of the scan, and from samples spread evenly over the replay's area.
//! Both directions are needed: the first sees what the replay lacks, the second what it makes up.

mod area_samples;
mod compare;
mod comparisons;
mod distortion;
mod drift;
mod error_histogram;
mod normal_error;
mod truth;

pub use area_samples::{AreaSample, AreaSamples};
pub use compare::{ScanComparison, compare};
pub use comparisons::Comparisons;
pub use distortion::{Distortion, PlaneError, Share, TextureError};
pub use drift::{ANCHOR_LIMIT_MM, Drift};
pub use error_histogram::{ErrorHistogram, SurfaceErrors};
pub use normal_error::NormalError;
pub use truth::TruthComparison;

/// Farther than this from the other surface, a point counts as missing or invented, millimetres.
pub const COVERAGE_LIMIT_MM: f32 = 2.0;
