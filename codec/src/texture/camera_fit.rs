//! One camera matrix in place of texture coordinates: a scanner's uv is the projection of its vertices.

use glam::{DMat4, DVec2, DVec3, DVec4, Vec3};

/// Points that enter the fit; the error is measured on all.
const MAX_FITTED: usize = 4096;
/// Fewer points than this fix no camera (eleven unknowns, two equations a point).
const MIN_POINTS: usize = 6;

/// A camera that maps positions (mm) to pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraFit {
    /// 3x4, row-major; see [`project`].
    pub matrix: [f64; 12],
    /// Largest distance of a projected point from its pixel.
    pub max_error_px: f64,
    /// Root mean square of those distances.
    pub rms_error_px: f64,
}

/// Pixel of a position (mm) under a 3x4 camera matrix; not finite for points in the camera's focal plane.
pub fn project(matrix: &[f64; 12], position_mm: Vec3) -> [f32; 2] {
    let p = position_mm.as_dvec3();
    let row = |r: usize| matrix[4 * r] * p.x + matrix[4 * r + 1] * p.y + matrix[4 * r + 2] * p.z + matrix[4 * r + 3];
    let (x, y, w) = (row(0), row(1), row(2));
    [(x / w) as f32, (y / w) as f32]
}

/// The camera that takes `positions_mm` to `uv_px`, perspective or affine, whichever has the smaller largest error.
/// `None` for fewer than six points, numbers that are not finite, or points that no camera of the two fits sees in front of
/// it. Points of a plane are fitted too (the matrix is then one of many; the error is measured all the same).
///
/// Perspective by the normalised direct linear transformation (Hartley, Zisserman: Multiple View Geometry, 2nd edition
/// 2004, section 7.1), affine by least squares (section 7.2).
///
/// # Panics
/// When the slices differ in length.
pub fn fit_camera(positions_mm: &[Vec3], uv_px: &[[f32; 2]]) -> Option<CameraFit> {
    assert_eq!(positions_mm.len(), uv_px.len(), "one pixel a position");
    let finite = positions_mm.iter().all(|p| p.is_finite()) && uv_px.iter().flatten().all(|c| c.is_finite());
    if positions_mm.len() < MIN_POINTS || !finite {
        return None;
    }
    let points = Normalized::of(&spread(positions_mm), &spread(uv_px));
    let fits = [points.perspective(), points.affine()].map(|rows| points.measured(rows, positions_mm, uv_px));
    fits.into_iter().flatten().reduce(|best, other| if other.max_error_px < best.max_error_px { other } else { best })
}

/// At most [`MAX_FITTED`] elements, well spread over any order: steps of the golden ratio meet no row length.
fn spread<T: Copy>(all: &[T]) -> Vec<T> {
    if all.len() <= MAX_FITTED {
        return all.to_vec();
    }
    let index = |i: usize| ((i as f64 * 0.618_033_988_749_895).fract() * all.len() as f64) as usize;
    (0..MAX_FITTED).map(|i| all[index(i)]).collect()
}

/// Correspondences centred and scaled to unit spread (Hartley: In defense of the eight-point algorithm, PAMI 1997).
struct Normalized {
    points: Vec<(DVec4, DVec2)>,
    centre_mm: DVec3,
    per_mm: f64,
    centre_px: DVec2,
    per_px: f64,
}

impl Normalized {
    fn of(positions_mm: &[Vec3], uv_px: &[[f32; 2]]) -> Self {
        let n = positions_mm.len() as f64;
        let pixel = |c: &[f32; 2]| DVec2::new(f64::from(c[0]), f64::from(c[1]));
        let centre_mm = positions_mm.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / n;
        let centre_px = uv_px.iter().map(pixel).sum::<DVec2>() / n;
        let spread_mm2 = positions_mm.iter().map(|p| p.as_dvec3().distance_squared(centre_mm)).sum::<f64>() / n;
        let spread_px2 = uv_px.iter().map(|c| pixel(c).distance_squared(centre_px)).sum::<f64>() / n;
        let inverse = |mean: f64, wanted: f64| if mean > 0.0 { (wanted / mean).sqrt() } else { 1.0 };
        let (per_mm, per_px) = (inverse(spread_mm2, 3.0), inverse(spread_px2, 2.0));
        let place = |(p, c): (&Vec3, &[f32; 2])| {
            (((p.as_dvec3() - centre_mm) * per_mm).extend(1.0), (pixel(c) - centre_px) * per_px)
        };
        let points = positions_mm.iter().zip(uv_px).map(place).collect();
        Self { points, centre_mm, per_mm, centre_px, per_px }
    }

    /// Sum of `weight * X Xᵀ` over the points.
    fn moments(&self, weight: impl Fn(DVec2) -> f64) -> DMat4 {
        let outer = |&(x, u): &(DVec4, DVec2)| DMat4::from_cols(x * x.x, x * x.y, x * x.z, x * x.w) * weight(u);
        self.points.iter().map(outer).fold(DMat4::ZERO, |sum, m| sum + m)
    }

    /// Eigenvector of the smallest eigenvalue of the DLT's normal matrix, as three rows.
    fn perspective(&self) -> [DVec4; 3] {
        let blocks = [
            (0, 0, self.moments(|_| 1.0)),
            (1, 1, self.moments(|_| 1.0)),
            (0, 2, self.moments(|u| -u.x)),
            (1, 2, self.moments(|u| -u.y)),
            (2, 2, self.moments(|u| u.length_squared())),
        ];
        let mut normal = [[0.0_f64; 12]; 12];
        for (row, column, block) in blocks {
            for i in 0..4 {
                for j in 0..4 {
                    normal[4 * row + i][4 * column + j] = block.col(j)[i];
                    normal[4 * column + j][4 * row + i] = block.col(j)[i];
                }
            }
        }
        let (values, vectors) = symmetric_eigen(normal);
        let smallest = (1..12).fold(0, |best, k| if values[k] < values[best] { k } else { best });
        [0, 1, 2].map(|r| DVec4::from_array([0, 1, 2, 3].map(|c| vectors[4 * r + c][smallest])))
    }

    /// Least-squares affine camera; directions in which the points have no extent get coefficient 0.
    fn affine(&self) -> [DVec4; 3] {
        let (values, vectors) = symmetric_eigen(self.moments(|_| 1.0).to_cols_array_2d());
        let largest = values.iter().copied().fold(0.0, f64::max);
        let row = |axis: usize| {
            let right = self.points.iter().map(|&(x, u)| x * u[axis]).sum::<DVec4>();
            let mut solution = DVec4::ZERO;
            for k in (0..4).filter(|&k| values[k] > 1e-12 * largest) {
                let v = DVec4::from_array([0, 1, 2, 3].map(|i| vectors[i][k]));
                solution += v * (v.dot(right) / values[k]);
            }
            solution
        };
        [row(0), row(1), DVec4::W]
    }

    /// The matrix in millimetres and pixels, depth 1 at the centre of the points, and its error on all points.
    fn measured(&self, rows: [DVec4; 3], positions_mm: &[Vec3], uv_px: &[[f32; 2]]) -> Option<CameraFit> {
        let depth = rows[2].w;
        let in_mm = |row: DVec4| {
            let direction = row.truncate() * self.per_mm;
            direction.extend(row.w - direction.dot(self.centre_mm)) / depth
        };
        let [x, y, w] = rows.map(in_mm);
        let matrix_rows = [x / self.per_px + w * self.centre_px.x, y / self.per_px + w * self.centre_px.y, w];
        let mut matrix = [0.0_f64; 12];
        for (out, value) in matrix.iter_mut().zip(matrix_rows.iter().flat_map(|r| r.to_array())) {
            *out = value;
        }
        let (mut largest2, mut sum2) = (0.0_f64, 0.0_f64);
        for (p, c) in positions_mm.iter().zip(uv_px) {
            let seen = project(&matrix, *p);
            let in_front = w.dot(p.as_dvec3().extend(1.0)) > 0.0;
            let error = DVec2::new(f64::from(seen[0] - c[0]), f64::from(seen[1] - c[1]));
            if !in_front || !error.is_finite() {
                return None;
            }
            largest2 = largest2.max(error.length_squared());
            sum2 += error.length_squared();
        }
        let rms_error_px = (sum2 / positions_mm.len() as f64).sqrt();
        Some(CameraFit { matrix, max_error_px: largest2.sqrt(), rms_error_px })
    }
}

/// Eigenvalues and eigenvectors (columns) of a symmetric matrix by cyclic Jacobi rotations (Golub, Van Loan: Matrix
/// Computations, 4th edition 2013, section 8.5). Own code, since the same matrix must give the same bits on every processor.
fn symmetric_eigen<const N: usize>(mut a: [[f64; N]; N]) -> ([f64; N], [[f64; N]; N]) {
    let mut vectors = [[0.0_f64; N]; N];
    for (i, row) in vectors.iter_mut().enumerate() {
        row[i] = 1.0;
    }
    for _sweep in 0..32 {
        let off: f64 = (0..N).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| a[i][j] * a[i][j]).sum();
        let diagonal: f64 = (0..N).map(|i| a[i][i] * a[i][i]).sum();
        if off <= 1e-34 * diagonal {
            break;
        }
        for p in 0..N {
            for q in p + 1..N {
                if a[p][q] == 0.0 {
                    continue;
                }
                let tau = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                let t = tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt());
                let c = 1.0 / (1.0 + t * t).sqrt();
                let s = t * c;
                for row in &mut a {
                    (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
                }
                let (upper, lower) = a.split_at_mut(q);
                for (at_p, at_q) in upper[p].iter_mut().zip(&mut lower[0]) {
                    (*at_p, *at_q) = (c * *at_p - s * *at_q, s * *at_p + c * *at_q);
                }
                for row in &mut vectors {
                    (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
                }
            }
        }
    }
    let mut values = [0.0_f64; N];
    for (i, value) in values.iter_mut().enumerate() {
        *value = a[i][i];
    }
    (values, vectors)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A head of points, mm.
    fn head() -> Vec<Vec3> {
        let at = |i: u32| {
            let (x, y) = ((i % 90) as f32 * 1.6 - 72.0, (i / 90) as f32 * 1.9 - 95.0);
            Vec3::new(x, y, 60.0 - 0.008 * (x * x + 0.5 * y * y) + 4.0 * (0.2 * x).sin())
        };
        (0..9000).map(at).collect()
    }

    /// A camera 600 mm away, turned a little, f = 1400 px, centre (320, 240).
    fn perspective(p: &Vec3) -> [f32; 2] {
        let q = glam::DQuat::from_rotation_y(0.2) * p.as_dvec3() + DVec3::new(5.0, -8.0, -600.0);
        [(320.0 - 1400.0 * q.x / q.z) as f32, (240.0 + 1400.0 * q.y / q.z) as f32]
    }

    #[test]
    fn a_perspective_camera_is_found() {
        let p = head();
        let c: Vec<_> = p.iter().map(perspective).collect();
        let fit = fit_camera(&p, &c).unwrap();
        assert!(fit.max_error_px < 1e-3 && fit.rms_error_px <= fit.max_error_px, "{fit:?}");
        let seen = project(&fit.matrix, Vec3::new(10.0, 20.0, 30.0));
        let want = perspective(&Vec3::new(10.0, 20.0, 30.0));
        assert!((seen[0] - want[0]).abs() < 2e-3 && (seen[1] - want[1]).abs() < 2e-3);
    }

    #[test]
    fn an_orthographic_camera_is_found() {
        let p = head();
        let c: Vec<_> = p.iter().map(|p| [p.x / 0.46 + 168.0, 218.0 - p.y / 0.46]).collect();
        let fit = fit_camera(&p, &c).unwrap();
        assert!(fit.max_error_px < 1e-3, "{fit:?}");
        assert!(fit.matrix[8..11].iter().all(|w| w.abs() < 1e-6));
    }

    #[test]
    fn points_of_a_plane_are_fitted_or_refused_and_the_error_is_the_true_one() {
        let flat: Vec<Vec3> = head().iter().map(|p| Vec3::new(p.x, p.y, 0.3 * p.x + 10.0)).collect();
        let cameras: [fn(&Vec3) -> [f32; 2]; 2] = [perspective, |p| [2.0 * p.x, 3.0 * p.y]];
        for (camera, known_good) in cameras.into_iter().zip([false, true]) {
            let c: Vec<_> = flat.iter().map(camera).collect();
            let fit = fit_camera(&flat, &c);
            assert!(!known_good || fit.is_some_and(|f| f.max_error_px < 1e-3), "{fit:?}");
            let Some(fit) = fit else { continue };
            let error = |(p, c): (&Vec3, &[f32; 2])| {
                let s = project(&fit.matrix, *p);
                f64::from((s[0] - c[0]).hypot(s[1] - c[1]))
            };
            let worst = flat.iter().zip(&c).map(error).fold(0.0, f64::max);
            assert!((worst - fit.max_error_px).abs() < 1e-4);
        }
    }

    #[test]
    fn one_point_off_shows_in_the_largest_error() {
        let p = head();
        let mut c: Vec<_> = p.iter().map(perspective).collect();
        c[1234][0] += 7.0;
        let fit = fit_camera(&p, &c).unwrap();
        assert!((6.9..7.1).contains(&fit.max_error_px) && fit.rms_error_px < 0.2, "{fit:?}");
    }

    #[test]
    fn too_few_equal_or_broken_points() {
        let p = head();
        assert_eq!(fit_camera(&p[..5], &[[0.0; 2]; 5]), None);
        assert_eq!(fit_camera(&[], &[]), None);
        assert_eq!(fit_camera(&[Vec3::NAN; 9], &[[0.0; 2]; 9]), None);
        let same = fit_camera(&[Vec3::ONE; 9], &[[5.0, 6.0]; 9]);
        assert!(same.is_none_or(|f| f.max_error_px < 1e-3));
        let line: Vec<Vec3> = (0..50).map(|i| Vec3::new(i as f32, 0.0, 0.0)).collect();
        let on_line = fit_camera(&line, &line.iter().map(|p| [p.x * 2.0, 3.0]).collect::<Vec<_>>());
        assert!(on_line.is_some_and(|f| f.max_error_px < 1e-3));
    }

    #[test]
    fn eigenvectors_satisfy_their_equation() {
        let a = [[4.0, 1.0, -2.0], [1.0, 3.0, 0.5], [-2.0, 0.5, 1.0]];
        let (values, vectors) = symmetric_eigen(a);
        for k in 0..3 {
            for i in 0..3 {
                let left: f64 = (0..3).map(|j| a[i][j] * vectors[j][k]).sum();
                assert!((left - values[k] * vectors[i][k]).abs() < 1e-12);
            }
        }
        assert!((values.iter().sum::<f64>() - 8.0).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn the_measured_error_is_honest_on_anything(
            numbers in proptest::collection::vec((-1e3_f32..1e3, -1e3_f32..1e3, -1e3_f32..1e3, -1e3_f32..1e3, -1e3_f32..1e3), 6..40)
        ) {
            let p: Vec<Vec3> = numbers.iter().map(|n| Vec3::new(n.0, n.1, n.2)).collect();
            let c: Vec<[f32; 2]> = numbers.iter().map(|n| [n.3, n.4]).collect();
            if let Some(fit) = fit_camera(&p, &c) {
                for (p, c) in p.iter().zip(&c) {
                    let s = project(&fit.matrix, *p);
                    prop_assert!(f64::from((s[0] - c[0]).hypot(s[1] - c[1])) <= fit.max_error_px * 1.001 + 1e-3);
                }
            }
        }
    }
}
