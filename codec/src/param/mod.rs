//! Parameterization: conformal disk maps, Möbius transformations, warps between disks, point location.

pub mod disk;
pub mod intrinsic;
pub mod locate;
pub mod matching;
pub mod mobius;
pub mod thin_plate;
