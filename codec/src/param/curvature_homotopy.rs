//! The published homotopy: natural cubic splines in time of (H, lambda) and of the border, each moment reconstructed; beyond
//! the last key the splines run on straight. A reference beside the spline through vertex positions, which is far nearer.

use super::curvature_map::{CommonDisk, CurvatureForm, CurvatureMap, Reconstruction};
use crate::Result;
use crate::motion::spline::ChannelSplines;
use glam::{DVec3, Vec3};

/// Channels a vertex: three of the curvature vector, one of the factor.
const PER_VERTEX: usize = 4;

/// Surfaces over one disk, in motion.
pub struct CurvatureHomotopy {
    splines: ChannelSplines,
    form: CurvatureForm,
}

impl CurvatureHomotopy {
    /// Through `surfaces_mm` (positions over `disk`) at increasing times.
    ///
    /// # Errors
    /// [`crate::CodecError::Mesh`] when a surface does not fit the disk, [`crate::CodecError::Stream`] when times do not
    /// increase or are not one a surface.
    pub fn new(disk: &CommonDisk, times_s: &[f64], surfaces_mm: &[&[Vec3]], form: CurvatureForm) -> Result<Self> {
        let channels = PER_VERTEX * disk.vertex_count() + 3 * disk.border().len();
        let mut values = Vec::with_capacity(channels * surfaces_mm.len());
        for surface in surfaces_mm {
            let map = disk.analyse(surface)?;
            for (c, lambda) in map.curvature_per_mm.iter().zip(&map.factor_mm) {
                values.extend([c.x as f32, c.y as f32, c.z as f32, *lambda as f32]);
            }
            values.extend(map.border_mm.iter().flat_map(|p| p.as_vec3().to_array()));
        }
        Ok(Self { splines: ChannelSplines::new(times_s, values, channels)?, form })
    }

    /// The curvature map at a time, extrapolated straight outside the keys.
    pub fn map_at(&self, disk: &CommonDisk, time_s: f64) -> CurvatureMap {
        let mut row = vec![0.0; self.splines.channels()];
        self.splines.sample(time_s, &mut row);
        let (vertices, border) = row.split_at(PER_VERTEX * disk.vertex_count());
        let vertices = vertices.chunks_exact(PER_VERTEX);
        let wide = |c: &[f32]| DVec3::new(f64::from(c[0]), f64::from(c[1]), f64::from(c[2]));
        CurvatureMap {
            curvature_per_mm: vertices.clone().map(wide).collect(),
            factor_mm: vertices.map(|c| f64::from(c[3])).collect(),
            border_mm: border.chunks_exact(3).map(wide).collect(),
        }
    }

    /// The surface at a time, extrapolated outside the keys.
    ///
    /// # Errors
    /// [`crate::CodecError::Mesh`] when `disk` is not the one of [`Self::new`].
    pub fn surface_at(&self, disk: &CommonDisk, time_s: f64) -> Result<Reconstruction> {
        disk.reconstruct(&self.map_at(disk, time_s), self.form)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::test_surfaces::polar_disk;
    use glam::DVec2;

    /// A dome whose top swells and a bump on it that travels.
    fn surface(points: &[DVec2], t: f64) -> Vec<Vec3> {
        let height = |z: DVec2| {
            let bump = 8.0 * (-z.distance_squared(DVec2::new(0.3 * (t - 1.0), 0.2)) * 30.0).exp();
            (35.0 + 4.0 * t.sin()) * (1.0 - z.length_squared()) + bump
        };
        points.iter().map(|&z| (z * 90.0).extend(height(z)).as_vec3()).collect()
    }

    #[test]
    fn keys_come_back_and_moments_between_and_after_are_near() {
        let (points, triangles) = polar_disk(24);
        let disk = CommonDisk::new(&points, &triangles).unwrap();
        let times: Vec<f64> = (0..5).map(|k| 0.4 * f64::from(k)).collect();
        let keys: Vec<Vec<Vec3>> = times.iter().map(|&t| surface(&points, t)).collect();
        let keys: Vec<&[Vec3]> = keys.iter().map(Vec::as_slice).collect();
        let flat: Vec<f32> = keys.iter().flat_map(|k| k.iter().flat_map(|p| p.to_array())).collect();
        let by_vertex = ChannelSplines::new(&times, flat, 3 * points.len()).unwrap();
        for form in [CurvatureForm::FullVector, CurvatureForm::Published] {
            let homotopy = CurvatureHomotopy::new(&disk, &times, &keys, form).unwrap();
            let error = |t: f64| {
                let found = homotopy.surface_at(&disk, t).unwrap();
                disk.error(&found.positions_mm, &surface(&points, t)).unwrap().rms_mm
            };
            let vertex_error = |t: f64| {
                let mut row = vec![0.0; 3 * points.len()];
                by_vertex.sample(t, &mut row);
                let found: Vec<Vec3> = row.chunks_exact(3).map(Vec3::from_slice).collect();
                disk.error(&found, &surface(&points, t)).unwrap().rms_mm
            };
            let (key, between, after) = (error(0.8), error(0.6), error(1.7));
            println!("{form:?}: key {key:.4}, between {between:.4}, after {after:.4} mm;");
            println!("  vertex spline: between {:.4}, after {:.4} mm", vertex_error(0.6), vertex_error(1.7));
            let limit = if form == CurvatureForm::FullVector { 0.05 } else { 8.0 };
            assert!(key < limit && between < 0.5 + limit && after < 1.0 + limit);
            assert!(vertex_error(0.6) < 0.5);
        }
    }
}
