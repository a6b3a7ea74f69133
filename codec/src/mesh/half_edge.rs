//! Half-edges of an oriented manifold triangle mesh.
//!
//! Half-edge `h = 3 t + k` runs from corner `k` of triangle `t` to corner `k + 1`; only its twin has to be stored.
//! Edges are paired by a counting sort on their smaller vertex: linear, and the result does not depend on hashing.

use crate::{CodecError, Result};

/// "No half-edge": the twin of a boundary half-edge, the outgoing half-edge of a vertex without triangles.
pub const NONE: u32 = u32::MAX;

/// Buckets longer than this are sorted before they are searched, so that a hub of many edges costs n log n.
const SORT_ABOVE: usize = 24;

/// Half-edge that follows `h` inside its triangle.
#[inline]
pub fn next(h: u32) -> u32 {
    if h % 3 == 2 { h - 2 } else { h + 1 }
}

/// Half-edge before `h` inside its triangle.
#[inline]
pub fn prev(h: u32) -> u32 {
    if h.is_multiple_of(3) { h + 2 } else { h - 1 }
}

/// Connectivity of an oriented 2-manifold, with or without boundary.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HalfEdges {
    /// Vertex each half-edge starts from: the triangles, flattened.
    pub origin: Vec<u32>,
    /// Opposite half-edge, or [`NONE`] at the boundary.
    pub twin: Vec<u32>,
    /// One half-edge that leaves each vertex, the boundary one at a boundary vertex; [`NONE`] without triangles.
    pub outgoing: Vec<u32>,
}

impl HalfEdges {
    /// Builds the connectivity of `triangles` over `vertex_count` vertices.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] naming (1-based, as OBJ counts) an index out of range, a triangle that repeats a vertex,
    /// an edge with more than two triangles, an edge whose two triangles disagree in orientation, or a vertex where
    /// several fans of triangles meet (bow-tie).
    pub fn build(vertex_count: usize, triangles: &[[u32; 3]]) -> Result<Self> {
        check_triangles(vertex_count, triangles)?;
        let origin = triangles.as_flattened().to_vec();
        let mut wrong = None;
        let twin = pair_edges(vertex_count, &origin, |group| {
            wrong.get_or_insert((group[0], group.len()));
        });
        if let Some((h, count)) = wrong {
            let (a, b) = (origin[h as usize] + 1, origin[next(h) as usize] + 1);
            return Err(CodecError::Mesh(format!("edge {a}-{b} has {count} triangles; a surface has at most 2")));
        }
        if let Some(h) = (0..twin.len()).find(|&h| twin[h] != NONE && origin[twin[h] as usize] == origin[h]) {
            let (a, b) = (origin[h] + 1, origin[next(h as u32) as usize] + 1);
            return Err(CodecError::Mesh(format!("the two triangles of edge {a}-{b} have opposite orientation")));
        }
        let outgoing = outgoing_half_edges(vertex_count, &origin, &twin);
        let mesh = Self { origin, twin, outgoing };
        mesh.check_fans()?;
        Ok(mesh)
    }

    /// Connectivity of the triangles that are `alive`, given their half-edges as (origin, twin) and the new number of each
    /// vertex they use; the others' half-edges are nobody's twin.
    pub(crate) fn of_kept(
        alive: &[bool],
        half_edge: impl Fn(usize) -> (u32, u32),
        new_vertex: &[u32],
        vertex_count: usize,
    ) -> Self {
        let mut count = 0;
        let mut new_triangle = Vec::with_capacity(alive.len());
        for &alive in alive {
            new_triangle.push(count);
            count += u32::from(alive);
        }
        let moved = |g: u32| if g == NONE { NONE } else { 3 * new_triangle[g as usize / 3] + g % 3 };
        let (mut origin, mut twin) = (Vec::with_capacity(3 * count as usize), Vec::with_capacity(3 * count as usize));
        for (t, _) in alive.iter().enumerate().filter(|(_, alive)| **alive) {
            let sides = [3 * t, 3 * t + 1, 3 * t + 2].map(&half_edge);
            origin.extend(sides.map(|(v, _)| new_vertex[v as usize]));
            twin.extend(sides.map(|(_, g)| moved(g)));
        }
        let outgoing = outgoing_half_edges(vertex_count, &origin, &twin);
        Self { origin, twin, outgoing }
    }

    /// Number of vertices, with or without triangles.
    pub fn vertex_count(&self) -> usize {
        self.outgoing.len()
    }

    /// Number of triangles.
    pub fn triangle_count(&self) -> usize {
        self.origin.len() / 3
    }

    /// Number of undirected edges.
    pub fn edge_count(&self) -> usize {
        let boundary = self.twin.iter().filter(|&&t| t == NONE).count();
        (self.twin.len() + boundary) / 2
    }

    /// Vertex half-edge `h` starts from.
    #[inline]
    pub fn from(&self, h: u32) -> u32 {
        self.origin[h as usize]
    }

    /// Vertex half-edge `h` leads to.
    #[inline]
    pub fn to(&self, h: u32) -> u32 {
        self.origin[next(h) as usize]
    }

    /// Whether vertex `v` lies on a boundary; a vertex without triangles does not.
    #[inline]
    pub fn is_boundary_vertex(&self, v: u32) -> bool {
        let h = self.outgoing[v as usize];
        h != NONE && self.twin[h as usize] == NONE
    }

    /// Half-edges that leave vertex `v`, counter-clockwise, from the boundary one at a boundary vertex. The last
    /// neighbour of a boundary vertex is only reached by the incoming half-edge `prev` of the last one given.
    pub fn fan(&self, v: u32) -> impl Iterator<Item = u32> + '_ {
        let start = self.outgoing[v as usize];
        let mut at = start;
        std::iter::from_fn(move || {
            let here = at;
            if here == NONE {
                return None;
            }
            let onward = self.twin[prev(here) as usize];
            at = if onward == start { NONE } else { onward };
            Some(here)
        })
    }

    /// Neighbours of vertex `v`, counter-clockwise; at a boundary vertex from the next boundary vertex to the previous.
    pub fn neighbours(&self, v: u32) -> impl Iterator<Item = u32> + '_ {
        self.fan(v).flat_map(move |h| {
            let ends = self.twin[prev(h) as usize] == NONE;
            std::iter::once(self.to(h)).chain(ends.then(|| self.from(prev(h))))
        })
    }

    /// Boundary loops as vertex lists, each in the direction of its half-edges (the face lies on the left); every
    /// loop begins at its smallest vertex index, loops are ordered by that.
    pub fn boundary_loops(&self) -> Vec<Vec<u32>> {
        let mut seen = vec![false; self.vertex_count()];
        let mut loops = Vec::new();
        for start in 0..self.vertex_count() as u32 {
            if seen[start as usize] || !self.is_boundary_vertex(start) {
                continue;
            }
            let mut ring = Vec::new();
            let mut v = start;
            while !seen[v as usize] {
                seen[v as usize] = true;
                ring.push(v);
                v = self.to(self.outgoing[v as usize]);
            }
            loops.push(ring);
        }
        loops
    }

    /// Euler characteristic V - E + F; vertices without triangles count.
    pub fn euler_characteristic(&self) -> i64 {
        self.vertex_count() as i64 - self.edge_count() as i64 + self.triangle_count() as i64
    }

    /// An edge (two vertices) on a loop around a handle; none on a connected surface without handles. Edges in neither
    /// of two trees, one over the vertices and one over the triangles and borders that does not cross it, are those on
    /// which handles hang (Eppstein 2003, tree-cotree decomposition).
    pub fn handle_edge(&self) -> Option<(u32, u32)> {
        let mut in_tree = vec![false; self.twin.len()];
        let mut reached = vec![false; self.vertex_count()];
        for seed in 0..self.vertex_count() as u32 {
            let mut stack = vec![seed];
            reached[seed as usize] |= self.outgoing[seed as usize] == NONE;
            if std::mem::replace(&mut reached[seed as usize], true) {
                continue;
            }
            while let Some(v) = stack.pop() {
                for h in self.fan(v).flat_map(|h| [h, prev(h)]) {
                    let w = if self.from(h) == v { self.to(h) } else { self.from(h) };
                    if !std::mem::replace(&mut reached[w as usize], true) {
                        in_tree[h as usize] = true;
                        if self.twin[h as usize] != NONE {
                            in_tree[self.twin[h as usize] as usize] = true;
                        }
                        stack.push(w);
                    }
                }
            }
        }
        self.edge_outside_cotree(&in_tree)
    }

    /// An inner edge not in the tree whose sides are joined by other ways across edges not in the tree.
    fn edge_outside_cotree(&self, in_tree: &[bool]) -> Option<(u32, u32)> {
        let triangles = self.triangle_count();
        let mut border_of = vec![0; self.vertex_count()];
        for (i, ring) in self.boundary_loops().iter().enumerate() {
            ring.iter().for_each(|&v| border_of[v as usize] = triangles + i);
        }
        // Union-find over triangles and borders.
        let mut parent: Vec<usize> = (0..triangles + self.twin.len()).collect();
        let find = |parent: &mut [usize], mut node: usize| {
            while parent[node] != node {
                parent[node] = parent[parent[node]];
                node = parent[node];
            }
            node
        };
        for h in (0..self.twin.len()).filter(|&h| !in_tree[h]) {
            let twin = self.twin[h];
            if twin != NONE && (twin as usize) < h {
                continue;
            }
            let other = if twin == NONE { border_of[self.origin[h] as usize] } else { twin as usize / 3 };
            let (a, b) = (find(&mut parent, h / 3), find(&mut parent, other));
            if a == b {
                return Some((self.origin[h], self.to(h as u32)));
            }
            parent[a] = b;
        }
        None
    }

    /// Component number of each triangle (numbered by first triangle), and how many components there are.
    /// Triangles are connected across edges; vertices without triangles are not counted.
    pub fn triangle_components(&self) -> (Vec<u32>, usize) {
        components(&self.twin)
    }

    /// Whether this is one topological disk: connected, a single boundary loop, Euler characteristic 1, and no
    /// vertex without triangles.
    pub fn is_disk(&self) -> bool {
        self.outgoing.iter().all(|&h| h != NONE)
            && self.triangle_components().1 == 1
            && self.euler_characteristic() == 1
            && self.boundary_loops().len() == 1
    }

    /// A bow-tie hides triangles from the walk around its vertex: all corners must be met once over all walks.
    fn check_fans(&self) -> Result<()> {
        let mut corners = vec![0u32; self.vertex_count()];
        for &v in &self.origin {
            corners[v as usize] += 1;
        }
        for (v, &count) in corners.iter().enumerate() {
            if self.fan(v as u32).count() != count as usize {
                return Err(CodecError::Mesh(format!("several fans of triangles meet at vertex {} (bow-tie)", v + 1)));
            }
        }
        Ok(())
    }
}

fn check_triangles(vertex_count: usize, triangles: &[[u32; 3]]) -> Result<()> {
    if vertex_count >= NONE as usize || triangles.len() >= NONE as usize / 3 {
        return Err(CodecError::Mesh(format!(
            "{vertex_count} vertices and {} triangles are more than 32-bit indices can name",
            triangles.len()
        )));
    }
    for (i, t) in triangles.iter().enumerate() {
        if let Some(v) = t.iter().find(|&&v| v as usize >= vertex_count) {
            return Err(CodecError::Mesh(format!(
                "triangle {} names vertex {}, of {vertex_count}",
                i + 1,
                u64::from(*v) + 1
            )));
        }
        if t[0] == t[1] || t[1] == t[2] || t[2] == t[0] {
            return Err(CodecError::Mesh(format!("triangle {} repeats a vertex", i + 1)));
        }
    }
    Ok(())
}

/// Pairs the half-edges of every edge with exactly two triangles, whatever their directions. Edges with more are
/// given to `crowded` (half-edges in ascending order) and stay unpaired. `origin` is the flattened triangle list.
pub(crate) fn pair_edges(vertex_count: usize, origin: &[u32], mut crowded: impl FnMut(&[u32])) -> Vec<u32> {
    let mut start = vec![0u32; vertex_count + 1];
    let ends = |t: &[u32], k: usize| (t[k], t[if k == 2 { 0 } else { k + 1 }]);
    for t in origin.chunks_exact(3) {
        for k in 0..3 {
            let (a, b) = ends(t, k);
            start[a.min(b) as usize + 1] += 1;
        }
    }
    for v in 0..vertex_count {
        start[v + 1] += start[v];
    }
    let mut fill = start.clone();
    let mut entries = vec![(0u32, 0u32); origin.len()];
    for (i, t) in origin.chunks_exact(3).enumerate() {
        for k in 0..3 {
            let (a, b) = ends(t, k);
            let slot = &mut fill[a.min(b) as usize];
            entries[*slot as usize] = (a.max(b), (3 * i + k) as u32);
            *slot += 1;
        }
    }
    let mut twin = vec![NONE; origin.len()];
    let mut group = Vec::new();
    for v in 0..vertex_count {
        let bucket = &mut entries[start[v] as usize..start[v + 1] as usize];
        pair_bucket(bucket, &mut twin, &mut group, &mut crowded);
    }
    twin
}

/// Pairs the edges of one smaller vertex: `bucket` holds (larger vertex, half-edge).
fn pair_bucket(bucket: &mut [(u32, u32)], twin: &mut [u32], group: &mut Vec<u32>, crowded: &mut impl FnMut(&[u32])) {
    if bucket.len() > SORT_ABOVE {
        bucket.sort_unstable();
    }
    let sorted = bucket.len() > SORT_ABOVE;
    for i in 0..bucket.len() {
        let (far, h) = bucket[i];
        if far == NONE {
            continue;
        }
        group.clear();
        group.push(h);
        for entry in &mut bucket[i + 1..] {
            if entry.0 == far {
                group.push(entry.1);
                entry.0 = NONE;
            } else if sorted && entry.0 != NONE {
                break;
            }
        }
        match group[..] {
            [_] => {}
            [a, b] => (twin[a as usize], twin[b as usize]) = (b, a),
            _ => crowded(group),
        }
    }
}

/// One outgoing half-edge a vertex; the boundary one wins.
fn outgoing_half_edges(vertex_count: usize, origin: &[u32], twin: &[u32]) -> Vec<u32> {
    let mut outgoing = vec![NONE; vertex_count];
    for (h, &v) in origin.iter().enumerate() {
        if outgoing[v as usize] == NONE || twin[h] == NONE {
            outgoing[v as usize] = h as u32;
        }
    }
    outgoing
}

/// Component number of each triangle, connected across paired half-edges, and the number of components.
pub(crate) fn components(twin: &[u32]) -> (Vec<u32>, usize) {
    let mut label = vec![NONE; twin.len() / 3];
    let mut count = 0;
    let mut stack = Vec::new();
    for seed in 0..label.len() {
        if label[seed] != NONE {
            continue;
        }
        label[seed] = count;
        stack.push(seed);
        while let Some(t) = stack.pop() {
            for &g in &twin[3 * t..3 * t + 3] {
                if g != NONE && label[g as usize / 3] == NONE {
                    label[g as usize / 3] = count;
                    stack.push(g as usize / 3);
                }
            }
        }
        count += 1;
    }
    (label, count as usize)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Grid of `w` x `h` quads, wrapped around in x and/or y, two triangles each.
    fn grid(w: u32, h: u32, wrap_x: bool, wrap_y: bool) -> (usize, Vec<[u32; 3]>) {
        let columns = if wrap_x { w } else { w + 1 };
        let rows = if wrap_y { h } else { h + 1 };
        let at = |x: u32, y: u32| (y % rows) * columns + x % columns;
        let mut triangles = Vec::new();
        for y in 0..h {
            for x in 0..w {
                triangles.push([at(x, y), at(x + 1, y), at(x + 1, y + 1)]);
                triangles.push([at(x, y), at(x + 1, y + 1), at(x, y + 1)]);
            }
        }
        ((columns * rows) as usize, triangles)
    }

    const OCTAHEDRON: [[u32; 3]; 8] =
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];

    fn build((vertices, triangles): (usize, Vec<[u32; 3]>)) -> HalfEdges {
        HalfEdges::build(vertices, &triangles).unwrap()
    }

    fn message(vertices: usize, triangles: &[[u32; 3]]) -> String {
        HalfEdges::build(vertices, triangles).unwrap_err().to_string()
    }

    #[test]
    fn euler_characteristic_and_loops_of_known_surfaces() {
        for (mesh, chi, loops) in [
            (build((6, OCTAHEDRON.to_vec())), 2, 0),
            (build(grid(5, 4, false, false)), 1, 1),
            (build(grid(7, 4, true, false)), 0, 2),
            (build(grid(7, 5, true, true)), 0, 0),
        ] {
            assert_eq!(mesh.euler_characteristic(), chi);
            assert_eq!(mesh.boundary_loops().len(), loops);
            assert_eq!(mesh.triangle_components().1, 1);
            assert_eq!(mesh.is_disk(), chi == 1);
            // Only the torus has a handle.
            assert_eq!(mesh.handle_edge().is_some(), chi == 0 && loops == 0);
        }
        let (vertices, mut torus) = grid(8, 6, true, true);
        torus.retain(|t| !t.contains(&11) && !t.contains(&30));
        assert!(build((vertices, torus)).handle_edge().is_some());
    }

    #[test]
    fn boundary_keeps_the_direction_of_its_triangles() {
        let mesh = build(grid(2, 1, false, false));
        assert_eq!(mesh.boundary_loops(), vec![vec![0, 1, 2, 5, 4, 3]]);
        assert_eq!(mesh.neighbours(0).collect::<Vec<_>>(), vec![1, 4, 3]);
        assert_eq!(mesh.neighbours(1).collect::<Vec<_>>(), vec![2, 5, 4, 0]);
    }

    #[test]
    fn two_pieces_and_a_lonely_vertex_are_no_disk() {
        let two = HalfEdges::build(6, &[[0, 1, 2], [3, 4, 5]]).unwrap();
        assert_eq!(two.triangle_components(), (vec![0, 1], 2));
        assert!(!two.is_disk());
        let lonely = HalfEdges::build(4, &[[0, 1, 2]]).unwrap();
        assert!(!lonely.is_disk());
        assert_eq!(lonely.fan(3).count(), 0);
        assert!(HalfEdges::build(3, &[[0, 1, 2]]).unwrap().is_disk());
        assert!(!HalfEdges::build(0, &[]).unwrap().is_disk());
    }

    #[test]
    fn broken_meshes_are_named() {
        assert!(message(5, &[[0, 1, 2], [1, 0, 3], [0, 1, 4]]).contains("edge 1-2 has 3 triangles"));
        assert!(message(4, &[[0, 1, 2], [0, 1, 3]]).contains("edge 1-2 have opposite"));
        assert!(message(5, &[[0, 1, 2], [0, 3, 4]]).contains("vertex 1 (bow-tie)"));
        assert!(message(2, &[[0, 1, 2]]).contains("triangle 1 names vertex 3"));
        assert!(message(2, &[[0, 1, 1]]).contains("triangle 1 repeats"));
        assert!(message(3, &[[0, 1, u32::MAX]]).contains("triangle 1 names vertex 4294967296"));
    }

    #[test]
    fn two_closed_surfaces_that_touch_in_a_vertex_are_refused() {
        let second = OCTAHEDRON.map(|t| t.map(|v| if v == 0 { 0 } else { v + 5 }));
        let both: Vec<_> = OCTAHEDRON.into_iter().chain(second).collect();
        assert!(message(11, &both).contains("vertex 1 (bow-tie)"));
    }

    #[test]
    fn a_hub_of_many_edges_is_paired() {
        let n = 500u32;
        let wheel: Vec<_> = (0..n).map(|i| [0, 1 + i, 1 + (i + 1) % n]).collect();
        let mesh = HalfEdges::build(n as usize + 1, &wheel).unwrap();
        assert!(mesh.is_disk());
        assert_eq!(mesh.fan(0).count(), n as usize);
    }

    proptest! {
        #[test]
        fn identities_hold_and_order_does_not_matter(
            w in 1u32..9, h in 1u32..9, order in any::<u64>(), turn in any::<u64>()
        ) {
            let (vertices, mut triangles) = grid(w, h, false, false);
            for i in (1..triangles.len()).rev() {
                triangles.swap(i, (order.rotate_left(i as u32) % (i as u64 + 1)) as usize);
                triangles[i].rotate_left((turn.rotate_left(i as u32) % 3) as usize);
            }
            let mesh = HalfEdges::build(vertices, &triangles).unwrap();
            prop_assert!(mesh.is_disk());
            prop_assert_eq!(mesh.boundary_loops()[0].len() as u32, 2 * (w + h));
            for half in 0..mesh.twin.len() as u32 {
                prop_assert_eq!(next(prev(half)), half);
                let twin = mesh.twin[half as usize];
                if twin != NONE {
                    prop_assert_eq!(mesh.twin[twin as usize], half);
                    prop_assert_eq!(mesh.from(twin), mesh.to(half));
                }
            }
            let degrees: usize = (0..vertices as u32).map(|v| mesh.neighbours(v).count()).sum();
            prop_assert_eq!(degrees, 2 * mesh.edge_count());
        }
    }
}
