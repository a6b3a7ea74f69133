//! Thin-plate spline of the plane with affine part: the warp after Möbius for scans, whose border slips.

use super::kernel_sum::add_kernels;
use super::log::ln;
use crate::{CodecError, Result};
use faer::prelude::*;
use glam::DVec2;

/// f(z) = c0 + c1 x + c2 y + sum_k w_k U(|z - p_k|), U(r) = r^2 ln r^2 (Bookstein 1989), smoothed (Wahba 1990).
#[derive(Debug, Clone)]
pub struct ThinPlate {
    centres: Vec<DVec2>,
    weights: Vec<DVec2>,
    affine: [DVec2; 3],
}

impl ThinPlate {
    /// Fits `from` to `to`; `smoothing` >= 0 is added to the kernel's diagonal (0 interpolates).
    ///
    /// # Errors
    /// [`CodecError::Mesh`] with fewer than three points or points all on one line.
    pub fn fit(from: &[DVec2], to: &[DVec2], smoothing: f64) -> Result<Self> {
        let n = from.len();
        if n < 3 || to.len() != n {
            return Err(CodecError::Mesh(format!("a thin plate needs three or more landmarks, got {n}")));
        }
        let m = n + 3;
        let mut a = Mat::<f64>::zeros(m, m);
        let mut rhs = Mat::<f64>::zeros(m, 2);
        for i in 0..n {
            for j in 0..i {
                let u = kernel(from[i].distance_squared(from[j]));
                a[(i, j)] = u;
                a[(j, i)] = u;
            }
            a[(i, i)] = smoothing;
            for (k, v) in [1.0, from[i].x, from[i].y].into_iter().enumerate() {
                a[(i, n + k)] = v;
                a[(n + k, i)] = v;
            }
            rhs[(i, 0)] = to[i].x;
            rhs[(i, 1)] = to[i].y;
        }
        let x = a.partial_piv_lu().solve(&rhs);
        let row = |i: usize| DVec2::new(x[(i, 0)], x[(i, 1)]);
        let plate = Self {
            centres: from.to_vec(),
            weights: (0..n).map(row).collect(),
            affine: [row(n), row(n + 1), row(n + 2)],
        };
        if plate.weights.iter().chain(&plate.affine).any(|w| !w.is_finite()) {
            return Err(CodecError::Mesh("the landmarks lie on one line or coincide".into()));
        }
        Ok(plate)
    }

    /// Image of `z`.
    pub fn apply(&self, z: DVec2) -> DVec2 {
        let mut sum = self.affine(z);
        for (&c, &w) in self.centres.iter().zip(&self.weights) {
            sum += w * kernel(z.distance_squared(c));
        }
        sum
    }

    /// Images of many points, as [`Self::apply`] gives them, in half the time.
    pub fn images(&self, points: &[DVec2]) -> Vec<DVec2> {
        let terms = self.centres.iter().zip(&self.weights).map(|(&c, &w)| (c, w, |distance2, _| kernel(distance2)));
        let mut images: Vec<DVec2> = points.iter().map(|&z| self.affine(z)).collect();
        add_kernels(points, &mut images, terms);
        images
    }

    fn affine(&self, z: DVec2) -> DVec2 {
        self.affine[0] + self.affine[1] * z.x + self.affine[2] * z.y
    }
}

/// r^2 ln r^2 from r^2.
#[inline(always)]
fn kernel(r2: f64) -> f64 {
    r2 * ln(r2.max(1e-30))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn spiral(n: u32) -> Vec<DVec2> {
        (0..n).map(|k| DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / f64::from(n)).sqrt()).collect()
    }

    proptest! {
        #[test]
        fn interpolates_landmarks(seed in 0u64..1000) {
            let from = spiral(30);
            let to: Vec<DVec2> = from.iter().enumerate()
                .map(|(i, p)| *p + DVec2::new((i as f64 + seed as f64).sin(), (i as f64 * 1.3).cos()) * 0.02).collect();
            let plate = ThinPlate::fit(&from, &to, 0.0).unwrap();
            for (p, q) in from.iter().zip(&to) {
                prop_assert!((plate.apply(*p) - *q).length() < 1e-8);
            }
            let images = plate.images(&from);
            prop_assert!(from.iter().zip(images).all(|(&p, image)| plate.apply(p) == image));
        }
    }

    #[test]
    fn reproduces_affine_maps_everywhere_even_smoothed() {
        let from = spiral(20);
        let affine = |p: DVec2| DVec2::new(0.1 + 1.2 * p.x - 0.3 * p.y, -0.2 + 0.1 * p.x + 0.9 * p.y);
        let to: Vec<DVec2> = from.iter().map(|&p| affine(p)).collect();
        let plate = ThinPlate::fit(&from, &to, 0.1).unwrap();
        let z = DVec2::new(0.37, -0.81);
        assert!((plate.apply(z) - affine(z)).length() < 1e-9);
    }

    #[test]
    fn refuses_points_on_a_line() {
        let line: Vec<DVec2> = (0..5).map(|i| DVec2::new(f64::from(i), 0.0)).collect();
        assert!(ThinPlate::fit(&line, &line, 0.0).is_err());
        assert!(ThinPlate::fit(&line[..2], &line[..2], 0.0).is_err());
    }
}
