//! 8x8 blocks of what prediction misses, inside a mask, where they are worth their bits.

use super::block_transform::{AREA, BASIS, BlockModels, SIDE, ZIGZAG, forward, inverse};
use crate::Result;
use crate::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};
use std::ops::Range;

/// Share of a step above which a coefficient is tried at all.
const DEAD_ZONE: f32 = 0.65;
/// Rounding offset of larger coefficients: below a half, since the smaller integer is cheaper.
const ROUNDING: f32 = 0.35;
/// Rounds in which pixels off the mask take what the coded block makes of them.
const FILLINGS: usize = 2;
/// Fewer bits than this no block costs.
const LEAST_BITS: f32 = 4.0;

/// Pixels that count.
#[derive(Debug, Clone, Copy)]
pub struct Field<'a> {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// One value a pixel.
    pub mask: &'a [bool],
}

/// What the encoder weighs.
#[derive(Debug, Clone, Copy)]
pub struct PatchOptions {
    /// Quantization step.
    pub step: i32,
    /// Squared error that a bit may cost at most, in the values' own units.
    pub lambda: f32,
}

/// What the coder has learned of patches.
#[derive(Debug, Clone, Default)]
pub struct PatchModels {
    coded: [BitModel; 3],
    blocks: BlockModels,
}

/// A block's place.
#[derive(Debug, Clone, Copy)]
struct Place {
    x: usize,
    y: usize,
}

impl Field<'_> {
    fn columns(&self) -> usize {
        self.width.div_ceil(SIDE)
    }

    /// Blocks that hold a pixel of the mask, row by row.
    fn blocks(&self) -> impl Iterator<Item = Place> + '_ {
        let rows = self.height.div_ceil(SIDE);
        let places = (0..rows).flat_map(|y| (0..self.columns()).map(move |x| Place { x, y }));
        places.filter(|p| self.rows(*p).any(|(row, _)| self.mask[row].contains(&true)))
    }

    /// Pixels of each row of a block inside the picture, with the place of the first in the block.
    fn rows(&self, place: Place) -> impl Iterator<Item = (Range<usize>, usize)> + use<> {
        let (width, x, y) = (self.width, place.x * SIDE, place.y * SIDE);
        let end = (x + SIDE).min(width);
        (y..(y + SIDE).min(self.height)).map(move |row| (row * width + x..row * width + end, (row - y) * SIDE))
    }

    fn add(&self, place: Place, block: &[i32; AREA], values: &mut [i32]) {
        for (row, k) in self.rows(place) {
            for (i, v) in row.zip(&block[k..]).filter(|(i, _)| self.mask[*i]) {
                values[i] = values[i].saturating_add(*v);
            }
        }
    }
}

/// Which blocks around are coded.
struct Coded {
    columns: usize,
    flags: Vec<bool>,
}

impl Coded {
    fn new(field: &Field<'_>) -> Self {
        Self { columns: field.columns(), flags: vec![false; field.columns() * field.height.div_ceil(SIDE)] }
    }

    fn context(&self, p: Place) -> usize {
        let at = p.y * self.columns + p.x;
        usize::from(p.x > 0 && self.flags[at - 1]) + usize::from(p.y > 0 && self.flags[at - self.columns])
    }

    fn set(&mut self, p: Place) {
        self.flags[p.y * self.columns + p.x] = true;
    }
}

/// Codes patches that bring `values`, the prediction, nearer to `wanted`; `values` becomes what is decoded. `weights` say
/// how much the squared error of a pixel counts. Returns the number of patches.
pub fn encode(
    field: &Field<'_>,
    wanted: &[i32],
    weights: &[f32],
    values: &mut [i32],
    options: PatchOptions,
    (out, models): (&mut RangeEncoder, &mut PatchModels),
) -> usize {
    let mut coded = Coded::new(field);
    let mut count = 0;
    for place in field.blocks() {
        let context = coded.context(place);
        let block = Block::gather(field, place, wanted, weights, values);
        let flag = models.coded[context];
        let worth = options.lambda * (flag.cost(true) as f32 - flag.cost(false) as f32) / 256.0;
        let levels = block.choose(&models.blocks, options, worth);
        out.bit(&mut models.coded[context], levels.is_some());
        if let Some(levels) = levels {
            models.blocks.encode(&levels, out);
            field.add(place, &inverse(&levels, options.step), values);
            coded.set(place);
            count += 1;
        }
    }
    count
}

/// Reads patches onto `values`, the prediction.
///
/// # Errors
/// [`crate::CodecError::Payload`] for coefficients out of range.
pub fn decode(
    field: &Field<'_>,
    values: &mut [i32],
    step: i32,
    (reader, models): (&mut RangeDecoder<'_>, &mut PatchModels),
) -> Result<()> {
    let mut coded = Coded::new(field);
    for place in field.blocks() {
        if reader.bit(&mut models.coded[coded.context(place)]) {
            let levels = models.blocks.decode(reader)?;
            field.add(place, &inverse(&levels, step), values);
            coded.set(place);
        }
    }
    Ok(())
}

/// What is missing in a block, and how much each pixel counts.
struct Block {
    missing: [f32; AREA],
    weight: [f32; AREA],
}

impl Block {
    fn gather(field: &Field<'_>, place: Place, wanted: &[i32], weights: &[f32], values: &[i32]) -> Self {
        let mut block = Self { missing: [0.0; AREA], weight: [0.0; AREA] };
        for (row, k) in field.rows(place) {
            for (i, k) in row.zip(k..).filter(|(i, _)| field.mask[*i]) {
                block.missing[k] = (wanted[i] - values[i]) as f32;
                block.weight[k] = weights[i];
            }
        }
        block
    }

    fn error(&self, coded: &[i32; AREA]) -> f32 {
        let mut sums = [0.0; SIDE];
        let rows = self.missing.chunks_exact(SIDE).zip(coded.chunks_exact(SIDE)).zip(self.weight.chunks_exact(SIDE));
        for ((missing, coded), weight) in rows {
            for i in 0..SIDE {
                let rest = missing[i] - coded[i] as f32;
                sums[i] += rest * rest * weight[i];
            }
        }
        sums.iter().sum()
    }

    /// Levels whose saving exceeds `lambda` times their bits and `worth`.
    fn choose(&self, models: &BlockModels, options: PatchOptions, worth: f32) -> Option<[i32; AREA]> {
        let without = self.error(&[0; AREA]);
        if without <= options.lambda * LEAST_BITS + worth {
            return None;
        }
        let levels = self.lowered(self.quantize(options.step), models, options);
        let is_worth = || {
            let error = self.error(&inverse(&levels, options.step));
            error + options.lambda * models.bits(&levels) + worth < without
        };
        (levels.iter().any(|l| *l != 0) && is_worth()).then_some(levels)
    }

    /// Levels, the last one first, at zero or one nearer to it where that costs less than it saves.
    fn lowered(&self, mut levels: [i32; AREA], models: &BlockModels, options: PatchOptions) -> [i32; AREA] {
        let mut rest = self.missing;
        let take = |rest: &mut [f32; AREA], k: usize, by: i32| {
            let by = (by * options.step) as f32;
            rest.iter_mut().zip(&BASIS[k]).for_each(|(r, b)| *r -= by * b);
        };
        (0..AREA).filter(|k| levels[*k] != 0).for_each(|k| take(&mut rest, k, levels[k]));
        let mut is_last = true;
        for (i, k) in ZIGZAG.iter().map(|k| usize::from(*k)).enumerate().rev() {
            let kept = levels[k];
            if kept == 0 {
                continue;
            }
            let [slope, curvature] = self.projected(&rest, &BASIS[k]);
            for tried in [0, kept - kept.signum()] {
                let step = ((tried - kept) * options.step) as f32;
                let more = models.more_bits(&levels, (i, is_last), tried);
                if step * (step * curvature - 2.0 * slope) + options.lambda * more < 0.0 {
                    levels[k] = tried;
                    take(&mut rest, k, tried - kept);
                    break;
                }
            }
            is_last &= levels[k] == 0;
        }
        levels
    }

    /// Weighted products of a picture with `rest` and with itself: when `s` times the picture is taken off `rest`, its squared
    /// error grows by `s (s b - 2 a)`.
    fn projected(&self, rest: &[f32; AREA], picture: &[f32; AREA]) -> [f32; 2] {
        let (mut a, mut b) = ([0.0; SIDE], [0.0; SIDE]);
        let rows = rest.chunks_exact(SIDE).zip(picture.chunks_exact(SIDE)).zip(self.weight.chunks_exact(SIDE));
        for ((rest, picture), weight) in rows {
            for i in 0..SIDE {
                let weighted = weight[i] * picture[i];
                a[i] += weighted * rest[i];
                b[i] += weighted * picture[i];
            }
        }
        [a.iter().sum(), b.iter().sum()]
    }

    /// Levels of the block whose pixels off the mask are free: they follow what is coded for the others (projection onto
    /// convex sets; H. H. Chen, M. R. Civanlar, B. G. Haskell, A block transform coder for arbitrarily shaped image
    /// segments, 1994).
    fn quantize(&self, step: i32) -> [i32; AREA] {
        let count = self.weight.iter().filter(|w| **w > 0.0).count();
        let mean = self.missing.iter().sum::<f32>() / count.max(1) as f32;
        let mut filled: [f32; AREA] =
            std::array::from_fn(|k| if self.weight[k] > 0.0 { self.missing[k] } else { mean });
        let mut levels = quantized(&filled, step);
        if count < AREA {
            for _ in 0..FILLINGS {
                let coded = inverse(&levels, step);
                (0..AREA).filter(|k| self.weight[*k] == 0.0).for_each(|k| filled[k] = coded[k] as f32);
                levels = quantized(&filled, step);
            }
        }
        levels
    }
}

fn quantized(block: &[f32; AREA], step: i32) -> [i32; AREA] {
    forward(block).map(|c| {
        let v = c / step as f32;
        if v.abs() < DEAD_ZONE { 0 } else { ((v.abs() + ROUNDING) as i32).min(1 << 14) * v.signum() as i32 }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn both_ways(
        width: usize,
        height: usize,
        wanted: &[i32],
        mask: &[bool],
        options: PatchOptions,
    ) -> (Vec<i32>, usize) {
        let field = Field { width, height, mask };
        let weights = vec![1.0; wanted.len()];
        let mut values = vec![0; wanted.len()];
        let mut out = RangeEncoder::default();
        encode(&field, wanted, &weights, &mut values, options, (&mut out, &mut PatchModels::default()));
        let bytes = out.finish();
        let mut reader = RangeDecoder::new(&bytes, "patches");
        let mut decoded = vec![0; wanted.len()];
        decode(&field, &mut decoded, options.step, (&mut reader, &mut PatchModels::default())).unwrap();
        reader.finish().unwrap();
        assert_eq!(decoded, values);
        (decoded, bytes.len())
    }

    #[test]
    fn a_cheap_step_meets_a_smooth_field_and_nothing_costs_hardly_anything() {
        let (w, h) = (43, 30);
        let wanted: Vec<i32> = (0..w * h).map(|i| ((i % w) * 9 + (i / w) * (i / w)) as i32).collect();
        let mask: Vec<bool> = (0..w * h).map(|i| i % w > 3 && (i / w + i % w) < 60).collect();
        let (decoded, _) = both_ways(w, h, &wanted, &mask, PatchOptions { step: 4, lambda: 1e-3 });
        for i in (0..w * h).filter(|i| mask[*i]) {
            assert!((decoded[i] - wanted[i]).abs() <= 8, "{} for {}", decoded[i], wanted[i]);
        }
        assert!((0..w * h).filter(|i| !mask[*i]).all(|i| decoded[i] == 0));
        let (_, bytes) = both_ways(w, h, &vec![0; w * h], &mask, PatchOptions { step: 4, lambda: 1e-3 });
        assert!(bytes <= 6, "{bytes}");
    }

    proptest! {
        #[test]
        fn a_patch_never_makes_it_worse(width in 1_usize..30, height in 1_usize..30, seed in 0_u32..500, lambda in 0.0_f32..1e5) {
            let hash = |i: usize| (i as u32 ^ seed.wrapping_mul(747_796_405)).wrapping_mul(2_654_435_761) >> 16;
            let wanted: Vec<i32> = (0..width * height).map(|i| (hash(i) % 2001) as i32 - 1000).collect();
            let mask: Vec<bool> = (0..width * height).map(|i| hash(i / 5 + 77) % 3 != 0).collect();
            let (decoded, _) = both_ways(width, height, &wanted, &mask, PatchOptions { step: 60, lambda });
            let error = |values: &dyn Fn(usize) -> i32| -> f64 {
                (0..wanted.len()).filter(|i| mask[*i]).map(|i| f64::from(wanted[i] - values(i)).powi(2)).sum()
            };
            prop_assert!(error(&|i| decoded[i]) <= error(&|_| 0) + 1.0);
        }
    }
}
