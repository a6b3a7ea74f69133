//! Least-squares planes and spheres through points, by orthogonal distance, and how they are found among other things.

use glam::{DMat3, DMat4, DVec3, DVec4};

/// Share of the points that the guideline allows to be left out: 3 per mille.
pub const REJECTED_SHARE: f64 = 0.003;
/// Gauss-Newton steps; each squares the relative error, so that a handful reaches the last bit.
const STEPS: usize = 20;
/// Points that hypotheses are tried on.
const THINNED: usize = 4000;
/// Least share of a scan's points on a form: chance cuts through other things hold fewer.
const LEAST_SHARE: f64 = 0.02;
/// Random hypotheses: with half of the points on the form, four all on it are missed once in 10^28.
const HYPOTHESES: usize = 1000;

/// A plane through `point_mm` with unit `normal`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// Mean of the points it was fitted to.
    pub point_mm: DVec3,
    /// Unit normal with z at least 0.
    pub normal: DVec3,
}

impl Plane {
    /// Total least squares: the direction in which the points vary least. `None` for fewer than three points, or for points
    /// on a line.
    pub fn fit(points: &[DVec3]) -> Option<Self> {
        if points.len() < 3 {
            return None;
        }
        let mean = points.iter().sum::<DVec3>() / points.len() as f64;
        let square = |p: &DVec3| {
            let d = *p - mean;
            DMat3::from_cols(d * d.x, d * d.y, d * d.z)
        };
        let (values, vectors) = eigen(points.iter().map(square).fold(DMat3::ZERO, |sum, m| sum + m));
        let least = (0..3).min_by(|&a, &b| values[a].total_cmp(&values[b]))?;
        let mut sorted = values;
        sorted.sort_by(f64::total_cmp);
        let is_flat = sorted[1] > 1e-12 * sorted[2] && sorted[2].is_finite();
        let normal = vectors.col(least);
        is_flat.then(|| Self { point_mm: mean, normal: if normal.z < 0.0 { -normal } else { normal } })
    }

    /// Signed distance of a point, mm; positive on the side that the normal points to.
    pub fn distance_mm(&self, point: DVec3) -> f64 {
        (point - self.point_mm).dot(self.normal)
    }
}

/// A sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Centre.
    pub centre_mm: DVec3,
    /// Radius.
    pub radius_mm: f64,
}

/// A fitted sphere and how sure it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SphereFit {
    /// The sphere.
    pub sphere: Sphere,
    /// Standard deviation of the radial distances, with the degrees of freedom of the fit, mm.
    pub sigma_mm: f64,
    /// Covariance of centre x, y, z and radius, mm^2: sigma^2 (J^T J)^-1.
    pub covariance_mm2: DMat4,
}

impl Sphere {
    /// Signed radial distance of a point, mm; positive outside.
    pub fn distance_mm(&self, point: DVec3) -> f64 {
        (point - self.centre_mm).length() - self.radius_mm
    }

    /// Least squares of radial distances by Gauss-Newton from the algebraic sphere; the radius is free. `None` for fewer than
    /// five points or points near a plane.
    pub fn fit(points: &[DVec3]) -> Option<SphereFit> {
        if points.len() < 5 {
            return None;
        }
        let mut sphere = Self::algebraic(points)?;
        for _ in 0..STEPS {
            let (normal, right, _) = sphere.normal_equations(points);
            let step = solve(normal, right)?;
            sphere.centre_mm += step.truncate();
            sphere.radius_mm += step.w;
            if step.length() < 1e-14 * sphere.radius_mm {
                break;
            }
        }
        let (normal, _, squares) = sphere.normal_equations(points);
        let variance = squares / (points.len() - 4) as f64;
        let is_sound = sphere.centre_mm.is_finite() && sphere.radius_mm.is_finite() && sphere.radius_mm > 0.0;
        let covariance_mm2 = normal.inverse() * variance;
        is_sound.then_some(SphereFit { sphere, sigma_mm: variance.sqrt(), covariance_mm2 })
    }

    /// The sphere that solves |p|^2 = 2 c.p + (r^2 - |c|^2) in the least-squares sense.
    fn algebraic(points: &[DVec3]) -> Option<Self> {
        let mean = points.iter().sum::<DVec3>() / points.len() as f64;
        let (mut normal, mut right) = (DMat4::ZERO, DVec4::ZERO);
        for p in points {
            let d = *p - mean;
            let row = (2.0 * d).extend(1.0);
            normal += DMat4::from_cols(row * row.x, row * row.y, row * row.z, row * row.w);
            right += row * d.length_squared();
        }
        let solution = solve(normal, right)?;
        let centre = solution.truncate();
        let radius_mm = (solution.w + centre.length_squared()).sqrt();
        radius_mm.is_finite().then_some(Self { centre_mm: mean + centre, radius_mm })
    }

    /// J^T J, -J^T r and r^T r of the radial distances r at this sphere.
    fn normal_equations(&self, points: &[DVec3]) -> (DMat4, DVec4, f64) {
        let (mut normal, mut right, mut squares) = (DMat4::ZERO, DVec4::ZERO, 0.0);
        for p in points {
            let arm = *p - self.centre_mm;
            let length = arm.length().max(f64::MIN_POSITIVE);
            let row = (-arm / length).extend(-1.0);
            let distance = length - self.radius_mm;
            normal += DMat4::from_cols(row * row.x, row * row.y, row * row.z, row * row.w);
            right -= row * distance;
            squares += distance * distance;
        }
        (normal, right, squares)
    }
}

/// Solves a symmetric system scaled to a unit diagonal; `None` when it is singular in double precision.
fn solve(matrix: DMat4, right: DVec4) -> Option<DVec4> {
    let scale = DVec4::from_array(std::array::from_fn(|k| 1.0 / matrix.col(k)[k].sqrt()));
    let scaled = DMat4::from_diagonal(scale) * matrix * DMat4::from_diagonal(scale);
    let is_regular = scaled.determinant().abs() > 1e-20;
    is_regular.then(|| scale * (scaled.inverse() * (scale * right)))
}

/// Eigenvalues and unit eigenvectors (columns) of a symmetric matrix by Jacobi rotations (Golub and Van Loan, Matrix
/// Computations, 8.5).
fn eigen(mut a: DMat3) -> ([f64; 3], DMat3) {
    let mut vectors = DMat3::IDENTITY;
    for _ in 0..12 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a.col(q)[p] == 0.0 {
                continue;
            }
            let tau = (a.col(q)[q] - a.col(p)[p]) / (2.0 * a.col(q)[p]);
            let t = tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt());
            let c = 1.0 / (1.0 + t * t).sqrt();
            let mut turn = DMat3::IDENTITY;
            turn.col_mut(p)[p] = c;
            turn.col_mut(q)[q] = c;
            turn.col_mut(q)[p] = t * c;
            turn.col_mut(p)[q] = -t * c;
            a = turn.transpose() * a * turn;
            vectors *= turn;
        }
    }
    (std::array::from_fn(|k| a.col(k)[k]), vectors)
}

/// The points less the 3 per mille farthest from a form, and how many those were.
pub fn without_worst(points: &[DVec3], distance_mm: impl Fn(DVec3) -> f64) -> (Vec<DVec3>, usize) {
    let rejected = (points.len() as f64 * REJECTED_SHARE) as usize;
    let mut order: Vec<(f64, usize)> = points.iter().enumerate().map(|(i, p)| (distance_mm(*p).abs(), i)).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    order.truncate(points.len() - rejected);
    (order.into_iter().map(|(_, i)| points[i]).collect(), rejected)
}

/// Least and greatest of some distances.
pub fn range_mm(distances: impl Iterator<Item = f64>) -> [f64; 2] {
    distances.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], d| [low.min(d), high.max(d)])
}

/// Points within `gate_mm` of the sphere of about `radius_mm` (10 %) on which most points lie; `None` when that holds fewer
/// than 2 % of them, or when they fill the gate evenly: any surface that passes through the gate does so, a sphere does not.
pub fn find_sphere(points: &[DVec3], radius_mm: f64, gate_mm: f64) -> Option<Vec<DVec3>> {
    let hypothesis = |pick: &mut dyn FnMut() -> DVec3| {
        let four: [DVec3; 4] = std::array::from_fn(|_| pick());
        let sphere = Sphere::algebraic(&four)?;
        ((sphere.radius_mm - radius_mm).abs() < 0.1 * radius_mm).then_some(move |p| sphere.distance_mm(p))
    };
    let refine = |inliers: &[DVec3]| {
        let sphere = Sphere::fit(inliers)?.sphere;
        ((sphere.radius_mm - radius_mm).abs() < 0.1 * radius_mm).then_some(move |p| sphere.distance_mm(p))
    };
    let found = find(points, gate_mm, hypothesis, refine)?;
    let sphere = Sphere::fit(&found)?.sphere;
    let mean_square = found.iter().map(|p| sphere.distance_mm(*p).powi(2)).sum::<f64>() / found.len() as f64;
    (mean_square.sqrt() < EVEN_SHARE * gate_mm).then_some(found)
}

/// Points within `gate_mm` of the plane on which most points lie; `None` when that holds fewer than 2 % of them.
pub fn find_plane(points: &[DVec3], gate_mm: f64) -> Option<Vec<DVec3>> {
    let hypothesis = |pick: &mut dyn FnMut() -> DVec3| {
        let plane = Plane::fit(&[pick(), pick(), pick()])?;
        Some(move |p| plane.distance_mm(p))
    };
    let refine = |inliers: &[DVec3]| {
        let plane = Plane::fit(inliers)?;
        Some(move |p| plane.distance_mm(p))
    };
    find(points, gate_mm, hypothesis, refine)
}

/// An even spread over the gate has a standard deviation of 0.58 of it.
const EVEN_SHARE: f64 = 0.45;

/// Random sample consensus (Fischler and Bolles 1981) on thinned points, then least squares on all within the gate until it
/// stays. The same points give the same answer.
fn find<A: Fn(DVec3) -> f64, B: Fn(DVec3) -> f64>(
    points: &[DVec3],
    gate_mm: f64,
    hypothesis: impl Fn(&mut dyn FnMut() -> DVec3) -> Option<A>,
    refine: impl Fn(&[DVec3]) -> Option<B>,
) -> Option<Vec<DVec3>> {
    if points.len() < 20 {
        return None;
    }
    let thin: Vec<DVec3> = points.iter().copied().step_by(points.len().div_ceil(THINNED)).collect();
    let mut state = 1u64;
    let mut pick = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        thin[(state >> 33) as usize % thin.len()]
    };
    let mut best: Vec<DVec3> = Vec::new();
    for _ in 0..HYPOTHESES {
        let Some(distance) = hypothesis(&mut pick) else { continue };
        let inliers: Vec<DVec3> = thin.iter().copied().filter(|p| distance(*p).abs() < gate_mm).collect();
        if inliers.len() > best.len() {
            best = inliers;
        }
    }
    for _ in 0..6 {
        let distance = refine(&best)?;
        best = points.iter().copied().filter(|p| distance(*p).abs() < gate_mm).collect();
    }
    (best.len() >= 20 && best.len() as f64 >= LEAST_SHARE * points.len() as f64).then_some(best)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn normals(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            // The sum of twelve uniforms less six: mean 0, variance 1.
            (0..12)
                .map(|_| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    (state >> 11) as f64 / (1u64 << 53) as f64
                })
                .sum::<f64>()
                - 6.0
        }
    }

    /// A cap of a sphere as a scanner sees it, half angle 60 degrees, each point moved along its normal.
    fn cap(sphere: Sphere, count: usize, mut deviation: impl FnMut(usize) -> f64) -> Vec<DVec3> {
        (0..count)
            .map(|i| {
                let z = 1.0 - 0.5 * (i as f64 + 0.5) / count as f64;
                let (ring, turn) = ((1.0 - z * z).sqrt(), i as f64 * 2.399_963_229_728_653);
                let normal = DVec3::new(ring * turn.cos(), ring * turn.sin(), z);
                sphere.centre_mm + normal * (sphere.radius_mm + deviation(i))
            })
            .collect()
    }

    const BALL: Sphere = Sphere { centre_mm: DVec3::new(12.0, -30.0, -600.0), radius_mm: 40.0 };

    #[test]
    fn exact_forms_are_found_to_the_last_digits() {
        let found = Sphere::fit(&cap(BALL, 500, |_| 0.0)).unwrap();
        assert!(found.sphere.centre_mm.distance(BALL.centre_mm) < 1e-9, "{found:?}");
        assert!((found.sphere.radius_mm - 40.0).abs() < 1e-9 && found.sigma_mm < 1e-10);
        for normal in [DVec3::Z, DVec3::X, DVec3::new(0.3, -0.5, 0.2).normalize()] {
            let (u, v) = normal.any_orthonormal_pair();
            let points: Vec<DVec3> =
                (0..200).map(|i| DVec3::splat(-400.0) + u * f64::from(i % 20) + v * f64::from(i / 20)).collect();
            let plane = Plane::fit(&points).unwrap();
            assert!(plane.normal.dot(normal).abs() > 1.0 - 1e-12, "{normal}");
            assert!(points.iter().all(|p| plane.distance_mm(*p).abs() < 1e-10));
        }
    }

    #[test]
    fn degenerate_points_have_no_form() {
        let line: Vec<DVec3> = (0..50).map(|i| DVec3::new(f64::from(i), 2.0 * f64::from(i), 0.0)).collect();
        assert!(Plane::fit(&line).is_none() && Sphere::fit(&line).is_none());
        assert!(Plane::fit(&line[..2]).is_none() && Sphere::fit(&[]).is_none());
        let flat: Vec<DVec3> = (0..50).map(|i| DVec3::new(f64::from(i % 7), f64::from(i / 7), 0.0)).collect();
        assert!(Sphere::fit(&flat).is_none());
        assert!(Plane::fit(&[DVec3::splat(1.0); 9]).is_none());
        assert!(find_plane(&flat[..10], 1.0).is_none());
    }

    #[test]
    fn a_wavy_plane_keeps_its_place_and_its_range() {
        // Ten whole waves turn the plane by no more than a fortieth of their height across.
        let points: Vec<DVec3> = (0..40 * 40)
            .map(|i| {
                DVec3::new(
                    f64::from(i % 40),
                    f64::from(i / 40),
                    0.02 * (f64::from(i % 40) * 0.5 * std::f64::consts::PI).sin(),
                )
            })
            .collect();
        let plane = Plane::fit(&points).unwrap();
        let [low, high] = range_mm(points.iter().map(|p| plane.distance_mm(*p)));
        assert!((high - low - 0.04).abs() < 0.004, "{low} {high}");
    }

    #[test]
    fn the_covariance_is_that_of_repeated_fits() {
        let (sigma, runs) = (0.05, 400);
        let mut noise = normals(7);
        let fits: Vec<SphereFit> =
            (0..runs).map(|_| Sphere::fit(&cap(BALL, 300, |_| sigma * noise())).unwrap()).collect();
        let told = fits[0].covariance_mm2;
        let variance = |value: fn(&SphereFit) -> f64, truth: f64| {
            fits.iter().map(|f| (value(f) - truth).powi(2)).sum::<f64>() / f64::from(runs)
        };
        // The sample variance of 400 runs is within 7 % (one sigma) of the true one.
        for (found, told) in [
            (variance(|f| f.sphere.centre_mm.x, 12.0), told.x_axis.x),
            (variance(|f| f.sphere.centre_mm.z, -600.0), told.z_axis.z),
            (variance(|f| f.sphere.radius_mm, 40.0), told.w_axis.w),
        ] {
            assert!((found / told - 1.0).abs() < 0.4, "{found} {told}");
        }
        let mean_sigma = fits.iter().map(|f| f.sigma_mm).sum::<f64>() / f64::from(runs);
        assert!((mean_sigma / sigma - 1.0).abs() < 0.02, "{mean_sigma}");
    }

    #[test]
    fn three_per_mille_are_left_out_and_no_more() {
        let mut points = cap(BALL, 1000, |_| 0.0);
        for i in [10, 500, 800] {
            points[i] = BALL.centre_mm + (points[i] - BALL.centre_mm) * 1.01;
        }
        let (kept, rejected) = without_worst(&points, |p| BALL.distance_mm(p));
        assert_eq!((kept.len(), rejected), (997, 3));
        let fit = Sphere::fit(&kept).unwrap();
        assert!(fit.sigma_mm < 1e-9);
        points[300] = BALL.centre_mm + (points[300] - BALL.centre_mm) * 1.005;
        let (kept, _) = without_worst(&points, |p| BALL.distance_mm(p));
        let [low, high] = range_mm(kept.iter().map(|p| BALL.distance_mm(*p)));
        assert!(high - low > 0.1, "a fourth one stays");
        assert_eq!(without_worst(&points[..300], |p| BALL.distance_mm(p)).1, 0);
    }

    #[test]
    fn forms_are_found_among_other_things() {
        let mut noise = normals(3);
        let other = Sphere { centre_mm: DVec3::new(-98.0, -30.0, -600.0), radius_mm: 40.0 };
        let mut points = cap(BALL, 3000, |_| 0.03 * noise());
        points.extend(cap(other, 2500, |_| 0.03 * noise()));
        points.extend((0..2000).map(|i| DVec3::new(f64::from(i % 50) * 4.0 - 100.0, f64::from(i / 50) * 3.0, -680.0)));
        let first = find_sphere(&points, 40.0, 0.5).unwrap();
        let fit = Sphere::fit(&first).unwrap();
        assert!(fit.sphere.centre_mm.distance(BALL.centre_mm) < 0.02 && first.len() > 2990, "{fit:?}");
        let rest: Vec<DVec3> = points.iter().copied().filter(|p| fit.sphere.distance_mm(*p).abs() > 1.5).collect();
        let second = Sphere::fit(&find_sphere(&rest, 40.0, 0.5).unwrap()).unwrap();
        assert!(second.sphere.centre_mm.distance(other.centre_mm) < 0.02);
        assert!(find_sphere(&points[5500..], 40.0, 0.5).is_none(), "a plane is no sphere");
        assert_eq!(find_plane(&points[5500..], 0.5).unwrap().len(), 2000);
    }
}
