//! Affine alignment of one window over a long interval: takes back the drift that translation from picture to picture
//! gathers, and judges likeness free of the rotation and stretch of the skin.
//!
//! Inverse-compositional Lucas-Kanade (Baker, Matthews: Lucas-Kanade 20 years on, IJCV 2004, section 3.2) with the affine
//! warp of Shi, Tomasi: Good features to track, CVPR 1994, at the finest level only: the start is known to a pixel or so.

use super::pyramid::{Level, PAD_PX};

const ITERATIONS: usize = 10;
/// A step that moves the centre less than this and the rim about as little ends the iteration.
const EPSILON_PX: f32 = 0.01;
/// Smallest pivot, as a share of the largest diagonal, of a normal matrix that is still solved.
const MIN_PIVOT: f32 = 1e-4;

/// Where a window was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Alignment {
    /// Centre, px.
    pub px: [f32; 2],
    /// Zero-mean normalised cross-correlation of the window and the warped one.
    pub zncc: f32,
}

/// Windows of one size, with the room to align them.
pub(super) struct Aligner {
    half: usize,
    template: Vec<f32>,
    /// Steepest-descent images {gx x, gx y, gy x, gy y, gx, gy}, x and y in units of the half window.
    descent: Vec<[f32; 6]>,
    warped: Vec<f32>,
}

impl Aligner {
    /// For odd windows of 3 to 25 px.
    pub fn new(window_px: u32) -> Self {
        let (half, count) = (window_px as usize / 2, (window_px * window_px) as usize);
        Self { half, template: vec![0.0; count], descent: vec![[0.0; 6]; count], warped: vec![0.0; count] }
    }

    /// Aligns the window about `at` in `from` with `to`, beginning at `start`. `None` where the window cannot fix an affine
    /// map or the search leaves the picture.
    pub fn align(&mut self, from: &Level, at: [f32; 2], to: &Level, start: [f32; 2]) -> Option<Alignment> {
        if !from.contains(at) {
            return None;
        }
        self.set_template(from, at);
        let mut normal = [[0.0_f32; 6]; 6];
        for d in &self.descent {
            for i in 0..6 {
                for j in 0..=i {
                    normal[i][j] += d[i] * d[j];
                }
            }
        }
        let factor = cholesky(normal)?;
        let (mut linear, mut centre) = ([1.0, 0.0, 0.0, 1.0], start);
        for _ in 0..ITERATIONS {
            self.warp(to, linear, centre)?;
            let mut gradient = [0.0_f32; 6];
            for ((d, w), t) in self.descent.iter().zip(&self.warped).zip(&self.template) {
                for k in 0..6 {
                    gradient[k] += d[k] * (w - t);
                }
            }
            let step = solve(&factor, gradient);
            (linear, centre) = compose_inverse(linear, centre, step, self.half as f32)?;
            if step.iter().all(|s| s.abs() < EPSILON_PX) {
                break;
            }
        }
        self.warp(to, linear, centre)?;
        to.contains(centre).then_some(Alignment { px: centre, zncc: self.correlation() })
    }

    fn set_template(&mut self, from: &Level, at: [f32; 2]) {
        let n = 2 * self.half + 1;
        let half = self.half as f32;
        for i in 0..n * n {
            let (x, y) = ((i % n) as f32 - half, (i / n) as f32 - half);
            let value = |dx: f32, dy: f32| from.sample(at[0] + x + dx, at[1] + y + dy);
            let (gx, gy) = (0.5 * (value(1.0, 0.0) - value(-1.0, 0.0)), 0.5 * (value(0.0, 1.0) - value(0.0, -1.0)));
            let (u, v) = (x / half, y / half);
            self.template[i] = value(0.0, 0.0);
            self.descent[i] = [gx * u, gx * v, gy * u, gy * v, gx, gy];
        }
    }

    /// Samples `to` over the warped window; `None` where a corner of it leaves the padded picture.
    fn warp(&mut self, to: &Level, linear: [f32; 4], centre: [f32; 2]) -> Option<()> {
        let (n, half) = (2 * self.half + 1, self.half as f32);
        let [a, b, c, d] = linear;
        let reach = [half * (a.abs() + b.abs()), half * (c.abs() + d.abs())];
        let room = PAD_PX as f32 - 2.0;
        let size = [to.width as f32, to.height as f32];
        if !(0..2).all(|k| centre[k] - reach[k] > -room && centre[k] + reach[k] < size[k] + room) {
            return None;
        }
        for (row, y) in self.warped.chunks_exact_mut(n).zip(0..) {
            let y = y as f32 - half;
            for (out, x) in row.iter_mut().zip(0..) {
                let x = x as f32 - half;
                *out = to.sample(centre[0] + a * x + b * y, centre[1] + c * x + d * y);
            }
        }
        Some(())
    }

    fn correlation(&self) -> f32 {
        let count = self.template.len() as f32;
        let mean = |v: &[f32]| v.iter().sum::<f32>() / count;
        let (p, q) = (mean(&self.template), mean(&self.warped));
        let mut sums = [0.0_f32; 3];
        for (t, w) in self.template.iter().zip(&self.warped) {
            let (t, w) = (t - p, w - q);
            sums = [sums[0] + t * t, sums[1] + w * w, sums[2] + t * w];
        }
        let power = sums[0] * sums[1];
        if power > 0.0 { sums[2] / power.sqrt() } else { 0.0 }
    }
}

impl Level {
    /// Bilinear sample at a position in the padded picture.
    fn sample(&self, x: f32, y: f32) -> f32 {
        let (x, y) = (x + PAD_PX as f32, y + PAD_PX as f32);
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - row as f32);
        let i = row * self.stride + column;
        let (top, bottom) = (&self.padded[i..i + 2], &self.padded[i + self.stride..i + self.stride + 2]);
        let (t, b) = (top[0] + fx * (top[1] - top[0]), bottom[0] + fx * (bottom[1] - bottom[0]));
        t + fy * (b - t)
    }
}

/// The warp `(linear, centre)` after the inverse of the step found on the template.
fn compose_inverse(linear: [f32; 4], centre: [f32; 2], step: [f32; 6], half: f32) -> Option<([f32; 4], [f32; 2])> {
    let [a, b, c, d] = [1.0 + step[0] / half, step[1] / half, step[2] / half, 1.0 + step[3] / half];
    let determinant = a * d - b * c;
    // A window that folds or grows without bound is lost.
    if !(0.25..4.0).contains(&determinant) {
        return None;
    }
    let inverse = [d, -b, -c, a].map(|v| v / determinant);
    let product = [
        linear[0] * inverse[0] + linear[1] * inverse[2],
        linear[0] * inverse[1] + linear[1] * inverse[3],
        linear[2] * inverse[0] + linear[3] * inverse[2],
        linear[2] * inverse[1] + linear[3] * inverse[3],
    ];
    let moved = [
        centre[0] - product[0] * step[4] - product[1] * step[5],
        centre[1] - product[2] * step[4] - product[3] * step[5],
    ];
    Some((product, moved))
}

/// Lower Cholesky factor of a symmetric matrix given by its lower half; `None` when it is nearly singular.
pub(super) fn cholesky<const N: usize>(mut m: [[f32; N]; N]) -> Option<[[f32; N]; N]> {
    let largest = (0..N).map(|i| m[i][i]).fold(0.0, f32::max);
    for i in 0..N {
        for j in 0..=i {
            let inner: f32 = (0..j).map(|k| m[i][k] * m[j][k]).sum();
            let rest = m[i][j] - inner;
            if i > j {
                m[i][j] = rest / m[j][j];
            } else if rest > MIN_PIVOT * largest {
                m[i][i] = rest.sqrt();
            } else {
                return None;
            }
        }
    }
    Some(m)
}

/// Solves `L Lᵀ x = b`.
pub(super) fn solve<const N: usize>(factor: &[[f32; N]; N], mut b: [f32; N]) -> [f32; N] {
    for i in 0..N {
        let inner: f32 = (0..i).map(|k| factor[i][k] * b[k]).sum();
        b[i] = (b[i] - inner) / factor[i][i];
    }
    for i in (0..N).rev() {
        let inner: f32 = (i + 1..N).map(|k| factor[k][i] * b[k]).sum();
        b[i] = (b[i] - inner) / factor[i][i];
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Pyramid;
    use crate::motion::test_texture::{Warp, median, render};

    fn aligned(warp: &Warp, off_px: f32) -> Vec<(f32, f32)> {
        let (a, b) = (Pyramid::new(&render(&Warp::still(), 150, 120), 1), Pyramid::new(&render(warp, 150, 120), 1));
        let mut aligner = Aligner::new(15);
        let one = |i: i32| {
            let at = [30.25 + 10.5 * (i % 9) as f32, 28.5 + 9.75 * (i / 9) as f32];
            let truth = warp.apply(at);
            let found = aligner.align(a.finest(), at, b.finest(), [truth[0] + off_px, truth[1] - off_px])?;
            Some(((found.px[0] - truth[0]).hypot(found.px[1] - truth[1]), found.zncc))
        };
        (0..63).filter_map(one).collect()
    }

    #[test]
    fn rotation_and_stretch_are_followed_exactly() {
        for matrix in [[0.9962, -0.0872, 0.0872, 0.9962], [1.08, 0.03, -0.02, 0.93], [1.0, 0.1, 0.0, 1.0]] {
            let found = aligned(&Warp::about_centre(matrix, [0.3, -0.2]), 0.4);
            let errors: Vec<f32> = found.iter().map(|f| f.0).collect();
            assert!(found.len() >= 58, "{matrix:?}: {} of 63", found.len());
            assert!(median(&errors) < 0.03, "{matrix:?}: {}", median(&errors));
            assert!(found.iter().filter(|f| f.1 > 0.99).count() >= 56);
        }
    }

    #[test]
    fn other_texture_and_flat_windows_are_not_alike() {
        let (a, b) = (render(&Warp::still(), 60, 50), render(&Warp::shift(4000.0, 900.0), 60, 50));
        let (a, b) = (Pyramid::new(&a, 1), Pyramid::new(&b, 1));
        let mut aligner = Aligner::new(15);
        let mut alike = |x: i32| {
            let at = [10.0 + x as f32, 25.0];
            aligner.align(a.finest(), at, b.finest(), at).is_some_and(|f| f.zncc > 0.9)
        };
        assert!((0..40).filter(|x| alike(*x)).count() <= 2);
        let flat = Pyramid::new(&crate::motion::FloatPicture::new(60, 50, vec![0.0; 3000]), 1);
        assert_eq!(aligner.align(flat.finest(), [30.0, 25.0], a.finest(), [30.0, 25.0]), None);
        assert_eq!(aligner.align(a.finest(), [-3.0, 25.0], a.finest(), [30.0, 25.0]), None);
        assert_eq!(aligner.align(a.finest(), [30.0, 25.0], a.finest(), [-1e9, f32::NAN]), None);
    }

    #[test]
    fn the_normal_equations_are_solved() {
        let mut m = [[0.0_f32; 6]; 6];
        for (i, row) in m.iter_mut().enumerate() {
            for (j, v) in row.iter_mut().enumerate() {
                *v = 1.0 / (1.0 + i.abs_diff(j) as f32) + if i == j { 2.0 } else { 0.0 };
            }
        }
        let x = [1.0, -2.0, 3.0, 0.5, 0.0, -1.0];
        let b: [f32; 6] = std::array::from_fn(|i| (0..6).map(|j| m[i][j] * x[j]).sum());
        let got = solve(&cholesky(m).unwrap(), b);
        assert!(got.iter().zip(&x).all(|(g, w)| (g - w).abs() < 1e-5));
        assert!(cholesky([[1.0; 6]; 6]).is_none());
    }
}
