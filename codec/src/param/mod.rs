//! Parameterization: conformal disk maps, Möbius transformations, warps between disks, point location.

pub mod beltrami;
pub mod clamped_plate;
pub mod dirichlet;
pub mod disk;
pub mod grid_plate;
pub mod intrinsic;
pub mod locate;
mod log;
pub mod matching;
pub mod mobius;
pub mod thin_plate;
