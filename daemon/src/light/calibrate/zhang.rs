//! Closed-form intrinsics and poses from homographies of a plane: Z. Zhang, "A flexible new technique for camera
//! calibration", PAMI 22(11), 2000, sections 3.1 and 3.2, with the constraint of zero skew.

use faer::Mat;
use glam::{DMat3, DVec2, DVec3};

/// A board's pose: p' = rotation p + translation, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pose {
    pub rotation: DMat3,
    pub translation_mm: DVec3,
}

impl Pose {
    /// The moved point.
    pub fn apply(&self, p: DVec3) -> DVec3 {
        self.rotation * p + self.translation_mm
    }
}

/// Matrix of a lens without distortion from homographies (plane, mm, to px) of at least three poses.
///
/// Where noise leaves the conic of the closed form indefinite, or the principal point a picture away, the point is put
/// in the picture's centre and the focal lengths alone are solved for. `None` when that fails too.
pub(super) fn lens_matrix(homographies: &[DMat3], size_px: [u32; 2]) -> Option<DMat3> {
    let [w, h] = size_px.map(f64::from);
    // Pixels to about -1..1, so that the entries of the conic are of one size.
    let to_unit = DMat3::from_cols(
        DVec3::new(2.0 / w, 0.0, 0.0),
        DVec3::new(0.0, 2.0 / w, 0.0),
        DVec3::new(-(w - 1.0) / w, -(h - 1.0) / w, 1.0),
    );
    let normalised: Vec<DMat3> = homographies
        .iter()
        .map(|&homography| {
            let m = to_unit * homography;
            m * (1.0 / (m.x_axis.length() * m.y_axis.length()).sqrt())
        })
        .collect();
    let unit = conic(&normalised, true)
        .and_then(|b| unit_lens(b, h / w))
        .or_else(|| conic(&normalised, false).and_then(|b| unit_lens(b, h / w)))?;
    Some(to_unit.inverse() * unit)
}

/// Image of the absolute conic, B = K^-T K^-1 up to scale, as (B11, B22, B13, B23, B33); B12 is zero without skew, and
/// without `principal_point` B13 and B23 are too.
fn conic(homographies: &[DMat3], principal_point: bool) -> Option<[f64; 5]> {
    let columns: &[usize] = if principal_point { &[0, 1, 2, 3, 4] } else { &[0, 1, 4] };
    let mut v = Mat::<f64>::zeros(2 * homographies.len(), columns.len());
    for (i, homography) in homographies.iter().enumerate() {
        let (h1, h2) = (homography.x_axis, homography.y_axis);
        let (v12, v11, v22) = (products(h1, h2), products(h1, h1), products(h2, h2));
        for (to, &from) in columns.iter().enumerate() {
            v[(2 * i, to)] = v12[from];
            v[(2 * i + 1, to)] = v11[from] - v22[from];
        }
    }
    let found = null_vector(&v)?;
    let mut b = [0.0; 5];
    columns.iter().zip(&found).for_each(|(&to, &value)| b[to] = value);
    Some(b)
}

/// Unit vector x of least |a x|; `None` for fewer equations than that takes.
fn null_vector(a: &Mat<f64>) -> Option<Vec<f64>> {
    let (rows, columns) = (a.nrows(), a.ncols());
    if rows + 1 < columns || !(0..columns).all(|c| (0..rows).all(|r| a[(r, c)].is_finite())) {
        return None;
    }
    let svd = a.svd().ok()?;
    Some((0..columns).map(|i| svd.V()[(i, columns - 1)]).collect())
}

/// Zhang's v_ij (eq. 7) without its entry for the skew.
fn products(a: DVec3, b: DVec3) -> [f64; 5] {
    [a.x * b.x, a.y * b.y, a.z * b.x + a.x * b.z, a.z * b.y + a.y * b.z, a.z * b.z]
}

/// Zhang's appendix B; `height` is that of the picture, its width being two.
fn unit_lens([b11, b22, b13, b23, b33]: [f64; 5], height: f64) -> Option<DMat3> {
    let (cx, cy) = (-b13 / b11, -b23 / b22);
    let scale = b33 - b13 * b13 / b11 - b23 * b23 / b22;
    let (fx, fy) = ((scale / b11).sqrt(), (scale / b22).sqrt());
    let is_lens = |f: f64| (0.2..200.0).contains(&f);
    let is_near = cx.abs() < 3.0 && cy.abs() < 3.0 * height.max(0.1);
    (is_lens(fx) && is_lens(fy) && is_near)
        .then(|| DMat3::from_cols(DVec3::new(fx, 0.0, 0.0), DVec3::new(0.0, fy, 0.0), DVec3::new(cx, cy, 1.0)))
}

/// Pose of the plane, in front of the lens, from its homography.
pub(super) fn pose(lens: DMat3, homography: DMat3) -> Pose {
    let m = lens.inverse() * homography;
    let (mut a, mut b, mut t) = (m.x_axis, m.y_axis, m.z_axis * (2.0 / (m.x_axis.length() + m.y_axis.length())));
    if t.z < 0.0 {
        (a, b, t) = (-a, -b, -t);
    }
    // The nearest orthogonal pair: sum and difference of two unit vectors are at right angles.
    let (a, b) = (a.normalize(), b.normalize());
    let (sum, difference) = ((a + b).normalize(), (a - b).normalize());
    let (r1, r2) = ((sum + difference).normalize(), (sum - difference).normalize());
    Pose { rotation: DMat3::from_cols(r1, r2, r1.cross(r2)), translation_mm: t }
}

/// Largest angle between the normals of the planes seen through these homographies, rad, by a lens of a usual field.
///
/// The picture of the plane's line at infinity, H^-T (0, 0, 1), depends on the plane's normal alone (Hartley and
/// Zisserman, section 8.6). The exact focal length does not matter to tell parallel from tilted.
pub(super) fn largest_tilt_rad(homographies: &[DMat3], size_px: [u32; 2]) -> f64 {
    let [w, h] = size_px.map(f64::from);
    let f = 1.5 * w.max(h);
    let normal = |homography: &DMat3| {
        let horizon = homography.inverse().transpose() * DVec3::Z;
        let centre = DVec2::new(w - 1.0, h - 1.0) * 0.5;
        DVec3::new(f * horizon.x, f * horizon.y, horizon.z + horizon.truncate().dot(centre)).normalize()
    };
    let normals: Vec<DVec3> = homographies.iter().map(normal).collect();
    let pairs = normals.iter().enumerate().flat_map(|(i, a)| normals[i + 1..].iter().map(move |b| a.dot(*b).abs()));
    pairs.fold(1.0f64, f64::min).clamp(0.0, 1.0).acos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::homography::fit_homography;

    fn lens() -> DMat3 {
        DMat3::from_cols(DVec3::new(1150.0, 0.0, 0.0), DVec3::new(0.0, 1140.0, 0.0), DVec3::new(310.0, 250.0, 1.0))
    }

    fn homography_of(pose: &Pose) -> DMat3 {
        let from: Vec<DVec2> = (0..12).map(|i| DVec2::new(f64::from(i % 4), f64::from(i / 4)) * 30.0).collect();
        let project = |p: &DVec2| {
            let q = lens() * pose.apply(p.extend(0.0));
            q.truncate() / q.z
        };
        fit_homography(&from, &from.iter().map(project).collect::<Vec<_>>()).unwrap()
    }

    fn tilted(x: f64, y: f64) -> Pose {
        let rotation = DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x) * DMat3::from_rotation_z(0.1 + x);
        Pose { rotation, translation_mm: DVec3::new(-30.0 + 50.0 * x, 10.0, 600.0 + 100.0 * y) }
    }

    #[test]
    fn exact_homographies_give_lens_and_poses_back() {
        let poses = [tilted(0.4, 0.0), tilted(-0.3, 0.3), tilted(0.0, -0.5), tilted(0.2, 0.4)];
        let homographies: Vec<DMat3> = poses.iter().map(homography_of).collect();
        let found = lens_matrix(&homographies, [640, 480]).unwrap();
        assert!(found.abs_diff_eq(lens(), 1e-6), "{found}");
        for (expected, homography) in poses.iter().zip(&homographies) {
            let pose = pose(found, *homography);
            assert!(pose.rotation.abs_diff_eq(expected.rotation, 1e-8));
            assert!(pose.translation_mm.abs_diff_eq(expected.translation_mm, 1e-5));
        }
    }

    #[test]
    fn the_tilt_tells_parallel_boards_from_others() {
        let parallel: Vec<DMat3> = (0..4)
            .map(|i| {
                let shift = DVec3::new(20.0 * f64::from(i), 0.0, 50.0 * f64::from(i));
                let turn = DMat3::from_rotation_z(0.3 * f64::from(i));
                let first = tilted(0.3, 0.2);
                homography_of(&Pose { rotation: first.rotation * turn, translation_mm: first.translation_mm + shift })
            })
            .collect();
        assert!(largest_tilt_rad(&parallel, [640, 480]) < 1e-3);
        let two = [homography_of(&tilted(0.2, 0.0)), homography_of(&tilted(-0.2, 0.0))];
        let found = largest_tilt_rad(&two, [640, 480]);
        assert!((0.3..0.5).contains(&found), "{found}");
    }
}
