//! Do matched landmarks move as their neighbours do?
//!
//! Skin moves smoothly: about each landmark the motion is nearly affine. The affine map of its neighbours, fitted by
//! iteratively reweighted least squares (Holland, Welsch: Robust regression using iteratively reweighted least-squares,
//! 1977; Cauchy weights), predicts where it should be.

use glam::{DMat4, DVec3, DVec4, Vec3};

/// Neighbours that vote on a landmark.
const NEIGHBOURS: usize = 10;
/// Fewer neighbours than this cannot outvote an outlier among them.
const MIN_NEIGHBOURS: usize = 4;
/// Rounds: the first judges by everybody, the later ones by those not yet caught.
const ROUNDS: usize = 3;
const ITERATIONS: usize = 8;

/// For each match `a[i]` -> `b[i]` (mm; points of a plane have z = 0) whether it lies within `threshold_mm` of where the
/// affine map of its ten nearest neighbours in `a` puts it. A landmark with fewer than four neighbours is not contradicted.
///
/// # Panics
/// When `a` and `b` differ in length.
pub fn consistent(a: &[Vec3], b: &[Vec3], threshold_mm: f32) -> Vec<bool> {
    assert_eq!(a.len(), b.len(), "matches come in pairs");
    let mut good: Vec<bool> = a.iter().zip(b).map(|(p, q)| p.is_finite() && q.is_finite()).collect();
    let usable = good.clone();
    let mut nearest = Vec::with_capacity(a.len());
    for _ in 0..ROUNDS {
        let judged = (0..a.len()).map(|i| {
            if !usable[i] {
                return false;
            }
            nearest_good(a, &good, i, &mut nearest);
            let predicted = predict(a, b, i, &nearest, f64::from(threshold_mm));
            predicted.is_none_or(|p| p.distance(b[i].as_dvec3()) <= f64::from(threshold_mm))
        });
        let judged: Vec<bool> = judged.collect();
        if judged == good {
            break;
        }
        good = judged;
    }
    good
}

/// Up to [`NEIGHBOURS`] nearest good landmarks of `i`, itself excluded; ties by index.
fn nearest_good(a: &[Vec3], good: &[bool], i: usize, nearest: &mut Vec<(f32, usize)>) {
    nearest.clear();
    let others = (0..a.len()).filter(|&j| j != i && good[j]);
    nearest.extend(others.map(|j| (a[j].distance_squared(a[i]), j)));
    let order = |p: &(f32, usize), q: &(f32, usize)| p.0.total_cmp(&q.0).then(p.1.cmp(&q.1));
    if nearest.len() > NEIGHBOURS {
        nearest.select_nth_unstable_by(NEIGHBOURS, order);
        nearest.truncate(NEIGHBOURS);
    }
    nearest.sort_unstable_by(order);
}

/// Where the neighbours' affine motion takes landmark `i`, mm.
fn predict(a: &[Vec3], b: &[Vec3], i: usize, nearest: &[(f32, usize)], threshold_mm: f64) -> Option<DVec3> {
    if nearest.len() < MIN_NEIGHBOURS {
        return None;
    }
    let radius = f64::from(nearest[nearest.len() - 1].0).sqrt().max(1e-6);
    let centre = a[i].as_dvec3();
    let offset = |j: usize| ((a[j].as_dvec3() - centre) / radius).extend(1.0);
    let motion = |j: usize| (b[j] - a[j]).as_dvec3();
    // The coordinate-wise median is a start that no minority can pull away.
    let mut columns = [DVec3::ZERO; 4];
    columns[3] = median(nearest.iter().map(|&(_, j)| motion(j)).collect());
    let mut scale = 4.0 * threshold_mm;
    for _ in 0..ITERATIONS {
        let (mut normal, mut right) = (DMat4::ZERO, [DVec4::ZERO; 3]);
        for &(_, j) in nearest {
            let (x, d) = (offset(j), motion(j));
            let residual = (d - apply(&columns, x)).length() / scale;
            let weight = 1.0 / (1.0 + residual * residual);
            normal += DMat4::from_cols(x * x.x, x * x.y, x * x.z, x * x.w) * weight;
            for k in 0..3 {
                right[k] += x * (weight * d[k]);
            }
        }
        // Neighbours in a plane leave the slope along its normal free: a small ridge sets it to 0.
        normal += DMat4::from_diagonal(DVec4::new(0.02, 0.02, 0.02, 1e-9));
        let inverse = normal.inverse();
        let rows = right.map(|r| inverse * r);
        columns = [0, 1, 2, 3].map(|c| DVec3::new(rows[0][c], rows[1][c], rows[2][c]));
        scale = (scale * 0.5).max(0.5 * threshold_mm);
    }
    Some(centre + columns[3])
}

fn apply(columns: &[DVec3; 4], x: DVec4) -> DVec3 {
    columns[0] * x.x + columns[1] * x.y + columns[2] * x.z + columns[3] * x.w
}

fn median(mut values: Vec<DVec3>) -> DVec3 {
    let middle = values.len() / 2;
    let mut result = DVec3::ZERO;
    for k in 0..3 {
        values.sort_unstable_by(|p, q| p[k].total_cmp(&q[k]));
        result[k] = values[middle][k];
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 600 points of a bulged sheet, and a smooth deformation of it.
    fn sheet() -> (Vec<Vec3>, Vec<Vec3>) {
        let a: Vec<Vec3> = (0..600)
            .map(|i| {
                let (x, y) = (
                    5.5 * (i % 25) as f32 + (i * 7 % 5) as f32 * 0.4,
                    5.5 * (i / 25) as f32 + (i * 3 % 7) as f32 * 0.3,
                );
                Vec3::new(x, y, 40.0 - 0.01 * ((x - 65.0) * (x - 65.0) + (y - 65.0) * (y - 65.0)))
            })
            .collect();
        let moved = |p: &Vec3| {
            let bend =
                Vec3::new((p.y * 0.06).sin() * 2.0, (p.x * 0.05).cos() * 3.0, (p.x * 0.04 + p.y * 0.05).sin() * 4.0);
            glam::Quat::from_rotation_y(0.08) * *p + bend + Vec3::new(3.0, -2.0, 5.0)
        };
        let b = a.iter().map(moved).collect();
        (a, b)
    }

    fn random(state: &mut u32) -> f32 {
        *state ^= *state << 13;
        *state ^= *state >> 17;
        *state ^= *state << 5;
        (*state >> 8) as f32 / (1 << 24) as f32
    }

    #[test]
    fn smooth_motion_is_consistent_in_space_and_in_the_plane() {
        let (a, b) = sheet();
        assert!(consistent(&a, &b, 1.0).iter().all(|c| *c));
        let flat = |v: &[Vec3]| v.iter().map(|p| Vec3::new(p.x, p.y, 0.0)).collect::<Vec<_>>();
        assert!(consistent(&flat(&a), &flat(&b), 1.0).iter().all(|c| *c));
    }

    #[test]
    fn a_fifth_of_outliers_is_found_and_the_rest_kept() {
        let (a, mut b) = sheet();
        let mut state = 77;
        let outlier: Vec<bool> = (0..a.len()).map(|_| random(&mut state) < 0.2).collect();
        for (q, _) in b.iter_mut().zip(&outlier).filter(|(_, o)| **o) {
            let direction = Vec3::new(random(&mut state) - 0.5, random(&mut state) - 0.5, random(&mut state) - 0.5);
            *q += direction.normalize() * (2.0 + 18.0 * random(&mut state));
        }
        let kept = consistent(&a, &b, 1.0);
        let count = |want_outlier: bool| (0..a.len()).filter(|&i| outlier[i] == want_outlier && kept[i]).count();
        let outliers = outlier.iter().filter(|o| **o).count();
        assert!(outliers > 100);
        assert!(count(true) * 100 <= outliers * 3, "{} of {outliers} outliers kept", count(true));
        assert!(count(false) * 100 >= (a.len() - outliers) * 97, "{} of {} kept", count(false), a.len() - outliers);
    }

    #[test]
    fn degenerate_sets_do_not_fail() {
        assert!(consistent(&[], &[], 1.0).is_empty());
        assert_eq!(consistent(&[Vec3::ZERO; 2], &[Vec3::ZERO, Vec3::X * 50.0], 1.0), [true, true]);
        let same = [Vec3::ONE; 20];
        assert!(consistent(&same, &same, 1.0).iter().all(|c| *c));
        let mut broken = same;
        broken[4].x = f32::NAN;
        assert_eq!(consistent(&same, &broken, 1.0).iter().filter(|c| !**c).count(), 1);
        let line: Vec<Vec3> = (0..30).map(|i| Vec3::X * i as f32).collect();
        assert!(consistent(&line, &line, 1.0).iter().all(|c| *c));
    }
}
