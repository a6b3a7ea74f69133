//! The published warp, kept as reference: a sum of r^2 log r over a square grid, with the border pinned at 16 points.

use super::log::ln;
use crate::{CodecError, Result};
use faer::prelude::*;
use glam::DVec2;

/// Points of the circle that are carried to themselves, at k pi/8.
const BORDER_POINTS: u32 = 16;

/// How a [`GridPlate`] is fitted.
#[derive(Debug, Clone, PartialEq)]
pub struct GridPlateOptions {
    /// Centres a side, n: the grid covers [-1, 1]^2. From 2 to 256.
    pub side: usize,
    /// Tikhonov weight epsilon.
    pub epsilon: f64,
    /// The published rule leaves epsilon out and solves least squares by QR when n^2 is no more than the landmarks. It
    /// folds: the systems are near singular.
    pub least_squares_if_few_centres: bool,
    /// Factor of each centre's column, lambda_b / lambda_a there, row by row from (-1, -1); none for 1.
    pub centre_weights: Option<Vec<f64>>,
}

impl Default for GridPlateOptions {
    fn default() -> Self {
        Self { side: 16, epsilon: 1e-3, least_squares_if_few_centres: false, centre_weights: None }
    }
}

/// f(z) = sum_j alpha_j w_j r_j^2 log r_j, r_j the distance from centre j of the grid (Yueh, Gu, Lin, Wu, Yau, "Conformal
/// surface morphing with applications on facial expressions", section on landmark matching).
#[derive(Debug, Clone)]
pub struct GridPlate {
    centres: Vec<DVec2>,
    weights: Vec<DVec2>,
}

impl GridPlate {
    /// Fits `from` and the 16 border points to `to` and themselves.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] for options out of range, landmarks that are not finite, or a system that cannot be solved.
    pub fn fit(from: &[DVec2], to: &[DVec2], options: &GridPlateOptions) -> Result<Self> {
        let n = options.side;
        let factor = options.centre_weights.clone().unwrap_or_else(|| vec![1.0; n * n]);
        if !(2..=256).contains(&n) || factor.len() != n * n || from.len() != to.len() || options.epsilon.is_nan() {
            return Err(CodecError::Mesh(format!(
                "a grid of {n} x {n} centres with {} weights, {} landmarks here and {} there",
                factor.len(),
                from.len(),
                to.len()
            )));
        }
        let border = (0..BORDER_POINTS).map(|k| f64::from(k) * std::f64::consts::PI / 8.0);
        let border = border.map(|t| DVec2::new(libm::cos(t), libm::sin(t)));
        let pairs: Vec<(DVec2, DVec2)> =
            from.iter().copied().zip(to.iter().copied()).chain(border.map(|b| (b, b))).collect();
        let step = 2.0 / (n - 1) as f64;
        let centres: Vec<DVec2> =
            (0..n * n).map(|j| DVec2::new((j % n) as f64, (j / n) as f64) * step - DVec2::ONE).collect();
        let s = Mat::from_fn(pairs.len(), n * n, |i, j| factor[j] * kernel(pairs[i].0.distance_squared(centres[j])));
        let q = Mat::from_fn(pairs.len(), 2, |i, k| pairs[i].1[k]);
        let alpha = if options.least_squares_if_few_centres && n * n <= pairs.len() {
            s.qr().solve_lstsq(&q)
        } else {
            tikhonov(&s, &q, options.epsilon)?
        };
        let weights: Vec<DVec2> =
            factor.iter().enumerate().map(|(j, &w)| DVec2::new(alpha[(j, 0)], alpha[(j, 1)]) * w).collect();
        if weights.iter().any(|w| !w.is_finite()) {
            return Err(CodecError::Mesh("the landmarks cannot be fitted by a grid of centres".into()));
        }
        Ok(Self { centres, weights })
    }

    /// Image of `z`.
    pub fn apply(&self, z: DVec2) -> DVec2 {
        self.centres.iter().zip(&self.weights).map(|(&c, &w)| w * kernel(z.distance_squared(c))).sum()
    }
}

/// (eps I + S^T S) alpha = S^T q, solved as alpha = S^T (eps I + S S^T)^-1 q: the same alpha from a system the size of
/// the landmarks instead of the centres.
fn tikhonov(s: &Mat<f64>, q: &Mat<f64>, epsilon: f64) -> Result<Mat<f64>> {
    let mut normal = s * s.transpose();
    for i in 0..normal.nrows() {
        normal[(i, i)] += epsilon;
    }
    let factor = normal
        .llt(faer::Side::Lower)
        .map_err(|_| CodecError::Mesh("the landmarks' system is singular; take a larger epsilon".into()))?;
    Ok(s.transpose() * factor.solve(q))
}

/// r^2 log r from r^2.
#[inline]
fn kernel(r2: f64) -> f64 {
    0.5 * r2 * ln(r2.max(1e-30))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spiral(n: u32) -> Vec<DVec2> {
        (0..n).map(|k| DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / f64::from(n)).sqrt() * 0.9).collect()
    }

    fn worst(plate: &GridPlate, from: &[DVec2], to: &[DVec2]) -> f64 {
        from.iter().zip(to).map(|(p, q)| plate.apply(*p).distance(*q)).fold(0.0, f64::max)
    }

    #[test]
    fn comes_near_landmarks_and_border_points() {
        let from = spiral(50);
        let to: Vec<DVec2> = from.iter().map(|p| *p + DVec2::new((2.0 * p.y).sin(), p.x.cos()) * 0.02).collect();
        let plate = GridPlate::fit(&from, &to, &GridPlateOptions::default()).unwrap();
        assert!(worst(&plate, &from, &to) < 1e-2, "{}", worst(&plate, &from, &to));
        let border: Vec<DVec2> =
            (0..16).map(|k| DVec2::from_angle(f64::from(k) * std::f64::consts::PI / 8.0)).collect();
        assert!(worst(&plate, &border, &border) < 2e-2);
    }

    #[test]
    fn the_small_system_gives_the_published_solution() {
        let s = Mat::from_fn(5, 9, |i, j| ((i * 9 + j) as f64 * 0.7).sin());
        let q = Mat::from_fn(5, 2, |i, k| (i + 3 * k) as f64);
        let alpha = tikhonov(&s, &q, 1e-3).unwrap();
        let left = s.transpose() * (&s * &alpha) + &alpha * Scale(1e-3);
        let right = s.transpose() * &q;
        assert!((left - right).norm_max() < 1e-9);
    }

    #[test]
    fn few_centres_give_the_least_squares_fit() {
        // Data made by the kernel itself come back exactly from least squares, not from Tikhonov.
        let from = spiral(60);
        let options = GridPlateOptions { side: 3, least_squares_if_few_centres: true, ..Default::default() };
        let plate = GridPlate::fit(&from, &from, &options).unwrap();
        let ridge = GridPlate::fit(&from, &from, &GridPlateOptions { side: 3, ..Default::default() }).unwrap();
        let cost = |p: &GridPlate| from.iter().map(|z| p.apply(*z).distance_squared(*z)).sum::<f64>();
        assert!(cost(&plate) < cost(&ridge) + 0.1);
        assert!(plate.weights != ridge.weights);
    }

    #[test]
    fn centre_weights_scale_columns_and_bad_options_are_refused() {
        let from = spiral(20);
        let fit = |options: &GridPlateOptions| GridPlate::fit(&from, &from, options);
        let plain = GridPlateOptions { side: 6, ..Default::default() };
        // Twice the column with a quarter of the penalty is the same function.
        let doubled =
            GridPlateOptions { centre_weights: Some(vec![2.0; 36]), epsilon: 4.0 * plain.epsilon, ..plain.clone() };
        let z = DVec2::new(0.1, 0.6);
        assert!(fit(&plain).unwrap().apply(z).distance(fit(&doubled).unwrap().apply(z)) < 1e-6);
        assert!(fit(&GridPlateOptions { side: 1, ..plain.clone() }).is_err());
        assert!(fit(&GridPlateOptions { centre_weights: Some(vec![1.0; 7]), ..plain.clone() }).is_err());
        assert!(fit(&GridPlateOptions { epsilon: f64::NAN, ..plain.clone() }).is_err());
        assert!(GridPlate::fit(&[DVec2::NAN], &[DVec2::ZERO], &plain).is_err());
    }
}
