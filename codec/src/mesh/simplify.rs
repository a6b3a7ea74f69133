//! Decimation where flat: edge collapse in order of quadric error (Garland, Heckbert 1997).

use super::{HalfEdges, TriMesh};
use crate::{CodecError, Result};
use glam::{DMat3, DVec3};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// How a mesh is decimated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SimplifyOptions {
    /// Weight of planes that stand on border edges: how firmly the border keeps its line.
    pub border_weight: f64,
    /// Weight of staying near the collapsed vertices, against the planes: spreads vertices evenly where it is flat.
    pub stay_weight: f64,
    /// Largest turn of a triangle's normal in one collapse, as the cosine of its angle.
    pub min_normal_cosine: f64,
    /// Least quality 4 sqrt(3) area / (sum of squared edges) of a new triangle, unless it was worse before.
    pub min_quality: f64,
}

impl Default for SimplifyOptions {
    fn default() -> Self {
        Self { border_weight: 10.0, stay_weight: 2e-3, min_normal_cosine: 0.7, min_quality: 0.08 }
    }
}

/// What decimation did.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SimplifyReport {
    /// Edges collapsed.
    pub collapses: usize,
    /// Whether the wanted number of vertices was reached.
    pub is_complete: bool,
}

/// Decimates a disk to `target` vertices or as near above it as topology and shape allow; it stays a disk, its border
/// stays a border, and texture coordinates follow the surface.
///
/// # Errors
/// [`CodecError::Mesh`] when `mesh` is not manifold.
pub fn simplify(mesh: &TriMesh, target: usize, options: &SimplifyOptions) -> Result<(TriMesh, SimplifyReport)> {
    let edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    if edges.boundary_loops().iter().any(|l| l.len() < 3) {
        return Err(CodecError::Mesh("a border of fewer than three vertices".into()));
    }
    let mut work = Work::new(mesh, &edges, options);
    let mut report = SimplifyReport::default();
    let mut left = mesh.vertex_count();
    while left > target.max(3) {
        let Some(candidate) = work.heap.pop() else { break };
        if work.is_stale(&candidate) || !work.may_collapse(&candidate) {
            continue;
        }
        work.collapse(&candidate);
        left -= 1;
        report.collapses += 1;
    }
    report.is_complete = left <= target.max(3);
    Ok((work.into_mesh(), report))
}

/// Sum of weighted squared distances to planes and points: x^T A x - 2 b^T x + c.
#[derive(Debug, Clone, Copy, Default)]
struct Quadric {
    xx: f64,
    xy: f64,
    xz: f64,
    yy: f64,
    yz: f64,
    zz: f64,
    b: DVec3,
    c: f64,
}

impl Quadric {
    fn add_plane(&mut self, normal: DVec3, through: DVec3, weight: f64) {
        let n = normal * weight;
        self.xx += n.x * normal.x;
        self.xy += n.x * normal.y;
        self.xz += n.x * normal.z;
        self.yy += n.y * normal.y;
        self.yz += n.y * normal.z;
        self.zz += n.z * normal.z;
        let d = normal.dot(through);
        self.b += n * d;
        self.c += weight * d * d;
    }

    fn add_point(&mut self, p: DVec3, weight: f64) {
        self.xx += weight;
        self.yy += weight;
        self.zz += weight;
        self.b += p * weight;
        self.c += weight * p.length_squared();
    }

    fn plus(&self, o: &Self) -> Self {
        Self {
            xx: self.xx + o.xx,
            xy: self.xy + o.xy,
            xz: self.xz + o.xz,
            yy: self.yy + o.yy,
            yz: self.yz + o.yz,
            zz: self.zz + o.zz,
            b: self.b + o.b,
            c: self.c + o.c,
        }
    }

    fn matrix(&self) -> DMat3 {
        DMat3::from_cols(
            DVec3::new(self.xx, self.xy, self.xz),
            DVec3::new(self.xy, self.yy, self.yz),
            DVec3::new(self.xz, self.yz, self.zz),
        )
    }

    fn error(&self, x: DVec3) -> f64 {
        (x.dot(self.matrix() * x) - 2.0 * self.b.dot(x) + self.c).max(0.0)
    }

    /// The point of least error; `fallback` when the matrix is singular or the point lies far off.
    fn minimum(&self, fallback: DVec3, reach: f64) -> DVec3 {
        let x = self.matrix().inverse() * self.b;
        if x.is_finite() && x.distance(fallback) <= reach { x } else { fallback }
    }
}

/// An edge that may be collapsed; stale once either end has changed since.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    cost: f32,
    ends: [u32; 2],
    stamps: [u32; 2],
    to: [f32; 3],
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}
impl Eq for Candidate {}
impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
/// Cheapest first out of the heap; ties by index so that the order never depends on the heap's history.
impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        other.cost.total_cmp(&self.cost).then_with(|| (other.ends, other.stamps).cmp(&(self.ends, self.stamps)))
    }
}

struct Work<'a> {
    options: &'a SimplifyOptions,
    origin: DVec3,
    positions: Vec<DVec3>,
    uv: Option<Vec<[f32; 2]>>,
    quadrics: Vec<Quadric>,
    triangles: Vec<[u32; 3]>,
    alive: Vec<bool>,
    /// Triangles around each vertex; dead ones are swept out when met.
    around: Vec<Vec<u32>>,
    is_border: Vec<bool>,
    stamp: Vec<u32>,
    heap: BinaryHeap<Candidate>,
}

impl<'a> Work<'a> {
    fn new(mesh: &TriMesh, edges: &HalfEdges, options: &'a SimplifyOptions) -> Self {
        let n = mesh.vertex_count();
        // Quadrics hold squares of coordinates: near the origin they keep their digits.
        let origin = mesh.centroid_mm().as_dvec3();
        let mut work = Self {
            options,
            origin,
            positions: mesh.positions_mm.iter().map(|p| p.as_dvec3() - origin).collect(),
            uv: mesh.uv.clone(),
            quadrics: vec![Quadric::default(); n],
            triangles: mesh.triangles.clone(),
            alive: vec![true; mesh.triangles.len()],
            around: vec![Vec::new(); n],
            is_border: (0..n as u32).map(|v| edges.is_boundary_vertex(v)).collect(),
            stamp: vec![0; n],
            heap: BinaryHeap::new(),
        };
        for t in 0..work.triangles.len() {
            work.add_triangle(t, edges);
        }
        let all = (0..edges.twin.len() as u32)
            .filter(|&h| edges.twin[h as usize] > h)
            .map(|h| work.candidate(edges.from(h), edges.to(h)))
            .collect::<Vec<_>>();
        work.heap = BinaryHeap::from(all);
        work
    }

    fn corners(&self, t: usize) -> [DVec3; 3] {
        self.triangles[t].map(|v| self.positions[v as usize])
    }

    /// Adds a triangle's plane, the planes on its border edges, and the pull of its corners.
    fn add_triangle(&mut self, t: usize, edges: &HalfEdges) {
        let corners = self.corners(t);
        let cross = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
        let area = 0.5 * cross.length();
        let normal = cross.normalize_or_zero();
        for (k, &corner) in corners.iter().enumerate() {
            let v = self.triangles[t][k] as usize;
            self.around[v].push(t as u32);
            self.quadrics[v].add_plane(normal, corner, area / 3.0);
            self.quadrics[v].add_point(corner, self.options.stay_weight * area / 3.0);
            if edges.twin[3 * t + k] == super::half_edge::NONE {
                let along = corners[(k + 1) % 3] - corner;
                let wall = along.cross(normal).normalize_or_zero();
                let weight = self.options.border_weight * along.length_squared();
                self.quadrics[v].add_plane(wall, corner, weight);
                self.quadrics[self.triangles[t][(k + 1) % 3] as usize].add_plane(wall, corner, weight);
            }
        }
    }

    /// A border vertex stays where it is when it swallows an inner one: the border must not move inwards.
    fn candidate(&self, u: u32, v: u32) -> Candidate {
        let (u, v) = (u.min(v), u.max(v));
        let (pu, pv) = (self.positions[u as usize], self.positions[v as usize]);
        let q = self.quadrics[u as usize].plus(&self.quadrics[v as usize]);
        let to = match (self.is_border[u as usize], self.is_border[v as usize]) {
            (true, false) => pu,
            (false, true) => pv,
            _ => q.minimum((pu + pv) * 0.5, pu.distance(pv) * 1.5),
        };
        Candidate {
            cost: q.error(to) as f32,
            ends: [u, v],
            stamps: [self.stamp[u as usize], self.stamp[v as usize]],
            to: to.as_vec3().to_array(),
        }
    }

    fn is_stale(&self, c: &Candidate) -> bool {
        c.ends.iter().zip(c.stamps).any(|(&v, s)| self.stamp[v as usize] != s)
    }

    /// Link condition (Dey, Edelsbrunner, Guha, Nekhayev 1999) and shape of the triangles that stay.
    fn may_collapse(&self, c: &Candidate) -> bool {
        let [u, v] = c.ends;
        let mut shared = 0;
        for &t in self.live_around(u) {
            shared += usize::from(self.triangles[t as usize].contains(&v));
        }
        let both_border = self.is_border[u as usize] && self.is_border[v as usize];
        if shared == 0 || (both_border && shared != 1) {
            return false;
        }
        if self.common_neighbours(u, v) != shared {
            return false;
        }
        let to = glam::Vec3::from(c.to).as_dvec3();
        self.keeps_shape(u, v, to) && self.keeps_shape(v, u, to)
    }

    fn live_around(&self, v: u32) -> impl Iterator<Item = &u32> {
        self.around[v as usize].iter().filter(|&&t| self.alive[t as usize])
    }

    fn common_neighbours(&self, u: u32, v: u32) -> usize {
        let mut seen = [0u32; 64];
        let mut count = 0;
        let mut common = 0;
        let mut of_u = |w: u32| {
            if w != u && w != v && count < seen.len() && !seen[..count].contains(&w) {
                seen[count] = w;
                count += 1;
            }
        };
        self.live_around(u).for_each(|&t| self.triangles[t as usize].iter().for_each(|&w| of_u(w)));
        if count == seen.len() {
            // A vertex of such valence is better left alone.
            return usize::MAX;
        }
        let mut met = [false; 64];
        for &t in self.live_around(v) {
            for &w in &self.triangles[t as usize] {
                if let Some(i) = seen[..count].iter().position(|&s| s == w) {
                    common += usize::from(!std::mem::replace(&mut met[i], true));
                }
            }
        }
        common
    }

    /// Whether the triangles of `moved` without `other` keep direction and shape when `moved` goes to `to`.
    fn keeps_shape(&self, moved: u32, other: u32, to: DVec3) -> bool {
        self.live_around(moved).filter(|&&t| !self.triangles[t as usize].contains(&other)).all(|&t| {
            let before = self.corners(t as usize);
            let mut after = before;
            if let Some(k) = self.triangles[t as usize].iter().position(|&w| w == moved) {
                after[k] = to;
            }
            let (n0, n1) = (area_vector(&before), area_vector(&after));
            let cosine = n0.dot(n1) / (n0.length() * n1.length()).max(1e-30);
            let quality = quality(&after);
            cosine >= self.options.min_normal_cosine
                && (quality >= self.options.min_quality || quality >= self.quality_of(t as usize))
        })
    }

    fn quality_of(&self, t: usize) -> f64 {
        quality(&self.corners(t))
    }

    /// Merges the edge's second end into its first.
    fn collapse(&mut self, c: &Candidate) {
        let [u, v] = c.ends;
        let to = glam::Vec3::from(c.to).as_dvec3();
        self.carry_uv(u, v, to);
        self.positions[u as usize] = to;
        self.quadrics[u as usize] = self.quadrics[u as usize].plus(&self.quadrics[v as usize]);
        self.is_border[u as usize] |= self.is_border[v as usize];
        let mut ring = std::mem::take(&mut self.around[u as usize]);
        ring.retain(|&t| self.alive[t as usize]);
        for t in std::mem::take(&mut self.around[v as usize]) {
            let triangle = &mut self.triangles[t as usize];
            if !self.alive[t as usize] {
                continue;
            }
            if triangle.contains(&u) {
                self.alive[t as usize] = false;
            } else {
                *triangle = triangle.map(|w| if w == v { u } else { w });
                ring.push(t);
            }
        }
        ring.retain(|&t| self.alive[t as usize]);
        self.stamp[u as usize] += 1;
        self.stamp[v as usize] += 1;
        self.push_ring(u, &ring);
        self.around[u as usize] = ring;
    }

    fn push_ring(&mut self, u: u32, ring: &[u32]) {
        for &t in ring {
            let triangle = self.triangles[t as usize];
            let Some(k) = triangle.iter().position(|&w| w == u) else { continue };
            let (next, prev) = (triangle[(k + 1) % 3], triangle[(k + 2) % 3]);
            self.heap.push(self.candidate(u, next));
            // The edge to `prev` is the next triangle's edge to its `next`, except at the border.
            if self.is_border[u as usize] && self.is_border[prev as usize] {
                self.heap.push(self.candidate(u, prev));
            }
        }
    }

    /// Texture coordinates at the point of the old triangles nearest to the new position.
    fn carry_uv(&mut self, u: u32, v: u32, to: DVec3) {
        let Some(uv) = &self.uv else { return };
        let mut best = (f64::INFINITY, uv[u as usize]);
        for &t in self.live_around(u).chain(self.live_around(v)) {
            let corners = self.corners(t as usize);
            let w = clamped_barycentric(&corners, to);
            let p = corners[0] * w[0] + corners[1] * w[1] + corners[2] * w[2];
            let distance = p.distance_squared(to);
            if distance < best.0 {
                let c = self.triangles[t as usize].map(|x| uv[x as usize]);
                let mix = |i: usize| (0..3).map(|k| w[k] * f64::from(c[k][i])).sum::<f64>() as f32;
                best = (distance, [mix(0), mix(1)]);
            }
        }
        if let Some(uv) = &mut self.uv {
            uv[u as usize] = best.1;
        }
    }

    fn into_mesh(self) -> TriMesh {
        let whole = TriMesh {
            positions_mm: self.positions.iter().map(|p| (*p + self.origin).as_vec3()).collect(),
            triangles: self.triangles,
            uv: self.uv,
        };
        whole.submesh(|t| self.alive[t]).0
    }
}

fn area_vector([a, b, c]: &[DVec3; 3]) -> DVec3 {
    (*b - *a).cross(*c - *a)
}

fn quality(corners: &[DVec3; 3]) -> f64 {
    let [a, b, c] = corners;
    let edges = a.distance_squared(*b) + b.distance_squared(*c) + c.distance_squared(*a);
    2.0 * 3f64.sqrt() * area_vector(corners).length() / edges.max(1e-30)
}

/// Barycentric coordinates of the projection, negative ones cut off and the rest scaled: near enough to the nearest
/// point for texture coordinates.
fn clamped_barycentric(corners: &[DVec3; 3], p: DVec3) -> [f64; 3] {
    let n = area_vector(corners);
    let total = n.length_squared().max(1e-30);
    let part = |i: usize, j: usize| ((corners[j] - corners[i]).cross(p - corners[i]).dot(n) / total).max(0.0);
    let w = [part(1, 2), part(2, 0), part(0, 1)];
    let sum = (w[0] + w[1] + w[2]).max(1e-30);
    w.map(|x| x / sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use proptest::prelude::*;

    fn grid(n: usize, height: impl Fn(f32, f32) -> f32) -> TriMesh {
        let at = |i: usize| ((i % n) as f32, (i / n) as f32);
        let positions_mm = (0..n * n).map(|i| Vec3::new(at(i).0, at(i).1, height(at(i).0, at(i).1))).collect();
        let triangles = (0..n - 1)
            .flat_map(|y| (0..n - 1).map(move |x| (y * n + x) as u32))
            .flat_map(|a| [[a, a + 1, a + n as u32 + 1], [a, a + n as u32 + 1, a + n as u32]])
            .collect();
        let uv = (0..n * n).map(|i| [at(i).0 / n as f32, at(i).1 / n as f32]).collect();
        TriMesh { positions_mm, triangles, uv: Some(uv) }
    }

    #[test]
    fn a_plane_stays_a_plane_with_its_corners_and_uv() {
        let mesh = grid(40, |x, y| 0.3 * x - 0.2 * y);
        let (small, report) = simplify(&mesh, 120, &SimplifyOptions::default()).unwrap();
        assert!(report.is_complete && small.vertex_count() == 120);
        let uv = small.uv.as_ref().unwrap();
        for (p, t) in small.positions_mm.iter().zip(uv) {
            assert!((p.z - 0.3 * p.x + 0.2 * p.y).abs() < 1e-3);
            assert!((t[0] - p.x / 40.0).abs() < 2e-3 && (t[1] - p.y / 40.0).abs() < 2e-3);
        }
        assert!((small.area_mm2() / mesh.area_mm2() - 1.0).abs() < 0.01);
    }

    #[test]
    fn a_dome_keeps_its_shape_within_the_sagitta_of_its_new_edges() {
        let radius = 60.0f32;
        let mesh = grid(70, |x, y| (radius * radius - (x - 34.5).powi(2) - (y - 34.5).powi(2)).sqrt());
        let (small, _) = simplify(&mesh, mesh.vertex_count() / 6, &SimplifyOptions::default()).unwrap();
        let centre = Vec3::new(34.5, 34.5, 0.0);
        let worst = small.positions_mm.iter().map(|p| (p.distance(centre) - radius).abs()).fold(0.0, f32::max);
        assert!(worst < 0.1, "{worst}");
        assert!((small.area_mm2() / mesh.area_mm2() - 1.0).abs() < 0.01);
    }

    #[test]
    fn flat_regions_lose_more_than_curved_ones() {
        let mesh = grid(60, |x, y| if x > 30.0 { (x * 0.9).sin() * (y * 0.9).cos() * 2.0 } else { 0.0 });
        let (small, _) = simplify(&mesh, 900, &SimplifyOptions::default()).unwrap();
        let curved = small.positions_mm.iter().filter(|p| p.x > 31.0).count();
        assert!(curved > 4 * (small.vertex_count() - curved), "{curved} of {}", small.vertex_count());
    }

    proptest! {
        #[test]
        fn stays_a_disk_without_flips(seed in 0u32..300, share in 2usize..12) {
            let noise = |x: f32, y: f32| ((x * 12.9898 + y * 78.233 + seed as f32).sin() * 43758.547).fract();
            let mesh = grid(24, |x, y| noise(x, y) * 0.2);
            let (small, _) = simplify(&mesh, mesh.vertex_count() / share, &SimplifyOptions::default()).unwrap();
            small.validate().unwrap();
            let edges = HalfEdges::build(small.vertex_count(), &small.triangles).unwrap();
            prop_assert!(edges.is_disk());
            prop_assert!((0..small.triangles.len()).all(|t| small.area_normal(t).z > 0.0));
        }
    }

    #[test]
    fn stops_where_nothing_can_be_collapsed() {
        let mesh = grid(2, |_, _| 0.0);
        let (small, report) = simplify(&mesh, 1, &SimplifyOptions::default()).unwrap();
        assert!(small.vertex_count() >= 3);
        assert!(!small.triangles.is_empty());
        assert_eq!(report.collapses, 4 - small.vertex_count());
    }
}
