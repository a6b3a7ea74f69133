//! Points from camera pixels and projector coordinates of either or both directions, exact for any lenses; the live scanner's
//! columns have their own kernel in [`super::triangulate`].
//!
//! In the projector's frame the camera's ray is z r + t. The ideal normalized column c and row d of the projector each give an
//! equation linear in z: z (r_x - c r_z) = c t_z - t_x, and the same with d and y. Both together are solved by least squares,
//! which weighs each by its share of the baseline; what remains is the distance from the epipolar line.

use super::mask::{PixelMask, Rejection};
use super::triangulate::PointGrid;
use super::{Calibration, DepthRange, LightError};
use glam::{DVec2, DVec3, Vec3};

/// Largest distance of a projector pixel from the epipolar line of its camera pixel, projector pixels.
pub const MAX_EPIPOLAR_PX: f64 = 3.0;

/// Rounds in which the missing coordinate follows the measured one; each is about a hundred times nearer.
const ROUNDS: usize = 4;

/// Projector coordinates of every camera pixel, px.
#[derive(Debug, Clone, Copy)]
pub enum ProjectorCoordinates<'a> {
    /// Columns only.
    Columns(&'a [f32]),
    /// Rows only.
    Rows(&'a [f32]),
    /// Columns and rows.
    Both(&'a [f32], &'a [f32]),
}

/// Rays of a rig's camera, for one scan after the other.
#[derive(Debug, Clone)]
pub struct Intersector {
    calibration: Calibration,
    depth: DepthRange,
    rays: Vec<DVec2>,
}

impl Intersector {
    /// Rays for a rig and a working range.
    ///
    /// # Errors
    /// [`LightError::Field`] for a calibration or range that cannot work.
    pub fn new(calibration: &Calibration, depth: DepthRange) -> Result<Self, LightError> {
        calibration.validate()?;
        depth.validate()?;
        Ok(Self { calibration: *calibration, depth, rays: calibration.camera.ray_table("camera")? })
    }

    /// Points of all kept pixels, scan frame; rejects, in `mask`, those off the epipolar line and outside the working range.
    ///
    /// # Panics
    /// When a slice, the mask or the grid is not of the camera's size.
    pub fn intersect(&self, coordinates: ProjectorCoordinates<'_>, mask: &mut PixelMask, out: &mut PointGrid) {
        assert_eq!(self.rays.len(), mask.verdicts.len(), "calibration and mask differ in size");
        let rotation = self.calibration.projector_from_camera.matrix();
        out.points_mm.fill(Vec3::NAN);
        for (i, ray) in self.rays.iter().enumerate() {
            if !mask.is_kept(i) {
                continue;
            }
            let ray_in_projector = rotation * ray.extend(1.0);
            let px = |coordinate: f32| Some(f64::from(coordinate));
            let [column, row] = match coordinates {
                ProjectorCoordinates::Columns(columns) => [px(columns[i]), None],
                ProjectorCoordinates::Rows(rows) => [None, px(rows[i])],
                ProjectorCoordinates::Both(columns, rows) => [px(columns[i]), px(rows[i])],
            };
            match depth_mm(&self.calibration, ray_in_projector, column, row) {
                Some((_, distance_px)) if distance_px > MAX_EPIPOLAR_PX => mask.verdicts[i] = Rejection::Epipolar,
                Some((z_mm, _)) if z_mm >= self.depth.near_mm && z_mm <= self.depth.far_mm => {
                    out.points_mm[i] = Vec3::new((ray.x * z_mm) as f32, (-ray.y * z_mm) as f32, -z_mm as f32);
                }
                _ => mask.verdicts[i] = Rejection::DepthRange,
            }
        }
    }
}

/// Distance of a projector pixel from the epipolar line of a camera pixel, projector pixels; `None` where a lens folds, or where
/// the rays meet behind the rig.
pub fn epipolar_distance_px(calibration: &Calibration, camera_px: DVec2, projector_px: DVec2) -> Option<f64> {
    let ray = calibration.projector_from_camera.matrix() * calibration.camera.unproject(camera_px)?.extend(1.0);
    depth_mm(calibration, ray, Some(projector_px.x), Some(projector_px.y)).map(|(_, distance_px)| distance_px)
}

/// Depth along a ray, mm, and distance of the projector pixel from the epipolar line, px; `None` where the lens folds.
fn depth_mm(calibration: &Calibration, ray: DVec3, column_px: Option<f64>, row_px: Option<f64>) -> Option<(f64, f64)> {
    let projector = &calibration.projector;
    let t = calibration.projector_from_camera.translation();
    let (x, y) = (f64::from(u8::from(column_px.is_some())), f64::from(u8::from(row_px.is_some())));
    let is_both = x * y > 0.0;
    // The coordinate that is missing begins in the middle, and then is that of the point found.
    let mut px = DVec2::new(column_px.unwrap_or(projector.cx_px), row_px.unwrap_or(projector.cy_px));
    let mut found = None;
    for _ in 0..if is_both { 1 } else { ROUNDS } {
        let ideal = projector.unproject(px)?;
        let a = (ray.truncate() - ideal * ray.z) * DVec2::new(x, y);
        let b = (ideal * t.z - t.truncate()) * DVec2::new(x, y);
        let z_mm = a.dot(b) / a.length_squared();
        let point = ray * z_mm + t;
        if !(z_mm > 0.0 && point.z > 0.0) {
            return None;
        }
        let distance_px = ((a * z_mm - b) * DVec2::new(projector.fx_px, projector.fy_px)).length() / point.z;
        found = Some((z_mm, if is_both { distance_px } else { 0.0 }));
        let seen_px = projector.project(point);
        px = DVec2::new(column_px.unwrap_or(seen_px.x), row_px.unwrap_or(seen_px.y));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;

    /// A small camera on a rig with the projector beside and above, so that columns and rows both measure.
    fn slanted() -> Calibration {
        let mut c = rig();
        (c.camera.width_px, c.camera.height_px) = (64, 48);
        for length in [&mut c.camera.fx_px, &mut c.camera.fy_px, &mut c.camera.cx_px, &mut c.camera.cy_px] {
            *length /= 10.0;
        }
        c.projector_from_camera.translation_mm[1] += 120.0;
        c
    }

    #[test]
    fn a_plane_comes_back_from_columns_rows_and_both() {
        let c = slanted();
        let normal = DVec3::new(0.2, -0.1, 1.0).normalize();
        let rays = c.camera.ray_table("camera").unwrap();
        let truth: Vec<DVec3> =
            rays.iter().map(|r| r.extend(1.0) * 600.0 * normal.z / normal.dot(r.extend(1.0))).collect();
        let px: Vec<DVec2> = truth.iter().map(|p| c.projector_px(*p)).collect();
        let (columns, mut rows): (Vec<f32>, Vec<f32>) = px.iter().map(|p| (p.x as f32, p.y as f32)).unzip();
        let intersector = Intersector::new(&c, DepthRange::default()).unwrap();
        for coordinates in [
            ProjectorCoordinates::Columns(&columns),
            ProjectorCoordinates::Rows(&rows),
            ProjectorCoordinates::Both(&columns, &rows),
        ] {
            let mut mask = PixelMask::new(64, 48);
            let mut grid = PointGrid::new(64, 48);
            intersector.intersect(coordinates, &mut mask, &mut grid);
            assert_eq!(mask.count().total(), 0);
            for (point, truth) in grid.points_mm.iter().zip(&truth) {
                let error = (super::super::triangulate::scan_from_camera(*point).as_dvec3() - truth).length();
                assert!(error < 2e-3, "{error} mm");
            }
        }
        rows[100] += 12.0;
        let mut mask = PixelMask::new(64, 48);
        intersector.intersect(ProjectorCoordinates::Both(&columns, &rows), &mut mask, &mut PointGrid::new(64, 48));
        assert_eq!((mask.verdicts[100], mask.count().total()), (Rejection::Epipolar, 1));
    }
}
