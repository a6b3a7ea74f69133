//! Decimates a disk where it is flat: edge collapse by quadric error (M. Garland, P. S. Heckbert, Surface
//! Simplification Using Quadric Error Metrics, 1997).
//!
//! A quadric only grows as vertices merge, so the cost an edge had when it was last looked at is a lower bound. Instead
//! of a queue, sweeps in the order of memory collapse whatever costs less than a threshold that rises from sweep to
//! sweep: a scan's neighbours in space are neighbours in memory, where a queue's exact order jumps about. Edges of a
//! vertex that was merged wait for the next sweep.

use super::bvh::Triangle;
use super::half_edge::{HalfEdges, NONE, next, prev};
use super::{DiskMesh, TriMesh};
use glam::{DVec3, Vec3};

/// Pull towards the middle of the edge, relative to the quadric: settles where on a flat place the vertex goes.
const CENTRING: f64 = 1e-5;
/// Cost of length, mm² a mm² and unit of weight: on flat places short edges go first and triangles stay well shaped.
const LENGTH_COST: f32 = 1e-5;
/// From sweep to sweep the threshold grows at least by this factor: 3 costs 4 % of the distance and saves half the time
/// against 1.1.
const GROWTH: f32 = 3.0;
/// Edges looked at to set a threshold, about.
const SAMPLE: usize = 8192;

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
pub fn simplify(disk: &DiskMesh, target_vertices: usize, options: &SimplifyOptions) -> (DiskMesh, SimplifyReport) {
    let mut collapser = Collapser::new(disk, disk.half_edges(), options);
    collapser.run(target_vertices.max(3));
    collapser.finish(disk, disk.half_edges())
}

/// Sum of squared distances to weighted planes, x' A x + 2 b x + c with x relative to the vertex the quadric belongs to:
/// so near to it single precision is enough.
#[derive(Debug, Clone, Copy, Default)]
struct Quadric {
    /// A as xx, yy, zz, xy, xz, yz; then the area the planes stand for, mm², and c: added up as two vectors of four.
    sums: [f32; 8],
    b: Vec3,
}

impl Quadric {
    /// A plane through the vertex with unit normal `n`, of weight `weight`, that stands for `area_mm2`.
    fn plane(n: Vec3, weight: f32, area_mm2: f32) -> Self {
        let m = n * weight;
        let sums = [m.x * n.x, m.y * n.y, m.z * n.z, m.x * n.y, m.x * n.z, m.y * n.z, area_mm2, 0.0];
        Self { sums, b: Vec3::ZERO }
    }

    fn area_mm2(&self) -> f32 {
        self.sums[6]
    }

    fn c(&self) -> f32 {
        self.sums[7]
    }

    /// The same sum, relative to a point `d` further on.
    fn moved(&self, d: Vec3) -> Self {
        let ad = self.times(d);
        let mut sums = self.sums;
        sums[7] += d.dot(2.0 * self.b + ad);
        Self { sums, b: self.b + ad }
    }

    fn plus(&self, other: &Self) -> Self {
        Self { sums: std::array::from_fn(|i| self.sums[i] + other.sums[i]), b: self.b + other.b }
    }

    fn times(&self, x: Vec3) -> Vec3 {
        let [xx, yy, zz, xy, xz, yz, ..] = self.sums;
        Vec3::new(xx * x.x + xy * x.y + xz * x.z, xy * x.x + yy * x.y + yz * x.z, xz * x.x + yz * x.y + zz * x.z)
    }

    fn at(&self, x: Vec3) -> f32 {
        (x.dot(2.0 * self.b + self.times(x)) + self.c()).max(0.0)
    }

    /// Minimum of this plus a weak pull towards 0, by Cramer's rule: the pull makes the matrix definite, by a margin that
    /// takes double precision.
    fn minimum_near_zero(&self) -> Vec3 {
        let [xx, yy, zz, xy, xz, yz, ..] = self.sums.map(f64::from);
        let pull = CENTRING * (xx + yy + zz);
        let (c0, c1, c2) =
            (DVec3::new(xx + pull, xy, xz), DVec3::new(xy, yy + pull, yz), DVec3::new(xz, yz, zz + pull));
        let rhs = -self.b.as_dvec3();
        let c12 = c1.cross(c2);
        let determinant = c0.dot(c12);
        if determinant <= 0.0 {
            return Vec3::ZERO;
        }
        let inverse = 1.0 / determinant;
        (DVec3::new(rhs.dot(c12), c0.dot(rhs.cross(c2)), c0.dot(c1.cross(rhs))) * inverse).as_vec3()
    }
}

/// What a collapse reads of a vertex, in one line of the cache.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
struct Vertex {
    position_mm: Vec3,
    quadric: Quadric,
}

/// A half-edge: both words that a walk reads of it side by side.
#[derive(Debug, Clone, Copy)]
struct HalfEdge {
    origin: u32,
    twin: u32,
}

/// One way to collapse an edge.
struct Collapse {
    cost: f32,
    position: Vec3,
}

struct Collapser<'a> {
    options: &'a SimplifyOptions,
    min_cos2: f32,
    vertices: Vec<Vertex>,
    on_border: Vec<bool>,
    half_edges: Vec<HalfEdge>,
    /// As in [`HalfEdges`].
    outgoing: Vec<u32>,
    alive: Vec<bool>,
    /// A half-edge of every edge that may be collapsed, and some whose cost is infinite, which may not.
    edges: Vec<u32>,
    /// A lower bound of the cost of each edge, at the half-edge that `edges` holds; infinite at all others.
    costs: Vec<f32>,
    /// Vertices merged in this sweep.
    merged: Vec<bool>,
    merged_into: Vec<u32>,
    vertex_count: usize,
    /// Round in which a vertex was last marked as a neighbour.
    mark: Vec<u32>,
    round: u32,
    rings: [Vec<u32>; 2],
}

impl<'a> Collapser<'a> {
    fn new(mesh: &TriMesh, half_edges: &HalfEdges, options: &'a SimplifyOptions) -> Self {
        let n = mesh.vertex_count();
        let pairs = half_edges.origin.iter().zip(&half_edges.twin);
        Self {
            options,
            min_cos2: libm::cosf(options.max_turn_deg.clamp(0.0, 90.0).to_radians()).powi(2),
            vertices: initial_vertices(mesh, half_edges, options.border_weight),
            on_border: (0..n as u32).map(|v| half_edges.is_boundary_vertex(v)).collect(),
            alive: vec![true; mesh.triangles.len()],
            edges: Vec::new(),
            costs: Vec::with_capacity(half_edges.twin.len()),
            merged: vec![false; n],
            merged_into: (0..n as u32).collect(),
            vertex_count: n,
            mark: vec![0; n],
            round: 0,
            rings: Default::default(),
            half_edges: pairs.map(|(&origin, &twin)| HalfEdge { origin, twin }).collect(),
            outgoing: half_edges.outgoing.clone(),
        }
    }

    /// Sweeps with rising thresholds until the target is met. When no edge is left all are looked at again, for what
    /// was refused may be possible now, until that brings nothing.
    fn run(&mut self, target: usize) {
        while self.vertex_count > target {
            let before = self.vertex_count;
            self.list_edges();
            let mut threshold = 0.0;
            while let Some(next) = self.threshold_after(threshold, self.vertex_count - target) {
                threshold = next;
                self.sweep_below(threshold, target);
                if self.vertex_count <= target {
                    return;
                }
            }
            if self.vertex_count == before {
                return;
            }
        }
    }

    fn from(&self, h: u32) -> u32 {
        self.half_edges[h as usize].origin
    }

    fn to(&self, h: u32) -> u32 {
        self.from(next(h))
    }

    /// Lists all edges, at cost 0 until they are looked at.
    fn list_edges(&mut self) {
        self.edges.clear();
        self.costs.clear();
        for (h, half_edge) in self.half_edges.iter().enumerate() {
            let first = h < half_edge.twin as usize && self.alive[h / 3];
            self.costs.push(if first { 0.0 } else { f32::INFINITY });
            if first {
                self.edges.push(h as u32);
            }
        }
    }

    /// The threshold of the next sweep: what the edges of a sample cost at the rank that promises enough collapses, but
    /// not more than four fifths of them do, and at least [`GROWTH`] times the one before. `None` when no edge is left.
    fn threshold_after(&mut self, before: f32, wanted: usize) -> Option<f32> {
        let step = self.edges.len().div_ceil(SAMPLE).max(1);
        let mut costs = Vec::with_capacity(SAMPLE);
        for i in (0..self.edges.len()).step_by(step) {
            let h = self.edges[i];
            if self.costs[h as usize] == 0.0 {
                self.costs[h as usize] = self.evaluate(h).map_or(f32::INFINITY, |c| c.cost);
            }
            costs.push(self.costs[h as usize].min(f32::MAX));
        }
        if costs.is_empty() {
            return None;
        }
        let rank = (wanted * 3 / 2 / step).min(costs.len() * 4 / 5);
        let enough = *costs.select_nth_unstable_by(rank, f32::total_cmp).1;
        Some(enough.max(before * GROWTH).clamp(f32::MIN_POSITIVE, f32::MAX))
    }

    /// Collapses, in the order of the list, what costs no more than `threshold`, until `target` vertices are left.
    fn sweep_below(&mut self, threshold: f32, target: usize) {
        self.merged.fill(false);
        let edges = std::mem::take(&mut self.edges);
        for h in edges {
            let cost = self.costs[h as usize];
            let waits = cost > threshold || self.merged[self.from(h) as usize] || self.merged[self.to(h) as usize];
            if !waits {
                let found = self.evaluate(h);
                self.costs[h as usize] = found.as_ref().map_or(f32::INFINITY, |c| c.cost);
                if let Some(collapse) = found.filter(|c| c.cost <= threshold) {
                    self.costs[h as usize] = f32::INFINITY;
                    if self.may_collapse(h, collapse.position) {
                        self.collapse(h, &collapse);
                        if self.vertex_count <= target {
                            return;
                        }
                    }
                }
            }
            if self.costs[h as usize] < f32::INFINITY {
                self.edges.push(h);
            }
        }
    }

    /// Half-edge of the same edge whose origin may go: an inner vertex moves onto a border vertex, not away from it.
    /// `None` for an inner edge between border vertices, whose collapse would pinch the disk.
    fn directed(&self, h: u32) -> Option<u32> {
        let twin = self.half_edges[h as usize].twin;
        if twin == NONE || !self.on_border[self.from(h) as usize] {
            return Some(h);
        }
        (!self.on_border[self.to(h) as usize]).then_some(twin)
    }

    fn evaluate(&self, h: u32) -> Option<Collapse> {
        let h = self.directed(h)?;
        let (u, v) = (self.from(h), self.to(h));
        let on_end = self.half_edges[h as usize].twin != NONE && self.on_border[v as usize];
        let [u, v] = [u, v].map(|v| &self.vertices[v as usize]);
        let edge = v.position_mm - u.position_mm;
        let length_cost = LENGTH_COST * edge.length_squared();
        let (error, position, area_mm2) = if on_end {
            let quadric = u.quadric.moved(edge).plus(&v.quadric);
            (quadric.c().max(0.0), v.position_mm, quadric.area_mm2())
        } else {
            let quadric = u.quadric.moved(0.5 * edge).plus(&v.quadric.moved(-0.5 * edge));
            let place = quadric.minimum_near_zero();
            (quadric.at(place), u.position_mm + 0.5 * edge + place, quadric.area_mm2())
        };
        if error > self.options.max_error_mm * self.options.max_error_mm * area_mm2 {
            return None;
        }
        Some(Collapse { cost: error + length_cost * area_mm2, position })
    }

    /// Link condition (the ends share no neighbours but the apexes of the edge's triangles), and no triangle that
    /// stays turns too far or becomes a sliver.
    fn may_collapse(&mut self, h: u32, position: Vec3) -> bool {
        let (u, v) = (self.from(h), self.to(h));
        let [mut of_u, mut of_v] = std::mem::take(&mut self.rings);
        self.collect_ring(u, &mut of_u);
        self.collect_ring(v, &mut of_v);
        self.round += 1;
        for &w in &of_u {
            self.mark[w as usize] = self.round;
        }
        let closing = usize::from(of_v.first() == of_v.last());
        let shared = of_v[closing..].iter().filter(|&&w| self.mark[w as usize] == self.round).count();
        let triangles = 1 + usize::from(self.half_edges[h as usize].twin != NONE);
        let may =
            shared == triangles && self.stays_sound(u, &of_u, v, position) && self.stays_sound(v, &of_v, u, position);
        self.rings = [of_u, of_v];
        may
    }

    /// Neighbours of `v` in order; those of an inner vertex end with the first once more.
    fn collect_ring(&self, v: u32, ring: &mut Vec<u32>) {
        ring.clear();
        let first = self.outgoing[v as usize];
        let mut h = first;
        loop {
            ring.push(self.to(h));
            let back = prev(h);
            h = self.half_edges[back as usize].twin;
            if h == NONE || h == first {
                ring.push(self.from(back));
                return;
            }
        }
    }

    fn stays_sound(&self, moved: u32, ring: &[u32], other: u32, position: Vec3) -> bool {
        let least2 = self.options.min_quality * self.options.min_quality;
        let a = self.vertices[moved as usize].position_mm;
        ring.windows(2).filter(|pair| pair[0] != other && pair[1] != other).all(|pair| {
            let [b, c] = [pair[0], pair[1]].map(|v| self.vertices[v as usize].position_mm);
            let (before, after) = ((b - a).cross(c - a), (b - position).cross(c - position));
            let (dot, lengths2) = (before.dot(after), before.length_squared() * after.length_squared());
            let turned = dot <= 0.0 || dot * dot < self.min_cos2 * lengths2;
            let is2 = quality2([position, b, c]);
            if !turned && is2 >= least2 {
                return is2 > 0.0;
            }
            let was2 = quality2([a, b, c]);
            is2 > 0.0 && (was2 < 1e-12 || !turned) && is2 >= was2.min(least2)
        })
    }

    fn collapse(&mut self, h: u32, collapse: &Collapse) {
        let Some(h) = self.directed(h) else { return };
        let (gone, keep) = (self.from(h), self.to(h));
        let first = self.outgoing[gone as usize];
        let mut g = first;
        loop {
            self.half_edges[g as usize].origin = keep;
            g = self.half_edges[prev(g) as usize].twin;
            if g == NONE || g == first {
                break;
            }
        }
        let twin = self.half_edges[h as usize].twin;
        if [next(h), twin].contains(&self.outgoing[keep as usize]) {
            self.outgoing[keep as usize] = self.half_edges[prev(h) as usize].twin;
        }
        self.remove_triangle(h);
        if twin != NONE {
            self.remove_triangle(twin);
        }
        self.outgoing[gone as usize] = NONE;
        self.merged_into[gone as usize] = keep;
        self.vertex_count -= 1;
        self.merge(gone, keep, collapse.position);
    }

    /// Moves `keep` to its new place and gives it what `gone` stood for.
    fn merge(&mut self, gone: u32, keep: u32, position: Vec3) {
        let [gone, kept] = [gone, keep].map(|v| &self.vertices[v as usize]);
        let moved = |v: &Vertex| v.quadric.moved(position - v.position_mm);
        let quadric = moved(gone).plus(&moved(kept));
        self.vertices[keep as usize] = Vertex { position_mm: position, quadric };
        self.merged[keep as usize] = true;
    }

    /// Takes away the triangle of `h`, an edge that has shrunk to a point, and joins its two other sides.
    fn remove_triangle(&mut self, h: u32) {
        let (n, p) = (next(h), prev(h));
        let apex = self.from(p) as usize;
        let (after, before) = (self.half_edges[n as usize].twin, self.half_edges[p as usize].twin);
        for (side, other) in [(after, before), (before, after)] {
            if side != NONE {
                self.half_edges[side as usize].twin = other;
            }
        }
        self.join_costs([h, n, p], [after, before]);
        if self.outgoing[apex] == p {
            self.outgoing[apex] = after;
        }
        self.alive[h as usize / 3] = false;
    }

    /// The edge that stays where a triangle went costs at least what either of the two costs that it was made of.
    fn join_costs(&mut self, gone: [u32; 3], stay: [u32; 2]) {
        let cost = |s: &Self, h: u32| s.costs.get(h as usize).copied().unwrap_or(f32::INFINITY);
        let finite = [gone[1], gone[2], stay[0], stay[1]].map(|h| cost(self, h)).into_iter().filter(|c| c.is_finite());
        let bound = finite.fold(0.0, f32::max);
        let listed = stay.into_iter().find(|&h| cost(self, h).is_finite());
        for h in gone.into_iter().chain(stay).filter(|&h| h != NONE) {
            self.costs[h as usize] = f32::INFINITY;
        }
        let heir = listed.unwrap_or_else(|| {
            let heir = stay[0].min(stay[1]);
            self.edges.push(heir);
            heir
        });
        self.costs[heir as usize] = bound;
    }

    fn finish(mut self, mesh: &TriMesh, half_edges: &HalfEdges) -> (DiskMesh, SimplifyReport) {
        let n = self.merged_into.len();
        let (mut largest, mut sum, mut area_mm2) = (0f64, 0.0, 0.0);
        let mut new_of = vec![NONE; n];
        let mut kept = Vec::with_capacity(self.vertex_count);
        for v in (0..n).filter(|&v| self.merged_into[v] as usize == v) {
            new_of[v] = kept.len() as u32;
            kept.push(v);
            let quadric = &self.vertices[v].quadric;
            let (error, area) = (f64::from(quadric.c().max(0.0)), f64::from(quadric.area_mm2()));
            largest = largest.max(error / area.max(f64::MIN_POSITIVE));
            sum += error;
            area_mm2 += area;
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
        let half_edge = |h: usize| (self.half_edges[h].origin, self.half_edges[h].twin);
        let connectivity = HalfEdges::of_kept(&self.alive, half_edge, &new_of, kept.len());
        let small = TriMesh {
            positions_mm: kept.iter().map(|&v| self.vertices[v].position_mm).collect(),
            triangles: connectivity.origin.as_chunks::<3>().0.to_vec(),
            uv: mesh.uv.as_ref().map(|uv| {
                kept.iter().map(|&v| uv_near(mesh, half_edges, uv, v as u32, self.vertices[v].position_mm)).collect()
            }),
        };
        let report = SimplifyReport {
            merged_into: self.merged_into.iter().map(|&v| new_of[v as usize]).collect(),
            max_error_mm: largest.sqrt() as f32,
            rms_error_mm: (sum / area_mm2.max(f64::MIN_POSITIVE)).sqrt() as f32,
        };
        (DiskMesh::known(small, connectivity), report)
    }
}

/// Texture coordinate of the point of `mesh` nearest to `p`, among the triangles about the vertex nearest to `p` that is
/// reached by walking from vertex `v` ever nearer.
fn uv_near(mesh: &TriMesh, half_edges: &HalfEdges, uv: &[[f32; 2]], mut v: u32, p: Vec3) -> [f32; 2] {
    let distance2 = |v: u32| mesh.positions_mm[v as usize].distance_squared(p);
    let mut here = distance2(v);
    while here > 0.0 {
        let nearer =
            half_edges.neighbours(v).map(|w| (distance2(w), w)).fold((here, v), |a, b| if b.0 < a.0 { b } else { a });
        if nearer.1 == v {
            break;
        }
        (here, v) = nearer;
    }
    let mut best = (here, uv[v as usize]);
    for h in half_edges.fan(v) {
        let corners = mesh.triangles[h as usize / 3].map(|v| v as usize);
        let found = Triangle::new(corners.map(|v| mesh.positions_mm[v]), 0).closest(p);
        let distance2 = found.offset.length_squared();
        if distance2 < best.0 {
            let [a, b, c] = corners.map(|v| uv[v]);
            let mix = |i: usize| a[i] + (b[i] - a[i]) * found.v + (c[i] - a[i]) * found.w;
            best = (distance2, [mix(0), mix(1)]);
        }
    }
    best.1
}

/// Square of the shape quality, 1 equilateral, 0 degenerate ([`super::quality`]).
fn quality2([a, b, c]: [Vec3; 3]) -> f32 {
    let squares = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
    12.0 * (b - a).cross(c - a).length_squared() / (squares * squares).max(f32::MIN_POSITIVE)
}

/// Area-weighted quadrics of the triangles around each vertex, with upright planes along the border.
fn initial_vertices(mesh: &TriMesh, half_edges: &HalfEdges, border_weight: f32) -> Vec<Vertex> {
    let vertex = |&position_mm: &Vec3| Vertex { position_mm, quadric: Quadric::default() };
    let mut vertices: Vec<Vertex> = mesh.positions_mm.iter().map(vertex).collect();
    for (t, corners) in mesh.triangles.iter().enumerate() {
        let points = mesh.corners(t);
        let normal = (points[1] - points[0]).cross(points[2] - points[0]);
        let length = normal.length();
        let third = length / 6.0;
        let unit = if length > 0.0 { normal / length } else { Vec3::ZERO };
        let plane = Quadric::plane(unit, third, third);
        for &v in corners {
            let quadric = &mut vertices[v as usize].quadric;
            *quadric = quadric.plus(&plane);
        }
        for k in (0..3).filter(|k| half_edges.twin[3 * t + k] == NONE) {
            let edge = points[(k + 1) % 3] - points[k];
            let wall = edge.cross(unit).normalize_or_zero();
            let plane = Quadric::plane(wall, border_weight * edge.length_squared(), 0.0);
            for v in [corners[k], corners[(k + 1) % 3]] {
                let quadric = &mut vertices[v as usize].quadric;
                *quadric = quadric.plus(&plane);
            }
        }
    }
    vertices
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{Bvh, quality};
    use proptest::prelude::*;

    fn height_field(side: u32, height: impl Fn(f32, f32) -> f32) -> DiskMesh {
        let pixels = (0..side * side).map(|i| ((i % side) as f32, (i / side) as f32));
        let mut mesh = TriMesh {
            positions_mm: pixels.clone().map(|(x, y)| Vec3::new(x, y, height(x, y))).collect(),
            triangles: Vec::new(),
            uv: Some(pixels.map(|(x, y)| [x / side as f32, y / side as f32]).collect()),
        };
        for a in (0..side - 1).flat_map(|y| (0..side - 1).map(move |x| y * side + x)) {
            mesh.triangles.extend([[a, a + 1, a + side + 1], [a, a + side + 1, a + side]]);
        }
        DiskMesh::new(mesh).unwrap()
    }

    fn reduce(mesh: &DiskMesh, target: usize) -> (TriMesh, SimplifyReport) {
        let (small, report) = simplify(mesh, target, &SimplifyOptions::default());
        assert_eq!(DiskMesh::new((*small).clone()).unwrap().half_edges(), small.half_edges());
        let small = small.into_mesh();
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
    fn limits_of_error_hold() {
        let mesh = height_field(40, |x, y| (x * 0.8).sin() * (y * 0.8).cos());
        let options = SimplifyOptions { max_error_mm: 0.02, ..Default::default() };
        let (small, report) = simplify(&mesh, 3, &options);
        assert!(small.vertex_count() > 200 && report.max_error_mm <= 0.0201, "{}", small.vertex_count());
        let (same, report) = reduce(&mesh, 99_999);
        assert!(same == *mesh && report.rms_error_mm < 1e-6);
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
