//! Curvature of a triangle mesh: angle defects for the Gaussian, the Laplacian of the positions for the mean one
//! (Meyer, Desbrun, Schröder and Barr 2003).

use super::half_edge::HalfEdges;
use super::{TriMesh, cotangent_laplacian, mixed_areas_mm2, sphere_normals};
use crate::Result;
use glam::DVec3;
use std::f64::consts::{PI, TAU};

/// Angle that is missing to a flat vertex: 2 pi minus the sum of the angles inside the surface (curvature), pi minus
/// it on the border (turning of the border); rad. They sum to 2 pi times the Euler characteristic (Gauss-Bonnet).
/// Zero at a vertex without triangles.
///
/// # Errors
/// [`crate::CodecError::Mesh`] when `mesh` is no oriented manifold.
pub fn angle_defects(mesh: &TriMesh) -> Result<Vec<f64>> {
    let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    let mut defects: Vec<f64> = (0..mesh.vertex_count() as u32)
        .map(|v| match half_edges.is_boundary_vertex(v) {
            _ if half_edges.fan(v).next().is_none() => 0.0,
            true => PI,
            false => TAU,
        })
        .collect();
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        for (&v, angle) in triangle.iter().zip(angles_rad(mesh.corners(t).map(|p| p.as_dvec3()))) {
            defects[v as usize] -= angle;
        }
    }
    Ok(defects)
}

/// Gaussian curvature at each vertex, 1/mm²: angle defect over mixed area. Zero on the border, where it is not defined.
///
/// # Errors
/// [`crate::CodecError::Mesh`] when `mesh` is no oriented manifold.
pub fn gaussian_curvature(mesh: &TriMesh) -> Result<Vec<f64>> {
    let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    let mut curvature = angle_defects(mesh)?;
    for (v, (k, area)) in curvature.iter_mut().zip(mixed_areas_mm2(mesh)).enumerate() {
        *k = if half_edges.is_boundary_vertex(v as u32) { 0.0 } else { *k / area.max(f64::MIN_POSITIVE) };
    }
    Ok(curvature)
}

/// Mean curvature at each vertex, 1/mm: (k1 + k2)/2, 1/r on a sphere of radius r seen from outside, negative in
/// hollows. The part of L x / (2 A) along the normal. Zero on the border, where it is not defined.
///
/// # Errors
/// [`crate::CodecError::Mesh`] when `mesh` is no oriented manifold.
pub fn mean_curvature(mesh: &TriMesh) -> Result<Vec<f64>> {
    let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    let laplacian = cotangent_laplacian(mesh);
    let axis = |k: usize| -> Vec<f64> { mesh.positions_mm.iter().map(|p| f64::from(p[k])).collect() };
    let [x, y, z] = [0, 1, 2].map(|k| laplacian.multiply(&axis(k)));
    let (normals, areas) = (sphere_normals(mesh), mixed_areas_mm2(mesh));
    let at = |v: usize| DVec3::new(x[v], y[v], z[v]).dot(normals[v]) / (2.0 * areas[v].max(f64::MIN_POSITIVE));
    Ok((0..mesh.vertex_count()).map(|v| if half_edges.is_boundary_vertex(v as u32) { 0.0 } else { at(v) }).collect())
}

/// Angles of a triangle; they sum to pi even where it degenerates.
fn angles_rad([a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let angle = |at: DVec3, p: DVec3, q: DVec3| {
        let (e, f) = (p - at, q - at);
        libm::atan2(e.cross(f).length(), e.dot(f))
    };
    let (at_a, at_b) = (angle(a, b, c), angle(b, c, a));
    [at_a, at_b, PI - at_a - at_b]
}

#[cfg(test)]
mod tests {
    use super::super::test_surfaces::{jittered_plate, sphere, torus, tube};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn defects_sum_to_the_euler_characteristic() {
        for (mesh, chi) in [
            (sphere(7, 3.0), 2.0),
            (jittered_plate(9, 4), 1.0),
            (tube(14, 5, 2.0, 4.0), 0.0),
            (torus(18, 11, 5.0, 2.0), 0.0),
        ] {
            let sum: f64 = angle_defects(&mesh).unwrap().iter().sum();
            assert!((sum - TAU * chi).abs() < 1e-9, "{sum} of {}", TAU * chi);
        }
    }

    #[test]
    fn a_sphere_has_the_curvatures_of_its_radius() {
        let r = 40.0;
        let mesh = sphere(24, r);
        let inverse = 1.0 / f64::from(r);
        let (h, k) = (mean_curvature(&mesh).unwrap(), gaussian_curvature(&mesh).unwrap());
        assert!(h.iter().all(|h| (h / inverse - 1.0).abs() < 5e-3), "{h:?}");
        assert!(k.iter().all(|k| (k / (inverse * inverse) - 1.0).abs() < 0.03));
        let turned = TriMesh { triangles: mesh.triangles.iter().map(|&[a, b, c]| [a, c, b]).collect(), ..mesh };
        assert!(mean_curvature(&turned).unwrap().iter().all(|h| *h < 0.0), "seen from inside a sphere is hollow");
    }

    #[test]
    fn a_tube_is_bent_one_way_only_and_a_plate_not_at_all() {
        let mesh = tube(60, 12, 5.0, 6.0);
        let inner = |h: &[f64]| -> Vec<f64> { h.iter().copied().filter(|h| *h != 0.0).collect() };
        let h = inner(&mean_curvature(&mesh).unwrap());
        assert!(h.len() > 500 && h.iter().all(|h| (h / 0.1 - 1.0).abs() < 5e-3));
        assert!(gaussian_curvature(&mesh).unwrap().iter().all(|k| k.abs() < 1e-4));
        let plate = jittered_plate(9, 3);
        assert!(mean_curvature(&plate).unwrap().iter().all(|h| h.abs() < 1e-4));
    }

    #[test]
    fn a_torus_follows_its_closed_form() {
        let (ring, r) = (30.0, 10.0);
        let mesh = torus(90, 60, ring, r);
        let (ring, r) = (f64::from(ring), f64::from(r));
        let (h, k) = (mean_curvature(&mesh).unwrap(), gaussian_curvature(&mesh).unwrap());
        for (v, p) in mesh.positions_mm.iter().enumerate() {
            let p = p.as_dvec3();
            let along = (p.truncate().length() - ring) / r;
            let across = along / (ring + r * along);
            assert!((h[v] - 0.5 * (1.0 / r + across)).abs() < 2e-3, "H at {p}");
            assert!((k[v] - across / r).abs() < 2e-4, "K at {p}");
        }
    }

    proptest! {
        #[test]
        fn defects_of_any_disk_sum_to_a_full_turn(seed in 0u64..500) {
            let mut mesh = jittered_plate(7, seed);
            for (i, p) in mesh.positions_mm.iter_mut().enumerate() {
                p.z = ((i as u64 * 29 + seed) % 13) as f32 * 0.2;
            }
            prop_assert!((angle_defects(&mesh).unwrap().iter().sum::<f64>() - TAU).abs() < 1e-9);
        }
    }
}
