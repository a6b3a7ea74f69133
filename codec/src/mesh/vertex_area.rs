//! The share of the surface that belongs to each vertex: the lumped mass matrix, as its diagonal.

use super::TriMesh;
use super::laplacian::cotangents;

/// A third of the triangles around each vertex, mm². Sums to the area of the mesh.
///
/// # Panics
/// When a triangle names a vertex that is not there ([`TriMesh::validate`]).
pub fn barycentric_areas_mm2(mesh: &TriMesh) -> Vec<f64> {
    let mut areas = vec![0.0; mesh.vertex_count()];
    for (t, corners) in mesh.triangles.iter().enumerate() {
        let third = f64::from(mesh.area_normal(t).length()) / 6.0;
        corners.iter().for_each(|&v| areas[v as usize] += third);
    }
    areas
}

/// Voronoi areas where triangles are acute, halves and quarters of obtuse ones, mm² (Meyer, Desbrun, Schröder and Barr
/// 2003, Discrete Differential-Geometry Operators for Triangulated 2-Manifolds, section 3.3). Sums to the area of the
/// mesh; the choice that makes curvature least wrong.
///
/// # Panics
/// When a triangle names a vertex that is not there ([`TriMesh::validate`]).
pub fn mixed_areas_mm2(mesh: &TriMesh) -> Vec<f64> {
    let mut areas = vec![0.0; mesh.vertex_count()];
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let corners = mesh.corners(t).map(|p| p.as_dvec3());
        let cot = cotangents(corners);
        let [a, b, c] = corners;
        let area = 0.5 * (b - a).cross(c - a).length();
        let obtuse = (0..3).find(|&k| cot[k] < 0.0);
        for k in 0..3 {
            let (i, j) = ((k + 1) % 3, (k + 2) % 3);
            areas[triangle[k] as usize] += match obtuse {
                None => {
                    let across_j = corners[k].distance_squared(corners[i]) * cot[j];
                    let across_i = corners[k].distance_squared(corners[j]) * cot[i];
                    (across_j + across_i) / 8.0
                }
                Some(at) if at == k => 0.5 * area,
                Some(_) => 0.25 * area,
            };
        }
    }
    areas
}

#[cfg(test)]
mod tests {
    use super::super::test_surfaces::jittered_plate;
    use super::*;
    use glam::Vec3;
    use proptest::prelude::*;

    #[test]
    fn right_and_obtuse_triangles_by_hand() {
        let mut mesh = TriMesh {
            positions_mm: vec![Vec3::ZERO, Vec3::X * 2.0, Vec3::Y * 2.0],
            triangles: vec![[0, 1, 2]],
            uv: None,
        };
        // The Voronoi cells of a right triangle: a square at the right angle, half a square at the others.
        let expected = [1.0, 0.5, 0.5];
        assert!(mixed_areas_mm2(&mesh).iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6));
        assert!(barycentric_areas_mm2(&mesh).iter().all(|a| (a - 2.0 / 3.0).abs() < 1e-6));
        mesh.positions_mm[0] = Vec3::new(0.9, 0.9, 0.0);
        let area = mesh.area_mm2();
        let expected = [0.5 * area, 0.25 * area, 0.25 * area];
        assert!(mixed_areas_mm2(&mesh).iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6));
    }

    proptest! {
        #[test]
        fn shares_are_positive_and_sum_to_the_area(seed in 0u64..500) {
            let mesh = jittered_plate(8, seed);
            for areas in [barycentric_areas_mm2(&mesh), mixed_areas_mm2(&mesh)] {
                prop_assert!(areas.iter().all(|&a| a > 0.0));
                prop_assert!((areas.iter().sum::<f64>() - mesh.area_mm2()).abs() < 1e-5 * mesh.area_mm2());
            }
        }
    }
}
