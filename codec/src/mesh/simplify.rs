//! Decimates a disk where it is flat: edge collapse by quadric error (M. Garland, P. S. Heckbert, Surface
//! Simplification Using Quadric Error Metrics, 1997).
//!
//! A quadric only grows as vertices merge, so the cost an edge had when it was queued is a lower bound: costs are
//! brought up to date when an edge comes up, not whenever a neighbour changes. The queue sorts costs into classes of
//! 12 %: a heap's exact order took longer and was no better.

use super::bvh::Triangle;
use super::half_edge::{HalfEdges, NONE, next, prev};
use super::{TriMesh, quality};
use crate::{CodecError, Result};
use glam::{DVec3, Vec3};

/// Pull towards the middle of the edge, relative to the quadric: settles where on a flat place the vertex goes.
const CENTRING: f64 = 1e-5;
/// Cost of length, mm² a mm² and unit of weight: on flat places short edges go first and triangles stay well shaped.
const LENGTH_COST: f64 = 1e-5;

/// Bits of a cost (as f32) below its class: three bits of the mantissa count.
const CLASS_SHIFT: u32 = 20;

/// How [`simplify`] may change the surface.
#[derive(Debug, Clone, PartialEq)]
pub struct SimplifyOptions {
    /// Farthest that a collapse may turn the normal of a triangle, degrees (0 to 90).
    pub max_turn_deg: f32,
    /// Shape quality (1 equilateral, 0 degenerate) below which no triangle may fall that was not there before.
    pub min_quality: f32,
    /// Weight of the border's planes against the surface's.
    pub border_weight: f32,
    /// No vertex is placed farther than this from the planes it stands for (root mean square), mm.
    pub max_error_mm: f32,
}

impl Default for SimplifyOptions {
    fn default() -> Self {
        Self { max_turn_deg: 60.0, min_quality: 0.2, border_weight: 10.0, max_error_mm: f32::INFINITY }
    }
}

/// What [`simplify`] did.
#[derive(Debug, Clone, PartialEq)]
pub struct SimplifyReport {
    /// For each vertex of the input the vertex of the result it was merged into.
    pub merged_into: Vec<u32>,
    /// Largest distance of a vertex from the planes it stands for (root mean square over its planes), mm.
    pub max_error_mm: f32,
    /// The same over all vertices, area-weighted, mm.
    pub rms_error_mm: f32,
}

/// Reduces the disk `mesh` to `target_vertices` (at least 3), or as near as the options allow. The result is a disk
/// again, its border stays along the old one; vertices that remain keep their order.
///
/// # Errors
/// [`CodecError::Mesh`] when `mesh` is no valid disk ([`super::repair::to_disk`] makes one).
pub fn simplify(
    mesh: &TriMesh,
    target_vertices: usize,
    options: &SimplifyOptions,
) -> Result<(TriMesh, SimplifyReport)> {
    mesh.validate()?;
    let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    if !half_edges.is_disk() {
        return Err(CodecError::Mesh("is no disk and cannot be simplified; repair it first".into()));
    }
    let mut collapser = Collapser::new(mesh, half_edges, options);
    collapser.run(target_vertices.max(3));
    Ok(collapser.finish())
}

/// Sum of squared distances to weighted planes: x' A x + 2 b x + c, with the area the planes stand for.
#[derive(Debug, Clone, Copy, Default)]
struct Quadric {
    /// xx, yy, zz, xy, xz, yz.
    a: [f64; 6],
    b: DVec3,
    c: f64,
    area_mm2: f64,
}

impl Quadric {
    /// Plane through `p` with unit normal `n`.
    fn plane(n: DVec3, p: DVec3, weight: f64, area_mm2: f64) -> Self {
        let d = -n.dot(p);
        let a = [n.x * n.x, n.y * n.y, n.z * n.z, n.x * n.y, n.x * n.z, n.y * n.z].map(|m| m * weight);
        Self { a, b: n * (d * weight), c: d * d * weight, area_mm2 }
    }

    fn add(&mut self, other: &Self) {
        for (a, b) in self.a.iter_mut().zip(other.a) {
            *a += b;
        }
        self.b += other.b;
        self.c += other.c;
        self.area_mm2 += other.area_mm2;
    }

    fn times(&self, x: DVec3) -> DVec3 {
        let [xx, yy, zz, xy, xz, yz] = self.a;
        DVec3::new(xx * x.x + xy * x.y + xz * x.z, xy * x.x + yy * x.y + yz * x.z, xz * x.x + yz * x.y + zz * x.z)
    }

    fn at(&self, x: DVec3) -> f64 {
        (x.dot(self.times(x)) + 2.0 * self.b.dot(x) + self.c).max(0.0)
    }

    /// Minimum of this plus a weak pull towards `middle`, by Cramer's rule: the pull makes the matrix definite.
    fn minimum_near(&self, middle: DVec3) -> DVec3 {
        let pull = CENTRING * (self.a[0] + self.a[1] + self.a[2]);
        let [xx, yy, zz, xy, xz, yz] = self.a;
        let (c0, c1, c2) =
            (DVec3::new(xx + pull, xy, xz), DVec3::new(xy, yy + pull, yz), DVec3::new(xz, yz, zz + pull));
        let rhs = -(self.times(middle) + self.b);
        let determinant = c0.dot(c1.cross(c2));
        if determinant <= 0.0 {
            return middle;
        }
        middle + DVec3::new(rhs.dot(c1.cross(c2)), c0.dot(rhs.cross(c2)), c0.dot(c1.cross(rhs))) / determinant
    }
}

/// One way to collapse an edge.
struct Collapse {
    cost: f32,
    position: Vec3,
    /// The vertex is placed on `to(h)` itself.
    on_end: bool,
}

/// Monotone bucket queue of half-edges, each in it at most once: a chain for every class of costs.
struct EdgeQueue {
    head: Vec<u32>,
    /// The half-edge after this one in its chain, [`NONE`] at the end; [`Self::ABSENT`] when not queued.
    after: Vec<u32>,
    /// Class of the edge given last; what is cheaper than that comes next.
    level: usize,
}

impl EdgeQueue {
    const ABSENT: u32 = NONE - 1;

    fn new(half_edges: usize) -> Self {
        let classes = Self::class(f32::INFINITY) + 1;
        Self { head: vec![NONE; classes], after: vec![Self::ABSENT; half_edges], level: 0 }
    }

    /// Non-negative floats are ordered as their bits are; NaN, from coordinates beyond all reason, comes last.
    fn class(cost: f32) -> usize {
        (cost.min(f32::INFINITY).to_bits() >> CLASS_SHIFT) as usize
    }

    fn contains(&self, h: u32) -> bool {
        self.after[h as usize] != Self::ABSENT
    }

    fn push(&mut self, h: u32, cost: f32) {
        let class = Self::class(cost).max(self.level);
        self.after[h as usize] = std::mem::replace(&mut self.head[class], h);
    }

    fn pop(&mut self) -> Option<u32> {
        while *self.head.get(self.level)? == NONE {
            self.level += 1;
        }
        let h = self.head[self.level];
        self.head[self.level] = std::mem::replace(&mut self.after[h as usize], Self::ABSENT);
        Some(h)
    }
}

struct Collapser<'a> {
    options: &'a SimplifyOptions,
    min_cos2: f32,
    /// Quadrics are relative to this, for precision.
    origin_mm: DVec3,
    positions_mm: Vec<Vec3>,
    uv: Option<Vec<[f32; 2]>>,
    quadrics: Vec<Quadric>,
    mesh: HalfEdges,
    alive: Vec<bool>,
    merged_into: Vec<u32>,
    vertices: usize,
    queue: EdgeQueue,
    /// Round in which a vertex was last marked as a neighbour.
    mark: Vec<u32>,
    round: u32,
    fan: Vec<u32>,
}

impl<'a> Collapser<'a> {
    fn new(mesh: &TriMesh, half_edges: HalfEdges, options: &'a SimplifyOptions) -> Self {
        let n = mesh.vertex_count();
        let origin_mm = mesh.centroid_mm().as_dvec3();
        Self {
            options,
            min_cos2: options.max_turn_deg.clamp(0.0, 90.0).to_radians().cos().powi(2),
            origin_mm,
            positions_mm: mesh.positions_mm.clone(),
            uv: mesh.uv.clone(),
            quadrics: initial_quadrics(mesh, &half_edges, origin_mm, f64::from(options.border_weight)),
            alive: vec![true; mesh.triangles.len()],
            merged_into: (0..n as u32).collect(),
            vertices: n,
            queue: EdgeQueue::new(half_edges.twin.len()),
            mark: vec![0; n],
            round: 0,
            fan: Vec::new(),
            mesh: half_edges,
        }
    }

    /// Collapses the cheapest edge until the target is met. When the queue runs dry all edges are queued again, for
    /// what was refused may be possible now, until that brings nothing.
    fn run(&mut self, target: usize) {
        while self.vertices > target {
            let before = self.vertices;
            self.queue_all();
            while self.vertices > target {
                let Some(h) = self.queue.pop() else { break };
                let Some(collapse) = self.alive[h as usize / 3].then(|| self.evaluate(h)).flatten() else { continue };
                if EdgeQueue::class(collapse.cost) > self.queue.level {
                    self.queue.push(h, collapse.cost);
                } else if self.may_collapse(h, collapse.position) {
                    self.collapse(h, &collapse);
                }
            }
            if self.vertices == before {
                return;
            }
        }
    }

    fn queue_all(&mut self) {
        self.queue.level = 0;
        for h in 0..self.mesh.twin.len() as u32 {
            let twin = self.mesh.twin[h as usize];
            let first = self.alive[h as usize / 3] && (twin == NONE || h < twin);
            if let Some(collapse) = first.then(|| self.evaluate(h)).flatten() {
                self.queue.push(h, collapse.cost);
            }
        }
    }

    /// Half-edge of the same edge whose origin may go: an inner vertex moves onto a border vertex, not away from it.
    /// `None` for an inner edge between border vertices, whose collapse would pinch the disk.
    fn directed(&self, h: u32) -> Option<u32> {
        let twin = self.mesh.twin[h as usize];
        if twin == NONE || !self.mesh.is_boundary_vertex(self.mesh.from(h)) {
            return Some(h);
        }
        (!self.mesh.is_boundary_vertex(self.mesh.to(h))).then_some(twin)
    }

    fn evaluate(&self, h: u32) -> Option<Collapse> {
        let h = self.directed(h)?;
        let (u, v) = (self.mesh.from(h), self.mesh.to(h));
        let [p, q] = [u, v].map(|v| self.positions_mm[v as usize].as_dvec3() - self.origin_mm);
        let mut quadric = self.quadrics[u as usize];
        quadric.add(&self.quadrics[v as usize]);
        let on_end = self.mesh.twin[h as usize] != NONE && self.mesh.is_boundary_vertex(v);
        let place = if on_end { q } else { quadric.minimum_near((p + q) * 0.5) };
        let error = quadric.at(place);
        if error > f64::from(self.options.max_error_mm).powi(2) * quadric.area_mm2 {
            return None;
        }
        let cost = (error + LENGTH_COST * quadric.area_mm2 * (p - q).length_squared()) as f32;
        let position = if on_end { self.positions_mm[v as usize] } else { (place + self.origin_mm).as_vec3() };
        Some(Collapse { cost, position, on_end })
    }

    /// Link condition (the ends share no neighbours but the apexes of the edge's triangles), and no triangle that
    /// stays turns too far or becomes a sliver.
    fn may_collapse(&mut self, h: u32, position: Vec3) -> bool {
        let (u, v) = (self.mesh.from(h), self.mesh.to(h));
        self.round += 1;
        for w in self.mesh.neighbours(u) {
            self.mark[w as usize] = self.round;
        }
        let shared = self.mesh.neighbours(v).filter(|&w| self.mark[w as usize] == self.round).count();
        let triangles = 1 + usize::from(self.mesh.twin[h as usize] != NONE);
        shared == triangles && self.stays_sound(u, v, position) && self.stays_sound(v, u, position)
    }

    fn stays_sound(&self, moved: u32, other: u32, position: Vec3) -> bool {
        self.mesh.fan(moved).all(|h| {
            let (b, c) = (self.mesh.to(h), self.mesh.from(prev(h)));
            if b == other || c == other {
                return true;
            }
            let [a, b, c] = [moved, b, c].map(|v| self.positions_mm[v as usize]);
            let (before, after) = ((b - a).cross(c - a), (b - position).cross(c - position));
            let (dot, lengths2) = (before.dot(after), before.length_squared() * after.length_squared());
            let turned = dot <= 0.0 || dot * dot < self.min_cos2 * lengths2;
            let (was, is) = (quality([a, b, c]), quality([position, b, c]));
            is > 0.0 && (was < 1e-6 || !turned) && is >= self.options.min_quality.min(was)
        })
    }

    fn collapse(&mut self, h: u32, collapse: &Collapse) {
        let Some(h) = self.directed(h) else { return };
        let (gone, keep) = (self.mesh.from(h), self.mesh.to(h));
        self.place(gone, keep, collapse);
        let mut fan = std::mem::take(&mut self.fan);
        fan.clear();
        fan.extend(self.mesh.fan(gone));
        for &g in &fan {
            self.mesh.origin[g as usize] = keep;
        }
        self.fan = fan;
        let twin = self.mesh.twin[h as usize];
        if [next(h), twin].contains(&self.mesh.outgoing[keep as usize]) {
            self.mesh.outgoing[keep as usize] = self.mesh.twin[prev(h) as usize];
        }
        self.remove_triangle(h);
        if twin != NONE {
            self.remove_triangle(twin);
        }
        self.mesh.outgoing[gone as usize] = NONE;
        self.merged_into[gone as usize] = keep;
        self.vertices -= 1;
        self.requeue_around(keep);
    }

    /// Moves `keep` to its new place, with the texture coordinate of the nearest point on the old triangles.
    fn place(&mut self, gone: u32, keep: u32, collapse: &Collapse) {
        if let (Some(uv), false) = (&self.uv, collapse.on_end) {
            let mut best = (f32::INFINITY, uv[keep as usize]);
            for h in self.mesh.fan(gone).chain(self.mesh.fan(keep)) {
                let corners = [h, next(h), prev(h)].map(|e| self.mesh.from(e) as usize);
                let found = Triangle::new(corners.map(|v| self.positions_mm[v]), 0).closest(collapse.position);
                let distance2 = found.offset.length_squared();
                if distance2 < best.0 {
                    let [a, b, c] = corners.map(|v| uv[v]);
                    let mix = |i: usize| a[i] + (b[i] - a[i]) * found.v + (c[i] - a[i]) * found.w;
                    best = (distance2, [mix(0), mix(1)]);
                }
            }
            if let Some(uv) = &mut self.uv {
                uv[keep as usize] = best.1;
            }
        }
        self.positions_mm[keep as usize] = collapse.position;
        let quadric = self.quadrics[gone as usize];
        self.quadrics[keep as usize].add(&quadric);
    }

    /// Takes away the triangle of `h`, an edge that has shrunk to a point, and joins its two other sides.
    fn remove_triangle(&mut self, h: u32) {
        let (n, p) = (next(h), prev(h));
        let apex = self.mesh.from(p) as usize;
        let (after, before) = (self.mesh.twin[n as usize], self.mesh.twin[p as usize]);
        for (side, other) in [(after, before), (before, after)] {
            if side != NONE {
                self.mesh.twin[side as usize] = other;
            }
        }
        if self.mesh.outgoing[apex] == p {
            self.mesh.outgoing[apex] = after;
        }
        self.alive[h as usize / 3] = false;
    }

    /// Queues the edges around `v` that are not queued: merged ones, and refused ones that may be possible now.
    fn requeue_around(&mut self, v: u32) {
        let mut fan = std::mem::take(&mut self.fan);
        fan.clear();
        fan.extend(self.mesh.fan(v).flat_map(|h| [h, prev(h)]));
        for &h in &fan {
            let twin = self.mesh.twin[h as usize];
            let queued = self.queue.contains(h) || twin != NONE && self.queue.contains(twin);
            if let Some(collapse) = (!queued).then(|| self.evaluate(h)).flatten() {
                self.queue.push(h, collapse.cost);
            }
        }
        self.fan = fan;
    }

    fn finish(mut self) -> (TriMesh, SimplifyReport) {
        let n = self.merged_into.len();
        let (mut largest, mut sum, mut area_mm2) = (0f64, 0.0, 0.0);
        let mut new_of = vec![NONE; n];
        let mut kept = Vec::with_capacity(self.vertices);
        for v in (0..n).filter(|&v| self.merged_into[v] as usize == v) {
            new_of[v] = kept.len() as u32;
            kept.push(v);
            let quadric = &self.quadrics[v];
            let error = quadric.at(self.positions_mm[v].as_dvec3() - self.origin_mm);
            largest = largest.max(error / quadric.area_mm2.max(f64::MIN_POSITIVE));
            sum += error;
            area_mm2 += quadric.area_mm2;
        }
        for v in 0..n {
            let mut root = v;
            while self.merged_into[root] as usize != root {
                root = self.merged_into[root] as usize;
            }
            let mut at = v;
            while at != root {
                at = std::mem::replace(&mut self.merged_into[at], root as u32) as usize;
            }
        }
        let triangles = self.mesh.origin.chunks_exact(3).zip(&self.alive).filter(|(_, alive)| **alive);
        let mesh = TriMesh {
            positions_mm: kept.iter().map(|&v| self.positions_mm[v]).collect(),
            triangles: triangles.map(|(t, _)| [t[0], t[1], t[2]].map(|v| new_of[v as usize])).collect(),
            uv: self.uv.as_ref().map(|uv| kept.iter().map(|&v| uv[v]).collect()),
        };
        let report = SimplifyReport {
            merged_into: self.merged_into.iter().map(|&v| new_of[v as usize]).collect(),
            max_error_mm: largest.sqrt() as f32,
            rms_error_mm: (sum / area_mm2.max(f64::MIN_POSITIVE)).sqrt() as f32,
        };
        (mesh, report)
    }
}

/// Area-weighted quadrics of the triangles around each vertex, with upright planes along the border.
fn initial_quadrics(mesh: &TriMesh, half_edges: &HalfEdges, origin_mm: DVec3, border_weight: f64) -> Vec<Quadric> {
    let mut quadrics = vec![Quadric::default(); mesh.vertex_count()];
    for (t, corners) in mesh.triangles.iter().enumerate() {
        let points = mesh.corners(t).map(|p| p.as_dvec3() - origin_mm);
        let normal = (points[1] - points[0]).cross(points[2] - points[0]);
        let third = normal.length() / 6.0;
        let unit = normal.normalize_or_zero();
        let face = Quadric::plane(unit, points[0], third, third);
        for &v in corners {
            quadrics[v as usize].add(&face);
        }
        for k in (0..3).filter(|k| half_edges.twin[3 * t + k] == NONE) {
            let edge = points[(k + 1) % 3] - points[k];
            let wall = edge.cross(unit).normalize_or_zero();
            let border = Quadric::plane(wall, points[k], border_weight * edge.length_squared(), 0.0);
            for v in [corners[k], corners[(k + 1) % 3]] {
                quadrics[v as usize].add(&border);
            }
        }
    }
    quadrics
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Bvh;
    use proptest::prelude::*;

    fn height_field(side: u32, height: impl Fn(f32, f32) -> f32) -> TriMesh {
        let pixels = (0..side * side).map(|i| ((i % side) as f32, (i / side) as f32));
        let mut mesh = TriMesh {
            positions_mm: pixels.clone().map(|(x, y)| Vec3::new(x, y, height(x, y))).collect(),
            triangles: Vec::new(),
            uv: Some(pixels.map(|(x, y)| [x / side as f32, y / side as f32]).collect()),
        };
        for a in (0..side - 1).flat_map(|y| (0..side - 1).map(move |x| y * side + x)) {
            mesh.triangles.extend([[a, a + 1, a + side + 1], [a, a + side + 1, a + side]]);
        }
        mesh
    }

    fn reduce(mesh: &TriMesh, target: usize) -> (TriMesh, SimplifyReport) {
        let (small, report) = simplify(mesh, target, &SimplifyOptions::default()).unwrap();
        small.validate().unwrap();
        assert!(HalfEdges::build(small.vertex_count(), &small.triangles).unwrap().is_disk());
        assert_eq!(report.merged_into.len(), mesh.vertex_count());
        assert!(report.merged_into.iter().all(|&v| (v as usize) < small.vertex_count()));
        (small, report)
    }

    fn farthest(from: &TriMesh, to: &TriMesh) -> f32 {
        let bvh = Bvh::new(to);
        let distance = |&p: &Vec3| bvh.nearest(p, f32::INFINITY).unwrap().distance2_mm2.sqrt();
        from.positions_mm.iter().map(distance).fold(0.0, f32::max)
    }

    #[test]
    fn a_tilted_plane_stays_exactly_itself() {
        let height = |x: f32, y: f32| 0.4 * x - 0.1 * y;
        let mesh = height_field(40, height);
        let (small, report) = reduce(&mesh, 100);
        assert_eq!(small.vertex_count(), 100);
        assert!((small.area_mm2() - mesh.area_mm2()).abs() < 0.05);
        let off = farthest(&mesh, &small);
        assert!(off < 1e-3 && report.max_error_mm < 1e-3, "{off} {}", report.max_error_mm);
        for (p, uv) in small.positions_mm.iter().zip(small.uv.as_ref().unwrap()) {
            assert!((uv[0] * 40.0 - p.x).abs() < 1e-3 && (uv[1] * 40.0 - p.y).abs() < 1e-3);
        }
    }

    #[test]
    fn a_dome_is_approximated_to_its_curvature() {
        let mesh = height_field(80, |x, y| (80f32 * 80.0 - (x - 39.5).powi(2) - (y - 39.5).powi(2)).sqrt());
        let (small, report) = reduce(&mesh, 640);
        assert_eq!(small.vertex_count(), 640);
        // Edges of about 3.8 mm on a radius of 80 mm: the sagitta of a triangle is about 0.03 mm.
        assert!(farthest(&mesh, &small) < 0.12, "{}", farthest(&mesh, &small));
        assert!(report.rms_error_mm < 0.03 && report.max_error_mm < 0.12, "{}", report.max_error_mm);
        let upright = (0..small.triangles.len()).all(|t| small.area_normal(t).normalize().z > 0.5);
        assert!(upright && (0..small.triangles.len()).all(|t| quality(small.corners(t)) >= 0.2));
    }

    #[test]
    fn vertices_gather_where_the_surface_curves() {
        let mesh = height_field(80, |x, y| if x > 40.0 { (x * 0.7).sin() * (y * 0.7).cos() } else { 0.0 });
        let (small, _) = reduce(&mesh, 1600);
        let flat = small.positions_mm.iter().filter(|p| p.x < 39.0).count();
        assert!(flat * 5 < small.vertex_count(), "{flat} of {} on the flat half", small.vertex_count());
    }

    #[test]
    fn limits_of_error_hold_and_nonsense_is_refused() {
        let mesh = height_field(40, |x, y| (x * 0.8).sin() * (y * 0.8).cos());
        let options = SimplifyOptions { max_error_mm: 0.02, ..Default::default() };
        let (small, report) = simplify(&mesh, 3, &options).unwrap();
        assert!(small.vertex_count() > 200 && report.max_error_mm <= 0.0201, "{}", small.vertex_count());
        let (same, report) = reduce(&mesh, 99_999);
        assert!(same == mesh && report.rms_error_mm < 1e-6);
        let two = TriMesh { positions_mm: vec![Vec3::ZERO; 6], triangles: vec![[0, 1, 2], [3, 4, 5]], uv: None };
        assert!(simplify(&two, 3, &options).unwrap_err().to_string().contains("no disk"));
    }

    #[test]
    fn down_to_almost_nothing() {
        let (small, _) = reduce(&height_field(12, |_, _| 0.0), 4);
        assert_eq!(small.vertex_count(), 4);
        assert!((small.area_mm2() - 121.0).abs() < 0.01, "{}", small.area_mm2());
    }

    proptest! {
        #[test]
        fn random_height_fields_stay_disks(
            heights in proptest::collection::vec(0f32..3.0, 400), target in 3usize..400,
        ) {
            let mesh = height_field(20, |x, y| heights[(y * 20.0 + x) as usize]);
            let (small, report) = reduce(&mesh, target);
            prop_assert!(small.vertex_count() >= target);
            prop_assert!(small.positions_mm.iter().all(|p| p.z.abs() < 12.0));
            prop_assert!((0..small.triangles.len()).all(|t| quality(small.corners(t)) > 0.01));
            let again = reduce(&mesh, target);
            prop_assert!(again == (small, report), "two runs differ");
        }
    }
}
