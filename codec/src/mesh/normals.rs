//! Vertex normals: area-weighted for drawing, Max's weights for differential geometry.

use super::TriMesh;
use glam::{DVec3, Vec3};

impl TriMesh {
    /// Unit vertex normals, area-weighted; zero where a vertex has no triangle.
    pub fn vertex_normals(&self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; self.positions_mm.len()];
        for (t, tri) in self.triangles.iter().enumerate() {
            let n = self.area_normal(t);
            for &v in tri {
                normals[v as usize] += n;
            }
        }
        for n in &mut normals {
            *n = n.normalize_or_zero();
        }
        normals
    }
}

/// Unit vertex normals that are exact for vertices on a sphere and of second order elsewhere: each corner counts
/// e x f / (|e|² |f|²) (Max 1999, Weights for Computing Vertex Normals from Facet Normals). Zero where a vertex has no
/// triangle of positive area.
///
/// # Panics
/// When a triangle names a vertex that is not there ([`TriMesh::validate`]).
pub fn sphere_normals(mesh: &TriMesh) -> Vec<DVec3> {
    let mut normals = vec![DVec3::ZERO; mesh.vertex_count()];
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let p = mesh.corners(t).map(|p| p.as_dvec3());
        for k in 0..3 {
            let (e, f) = (p[(k + 1) % 3] - p[k], p[(k + 2) % 3] - p[k]);
            let squares = e.length_squared() * f.length_squared();
            if squares > 0.0 {
                normals[triangle[k] as usize] += e.cross(f) / squares;
            }
        }
    }
    normals.iter_mut().for_each(|n| *n = n.normalize_or_zero());
    normals
}

#[cfg(test)]
mod tests {
    use super::super::test_surfaces::{jittered_plate, sphere};
    use super::*;

    #[test]
    fn normals_of_a_sphere_are_its_radii() {
        let mesh = sphere(6, 20.0);
        for (n, p) in sphere_normals(&mesh).iter().zip(&mesh.positions_mm) {
            assert!(n.distance(p.as_dvec3().normalize()) < 1e-5);
        }
        for (n, p) in mesh.vertex_normals().iter().zip(&mesh.positions_mm) {
            assert!(n.distance(p.normalize()) < 0.1);
        }
    }

    #[test]
    fn normals_of_a_plate_point_up_whatever_its_triangles() {
        let mesh = jittered_plate(9, 5);
        assert!(mesh.vertex_normals().iter().all(|n| n.distance(Vec3::Z) < 1e-6));
        assert!(sphere_normals(&mesh).iter().all(|n| n.distance(DVec3::Z) < 1e-6));
    }

    #[test]
    fn unused_and_degenerate_vertices_have_none() {
        let mesh = TriMesh { positions_mm: vec![Vec3::ONE; 4], triangles: vec![[0, 1, 2]], uv: None };
        assert!(mesh.vertex_normals().iter().all(|n| *n == Vec3::ZERO));
        assert!(sphere_normals(&mesh).iter().all(|n| *n == DVec3::ZERO));
    }
}
