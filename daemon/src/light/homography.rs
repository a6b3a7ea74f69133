//! Homographies from point pairs.

use glam::{DMat3, DVec2, DVec3};

/// The homography that takes `from` to `to` with least squared algebraic error, by the direct linear transformation on
/// normalized points (R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., algorithm 4.2). The
/// scale is such that the middle of `from` has a third coordinate of 1.
///
/// `None` for fewer than four pairs and for points that determine no homography: on one line, or all in one place.
///
/// # Panics
/// When the lists differ in length.
pub fn fit_homography(from: &[DVec2], to: &[DVec2]) -> Option<DMat3> {
    assert_eq!(from.len(), to.len(), "points are paired");
    let (normal_from, normal_to) = (normalization(from)?, normalization(to)?);
    let mut m = [[0.0f64; 9]; 8];
    for (p, q) in from.iter().zip(to) {
        let p = normal_from.transform_point2(*p);
        let q = normal_to.transform_point2(*q);
        // h33 = 1: the middle of the points is no point at infinity.
        let rows = [
            [p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y, q.x],
            [0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y, q.y],
        ];
        for row in rows {
            for (i, line) in m.iter_mut().enumerate() {
                for (cell, value) in line.iter_mut().zip(row) {
                    *cell += row[i] * value;
                }
            }
        }
    }
    let h = solve(m, from.len() as f64)?;
    let h = DMat3::from_cols(DVec3::new(h[0], h[3], h[6]), DVec3::new(h[1], h[4], h[7]), DVec3::new(h[2], h[5], 1.0));
    Some(normal_to.inverse() * h * normal_from)
}

/// The point that a homography takes `p` to.
#[inline]
pub fn apply_homography(h: &DMat3, p: DVec2) -> DVec2 {
    let q = *h * p.extend(1.0);
    q.truncate() / q.z
}

/// The similarity that takes the points' mean to the origin and their mean distance from it to the square root of 2.
fn normalization(points: &[DVec2]) -> Option<DMat3> {
    let n = points.len() as f64;
    let mean = points.iter().sum::<DVec2>() / n;
    let distance = points.iter().map(|p| p.distance(mean)).sum::<f64>() / n;
    if points.len() < 4 || !distance.is_finite() || distance <= 1e-12 * mean.length().max(1e-12) {
        return None;
    }
    let scale = std::f64::consts::SQRT_2 / distance;
    Some(DMat3::from_cols(DVec3::new(scale, 0.0, 0.0), DVec3::new(0.0, scale, 0.0), (-scale * mean).extend(1.0)))
}

/// Solves eight linear equations, their right side in column 8, by elimination; `None` when a pivot vanishes beside `size`.
fn solve(mut m: [[f64; 9]; 8], size: f64) -> Option<[f64; 8]> {
    for column in 0..8 {
        let pivot = (column..8).max_by(|&a, &b| m[a][column].abs().total_cmp(&m[b][column].abs()))?;
        m.swap(column, pivot);
        let top = m[column];
        if top[column].is_nan() || top[column].abs() <= 1e-12 * size {
            return None;
        }
        for line in &mut m[column + 1..] {
            let factor = line[column] / top[column];
            for (cell, value) in line.iter_mut().zip(top).skip(column) {
                *cell -= factor * value;
            }
        }
    }
    let mut x = [0.0; 8];
    for i in (0..8).rev() {
        let known: f64 = (i + 1..8).map(|k| m[i][k] * x[k]).sum();
        x[i] = (m[i][8] - known) / m[i][i];
    }
    Some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_homography_comes_back(
            a in prop::array::uniform6(-0.3f64..0.3), tilt in prop::array::uniform2(-3e-4f64..3e-4), shift in 0.0f64..2000.0
        ) {
            let truth = DMat3::from_cols(
                DVec3::new(1.0 + a[0], a[1], tilt[0]),
                DVec3::new(a[2], 1.0 + a[3], tilt[1]),
                DVec3::new(shift + a[4], a[5], 1.0),
            );
            let from: Vec<DVec2> = (0..20).map(|i| DVec2::new(f64::from(i * 37 % 101), f64::from(i * 53 % 89)) * 4.0).collect();
            let to: Vec<DVec2> = from.iter().map(|p| apply_homography(&truth, *p)).collect();
            for count in [4, 20] {
                let found = fit_homography(&from[..count], &to[..count]).unwrap();
                for (p, q) in from.iter().zip(&to) {
                    prop_assert!(apply_homography(&found, *p).distance(*q) < 1e-6);
                }
            }
        }
    }

    #[test]
    fn points_that_determine_nothing_are_refused() {
        let line: Vec<DVec2> = (0..10).map(|i| DVec2::new(f64::from(i), 2.0 * f64::from(i))).collect();
        let square = [DVec2::ZERO, DVec2::X, DVec2::ONE, DVec2::Y];
        assert!(fit_homography(&line, &line).is_none());
        assert!(fit_homography(&square[..3], &square[..3]).is_none());
        assert!(fit_homography(&[DVec2::ONE; 5], &[DVec2::ONE; 5]).is_none());
        let mut holes = square;
        holes[2].x = f64::NAN;
        assert!(fit_homography(&square, &holes).is_none());
    }
}
