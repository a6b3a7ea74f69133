//! Conformal map of a disk-like surface to the unit disk: Green's function on the border, one harmonic extension.
//!
//! The harmonic function with a pole at p and zero on the border has the harmonic measure seen from p as its border
//! flux; a conformal map that sends p to 0 sends harmonic measure to arc length. So the flux gives the angles on the
//! circle, and a harmonic extension by the same factorized Laplacian gives the rest. The intrinsic Delaunay
//! triangulation makes all weights non-negative (maximum principle, Tutte's theorem on the intrinsic mesh).

use super::mobius::Mobius;
use crate::linalg::{LowerCsc, SparseLlt};
use crate::mesh::half_edge::{NONE, next};
use crate::mesh::intrinsic::IntrinsicMesh;
use crate::mesh::{HalfEdges, TriMesh};
use crate::{CodecError, Result};
use glam::DVec2;
use std::f64::consts::TAU;

/// Border flux is floored at this share of its mean: staircase corners may have none.
const FLUX_FLOOR: f64 = 1e-3;

/// A surface laid on the unit disk.
#[derive(Debug, Clone)]
pub struct DiskMap {
    /// One point a vertex, |z| <= 1, border vertices on the circle.
    pub points: Vec<DVec2>,
    /// The vertex at the centre.
    pub centre: u32,
    /// Triangles of the embedded mesh that the map turns over.
    pub flips: usize,
}

/// Maps a disk to the unit disk; rotated so that +y of the scan frame points up.
///
/// # Errors
/// [`CodecError::Mesh`] when `mesh` is not a disk, lies in one point, or is too degenerate for its Laplacian to factorize.
pub fn disk_map(mesh: &TriMesh) -> Result<DiskMap> {
    let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    let border = single_border(mesh, &half_edges)?;
    let mut intrinsic = IntrinsicMesh::new(mesh, &half_edges.twin);
    intrinsic.mollify()?;
    intrinsic.make_delaunay();
    separate_border(&mut intrinsic, &border, mesh.vertex_count());
    let system = InteriorLaplacian::new(&intrinsic, &border)?;
    let centre = deepest_vertex(mesh, &border);
    let theta = border_angles(&intrinsic, &system, &border, centre);
    let mut points = system.extend(&border, &theta);
    points.truncate(mesh.vertex_count());
    let to_centre = Mobius { rotation: DVec2::X, centre: points[centre as usize] };
    for z in &mut points {
        *z = to_centre.apply(*z);
    }
    turn_upright(mesh, &mut points);
    if !points.iter().all(|z| z.is_finite()) {
        return Err(CodecError::Mesh("too degenerate to be laid on a disk".into()));
    }
    let flips = mesh.triangles.iter().filter(|t| signed_area(&points, **t) <= 0.0).count();
    Ok(DiskMap { points, centre, flips })
}

/// Twice the signed area of a triangle on the disk.
pub fn signed_area(points: &[DVec2], t: [u32; 3]) -> f64 {
    let [a, b, c] = t.map(|v| points[v as usize]);
    (b - a).perp_dot(c - a)
}

fn single_border(mesh: &TriMesh, half_edges: &HalfEdges) -> Result<Vec<u32>> {
    let mut loops = half_edges.boundary_loops();
    if !half_edges.is_disk() {
        return Err(CodecError::Mesh(format!(
            "not a disk: {} boundary loops, Euler characteristic {}, {} pieces (1 of each wanted)",
            loops.len(),
            half_edges.euler_characteristic(),
            half_edges.triangle_components().1
        )));
    }
    let border = loops.swap_remove(0);
    if border.len() == mesh.vertex_count() {
        return Err(CodecError::Mesh("every vertex lies on the border; nothing to map".into()));
    }
    Ok(border)
}

/// Splits interior edges that join two border vertices, so that every triangle reaches the interior.
fn separate_border(m: &mut IntrinsicMesh, border: &[u32], vertex_count: usize) {
    let mut on_border = vec![false; vertex_count];
    for &b in border {
        on_border[b as usize] = true;
    }
    let joins = |m: &IntrinsicMesh, on_border: &[bool], h: u32| {
        let is = |v: u32| on_border.get(v as usize).copied().unwrap_or(false);
        m.twin[h as usize] != NONE && is(m.origin[h as usize]) && is(m.target(h))
    };
    // Flipping after a split may join border vertices again; a few rounds always sufficed, the bound is a guard.
    for _ in 0..16 {
        let before = m.vertex_count;
        let mut h = 0;
        while h < m.twin.len() as u32 {
            if joins(m, &on_border, h) {
                m.split(h);
            }
            h += 1;
        }
        if m.vertex_count == before {
            return;
        }
        m.make_delaunay();
    }
}

/// Vertex farthest from the border in edge steps (the last one a breadth-first walk from the border reaches).
fn deepest_vertex(mesh: &TriMesh, border: &[u32]) -> u32 {
    let n = mesh.vertex_count();
    let mut start = vec![0u32; n + 1];
    for &v in mesh.triangles.iter().flatten() {
        start[v as usize + 1] += 1;
    }
    for i in 0..n {
        start[i + 1] += start[i];
    }
    let mut fill = start.clone();
    let mut around = vec![0u32; mesh.triangles.len() * 3];
    for (t, tri) in mesh.triangles.iter().enumerate() {
        for &v in tri {
            around[fill[v as usize] as usize] = t as u32;
            fill[v as usize] += 1;
        }
    }
    let mut seen = vec![false; n];
    let mut queue = border.to_vec();
    for &b in border {
        seen[b as usize] = true;
    }
    let mut head = 0;
    while head < queue.len() {
        let v = queue[head] as usize;
        head += 1;
        for &t in &around[start[v] as usize..start[v + 1] as usize] {
            for w in mesh.triangles[t as usize] {
                if !std::mem::replace(&mut seen[w as usize], true) {
                    queue.push(w);
                }
            }
        }
    }
    queue[queue.len() - 1]
}

/// The interior block of the cotangent Laplacian, factorized, and its coupling to the border.
struct InteriorLaplacian {
    /// Interior row of a vertex, `u32::MAX` on the border.
    row: Vec<u32>,
    /// (interior row, border vertex, weight)
    coupling: Vec<(u32, u32, f64)>,
    factor: SparseLlt,
    rows: usize,
}

impl InteriorLaplacian {
    fn new(m: &IntrinsicMesh, border: &[u32]) -> Result<Self> {
        let mut row = vec![0u32; m.vertex_count];
        for &b in border {
            row[b as usize] = u32::MAX;
        }
        let mut rows = 0;
        for r in row.iter_mut().filter(|r| **r == 0) {
            *r = rows;
            rows += 1;
        }
        let mut diagonal = vec![0.0; rows as usize];
        let (mut entries, mut coupling) = (Vec::with_capacity(m.twin.len() / 2), Vec::new());
        for h in 0..m.twin.len() as u32 {
            let other = m.twin[h as usize];
            let (i, j) = (m.origin[h as usize], m.target(h));
            if other == NONE || h > other || i == j {
                continue;
            }
            let w = m.edge_weight(h).max(0.0);
            let (ri, rj) = (row[i as usize], row[j as usize]);
            for r in [ri, rj] {
                if r != u32::MAX {
                    diagonal[r as usize] += w;
                }
            }
            match (ri, rj) {
                (u32::MAX, u32::MAX) => {}
                (u32::MAX, r) => coupling.push((r, i, w)),
                (r, u32::MAX) => coupling.push((r, j, w)),
                (a, b) => entries.push((a, b, -w)),
            }
        }
        let factor = SparseLlt::factorize(&LowerCsc::assemble(&diagonal, &entries))?;
        Ok(Self { row, coupling, factor, rows: rows as usize })
    }

    /// Harmonic functions with the given border values e^{i theta}; points of all vertices.
    fn extend(&self, border: &[u32], theta: &[f64]) -> Vec<DVec2> {
        let mut points = vec![DVec2::ZERO; self.row.len()];
        for (&b, &t) in border.iter().zip(theta) {
            points[b as usize] = DVec2::new(libm::cos(t), libm::sin(t));
        }
        let mut rhs = vec![0.0; 2 * self.rows];
        for &(r, b, w) in &self.coupling {
            rhs[r as usize] += w * points[b as usize].x;
            rhs[self.rows + r as usize] += w * points[b as usize].y;
        }
        self.factor.solve(&mut rhs, 2);
        for (z, &r) in points.iter_mut().zip(&self.row).filter(|(_, r)| **r != u32::MAX) {
            *z = DVec2::new(rhs[r as usize], rhs[self.rows + r as usize]);
        }
        points
    }
}

/// Angle of each border vertex: d theta over an edge is its length times the mean flux density at its ends.
fn border_angles(m: &IntrinsicMesh, system: &InteriorLaplacian, border: &[u32], centre: u32) -> Vec<f64> {
    let mut green = vec![0.0; system.rows];
    green[system.row[centre as usize] as usize] = 1.0;
    system.factor.solve(&mut green, 1);
    let n = border.len();
    let mut flux_of = vec![0.0; m.vertex_count];
    for &(r, b, w) in &system.coupling {
        flux_of[b as usize] += w * green[r as usize];
    }
    let mean = border.iter().map(|&b| flux_of[b as usize]).sum::<f64>() / n as f64;
    let flux: Vec<f64> = border.iter().map(|&b| flux_of[b as usize].max(FLUX_FLOOR * mean)).collect();
    let length = border_lengths(m, border);
    let density: Vec<f64> = (0..n).map(|b| flux[b] / (0.5 * (length[(b + n - 1) % n] + length[b]))).collect();
    let arc: Vec<f64> = (0..n).map(|b| length[b] * (density[b] + density[(b + 1) % n])).collect();
    let scale = TAU / arc.iter().sum::<f64>();
    arc.iter()
        .scan(0.0, |sum, a| {
            let theta = *sum;
            *sum += a * scale;
            Some(theta)
        })
        .collect()
}

/// Length of the border edge that leaves each border vertex.
fn border_lengths(m: &IntrinsicMesh, border: &[u32]) -> Vec<f64> {
    let mut leaving = vec![0.0; m.vertex_count];
    for h in (0..m.twin.len()).filter(|&h| m.twin[h] == NONE) {
        leaving[m.origin[h] as usize] = m.length[h];
        debug_assert_ne!(m.origin[h], m.origin[next(h as u32) as usize]);
    }
    border.iter().map(|&b| leaving[b as usize]).collect()
}

/// Turns the disk so that the map's best rotation against the frontal view (x, y) is the identity.
fn turn_upright(mesh: &TriMesh, points: &mut [DVec2]) {
    let middle = mesh.centroid_mm();
    let mut turn = DVec2::ZERO;
    for (z, p) in points.iter().zip(&mesh.positions_mm) {
        let front = (*p - middle).as_dvec3().truncate();
        turn += super::mobius::mul(front, super::mobius::conj(*z));
    }
    if turn.length_squared() > 1e-24 {
        let rotation = turn.normalize();
        for z in points {
            *z = super::mobius::mul(rotation, *z);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::test_surfaces::polar_disk;
    use glam::Vec3;

    /// z + 0.3 z^2 rolled on a cylinder is conformal, so the disk map must return z up to a Möbius transformation.
    fn riemann_error(rings: u32) -> f64 {
        let (z, triangles) = polar_disk(rings);
        let positions_mm = z
            .iter()
            .map(|&z| {
                let w = z + 0.3 * super::super::mobius::mul(z, z);
                let angle = w.x / 1.5;
                (Vec3::new(1.5 * angle.sin() as f32, w.y as f32, 1.5 * angle.cos() as f32)) * 100.0
            })
            .collect();
        let mesh = TriMesh { positions_mm, triangles, uv: None };
        let map = disk_map(&mesh).unwrap();
        assert_eq!(map.flips, 0);
        let m = Mobius::fit(&map.points, &z);
        let sum: f64 = map.points.iter().zip(&z).map(|(&p, &q)| (m.apply(p) - q).length_squared()).sum();
        (sum / z.len() as f64).sqrt()
    }

    #[test]
    fn converges_to_the_exact_riemann_map_at_second_order() {
        let (coarse, fine) = (riemann_error(20), riemann_error(40));
        assert!(coarse < 4e-4, "{coarse}");
        assert!(coarse / fine > 3.4, "{coarse} / {fine}");
    }

    #[test]
    fn border_lies_on_the_circle_in_order_and_inside_within() {
        let (z, triangles) = polar_disk(12);
        let positions_mm = z
            .iter()
            .map(|z| Vec3::new(80.0 * z.x as f32, 110.0 * z.y as f32, 30.0 * (1.0 - z.length_squared()) as f32))
            .collect();
        let mesh = TriMesh { positions_mm, triangles, uv: None };
        let map = disk_map(&mesh).unwrap();
        let n = z.len();
        for (i, p) in map.points.iter().enumerate() {
            if i >= n - 72 {
                assert!((p.length() - 1.0).abs() < 1e-12);
            } else {
                assert!(p.length() < 1.0);
            }
        }
        assert!(map.points[map.centre as usize].length() < 1e-12);
        // Upright: the rim point at +y stays on top.
        let top = (n - 72..n).max_by(|&a, &b| z[a].y.total_cmp(&z[b].y)).unwrap();
        assert!(map.points[top].y > 0.999);
    }

    #[test]
    fn degenerate_surfaces_give_a_finite_map_or_an_error() {
        let (z, triangles) = polar_disk(6);
        let map_of = |place: &dyn Fn(usize, DVec2) -> Vec3| {
            let positions_mm = z.iter().enumerate().map(|(i, &z)| place(i, z)).collect();
            disk_map(&TriMesh { positions_mm, triangles: triangles.clone(), uv: None })
        };
        let flat = |z: DVec2| Vec3::new(z.x as f32, z.y as f32, 0.0) * 100.0;
        let one_point = map_of(&|_, _| Vec3::splat(7.0)).unwrap_err().to_string();
        assert!(one_point.contains("one point"), "{one_point}");
        let far = 2f32.powi(40);
        let cases: [&dyn Fn(usize, DVec2) -> Vec3; 7] = [
            &|_, z| Vec3::X * z.x as f32,
            &|i, z| if i < 40 { Vec3::ZERO } else { flat(z) },
            &|i, z| if i >= 40 { Vec3::ZERO } else { flat(z) },
            &|i, _| if i == 17 { Vec3::ONE } else { Vec3::ZERO },
            &|i, _| if i % 2 == 0 { Vec3::splat(far) } else { Vec3::splat(-far) },
            &|i, z| flat(z) * if i % 5 == 0 { far } else { 1e-6 },
            &|i, z| (flat(z) * 0.01).round() * if i % 3 == 0 { 1.0 } else { -1.0 },
        ];
        let mut mapped = 0;
        for (k, place) in cases.iter().enumerate() {
            if let Ok(map) = map_of(place) {
                mapped += 1;
                assert!(map.points.iter().all(|p| p.is_finite() && p.length() < 1.0 + 1e-6), "case {k}");
            }
        }
        assert!(mapped >= 4, "{mapped} of 7 mapped");
    }

    #[test]
    fn a_closed_piece_beside_the_disk_is_refused() {
        let torus = |x: u32, y: u32| 3 + (y % 4) * 4 + x % 4;
        let mut triangles = vec![[0, 1, 2]];
        for i in 0..16 {
            let (x, y) = (i % 4, i / 4);
            triangles.push([torus(x, y), torus(x + 1, y), torus(x + 1, y + 1)]);
            triangles.push([torus(x, y), torus(x + 1, y + 1), torus(x, y + 1)]);
        }
        let positions_mm = (0..19).map(|v| Vec3::new(v as f32, (v * v % 7) as f32, 0.0)).collect();
        let error = disk_map(&TriMesh { positions_mm, triangles, uv: None }).unwrap_err().to_string();
        assert!(error.contains("2 pieces"), "{error}");
    }

    #[test]
    fn refuses_what_is_no_disk() {
        let tetrahedron = TriMesh {
            positions_mm: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
            triangles: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
            uv: None,
        };
        assert!(disk_map(&tetrahedron).unwrap_err().to_string().contains("not a disk"));
    }
}
