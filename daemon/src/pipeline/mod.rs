//! From frames to scans to a session.

pub mod board_views;
mod capture;
pub mod frame_set;
pub mod raw;
pub mod reconstruct;
pub mod record;
pub mod still;

pub use board_views::{BoardViewError, read_board_view, read_board_views, simulate_board_views};
pub use frame_set::{DropCounts, FrameSet, FrameSetAssembler};
pub use raw::{RawRecorded, RawRecorder, RawSets};
pub use reconstruct::{Reconstruction, Reconstructor};
pub use record::{RecordError, RecordSettings, Recorded, record};
pub use still::StillReconstructor;

use crate::light::{Calibration, LightError, Limits, PatternSequence};

/// Calibration, patterns and limits are sound, and patterns and calibration are for the same projector.
fn check_rig(calibration: &Calibration, sequence: &PatternSequence, limits: &Limits) -> Result<(), LightError> {
    calibration.validate()?;
    sequence.validate()?;
    limits.validate()?;
    let [width, height] = [calibration.projector.width_px, calibration.projector.height_px];
    if [sequence.width_px, sequence.height_px] == [width, height] {
        return Ok(());
    }
    let found = format!("{} x {}", sequence.width_px, sequence.height_px);
    let reason = format!("{found}, but the calibration's projector has {width} x {height}");
    Err(LightError::field("sequence.width_px", reason))
}
