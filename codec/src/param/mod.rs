//! Parameterization: conformal disk maps, Möbius transformations, warps between disks, point location.

mod conformal_factor;
pub mod disk;
pub mod locate;
pub mod matching;
pub mod mobius;
pub mod thin_plate;

pub use conformal_factor::conformal_factors;
