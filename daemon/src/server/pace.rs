//! How often a viewer gets the newest.

use super::problem::Problem;
use std::time::Duration;
use tokio::time::{Instant, sleep_until};

/// Messages a second without `fps`.
const USUAL_FPS: f64 = 10.0;
/// Fewest and most messages a second.
const FPS_LIMITS: std::ops::RangeInclusive<f64> = 0.1..=60.0;

/// The rate asked for.
///
/// # Errors
/// [`Problem`] 400 outside 0.1 to 60.
pub fn fps_limited(fps: Option<f64>) -> Result<f64, Problem> {
    let fps = fps.unwrap_or(USUAL_FPS);
    FPS_LIMITS.contains(&fps).then_some(fps).ok_or_else(|| Problem::bad_request("fps: from 0.1 to 60"))
}

/// The times at which one viewer gets messages.
#[derive(Debug)]
pub struct Pace {
    period: Duration,
    due: Instant,
    count: u32,
}

impl Pace {
    /// So many a second, the first at once.
    pub fn new(fps: f64) -> Self {
        Self { period: Duration::from_secs_f64(1.0 / fps), due: Instant::now(), count: 0 }
    }

    /// Waits until the next may go.
    pub async fn wait(&self) {
        sleep_until(self.due).await;
    }

    /// One goes now.
    pub fn taken(&mut self) {
        self.count = self.count.wrapping_add(1);
        // Late ones are not made up for.
        self.due = (self.due + self.period).max(Instant::now());
    }

    /// Messages so far.
    pub fn count(&self) -> u32 {
        self.count
    }
}
