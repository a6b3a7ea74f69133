//! Parameterization: conformal disk maps, Möbius transformations, warps between disks, point location, geodesics, and
//! surfaces as mean curvature and conformal factor.

mod angle_error;
pub mod beltrami;
pub mod clamped_plate;
mod conformal_factor;
pub mod curvature_homotopy;
pub mod curvature_map;
pub mod dirichlet;
pub mod disk;
pub mod geodesic;
pub mod geodesic_partition;
pub mod grid_plate;
mod harmonic;
mod kernel_sum;
pub mod locate;
mod log;
pub mod match_energies;
pub mod matching;
pub mod mobius;
pub mod partition;
pub mod sphere;
pub mod thin_plate;
mod untangle;

pub use angle_error::{AngleErrors, HISTOGRAM_BOUNDS_DEG};
pub use conformal_factor::conformal_factors;
