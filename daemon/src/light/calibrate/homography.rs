//! Plane to plane by the normalised direct linear transform (R. Hartley, "In defense of the eight-point algorithm",
//! PAMI 19(6), 1997; Hartley and Zisserman, "Multiple View Geometry", algorithm 4.2).

use faer::Mat;
use glam::{DMat3, DVec2, DVec3};

/// Homography that takes `from` to `to`, of Frobenius norm one up to normalisation; `None` for fewer than four points or
/// points that determine none, such as points on one line.
pub(super) fn homography(from: &[DVec2], to: &[DVec2]) -> Option<DMat3> {
    let (from_norm, to_norm) = (normalisation(from)?, normalisation(to)?);
    let n = from.len().min(to.len());
    if n < 4 {
        return None;
    }
    let mut a = Mat::<f64>::zeros(2 * n, 9);
    for (i, (from, to)) in from.iter().zip(to).enumerate() {
        let (p, q) = ((from_norm * from.extend(1.0)).to_array(), to_norm * to.extend(1.0));
        for (k, p) in p.into_iter().enumerate() {
            a[(2 * i, k)] = p;
            a[(2 * i, 6 + k)] = -q.x * p;
            a[(2 * i + 1, 3 + k)] = p;
            a[(2 * i + 1, 6 + k)] = -q.y * p;
        }
    }
    let h = null_vector(&a, 1e-7)?;
    let normalised = DMat3::from_cols_array(&[h[0], h[3], h[6], h[1], h[4], h[7], h[2], h[5], h[8]]);
    let found = to_norm.inverse() * normalised * from_norm;
    found.is_finite().then_some(found)
}

/// The point where a homography takes another.
pub(super) fn transfer(h: DMat3, p: DVec2) -> DVec2 {
    let q = h * p.extend(1.0);
    q.truncate() / q.z
}

/// Unit vector x of least |a x|; `None` when another comes within `ratio` of it, relative to the largest |a x|.
pub(super) fn null_vector(a: &Mat<f64>, ratio: f64) -> Option<Vec<f64>> {
    let (rows, columns) = (a.nrows(), a.ncols());
    if rows + 1 < columns || !(0..columns).all(|c| (0..rows).all(|r| a[(r, c)].is_finite())) {
        return None;
    }
    let svd = a.svd().ok()?;
    let singular = svd.S().column_vector();
    (singular[columns - 2] > ratio * singular[0]).then(|| (0..columns).map(|i| svd.V()[(i, columns - 1)]).collect())
}

/// Takes the mean to the origin and the mean distance from it to the square root of two.
fn normalisation(points: &[DVec2]) -> Option<DMat3> {
    let n = points.len() as f64;
    let mean = points.iter().sum::<DVec2>() / n;
    let distance = points.iter().map(|p| (*p - mean).length()).sum::<f64>() / n;
    let scale = std::f64::consts::SQRT_2 / distance;
    (scale.is_finite() && scale > 0.0).then(|| {
        DMat3::from_cols(
            DVec3::new(scale, 0.0, 0.0),
            DVec3::new(0.0, scale, 0.0),
            DVec3::new(-scale * mean.x, -scale * mean.y, 1.0),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn grid() -> Vec<DVec2> {
        (0..20).map(|i| DVec2::new(f64::from(i % 5) * 20.0 - 40.0, f64::from(i / 5) * 20.0)).collect()
    }

    proptest! {
        #[test]
        fn a_homography_comes_back(c in prop::array::uniform8(-1.0f64..1.0)) {
            let h = DMat3::from_cols_array(&[
                4.0 + c[0], c[1], 2e-3 * c[2], c[3], 5.0 + c[4], 2e-3 * c[5], 300.0 * c[6], 200.0 * c[7], 1.0,
            ]);
            let to: Vec<DVec2> = grid().iter().map(|&p| transfer(h, p)).collect();
            let found = homography(&grid(), &to).unwrap();
            for (&from, to) in grid().iter().zip(&to) {
                prop_assert!((transfer(found, from) - *to).length() < 1e-8);
            }
            prop_assert!(homography(&grid()[..4], &to[..4]).is_none(), "four points of one row");
        }
    }

    #[test]
    fn points_that_determine_nothing_give_nothing() {
        let line: Vec<DVec2> = (0..9).map(|i| DVec2::splat(f64::from(i))).collect();
        let square: Vec<DVec2> = (0..9).map(|i| DVec2::new(f64::from(i % 3), f64::from(i / 3))).collect();
        assert!(homography(&square, &square).is_some());
        assert!(homography(&line, &line).is_none());
        assert!(homography(&line, &square).is_none());
        assert!(homography(&square[..3], &square[..3]).is_none());
        assert!(homography(&[DVec2::ZERO; 9], &square).is_none());
        assert!(homography(&square, &[DVec2::NAN; 9]).is_none());
    }
}
