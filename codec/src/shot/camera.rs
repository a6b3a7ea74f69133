//! The camera of a shot, and the pixels of it that a scan fills.

use super::model::Window;
use super::view::View;
use crate::texture::{CameraFit, fit_camera};
use crate::{CodecError, Result, Scan};
use glam::DVec3;

/// Largest distance of a vertex's projection from its texture pixel, px.
const MAX_ERROR_PX: f64 = 0.5;
/// Vertices that are looked at to find a scan's window.
const PROBES: usize = 2048;
/// Room around a surface without a picture for the motion of a shot, as a share of its larger extent.
const MARGIN: f64 = 0.15;
/// Longest side of a window that is made up, px.
const MAX_MADE_UP_PX: f64 = 1024.0;

/// Camera of a shot: the scanner's where texture coordinates show one, else one that looks along the mean normal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShotCamera {
    /// In integers, as it is sent.
    pub view: View,
    /// Window of all scans when the camera is made up.
    fixed: Option<Window>,
}

impl ShotCamera {
    /// The camera of a shot that begins with `scan`.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when the surface has no area or lies out of range.
    pub fn of(scan: &Scan) -> Result<Self> {
        let facing: DVec3 = scan.mesh.vertex_normals().iter().map(|n| n.as_dvec3()).sum();
        let centre_mm = scan.mesh.centroid_mm().as_dvec3();
        let fitted = texture_px(scan).and_then(|px| fit_camera(&scan.mesh.positions_mm, &px));
        if let Some(camera) = fitted.filter(|f| f.max_error_px <= MAX_ERROR_PX) {
            return Ok(Self { view: View::new(&camera, centre_mm, facing)?, fixed: None });
        }
        let (camera, window) = made_up(scan, facing)?;
        Ok(Self { view: View::new(&camera, centre_mm, facing)?, fixed: Some(window) })
    }

    /// Pixels that a scan fills; `None` when another camera saw it.
    pub fn window(&self, scan: &Scan) -> Option<Window> {
        if self.fixed.is_some() {
            return self.fixed;
        }
        let (picture, uv) = (scan.texture.as_ref()?, scan.mesh.uv.as_ref()?);
        let stride = (uv.len() / PROBES).max(1);
        let probes: Vec<[f64; 2]> = scan
            .mesh
            .positions_mm
            .iter()
            .zip(uv)
            .step_by(stride)
            .map(|(p, uv)| {
                let px = picture.uv_to_px(*uv);
                let units = p.to_array().map(|v| (f64::from(v) * f64::from(super::UNITS_PER_MM)).round() as i32);
                let seen = self.view.project(units)?;
                Some([f64::from(px[0]) * 256.0 - f64::from(seen.x), f64::from(px[1]) * 256.0 - f64::from(seen.y)])
            })
            .collect::<Option<_>>()?;
        let mean = |k: usize| probes.iter().map(|p| p[k]).sum::<f64>() / probes.len() as f64;
        let mean = [mean(0), mean(1)];
        let limit = 256.0 * MAX_ERROR_PX;
        let fits = probes.iter().all(|p| (p[0] - mean[0]).abs() <= limit && (p[1] - mean[1]).abs() <= limit);
        let offset = mean.map(|m| m.round() as i32);
        fits.then_some(Window { width: picture.width_px as usize, height: picture.height_px as usize, offset })
    }
}

fn texture_px(scan: &Scan) -> Option<Vec<[f32; 2]>> {
    let (picture, uv) = (scan.texture.as_ref()?, scan.mesh.uv.as_ref()?);
    Some(uv.iter().map(|&t| picture.uv_to_px(t)).collect())
}

/// An orthographic camera along the mean normal, its pixels as large as the mesh's vertices are apart.
fn made_up(scan: &Scan, facing: DVec3) -> Result<(CameraFit, Window)> {
    let no_area = || CodecError::Mesh("no area is seen; the triangles of the scan face in all directions alike".into());
    let axis = facing.try_normalize().ok_or_else(no_area)?;
    let up = if axis.y.abs() < 0.9 { DVec3::Y } else { DVec3::Z };
    let right = up.cross(axis).normalize();
    let up = axis.cross(right);
    let mesh = &scan.mesh;
    let area_mm2: f64 =
        (0..mesh.triangles.len()).map(|t| 0.5 * mesh.area_normal(t).as_dvec3().dot(axis).max(0.0)).sum();
    let extent = |d: DVec3| {
        let along = mesh.positions_mm.iter().map(|p| p.as_dvec3().dot(d));
        along.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)))
    };
    let ((left, right_end), (bottom, top)) = (extent(right), extent(up));
    let size = (right_end - left).max(top - bottom);
    let pixel_mm =
        (2.0 * area_mm2 / mesh.triangles.len() as f64).sqrt().max(size * (1.0 + 2.0 * MARGIN) / MAX_MADE_UP_PX);
    if !(pixel_mm > 0.0 && size.is_finite()) {
        return Err(no_area());
    }
    let margin = MARGIN * size;
    let x = right / pixel_mm;
    let y = -up / pixel_mm;
    let (x0, y0) = (-(left - margin) / pixel_mm, (top + margin) / pixel_mm);
    let matrix = [x.x, x.y, x.z, x0, y.x, y.y, y.z, y0, 0.0, 0.0, 0.0, 1.0];
    let side = |length: f64| ((length + 2.0 * margin) / pixel_mm).ceil().max(1.0) as usize;
    let window = Window { width: side(right_end - left), height: side(top - bottom), offset: [0; 2] };
    Ok((CameraFit { matrix, max_error_px: 0.0, rms_error_px: 0.0 }, window))
}
