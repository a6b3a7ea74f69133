//! From frames to scans to a session.

pub mod frame_set;
pub mod record;
pub mod reconstruct;

pub use frame_set::{DropCounts, FrameSet, FrameSetAssembler};
pub use record::{RecordError, RecordSettings, Recorded, record};
pub use reconstruct::{Reconstruction, Reconstructor};
