//! A decoded scan, as later scans are predicted from it.

use super::carry::{Carried, carry};
use super::mask::{CERTAIN, Expectation};
use super::model::{Drawn, Model, Window};
use super::motion::Motion;
use super::raster::NOTHING;
use super::view::PX_BITS;

/// Farthest depth, units.
const MAX_DEPTH: i32 = 1 << 25;

/// A decoded scan.
#[derive(Debug, Clone)]
pub struct SeenScan {
    /// Where the model is.
    pub motion: Motion,
    /// The camera's pixels.
    pub window: Window,
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
        let drawn = Drawn::new(model, motion, &self.window);
        let model_depth = carry(&drawn.picture, &drawn.seen, &model.connectivity, &[]).depth;
        let model_depth = without_nothing(model_depth);
        let residual = (0..self.mask.len())
            .map(|i| if self.mask[i] { self.depth(i).saturating_sub(model_depth[i]) } else { 0 })
            .collect();
        Self { motion: motion.clone(), drawn, model_depth, residual, mask: self.mask.clone(), window: self.window }
    }
}

/// What is known of a scan before its mask: the model where it is, and what decoded scans say of its pixels.
#[derive(Debug, Clone)]
pub struct Expected {
    /// Depth of the model, continued beside it.
    pub model_depth: Vec<i32>,
    /// Where each pixel lies in the references.
    pub places: Vec<Vec<[i32; 2]>>,
    /// Which pixels the scan should have.
    pub mask: Expectation,
    /// Residual that the references carry along.
    pub residual: Vec<i32>,
}

impl Expected {
    /// Expects a scan that sees `drawn` from those decoded already.
    pub fn new(model: &Model, drawn: &Drawn, references: &[&SeenScan]) -> Self {
        let seen: Vec<_> = references.iter().map(|r| &r.drawn.seen[..]).collect();
        let Carried { depth, places } = carry(&drawn.picture, &drawn.seen, &model.connectivity, &seen);
        let (width, height) = (drawn.picture.width, drawn.picture.height);
        let (level, residual) = if references.is_empty() {
            let level = drawn.picture.depth.iter().map(|d| if *d == NOTHING { 0 } else { 2 }).collect();
            (level, vec![0; depth.len()])
        } else {
            expected_pixels(&places, references, depth.len())
        };
        let mask = Expectation { width, height, level };
        Self { model_depth: without_nothing(depth), places, mask, residual }
    }
}

/// A model that is not seen at all lies at depth 0.
fn without_nothing(mut depth: Vec<i32>) -> Vec<i32> {
    depth.iter_mut().filter(|d| **d == NOTHING).for_each(|d| *d = 0);
    depth
}

/// How surely each pixel is on the surface: the mean of bilinear shares of the references' masks; and its residual: the
/// mean of what those references hold whose masks have the nearest pixel, 0 where none has it.
fn expected_pixels(places: &[Vec<[i32; 2]>], references: &[&SeenScan], count: usize) -> (Vec<u8>, Vec<i32>) {
    let of = references.len() as i32;
    let (mut level, mut residual) = (Vec::with_capacity(count), Vec::with_capacity(count));
    for i in 0..count {
        let (mut share, mut sum, mut n) = (0, 0_i64, 0);
        for (reference, places) in references.iter().zip(places) {
            let (covered, nearest) = look(reference, places[i]);
            share += covered;
            if let Some(v) = nearest {
                sum += i64::from(v);
                n += 1;
            }
        }
        // Shares of 65536.
        level.push(match share {
            s if s >= 65_000 * of => CERTAIN,
            s if s >= 43_000 * of => 3,
            s if s >= 22_000 * of => 2,
            s if s >= 600 * of => 1,
            _ => 0,
        });
        residual.push(match n {
            0 => 0,
            1 => sum as i32,
            2 => (sum / 2) as i32,
            n => (sum / n) as i32,
        });
    }
    (level, residual)
}

/// Bilinear share of a reference's mask at a place, 1/65536, and the residual of the nearest pixel if the mask has it.
fn look(reference: &SeenScan, [x, y]: [i32; 2]) -> (i32, Option<i32>) {
    let (width, height) = (reference.window.width as i32, reference.window.height as i32);
    let (px, py) = (x >> PX_BITS, y >> PX_BITS);
    if px < -1 || py < -1 || px >= width || py >= height {
        return (0, None);
    }
    let (fx, fy) = (x & 255, y & 255);
    let (right, below) = (fx >> 7, fy >> 7);
    if px >= 0 && py >= 0 && px + 1 < width && py + 1 < height {
        let at = (py * width + px) as usize;
        let (upper, lower) =
            (&reference.mask[at..at + 2], &reference.mask[at + width as usize..at + width as usize + 2]);
        if upper[0] && upper[1] && lower[0] && lower[1] {
            return (1 << 16, Some(reference.residual[at + (below * width + right) as usize]));
        }
    }
    let on = |x: i32, y: i32| {
        let inside = x >= 0 && y >= 0 && x < width && y < height;
        inside && reference.mask[(y * width + x) as usize]
    };
    let weight = |x: i32, y: i32| i32::from(on(x, y));
    let share = (weight(px, py) * (256 - fx) + weight(px + 1, py) * fx) * (256 - fy)
        + (weight(px, py + 1) * (256 - fx) + weight(px + 1, py + 1) * fx) * fy;
    let (nx, ny) = (px + right, py + below);
    (share, on(nx, ny).then(|| reference.residual[(ny * width + nx) as usize]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shot::carry::NOWHERE;
    use crate::shot::raster::DepthPicture;

    fn reference(mask: &[bool]) -> SeenScan {
        let window = Window { width: 4, height: 2, offset: [0; 2] };
        let drawn = Drawn { seen: Vec::new(), picture: DepthPicture::new(4, 2) };
        let residual = (0..8).map(|i| 10 * i - 30).collect();
        SeenScan { motion: Motion::default(), window, drawn, model_depth: vec![7; 8], mask: mask.to_vec(), residual }
    }

    #[test]
    fn shares_of_a_mask_are_bilinear_and_end_at_its_border() {
        let r = reference(&[true, true, false, false, true, true, false, false]);
        assert_eq!(look(&r, [0, 0]).0, 1 << 16);
        assert_eq!(look(&r, [256 + 64, 128]).0, 3 << 14);
        assert_eq!(look(&r, [-128, 0]).0, 1 << 15);
        assert_eq!(look(&r, [0, 256 + 192]).0, 1 << 14);
        for off in [NOWHERE, [-257, 0], [0, -300], [4 << 8, 0], [0, 2 << 8]] {
            assert_eq!(look(&r, off), (0, None));
        }
    }

    #[test]
    fn residuals_are_the_mean_of_the_references_that_have_the_pixel() {
        let (all, left) = (reference(&[true; 8]), reference(&[true, true, false, false, true, true, false, false]));
        let places = [vec![[100, 0], [700, 300], NOWHERE], vec![[130, 0], [700, 300], [0, 5000]]];
        assert_eq!(expected_pixels(&places, &[&all, &left], 3).1, [(-30 - 20) / 2, 40, 0]);
    }

    #[test]
    fn depths_stay_in_range() {
        let mut r = reference(&[true; 8]);
        (r.model_depth[0], r.residual[0]) = (i32::MAX - 1, i32::MAX);
        (r.model_depth[1], r.residual[1]) = (i32::MIN, -5);
        assert_eq!([0, 1, 2].map(|i| r.depth(i)), [MAX_DEPTH, -MAX_DEPTH, -3]);
    }
}
