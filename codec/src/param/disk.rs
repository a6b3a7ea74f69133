//! Conformal map of a disk-like surface to the unit disk: Green's function on the border, one harmonic extension.
//!
//! The harmonic function with a pole at p and zero on the border has the harmonic measure seen from p as its border
//! flux; a conformal map that sends p to 0 sends harmonic measure to arc length. So the flux gives the angles on the
//! circle, and a harmonic extension by the same factorized Laplacian gives the rest. The intrinsic Delaunay
//! triangulation makes all weights non-negative (maximum principle, Tutte's theorem on the intrinsic mesh).

use super::harmonic::HarmonicSystem;
use super::mobius::Mobius;
use super::untangle::untangle;
use crate::linalg::SparseLlt;
use crate::mesh::half_edge::{NONE, next};
use crate::mesh::intrinsic::IntrinsicMesh;
use crate::mesh::{DiskMesh, HalfEdges, TriMesh};
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
    /// Border vertices, counter-clockwise.
    pub border: Vec<u32>,
    /// Triangles of the embedded mesh that the map turns over.
    pub flips: usize,
}

/// How a disk is mapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DiskOptions {
    /// Vertex that goes to the centre; the one farthest from the border in edge steps by default.
    pub centre: Option<u32>,
}

/// Maps a disk to the unit disk; rotated so that +y of the scan frame points up.
///
/// # Errors
/// [`CodecError::Mesh`] when `mesh` is not a disk, lies in one point, or is too degenerate for its Laplacian to factorize.
pub fn disk_map(mesh: &TriMesh) -> Result<DiskMap> {
    DiskMapper::default().map(&DiskMesh::new(mesh.clone())?, &mut |_| ())
}

/// Maps disks one after another; elimination order and symbolic factor are kept while the Laplacian has the same
/// pattern.
#[derive(Default)]
pub struct DiskMapper {
    options: DiskOptions,
    factor: Option<SparseLlt>,
}

impl DiskMapper {
    /// Maps with `options`.
    pub fn new(options: DiskOptions) -> Self {
        Self { options, factor: None }
    }

    /// As [`disk_map`]; `on_stage` is called with the name of each stage when it ends: topology, intrinsic, assemble,
    /// factorize, solve, untangle.
    ///
    /// # Errors
    /// As [`disk_map`], and when the wanted centre is no inner vertex.
    pub fn map(&mut self, mesh: &DiskMesh, on_stage: &mut dyn FnMut(&'static str)) -> Result<DiskMap> {
        let mut map = self.harmonic_map(mesh, on_stage)?;
        map.flips = untangle(mesh, &mut map.points, &map.border)?;
        on_stage("untangle");
        Ok(map)
    }

    /// The map that is conformal on the intrinsic triangulation; its flips are not counted.
    fn harmonic_map(&mut self, mesh: &DiskMesh, on_stage: &mut dyn FnMut(&'static str)) -> Result<DiskMap> {
        let half_edges = mesh.half_edges();
        let border = border_of(mesh)?;
        let centre = match self.options.centre {
            None => deepest_vertex(half_edges, &border),
            Some(v) if (v as usize) < mesh.vertex_count() && !half_edges.is_boundary_vertex(v) => v,
            Some(v) => {
                let v = u64::from(v) + 1;
                return Err(CodecError::Mesh(format!("vertex {v} cannot be the centre: it is not inside")));
            }
        };
        on_stage("topology");
        let intrinsic = intrinsic_disk(mesh, &border)?;
        on_stage("intrinsic");
        let system = HarmonicSystem::assemble(&intrinsic, &border);
        on_stage("assemble");
        let factor = system.factorize(&mut self.factor, &mesh.positions_mm)?;
        on_stage("factorize");
        let theta = border_angles(&intrinsic, &system.harmonic_measure(factor, centre), &border);
        let mut points = system.extend(factor, &border, &on_circle(&theta));
        points.truncate(mesh.vertex_count());
        let to_centre = Mobius::centring(points[centre as usize]);
        points.iter_mut().for_each(|z| *z = to_centre.apply(*z));
        turn_upright(mesh, &mut points);
        on_stage("solve");
        if !points.iter().all(|z| z.is_finite()) {
            return Err(CodecError::Mesh("too degenerate to be laid on a disk".into()));
        }
        Ok(DiskMap { points, centre, border, flips: 0 })
    }
}

/// Intrinsic Delaunay triangulation of a disk, no edge across from border to border.
fn intrinsic_disk(mesh: &DiskMesh, border: &[u32]) -> Result<IntrinsicMesh> {
    let mut intrinsic = IntrinsicMesh::new(mesh, &mesh.half_edges().twin);
    intrinsic.mollify()?;
    intrinsic.make_delaunay();
    separate_border(&mut intrinsic, border, mesh.vertex_count());
    Ok(intrinsic)
}

fn on_circle(theta: &[f64]) -> Vec<DVec2> {
    theta.iter().map(|&t| DVec2::new(libm::cos(t), libm::sin(t))).collect()
}

/// Harmonic map to the unit disk whose border keeps its proportions, where the flow of a double cover starts; and the
/// border.
pub(super) fn border_on_circle(mesh: &TriMesh) -> Result<(Vec<DVec2>, Vec<u32>)> {
    let mesh = &DiskMesh::new(mesh.clone())?;
    let border = border_of(mesh)?;
    let intrinsic = intrinsic_disk(mesh, &border)?;
    let system = HarmonicSystem::assemble(&intrinsic, &border);
    let circle = on_circle(&angles_of(&border_lengths(&intrinsic, &border)));
    let mut factor = None;
    let mut points = system.extend(system.factorize(&mut factor, &mesh.positions_mm)?, &border, &circle);
    points.truncate(mesh.vertex_count());
    Ok((points, border))
}

/// Twice the signed area of a triangle on the disk.
pub fn signed_area(points: &[DVec2], t: [u32; 3]) -> f64 {
    let [a, b, c] = t.map(|v| points[v as usize]);
    (b - a).perp_dot(c - a)
}

fn border_of(mesh: &DiskMesh) -> Result<Vec<u32>> {
    let border = mesh.half_edges().boundary_loops().swap_remove(0);
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
fn deepest_vertex(half_edges: &HalfEdges, border: &[u32]) -> u32 {
    let mut seen = vec![false; half_edges.vertex_count()];
    let mut queue = border.to_vec();
    for &b in border {
        seen[b as usize] = true;
    }
    let mut head = 0;
    while head < queue.len() {
        for w in half_edges.neighbours(queue[head]) {
            if !std::mem::replace(&mut seen[w as usize], true) {
                queue.push(w);
            }
        }
        head += 1;
    }
    queue[queue.len() - 1]
}

/// Angle of each border vertex: d theta over an edge is its length times the mean flux density at its ends.
fn border_angles(m: &IntrinsicMesh, flux_of: &[f64], border: &[u32]) -> Vec<f64> {
    let n = border.len();
    let mean = border.iter().map(|&b| flux_of[b as usize]).sum::<f64>() / n as f64;
    let flux: Vec<f64> = border.iter().map(|&b| flux_of[b as usize].max(FLUX_FLOOR * mean)).collect();
    let length = border_lengths(m, border);
    let density: Vec<f64> = (0..n).map(|b| flux[b] / (0.5 * (length[(b + n - 1) % n] + length[b]))).collect();
    let arc: Vec<f64> = (0..n).map(|b| length[b] * (density[b] + density[(b + 1) % n])).collect();
    angles_of(&arc)
}

/// Angles of points on the circle from their distances to the next, in any unit.
fn angles_of(arc: &[f64]) -> Vec<f64> {
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
    use crate::mesh::test_surfaces::{jittered_plate, noise, polar_disk};
    use crate::param::AngleErrors;
    use glam::Vec3;
    use proptest::prelude::*;

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

    /// Height field with a thin spike: its base flips on the disk.
    fn spiky() -> TriMesh {
        let mut mesh = jittered_plate(24, 11);
        let mut noise = noise(5);
        mesh.positions_mm.iter_mut().for_each(|p| p.z = 2.5 * noise());
        mesh.positions_mm[300].z = 40.0;
        mesh
    }

    #[test]
    fn a_rough_surface_is_untangled_and_other_angles_are_left_alone() {
        let mesh = DiskMesh::new(spiky()).unwrap();
        let plain = DiskMapper::default().harmonic_map(&mesh, &mut |_| ()).unwrap();
        assert!(mesh.triangles.iter().any(|t| signed_area(&plain.points, *t) <= 0.0), "rough enough to flip");
        let map = DiskMapper::default().map(&mesh, &mut |_| ()).unwrap();
        assert_eq!(map.flips, 0);
        assert!(map.border.iter().all(|&b| map.points[b as usize].distance(plain.points[b as usize]) < 1e-12));
        let at = |v: u32| mesh.positions_mm[v as usize].as_dvec3();
        let error = |points: &[DVec2]| AngleErrors::between(&mesh.triangles, at, |v| points[v as usize].extend(0.0));
        let (before, after) = (error(&plain.points), error(&map.points));
        assert!(after.mean_deg < 2.0 * before.mean_deg + 1.0, "{before:?} {after:?}");
    }

    #[test]
    fn the_centre_is_where_it_is_wanted_and_the_maps_differ_by_a_moebius_transformation() {
        let (z, triangles) = polar_disk(12);
        let place = |z: &DVec2| Vec3::new(z.x as f32, z.y as f32, 0.4 * z.length_squared() as f32) * 90.0;
        let mesh = TriMesh { positions_mm: z.iter().map(place).collect(), triangles, uv: None };
        let mesh = DiskMesh::new(mesh).unwrap();
        let centred = |centre| DiskMapper::new(DiskOptions { centre }).map(&mesh, &mut |_| ());
        let (middle, aside) = (centred(None).unwrap(), centred(Some(60)).unwrap());
        assert_eq!((middle.centre, aside.centre), (0, 60));
        assert!(aside.points[60].length() < 1e-12);
        let m = Mobius::fit(&middle.points, &aside.points);
        let apart = middle.points.iter().zip(&aside.points).map(|(&p, &q)| m.apply(p).distance(q)).fold(0.0, f64::max);
        assert!(apart < 0.02, "{apart}");
        assert!(centred(Some(z.len() as u32 - 1)).unwrap_err().to_string().contains("cannot be the centre"));
        assert!(centred(Some(u32::MAX)).is_err());
    }

    #[test]
    fn a_mapper_gives_what_single_maps_give() {
        let (z, triangles) = polar_disk(10);
        let mut mapper = DiskMapper::default();
        for k in 0..3 {
            let place =
                |z: &DVec2| Vec3::new(80.0 * z.x as f32, (80 + 20 * k) as f32 * z.y as f32, 30.0 * (z.x * z.y) as f32);
            let mesh = TriMesh { positions_mm: z.iter().map(place).collect(), triangles: triangles.clone(), uv: None };
            let (again, single) =
                (mapper.map(&DiskMesh::new(mesh.clone()).unwrap(), &mut |_| ()).unwrap(), disk_map(&mesh).unwrap());
            assert!(again.points.iter().zip(&single.points).all(|(a, b)| a.distance(*b) < 1e-12));
        }
    }

    proptest! {
        #[test]
        fn random_disks_keep_order_on_the_circle_and_the_maximum_principle(seed in 0u64..500, rough in 0.0..1.5f32) {
            let mut mesh = jittered_plate(9, seed);
            let mut noise = noise(seed ^ 77);
            mesh.positions_mm.iter_mut().for_each(|p| p.z = rough * noise());
            let map = disk_map(&mesh).unwrap();
            let angles = map.border.iter().zip(map.border.iter().cycle().skip(1))
                .map(|(&a, &b)| map.points[a as usize].angle_to(map.points[b as usize]));
            let angles: Vec<f64> = angles.collect();
            prop_assert!(angles.iter().all(|a| *a > 0.0), "the border runs round once, forward");
            prop_assert!((angles.iter().sum::<f64>() - TAU).abs() < 1e-9);
            for (v, z) in map.points.iter().enumerate() {
                let on_border = map.border.contains(&(v as u32));
                let holds = if on_border { (z.length() - 1.0).abs() < 1e-12 } else { z.length() < 1.0 };
                prop_assert!(holds, "vertex {} at {}", v, z);
            }
        }
    }

    /// Random points in a disk of 100 mm and on its rim, Delaunay: each falls into a triangle, then edges are flipped.
    fn random_delaunay_disk(seed: u64, inside: u32, rim: u32) -> TriMesh {
        let mut noise = noise(seed);
        let at = |angle: f64, r: f32| Vec3::new(angle.cos() as f32, angle.sin() as f32, 0.0) * r;
        let mut mesh = TriMesh::default();
        mesh.positions_mm.extend((0..rim).map(|i| at(TAU * f64::from(i) / f64::from(rim), 100.0)));
        mesh.triangles.extend((1..rim - 1).map(|i| [0, i, i + 1]));
        while mesh.positions_mm.len() < (inside + rim) as usize {
            let p = at(TAU * f64::from(noise()), 95.0 * (noise() + 0.5).sqrt());
            let points = &mesh.positions_mm;
            let left = |a: u32, b: u32| {
                let (a, b) = (points[a as usize], points[b as usize]);
                (b - a).truncate().perp_dot((p - a).truncate()) > 1e-2
            };
            let around = |t: &[u32; 3]| left(t[0], t[1]) && left(t[1], t[2]) && left(t[2], t[0]);
            let Some(t) = mesh.triangles.iter().position(around) else { continue };
            let (n, [a, b, c]) = (mesh.positions_mm.len() as u32, mesh.triangles[t]);
            mesh.triangles[t] = [a, b, n];
            mesh.triangles.extend([[b, c, n], [c, a, n]]);
            mesh.positions_mm.push(p);
        }
        let twin = HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap().twin;
        let mut intrinsic = IntrinsicMesh::new(&mesh, &twin);
        intrinsic.make_delaunay();
        mesh.triangles = intrinsic.origin.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect();
        mesh
    }

    proptest! {
        #[test]
        fn random_delaunay_disks_have_no_intrinsic_flip(seed in 0u64..100_000, inside in 20u32..150, rim in 8u32..40) {
            let mut mesh = random_delaunay_disk(seed, inside, rim);
            for p in &mut mesh.positions_mm {
                p.z = 20.0 * (p.x * 0.03).sin() + 0.002 * p.x * p.y;
            }
            let mesh = DiskMesh::new(mesh).unwrap();
            let (half_edges, border) = (mesh.half_edges(), border_of(&mesh).unwrap());
            let intrinsic = intrinsic_disk(&mesh, &border).unwrap();
            let system = HarmonicSystem::assemble(&intrinsic, &border);
            let mut slot = None;
            let factor = system.factorize(&mut slot, &mesh.positions_mm).unwrap();
            let centre = deepest_vertex(half_edges, &border);
            let theta = border_angles(&intrinsic, &system.harmonic_measure(factor, centre), &border);
            let points = system.extend(factor, &border, &on_circle(&theta));
            for t in intrinsic.origin.chunks_exact(3) {
                prop_assert!(signed_area(&points, [t[0], t[1], t[2]]) > -1e-9);
            }
            let map = disk_map(&mesh).unwrap();
            let n = map.border.len();
            let at = |i: usize| map.points[map.border[i % n] as usize];
            prop_assert!((0..n).all(|i| (at(i).length() - 1.0).abs() < 1e-12 && at(i).angle_to(at(i + 1)) > 0.0));
            let sum: f64 = (0..n).map(|i| at(i).angle_to(at(i + 1))).sum();
            prop_assert!((sum - TAU).abs() < 1e-9);
        }
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
