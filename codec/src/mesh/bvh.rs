//! Nearest point on a triangle mesh: a bounding-volume hierarchy, four children a node.
//!
//! Nodes keep the boxes of their children side by side, so that the four distances of a visit are computed together.
//! Splits are medians on the longest axis: scans are sampled evenly, where a surface-area heuristic gains little and
//! costs more to build. Depth is bounded by the halving, whatever the input.

use super::TriMesh;
use glam::Vec3;

/// Triangles a leaf holds at most.
const LEAF_TRIANGLES: usize = 4;
/// Marks a child without triangles.
const EMPTY: u32 = u32::MAX;
/// Marks a leaf; the bits below hold first slot * 8 + triangle count.
const LEAF_BIT: u32 = 1 << 31;
/// Pending children: 3 a level, and 4^15 triangles are more than a leaf code can name.
const STACK: usize = 64;

/// The point of a mesh nearest to a query point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// Index into `TriMesh::triangles`.
    pub triangle: u32,
    /// Point on that triangle, millimetres.
    pub point_mm: Vec3,
    /// Weights of the triangle's corners at that point; they sum to 1.
    pub barycentric: [f32; 3],
    /// Squared distance from the query point, mm².
    pub distance2_mm2: f32,
}

impl Nearest {
    /// Value at this point of something given at the mesh's vertices, texture coordinates for instance.
    #[inline]
    pub fn interpolate<const N: usize>(&self, triangles: &[[u32; 3]], values: &[[f32; N]]) -> [f32; N] {
        let corners = triangles[self.triangle as usize].map(|v| values[v as usize]);
        std::array::from_fn(|i| (0..3).map(|k| self.barycentric[k] * corners[k][i]).sum())
    }
}

/// Where a ray first meets a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RayHit {
    /// Index into `TriMesh::triangles`.
    pub triangle: u32,
    /// Distance from the ray's origin, millimetres.
    pub distance_mm: f32,
    /// Weights of the triangle's corners at that point; they sum to 1.
    pub barycentric: [f32; 3],
}

/// Weights down to this below zero count as inside, so that no ray slips through between neighbours.
const EDGE_SLACK: f64 = 1e-6;

/// Hierarchy over the triangles of one mesh; keeps its own copy of the corners.
#[derive(Debug, Clone)]
pub struct Bvh {
    nodes: Vec<Node>,
    leaves: Vec<Triangle>,
}

/// Four children: their boxes by axis, and what they are.
#[derive(Debug, Clone)]
struct Node {
    lo: [[f32; 4]; 3],
    hi: [[f32; 4]; 3],
    child: [u32; 4],
}

/// While building: sum of a triangle's corners, and its index.
type Item = (Vec3, u32);

/// A triangle in leaf order.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Triangle {
    a: Vec3,
    ab: Vec3,
    ac: Vec3,
    id: u32,
}

/// Nearest point on one triangle: weights of corners b and c, and the offset from the query point.
#[derive(Clone, Copy)]
pub(crate) struct Closest {
    pub(crate) v: f32,
    pub(crate) w: f32,
    pub(crate) offset: Vec3,
}

impl Bvh {
    /// Hierarchy over the triangles of a valid mesh. O(n log n).
    ///
    /// # Panics
    /// When the mesh has 2^28 triangles or more, or names vertices it has not ([`TriMesh::validate`]).
    pub fn new(mesh: &TriMesh) -> Self {
        assert!(mesh.triangles.len() < 1 << 28, "a leaf code names up to 2^28 triangles");
        let mut items: Vec<Item> =
            (0..mesh.triangles.len()).map(|t| (mesh.corners(t).iter().sum::<Vec3>(), t as u32)).collect();
        let mut bvh = Self { nodes: Vec::with_capacity(items.len() / 4 + 1), leaves: Vec::with_capacity(items.len()) };
        if !items.is_empty() {
            bvh.build_node(mesh, &mut items);
        }
        bvh
    }

    /// Builds the node over `items` and what is below it; returns its index and box.
    fn build_node(&mut self, mesh: &TriMesh, items: &mut [Item]) -> (u32, Vec3, Vec3) {
        let index = self.nodes.len();
        self.nodes.push(Node { lo: [[f32::INFINITY; 4]; 3], hi: [[f32::NEG_INFINITY; 4]; 3], child: [EMPTY; 4] });
        let (left, right) = halve(items);
        let ((a, b), (c, d)) = (halve(left), halve(right));
        let (mut lo, mut hi) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for (k, part) in [a, b, c, d].into_iter().enumerate().filter(|(_, part)| !part.is_empty()) {
            let (child, part_lo, part_hi) =
                if part.len() <= LEAF_TRIANGLES { self.push_leaf(mesh, part) } else { self.build_node(mesh, part) };
            let node = &mut self.nodes[index];
            node.child[k] = child;
            for axis in 0..3 {
                node.lo[axis][k] = part_lo[axis];
                node.hi[axis][k] = part_hi[axis];
            }
            (lo, hi) = (lo.min(part_lo), hi.max(part_hi));
        }
        (index as u32, lo, hi)
    }

    fn push_leaf(&mut self, mesh: &TriMesh, items: &[Item]) -> (u32, Vec3, Vec3) {
        let code = LEAF_BIT | (self.leaves.len() * 8 + items.len()) as u32;
        let (mut lo, mut hi) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for &(_, id) in items {
            let corners = mesh.corners(id as usize);
            (lo, hi) = corners.iter().fold((lo, hi), |(lo, hi), &p| (lo.min(p), hi.max(p)));
            self.leaves.push(Triangle::new(corners, id));
        }
        (code, lo, hi)
    }

    /// The point of the mesh nearest to `p` and closer than `max_distance_mm` (infinity allowed); `None` when there
    /// is none, or when `p` is not finite. Among equally near triangles the choice is deterministic.
    ///
    /// Depth-first, nearer children first. Starting from the triangle found for a neighbouring point was measured
    /// not to pay: the first descent finds as good a bound.
    pub fn nearest(&self, p: Vec3, max_distance_mm: f32) -> Option<Nearest> {
        if !p.is_finite() || self.nodes.is_empty() {
            return None;
        }
        let mut best = None;
        let mut best2 = max_distance_mm * max_distance_mm;
        let mut stack = [(0u32, 0f32); STACK];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (child, bound) = stack[depth];
            if bound >= best2 {
                continue;
            }
            if child & LEAF_BIT != 0 {
                let first = (child & !LEAF_BIT) as usize / 8;
                for triangle in &self.leaves[first..first + child as usize % 8] {
                    let closest = triangle.closest(p);
                    let d2 = closest.offset.length_squared();
                    if d2 < best2 {
                        best2 = d2;
                        best = Some((triangle.id, closest));
                    }
                }
                continue;
            }
            let node = &self.nodes[child as usize];
            let base = depth;
            for (&child, bound) in node.child.iter().zip(node.distances2(p)) {
                if bound < best2 {
                    let mut at = depth;
                    while at > base && stack[at - 1].1 < bound {
                        stack[at] = stack[at - 1];
                        at -= 1;
                    }
                    stack[at] = (child, bound);
                    depth += 1;
                }
            }
        }
        best.map(|(triangle, found): (u32, Closest)| Nearest {
            triangle,
            point_mm: p + found.offset,
            barycentric: [1.0 - found.v - found.w, found.v, found.w],
            distance2_mm2: best2,
        })
    }
}

impl Bvh {
    /// Where the ray from `origin` along `direction` (of any length) first meets the mesh, on either side of a triangle
    /// and no farther than `max_distance_mm` (infinity allowed). `None` when it does not, or when origin or direction is
    /// not finite or the direction zero.
    pub fn first_hit(&self, origin: Vec3, direction: Vec3, max_distance_mm: f32) -> Option<RayHit> {
        let direction = direction.try_normalize()?;
        if !origin.is_finite() || self.nodes.is_empty() {
            return None;
        }
        // A zero would give 0 x infinity on the face of a box.
        let inverse = direction.map(|d| if d.abs() < 1e-30 { 1e30 } else { 1.0 / d });
        let (mut best, mut reach) = (None, max_distance_mm);
        let mut stack = [(0u32, 0f32); STACK];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (child, entry) = stack[depth];
            if entry > reach {
                continue;
            }
            if child & LEAF_BIT != 0 {
                let first = (child & !LEAF_BIT) as usize / 8;
                for triangle in &self.leaves[first..first + child as usize % 8] {
                    if let Some(hit) = triangle.hit(origin, direction).filter(|hit| hit.distance_mm <= reach) {
                        reach = hit.distance_mm;
                        best = Some(hit);
                    }
                }
                continue;
            }
            let node = &self.nodes[child as usize];
            let base = depth;
            for (&child, [entry, exit]) in node.child.iter().zip(node.crossings(origin, inverse)) {
                if child != EMPTY && entry <= exit && entry <= reach {
                    let mut at = depth;
                    while at > base && stack[at - 1].1 < entry {
                        stack[at] = stack[at - 1];
                        at -= 1;
                    }
                    stack[at] = (child, entry);
                    depth += 1;
                }
            }
        }
        best
    }
}

impl Node {
    /// Where a ray enters and leaves the four boxes, never before its origin; boxes that it misses are left before they
    /// are entered.
    #[inline]
    fn crossings(&self, origin: Vec3, inverse: Vec3) -> [[f32; 2]; 4] {
        let mut spans = [[0f32, f32::INFINITY]; 4];
        for axis in 0..3 {
            for (span, (lo, hi)) in spans.iter_mut().zip(self.lo[axis].iter().zip(&self.hi[axis])) {
                let (a, b) = ((lo - origin[axis]) * inverse[axis], (hi - origin[axis]) * inverse[axis]);
                // Rounding may shorten a flat box to nothing.
                *span = [span[0].max(a.min(b) * (1.0 - 1e-6)), span[1].min(a.max(b) * (1.0 + 1e-6))];
            }
        }
        spans
    }

    /// Squared distances from `p` to the four boxes; infinite for an empty child.
    #[inline]
    fn distances2(&self, p: Vec3) -> [f32; 4] {
        let mut sum = [0f32; 4];
        for axis in 0..3 {
            for (sum, (lo, hi)) in sum.iter_mut().zip(self.lo[axis].iter().zip(&self.hi[axis])) {
                let d = (lo - p[axis]).max(p[axis] - hi).max(0.0);
                *sum += d * d;
            }
        }
        sum
    }
}

impl Triangle {
    pub(crate) fn new([a, b, c]: [Vec3; 3], id: u32) -> Self {
        Self { a, ab: b - a, ac: c - a, id }
    }

    /// Closest point by Voronoi regions (Ericson, Real-Time Collision Detection 2005, section 5.1.5), relative to
    /// `p` so that precision does not suffer from the distance to the origin. Degenerate triangles act as segments.
    #[inline]
    pub(crate) fn closest(&self, p: Vec3) -> Closest {
        let (ab, ac) = (self.ab, self.ac);
        let a = self.a - p;
        let at = |v: f32, w: f32| Closest { v, w, offset: a + ab * v + ac * w };
        let (d1, d2) = (-ab.dot(a), -ac.dot(a));
        if d1 <= 0.0 && d2 <= 0.0 {
            return at(0.0, 0.0);
        }
        let b = a + ab;
        let (d3, d4) = (-ab.dot(b), -ac.dot(b));
        if d3 >= 0.0 && d4 <= d3 {
            return at(1.0, 0.0);
        }
        let vc = d1 * d4 - d3 * d2;
        if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 && d1 > d3 {
            return at(d1 / (d1 - d3), 0.0);
        }
        let c = a + ac;
        let (d5, d6) = (-ab.dot(c), -ac.dot(c));
        if d6 >= 0.0 && d5 <= d6 {
            return at(0.0, 1.0);
        }
        let vb = d5 * d2 - d1 * d6;
        if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 && d2 > d6 {
            return at(0.0, d2 / (d2 - d6));
        }
        let va = d3 * d6 - d5 * d4;
        let (from_b, from_c) = (d4 - d3, d5 - d6);
        if va <= 0.0 && from_b >= 0.0 && from_c >= 0.0 && from_b + from_c > 0.0 {
            let w = from_b / (from_b + from_c);
            return at(1.0 - w, w);
        }
        let sum = va + vb + vc;
        if sum > 0.0 { at(vb / sum, vc / sum) } else { at(0.0, 0.0) }
    }
}

impl Triangle {
    /// Intersection with a ray of unit direction (Möller and Trumbore 1997), from either side.
    fn hit(&self, origin: Vec3, direction: Vec3) -> Option<RayHit> {
        let [a, ab, ac, o, d] = [self.a, self.ab, self.ac, origin, direction].map(|p| p.as_dvec3());
        let across = d.cross(ac);
        let determinant = ab.dot(across);
        if determinant == 0.0 {
            return None;
        }
        let from_a = o - a;
        let v = from_a.dot(across) / determinant;
        let along = from_a.cross(ab);
        let w = d.dot(along) / determinant;
        let distance = ac.dot(along) / determinant;
        let inside = v >= -EDGE_SLACK && w >= -EDGE_SLACK && v + w <= 1.0 + EDGE_SLACK && distance >= 0.0;
        let (v, w) = (v as f32, w as f32);
        inside.then_some(RayHit { triangle: self.id, distance_mm: distance as f32, barycentric: [1.0 - v - w, v, w] })
    }
}

/// Splits at the median along the longest axis; what fits a leaf stays whole.
fn halve(items: &mut [Item]) -> (&mut [Item], &mut [Item]) {
    let n = items.len();
    if n <= LEAF_TRIANGLES {
        return items.split_at_mut(n);
    }
    let (lo, hi) = items.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), (c, _)| (lo.min(*c), hi.max(*c)));
    let axis = (hi - lo).max_position();
    items.select_nth_unstable_by(n / 2, |a, b| a.0[axis].total_cmp(&b.0[axis]));
    items.split_at_mut(n / 2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn brute_force(mesh: &TriMesh, p: Vec3) -> f32 {
        let closest = |t: usize| Triangle::new(mesh.corners(t), 0).closest(p).offset.length();
        (0..mesh.triangles.len()).map(closest).fold(f32::INFINITY, f32::min)
    }

    fn soup(points: Vec<[f32; 3]>) -> TriMesh {
        let triangles = (0..points.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        TriMesh { positions_mm: points.into_iter().map(Vec3::from).collect(), triangles, uv: None }
    }

    #[test]
    fn every_region_of_a_triangle() {
        let bvh = Bvh::new(&soup(vec![[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]]));
        for (p, nearest) in [
            ([1.0, 1.0, 3.0], [1.0, 1.0, 0.0]),
            ([-1.0, -2.0, 1.0], [0.0, 0.0, 0.0]),
            ([6.0, -1.0, 1.0], [4.0, 0.0, 0.0]),
            ([-1.0, 6.0, 1.0], [0.0, 4.0, 0.0]),
            ([2.0, -3.0, 0.0], [2.0, 0.0, 0.0]),
            ([-3.0, 2.0, 0.0], [0.0, 2.0, 0.0]),
            ([4.0, 4.0, -1.0], [2.0, 2.0, 0.0]),
        ] {
            let found = bvh.nearest(p.into(), f32::INFINITY).unwrap();
            assert!((found.point_mm - Vec3::from(nearest)).length() < 1e-6, "{p:?} gave {found:?}");
            let corner_sum =
                Vec3::new(4.0, 0.0, 0.0) * found.barycentric[1] + Vec3::new(0.0, 4.0, 0.0) * found.barycentric[2];
            assert!((corner_sum - found.point_mm).length() < 1e-6);
        }
        assert!(bvh.nearest(Vec3::new(1.0, 1.0, 3.0), 2.9).is_none());
        assert!(bvh.nearest(Vec3::NAN, f32::INFINITY).is_none());
        assert!(Bvh::new(&TriMesh::default()).nearest(Vec3::ZERO, f32::INFINITY).is_none());
    }

    #[test]
    fn degenerate_triangles_act_as_segments_and_points() {
        let bvh = Bvh::new(&soup(vec![[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [2.0, 0.0, 0.0]]));
        let found = bvh.nearest(Vec3::new(3.5, 2.0, 0.0), f32::INFINITY).unwrap();
        assert!((found.point_mm - Vec3::new(3.5, 0.0, 0.0)).length() < 1e-6);
        let bvh = Bvh::new(&soup(vec![[1.0, 1.0, 1.0]; 3]));
        assert!((bvh.nearest(Vec3::ZERO, 10.0).unwrap().distance2_mm2 - 3.0).abs() < 1e-6);
    }

    #[test]
    fn interpolation_follows_the_corners() {
        let mesh = soup(vec![[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]]);
        let uv = [[0.0, 1.0], [1.0, 1.0], [0.0, 0.0]];
        let found = Bvh::new(&mesh).nearest(Vec3::new(1.0, 2.0, 5.0), f32::INFINITY).unwrap();
        let [u, v] = found.interpolate(&mesh.triangles, &uv);
        assert!((u - 0.25).abs() < 1e-6 && (v - 0.5).abs() < 1e-6);
    }

    #[test]
    fn rays_meet_a_sphere_where_geometry_says() {
        let mesh = super::super::test_surfaces::sphere(12, 10.0);
        let bvh = Bvh::new(&mesh);
        for p in &mesh.positions_mm {
            // Through a vertex, where rays slip through if anywhere; from outside and from the centre.
            let hit = bvh.first_hit(*p * 3.0, -*p, f32::INFINITY).unwrap();
            assert!((hit.distance_mm - 20.0).abs() < 1e-3, "{hit:?}");
            let point: Vec3 =
                mesh.corners(hit.triangle as usize).iter().zip(hit.barycentric).map(|(c, w)| *c * w).sum();
            assert!(point.distance(*p) < 1e-3);
            assert!((bvh.first_hit(Vec3::ZERO, *p, f32::INFINITY).unwrap().distance_mm - 10.0).abs() < 1e-3);
            assert!(bvh.first_hit(*p * 3.0, *p, f32::INFINITY).is_none(), "behind the origin");
            assert!(bvh.first_hit(*p * 3.0, -*p, 19.9).is_none(), "too far");
        }
        assert!(bvh.first_hit(Vec3::ZERO, Vec3::ZERO, 1.0).is_none());
        assert!(bvh.first_hit(Vec3::NAN, Vec3::X, 1.0).is_none());
        assert!(Bvh::new(&TriMesh::default()).first_hit(Vec3::ZERO, Vec3::X, f32::INFINITY).is_none());
    }

    proptest! {
        #[test]
        fn first_hits_agree_with_brute_force(
            points in proptest::collection::vec(prop::array::uniform3(-10f32..10.0), 3..300),
            rays in proptest::collection::vec(prop::array::uniform6(-12f32..12.0), 1..20),
        ) {
            let mesh = soup(points[..points.len() / 3 * 3].to_vec());
            let bvh = Bvh::new(&mesh);
            for [x, y, z, dx, dy, dz] in rays {
                let (origin, direction) = (Vec3::new(x, y, z), Vec3::new(dx, dy, dz).normalize_or(Vec3::X));
                let expected = (0..mesh.triangles.len())
                    .filter_map(|t| Triangle::new(mesh.corners(t), t as u32).hit(origin, direction))
                    .map(|hit| hit.distance_mm)
                    .fold(f32::INFINITY, f32::min);
                let found = bvh.first_hit(origin, direction, f32::INFINITY).map_or(f32::INFINITY, |h| h.distance_mm);
                // The direction is normalized a second time.
                prop_assert!(found == expected || (found - expected).abs() < 1e-4 * expected, "{} of {}", found, expected);
            }
        }

        #[test]
        fn agrees_with_brute_force(
            points in proptest::collection::vec(prop::array::uniform3(-10f32..10.0), 3..300),
            queries in proptest::collection::vec(prop::array::uniform3(-15f32..15.0), 1..20),
            limit in 0f32..30.0,
        ) {
            let mesh = soup(points[..points.len() / 3 * 3].to_vec());
            let bvh = Bvh::new(&mesh);
            for q in queries.into_iter().map(Vec3::from) {
                let expected = brute_force(&mesh, q);
                let found = bvh.nearest(q, f32::INFINITY).unwrap();
                prop_assert!((found.distance2_mm2.sqrt() - expected).abs() <= 1e-5 * (1.0 + expected));
                let [a, b, c] = mesh.corners(found.triangle as usize);
                let [u, v, w] = found.barycentric;
                prop_assert!((a * u + b * v + c * w - found.point_mm).length() < 1e-4);
                prop_assert!(u.min(v).min(w) >= -1e-6);
                if (limit - expected).abs() > 1e-4 {
                    prop_assert_eq!(bvh.nearest(q, limit).is_some(), expected < limit);
                }
            }
        }
    }
}
