//! In which order the scans between two keyframes are coded, and from which of them each is predicted.

use super::model::Window;
use super::motion::{Motion, weighted};
use super::seen_scan::SeenScan;
use crate::Result;
use crate::motion::tick_weights::TickWeights;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Coding order of `ticks` (increasing): the one nearest the middle of its gap first, wider gaps before narrower ones, so
/// that most scans have decoded neighbours on both sides. Without a keyframe `after` them they are coded as they came.
/// Returns indices into `ticks`.
pub fn coding_order(ticks: &[u64], before: u64, after: Option<u64>) -> Vec<usize> {
    let Some(after) = after else { return (0..ticks.len()).collect() };
    let mut order = Vec::with_capacity(ticks.len());
    // Gaps as (first index, one past the last index, tick before, tick after), level by level.
    let mut gaps = vec![(0, ticks.len(), before, after)];
    while !gaps.is_empty() {
        let mut finer = Vec::new();
        for (from, to, before, after) in gaps {
            if from == to {
                continue;
            }
            let middle = before + (after - before) / 2;
            let nearest = (from..to).min_by_key(|&i| (ticks[i].abs_diff(middle), i)).unwrap_or(from);
            order.push(nearest);
            finer.push((from, nearest, before, ticks[nearest]));
            finer.push((nearest + 1, to, ticks[nearest], after));
        }
        gaps = finer;
    }
    order
}

/// Where a scan is: its camera's pixels and its model.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Placed {
    /// The camera's pixels.
    pub window: Window,
    /// Where the model is.
    pub motion: Motion,
}

/// Scans decoded so far that share a model, by tick.
#[derive(Debug, Clone, Default)]
pub struct Decoded {
    /// Where scans are: knots of predictions.
    pub placed: BTreeMap<u64, Placed>,
    /// Scans as they are seen: references.
    pub scans: BTreeMap<u64, Arc<SeenScan>>,
}

impl Decoded {
    /// Adds a scan.
    pub fn insert(&mut self, tick: u64, scan: Arc<SeenScan>) {
        self.placed.insert(tick, scan.placed.clone());
        self.scans.insert(tick, scan);
    }

    /// The natural cubic spline through the nearest two motions before a tick and the nearest two after it; the nearest
    /// one where all lie on one side. `None` when there is none at all.
    ///
    /// # Errors
    /// [`crate::CodecError::Stream`] when the ticks lie too far apart.
    pub fn predict(&self, tick: u64) -> Result<Option<Motion>> {
        let mut knots: Vec<(i64, &Motion)> = self.placed.range(..tick).rev().take(2).map(knot).collect();
        knots.reverse();
        knots.extend(self.placed.range(tick..).take(2).map(knot));
        if knots.is_empty() {
            return Ok(None);
        }
        let ticks: Vec<i64> = knots.iter().map(|k| k.0).collect();
        let weights = TickWeights::new(&ticks, tick as i64)?;
        let motions: Vec<&Motion> = knots.iter().map(|k| k.1).collect();
        Ok(Some(weighted(&motions, &weights.numerators, weights.denominator)))
    }

    /// Ticks to the nearest scan that is placed, and its window; the earlier one of two.
    pub fn nearest(&self, tick: u64) -> Option<(u64, Window)> {
        let near = self.placed.range(..tick).next_back().into_iter().chain(self.placed.range(tick..).next());
        near.map(|(t, p)| (t.abs_diff(tick), p.window)).min_by_key(|(distance, _)| *distance)
    }

    /// The nearest scan before and after a tick, the nearer one first.
    pub fn references(&self, tick: u64) -> Vec<&SeenScan> {
        let before = self.scans.range(..tick).next_back();
        let after = self.scans.range(tick..).next();
        let mut found: Vec<(u64, &SeenScan)> =
            before.into_iter().chain(after).map(|(t, s)| (t.abs_diff(tick), &**s)).collect();
        found.sort_by_key(|(distance, _)| *distance);
        found.into_iter().map(|(_, s)| s).collect()
    }
}

fn knot<'a>((tick, placed): (&u64, &'a Placed)) -> (i64, &'a Motion) {
    (*tick as i64, &placed.motion)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_middle_comes_first() {
        let ticks: Vec<u64> = (1..10).collect();
        let order: Vec<u64> = coding_order(&ticks, 0, Some(10)).iter().map(|i| ticks[*i]).collect();
        assert_eq!(order, [5, 2, 7, 1, 3, 6, 8, 4, 9]);
        assert_eq!(coding_order(&ticks, 0, None), [0, 1, 2, 3, 4, 5, 6, 7, 8]);
        assert!(coding_order(&[], 3, Some(4)).is_empty());
    }

    proptest! {
        #[test]
        fn every_scan_once_whatever_the_gaps(steps in prop::collection::vec(1_u64..9, 1..30), last in 1_u64..9) {
            let ticks: Vec<u64> = steps.iter().scan(5, |t, s| { *t += s; Some(*t) }).collect();
            let mut order = coding_order(&ticks, 5, Some(ticks[ticks.len() - 1] + last));
            order.sort_unstable();
            prop_assert!(order.iter().enumerate().all(|(i, o)| i == *o) && order.len() == ticks.len());
        }

        #[test]
        fn straight_motion_is_predicted(a in -500_i32..500, gap in 1_u64..9, at in 0_u64..8) {
            let mut decoded = Decoded::default();
            for k in 0..3_u64 {
                let mut motion = Motion::default();
                motion.pose.shift[0] = a * (k * gap) as i32;
                motion.nodes[7][2] = -3 * a * (k * gap) as i32;
                decoded.placed.insert(k * gap, Placed { motion, ..Placed::default() });
            }
            let tick = at.min(2 * gap);
            let predicted = decoded.predict(tick).unwrap().unwrap();
            prop_assert_eq!(predicted.pose.shift[0], a * tick as i32);
            prop_assert_eq!(predicted.nodes[7][2], -3 * a * tick as i32);
        }
    }

    #[test]
    fn nothing_is_predicted_from_nothing_and_the_end_is_held() {
        let mut decoded = Decoded::default();
        assert!(decoded.predict(4).unwrap().is_none() && decoded.references(4).is_empty());
        let mut motion = Motion::default();
        motion.pose.turn = [1, 2, 3];
        decoded.placed.insert(3, Placed { motion: motion.clone(), ..Placed::default() });
        assert_eq!(decoded.predict(9).unwrap().unwrap(), motion);
    }
}
