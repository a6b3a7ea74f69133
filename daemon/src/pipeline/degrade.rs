//! What is left out when the encoder cannot keep up, in a stated order: first the correction of scans between keyframes, then
//! these scans; a keyframe never.

use serde::Serialize;
use std::time::{Duration, Instant};

/// What is left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Degradation {
    /// Nothing.
    #[default]
    None,
    /// Scans between keyframes are followed but not corrected.
    NoBetweenCorrection,
    /// Scans between keyframes are neither triangulated nor coded.
    NoBetweenScans,
}

impl Degradation {
    const ALL: [Self; 3] = [Self::None, Self::NoBetweenCorrection, Self::NoBetweenScans];

    /// As in the status.
    pub fn name(self) -> &'static str {
        ["none", "no_between_correction", "no_between_scans"][self as usize]
    }

    /// The reverse of `as u8`.
    pub(super) fn of(level: u8) -> Self {
        Self::ALL[usize::from(level).min(2)]
    }
}

/// Shares of the queue before the encoder at which the next level is entered.
const ENTER: [f64; 2] = [0.5, 0.875];
/// Share at or below which the encoder keeps up.
const CALM: f64 = 0.35;
/// How long it must keep up before scans between are taken again: soon, since none comes back.
const SHORT_CALM_TIME: Duration = Duration::from_secs(1);
/// How long before they are corrected again.
const CALM_TIME: Duration = Duration::from_secs(3);
/// Corrections left out again within this time of their return take twice as long to return.
const RELAPSE_TIME: Duration = Duration::from_secs(10);
/// Longest time to their return.
const MOST_CALM_TIME: Duration = Duration::from_secs(48);

/// Chooses the level by the queue before the encoder; up at once, down after some calm.
#[derive(Debug)]
pub(super) struct Degrader {
    level: Degradation,
    calm_since: Option<Instant>,
    calm_time: Duration,
    left: Option<Instant>,
}

impl Degrader {
    pub fn new() -> Self {
        Self { level: Degradation::None, calm_since: None, calm_time: CALM_TIME, left: None }
    }

    /// The level now that the queue is filled to `share` of its room.
    pub fn update(&mut self, now: Instant, share: f64) -> Degradation {
        let wanted = Degradation::of(ENTER.iter().filter(|enter| share >= **enter).count() as u8);
        if wanted > self.level {
            // Times are those of the first level.
            let is_relapse = self.left.is_some_and(|left| now.duration_since(left) < RELAPSE_TIME);
            self.calm_time = if is_relapse { (2 * self.calm_time).min(MOST_CALM_TIME) } else { self.calm_time };
            (self.level, self.calm_since, self.left) = (wanted, None, None);
        } else if share > CALM {
            self.calm_since = None;
        } else if self.level > Degradation::None
            && now.duration_since(*self.calm_since.get_or_insert(now)) >= self.needed()
        {
            self.level = Degradation::of(self.level as u8 - 1);
            (self.calm_since, self.left) = (Some(now), Some(now).filter(|_| self.level == Degradation::None));
        } else if self.left.is_some_and(|left| now.duration_since(left) >= MOST_CALM_TIME) {
            (self.calm_time, self.left) = (CALM_TIME, None);
        }
        self.level
    }

    fn needed(&self) -> Duration {
        if self.level == Degradation::NoBetweenScans { SHORT_CALM_TIME } else { self.calm_time }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Levels at the end of each stretch of (seconds, share), a step every 50 ms.
    fn levels(stretches: &[(u64, f64)]) -> Vec<Degradation> {
        let (mut degrader, mut now) = (Degrader::new(), Instant::now());
        let mut level_after = |&(seconds, share): &(u64, f64)| {
            let mut level = Degradation::None;
            for _ in 0..=seconds * 20 {
                now += Duration::from_millis(50);
                level = degrader.update(now, share);
            }
            level
        };
        stretches.iter().map(&mut level_after).collect()
    }

    #[test]
    fn up_at_once_and_in_order_down_one_by_one_after_calm() {
        use Degradation::{NoBetweenCorrection, NoBetweenScans, None};
        let stretches = [(0, 0.4), (0, 0.55), (0, 0.9), (2, 0.1), (1, 0.1), (3, 0.0), (1, 0.5)];
        let expected = [
            None,
            NoBetweenCorrection,
            NoBetweenScans,
            NoBetweenCorrection,
            NoBetweenCorrection,
            None,
            NoBetweenCorrection,
        ];
        assert_eq!(levels(&stretches), expected);
    }

    #[test]
    fn between_the_marks_nothing_changes() {
        assert_eq!(levels(&[(30, 0.45)]), [Degradation::None]);
        assert_eq!(levels(&[(0, 0.9), (60, 0.45)])[1], Degradation::NoBetweenScans);
    }

    #[test]
    fn relapses_take_longer_and_longer_to_leave() {
        // Down and at once up again: 3 s, then 6 s.
        let [.., before, after] = levels(&[(0, 0.6), (4, 0.0), (0, 0.6), (5, 0.0), (2, 0.0)])[..] else { panic!() };
        assert_eq!((before, after), (Degradation::NoBetweenCorrection, Degradation::None));
        // A long quiet time makes it quick again.
        let [.., last] = levels(&[(0, 0.6), (4, 0.0), (0, 0.6), (100, 0.0), (0, 0.6), (4, 0.0)])[..] else { panic!() };
        assert_eq!(last, Degradation::None);
    }
}
