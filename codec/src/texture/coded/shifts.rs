//! A correction of where pixels come from: shifts at the nodes of a coarse grid, bilinear in between.
//!
//! What moves the surface is found from its shape; along the surface it may be off by a pixel, which the picture shows.

use super::mixing::{Coder, Contexts, Mixer};
use super::offsets::{BLOCK, NOWHERE, Offsets};

/// Pixels between nodes, a power of two.
pub const SPACING: usize = 1 << SPACING_BITS;
const SPACING_BITS: u32 = 4;
/// Fraction bits of a node's shift, px.
pub const SHIFT_BITS: u32 = 3;
/// Largest shift of a node, in its unit.
pub const MAX_SHIFT: i32 = 16 << SHIFT_BITS;
/// Unary bins that have contexts of their own.
const BINS: u32 = 6;
/// Magnitude from which on the rest is coded in equiprobable bits.
const ESCAPE: u32 = 12;
/// Those bits.
const ESCAPE_BITS: u32 = 10;
/// Classes of how much the nodes before differ.
const CLASSES: usize = 5;
/// Counters of a set of bins.
const SET: usize = BINS as usize + 1;

/// Shifts at nodes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shifts {
    /// Nodes a row.
    pub columns: usize,
    /// (x, y) in 1/8 px, rows of nodes.
    pub nodes: Vec<[i32; 2]>,
}

impl Shifts {
    /// No shift, for a picture of this size.
    pub fn none(width: usize, height: usize) -> Self {
        let columns = width.div_ceil(SPACING) + 1;
        Self { columns, nodes: vec![[0; 2]; columns * (height.div_ceil(SPACING) + 1)] }
    }

    /// True when there is no shift.
    pub fn is_none(&self) -> bool {
        self.nodes.iter().all(|n| *n == [0; 2])
    }

    /// Shift of a pixel, 1/256 px.
    pub fn at(&self, x: usize, y: usize) -> [i32; 2] {
        let n = (y >> SPACING_BITS) * self.columns + (x >> SPACING_BITS);
        let (fx, fy) = ((x % SPACING) as i32, (y % SPACING) as i32);
        let s = SPACING as i32;
        [0, 1].map(|k| {
            let top = self.nodes[n][k] * (s - fx) + self.nodes[n + 1][k] * fx;
            let below = self.nodes[n + self.columns][k] * (s - fx) + self.nodes[n + self.columns + 1][k] * fx;
            (top * (s - fy) + below * fy) >> (2 * SPACING_BITS + SHIFT_BITS - 8)
        })
    }

    /// Shift of the block of [`BLOCK`] px whose first pixel this is, 1/256 px.
    pub fn of_block(&self, x: usize, y: usize) -> [i32; 2] {
        self.at(x + BLOCK / 2, y + BLOCK / 2)
    }

    /// Moves `offsets` (of a scan's blocks in a picture) by `share` / 256 of the shifts where `at` takes the same blocks in
    /// the picture that these shifts were found for; blocks that one of both does not show stay.
    ///
    /// A motion that goes astray evenly from the source (time 0) to this picture (time 1) is off by `t - t0` of a shift
    /// between a scan at time `t` and a picture at `t0`: that is the share for offsets of this scan to that picture.
    ///
    /// # Panics
    /// When the offsets are not of one picture.
    pub fn correct(&self, at: &Offsets, share: i32, offsets: &mut Offsets) {
        assert_eq!((at.columns, at.blocks.len()), (offsets.columns, offsets.blocks.len()), "offsets of one picture");
        let rows = self.nodes.len() / self.columns;
        let last = [self.columns, rows].map(|n| ((n - 1) * SPACING - 1) as i32);
        for block in 0..at.blocks.len() {
            let (there, offset) = (at.blocks[block], &mut offsets.blocks[block]);
            if there == NOWHERE || *offset == NOWHERE {
                continue;
            }
            let corner = at.corner(block);
            let [x, y] = [0, 1].map(|k| {
                let middle = (corner[k] + BLOCK / 2) as i32 + (there[k].saturating_add(128) >> 8);
                middle.clamp(0, last[k]) as usize
            });
            let shift = self.at(x, y);
            *offset = [0, 1].map(|k| offset[k].saturating_add((shift[k] * share) >> 8));
        }
    }

    /// What the nodes before let expect.
    fn expected(&self, n: usize, k: usize) -> (i32, u32) {
        let (x, y) = (n % self.columns, n / self.columns);
        let left = if x > 0 { self.nodes[n - 1][k] } else { 0 };
        let above = if y > 0 { self.nodes[n - self.columns][k] } else { left };
        let corner = if x > 0 && y > 0 { self.nodes[n - self.columns - 1][k] } else { above };
        let left = if x > 0 { left } else { above };
        let spread = ((left - corner).abs() + (above - corner).abs()) as u32;
        ((left + above).div_euclid(2), spread)
    }
}

/// What the coder has learned of shifts.
#[derive(Debug, Clone)]
pub struct ShiftModels(Mixer);

impl Default for ShiftModels {
    fn default() -> Self {
        Self(Mixer::new(1 + 2 * (CLASSES + 1) * SET, 1 + SET))
    }
}

impl ShiftModels {
    /// Codes shifts, or reads them; `None` for one out of range.
    pub fn code<C: Coder>(&mut self, coder: &mut C, shifts: &mut Shifts) -> Option<()> {
        let first = Contexts { counters: [0; 4], weights: 0 };
        if !coder.bit(&mut self.0, &first, !shifts.is_none()) {
            return Some(());
        }
        for n in 0..shifts.nodes.len() {
            for k in 0..2 {
                let (expected, spread) = shifts.expected(n, k);
                let class = ((spread + 1).ilog2() as usize).min(CLASSES - 1);
                let value = self.difference(coder, k, class, shifts.nodes[n][k] - expected)? + expected;
                if value.abs() > MAX_SHIFT {
                    return None;
                }
                shifts.nodes[n][k] = value;
            }
        }
        Some(())
    }

    fn difference<C: Coder>(&mut self, coder: &mut C, k: usize, class: usize, wanted: i32) -> Option<i32> {
        let contexts = |bin: u32| {
            let a = (1 + (k * CLASSES + class) * SET) as u32 + bin.min(BINS);
            let b = (1 + (2 * CLASSES + k) * SET) as u32 + bin.min(BINS);
            Contexts { counters: [a, b, a, b], weights: 1 + bin.min(BINS) }
        };
        let mut magnitude = 0;
        while magnitude < ESCAPE && coder.bit(&mut self.0, &contexts(magnitude), wanted.unsigned_abs() > magnitude) {
            magnitude += 1;
        }
        if magnitude == ESCAPE {
            magnitude += coder.raw(wanted.unsigned_abs().saturating_sub(ESCAPE), ESCAPE_BITS);
        }
        let negative = magnitude > 0 && coder.raw(u32::from(wanted < 0), 1) == 1;
        Some(if negative { -(magnitude as i32) } else { magnitude as i32 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bits::range_coder::{RangeDecoder, RangeEncoder};
    use proptest::prelude::*;

    #[test]
    fn shifts_are_exact_at_nodes_and_linear_between() {
        let mut shifts = Shifts::none(40, 20);
        shifts.nodes[1] = [8, -16];
        assert_eq!(shifts.at(16, 0), [256, -512]);
        assert_eq!(shifts.at(8, 0), [128, -256]);
        assert_eq!(shifts.at(16, 8), [128, -256]);
        assert_eq!(shifts.at(0, 0), [0, 0]);
        assert_eq!(shifts.at(39, 19), [0, 0]);
    }

    #[test]
    fn an_even_error_is_shared_between_the_two_sides() {
        let mut shifts = Shifts::none(32, 32);
        shifts.nodes.fill([16, 8]);
        let of = |blocks: &[[i32; 2]]| Offsets { columns: 4, blocks: blocks.into() };
        let after = of(&[[2048, 2048], [-900, 1 << 30], NOWHERE, [0; 2]]);
        let mut before = of(&[[2560, 2560], NOWHERE, [5, 5], [7, 7]]);
        shifts.correct(&after, 64, &mut before);
        assert_eq!(before, of(&[[2688, 2624], NOWHERE, [5, 5], [7 + 128, 7 + 64]]));
        let mut corrected = after.clone();
        shifts.correct(&after, 64 - 256, &mut corrected);
        assert_eq!(corrected.blocks[..2], [[2048 - 384, 2048 - 192], [-900 - 384, (1 << 30) - 192]]);
    }

    proptest! {
        #[test]
        fn shifts_come_back(width in 1_usize..90, height in 1_usize..90, seed in 0_u32..1000, size in 0_i32..=MAX_SHIFT) {
            let mut shifts = Shifts::none(width, height);
            for (i, node) in shifts.nodes.iter_mut().enumerate() {
                let hash = (i as u32 ^ seed.wrapping_mul(747_796_405)).wrapping_mul(2_654_435_761);
                *node = [8, 16].map(|s| ((hash >> s) as i32 % 1000) * size / 1000);
                *node = [node[0] - size / 2, (node[1] - size / 3).clamp(-MAX_SHIFT, MAX_SHIFT)];
            }
            let mut out = RangeEncoder::default();
            ShiftModels::default().code(&mut out, &mut shifts.clone()).unwrap();
            let bytes = out.finish();
            let (mut back, mut reader) = (Shifts::none(width, height), RangeDecoder::new(&bytes, "shifts"));
            ShiftModels::default().code(&mut reader, &mut back).unwrap();
            reader.finish().unwrap();
            prop_assert_eq!(back, shifts);
        }
    }
}
