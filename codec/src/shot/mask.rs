//! Which pixels a scan has, coded against what the moved surface and the masks of decoded scans let expect.

use crate::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};

/// Side of a block that may be as expected throughout, px.
const BLOCK: usize = 16;
/// Expectation of certainty.
pub const CERTAIN: u8 = 4;

/// How much each pixel is expected to be on the surface: 0 (not) to [`CERTAIN`].
#[derive(Debug, Clone)]
pub struct Expectation {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// One value a pixel.
    pub level: Vec<u8>,
}

impl Expectation {
    fn at(&self, x: usize, y: usize) -> u8 {
        if x < self.width && y < self.height { self.level[y * self.width + x] } else { 0 }
    }

    /// The level of a block and a pixel around it, if it is the same and certain.
    fn certain(&self, bx: usize, by: usize) -> Option<bool> {
        let first = self.at(bx, by);
        if first != 0 && first != CERTAIN {
            return None;
        }
        for y in by.saturating_sub(1)..(by + BLOCK + 1).min(self.height) {
            let row = &self.level[y * self.width..(y + 1) * self.width];
            if row[bx.saturating_sub(1)..(bx + BLOCK + 1).min(self.width)].iter().any(|v| *v != first) {
                return None;
            }
        }
        Some(first == CERTAIN)
    }
}

/// What the coder has learned of masks.
#[derive(Debug, Clone)]
pub struct MaskModels {
    block: [BitModel; 3],
    pixel: Vec<BitModel>,
}

impl Default for MaskModels {
    fn default() -> Self {
        Self { block: [BitModel::with_zero_share(60_000); 3], pixel: vec![BitModel::default(); 5 * 9 * 16 * 3] }
    }
}

/// A coder of bits in either direction.
trait Coder {
    fn bit(&mut self, model: &mut BitModel, bit: bool) -> bool;
}

impl Coder for RangeEncoder {
    fn bit(&mut self, model: &mut BitModel, bit: bool) -> bool {
        RangeEncoder::bit(self, model, bit);
        bit
    }
}

impl Coder for RangeDecoder<'_> {
    fn bit(&mut self, model: &mut BitModel, _: bool) -> bool {
        RangeDecoder::bit(self, model)
    }
}

/// Codes a mask, one value a pixel.
pub fn encode(mask: &[bool], expected: &Expectation, out: &mut RangeEncoder, models: &mut MaskModels) {
    code(&mut mask.to_vec(), expected, out, models);
}

/// Reads a mask.
pub fn decode(expected: &Expectation, reader: &mut RangeDecoder<'_>, models: &mut MaskModels) -> Vec<bool> {
    let mut mask = vec![false; expected.level.len()];
    code(&mut mask, expected, reader, models);
    mask
}

fn code(mask: &mut [bool], expected: &Expectation, coder: &mut impl Coder, models: &mut MaskModels) {
    let w = expected.width;
    let columns = w.div_ceil(BLOCK);
    let mut differs = vec![true; columns];
    for by in (0..expected.height).step_by(BLOCK) {
        for bx in (0..w).step_by(BLOCK) {
            let end = ((bx + BLOCK).min(w), (by + BLOCK).min(expected.height));
            differs[bx / BLOCK] = match expected.certain(bx, by) {
                None => true,
                Some(value) => {
                    let any = (by..end.1).any(|y| mask[y * w + bx..y * w + end.0].iter().any(|m| *m != value));
                    let near =
                        usize::from(bx > 0 && differs[bx / BLOCK - 1] && expected.certain(bx - BLOCK, by).is_some());
                    let any = coder.bit(&mut models.block[usize::from(value) + near], any);
                    if !any {
                        (by..end.1).for_each(|y| mask[y * w + bx..y * w + end.0].fill(value));
                    }
                    any
                }
            };
        }
        for y in by..(by + BLOCK).min(expected.height) {
            for x in 0..w {
                if differs[x / BLOCK] {
                    let context = context(mask, expected, x, y);
                    mask[y * w + x] = coder.bit(&mut models.pixel[context], mask[y * w + x]);
                }
            }
        }
    }
}

fn context(mask: &[bool], e: &Expectation, x: usize, y: usize) -> usize {
    let w = e.width;
    let bit = |dx: isize, dy: usize| {
        let xx = x as isize + dx;
        usize::from(xx >= 0 && (xx as usize) < w && y >= dy && mask[(y - dy) * w + xx as usize])
    };
    let causal = bit(-1, 0) | bit(-1, 1) << 1 | bit(0, 1) << 2 | bit(1, 1) << 3;
    let third = |v: u8| match v {
        0 => 0,
        CERTAIN => 2,
        _ => 1,
    };
    let ahead = third(e.at(x + 1, y)) * 3 + third(e.at(x, y + 1));
    // How the last pixels differed from what was expected: a border that has slipped slips on.
    let slip = |dx: isize, dy: usize| {
        let xx = x as isize + dx;
        if xx < 0 || y < dy {
            return 0;
        }
        let want = i32::from(e.at(xx as usize, y - dy));
        if bit(dx, dy) == 1 { i32::from(want < 2) } else { -i32::from(want > 2) }
    };
    let slipped = (slip(-1, 0) + slip(0, 1)).signum() + 1;
    ((usize::from(e.at(x, y)) * 9 + ahead) * 16 + causal) * 3 + slipped as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn masks_come_back(width in 1_usize..50, height in 1_usize..40, seed in 0_u32..1000) {
            let hash = |i: usize| (i as u32 ^ seed).wrapping_mul(2_654_435_761) >> 20;
            let level = (0..width * height).map(|i| if hash(i / 7) % 5 == 0 { (hash(i) % 5) as u8 } else { CERTAIN }).collect();
            let expected = Expectation { width, height, level };
            let mask: Vec<bool> = (0..width * height).map(|i| hash(i / 3 + 9) % 7 != 0).collect();
            let mut out = RangeEncoder::default();
            encode(&mask, &expected, &mut out, &mut MaskModels::default());
            let bytes = out.finish();
            let mut reader = RangeDecoder::new(&bytes, "mask");
            prop_assert_eq!(decode(&expected, &mut reader, &mut MaskModels::default()), mask);
            reader.finish().unwrap();
        }
    }
}
