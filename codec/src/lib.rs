//! Mesh-video codec: scans in, group payloads out, and back again at any moment in time.
//!
//! Same input, same bytes. No input or output beyond byte slices, no threads of its own making, no clock.
#![forbid(unsafe_code)]

mod error;
pub mod mesh;
pub mod motion;
mod picture;
mod scan;
pub mod texture;

pub use error::{CodecError, Result};
pub use picture::GreyPicture;
pub use scan::Scan;
