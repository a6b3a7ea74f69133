//! Conformal factor: how much longer the surface is than its picture on the disk.

use super::disk::signed_area;
use crate::mesh::TriMesh;
use glam::DVec2;

/// Areas on the disk are floored at this share of their mean, so that folded triangles do not make factors infinite.
const MIN_RELATIVE_AREA: f64 = 1e-9;

/// lambda at each vertex, mm per unit of the disk: ds = lambda |dz|, lambda² the ratio of the areas of the triangles
/// around the vertex on the surface and on the disk (Lui, Zeng, Yau and Gu 2014). Zero without triangles.
///
/// # Panics
/// When `disk` has not one point a vertex, or a triangle names a vertex that is not there.
pub fn conformal_factors(mesh: &TriMesh, disk: &[DVec2]) -> Vec<f64> {
    assert_eq!(disk.len(), mesh.vertex_count(), "one point of the disk a vertex");
    let mut areas = vec![[0.0f64; 2]; disk.len()];
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let (surface, flat) = (f64::from(mesh.area_normal(t).length()), signed_area(disk, *triangle).abs());
        for &v in triangle {
            areas[v as usize][0] += surface;
            areas[v as usize][1] += flat;
        }
    }
    let floor = MIN_RELATIVE_AREA * areas.iter().map(|a| a[1]).sum::<f64>() / areas.len().max(1) as f64;
    areas.iter().map(|[surface, flat]| (surface / flat.max(floor).max(1e-200)).sqrt()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::test_surfaces::polar_disk;
    use glam::Vec3;

    #[test]
    fn the_factor_of_a_stereographic_sphere_is_its_formula() {
        let (disk, triangles) = polar_disk(60);
        let r = 50.0;
        // Half a sphere of radius r by inverse stereographic projection: lambda = 2 r / (1 + |z|²).
        let place = |z: &DVec2| {
            let s = 1.0 + z.length_squared();
            Vec3::new((2.0 * z.x / s) as f32, (2.0 * z.y / s) as f32, (2.0 / s - 1.0) as f32) * r as f32
        };
        let mesh = TriMesh { positions_mm: disk.iter().map(place).collect(), triangles, uv: None };
        for (z, lambda) in disk.iter().zip(conformal_factors(&mesh, &disk)) {
            let exact = 2.0 * r / (1.0 + z.length_squared());
            assert!((lambda / exact - 1.0).abs() < 0.015, "{lambda} of {exact}");
        }
    }

    #[test]
    fn a_flat_disk_has_its_radius_everywhere_and_folds_stay_finite() {
        let (disk, triangles) = polar_disk(5);
        let flat = |z: &DVec2| Vec3::new(z.x as f32, z.y as f32, 0.0) * 7.0;
        let mesh = TriMesh { positions_mm: disk.iter().map(flat).collect(), triangles, uv: None };
        assert!(conformal_factors(&mesh, &disk).iter().all(|l| (l - 7.0).abs() < 1e-4));
        let collapsed = vec![DVec2::ZERO; disk.len()];
        assert!(conformal_factors(&mesh, &collapsed).iter().all(|l| l.is_finite()));
    }
}
