//! One set of patterns that no scan needs: grey levels one after the other, and fringes both ways.

use super::look::Look;
use crate::device::{Backend, RigConfig};
use crate::light::{Direction, Pattern, PatternSequence};
use gv3_codec::GreyPicture;

/// Pictures of the ramp: a sinusoid so long that all of the projector has one level, in even steps of its phase. Nine levels,
/// down and up again.
pub(super) const RAMP: usize = 16;
/// Period of the ramp's sinusoid; it changes by less than a thousandth of a level over the widest projector.
const RAMP_PERIOD_PX: f64 = 1e9;
/// Fringes: the finest period, and from period to period.
const FINEST_PX: f64 = 24.0;
const RATIO: f64 = 8.0;
const STEPS: u32 = 3;

/// Pictures of the test patterns, or why there are none.
pub(super) struct TestPictures {
    pub sequence: PatternSequence,
    pub pictures: Result<Vec<GreyPicture>, String>,
}

impl TestPictures {
    /// Opens the rig and takes one set.
    pub fn take(config: &RigConfig) -> Self {
        let size_px = [config.sequence.width_px, config.sequence.height_px];
        let sequence = test_sequence(size_px);
        let stored = match config.projector.backend {
            Backend::Dlpc350 => Some("the projector shows only what is stored in it"),
            Backend::Recorded => Some("a recording shows only what was recorded"),
            _ => None,
        };
        let pictures = stored.map_or_else(|| look(config, &sequence), |reason| Err(reason.into()));
        Self { sequence, pictures }
    }

    /// Level of the ramp's picture `i` as projected, 0..=255.
    pub fn ramp_level(&self, i: usize) -> f64 {
        f64::from(self.sequence.patterns[i].levels(1)[0])
    }

    /// The fringes without the ramp.
    pub fn fringes(&self) -> PatternSequence {
        PatternSequence { patterns: self.sequence.patterns[RAMP..].to_vec(), ..self.sequence.clone() }
    }
}

fn test_sequence(size_px: [u32; 2]) -> PatternSequence {
    let mut sequence = PatternSequence::n_step(size_px, Direction::Columns, RAMP_PERIOD_PX, RAMP as u32);
    for direction in [Direction::Columns, Direction::Rows] {
        let fringes: Vec<Pattern> = PatternSequence::hierarchical(size_px, direction, FINEST_PX, RATIO, STEPS).patterns;
        sequence.patterns.extend(fringes);
    }
    sequence
}

fn look(config: &RigConfig, sequence: &PatternSequence) -> Result<Vec<GreyPicture>, String> {
    let mut config = config.clone();
    config.sequence = sequence.clone();
    // Faults of the simulator name pictures of the rig's own sequence.
    config.sim.faults.retain(|fault| (fault.picture as usize) < sequence.patterns.len());
    let mut look = Look::at(&config, 1).map_err(|error| error.to_string())?;
    match look.sets.pop() {
        Some(set) => Ok(set.frames.into_iter().map(|frame| frame.picture).collect()),
        None => Err(look.ended_by.unwrap_or_else(|| format!("its only set was dropped: {:?}", look.drops))),
    }
}
