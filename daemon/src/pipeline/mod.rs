//! From frames to scans to a session.

pub mod board_views;
mod capture;
mod degrade;
mod encode_stage;
mod flow;
pub mod frame_set;
mod latency;
pub mod monitor;
mod picture_stage;
pub mod raw;
pub mod reconstruct;
mod reconstruct_stage;
pub mod record;
pub mod recording;
mod stages;
pub mod still;
#[cfg(test)]
pub(crate) mod test_rig;
mod write_stage;

pub use board_views::{BoardViewError, read_board_view, read_board_views, simulate_board_views};
pub use degrade::Degradation;
pub use flow::Ended;
pub use frame_set::{DropCounts, FrameSet, FrameSetAssembler};
pub use latency::LatencySummary;
pub use monitor::Monitor;
pub use raw::{RawRecorded, RawRecorder, RawSets, RawTap};
pub use reconstruct::{PhaseMaps, Reconstruction, Reconstructor};
pub use record::{RecordError, RecordSettings, Recorded, record};
pub use recording::{Closed, GroupSink, Progress, Recording, SegmentLimits};
pub use stages::{Pipeline, PipelineSettings, QueueDepths, QueueGauge};
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
