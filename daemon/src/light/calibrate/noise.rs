//! What the errors say about the noise: robust scale, covariance, outliers.

use super::bundle::{Bundle, Whitening};
use faer::{Mat, Side};
use glam::DVec2;

/// Errors count linearly from two standard deviations on while outliers are among the corners (P. Huber, 1964).
pub(super) const HUBER: f64 = 2.0;
/// A corner whose error in a device is longer than this many standard deviations is rejected there: of good corners with
/// normal noise, one in 3,000 (exp(-4^2/2)).
const REJECT: f64 = 4.0;
/// Least standard deviation, px: corners without any noise are no reason to divide by zero.
const LEAST_PX: f64 = 1e-6;
/// Median of the length of a pair of unit normal variables, sqrt(2 ln 2).
const MEDIAN_LENGTH: f64 = 1.177_410_022_515_474_7;

/// Standard deviations of the errors of camera and projector along one axis, by their medians, as a whitening without
/// correlations.
pub(super) fn robust_whitening(bundle: &Bundle) -> Whitening {
    let (mut camera, mut projector) = (Vec::new(), Vec::new());
    for view in &bundle.views {
        for corner in &view.corners {
            let (c, p) = bundle.errors(view, corner);
            camera.extend(c.map(DVec2::length));
            projector.extend(p.map(DVec2::length));
        }
    }
    let deviation = |lengths: &mut Vec<f64>| {
        lengths.sort_unstable_by(f64::total_cmp);
        lengths.get(lengths.len() / 2).map_or(1.0, |median| (median / MEDIAN_LENGTH).max(LEAST_PX))
    };
    let (c, p) = (1.0 / deviation(&mut camera), 1.0 / deviation(&mut projector));
    [[c, 0.0, 0.0, 0.0], [0.0, c, 0.0, 0.0], [0.0, 0.0, p, 0.0], [0.0, 0.0, 0.0, p]]
}

/// Covariance of the four errors of a corner, px^2, over the corners that are used in both devices, for the degrees of
/// freedom that are left; `None` for fewer measurements than unknowns.
pub(super) fn covariance(bundle: &Bundle) -> Option<[[f64; 4]; 4]> {
    let (mut sum, mut corners) = ([[0.0; 4]; 4], 0usize);
    for view in &bundle.views {
        for corner in view.corners.iter().filter(|c| !c.camera_rejected && !c.projector_rejected) {
            let (Some(camera), Some(projector)) = bundle.errors(view, corner) else { continue };
            let e = [camera.x, camera.y, projector.x, projector.y];
            for (row, a) in sum.iter_mut().zip(e) {
                row.iter_mut().zip(e).for_each(|(s, b)| *s += a * b);
            }
            corners += 1;
        }
    }
    let (measurements, unknowns) = (bundle.measurements(), bundle.unknowns());
    if measurements <= unknowns || corners == 0 {
        return None;
    }
    let scale = measurements as f64 / ((measurements - unknowns) as f64 * corners as f64);
    Some(sum.map(|row| row.map(|s| s * scale)))
}

/// Inverse Cholesky factor of a covariance.
pub(super) fn whitening(covariance: &[[f64; 4]; 4]) -> Option<Whitening> {
    let floored = Mat::from_fn(4, 4, |i, j| covariance[i][j] + if i == j { LEAST_PX * LEAST_PX } else { 0.0 });
    let factor = floored.llt(Side::Lower).ok()?;
    let l = factor.L();
    let mut inverse: Whitening = [[0.0; 4]; 4];
    // Row by row: L inverse = identity.
    for row in 0..4 {
        let mut line = [0.0; 4];
        line[row] = 1.0;
        for (k, above) in inverse.iter().enumerate().take(row) {
            line.iter_mut().zip(above).for_each(|(v, a)| *v -= l[(row, k)] * a);
        }
        inverse[row] = line.map(|v| v / l[(row, row)]);
    }
    inverse.iter().flatten().all(|v| v.is_finite()).then_some(inverse)
}

/// Marks the outliers by the present fit, and unmarks what fits again; returns how many corners changed.
pub(super) fn mark_outliers(bundle: &mut Bundle) -> usize {
    let mut marks = Vec::new();
    for view in &bundle.views {
        for corner in &view.corners {
            let (camera, projector) = bundle.errors(view, corner);
            let [in_camera, in_projector] =
                bundle.whitened(camera.unwrap_or(DVec2::MAX), projector.unwrap_or_default());
            marks.push((in_camera > REJECT, projector.is_some() && in_projector > REJECT));
        }
    }
    let mut changed = 0;
    for (corner, mark) in bundle.views.iter_mut().flat_map(|v| &mut v.corners).zip(marks) {
        // Where the corner itself was not found, its projector coordinate is that of another point.
        let mark = (mark.0, mark.1 || mark.0);
        changed += usize::from(mark != (corner.camera_rejected, corner.projector_rejected));
        (corner.camera_rejected, corner.projector_rejected) = mark;
    }
    changed
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Noise, simulated_bundle};
    use super::*;

    #[test]
    fn whitening_undoes_the_covariance() {
        let covariance =
            [[0.04, 0.005, 0.03, 0.0], [0.005, 0.05, 0.0, 0.04], [0.03, 0.0, 0.09, 0.01], [0.0, 0.04, 0.01, 0.08]];
        let w = whitening(&covariance).unwrap();
        for i in 0..4 {
            for j in 0..4 {
                let found: f64 = (0..4)
                    .flat_map(|k| (0..4).map(move |l| (k, l)))
                    .map(|(k, l)| w[i][k] * covariance[k][l] * w[j][l])
                    .sum();
                assert!((found - f64::from(u8::from(i == j))).abs() < 1e-9);
            }
        }
        assert!(whitening(&[[f64::NAN; 4]; 4]).is_none());
        assert!(whitening(&[[0.0; 4]; 4]).is_some());
    }

    #[test]
    fn the_robust_scale_is_that_of_the_noise_whatever_a_few_corners_do() {
        let mut bundle = simulated_bundle(8, &Noise { camera_px: 0.2, projector_px: 0.5, seed: 1 });
        for view in &mut bundle.views {
            view.corners.iter_mut().step_by(6).for_each(|c| c.camera_px.x += 50.0);
        }
        let w = robust_whitening(&bundle);
        assert!((0.9..1.3).contains(&(1.0 / w[0][0] / 0.2)), "{}", 1.0 / w[0][0]);
        assert!((0.9..1.1).contains(&(1.0 / w[2][2] / 0.5)), "{}", 1.0 / w[2][2]);
        bundle.whitening = w;
        let changed = mark_outliers(&mut bundle);
        for view in &bundle.views {
            assert!(view.corners.iter().step_by(6).all(|c| c.camera_rejected && c.projector_rejected));
        }
        // One corner in 3,000 is beyond the limit by chance.
        let moved: usize = bundle.views.iter().map(|v| v.corners.len().div_ceil(6)).sum();
        assert!((moved..moved + 4).contains(&changed), "{changed} of {moved}");
        assert_eq!(mark_outliers(&mut bundle), 0);
    }
}
