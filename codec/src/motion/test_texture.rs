//! A smooth random texture known at every real position, for tests with sub-pixel truth.

use super::FloatPicture;
use std::f32::consts::TAU;

/// Affine warp of the picture plane: texture at `p` is seen at `apply(p)`.
#[derive(Debug, Clone, Copy)]
pub struct Warp {
    matrix: [f32; 4],
    shift_px: [f32; 2],
}

impl Warp {
    pub fn still() -> Self {
        Self::shift(0.0, 0.0)
    }

    pub fn shift(dx: f32, dy: f32) -> Self {
        Self { matrix: [1.0, 0.0, 0.0, 1.0], shift_px: [dx, dy] }
    }

    /// `matrix` (row-major) about (75, 60), then a shift.
    pub fn about_centre(matrix: [f32; 4], shift_px: [f32; 2]) -> Self {
        let [a, b, c, d] = matrix;
        Self { matrix, shift_px: [75.0 - 75.0 * a - 60.0 * b + shift_px[0], 60.0 - 75.0 * c - 60.0 * d + shift_px[1]] }
    }

    pub fn apply(&self, p: [f32; 2]) -> [f32; 2] {
        let [a, b, c, d] = self.matrix;
        [a * p[0] + b * p[1] + self.shift_px[0], c * p[0] + d * p[1] + self.shift_px[1]]
    }

    fn invert(&self, q: [f32; 2]) -> [f32; 2] {
        let [a, b, c, d] = self.matrix;
        let (x, y, det) = (q[0] - self.shift_px[0], q[1] - self.shift_px[1], a * d - b * c);
        [(d * x - b * y) / det, (a * y - c * x) / det]
    }
}

/// Wave vector (rad/px) and phase of 48 waves of 5 to 24 px with fixed random directions.
fn waves() -> Vec<[f32; 3]> {
    let mut state = 0x9e37_79b9_u32;
    let mut random = move || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let wave = |_| {
        let (angle, phase, number) = (TAU * random(), TAU * random(), TAU / (5.0 + 19.0 * random()));
        [number * angle.cos(), number * angle.sin(), phase]
    };
    (0..48).map(wave).collect()
}

/// The warped texture, of about unit variance, as a picture.
pub fn render(warp: &Warp, width_px: u32, height_px: u32) -> FloatPicture {
    let waves = waves();
    let at = |i: u32| {
        let [x, y] = warp.invert([(i % width_px) as f32, (i / width_px) as f32]);
        waves.iter().map(|[kx, ky, phase]| (kx * x + ky * y + phase).sin()).sum::<f32>() / 24.0_f32.sqrt()
    };
    FloatPicture::new(width_px, height_px, (0..width_px * height_px).map(at).collect())
}

/// Middle value.
pub fn median(values: &[f32]) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    sorted[sorted.len() / 2]
}
