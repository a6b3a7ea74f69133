//! Quantized coefficients of a block: how many diagonals are used, then magnitudes and signs along them.

use super::mixing::{Coder, Contexts, INPUTS, Mixer};
use super::transform::{MAX_AREA, MAX_SIDE};

/// Largest magnitude of a coefficient in steps.
pub const MAX_LEVEL: u32 = 1 << 15;
/// Magnitude from which on the rest is coded in equiprobable bits.
const ESCAPE: u32 = 15;
/// Share of a step below which a coefficient does not extend its block.
const DEAD_ZONE: f32 = 0.62;
/// Bins of a magnitude that have counters of their own in the first table, and in the others.
const BINS: [usize; INPUTS] = [6, 3, 3, 3];
/// Classes of the magnitudes around a coefficient.
const AROUND: usize = 14;
/// Classes of a block's activity.
pub const ACTIVITIES: usize = 7;
/// Sizes of blocks, and whether they are predicted from the same picture: kinds of blocks that have weights of their own.
const KINDS: usize = 3 * 2;
/// Classes of the reach of the blocks before.
const REACHES: usize = 8;
/// Classes of the sum of two activities, where extents are coded.
const SUMS: usize = 4;
/// Nodes of the tree of an extent: whether it is 0, then up to six bits.
const EXTENT_NODES: usize = 1 << 6;
const EXTENT_DEPTH: usize = 7;

/// Bands of frequencies, half cycles in 32 px.
const BANDS: usize = 10;
const BAND: [u8; MAX_SIDE] =
    [0, 1, 2, 3, 3, 4, 4, 5, 5, 5, 6, 6, 6, 6, 7, 7, 7, 7, 7, 8, 8, 8, 8, 8, 8, 8, 9, 9, 9, 9, 9, 9];

/// Contexts of each table of counters.
const TABLES: [usize; INPUTS] =
    [KINDS * BANDS * AROUND, 3 * 2 * BANDS * BANDS, 6 * 3 * 6 * 3 * 2, ACTIVITIES * ACTIVITIES * BANDS * 2];

/// First counter of each table, and the end.
const STARTS: [usize; INPUTS + 1] = {
    let (mut starts, mut i) = ([0; INPUTS + 1], 0);
    while i < INPUTS {
        starts[i + 1] = starts[i] + TABLES[i] * BINS[i];
        i += 1;
    }
    starts
};

/// What is known of a block before its coefficients.
#[derive(Debug, Clone, Copy)]
pub struct Shape {
    /// Pixels a side: 8, 16 or 32.
    pub side: usize,
    /// Predicted from the same picture.
    pub intra: bool,
    /// Activity of the blocks on the left and above.
    pub activity: [usize; 2],
    /// Class of the extents of those blocks.
    pub reach: usize,
}

impl Shape {
    /// 0 to 5.
    fn kind(&self) -> usize {
        (self.side.ilog2() as usize - 3) * 2 + usize::from(self.intra)
    }

    /// Class of the activity of both blocks before, 0 to 2.
    fn calm(&self) -> usize {
        (self.activity[0] + self.activity[1]) / 5
    }

    /// Row of a table by the activities of both blocks before.
    fn activities(&self) -> usize {
        self.activity[0] * ACTIVITIES + self.activity[1]
    }
}

/// Coefficients of a block in steps.
#[derive(Debug, Clone)]
pub struct Levels {
    /// Diagonals up to the last one with a coefficient.
    pub extent: usize,
    /// Row-major with `side` columns.
    pub values: Vec<i32>,
}

/// What the coder has learned of coefficients.
#[derive(Debug, Clone)]
pub struct LevelModels {
    levels: Mixer,
    extents: Mixer,
}

impl Default for LevelModels {
    fn default() -> Self {
        Self {
            levels: Mixer::new(STARTS[INPUTS], BINS[0] * KINDS),
            extents: Mixer::new(
                EXTENT_NODES * KINDS * (1 + REACHES + ACTIVITIES * ACTIVITIES + SUMS),
                EXTENT_DEPTH * KINDS,
            ),
        }
    }
}

/// Contexts of a coefficient.
struct Place {
    counters: [u32; INPUTS],
    weights: u32,
}

impl Place {
    /// Contexts at column `u` and row `v` of a block of so many diagonals; `before` is the magnitude coded last on the
    /// diagonal.
    fn new(shape: &Shape, values: &[i32], [u, v]: [usize; 2], extent: usize, before: u32) -> Self {
        let side = shape.side;
        let at = |du: usize, dv: usize| {
            if u >= du && v >= dv { values[(v - dv) * side + u - du].unsigned_abs().min(8) as usize } else { 0 }
        };
        let (left, above, before) = (at(1, 0), at(0, 1), before.min(8) as usize);
        let around = around(2 * (left + above) + at(1, 1) + at(2, 0) + at(0, 2) + before);
        let band = |f: usize| usize::from(BAND[f * (MAX_SIDE / side)]);
        let diagonal = band((u + v).div_ceil(2));
        let intra = usize::from(shape.intra);
        let near = (rest(extent - u - v) * 3 + before.min(2)) * 6 + (left + above).min(5);
        let rows = [
            (shape.kind() * BANDS + diagonal) * AROUND + around,
            ((shape.calm() * 2 + intra) * BANDS + band(u)) * BANDS + band(v),
            (near * 3 + shape.calm()) * 2 + intra,
            (shape.activities() * BANDS + diagonal) * 2 + intra,
        ];
        Self {
            counters: std::array::from_fn(|i| (STARTS[i] + rows[i] * BINS[i]) as u32),
            weights: (shape.kind() * BINS[0]) as u32,
        }
    }

    /// Contexts of a bin of the magnitude.
    fn bin(&self, bin: u32) -> Contexts {
        let own = |i: usize| bin.min(BINS[i] as u32 - 1);
        Contexts { counters: std::array::from_fn(|i| self.counters[i] + own(i)), weights: self.weights + own(0) }
    }
}

/// Rows of a diagonal, in coding order.
fn rows(diagonal: usize, side: usize) -> std::ops::RangeInclusive<usize> {
    diagonal.saturating_sub(side - 1)..=diagonal.min(side - 1)
}

/// Diagonals up to the last one with a coefficient above `least`.
fn used_diagonals(coefficients: &[f32], side: usize, least: f32) -> usize {
    let large = |k: &usize| coefficients[*k].abs() > least;
    (0..side * side).filter(large).map(|k| k / side + k % side + 1).max().unwrap_or(0)
}

/// Whether no coefficient of a block extends it, by the sum of its squared pixels: no coefficient is larger than its root.
pub fn is_zero(squares: f32, step: f32) -> bool {
    squares <= (DEAD_ZONE * step).powi(2)
}

/// Class of the sum of magnitudes around a coefficient.
fn around(sum: usize) -> usize {
    match sum {
        0..=8 => sum,
        9..=10 => 9,
        11..=13 => 10,
        14..=18 => 11,
        19..=27 => 12,
        _ => 13,
    }
}

/// Class of the number of diagonals that are left.
fn rest(diagonals: usize) -> usize {
    match diagonals {
        1..=3 => diagonals - 1,
        4..=5 => 3,
        6..=9 => 4,
        _ => 5,
    }
}

/// Extra magnitude above [`ESCAPE`] in equiprobable bits: Exp-Golomb of order 0.
fn escape<C: Coder>(coder: &mut C, rest: u32) -> Option<u32> {
    let length = (rest + 1).ilog2();
    let mut bits = 0;
    while coder.raw(u32::from(bits < length), 1) == 1 {
        bits += 1;
        if bits > 15 {
            return None;
        }
    }
    Some((1 << bits) + coder.raw(rest + 1 - (1 << length), bits) - 1)
}

impl LevelModels {
    /// Codes a block, or reads it into `levels`; `None` for a magnitude out of range.
    pub fn code<C: Coder>(&mut self, coder: &mut C, shape: &Shape, levels: &mut Levels) -> Option<()> {
        levels.extent = self.code_extent(coder, shape, levels.extent)?;
        let side = shape.side;
        for d in 0..levels.extent {
            let mut before = 0;
            for v in rows(d, side) {
                let u = d - v;
                let place = Place::new(shape, &levels.values, [u, v], levels.extent, before);
                let value = levels.values[v * side + u];
                let wanted = value.unsigned_abs();
                let mut magnitude = 0;
                while magnitude < ESCAPE && coder.bit(&mut self.levels, &place.bin(magnitude), wanted > magnitude) {
                    magnitude += 1;
                }
                if magnitude == ESCAPE {
                    magnitude += escape(coder, wanted.saturating_sub(ESCAPE))?;
                    if magnitude > MAX_LEVEL {
                        return None;
                    }
                }
                let negative = magnitude > 0 && coder.raw(u32::from(value < 0), 1) == 1;
                levels.values[v * side + u] = if negative { -(magnitude as i32) } else { magnitude as i32 };
                before = magnitude;
            }
        }
        Some(())
    }

    fn extent_contexts(shape: &Shape, node: usize, depth: usize) -> Contexts {
        let sum = ((shape.activity[0] + shape.activity[1]) / 4).min(SUMS - 1);
        let rows = [
            0,
            1 + shape.reach.min(REACHES - 1),
            1 + REACHES + shape.activities(),
            1 + REACHES + ACTIVITIES * ACTIVITIES + sum,
        ];
        Contexts {
            counters: rows.map(|row| ((row * KINDS + shape.kind()) * EXTENT_NODES + node) as u32),
            weights: (shape.kind() * EXTENT_DEPTH + depth) as u32,
        }
    }

    /// Whether an extent is 0, then the bits of one less from the highest on, each in the context of those before.
    fn code_extent<C: Coder>(&mut self, coder: &mut C, shape: &Shape, extent: usize) -> Option<usize> {
        if !coder.bit(&mut self.extents, &Self::extent_contexts(shape, 0, 0), extent > 0) {
            return Some(0);
        }
        let mut node = 1;
        let bits = shape.side.ilog2() as usize + 1;
        for depth in 0..bits {
            let bit = (extent.max(1) - 1) >> (bits - 1 - depth) & 1 == 1;
            let bit = coder.bit(&mut self.extents, &Self::extent_contexts(shape, node, depth + 1), bit);
            node = 2 * node + usize::from(bit);
        }
        let extent = node - (1 << bits) + 1;
        (extent < 2 * shape.side).then_some(extent)
    }

    /// Cost of an extent, 1/256 bit.
    pub fn extent_cost(&self, shape: &Shape, extent: usize) -> u32 {
        let mut cost = self.extents.cost(&Self::extent_contexts(shape, 0, 0))[usize::from(extent > 0)];
        if extent == 0 {
            return cost;
        }
        let (mut node, bits) = (1, shape.side.ilog2() as usize + 1);
        for depth in 0..bits {
            let bit = (extent - 1) >> (bits - 1 - depth) & 1;
            cost += self.extents.cost(&Self::extent_contexts(shape, node, depth + 1))[bit];
            node = 2 * node + bit;
        }
        cost
    }

    /// Levels of `coefficients`, whose block has `squares` as the sum of its squared pixels, for about the least squared error + `lambda` x bits, and that sum: in coding order each takes
    /// the cheapest, then the last diagonals go as long as that pays.
    pub fn choose(&self, shape: &Shape, coefficients: &[f32], squares: f32, step: f32, lambda: f32) -> (Levels, f32) {
        let side = shape.side;
        let mut values = vec![0_i32; side * side];
        let per_cost = lambda / 256.0;
        let mut tail = squares;
        let mut best = (0, tail + per_cost * self.extent_cost(shape, 0) as f32);
        let extent = used_diagonals(coefficients, side, DEAD_ZONE * step);
        let mut sum = 0.0;
        for d in 0..extent {
            let (mut before, mut any) = (0, 0);
            for v in rows(d, side) {
                let c = coefficients[v * side + d - v];
                let place = Place::new(shape, &values, [d - v, v], extent, before);
                let (level, price) = self.decide(&place, c, step, per_cost);
                values[v * side + d - v] = level;
                before = level.unsigned_abs();
                any |= before;
                sum += price;
                tail -= c * c;
            }
            let total = sum + tail.max(0.0) + per_cost * self.extent_cost(shape, d + 1) as f32;
            if any > 0 && total < best.1 {
                best = (d + 1, total);
            }
        }
        for d in best.0..extent {
            rows(d, side).for_each(|v| values[v * side + d - v] = 0);
        }
        (Levels { extent: best.0, values }, best.1)
    }

    /// The level of a coefficient with the least price, zero or one of the two nearest, and that price.
    fn decide(&self, place: &Place, c: f32, step: f32, per_cost: f32) -> (i32, f32) {
        let magnitude = c.abs();
        let high = ((magnitude / step + 0.5) as u32).min(MAX_LEVEL);
        let [end, more] = self.levels.cost(&place.bin(0));
        let mut best = (0, magnitude * magnitude + per_cost * end as f32);
        let mut before = more + 256;
        for m in 1..=high.min(ESCAPE - 1) {
            let [end, more] = self.levels.cost(&place.bin(m));
            let missing = magnitude - m as f32 * step;
            let price = missing * missing + per_cost * (before + end) as f32;
            if price < best.1 {
                best = (m, price);
            }
            before += more;
        }
        if high >= ESCAPE {
            let missing = magnitude - high as f32 * step;
            let rest = 512 * (high - ESCAPE + 1).ilog2() + 256;
            best = (high, missing * missing + per_cost * (before + rest) as f32);
        }
        (if c < 0.0 { -(best.0 as i32) } else { best.0 as i32 }, best.1)
    }
}

/// Class of a block's activity: how large its levels are on average.
pub fn activity(levels: &Levels, side: usize) -> u8 {
    let sum: u32 = levels.values.iter().map(|v| v.unsigned_abs().min(64)).sum();
    let density = sum * (MAX_AREA / (side * side)) as u32;
    match density {
        0 => 0,
        1..=31 => 1,
        32..=95 => 2,
        96..=191 => 3,
        192..=351 => 4,
        352..=600 => 5,
        _ => 6,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bits::range_coder::{RangeDecoder, RangeEncoder};
    use proptest::prelude::*;

    fn shape(size: usize, intra: bool, activity: [usize; 2]) -> Shape {
        Shape { side: 8 << size, intra, activity, reach: activity[0] }
    }

    proptest! {
        #[test]
        fn levels_come_back(
            size in 0_usize..3,
            intra: bool,
            activity in [0_usize..ACTIVITIES, 0..ACTIVITIES],
            values in prop::collection::vec(prop_oneof![4 => Just(0_i32), 2 => -2_i32..3, 1 => -32_768_i32..=32_768], MAX_AREA),
            share in 0_usize..=100,
        ) {
            let shape = shape(size, intra, activity);
            let side = shape.side;
            let extent = (2 * side - 1) * share / 100;
            let value = |k: usize| if k / side + k % side < extent { values[k] } else { 0 };
            let levels = Levels { extent, values: (0..side * side).map(value).collect() };
            let mut out = RangeEncoder::default();
            LevelModels::default().code(&mut out, &shape, &mut levels.clone()).unwrap();
            let bytes = out.finish();
            let mut back = Levels { extent: 0, values: vec![0; side * side] };
            let mut reader = RangeDecoder::new(&bytes, "levels");
            LevelModels::default().code(&mut reader, &shape, &mut back).unwrap();
            reader.finish().unwrap();
            prop_assert_eq!((back.extent, back.values), (levels.extent, levels.values));
        }

        #[test]
        fn the_price_is_what_is_paid(size in 0_usize..3, seed in 1_u32..1000, lambda in 0.0_f32..3000.0) {
            let shape = shape(size, false, [2, 3]);
            let area = shape.side * shape.side;
            let hash = |k: usize| ((k as u32 ^ seed << 12).wrapping_mul(2_654_435_761) >> 16) as f32 / 65_536.0 - 0.5;
            let coefficients: Vec<f32> = (0..area).map(|k| 4000.0 * hash(k) / (1 + k / shape.side + k % shape.side) as f32).collect();
            let models = LevelModels::default();
            let squares = coefficients.iter().map(|c| c * c).sum();
            let (mut levels, price) = models.choose(&shape, &coefficients, squares, 100.0, lambda);
            let error: f32 = coefficients.iter().zip(&levels.values).map(|(c, l)| (c - 100.0 * *l as f32).powi(2)).sum();
            let nothing: f32 = coefficients.iter().map(|c| c * c).sum();
            prop_assert!(error <= nothing + 1.0);
            prop_assert!(price >= error * 0.999 - 1.0);
            let mut out = RangeEncoder::default();
            models.clone().code(&mut out, &shape, &mut levels).unwrap();
            let paid = error + lambda * 8.0 * out.finish().len() as f32;
            // A block without coefficients is always possible.
            prop_assert!(paid <= 1.3 * (nothing + lambda * 48.0) + 1.0);
        }
    }
}
