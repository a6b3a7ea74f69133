//! What a projector says it showed, and when.

use super::{DeviceError, PatternIndex};
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Exposures that wait to be read: six seconds of the fastest camera.
const QUEUE: usize = 1024;

/// One exposure as the projector counted it: what a frame must agree with to belong to its pattern.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exposure {
    /// Triggers since the run began, from 0; 0 again when the projector began anew after it was unplugged.
    pub sequence: u64,
    /// Frame sets since the run began, from 0.
    pub set: u64,
    /// Pattern shown.
    pub pattern: PatternIndex,
    /// Middle of the exposure on the projector's clock, nanoseconds.
    pub device_time_nanos: u64,
    /// Length of the exposure, nanoseconds.
    pub exposure_nanos: u64,
}

/// The exposures of a projector, in order, and which of its runs they are of. Clones read from the same queue; when nobody reads,
/// the oldest give way.
#[derive(Debug, Clone, Default)]
pub struct ExposureFeed(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    queue: Mutex<Queue>,
    is_new: Condvar,
    /// Tells of runs only.
    is_silent: bool,
}

#[derive(Debug, Default)]
struct Queue {
    exposures: VecDeque<Exposure>,
    lost: u64,
    runs: u64,
}

impl ExposureFeed {
    /// Of a projector that tells when it begins anew, but of no exposure.
    pub(super) fn silent() -> Self {
        Self(Arc::new(Shared { is_silent: true, ..Shared::default() }))
    }

    /// Whether exposures are reported at all.
    pub fn tells_exposures(&self) -> bool {
        !self.0.is_silent
    }

    /// A number that changes with every run: when the projector begins to play, before its first light, be it that it was
    /// told to or that it was unplugged meanwhile, and when it is found to be gone.
    pub fn runs(&self) -> u64 {
        self.queue().runs
    }

    /// The exposures that are there, with the run they are all of.
    pub(super) fn take(&self) -> (u64, VecDeque<Exposure>) {
        let mut queue = self.queue();
        (queue.runs, std::mem::take(&mut queue.exposures))
    }

    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.0.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for the next exposure.
    ///
    /// # Errors
    /// [`DeviceError::Timeout`] when none came before `deadline`.
    pub fn next(&self, deadline: Instant) -> Result<Exposure, DeviceError> {
        let queue = self.queue();
        let wait = deadline.saturating_duration_since(Instant::now());
        let (mut queue, _) = self
            .0
            .is_new
            .wait_timeout_while(queue, wait, |queue| queue.exposures.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        queue.exposures.pop_front().ok_or_else(|| DeviceError::Timeout("the projector reported no exposure".into()))
    }

    /// Exposures of this run that were shown but not reported, or that nobody read in time.
    pub fn lost(&self) -> u64 {
        self.queue().lost
    }

    /// A run begins: what is left of the one before is of no use. Gives the run's number.
    pub(super) fn begin(&self) -> u64 {
        let mut queue = self.queue();
        *queue = Queue { runs: queue.runs + 1, ..Queue::default() };
        queue.runs
    }

    /// The projector is gone, and with it its run.
    pub(super) fn end(&self) {
        self.begin();
    }

    /// An exposure of a run was reported.
    pub(super) fn push(&self, run: u64, exposure: Exposure) {
        let mut queue = self.queue();
        // Of the run before, still on its way.
        if run != queue.runs {
            return;
        }
        if queue.exposures.len() == QUEUE {
            queue.exposures.pop_front();
            queue.lost += 1;
        }
        queue.exposures.push_back(exposure);
        self.0.is_new.notify_one();
    }

    /// Exposures went unreported.
    pub(super) fn lose(&self, count: u64) {
        self.queue().lost += count;
    }
}
