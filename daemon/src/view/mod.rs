//! Pictures of meshes, side-by-side comparisons and plots of errors, drawn in software.

pub mod checkerboard;
pub mod colour_map;
pub mod compare;
pub mod error_map;
pub mod maps;
pub mod plot;
pub mod rate_plot;
pub mod render;
pub mod residuals;
mod text;
