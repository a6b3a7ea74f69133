//! What a projector says it showed, and when.

use super::{DeviceError, PatternIndex};
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
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

/// The exposures of a projector, in order. Clones read from the same queue; when nobody reads, the oldest give way.
#[derive(Debug, Clone, Default)]
pub struct ExposureFeed(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    queue: Mutex<Queue>,
    is_new: Condvar,
}

#[derive(Debug, Default)]
struct Queue {
    exposures: VecDeque<Exposure>,
    lost: u64,
}

impl ExposureFeed {
    /// Waits for the next exposure.
    ///
    /// # Errors
    /// [`DeviceError::Timeout`] when none came before `deadline`.
    pub fn next(&self, deadline: Instant) -> Result<Exposure, DeviceError> {
        let queue = self.0.queue.lock().unwrap_or_else(PoisonError::into_inner);
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
        self.0.queue.lock().unwrap_or_else(PoisonError::into_inner).lost
    }

    /// A run begins: what is left of the one before is of no use.
    pub(super) fn begin(&self) {
        *self.0.queue.lock().unwrap_or_else(PoisonError::into_inner) = Queue::default();
    }

    /// An exposure was reported.
    pub(super) fn push(&self, exposure: Exposure) {
        let mut queue = self.0.queue.lock().unwrap_or_else(PoisonError::into_inner);
        if queue.exposures.len() == QUEUE {
            queue.exposures.pop_front();
            queue.lost += 1;
        }
        queue.exposures.push_back(exposure);
        self.0.is_new.notify_one();
    }

    /// Exposures went unreported.
    pub(super) fn lose(&self, count: u64) {
        self.0.queue.lock().unwrap_or_else(PoisonError::into_inner).lost += count;
    }
}
