//! Coding of a motion against its prediction: pose steps, then the lattice levels that have any.

use super::descent::{Coefficients, active};
use super::frames::{Frame, to_space};
use super::lattice::{LEVEL_SIDES, refine};
use super::motion::Motion;
use crate::Result;
use crate::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};

/// Correction of a motion.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Correction {
    /// Turn, then shift in pose steps.
    pub pose: [i32; 6],
    /// Coefficients of each level; empty where there are none.
    pub levels: [Coefficients; 3],
}

/// Steps of motions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MotionSteps {
    /// Of the quaternion's vector part.
    pub turn: i32,
    /// Of the shift, units.
    pub shift: i32,
    /// Of the lattice along normals and tangents, units.
    pub lattice: [i32; 3],
}

/// Largest coefficient.
const MAX_COEFFICIENT: i32 = 1 << 15;

#[derive(Debug, Clone, Default)]
struct Models<const N: usize> {
    zero: [BitModel; 4],
    magnitude: Vec<BitModel>,
    sign: BitModel,
}

/// What the coder has learned of motions.
#[derive(Debug, Clone)]
pub struct MotionModels {
    pose: [Models<1>; 2],
    empty: [BitModel; 3],
    lattice: Vec<Models<4>>,
}

impl Default for MotionModels {
    fn default() -> Self {
        let models = || Models { magnitude: vec![BitModel::default(); 8], ..Models::default() };
        let pose = [0, 1].map(|_| Models { magnitude: vec![BitModel::default(); 8], ..Models::default() });
        Self { pose, empty: [BitModel::default(); 3], lattice: (0..6).map(|_| models()).collect() }
    }
}

impl Correction {
    /// The corrected motion.
    pub fn apply(&self, predicted: &Motion, frames: &[Vec<Frame>; 3], steps: &MotionSteps) -> Motion {
        let mut motion = predicted.clone();
        for c in 0..3 {
            motion.pose.turn[c] += self.pose[c] * steps.turn;
            motion.pose.shift[c] += self.pose[3 + c] * steps.shift;
        }
        let mut nodes = vec![[0; 3]; LEVEL_SIDES[0] * LEVEL_SIDES[0]];
        for (level, side) in LEVEL_SIDES.into_iter().enumerate() {
            if level > 0 {
                nodes = refine(&nodes, LEVEL_SIDES[level - 1]);
            }
            debug_assert_eq!(nodes.len(), side * side);
            for ((n, q), frame) in nodes.iter_mut().zip(&self.levels[level]).zip(&frames[level]) {
                if *q != [0; 3] {
                    let v = to_space(frame, steps.lattice, *q);
                    *n = [0, 1, 2].map(|c| n[c] + v[c]);
                }
            }
        }
        for (n, d) in motion.nodes.iter_mut().zip(&nodes) {
            *n = [0, 1, 2].map(|c| n[c] + d[c]);
        }
        motion
    }

    /// Codes the correction.
    pub fn encode(&self, out: &mut RangeEncoder, models: &mut MotionModels) {
        for (i, v) in self.pose.iter().enumerate() {
            let m = &mut models.pose[i / 3];
            out.signed(&mut m.magnitude, &mut m.sign, *v);
        }
        for (level, side) in LEVEL_SIDES.into_iter().enumerate() {
            let q = &self.levels[level];
            let any = q.iter().any(|q| *q != [0; 3]);
            out.bit(&mut models.empty[level], any);
            if !any {
                continue;
            }
            for node in (0..side * side).filter(|n| active(*n, side)) {
                for channel in 0..3 {
                    let m = &mut models.lattice[level * 2 + channel.min(1)];
                    let (v, near) = (q[node][channel], near(q, side, node, channel));
                    out.bit(&mut m.zero[near], v != 0);
                    if v != 0 {
                        out.number(&mut m.magnitude, v.unsigned_abs() - 1);
                        out.bit(&mut m.sign, v < 0);
                    }
                }
            }
        }
    }

    /// Reads a correction.
    ///
    /// # Errors
    /// [`crate::CodecError::Payload`] for numbers out of range.
    pub fn decode(reader: &mut RangeDecoder<'_>, models: &mut MotionModels) -> Result<Self> {
        let mut correction = Self::default();
        for (i, v) in correction.pose.iter_mut().enumerate() {
            let m = &mut models.pose[i / 3];
            *v = reader.signed(&mut m.magnitude, &mut m.sign)?;
            if v.abs() > MAX_COEFFICIENT {
                return Err(reader.error("a pose step out of range"));
            }
        }
        for (level, side) in LEVEL_SIDES.into_iter().enumerate() {
            if !reader.bit(&mut models.empty[level]) {
                continue;
            }
            let mut q = vec![[0; 3]; side * side];
            for node in (0..side * side).filter(|n| active(*n, side)) {
                for channel in 0..3 {
                    let near = near(&q, side, node, channel);
                    let m = &mut models.lattice[level * 2 + channel.min(1)];
                    if reader.bit(&mut m.zero[near]) {
                        let magnitude = reader.number(&mut m.magnitude)?;
                        if magnitude >= MAX_COEFFICIENT as u32 {
                            return Err(reader.error("a lattice coefficient out of range"));
                        }
                        let v = magnitude as i32 + 1;
                        q[node][channel] = if reader.bit(&mut m.sign) { -v } else { v };
                    }
                }
            }
            correction.levels[level] = q;
        }
        Ok(correction)
    }
}

/// How many of the coefficients to the left, above and above to the right are nonzero.
fn near(q: &[[i32; 3]], side: usize, node: usize, channel: usize) -> usize {
    let (x, y) = (node % side, node / side);
    let mut near = 0;
    if x > 0 {
        near += usize::from(q[node - 1][channel] != 0);
    }
    if y > 0 {
        near += usize::from(q[node - side][channel] != 0);
        near += usize::from(x + 1 < side && q[node - side + 1][channel] != 0);
    }
    near
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn corrections_come_back(seed in 0_u32..100_000, pose in prop::array::uniform6(-300_i32..300), rare in 1_u32..40) {
            let hash = |i: usize| (i as u32 ^ seed.wrapping_mul(747_796_405)).wrapping_mul(2_654_435_761) >> 8;
            let mut correction = Correction { pose, ..Correction::default() };
            for (level, side) in LEVEL_SIDES.into_iter().enumerate().filter(|(l, _)| hash(*l) % 3 > 0) {
                let value = |i: usize| if hash(i) % rare == 0 { (hash(i + 7) % 41) as i32 - 20 } else { 0 };
                let q: Coefficients = (0..side * side)
                    .map(|n| if active(n, side) { [0, 1, 2].map(|c| value(level + 9 * (3 * n + c))) } else { [0; 3] })
                    .collect();
                if q.iter().any(|q| *q != [0; 3]) {
                    correction.levels[level] = q;
                }
            }
            let mut out = RangeEncoder::default();
            correction.encode(&mut out, &mut MotionModels::default());
            let bytes = out.finish();
            let mut reader = RangeDecoder::new(&bytes, "motion");
            prop_assert_eq!(Correction::decode(&mut reader, &mut MotionModels::default()).unwrap(), correction);
            reader.finish().unwrap();
        }
    }
}
