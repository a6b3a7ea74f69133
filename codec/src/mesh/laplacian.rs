//! Laplacians of a surface as sparse symmetric matrices.
//!
//! Sign and scale: L = D - W with w_ij = (cot a + cot b)/2, so x^T L x is twice the Dirichlet energy of the piecewise
//! linear function x: positive semi-definite, constants in its kernel (Pinkall and Polthier 1993, Computing Discrete
//! Minimal Surfaces and Their Conjugates).

use super::half_edge::{NONE, next};
use super::{HalfEdges, TriMesh, intrinsic::IntrinsicMesh};
use crate::Result;
use crate::linalg::LowerCsc;
use glam::DVec3;

/// Doubled area of a triangle is floored at this share of its longest edge squared, so that cotangents stay finite.
const MIN_RELATIVE_AREA: f64 = 1e-10;

/// Cotangent Laplacian of the triangles as they are, one row a vertex (without unit: cotangents have none). A vertex
/// without triangles has a zero row.
///
/// # Panics
/// When a triangle names a vertex that is not there ([`TriMesh::validate`]).
pub fn cotangent_laplacian(mesh: &TriMesh) -> LowerCsc {
    let mut diagonal = vec![0.0; mesh.vertex_count()];
    let mut entries = Vec::with_capacity(3 * mesh.triangles.len());
    for (t, &[a, b, c]) in mesh.triangles.iter().enumerate() {
        let [cot_a, cot_b, cot_c] = cotangents(mesh.corners(t).map(|p| p.as_dvec3()));
        for (i, j, cotangent) in [(b, c, cot_a), (c, a, cot_b), (a, b, cot_c)] {
            let w = 0.5 * cotangent;
            diagonal[i as usize] += w;
            diagonal[j as usize] += w;
            entries.push((i, j, -w));
        }
    }
    LowerCsc::assemble(&diagonal, &entries)
}

/// Laplacian of the intrinsic Delaunay triangulation (Bobenko and Springborn 2007): the same surface and vertices, no
/// weight negative, so that the maximum principle holds.
///
/// # Errors
/// [`crate::CodecError::Mesh`] when `mesh` is no oriented manifold or lies in one point.
pub fn intrinsic_laplacian(mesh: &TriMesh) -> Result<LowerCsc> {
    let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    let mut m = IntrinsicMesh::new(mesh, &half_edges.twin);
    m.mollify()?;
    m.make_delaunay();
    let mut diagonal = vec![0.0; mesh.vertex_count()];
    let mut entries = Vec::with_capacity(m.twin.len() / 2 + 1);
    let cotangents = m.cotangents();
    for h in 0..m.twin.len() as u32 {
        let other = m.twin[h as usize];
        let (i, j) = (m.origin[h as usize], m.origin[next(h) as usize]);
        if i == j || other != NONE && other < h {
            continue;
        }
        let across = if other == NONE { 0.0 } else { cotangents[other as usize] };
        let w = 0.5 * (cotangents[h as usize] + across);
        diagonal[i as usize] += w;
        diagonal[j as usize] += w;
        entries.push((i, j, -w));
    }
    Ok(LowerCsc::assemble(&diagonal, &entries))
}

/// Cotangents of the angles at the three corners; finite for degenerate triangles.
pub(crate) fn cotangents([a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let (ab, bc, ca) = (b - a, c - b, a - c);
    let longest2 = ab.length_squared().max(bc.length_squared()).max(ca.length_squared());
    let doubled_area = ab.cross(ca).length().max(MIN_RELATIVE_AREA * longest2).max(f64::MIN_POSITIVE);
    [-ab.dot(ca) / doubled_area, -bc.dot(ab) / doubled_area, -ca.dot(bc) / doubled_area]
}

#[cfg(test)]
mod tests {
    use super::super::test_surfaces::{jittered_plate, sphere, torus};
    use super::*;
    use glam::Vec3;
    use proptest::prelude::*;

    fn energy(l: &LowerCsc, x: &[f64]) -> f64 {
        l.multiply(x).iter().zip(x).map(|(a, b)| a * b).sum()
    }

    #[test]
    fn weights_of_an_equilateral_triangle_are_half_of_the_cotangent_of_60_degrees() {
        let positions_mm = vec![Vec3::ZERO, Vec3::X, Vec3::new(0.5, 0.75f32.sqrt(), 0.0)];
        let l = cotangent_laplacian(&TriMesh { positions_mm, triangles: vec![[0, 1, 2]], uv: None });
        let w = 0.5 / 3f64.sqrt();
        for (r, c, v) in l.entries() {
            assert!((v - if r == c { 2.0 * w } else { -w }).abs() < 1e-7);
        }
        assert_eq!(l.entries().count(), 6);
    }

    #[test]
    fn the_inner_row_of_a_square_grid_is_the_five_point_stencil() {
        let mut mesh = jittered_plate(3, 0);
        mesh.positions_mm = (0..9).map(|i| Vec3::new((i % 3) as f32, (i / 3) as f32, 0.0)).collect();
        let mut x = [0.0; 9];
        x[4] = 1.0;
        let row = cotangent_laplacian(&mesh).multiply(&x);
        let expected = [0.0, -1.0, 0.0, -1.0, 4.0, -1.0, 0.0, -1.0, 0.0];
        assert!(row.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{row:?}");
    }

    #[test]
    fn rows_sum_to_zero_on_closed_and_open_surfaces() {
        for mesh in [sphere(8, 3.0), torus(20, 12, 5.0, 2.0), jittered_plate(12, 7)] {
            for l in [cotangent_laplacian(&mesh), intrinsic_laplacian(&mesh).unwrap()] {
                assert_eq!(l.size(), mesh.vertex_count());
                assert!(l.multiply(&vec![1.0; l.size()]).iter().all(|s| s.abs() < 1e-9));
            }
        }
    }

    #[test]
    fn degenerate_triangles_give_finite_entries() {
        let positions_mm = vec![Vec3::ZERO, Vec3::X, Vec3::X * 2.0, Vec3::ZERO];
        let mesh = TriMesh { positions_mm, triangles: vec![[0, 1, 2], [0, 1, 3]], uv: None };
        assert!(cotangent_laplacian(&mesh).entries().all(|(_, _, v)| v.is_finite()));
    }

    proptest! {
        #[test]
        fn linear_functions_are_harmonic_on_the_plane_and_energies_are_areas(seed in 1u64..500, slope in -2.0..2.0f64) {
            let mesh = jittered_plate(9, seed);
            let x: Vec<f64> = mesh.positions_mm.iter().map(|p| f64::from(p.x) + slope * f64::from(p.y)).collect();
            let inner = |i: usize| (1..8).contains(&(i % 9)) && (1..8).contains(&(i / 9));
            for l in [cotangent_laplacian(&mesh), intrinsic_laplacian(&mesh).unwrap()] {
                let y = l.multiply(&x);
                prop_assert!((0..81).filter(|&i| inner(i)).all(|i| y[i].abs() < 1e-4), "{y:?}");
                // Dirichlet energy of a linear function: squared gradient times area.
                let expected = (1.0 + slope * slope) * mesh.area_mm2();
                prop_assert!((energy(&l, &x) - expected).abs() < 1e-4 * expected);
            }
        }

        #[test]
        fn energies_are_not_negative_and_the_intrinsic_one_is_the_smaller(
            seed in 1u64..500, x in proptest::collection::vec(-1.0..1.0f64, 81)
        ) {
            let mut mesh = jittered_plate(9, seed);
            for (i, p) in mesh.positions_mm.iter_mut().enumerate() {
                p.z = ((i * 37 + seed as usize) % 11) as f32 * 0.1;
            }
            let (extrinsic, intrinsic) = (cotangent_laplacian(&mesh), intrinsic_laplacian(&mesh).unwrap());
            prop_assert!(energy(&intrinsic, &x) >= 0.0);
            // Rippa's theorem: Delaunay interpolation has the least Dirichlet energy of all triangulations.
            prop_assert!(energy(&extrinsic, &x) >= energy(&intrinsic, &x) * (1.0 - 1e-6));
            let off = intrinsic.entries().filter(|(r, c, _)| r != c);
            let inner = |v: u32| (1..8).contains(&(v % 9)) && (1..8).contains(&(v / 9));
            prop_assert!(off.filter(|(r, c, _)| inner(*r) || inner(*c)).all(|(_, _, v)| v <= 1e-8));
        }
    }
}
