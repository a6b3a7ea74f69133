//! The simulated projector.

use super::{Shown, SimWorld};
use crate::device::{DeviceError, PatternIndex, Projector, ProjectorInfo, SequenceTiming};
use crate::light::PatternSequence;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Projector of a simulated world.
pub struct SimProjector {
    world: Arc<Mutex<SimWorld>>,
}

impl SimProjector {
    /// The projector of a world.
    pub fn new(world: Arc<Mutex<SimWorld>>) -> Self {
        Self { world }
    }

    fn world(&self) -> MutexGuard<'_, SimWorld> {
        self.world.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Projector for SimProjector {
    fn info(&self) -> ProjectorInfo {
        let [width_px, height_px] = self.world().projector_size_px;
        ProjectorInfo {
            model: "simulated projector".into(),
            serial: "sim-projector-1".into(),
            width_px,
            height_px,
            min_period_nanos: 5_000_000,
            hardware_sequence: true,
        }
    }

    fn load(&mut self, sequence: &PatternSequence) -> Result<(), DeviceError> {
        sequence.validate()?;
        let mut world = self.world();
        if [sequence.width_px, sequence.height_px] != world.projector_size_px {
            let [width, height] = world.projector_size_px;
            let reason =
                format!("{} x {}, but the projector has {width} x {height}", sequence.width_px, sequence.height_px);
            return Err(DeviceError::config("sequence.width_px", reason));
        }
        world.load(sequence);
        Ok(())
    }

    fn play(&mut self, timing: &SequenceTiming) -> Result<(), DeviceError> {
        timing.validate()?;
        if timing.picture_period_nanos < self.info().min_period_nanos {
            let reason = format!("{} is shorter than a pattern can be shown", timing.picture_period_nanos);
            return Err(DeviceError::config("timing.picture_period_nanos", reason));
        }
        let mut world = self.world();
        if world.patterns.is_empty() {
            return Err(DeviceError::State("the projector plays before a sequence is loaded"));
        }
        world.shown = Shown::Playing { timing: *timing, start_nanos: world.clock_nanos };
        world.triggers = 0;
        world.repeats.clear();
        Ok(())
    }

    fn show(&mut self, pattern: PatternIndex) -> Result<(), DeviceError> {
        let mut world = self.world();
        if usize::from(pattern.0) >= world.patterns.len() {
            return Err(DeviceError::State("the projector shows a pattern that is not loaded"));
        }
        world.shown = Shown::Still(pattern);
        Ok(())
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.world().shown = Shown::Dark;
        Ok(())
    }
}
