//! Points from camera pixels and projector columns.
//!
//! The camera's ray is z (x, y, 1); in the projector's frame z r + t with r = R (x, y, 1). An ideal normalized column
//! c = (z r_x + t_x) / (z r_z + t_z) then gives z = (t_x - c t_z) / (c r_z - r_x): numerator and denominator are linear in the
//! column, the form X(u) = (o + f u)/(o_w + f_w u). With projector distortion a column is no plane: the column is corrected by
//! the distortion at the point found, three times.
//!
//! Output is in the *scan frame*: x right, y up, z towards the scanner, the camera's frame turned by half a turn about x.

use super::mask::{PixelMask, Rejection};
use super::{Calibration, DepthRange, Distortion, LightError};
use glam::Vec3;

/// Corrections of the column for projector distortion; each divides the error by about 50 for lenses in use.
const CORRECTIONS: usize = 3;

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

/// Per-pixel tables: the camera's ray, and the same in the projector's axes.
#[derive(Debug, Clone)]
pub struct Triangulator {
    rays: Vec<PixelRay>,
    translation_mm: Vec3,
    fx_px: f32,
    cx_px: f32,
    distortion: Option<Distortion>,
    near_mm: f32,
    far_mm: f32,
}

#[derive(Debug, Clone, Copy)]
struct PixelRay {
    x: f32,
    y: f32,
    in_projector: Vec3,
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
        let distortion = calibration.projector.distortion;
        Ok(Self {
            rays: rays
                .iter()
                .map(|ray| PixelRay {
                    x: ray.x as f32,
                    y: ray.y as f32,
                    in_projector: (rotation * ray.extend(1.0)).as_vec3(),
                })
                .collect(),
            translation_mm: calibration.projector_from_camera.translation().as_vec3(),
            fx_px: calibration.projector.fx_px as f32,
            cx_px: calibration.projector.cx_px as f32,
            distortion: (!distortion.is_zero()).then_some(distortion),
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
            let column = (column_px - self.cx_px) * inverse_fx;
            let z_mm = match &self.distortion {
                None => self.depth_mm(ray, column),
                Some(distortion) => self.depth_under_distortion_mm(ray, column, distortion),
            };
            if z_mm >= self.near_mm && z_mm <= self.far_mm {
                *point = Vec3::new(ray.x * z_mm, -ray.y * z_mm, -z_mm);
            } else {
                *verdict = Rejection::DepthRange;
            }
        }
    }

    /// Depth at which the pixel's ray meets the plane of an ideal normalized column.
    #[inline]
    fn depth_mm(&self, ray: &PixelRay, column: f32) -> f32 {
        let (r, t) = (ray.in_projector, self.translation_mm);
        (t.x - column * t.z) / (column * r.z - r.x)
    }

    #[inline]
    fn depth_under_distortion_mm(&self, ray: &PixelRay, column: f32, distortion: &Distortion) -> f32 {
        let (k1, k2, k3) = (distortion.k1 as f32, distortion.k2 as f32, distortion.k3 as f32);
        let (p1, p2) = (distortion.p1 as f32, distortion.p2 as f32);
        let (r, t) = (ray.in_projector, self.translation_mm);
        let mut x = column;
        for _ in 0..CORRECTIONS {
            let z_mm = self.depth_mm(ray, x);
            let y = (z_mm * r.y + t.y) / (z_mm * r.z + t.z);
            let r2 = x * x + y * y;
            let shift = x * r2 * (k1 + r2 * (k2 + r2 * k3)) + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
            x = column - shift;
        }
        self.depth_mm(ray, x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;
    use glam::{DVec2, DVec3};

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
