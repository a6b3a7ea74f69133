//! From frames to scans.

pub mod frame_set;
pub mod reconstruct;

pub use frame_set::{DropCounts, FrameSet, FrameSetAssembler};
pub use reconstruct::{Reconstruction, Reconstructor};
