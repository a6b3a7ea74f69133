//! Parameterization: conformal disk maps, Möbius transformations, warps between disks, point location.

mod angle_error;
mod conformal_factor;
pub mod disk;
mod harmonic;
pub mod locate;
pub mod matching;
pub mod mobius;
pub mod sphere;
pub mod thin_plate;

pub use angle_error::{AngleErrors, HISTOGRAM_BOUNDS_DEG};
pub use conformal_factor::conformal_factors;
