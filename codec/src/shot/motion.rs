//! Where a shot's base is at one scan: a rigid pose and a displacement lattice.

use super::base::Base;
use super::bisection::Connectivity;
use super::lattice::{Across, FINE_SIDE, GRID_SIDE, Nodes};
use super::pose::{MAX_SHIFT, MAX_TURN, Pose};
use super::reciprocal::Reciprocal;

/// Fraction bits of lattice nodes below a unit.
pub const NODE_BITS: u32 = 4;

/// Pose and lattice of one scan.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Motion {
    /// Applied after the lattice.
    pub pose: Pose,
    /// Finest level, displacement of the base in 1/16 units.
    pub nodes: Nodes,
}

impl Default for Motion {
    fn default() -> Self {
        Self { pose: Pose::default(), nodes: vec![[0; 3]; FINE_SIDE * FINE_SIDE] }
    }
}

/// Farthest node, 1/16 units: 16 m.
const MAX_NODE: i32 = 1 << 26;
/// Farthest mean of motions: uneven ticks can throw a spline far out, and a correction is added to it.
const MAX_MEAN: i32 = 1 << 29;

impl Motion {
    /// True when no later step overflows.
    pub fn in_range(&self) -> bool {
        let within = |v: &[i32; 3], most: i32| v.iter().all(|c| (-most..=most).contains(c));
        within(&self.pose.turn, MAX_TURN)
            && within(&self.pose.shift, MAX_SHIFT)
            && self.nodes.iter().all(|n| within(n, MAX_NODE))
    }

    /// All grid nodes of a base moved, units.
    pub fn grid_positions(&self, base: &Base) -> Vec<[i32; 3]> {
        let all = Connectivity { nodes: (0..(GRID_SIDE * GRID_SIDE) as u32).collect(), triangles: Vec::new() };
        self.positions(base, &all)
    }

    /// The base's vertices moved, units.
    pub fn positions(&self, base: &Base, connectivity: &Connectivity) -> Vec<[i32; 3]> {
        let shift = Across::new(&self.nodes);
        let pose = self.pose.matrix();
        let half = 1 << (NODE_BITS - 1);
        let moved = |&n: &u32| {
            let (p, d) = (base.positions[n as usize], shift.at(n as usize % GRID_SIDE, n as usize / GRID_SIDE));
            let along = |c: usize| p[c] + ((d[c] + half) >> NODE_BITS);
            pose.apply([along(0), along(1), along(2)])
        };
        connectivity.nodes.iter().map(moved).collect()
    }
}

/// A weighted mean of motions, `weights` over a common denominator, rounded to the nearest, halves up.
///
/// # Panics
/// When there is not one motion a weight, or the denominator is not positive.
pub fn weighted(motions: &[&Motion], weights: &[i64], denominator: i64) -> Motion {
    assert!(motions.len() == weights.len() && denominator > 0, "a weight a motion over a positive denominator");
    // Values within 2^27 (pose and nodes of any motion): sums of 64 bits hold small weights, which all but far ones are.
    let is_small = weights.iter().all(|w| w.unsigned_abs() < 1 << 32) && weights.len() <= 4 && denominator < 1 << 32;
    let by = Reciprocal::new(denominator);
    let mean = |values: &mut dyn Iterator<Item = i32>| {
        if is_small {
            let sum: i64 = values.zip(weights).map(|(v, w)| i64::from(v) * w).sum();
            return by.floor(sum + denominator / 2).clamp(-i64::from(MAX_MEAN), i64::from(MAX_MEAN)) as i32;
        }
        let sum: i128 = values.zip(weights).map(|(v, w)| i128::from(v) * i128::from(*w)).sum();
        let mean = (sum + i128::from(denominator) / 2).div_euclid(i128::from(denominator));
        mean.clamp(-i128::from(MAX_MEAN), i128::from(MAX_MEAN)) as i32
    };
    let pose = Pose {
        turn: [0, 1, 2].map(|c| mean(&mut motions.iter().map(|m| m.pose.turn[c]))),
        shift: [0, 1, 2].map(|c| mean(&mut motions.iter().map(|m| m.pose.shift[c]))),
    };
    let node = |i: usize| [0, 1, 2].map(|c| mean(&mut motions.iter().map(|m| m.nodes[i][c])));
    Motion { pose, nodes: (0..FINE_SIDE * FINE_SIDE).map(node).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turned(by: i32) -> Motion {
        Motion { pose: Pose { turn: [by, -by, 0], shift: [by; 3] }, ..Motion::default() }
    }

    #[test]
    fn means_round_halves_up_and_end_at_the_limit() {
        let (a, b) = (turned(1), turned(2));
        assert_eq!(weighted(&[&a, &b], &[1, 1], 2).pose, Pose { turn: [2, -1, 0], shift: [2; 3] });
        let far = weighted(&[&turned(MAX_SHIFT), &turned(-MAX_SHIFT)], &[1 << 40, 1 - (1 << 40)], 1);
        assert_eq!(far.pose, Pose { turn: [MAX_MEAN, -MAX_MEAN, 0], shift: [MAX_MEAN; 3] });
        assert!(!far.in_range() && turned(MAX_TURN).in_range() && !turned(MAX_TURN + 1).in_range());
    }

    #[test]
    fn sixteenths_of_units_are_rounded_before_the_pose() {
        let base = Base { positions: vec![[100, 0, -3]; GRID_SIDE * GRID_SIDE], normals: Vec::new() };
        let nodes = vec![[7, 8, -9]; FINE_SIDE * FINE_SIDE];
        let motion = Motion { pose: Pose { turn: [0; 3], shift: [1, 2, 3] }, nodes };
        assert_eq!(motion.grid_positions(&base)[77], [101, 3, -1]);
    }
}
