//! Quantized coefficients of a block: how many diagonals are used, then magnitudes and signs along them.

use super::mixing::{Coder, Contexts, INPUTS, Mixer};
use super::transform::{MAX_AREA, MAX_SIDE};

/// Largest magnitude of a coefficient in steps.
pub const MAX_LEVEL: u32 = 1 << 15;
/// Magnitude from which on the rest is coded in equiprobable bits.
const ESCAPE: u32 = 15;
/// Bins of a magnitude that have contexts of their own.
const BINS: usize = 6;
/// Buckets of a frequency.
const BANDS: usize = 10;
/// Buckets of the magnitude around a coefficient.
const AROUND: usize = 14;
/// Classes of a block's activity.
pub const ACTIVITIES: usize = 7;

/// Band of a frequency, 1/32 of a cycle in 2 px.
const BAND: [u8; 64] = {
    let mut t = [9_u8; 64];
    let ends = [1, 2, 3, 5, 7, 10, 14, 19, 26];
    let (mut i, mut b) = (0, 0);
    while i < 64 {
        while b < 9 && i >= ends[b] {
            b += 1;
        }
        t[i] = b as u8;
        i += 1;
    }
    t
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
    /// Extent (in 1/32 of cycles) of those blocks.
    pub reach: usize,
}

impl Shape {
    fn size(&self) -> usize {
        self.side.ilog2() as usize - 3
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

const SIG_A: usize = AROUND * BANDS * BINS * 3 * 2;
const SIG_B: usize = BANDS * BANDS * 3 * 3 * 2;
const SIG_C: usize = 6 * 3 * 6 * 3 * 3 * 2;
const SIG_D: usize = ACTIVITIES * ACTIVITIES * BANDS * 3 * 2;
const COUNTERS: usize = SIG_A + SIG_B + SIG_C + SIG_D;
const EXTENT_NODES: usize = 64;

/// What the coder has learned of coefficients.
#[derive(Debug, Clone)]
pub struct LevelModels {
    levels: Mixer,
    extents: Mixer,
}

impl Default for LevelModels {
    fn default() -> Self {
        Self {
            levels: Mixer::new(COUNTERS, BINS * 3 * 2),
            extents: Mixer::new(EXTENT_NODES * 3 * 2 * (1 + 8 + ACTIVITIES * ACTIVITIES + 4), 3 * 2 * 7),
        }
    }
}

/// Surroundings of a coefficient.
struct Place {
    base: [u32; INPUTS],
    per_bin: [u32; INPUTS],
    weights: u32,
}

impl Place {
    fn new(shape: &Shape, values: &[i32], u: usize, v: usize, extent: usize, before: u32) -> Self {
        let side = shape.side;
        let at = |du: usize, dv: usize| {
            if u >= du && v >= dv { values[(v - dv) * side + u - du].unsigned_abs() } else { 0 }
        };
        let (a, b) = (at(1, 0).min(8), at(0, 1).min(8));
        let near = 2 * (a + b) + at(1, 1).min(8) + at(2, 0).min(8) + at(0, 2).min(8) + before.min(8);
        let around = match near {
            0..=8 => near as usize,
            9..=10 => 9,
            11..=13 => 10,
            14..=18 => 11,
            19..=27 => 12,
            _ => 13,
        };
        let unit = MAX_SIDE / side;
        let (size, kind) = (shape.size(), usize::from(shape.intra));
        let band = |f: usize| usize::from(BAND[(f * unit).min(63)]);
        let diagonal = band((u + v).div_ceil(2));
        let [left, above] = shape.activity;
        let total = (left + above).min(2 * ACTIVITIES - 2) / 5;
        let left_over = match extent - (u + v) {
            n @ 1..=3 => n - 1,
            4..=5 => 3,
            6..=9 => 4,
            _ => 5,
        };
        let c = (left_over * 3 + before.min(2) as usize) * 6 + ((a + b) as usize).min(5);
        let index = [
            ((size * 2 + kind) * BANDS + diagonal) * AROUND + around,
            ((total.min(2) * 2 + kind) * BANDS + band(u)) * BANDS + band(v),
            (c * 3 + total.min(2)) * 2 + kind,
            ((left * ACTIVITIES + above) * BANDS + diagonal) * 2 + kind,
        ];
        let starts = [0, SIG_A, SIG_A + SIG_B, SIG_A + SIG_B + SIG_C];
        let bins = [BINS, 3, 3, 3];
        Self {
            base: std::array::from_fn(|i| (starts[i] + index[i] * bins[i]) as u32),
            per_bin: bins.map(|b| b as u32 - 1),
            weights: ((size * 2 + kind) * BINS) as u32,
        }
    }

    fn bin(&self, bin: u32) -> Contexts {
        let counters = std::array::from_fn(|i| self.base[i] + bin.min(self.per_bin[i]));
        Contexts { counters, weights: self.weights + bin.min(BINS as u32 - 1) }
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
            for v in d.saturating_sub(side - 1)..=d.min(side - 1) {
                let u = d - v;
                let place = Place::new(shape, &levels.values, u, v, levels.extent, before);
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
        let (size, kind) = (shape.size(), usize::from(shape.intra));
        let s = size * 2 + kind;
        let all = 3 * 2 * EXTENT_NODES;
        let reach = shape.reach.min(7);
        let [left, above] = shape.activity;
        Contexts {
            counters: [
                (s * EXTENT_NODES + node) as u32,
                (all + (reach * 6 + s) * EXTENT_NODES + node) as u32,
                (all * 9 + ((left * ACTIVITIES + above) * 6 + s) * EXTENT_NODES + node) as u32,
                (all * (9 + ACTIVITIES * ACTIVITIES) + (((left + above) / 4).min(3) * 6 + s) * EXTENT_NODES + node)
                    as u32,
            ],
            weights: (s * 7 + depth) as u32,
        }
    }

    /// The six bits of an extent from the highest on, each in the context of those before.
    fn code_extent<C: Coder>(&mut self, coder: &mut C, shape: &Shape, extent: usize) -> Option<usize> {
        let mut node = 0;
        if !coder.bit(&mut self.extents, &Self::extent_contexts(shape, 0, 0), extent > 0) {
            return Some(0);
        }
        node += 1;
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
    fn extent_cost(&self, shape: &Shape, extent: usize) -> u32 {
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

    /// Levels of `coefficients` that minimise squared error + `lambda` x bits, going through them once, and that sum.
    pub fn choose(&self, shape: &Shape, coefficients: &[f32], step: f32, lambda: f32) -> (Levels, f32) {
        let side = shape.side;
        let mut values = vec![0_i32; side * side];
        let energy: f32 = coefficients[..side * side].iter().map(|c| c * c).sum();
        let per_cost = lambda / 256.0;
        let mut best = (0, energy + per_cost * self.extent_cost(shape, 0) as f32);
        let dz: f32 = 0.62;
        let mut most = 0;
        for v in 0..side {
            for u in 0..side {
                if coefficients[v * side + u].abs() > dz * step {
                    most = most.max(u + v + 1);
                }
            }
        }
        let (mut sum, mut tail) = (0.0_f32, energy);
        for d in 0..most {
            let mut before = 0;
            let mut some = false;
            for v in d.saturating_sub(side - 1)..=d.min(side - 1) {
                let u = d - v;
                let c = coefficients[v * side + u];
                let place = Place::new(shape, &values, u, v, most, before);
                let (level, price) = self.decide(&place, c, step, per_cost);
                values[v * side + u] = level;
                before = level.unsigned_abs();
                some |= level != 0;
                sum += price;
                tail -= c * c;
            }
            if some {
                let total = sum + tail.max(0.0) + per_cost * self.extent_cost(shape, d + 1) as f32;
                if total < best.1 {
                    best = (d + 1, total);
                }
            }
        }
        for v in 0..side {
            for u in 0..side {
                if u + v >= best.0 {
                    values[v * side + u] = 0;
                }
            }
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
