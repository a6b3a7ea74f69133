//! From frames to scans to a session.

pub mod frame_set;
pub mod raw;
pub mod reconstruct;
pub mod record;
pub mod still;

pub use frame_set::{DropCounts, FrameSet, FrameSetAssembler};
pub use raw::{RawRecorded, RawRecorder, RawSets};
pub use reconstruct::{Reconstruction, Reconstructor};
pub use record::{RecordError, RecordSettings, Recorded, record};
pub use still::StillReconstructor;
