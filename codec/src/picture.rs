//! An 8-bit grey picture.

/// Grey picture, row-major, first row on top.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct GreyPicture {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// `width_px * height_px` grey levels.
    pub pixels: Vec<u8>,
}

impl GreyPicture {
    /// A picture from its grey levels.
    ///
    /// # Panics
    /// When `pixels.len() != width_px * height_px`.
    pub fn new(width_px: u32, height_px: u32, pixels: Vec<u8>) -> Self {
        assert_eq!(pixels.len(), width_px as usize * height_px as usize, "picture size and data differ");
        Self { width_px, height_px, pixels }
    }

    /// One grey level everywhere.
    pub fn filled(width_px: u32, height_px: u32, level: u8) -> Self {
        Self { width_px, height_px, pixels: vec![level; width_px as usize * height_px as usize] }
    }

    /// Pixel centre (x right, y down, first pixel at 0,0) of an OBJ texture coordinate (u right, v up, 0..1).
    pub fn uv_to_px(&self, uv: [f32; 2]) -> [f32; 2] {
        [uv[0] * self.width_px as f32 - 0.5, (1.0 - uv[1]) * self.height_px as f32 - 0.5]
    }

    /// Inverse of [`Self::uv_to_px`].
    pub fn px_to_uv(&self, px: [f32; 2]) -> [f32; 2] {
        [(px[0] + 0.5) / self.width_px as f32, 1.0 - (px[1] + 0.5) / self.height_px as f32]
    }

    /// Bilinear sample at a pixel position, clamped to the border.
    pub fn sample(&self, px: [f32; 2]) -> f32 {
        let (w, h) = (self.width_px as usize, self.height_px as usize);
        let x = px[0].clamp(0.0, (w - 1) as f32);
        let y = px[1].clamp(0.0, (h - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let at = |x: usize, y: usize| f32::from(self.pixels[y * w + x]);
        let top = at(x0, y0) * (1.0 - fx) + at(x1, y0) * fx;
        let bottom = at(x0, y1) * (1.0 - fx) + at(x1, y1) * fx;
        top * (1.0 - fy) + bottom * fy
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uv_and_pixels_are_inverse_and_v_points_up() {
        let p = GreyPicture::filled(640, 480, 0);
        let uv = p.px_to_uv([12.25, 7.5]);
        let px = p.uv_to_px(uv);
        assert!((px[0] - 12.25).abs() < 1e-3 && (px[1] - 7.5).abs() < 1e-3);
        assert!(p.px_to_uv([0.0, 0.0])[1] > p.px_to_uv([0.0, 479.0])[1]);
    }

    #[test]
    fn sampling_is_exact_on_a_ramp() {
        let p = GreyPicture::new(3, 2, vec![0, 10, 20, 100, 110, 120]);
        assert!((p.sample([0.5, 0.5]) - 55.0).abs() < 1e-4);
        assert!((p.sample([-5.0, 9.0]) - 100.0).abs() < 1e-4);
    }
}
