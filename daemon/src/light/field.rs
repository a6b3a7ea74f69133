//! Pictures of f32 levels, as corner detection blurs and samples them.

use gv3_codec::GreyPicture;

/// Levels of a picture, row-major.
#[derive(Debug, Clone)]
pub(super) struct Field {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` levels.
    pub values: Vec<f32>,
}

impl Field {
    /// The grey levels of a picture.
    pub fn from_picture(picture: &GreyPicture) -> Self {
        let values = picture.pixels.iter().map(|&level| f32::from(level)).collect();
        Self { width: picture.width_px as usize, height: picture.height_px as usize, values }
    }

    /// After a Gaussian of standard deviation `sigma_px`, cut at three of them; beyond the border the border goes on.
    pub fn blurred(&self, sigma_px: f64) -> Self {
        let kernel = gaussian(sigma_px);
        let reach = kernel.len() / 2;
        let (w, h) = (self.width, self.height);
        let mut across = vec![0.0f32; w * h];
        let mut padded = vec![0.0f32; w + 2 * reach];
        for (row, out) in self.values.chunks_exact(w).zip(across.chunks_exact_mut(w)) {
            padded[..reach].fill(row[0]);
            padded[reach..reach + w].copy_from_slice(row);
            padded[reach + w..].fill(row[w - 1]);
            for (k, &weight) in kernel.iter().enumerate() {
                for (o, v) in out.iter_mut().zip(&padded[k..k + w]) {
                    *o += weight * v;
                }
            }
        }
        let mut values = vec![0.0f32; w * h];
        for (y, out) in values.chunks_exact_mut(w).enumerate() {
            for (k, &weight) in kernel.iter().enumerate() {
                let from = (y + k).saturating_sub(reach).min(h - 1);
                for (o, v) in out.iter_mut().zip(&across[from * w..][..w]) {
                    *o += weight * v;
                }
            }
        }
        Self { width: w, height: h, values }
    }

    /// Half the size, each level the mean of four; position p becomes (p - 0.5) / 2.
    pub fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            let above = &self.values[2 * y * self.width..][..self.width];
            let below = &self.values[(2 * y + 1) * self.width..][..self.width];
            let pairs = above.chunks_exact(2).zip(below.chunks_exact(2));
            values.extend(pairs.map(|(a, b)| 0.25 * (a[0] + a[1] + b[0] + b[1])));
        }
        Self { width, height, values }
    }

    /// Whether a position is `margin` pixels or more inside the outermost pixel centres.
    pub fn holds(&self, [x, y]: [f64; 2], margin: f64) -> bool {
        let inside = |v: f64, size: usize| v >= margin && v <= size as f64 - 1.0 - margin;
        inside(x, self.width) && inside(y, self.height)
    }

    /// Bilinear sample, clamped to the border; the field is of 2 x 2 pixels or more.
    pub fn sample(&self, [x, y]: [f64; 2]) -> f32 {
        let (x, y) = (x.clamp(0.0, self.width as f64 - 1.001), y.clamp(0.0, self.height as f64 - 1.001));
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = ((x - column as f64) as f32, (y - row as f64) as f32);
        let at = row * self.width + column;
        let (a, b) = (&self.values[at..at + 2], &self.values[at + self.width..at + self.width + 2]);
        let (above, below) = (a[0] + fx * (a[1] - a[0]), b[0] + fx * (b[1] - b[0]));
        above + fy * (below - above)
    }
}

/// Weights of a Gaussian at whole numbers, their sum 1.
fn gaussian(sigma_px: f64) -> Vec<f32> {
    let reach = (3.0 * sigma_px).ceil() as i32;
    let weights: Vec<f64> = (-reach..=reach).map(|d| libm::exp(-0.5 * (f64::from(d) / sigma_px).powi(2))).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|w| (w / sum) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blur_keeps_ramps_and_spreads_a_point_by_its_sigma() {
        let ramp = Field { width: 30, height: 20, values: (0..600).map(|i| (i % 30) as f32 + 2.0).collect() };
        let blurred = ramp.blurred(1.5);
        assert!((blurred.values[10 * 30 + 15] - 17.0).abs() < 1e-4);
        let mut point = Field { width: 31, height: 31, values: vec![0.0; 961] };
        point.values[15 * 31 + 15] = 1.0;
        let spread = point.blurred(2.0);
        let moment: f32 = spread.values.iter().enumerate().map(|(i, v)| v * (i as f32 % 31.0 - 15.0).powi(2)).sum();
        assert!((spread.values.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        // Three sigma hold all but 3 % of the variance.
        assert!((moment.sqrt() - 2.0).abs() < 0.05, "{}", moment.sqrt());
    }

    #[test]
    fn halving_and_sampling_agree_on_a_plane() {
        let plane = |x: f64, y: f64| 3.0 + 0.5 * x - 0.25 * y;
        let values = (0..12 * 10).map(|i| plane(f64::from(i % 12), f64::from(i / 12)) as f32).collect();
        let field = Field { width: 12, height: 10, values };
        let half = field.halved();
        assert_eq!((half.width, half.height), (6, 5));
        for p in [[3.3, 4.7], [0.5, 0.5], [7.25, 6.0]] {
            let expected = plane(p[0], p[1]);
            assert!((f64::from(field.sample(p)) - expected).abs() < 1e-5);
            let q = p.map(|v| (v - 0.5) / 2.0);
            assert!((f64::from(half.sample(q)) - expected).abs() < 1e-5);
        }
        assert!(field.holds([2.0, 7.0], 2.0) && !field.holds([2.0, 7.1], 2.0));
    }
}
