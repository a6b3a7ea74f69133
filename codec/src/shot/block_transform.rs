//! 8x8 blocks: an integer inverse cosine transform, and coefficients coded in zigzag order.
//!
//! The inverse uses the 8-point matrix of ITU-T H.265 (section 8.6.4.2), so that every decoder has the same integers; the
//! coefficient flags follow H.264's CABAC residual block (D. Marpe, H. Schwarz, T. Wiegand, 2003).

use crate::Result;
use crate::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};

/// Pixels a side.
pub const SIDE: usize = 8;
/// Pixels or coefficients of a block.
pub const AREA: usize = SIDE * SIDE;
/// Largest coefficient in steps.
const MAX_LEVEL: u32 = 1 << 15;

/// Rows of the transform; each has length 64 √8 within 0.2 %.
const MATRIX: [[i32; SIDE]; SIDE] = [
    [64, 64, 64, 64, 64, 64, 64, 64],
    [89, 75, 50, 18, -18, -50, -75, -89],
    [83, 36, -36, -83, -83, -36, 36, 83],
    [75, -18, -89, -50, 50, 89, 18, -75],
    [64, -64, -64, 64, 64, -64, -64, 64],
    [50, -89, 18, 75, -75, -18, 89, -50],
    [36, -83, 83, -36, -36, 83, -83, 36],
    [18, -50, 75, -89, 89, -75, 50, -18],
];

/// Row-major index of each zigzag position.
pub const ZIGZAG: [u8; AREA] = zigzag();

const fn zigzag() -> [u8; AREA] {
    let mut order = [0; AREA];
    let (mut i, mut sum) = (0, 0);
    while sum < 2 * SIDE - 1 {
        let mut k = 0;
        while k <= sum {
            let (a, b) = (k, sum - k);
            let (x, y) = if sum % 2 == 1 { (b, a) } else { (a, b) };
            if x < SIDE && y < SIDE {
                order[i] = (y * SIDE + x) as u8;
                i += 1;
            }
            k += 1;
        }
        sum += 1;
    }
    order
}

/// The matrix transposed and orthonormal.
const ORTHONORMAL: [[f32; SIDE]; SIDE] = orthonormal();

const fn orthonormal() -> [[f32; SIDE]; SIDE] {
    const ROOT_8: f32 = 2.0 * std::f32::consts::SQRT_2;
    let mut m = [[0.0; SIDE]; SIDE];
    let mut k = 0;
    while k < AREA {
        m[k % SIDE][k / SIDE] = MATRIX[k / SIDE][k % SIDE] as f32 / (64.0 * ROOT_8);
        k += 1;
    }
    m
}

/// Orthonormal cosine transform of a block, for encoders.
pub fn forward(block: &[f32; AREA]) -> [f32; AREA] {
    let mut rows = [[0.0; SIDE]; SIDE];
    for (row, sums) in block.chunks_exact(SIDE).zip(&mut rows) {
        for (v, m) in row.iter().zip(&ORTHONORMAL) {
            sums.iter_mut().zip(m).for_each(|(s, m)| *s += v * m);
        }
    }
    let mut out = [0.0; AREA];
    for (row, factors) in rows.iter().zip(&ORTHONORMAL) {
        for (sums, factor) in out.chunks_exact_mut(SIDE).zip(factors) {
            sums.iter_mut().zip(row).for_each(|(s, r)| *s += r * factor);
        }
    }
    out
}

/// Pixels of each coefficient alone, of the size of a step.
pub const BASIS: [[f32; AREA]; AREA] = basis();

const fn basis() -> [[f32; AREA]; AREA] {
    let mut table = [[0.0; AREA]; AREA];
    let mut k = 0;
    while k < AREA {
        let mut p = 0;
        while p < AREA {
            let product = MATRIX[k / SIDE][p / SIDE] * MATRIX[k % SIDE][p % SIDE];
            table[k][p] = product as f32 / (1 << 15) as f32;
            p += 1;
        }
        k += 1;
    }
    table
}

/// Pixels of a block from its coefficients in steps of `step`.
pub fn inverse(levels: &[i32; AREA], step: i32) -> [i32; AREA] {
    let mut columns = [[0_i64; SIDE]; SIDE];
    for (k, level) in levels.iter().enumerate().filter(|(_, level)| **level != 0) {
        let scaled = i64::from(*level) * i64::from(step);
        for (value, m) in columns[k % SIDE].iter_mut().zip(&MATRIX[k / SIDE]) {
            *value += scaled * i64::from(*m);
        }
    }
    let mut out = [1_i64 << 14; AREA];
    for (column, row) in columns.iter().zip(&MATRIX).filter(|(column, _)| column.iter().any(|v| *v != 0)) {
        for (value, out) in column.iter().zip(out.chunks_exact_mut(SIDE)) {
            out.iter_mut().zip(row).for_each(|(o, m)| *o += value * i64::from(*m));
        }
    }
    out.map(|sum| (sum >> 15) as i32)
}

/// What the coder has learned of coefficients.
#[derive(Debug, Clone)]
pub struct BlockModels {
    significant: [BitModel; AREA],
    last: [BitModel; AREA],
    magnitude: [[BitModel; 6]; 3],
    sign: BitModel,
}

impl Default for BlockModels {
    fn default() -> Self {
        Self {
            significant: [BitModel::default(); AREA],
            last: [BitModel::default(); AREA],
            magnitude: [[BitModel::default(); 6]; 3],
            sign: BitModel::default(),
        }
    }
}

/// Models of a magnitude at a zigzag position.
fn band(position: usize) -> usize {
    match position {
        0 => 0,
        1..=5 => 1,
        _ => 2,
    }
}

impl BlockModels {
    /// Codes levels of which at least one is not zero.
    pub fn encode(&mut self, levels: &[i32; AREA], out: &mut RangeEncoder) {
        let last = (0..AREA).rev().find(|i| levels[ZIGZAG[*i] as usize] != 0).unwrap_or(0);
        for i in 0..=last {
            let v = levels[ZIGZAG[i] as usize];
            if i < AREA - 1 {
                out.bit(&mut self.significant[i], v != 0);
            }
            if v != 0 {
                out.number(&mut self.magnitude[band(i)], v.unsigned_abs() - 1);
                out.bit(&mut self.sign, v < 0);
                if i < AREA - 1 {
                    out.bit(&mut self.last[i], i == last);
                }
            }
        }
    }

    /// Reads levels.
    ///
    /// # Errors
    /// [`crate::CodecError::Payload`] for a level out of range.
    pub fn decode(&mut self, reader: &mut RangeDecoder<'_>) -> Result<[i32; AREA]> {
        let mut levels = [0; AREA];
        for i in 0..AREA {
            if i < AREA - 1 && !reader.bit(&mut self.significant[i]) {
                continue;
            }
            let magnitude = reader.number(&mut self.magnitude[band(i)])?;
            if magnitude >= MAX_LEVEL {
                return Err(reader.error("a transform coefficient out of range"));
            }
            let v = magnitude as i32 + 1;
            levels[ZIGZAG[i] as usize] = if reader.bit(&mut self.sign) { -v } else { v };
            if i < AREA - 1 && reader.bit(&mut self.last[i]) {
                break;
            }
        }
        Ok(levels)
    }

    /// Expected cost of levels, bits.
    pub fn bits(&self, levels: &[i32; AREA]) -> f32 {
        let Some(last) = (0..AREA).rev().find(|i| levels[ZIGZAG[*i] as usize] != 0) else { return 0.0 };
        let cost: u32 = (0..=last).map(|i| self.cost(i, levels[ZIGZAG[i] as usize], i == last)).sum();
        cost as f32 / 256.0
    }

    /// What levels cost more, in bits, when `level` takes the place of the one at zigzag position `i`, which is not zero;
    /// `is_last` says whether it is the last that is not.
    pub fn more_bits(&self, levels: &[i32; AREA], (i, is_last): (usize, bool), level: i32) -> f32 {
        let at = |i: usize| levels[ZIGZAG[i] as usize];
        let cost = |i: usize, is_last: bool| self.cost(i, at(i), is_last) as f32;
        let more = if is_last && level == 0 {
            let before = (0..i).rev().find(|j| at(*j) != 0);
            let gone: f32 = (before.map_or(0, |j| j + 1)..i).map(|j| cost(j, false)).sum();
            before.map_or(0.0, |j| cost(j, true) - cost(j, false)) - gone - cost(i, true)
        } else {
            self.cost(i, level, is_last) as f32 - cost(i, is_last)
        };
        more / 256.0
    }

    /// Expected cost of the level at a zigzag position, 1/256 bit.
    fn cost(&self, i: usize, level: i32, is_last: bool) -> u32 {
        let significant = self.significant[i].cost(level != 0);
        if level == 0 {
            return significant;
        }
        let models = &self.magnitude[band(i)];
        let steps = level.unsigned_abs() - 1;
        let more: u32 = (0..steps.min(14)).map(|s| models[(s as usize).min(5)].cost(true)).sum();
        let end =
            if steps < 14 { models[(steps as usize).min(5)].cost(false) } else { 512 * (steps - 13).ilog2() + 256 };
        significant + more + end + 256 + self.last[i].cost(is_last)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn zigzag_visits_all_from_low_to_high() {
        let mut seen = ZIGZAG.to_vec();
        assert_eq!(&seen[..6], &[0, 1, 8, 16, 9, 2]);
        seen.sort_unstable();
        assert!(seen.iter().enumerate().all(|(i, v)| i == usize::from(*v)));
    }

    proptest! {
        #[test]
        fn the_inverse_undoes_the_transform(values in prop::collection::vec(-2000_i32..2000, AREA)) {
            let block: [f32; AREA] = std::array::from_fn(|i| values[i] as f32);
            let levels = forward(&block).map(|c| c.round() as i32);
            let back = inverse(&levels, 1);
            prop_assert!(back.iter().zip(&values).all(|(a, b)| (a - b).abs() <= 24), "{:?}", back);
        }

        #[test]
        fn a_level_costs_what_its_block_costs_more(values in prop::collection::vec(-3_i32..4, AREA), at in 0_usize..AREA, level in -20_i32..20) {
            let mut levels: [i32; AREA] = std::array::from_fn(|k| values[k].max(0) - (-values[k] - 2).max(0));
            levels[usize::from(ZIGZAG[at])] = 2;
            let last = (0..AREA).rev().find(|i| levels[usize::from(ZIGZAG[*i])] != 0).unwrap();
            let models = BlockModels::default();
            // Zero in the place of the last level ends the block earlier; any other leaves its end where it is.
            let (before, more) = (models.bits(&levels), models.more_bits(&levels, (at, at == last), level));
            levels[usize::from(ZIGZAG[at])] = level;
            prop_assert!((models.bits(&levels) - before - more).abs() < 0.02);
        }

        #[test]
        fn levels_come_back(mut levels in prop::array::uniform32(-3_i32..4), big in -40_000_i32..40_000) {
            levels[5] = big.clamp(-30_000, 30_000);
            let mut block = [0; AREA];
            block[7..39].copy_from_slice(&levels);
            block[0] = 1;
            let mut out = RangeEncoder::default();
            BlockModels::default().encode(&block, &mut out);
            let bytes = out.finish();
            let mut reader = RangeDecoder::new(&bytes, "block");
            prop_assert_eq!(BlockModels::default().decode(&mut reader).unwrap(), block);
            reader.finish().unwrap();
        }
    }
}
