//! How far a map is from conformal: the difference of every corner's angle before and after.

use glam::DVec3;

/// Classes of the histogram, the last one for all that is larger: upper bounds in degrees.
pub const HISTOGRAM_BOUNDS_DEG: [f64; 9] = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 180.0];

/// Absolute angle differences over all corners of all triangles that have angles in both places.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AngleErrors {
    /// Mean.
    pub mean_deg: f64,
    /// Standard deviation.
    pub sd_deg: f64,
    /// 99th percentile.
    pub p99_deg: f64,
    /// Largest.
    pub max_deg: f64,
    /// Corners in each class of [`HISTOGRAM_BOUNDS_DEG`].
    pub histogram: [usize; HISTOGRAM_BOUNDS_DEG.len()],
}

impl AngleErrors {
    /// Compares the angles of `triangles` between two placements of their vertices.
    ///
    /// # Panics
    /// When a triangle names a vertex that one of the placements has not.
    pub fn between(triangles: &[[u32; 3]], before: impl Fn(u32) -> DVec3, after: impl Fn(u32) -> DVec3) -> Self {
        let mut errors: Vec<f64> = triangles
            .iter()
            .filter_map(|t| Some((angles_deg(t.map(&before))?, angles_deg(t.map(&after))?)))
            .flat_map(|(a, b)| [0, 1, 2].map(|k| (a[k] - b[k]).abs()))
            .collect();
        let Some(last) = errors.len().checked_sub(1) else { return Self::default() };
        let n = errors.len() as f64;
        let mean_deg = errors.iter().sum::<f64>() / n;
        let variance = errors.iter().map(|e| (e - mean_deg) * (e - mean_deg)).sum::<f64>() / n;
        let mut histogram = [0; HISTOGRAM_BOUNDS_DEG.len()];
        for e in &errors {
            let class = HISTOGRAM_BOUNDS_DEG.partition_point(|bound| bound < e);
            histogram[class.min(histogram.len() - 1)] += 1;
        }
        let max_deg = errors.iter().copied().fold(0.0, f64::max);
        let (_, &mut p99_deg, _) = errors.select_nth_unstable_by(last * 99 / 100, f64::total_cmp);
        Self { mean_deg, sd_deg: variance.sqrt(), p99_deg, max_deg, histogram }
    }
}

/// Angles of a triangle; `None` when two of its corners coincide or lie in infinity.
fn angles_deg([a, b, c]: [DVec3; 3]) -> Option<[f64; 3]> {
    let angle = |at: DVec3, p: DVec3, q: DVec3| {
        let (e, f) = (p - at, q - at);
        libm::atan2(e.cross(f).length(), e.dot(f)).to_degrees()
    };
    let has_angles = a != b && b != c && c != a && (a + b + c).is_finite();
    has_angles.then(|| {
        let (at_a, at_b) = (angle(a, b, c), angle(b, c, a));
        [at_a, at_b, 180.0 - at_a - at_b]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_right_triangle_against_an_equilateral_one() {
        let right = [DVec3::ZERO, DVec3::X, DVec3::Y];
        let even = [DVec3::ZERO, DVec3::X, DVec3::new(0.5, 0.75f64.sqrt(), 0.0)];
        let errors = AngleErrors::between(&[[0, 1, 2]], |v| right[v as usize], |v| even[v as usize]);
        assert!((errors.mean_deg - 20.0).abs() < 1e-9 && (errors.max_deg - 30.0).abs() < 1e-9);
        assert!((errors.sd_deg - 50f64.sqrt()).abs() < 1e-9);
        assert_eq!(errors.histogram.iter().sum::<usize>(), 3);
    }

    #[test]
    fn similar_triangles_have_none_and_points_do_not_count() {
        let small = [DVec3::ZERO, DVec3::X, DVec3::new(0.3, 0.9, 0.0), DVec3::ZERO];
        let large = |v: u32| small[v as usize] * 7.0 + DVec3::splat(3.0);
        let errors = AngleErrors::between(&[[0, 1, 2], [0, 1, 3]], |v| small[v as usize], large);
        assert!(errors.max_deg < 1e-9 && errors.histogram[0] == 3, "{errors:?}");
        assert_eq!(AngleErrors::between(&[], large, large), AngleErrors::default());
    }
}
