//! The pixels of a picture that show the surface.

/// One flag a pixel, row-major, first row on top.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Mask {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// `width_px * height_px` flags, true on the surface.
    pub inside: Vec<bool>,
}

impl Mask {
    /// A mask from its flags.
    ///
    /// # Panics
    /// When `inside.len() != width_px * height_px`.
    pub fn new(width_px: u32, height_px: u32, inside: Vec<bool>) -> Self {
        assert_eq!(inside.len(), width_px as usize * height_px as usize, "mask size and data differ");
        Self { width_px, height_px, inside }
    }

    /// A mask that holds every pixel.
    pub fn full(width_px: u32, height_px: u32) -> Self {
        Self::new(width_px, height_px, vec![true; width_px as usize * height_px as usize])
    }

    /// Whether the pixel nearest to `px` (pixel centres are integers) lies in the picture and on the surface.
    pub fn contains(&self, px: [f32; 2]) -> bool {
        let (x, y) = ((px[0] + 0.5).floor(), (px[1] + 0.5).floor());
        x >= 0.0
            && y >= 0.0
            && x < self.width_px as f32
            && y < self.height_px as f32
            && self.inside[y as usize * self.width_px as usize + x as usize]
    }

    /// The pixels whose whole square of side `2 * radius_px + 1` is inside; beyond the picture counts as outside.
    pub fn eroded(&self, radius_px: u32) -> Mask {
        let (w, h, r) = (self.width_px as usize, self.height_px as usize, radius_px as usize);
        let full = 2 * r + 1;
        // Run length of inside pixels that end at each place: an exact erosion in one read of the row or column.
        let mut rows = vec![false; w * h];
        for y in 0..h {
            let mut run = 0;
            for x in 0..w {
                run = if self.inside[y * w + x] { run + 1 } else { 0 };
                if run >= full {
                    rows[y * w + x - r] = true;
                }
            }
        }
        let mut inside = vec![false; w * h];
        let mut runs = vec![0_usize; w];
        for y in 0..h {
            for x in 0..w {
                runs[x] = if rows[y * w + x] { runs[x] + 1 } else { 0 };
                if runs[x] >= full {
                    inside[(y - r) * w + x] = true;
                }
            }
        }
        Mask { width_px: self.width_px, height_px: self.height_px, inside }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn contains_rounds_to_the_nearest_pixel() {
        let m = Mask::new(2, 1, vec![true, false]);
        assert!(m.contains([-0.4, 0.4]) && m.contains([0.4, 0.0]));
        assert!(!m.contains([0.6, 0.0]) && !m.contains([-0.6, 0.0]) && !m.contains([0.0, 0.6]));
        assert!(!m.contains([f32::NAN, 0.0]));
    }

    proptest! {
        #[test]
        fn erosion_is_the_minimum_over_the_square(
            flags in proptest::collection::vec(proptest::bool::weighted(0.9), 9 * 7),
            r in 0_u32..3,
        ) {
            let m = Mask::new(9, 7, flags);
            let e = m.eroded(r);
            for y in 0..7_i32 {
                for x in 0..9_i32 {
                    let r = r as i32;
                    let all = (-r..=r).all(|dy| (-r..=r).all(|dx| m.contains([(x + dx) as f32, (y + dy) as f32])));
                    prop_assert_eq!(e.inside[(y * 9 + x) as usize], all);
                }
            }
        }
    }
}
