//! From frames to scans to a session.

pub mod board_views;
pub mod frame_set;
pub mod reconstruct;
pub mod record;
pub mod still;

pub use board_views::{BoardViewError, read_board_view, read_board_views, simulate_board_views};
pub use frame_set::{DropCounts, FrameSet, FrameSetAssembler};
pub use reconstruct::{Reconstruction, Reconstructor};
pub use record::{RecordError, RecordSettings, Recorded, record};
pub use still::StillReconstructor;
