//! A decoded scan, as later scans are predicted from it.

use super::carry::{Carried, carry, continued_depth};
use super::mask::{CERTAIN, Expectation};
use super::model::{Drawn, Model, Window};
use super::motion::Motion;
use super::order::Placed;
use super::raster::NOTHING;
use super::view::PX_BITS;
use crate::texture::coded::{BLOCK, NOWHERE, Offsets};

/// Farthest depth, units.
const MAX_DEPTH: i32 = 1 << 25;
/// Residuals of neighbours that differ by more than this, units, are of two surfaces.
const EDGE_STEP: i32 = 512;

/// A decoded scan.
#[derive(Debug, Clone)]
pub struct SeenScan {
    /// The camera's pixels, and where the model is.
    pub placed: Placed,
    /// The model as it is seen.
    pub drawn: Drawn,
    /// Depth of the model, beside it that of the nearest pixel, units.
    pub model_depth: Vec<i32>,
    /// Which pixels the scan has.
    pub mask: Vec<bool>,
    /// What the scan is deeper than the model, units; where the mask is off, what it was expected to be.
    pub residual: Vec<i32>,
}

impl SeenScan {
    /// Depth of a pixel of the scan, units.
    pub fn depth(&self, pixel: usize) -> i32 {
        self.model_depth[pixel].saturating_add(self.residual[pixel]).clamp(-MAX_DEPTH, MAX_DEPTH)
    }

    /// The same scan against another model that is where `motion` takes it.
    pub fn against(&self, model: &Model, motion: &Motion) -> Self {
        let placed = Placed { window: self.placed.window, motion: motion.clone() };
        let drawn = Drawn::new(model, motion, &placed.window);
        let model_depth = continued_depth(&drawn.picture);
        let residual = (0..self.mask.len())
            .map(|i| if self.mask[i] { self.depth(i).saturating_sub(model_depth[i]) } else { 0 })
            .collect();
        Self { placed, drawn, model_depth, residual, mask: self.mask.clone() }
    }
}

/// What is known of a scan before its mask: the model where it is, and what decoded scans say of its pixels.
#[derive(Debug, Clone)]
pub struct Expected {
    /// Depth of the model, continued beside it.
    pub model_depth: Vec<i32>,
    /// Which pixels the scan should have.
    pub mask: Expectation,
    /// Residual that the references carry along.
    pub residual: Vec<i32>,
}

impl Expected {
    /// Expects a scan that sees `drawn` from those decoded already.
    pub fn new(model: &Model, drawn: &Drawn, references: &[&SeenScan]) -> Self {
        let seen: Vec<_> = references.iter().map(|r| &r.drawn.seen[..]).collect();
        let Carried { depth, offsets } = carry(&drawn.picture, &drawn.seen, &model.connectivity, &seen);
        let (width, height) = (drawn.picture.width, drawn.picture.height);
        let (level, residual) = if references.is_empty() {
            let level = drawn.picture.depth.iter().map(|d| if *d == NOTHING { 0 } else { 2 }).collect();
            (level, vec![0; depth.len()])
        } else {
            expected_pixels(&offsets, references, [width, height])
        };
        let mask = Expectation { width, height, level };
        Self { model_depth: depth, mask, residual }
    }
}

/// How surely each pixel is on the surface: the mean of bilinear shares of the references' masks; and its residual: the
/// mean of what those references hold whose masks have the nearest pixel, 0 where none has it.
fn expected_pixels(offsets: &[Offsets], references: &[&SeenScan], [width, height]: [usize; 2]) -> (Vec<u8>, Vec<i32>) {
    let of = references.len() as i32;
    let (mut level, mut residual) = (vec![0; width * height], vec![0; width * height]);
    for block in 0..offsets[0].blocks.len() {
        let [x0, y0] = offsets[0].corner(block);
        let mut found = Found::default();
        for (reference, offsets) in references.iter().zip(offsets) {
            found.look(reference, [x0, y0], offsets.blocks[block]);
        }
        for y in y0..(y0 + BLOCK).min(height) {
            for x in x0..(x0 + BLOCK).min(width) {
                let (i, k) = (y * width + x, (y - y0) * BLOCK + x - x0);
                level[i] = surely(found.share[k], of);
                residual[i] = found.residual(k);
            }
        }
    }
    (level, residual)
}

/// Class of a sum of shares of 65536 over so many references.
fn surely(share: i32, of: i32) -> u8 {
    match share {
        s if s >= 65_000 * of => CERTAIN,
        s if s >= 43_000 * of => 3,
        s if s >= 22_000 * of => 2,
        s if s >= 600 * of => 1,
        _ => 0,
    }
}

/// What references show of the pixels of a block.
#[derive(Default)]
struct Found {
    /// Sum of bilinear shares of their masks, 1/65536.
    share: [i32; BLOCK * BLOCK],
    /// Sum of the residuals of the nearest pixels that the masks have, and their number.
    sum: [i64; BLOCK * BLOCK],
    count: [u8; BLOCK * BLOCK],
}

impl Found {
    fn residual(&self, k: usize) -> i32 {
        match self.count[k] {
            0 => 0,
            1 => self.sum[k] as i32,
            2 => (self.sum[k] / 2) as i32,
            n => (self.sum[k] / i64::from(n)) as i32,
        }
    }

    /// Adds what a reference shows of the block whose first pixel is `corner`, `offset` (1/256 px) from there.
    fn look(&mut self, reference: &SeenScan, corner: [usize; 2], offset: [i32; 2]) {
        if offset == NOWHERE {
            return;
        }
        let Window { width, height, .. } = reference.placed.window;
        let [x0, y0] = [0, 1].map(|k| corner[k] as i32 + (offset[k] >> PX_BITS));
        let f = offset.map(|v| v & 255);
        let [right, below] = f.map(|v| (v >> 7) as usize);
        let end = BLOCK as i32 + 1;
        let is_inside = x0 >= 0 && y0 >= 0 && x0 + end <= width as i32 && y0 + end <= height as i32;
        let mut around = [0_i32; (BLOCK + 1) * (BLOCK + 1)];
        for (j, row) in (0..).zip(around.chunks_exact_mut(BLOCK + 1)) {
            if is_inside {
                let at = (y0 + j) as usize * width + x0 as usize;
                row.iter_mut().zip(&reference.mask[at..at + BLOCK + 1]).for_each(|(r, m)| *r = i32::from(*m));
            } else {
                let is_on = |x: i32, y: i32| {
                    let inside = x >= 0 && y >= 0 && x < width as i32 && y < height as i32;
                    inside && reference.mask[y as usize * width + x as usize]
                };
                (0..).zip(row).for_each(|(i, r)| *r = i32::from(is_on(x0 + i, y0 + j)));
            }
        }
        let on: i32 = around.iter().sum();
        if on == 0 {
            return;
        }
        let at = |x: usize, y: usize| (i64::from(y0) + y as i64) as usize * width + (i64::from(x0) + x as i64) as usize;
        if is_inside && on == around.len() as i32 {
            let row = |y: usize| &reference.residual[at(0, y)..][..BLOCK + 1];
            // Most of a surface is as it was expected.
            if (0..=BLOCK).any(|y| row(y).iter().fold(0, |any, r| any | r) != 0) {
                for (y, sums) in self.sum.chunks_exact_mut(BLOCK).enumerate() {
                    let [upper, lower] = [row(y), row(y + 1)];
                    for (x, sum) in sums.iter_mut().enumerate() {
                        *sum += i64::from(between([upper[x], upper[x + 1], lower[x], lower[x + 1]], f));
                    }
                }
            }
            self.share.iter_mut().for_each(|share| *share += 1 << 16);
            self.count.iter_mut().for_each(|count| *count += 1);
            return;
        }
        for y in 0..BLOCK {
            let rows = [y, y + 1].map(|y| &around[y * (BLOCK + 1)..(y + 1) * (BLOCK + 1)]);
            for x in 0..BLOCK {
                let [upper, lower] = rows.map(|r| r[x] * (256 - f[0]) + r[x + 1] * f[0]);
                let k = y * BLOCK + x;
                self.share[k] += upper * (256 - f[1]) + lower * f[1];
                if rows[below][x + right] == 1 {
                    let residual = |x: usize, y: usize| reference.residual[at(x, y)];
                    let is_whole = rows.iter().all(|r| r[x] + r[x + 1] == 2);
                    let four = || [[0, 0], [1, 0], [0, 1], [1, 1]].map(|[i, j]| residual(x + i, y + j));
                    self.sum[k] +=
                        i64::from(if is_whole { between(four(), f) } else { residual(x + right, y + below) });
                    self.count[k] += 1;
                }
            }
        }
    }
}

/// Residual at the fraction `f` (1/256 px) between four pixels: bilinear, or that of the nearest one where they lie so far
/// apart that their mean is on neither side of a step.
fn between(four: [i32; 4], f: [i32; 2]) -> i32 {
    let [a, b, c, d] = four;
    let (least, most) = (a.min(b).min(c).min(d), a.max(b).max(c).max(d));
    if most.saturating_sub(least) > EDGE_STEP {
        return four[((f[1] >> 7) * 2 + (f[0] >> 7)) as usize];
    }
    let along = |a: i32, b: i32| (a - least) * (256 - f[0]) + (b - least) * f[0];
    least + ((along(a, b) * (256 - f[1]) + along(c, d) * f[1] + (1 << 15)) >> 16)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shot::raster::DepthPicture;

    fn reference(mask: &[bool]) -> SeenScan {
        let window = Window { width: 4, height: 2, offset: [0; 2] };
        let drawn = Drawn { seen: Vec::new(), picture: DepthPicture::new(4, 2) };
        let residual = (0..8).map(|i| 10 * i - 30).collect();
        SeenScan {
            placed: Placed { window, ..Placed::default() },
            drawn,
            model_depth: vec![7; 8],
            mask: mask.to_vec(),
            residual,
        }
    }

    fn look(reference: &SeenScan, offset: [i32; 2]) -> (i32, Option<i64>) {
        let mut found = Found::default();
        found.look(reference, [0; 2], offset);
        (found.share[0], (found.count[0] > 0).then(|| found.sum[0]))
    }

    #[test]
    fn shares_of_a_mask_are_bilinear_and_end_at_its_border() {
        let r = reference(&[true, true, false, false, true, true, false, false]);
        assert_eq!(look(&r, [0, 0]), (1 << 16, Some(-30)));
        assert_eq!(look(&r, [256 + 64, 128]), (3 << 14, Some(20)));
        assert_eq!(look(&r, [-128, 0]), (1 << 15, Some(-30)));
        assert_eq!(look(&r, [0, 256 + 192]), (1 << 14, None));
        for off in [NOWHERE, [-257, 0], [0, -300], [4 << 8, 0], [0, 2 << 8], [1 << 28, -(1 << 28)]] {
            assert_eq!(look(&r, off), (0, None));
        }
    }

    #[test]
    fn a_block_is_looked_at_as_its_pixels_would_be() {
        let window = Window { width: 11, height: 9, offset: [0; 2] };
        let r = SeenScan {
            placed: Placed { window, ..Placed::default() },
            mask: (0..99).map(|i| i * i % 7 != 3).collect(),
            residual: (0..99).map(|i| i * 31 % 40).collect(),
            ..reference(&[])
        };
        for offset in [[77, 190], [-700, 300], [900, 800], [513, -257]] {
            let mut found = Found::default();
            found.look(&r, [4, 4], offset);
            for (k, [x, y]) in (0..16).map(|k| (k as usize, [4 + k % 4, 4 + k / 4])) {
                let (share, nearest) = look(&r, [(x << 8) + offset[0], (y << 8) + offset[1]]);
                assert_eq!((found.share[k], (found.count[k] > 0).then(|| found.sum[k])), (share, nearest));
            }
        }
    }

    #[test]
    fn residuals_are_the_mean_of_the_references_that_have_the_pixel() {
        let (all, left) = (reference(&[true; 8]), reference(&[true, true, false, false, true, true, false, false]));
        let residual = |offsets: [[i32; 2]; 2]| {
            let mut found = Found::default();
            found.look(&all, [0; 2], offsets[0]);
            found.look(&left, [0; 2], offsets[1]);
            found.residual(0)
        };
        assert_eq!(residual([[100, 0], [130, 0]]), (-30 - 20) / 2);
        assert_eq!(residual([[700, 300], [700, 300]]), 40);
        assert_eq!(residual([NOWHERE, [0, 5000]]), 0);
    }

    #[test]
    fn between_pixels_residuals_are_bilinear_unless_a_step_lies_between() {
        let plane = |x: i32, y: i32| 100 + 32 * x - 64 * y;
        let four = [plane(0, 0), plane(1, 0), plane(0, 1), plane(1, 1)];
        for f in [[0, 0], [255, 0], [8, 128], [200, 72]] {
            assert_eq!(between(four, f), (100 * 256 + 32 * f[0] - 64 * f[1] + 128) >> 8);
        }
        assert_eq!(between([0, EDGE_STEP, 0, 0], [128, 0]), EDGE_STEP / 2);
        let step = [7, EDGE_STEP + 8, 9, -3];
        assert_eq!([[127, 127], [128, 127], [127, 128], [128, 128]].map(|f| between(step, f)), step);
        assert_eq!(between([i32::MIN, i32::MAX, 0, 0], [0, 0]), i32::MIN);
    }

    #[test]
    fn depths_stay_in_range() {
        let mut r = reference(&[true; 8]);
        (r.model_depth[0], r.residual[0]) = (i32::MAX - 1, i32::MAX);
        (r.model_depth[1], r.residual[1]) = (i32::MIN, -5);
        assert_eq!([0, 1, 2].map(|i| r.depth(i)), [MAX_DEPTH, -MAX_DEPTH, -3]);
    }
}
