//! Points from camera pixels and projector columns.
//!
//! The camera's ray is z (x, y, 1); in the projector's frame z r + t with r = R (x, y, 1). An ideal normalized column
//! c = (z r_x + t_x) / (z r_z + t_z) then gives z = (t_x - c t_z) / (c r_z - r_x): numerator and denominator are linear in the
//! column, the form X(u) = (o + f u)/(o_w + f_w u). With projector distortion a column is no plane. But a pixel sees only its
//! epipolar line, along which the correction from measured to ideal column is a smooth function of one variable: a cubic a
//! pixel, through four depths of the working range, is exact to 1e-4 px for lenses in use.
//!
//! Output is in the *scan frame*: x right, y up, z towards the scanner, the camera's frame turned by half a turn about x.

use super::mask::{PixelMask, Rejection};
use super::{Calibration, DepthRange, LightError};
use glam::{DVec2, DVec3, Vec3};

/// Points of the camera's pixels, row-major, scan frame.
#[derive(Debug, Clone, Default)]
pub struct PointGrid {
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Points, mm; NaN where nothing was measured.
    pub points_mm: Vec<Vec3>,
}

impl PointGrid {
    /// A grid without points.
    pub fn new(width_px: usize, height_px: usize) -> Self {
        Self { width_px, height_px, points_mm: vec![Vec3::NAN; width_px * height_px] }
    }
}

/// A point of the camera's frame in the scan frame, and back.
pub fn scan_from_camera(p: Vec3) -> Vec3 {
    Vec3::new(p.x, -p.y, -p.z)
}

/// Per-pixel tables.
#[derive(Debug, Clone)]
pub struct Triangulator {
    rays: Vec<PixelRay>,
    translation_mm: Vec3,
    fx_px: f32,
    cx_px: f32,
    near_mm: f32,
    far_mm: f32,
}

#[derive(Debug, Clone, Copy)]
struct PixelRay {
    x: f32,
    y: f32,
    /// x and z of the ray in the projector's axes.
    rx: f32,
    rz: f32,
    /// Ideal minus measured column, both normalized, as a cubic in the measured one.
    correction: [f32; 4],
}

impl Triangulator {
    /// Tables for a rig and a working range.
    ///
    /// # Errors
    /// [`LightError::Field`] for a calibration or range that cannot work.
    pub fn new(calibration: &Calibration, depth: DepthRange) -> Result<Self, LightError> {
        calibration.validate()?;
        depth.validate()?;
        let rotation = calibration.projector_from_camera.matrix();
        let rays = calibration.camera.ray_table("camera")?;
        let pixel_ray = |ray: &DVec2| {
            let in_projector = rotation * ray.extend(1.0);
            PixelRay {
                x: ray.x as f32,
                y: ray.y as f32,
                rx: in_projector.x as f32,
                rz: in_projector.z as f32,
                correction: correction(calibration, in_projector, depth),
            }
        };
        Ok(Self {
            rays: rays.iter().map(pixel_ray).collect(),
            translation_mm: calibration.projector_from_camera.translation().as_vec3(),
            fx_px: calibration.projector.fx_px as f32,
            cx_px: calibration.projector.cx_px as f32,
            near_mm: depth.near_mm as f32,
            far_mm: depth.far_mm as f32,
        })
    }

    /// Points of all kept pixels from their projector columns, px; rejects, in `mask`, those outside the working range.
    ///
    /// # Panics
    /// When a slice or grid is not of the camera's size.
    pub fn triangulate(&self, column_px: &[f32], mask: &mut PixelMask, out: &mut PointGrid) {
        let n = self.rays.len();
        assert!(column_px.len() == n && mask.verdicts.len() == n && out.points_mm.len() == n);
        let inverse_fx = 1.0 / self.fx_px;
        let pixels = self.rays.iter().zip(column_px).zip(mask.verdicts.iter_mut().zip(out.points_mm.iter_mut()));
        for ((ray, &column_px), (verdict, point)) in pixels {
            *point = Vec3::NAN;
            if *verdict != Rejection::Kept {
                continue;
            }
            let measured = (column_px - self.cx_px) * inverse_fx;
            let [c0, c1, c2, c3] = ray.correction;
            let column = measured + (c0 + measured * (c1 + measured * (c2 + measured * c3)));
            let t = self.translation_mm;
            let z_mm = (t.x - column * t.z) / (column * ray.rz - ray.rx);
            if z_mm >= self.near_mm && z_mm <= self.far_mm {
                *point = Vec3::new(ray.x * z_mm, -ray.y * z_mm, -z_mm);
            } else {
                *verdict = Rejection::DepthRange;
            }
        }
    }
}

/// Cubic through the correction at four depths, spread evenly over the columns of the working range and its border.
fn correction(calibration: &Calibration, ray_in_projector: DVec3, depth: DepthRange) -> [f32; 4] {
    let distortion = calibration.projector.distortion;
    if distortion.is_zero() {
        return [0.0; 4];
    }
    let translation = calibration.projector_from_camera.translation();
    let (near, far) = (1.0 / depth.near_mm, 1.0 / depth.far_mm);
    // Columns are linear in the inverse depth, nearly.
    let nodes = [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0].map(|s| {
        let p = ray_in_projector / (far + s * (near - far)) + translation;
        let ideal = p.truncate() / p.z;
        let measured = distortion.distort(ideal).x;
        (measured, ideal.x - measured)
    });
    cubic_through(nodes).map(|c| c as f32)
}

/// Coefficients, constant first, of the cubic through four points: Newton's divided differences, multiplied out.
fn cubic_through(points: [(f64, f64); 4]) -> [f64; 4] {
    let x = points.map(|p| p.0);
    let mut d = points.map(|p| p.1);
    for order in 1..4 {
        for i in (order..4).rev() {
            d[i] = (d[i] - d[i - 1]) / (x[i] - x[i - order]);
        }
    }
    let mut coefficients = [d[3], 0.0, 0.0, 0.0];
    for i in (0..3).rev() {
        // Multiply by (X - x_i) and add d_i.
        for k in (1..4).rev() {
            coefficients[k] = coefficients[k - 1] - x[i] * coefficients[k];
        }
        coefficients[0] = d[i] - x[i] * coefficients[0];
    }
    coefficients
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::Distortion;
    use crate::light::calibration::tests::rig;

    /// Largest distance between the points triangulated from exact columns and the surface `depth_mm(ray)`.
    fn worst_error_mm(calibration: &Calibration, depth_mm: impl Fn(DVec2) -> Option<f64>) -> (f64, usize) {
        let triangulator = Triangulator::new(calibration, DepthRange { near_mm: 450.0, far_mm: 750.0 }).unwrap();
        let rays = calibration.camera.ray_table("camera").unwrap();
        let mut mask = PixelMask::new(640, 480);
        let mut grid = PointGrid::new(640, 480);
        let truth: Vec<Option<DVec3>> = rays.iter().map(|&ray| depth_mm(ray).map(|z| (ray * z).extend(z))).collect();
        for (verdict, point) in mask.verdicts.iter_mut().zip(&truth) {
            *verdict = if point.is_some() { Rejection::Kept } else { Rejection::LowModulation };
        }
        let columns: Vec<f32> =
            truth.iter().map(|p| p.map_or(f32::NAN, |p| calibration.projector_px(p).x as f32)).collect();
        triangulator.triangulate(&columns, &mut mask, &mut grid);
        let errors = truth
            .iter()
            .zip(&grid.points_mm)
            .filter_map(|(truth, point)| truth.map(|t| (scan_from_camera(*point).as_dvec3() - t).length()));
        errors.fold((0.0, 0), |(worst, count), e| {
            assert!(e.is_finite());
            (e.max(worst), count + 1)
        })
    }

    #[test]
    fn a_plane_and_a_sphere_come_back_exactly() {
        let normal = DVec3::new(0.2, -0.1, 1.0).normalize();
        let plane = |ray: DVec2| Some(600.0 * normal.z / normal.dot(ray.extend(1.0)));
        let centre = DVec3::new(5.0, -8.0, 640.0);
        let sphere = |ray: DVec2| {
            let d = ray.extend(1.0);
            let (a, b, c) = (d.length_squared(), d.dot(centre), centre.length_squared() - 80.0f64.powi(2));
            let discriminant = b * b - a * c;
            (discriminant > 0.0).then(|| (b - discriminant.sqrt()) / a)
        };
        let mut ideal = rig();
        ideal.projector.distortion = Distortion::default();
        for calibration in [rig(), ideal] {
            let (worst, count) = worst_error_mm(&calibration, plane);
            assert!(worst < 1e-3 && count == 640 * 480, "plane {worst}");
            let (worst, count) = worst_error_mm(&calibration, sphere);
            assert!(worst < 1e-3 && count > 50_000, "sphere {worst}, {count}");
        }
    }

    #[test]
    fn the_cubic_goes_through_its_points() {
        let f = |x: f64| 0.3 - 2.0 * x + 0.7 * x * x + 5.0 * x * x * x;
        let found = cubic_through([-0.2, -0.05, 0.1, 0.3].map(|x| (x, f(x))));
        for (found, exact) in found.iter().zip([0.3, -2.0, 0.7, 5.0]) {
            assert!((found - exact).abs() < 1e-10);
        }
    }

    #[test]
    fn points_outside_the_working_range_are_rejected() {
        let calibration = rig();
        let triangulator = Triangulator::new(&calibration, DepthRange::default()).unwrap();
        let ray = calibration.camera.unproject(DVec2::new(320.0, 240.0)).unwrap();
        let column = calibration.projector_px((ray * 800.0).extend(800.0)).x as f32;
        let mut mask = PixelMask::new(640, 480);
        let mut grid = PointGrid::new(640, 480);
        triangulator.triangulate(&vec![column; 640 * 480], &mut mask, &mut grid);
        let i = 240 * 640 + 320;
        assert_eq!(mask.verdicts[i], Rejection::DepthRange);
        assert!(grid.points_mm[i].is_nan());
    }
}
