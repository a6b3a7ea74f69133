//! Image pyramid for tracking, each level inside a border of zeros.

use super::FloatPicture;

/// Zeros around each level. A patch of half width up to `PAD_PX - 8` at any point of the picture stays in memory, so the
/// patch kernels need no clamping; zero is also what a normalised picture holds outside its mask.
pub(super) const PAD_PX: usize = 20;

/// One level of a pyramid.
#[derive(Debug, Clone)]
pub struct Level {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) stride: usize,
    /// `stride * (height + 2 * PAD_PX)` values.
    pub(super) padded: Vec<f32>,
}

impl Level {
    fn zeros(width: usize, height: usize) -> Self {
        let stride = width + 2 * PAD_PX;
        Self { width, height, stride, padded: vec![0.0; stride * (height + 2 * PAD_PX)] }
    }

    fn new(picture: &FloatPicture) -> Self {
        let mut level = Self::zeros(picture.width_px as usize, picture.height_px as usize);
        let (w, stride) = (level.width, level.stride);
        for (y, row) in picture.pixels.chunks_exact(w.max(1)).enumerate() {
            level.padded[(y + PAD_PX) * stride + PAD_PX..][..w].copy_from_slice(row);
        }
        level
    }

    /// Half the size; pixel (x, y) is the 3x3 binomial mean about (2x, 2y).
    fn halved(&self) -> Self {
        let mut half = Self::zeros(self.width.div_ceil(2), self.height.div_ceil(2));
        let mut column = vec![0.0_f32; 2 * half.width + 1];
        for y in 0..half.height {
            let start = (2 * y + PAD_PX) * self.stride + PAD_PX - 1;
            let [above, here, below] =
                [start - self.stride, start, start + self.stride].map(|s| &self.padded[s..][..column.len()]);
            for (((c, a), h), b) in column.iter_mut().zip(above).zip(here).zip(below) {
                *c = a + 2.0 * h + b;
            }
            let row = &mut half.padded[(y + PAD_PX) * half.stride + PAD_PX..][..half.width];
            for (x, out) in row.iter_mut().enumerate() {
                *out = (column[2 * x] + 2.0 * column[2 * x + 1] + column[2 * x + 2]) * (1.0 / 16.0);
            }
        }
        half
    }

    /// Whether `px` lies in the picture (between the outermost pixel centres).
    pub(super) fn contains(&self, px: [f32; 2]) -> bool {
        px[0] >= 0.0 && px[1] >= 0.0 && px[0] <= self.width as f32 - 1.0 && px[1] <= self.height as f32 - 1.0
    }
}

/// A picture at falling resolutions (Adelson and others: Pyramid methods in image processing, 1984), binomial 3x3.
#[derive(Debug, Clone)]
pub struct Pyramid {
    pub(super) levels: Vec<Level>,
}

impl Pyramid {
    /// Builds `levels` levels (at least one, none beyond a single pixel); level 0 is the picture itself.
    pub fn new(picture: &FloatPicture, levels: u32) -> Self {
        let mut all = vec![Level::new(picture)];
        while all.len() < levels as usize {
            let last = &all[all.len() - 1];
            if last.width.max(last.height) <= 1 {
                break;
            }
            all.push(last.halved());
        }
        Self { levels: all }
    }

    /// Level 0, at the resolution of the picture.
    pub fn finest(&self) -> &Level {
        &self.levels[0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halving_keeps_a_ramp_and_its_pixel_positions() {
        let p = FloatPicture::new(17, 12, (0..17 * 12).map(|i| (i % 17) as f32 + 10.0 * (i / 17) as f32).collect());
        let pyramid = Pyramid::new(&p, 3);
        let half = &pyramid.levels[1];
        assert_eq!((half.width, half.height, pyramid.levels[2].width), (9, 6, 5));
        for (x, y) in [(1, 1), (4, 3), (7, 4)] {
            let value = half.padded[(y + PAD_PX) * half.stride + x + PAD_PX];
            assert!((value - (2 * x + 20 * y) as f32).abs() < 1e-4);
        }
    }

    #[test]
    fn levels_end_at_a_pixel_and_empty_pictures_hold_no_point() {
        assert_eq!(Pyramid::new(&FloatPicture::new(5, 3, vec![1.0; 15]), 99).levels.len(), 4);
        let pyramid = Pyramid::new(&FloatPicture::default(), 3);
        assert!(!pyramid.finest().contains([0.0, 0.0]));
    }
}
