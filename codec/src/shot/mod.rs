//! The default mode: shots on the conformal disk, moved by B-spline lattices, corrected in the camera's view.
//!
//! Everything that something else is predicted from is an integer: lengths in units of 1/256 mm, pixels in 1/256 px.

pub mod anchors;
pub mod as_scan;
pub mod base;
pub mod base_fit;
pub mod bisection;
pub mod block_transform;
pub mod camera;
pub mod carry;
pub mod change;
pub mod crop;
pub mod descent;
pub mod encoder;
pub mod fit;
pub mod frames;
pub mod group;
pub mod lattice;
pub mod link;
pub mod mask;
pub mod model;
pub mod motion;
pub mod motion_code;
pub mod order;
pub mod outliers;
pub mod patches;
pub mod pictures;
pub mod player;
pub mod pose;
pub mod raster;
pub mod reciprocal;
pub mod register;
pub mod scan_code;
pub mod scan_image;
pub mod seen_scan;
pub mod steps;
pub mod textures;
pub mod tracked;
pub mod view;

/// Integer units of length a millimetre.
pub const UNITS_PER_MM: i32 = 256;
