//! Fills one hole of a surface by a patch as fine as its surroundings (P. Liepa, Filling Holes in Meshes, 2003).
//!
//! Triangulation of least area, refinement with Delaunay flips, then a harmonic surface through the rim, bent to a thin plate
//! that leaves the rim in the surface's tangent plane. Centroid fans
//! are left to the few rims that allow nothing else: their slivers ruin a conformal map.

mod fairing;

use super::half_edge::{HalfEdges, NONE, next, pair_edges, prev};
use super::{TriMesh, polygon::triangulate};
use glam::Vec3;
use std::f32::consts::SQRT_2;

/// Rounds of splitting; each can triple the triangles, so that far fewer are ever needed.
const MAX_REFINE_ROUNDS: usize = 40;
/// Passes of edge flips after a round of splitting. Flips nearly always settle in a few.
const MAX_FLIP_PASSES: usize = 12;
/// Conjugate-gradient steps; the count needed grows with the patch's width in vertices.
const MAX_SOLVE_STEPS: usize = 1000;
/// Where the solver stops: residual against right-hand side.
const SOLVE_TOLERANCE: f64 = 1e-6;

/// A patch under construction. Vertices below `rim.len()` are the rim, the others are new.
struct Patch<'a> {
    half_edges: &'a HalfEdges,
    /// Mesh vertices around the hole, the hole on the left.
    rim: Vec<u32>,
    /// x, y, z, u, v.
    values: Vec<[f64; 5]>,
    /// Mean length of the edges wanted around each vertex, mm.
    scale_mm: Vec<f32>,
    /// Local half-edges, three a triangle.
    origin: Vec<u32>,
    twin: Vec<u32>,
}

/// Closes the hole inside `ring`, a boundary loop of `mesh` as [`HalfEdges::boundary_loops`] gives it. New vertices
/// and triangles are appended; positions and texture coordinates are those of a thin plate, of a membrane in very large
/// holes and where a plate would overshoot.
pub(crate) fn fill_hole(mesh: &mut TriMesh, half_edges: &mut HalfEdges, ring: &[u32]) {
    fill_hole_as(mesh, half_edges, ring, true);
}

/// As [`fill_hole`]; a membrane where not `fair`.
fn fill_hole_as(mesh: &mut TriMesh, half_edges: &mut HalfEdges, ring: &[u32], fair: bool) {
    let mut patch = Patch::new(mesh, half_edges, ring);
    for _ in 0..MAX_REFINE_ROUNDS {
        if !patch.split() {
            break;
        }
        patch.flip_to_delaunay();
    }
    patch.make_harmonic();
    patch.flip_to_delaunay();
    if fair {
        patch.make_fair(mesh);
        patch.flip_to_delaunay();
    }
    let Patch { rim, values, origin, twin, .. } = patch;
    append(mesh, half_edges, [&rim, &origin, &twin], &values[rim.len()..]);
}

impl<'a> Patch<'a> {
    fn new(mesh: &TriMesh, half_edges: &'a HalfEdges, ring: &[u32]) -> Self {
        let rim: Vec<u32> = ring.iter().rev().copied().collect();
        let mut values: Vec<[f64; 5]> = rim.iter().map(|&v| vertex_values(mesh, v)).collect();
        let mut scale_mm: Vec<f32> = rim.iter().map(|&v| mean_edge_mm(mesh, half_edges, v)).collect();
        let points: Vec<Vec3> = rim.iter().map(|&v| mesh.positions_mm[v as usize]).collect();
        let normals: Vec<Vec3> = rim.iter().map(|&v| fan_normal(mesh, half_edges, v)).collect();
        let taken = |i: usize, j: usize| half_edges.neighbours(rim[i]).any(|v| v == rim[j]);
        let (triangles, centres) = triangulate(&points, &normals, taken);
        for centre in centres {
            values.push(mean(&centre, &values));
            scale_mm.push(centre.iter().map(|&i| scale_mm[i as usize]).sum::<f32>() / centre.len() as f32);
        }
        let origin = triangles.as_flattened().to_vec();
        let twin = pair_edges(values.len(), &origin, |_| unreachable!("a triangulated polygon is a manifold"));
        let mut patch = Self { half_edges, rim, values, scale_mm, origin, twin };
        patch.flip_to_delaunay();
        patch
    }

    fn position(&self, v: u32) -> Vec3 {
        let p = &self.values[v as usize];
        Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32)
    }

    /// Splits at its centroid every triangle that is large for its surroundings; whether there was one.
    fn split(&mut self) -> bool {
        let before = self.values.len();
        for t in 0..self.origin.len() / 3 {
            let corners = [0, 1, 2].map(|k| self.origin[3 * t + k]);
            let scale = corners.iter().map(|&v| self.scale_mm[v as usize]).sum::<f32>() / 3.0;
            let centre = corners.iter().map(|&v| self.position(v)).sum::<Vec3>() / 3.0;
            let large = corners.iter().all(|&v| {
                let reach = SQRT_2 * (self.position(v) - centre).length();
                reach > scale && reach > self.scale_mm[v as usize]
            });
            if large {
                self.split_triangle(t, corners, scale);
            }
        }
        self.values.len() > before
    }

    fn split_triangle(&mut self, t: usize, [a, b, c]: [u32; 3], scale_mm: f32) {
        let centre = self.values.len() as u32;
        self.values.push(mean(&[a, b, c], &self.values));
        self.scale_mm.push(scale_mm);
        let (first, second, third) = (3 * t as u32, self.origin.len() as u32, self.origin.len() as u32 + 3);
        let outer = [first, first + 1, first + 2].map(|h| self.twin[h as usize]);
        self.origin[first as usize + 2] = centre;
        self.origin.extend([b, c, centre, c, a, centre]);
        self.twin.extend([NONE; 6]);
        for (i, triangle) in [first, second, third].into_iter().enumerate() {
            self.link(triangle, outer[i]);
            self.link(triangle + 1, [second, third, first][i] + 2);
        }
    }

    fn link(&mut self, h: u32, twin: u32) {
        self.twin[h as usize] = twin;
        if twin != NONE {
            self.twin[twin as usize] = h;
        }
    }

    /// Flips edges whose opposite angles sum to more than pi, in passes, until none is left.
    fn flip_to_delaunay(&mut self) {
        for _ in 0..MAX_FLIP_PASSES {
            let mut flips = 0;
            for h in 0..self.origin.len() as u32 {
                if self.twin[h as usize] > h && self.twin[h as usize] != NONE && self.should_flip(h) {
                    self.flip(h);
                    flips += 1;
                }
            }
            if flips == 0 {
                break;
            }
        }
    }

    fn should_flip(&self, h: u32) -> bool {
        let g = self.twin[h as usize];
        let [a, b, c, d] = [h, next(h), prev(h), prev(g)].map(|e| self.origin[e as usize]);
        let [pa, pb, pc, pd] = [a, b, c, d].map(|v| self.position(v));
        let cotangent = |at: Vec3| (pa - at).dot(pb - at) / (pa - at).cross(pb - at).length().max(f32::MIN_POSITIVE);
        if cotangent(pc) + cotangent(pd) >= -1e-4 {
            return false;
        }
        let before = (pb - pa).cross(pc - pa) + (pa - pb).cross(pd - pb);
        let keeps_side = |n: Vec3| n.dot(before) > 0.0;
        keeps_side((pa - pc).cross(pd - pc)) && keeps_side((pd - pc).cross(pb - pc)) && !self.is_edge(h, c, d)
    }

    /// Whether `d` is a neighbour of `c` already, in the patch or in the mesh around it. `h` is opposite `c`.
    fn is_edge(&self, h: u32, c: u32, d: u32) -> bool {
        let rim = self.rim.len();
        if (c as usize) < rim && (d as usize) < rim {
            let (c, d) = (self.rim[c as usize], self.rim[d as usize]);
            if self.half_edges.neighbours(c).any(|v| v == d) {
                return true;
            }
        }
        let start = prev(h);
        let mut at = start;
        loop {
            if self.origin[next(at) as usize] == d || self.origin[prev(at) as usize] == d {
                return true;
            }
            at = self.twin[prev(at) as usize];
            if at == start {
                return false;
            }
            if at == NONE {
                break;
            }
        }
        at = self.twin[start as usize];
        while at != NONE {
            if self.origin[prev(at) as usize] == d {
                return true;
            }
            at = self.twin[next(at) as usize];
        }
        false
    }

    /// Turns the edge a-b of triangles abc and bad into c-d.
    fn flip(&mut self, h: u32) {
        let g = self.twin[h as usize];
        let (hn, hp, gn, gp) = (next(h), prev(h), next(g), prev(g));
        let [a, b, c, d] = [h, g, hp, gp].map(|e| self.origin[e as usize]);
        let [outer_bc, outer_ca, outer_ad, outer_db] = [hn, hp, gn, gp].map(|e| self.twin[e as usize]);
        for (e, v) in [(h, d), (hn, c), (hp, a), (g, c), (gn, d), (gp, b)] {
            self.origin[e as usize] = v;
        }
        for (e, outer) in [(hn, outer_ca), (hp, outer_ad), (gn, outer_db), (gp, outer_bc)] {
            self.link(e, outer);
        }
    }

    /// Moves the new vertices so that each is the mean of its neighbours: a membrane through the rim.
    fn make_harmonic(&mut self) {
        let rim = self.rim.len();
        let n = self.values.len() - rim;
        let mut start = vec![0usize; n + 1];
        let inner = |v: u32| (v as usize).checked_sub(rim);
        for i in self.origin.iter().filter_map(|&v| inner(v)) {
            start[i + 1] += 1;
        }
        for i in 0..n {
            start[i + 1] += start[i];
        }
        let (mut fill, mut neighbours) = (start.clone(), vec![0u32; start[n]]);
        for h in 0..self.origin.len() as u32 {
            if let Some(i) = inner(self.origin[h as usize]) {
                neighbours[fill[i]] = self.origin[next(h) as usize];
                fill[i] += 1;
            }
        }
        let laplacian = Laplacian { start, neighbours, rim: rim as u32 };
        laplacian.solve(&mut self.values);
    }
}

/// Sews a patch, given by its rim and its local half-edges' origins and twins, into the mesh and its connectivity.
fn append(mesh: &mut TriMesh, half_edges: &mut HalfEdges, [rim, origin, twin]: [&[u32]; 3], new: &[[f64; 5]]) {
    let (first, first_h) = (mesh.vertex_count() as u32, half_edges.origin.len() as u32);
    let global = |v: u32| rim.get(v as usize).copied().unwrap_or_else(|| first + v - rim.len() as u32);
    half_edges.origin.extend(origin.iter().map(|&v| global(v)));
    half_edges.outgoing.resize(first as usize + new.len(), NONE);
    for (h, &local) in (0..).zip(twin) {
        let v = global(origin[h as usize]) as usize;
        if half_edges.outgoing[v] == NONE {
            half_edges.outgoing[v] = first_h + h;
        }
        let twin = if local == NONE {
            // The half-edge of the old border that runs the other way leaves where this one ends.
            let across = half_edges.outgoing[half_edges.to(first_h + h) as usize];
            half_edges.twin[across as usize] = first_h + h;
            across
        } else {
            first_h + local
        };
        half_edges.twin.push(twin);
    }
    mesh.triangles.extend_from_slice(half_edges.origin[first_h as usize..].as_chunks::<3>().0);
    mesh.positions_mm.extend(new.iter().map(|p| Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32)));
    if let Some(uv) = &mut mesh.uv {
        uv.extend(new.iter().map(|p| [p[3] as f32, p[4] as f32]));
    }
}

/// Uniform Laplacian over the vertices from `rim` on, all others fixed.
struct Laplacian {
    start: Vec<usize>,
    neighbours: Vec<u32>,
    rim: u32,
}

impl Laplacian {
    fn row(&self, i: usize) -> &[u32] {
        &self.neighbours[self.start[i]..self.start[i + 1]]
    }

    /// degree * x_i - sum of the free neighbours.
    fn apply(&self, x: &[[f64; 5]], out: &mut [[f64; 5]]) {
        for (i, out) in out.iter_mut().enumerate() {
            let row = self.row(i);
            *out = x[i].map(|a| a * row.len() as f64);
            for &j in row.iter().filter(|&&j| j >= self.rim) {
                for (o, a) in out.iter_mut().zip(&x[(j - self.rim) as usize]) {
                    *o -= a;
                }
            }
        }
    }

    /// Conjugate gradients on all columns at once, each with its own step lengths; starts from the present values.
    fn solve(&self, values: &mut [[f64; 5]]) {
        let n = self.start.len() - 1;
        let (fixed, x) = values.split_at_mut(self.rim as usize);
        let mut residual = vec![[0.0; 5]; n];
        self.apply(x, &mut residual);
        for (i, r) in residual.iter_mut().enumerate() {
            *r = r.map(|a| -a);
            for &j in self.row(i).iter().filter(|&&j| j < self.rim) {
                add_scaled(r, &fixed[j as usize], [1.0; 5]);
            }
        }
        let mut direction = residual.clone();
        let mut product = vec![[0.0; 5]; n];
        let mut energy = dot(&residual, &residual);
        let goal = energy.map(|e| e * SOLVE_TOLERANCE * SOLVE_TOLERANCE + 1e-24);
        for _ in 0..MAX_SOLVE_STEPS {
            if energy.iter().zip(&goal).all(|(e, g)| e <= g) {
                break;
            }
            self.apply(&direction, &mut product);
            let curvature = dot(&direction, &product);
            let step = std::array::from_fn(|c| if curvature[c] > 0.0 { energy[c] / curvature[c] } else { 0.0 });
            for i in 0..n {
                add_scaled(&mut x[i], &direction[i], step);
                add_scaled(&mut residual[i], &product[i], step.map(|s: f64| -s));
            }
            let old = std::mem::replace(&mut energy, dot(&residual, &residual));
            for (d, r) in direction.iter_mut().zip(&residual) {
                *d = std::array::from_fn(|c| r[c] + if old[c] > 0.0 { energy[c] / old[c] * d[c] } else { 0.0 });
            }
        }
    }
}

fn add_scaled(x: &mut [f64; 5], y: &[f64; 5], factor: [f64; 5]) {
    for c in 0..5 {
        x[c] += factor[c] * y[c];
    }
}

fn dot(x: &[[f64; 5]], y: &[[f64; 5]]) -> [f64; 5] {
    let mut sum = [0.0; 5];
    for (a, b) in x.iter().zip(y) {
        add_scaled(&mut sum, a, *b);
    }
    sum
}

fn mean(of: &[u32], values: &[[f64; 5]]) -> [f64; 5] {
    let mut sum = [0.0; 5];
    for &v in of {
        add_scaled(&mut sum, &values[v as usize], [1.0 / of.len() as f64; 5]);
    }
    sum
}

fn vertex_values(mesh: &TriMesh, v: u32) -> [f64; 5] {
    let p = mesh.positions_mm[v as usize].as_dvec3();
    let uv = mesh.uv.as_ref().map_or([0.0; 2], |uv| uv[v as usize]);
    [p.x, p.y, p.z, f64::from(uv[0]), f64::from(uv[1])]
}

/// Mean length of the edges at vertex `v`.
fn mean_edge_mm(mesh: &TriMesh, half_edges: &HalfEdges, v: u32) -> f32 {
    let p = mesh.positions_mm[v as usize];
    let (sum, count) = half_edges
        .neighbours(v)
        .fold((0.0, 0u32), |(sum, count), w| (sum + (mesh.positions_mm[w as usize] - p).length(), count + 1));
    sum / count.max(1) as f32
}

/// Area-weighted normal of the triangles around vertex `v`.
fn fan_normal(mesh: &TriMesh, half_edges: &HalfEdges, v: u32) -> Vec3 {
    half_edges.fan(v).map(|h| mesh.area_normal(h as usize / 3)).sum::<Vec3>().normalize_or_zero()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::test_surfaces::plate;
    use glam::Vec2;

    fn fill_inner(mesh: &mut TriMesh, fair: bool) -> HalfEdges {
        let before = HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap();
        let mut sewn = before.clone();
        for ring in &before.boundary_loops()[1..] {
            fill_hole_as(mesh, &mut sewn, ring, fair);
        }
        let built = HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap();
        assert_eq!((&sewn.origin, &sewn.twin), (&built.origin, &built.twin));
        let leaves = |(v, &h): (usize, &u32)| sewn.from(h) == v as u32;
        assert!(sewn.outgoing.iter().enumerate().all(leaves));
        built
    }

    #[test]
    fn a_hole_in_a_tilted_plane_is_filled_exactly_and_evenly() {
        let height = |p: Vec2| 0.3 * p.x - 0.2 * p.y;
        for hole in [
            &(|p: Vec2| p.distance(Vec2::splat(20.0)) < 9.0) as &dyn Fn(Vec2) -> bool,
            &|p| p.distance(Vec2::splat(20.0)) < 14.0,
            &|p| (p.x - 20.0).abs() < 15.0 && (p.y - 20.0).abs() < 1.0,
            &|p| p == Vec2::splat(20.5),
            &|p| (8.0..15.0).contains(&p.distance(Vec2::splat(20.0))) && p.x < 24.0,
        ] {
            let mut mesh = plate(41, height, hole);
            let (kept, area) = (mesh.vertex_count(), plate(41, height, |_| false).area_mm2());
            assert!(fill_inner(&mut mesh, true).is_disk());
            assert!((mesh.area_mm2() - area).abs() < 1e-2, "area {} of {area}", mesh.area_mm2());
            for (p, uv) in mesh.positions_mm[kept..].iter().zip(&mesh.uv.as_ref().unwrap()[kept..]) {
                assert!((p.z - height(p.truncate())).abs() < 1e-3);
                assert!((Vec2::from(*uv) * 41.0).distance(p.truncate()) < 1e-3);
            }
            for t in 0..mesh.triangles.len() {
                let [a, b, c] = mesh.corners(t);
                assert!(mesh.area_normal(t).z > 0.0);
                assert!((a - b).length().max((b - c).length()).max((c - a).length()) < 4.0);
            }
        }
    }

    #[test]
    fn a_membrane_stays_between_the_heights_of_its_rim() {
        let mut mesh = plate(41, |p| (0.2 * p.x).sin() * 3.0, |p| p.distance(Vec2::splat(20.0)) < 8.0);
        let kept = mesh.vertex_count();
        assert!(fill_inner(&mut mesh, false).is_disk());
        assert!(mesh.positions_mm[kept..].iter().all(|p| p.z.abs() < 3.0));
        assert!(mesh.vertex_count() - kept > 100);
    }
}
