//! Intrinsic triangulation: edge lengths only, flipped until Delaunay (Fisher, Springborn, Schröder, Bobenko 2007).

use super::half_edge::{NONE, next, prev};
use crate::{CodecError, Result};

/// Cotangent sums below this make an edge flip; not zero, so that cocircular points end the loop.
const DELAUNAY_SLACK: f64 = -1e-9;

/// Every triangle inequality holds with at least this share of the mean edge to spare after [`IntrinsicMesh::mollify`].
const MOLLIFIER: f64 = 1e-6;

/// Most flips a half-edge: scans take a fraction of one, rounding cycles and surfaces made to be slow take all.
const FLIPS_PER_HALF_EDGE: usize = 8;

/// Triangulation known by its edge lengths. Half-edge `h = 3 t + k` leaves corner `k` of triangle `t`.
#[derive(Debug, Clone)]
pub struct IntrinsicMesh {
    /// Vertex each half-edge leaves from.
    pub origin: Vec<u32>,
    /// Opposite half-edge or [`NONE`].
    pub twin: Vec<u32>,
    /// Length of each half-edge's edge.
    pub length: Vec<f64>,
    /// Vertices, those made by [`Self::split`] included.
    pub vertex_count: usize,
}

impl IntrinsicMesh {
    /// From an embedded mesh: `twin` as in [`super::HalfEdges`].
    pub fn new(mesh: &super::TriMesh, twin: &[u32]) -> Self {
        let origin: Vec<u32> = mesh.triangles.iter().flatten().copied().collect();
        let at = |v: u32| mesh.positions_mm[v as usize].as_dvec3();
        let length =
            (0..origin.len() as u32).map(|h| at(origin[h as usize]).distance(at(origin[next(h) as usize]))).collect();
        Self { origin, twin: twin.to_vec(), length, vertex_count: mesh.vertex_count() }
    }

    /// Makes every edge longer by the same amount, the least that leaves no triangle degenerate (Sharp, Crane 2020, "A
    /// Laplacian for nonmanifold triangle meshes", section 4.5); nothing where none is.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when all edges have length zero.
    pub fn mollify(&mut self) -> Result<()> {
        let mean = self.length.iter().sum::<f64>() / self.length.len().max(1) as f64;
        if mean <= 0.0 {
            return Err(CodecError::Mesh("the whole surface lies in one point".into()));
        }
        let spare = |t: &[f64]| t[0] + t[1] + t[2] - 2.0 * t[0].max(t[1]).max(t[2]);
        let least = self.length.chunks_exact(3).map(spare).fold(f64::INFINITY, f64::min);
        let longer = (MOLLIFIER * mean - least).max(0.0);
        self.length.iter_mut().for_each(|l| *l += longer);
        Ok(())
    }

    /// Vertex the half-edge points to.
    pub fn target(&self, h: u32) -> u32 {
        self.origin[next(h) as usize]
    }

    /// Vertex opposite the half-edge in its triangle.
    pub fn apex(&self, h: u32) -> u32 {
        self.origin[prev(h) as usize]
    }

    /// Area of the triangle of `h` by Kahan's stable form of Heron's formula, floored so that cotangents stay finite.
    pub fn area(&self, h: u32) -> f64 {
        let [x, y, z] = [h, next(h), prev(h)].map(|e| self.length[e as usize]);
        let (low, high) = (x.min(y), x.max(y));
        let [a, b, c] = [high.max(z), low.max(high.min(z)), low.min(z)];
        let s = (a + (b + c)) * (c - (a - b)) * (c + (a - b)) * (a + (b - c));
        (0.25 * s.max(0.0).sqrt()).max(1e-10 * a * a)
    }

    /// Cotangent of the angle opposite `h` in its triangle: (b^2 + c^2 - a^2) / (4 A).
    pub fn cotangent(&self, h: u32) -> f64 {
        let [a, b, c] = [h, next(h), prev(h)].map(|e| self.length[e as usize]);
        (b * b + c * c - a * a) / (4.0 * self.area(h))
    }

    /// Cotangents opposite all half-edges, the area of each triangle taken once.
    pub fn cotangents(&self) -> Vec<f64> {
        let mut cotangents = Vec::with_capacity(self.length.len());
        for (t, length) in self.length.chunks_exact(3).enumerate() {
            let four_areas = 4.0 * self.area(3 * t as u32);
            let [a, b, c] = [length[0] * length[0], length[1] * length[1], length[2] * length[2]];
            cotangents.extend([(b + c - a) / four_areas, (c + a - b) / four_areas, (a + b - c) / four_areas]);
        }
        cotangents
    }

    /// Flips edges until every interior edge is Delaunay; returns the number of flips.
    pub fn make_delaunay(&mut self) -> usize {
        let cotangents = self.cotangents();
        let inner = |&(h, &g): &(usize, &u32)| g != NONE && h < g as usize;
        let bad = |&(h, &g): &(usize, &u32)| cotangents[h] + cotangents[g as usize] < DELAUNAY_SLACK;
        let mut stack: Vec<u32> =
            self.twin.iter().enumerate().filter(inner).filter(bad).map(|(h, _)| h as u32).collect();
        let mut queued = vec![false; self.twin.len()];
        for &h in &stack {
            queued[h as usize] = true;
        }
        let most = FLIPS_PER_HALF_EDGE * self.origin.len() + 64;
        let mut flips = 0;
        while let Some(h) = stack.pop() {
            queued[h as usize] = false;
            let other = self.twin[h as usize];
            if other == NONE || self.cotangent(h) + self.cotangent(other) >= DELAUNAY_SLACK || flips >= most {
                continue;
            }
            if self.flip(h) {
                flips += 1;
                let other = self.twin[h as usize];
                for e in [next(h), prev(h), next(other), prev(other)] {
                    if !std::mem::replace(&mut queued[e as usize], true) {
                        stack.push(e);
                    }
                }
            }
        }
        flips
    }

    /// Replaces the diagonal of the two triangles at `h` by the other one; false when the quadrilateral degenerates.
    fn flip(&mut self, h: u32) -> bool {
        let g = self.twin[h as usize];
        // h: a -> b in (a, b, c); g: b -> a in (b, a, d).
        let (bc, ca, ad, db) = (next(h), prev(h), next(g), prev(g));
        if bc / 3 == g / 3 {
            return false;
        }
        let l = self.length[h as usize];
        let [lbc, lca, lad, ldb] = [bc, ca, ad, db].map(|e| self.length[e as usize]);
        let cx = (lca * lca + l * l - lbc * lbc) / (2.0 * l);
        let dx = (lad * lad + l * l - ldb * ldb) / (2.0 * l);
        let diagonal = libm::hypot(cx - dx, 2.0 * (self.area(h) + self.area(g)) / l);
        let (a, b, c, d) = (self.origin[h as usize], self.origin[g as usize], self.apex(h), self.apex(g));
        if !diagonal.is_finite() {
            return false;
        }
        let outer = [bc, ca, ad, db].map(|e| (self.twin[e as usize], self.length[e as usize]));
        // Triangle of h becomes (c, d, b), that of g becomes (d, c, a); h and g stay the diagonal.
        let (h1, h2, g1, g2) = (next(h), prev(h), next(g), prev(g));
        for (e, v) in [(h, c), (h1, d), (h2, b), (g, d), (g1, c), (g2, a)] {
            self.origin[e as usize] = v;
        }
        self.length[h as usize] = diagonal;
        self.length[g as usize] = diagonal;
        let [old_bc, old_ca, old_ad, old_db] = outer;
        // An outer edge may be glued to another outer edge of the same pair: map such twins to their new places.
        let moved = |t: u32| match t {
            t if t == bc => h2,
            t if t == ca => g1,
            t if t == ad => g2,
            t if t == db => h1,
            t => t,
        };
        for (e, (t, len)) in [(h1, old_db), (h2, old_bc), (g1, old_ca), (g2, old_ad)] {
            self.length[e as usize] = len;
            let t = if t == NONE { t } else { moved(t) };
            self.twin[e as usize] = t;
            if t != NONE {
                self.twin[t as usize] = e;
            }
        }
        true
    }

    /// Splits interior edge `h` at its middle; the new vertex has the next free index. Returns it.
    pub fn split(&mut self, h: u32) -> u32 {
        let middle = self.vertex_count as u32;
        self.vertex_count += 1;
        let g = self.twin[h as usize];
        let half = 0.5 * self.length[h as usize];
        let (h_new, g_new) = (self.cut_corner(h, middle, half), self.cut_corner(g, middle, half));
        // h and g are now the halves that leave a and b; the new half-edges leave the middle.
        self.glue(h, g_new);
        self.glue(g, h_new);
        middle
    }

    /// Cuts triangle (a, b, c) of `h` = a->b into (a, m, c) and a new (m, b, c); returns the new half-edge m->b.
    fn cut_corner(&mut self, h: u32, middle: u32, half: f64) -> u32 {
        let (bc, ca) = (next(h), prev(h));
        let (b, c) = (self.origin[bc as usize], self.origin[ca as usize]);
        let [l, lbc, lca] = [h, bc, ca].map(|e| self.length[e as usize]);
        let median = (0.25 * (2.0 * (lbc * lbc + lca * lca) - l * l)).max(0.0).sqrt();
        let outer_bc = self.twin[bc as usize];
        let new = self.origin.len() as u32;
        self.origin.extend([middle, b, c]);
        self.length.extend([half, lbc, median]);
        self.twin.extend([NONE; 3]);
        self.length[h as usize] = half;
        self.length[bc as usize] = median;
        self.origin[bc as usize] = middle;
        if outer_bc == NONE {
            self.twin[new as usize + 1] = NONE;
        } else {
            self.glue(new + 1, outer_bc);
        }
        self.glue(bc, new + 2);
        new
    }

    fn glue(&mut self, h: u32, g: u32) {
        self.twin[h as usize] = g;
        self.twin[g as usize] = h;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{HalfEdges, TriMesh};
    use glam::Vec3;
    use proptest::prelude::*;

    /// A jittered grid whose triangles are poor enough to flip.
    fn grid(n: usize, seed: u64) -> TriMesh {
        let mut state = seed | 1;
        let mut noise = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5
        };
        let positions_mm = (0..n * n)
            .map(|i| Vec3::new((i % n) as f32 + 0.8 * noise(), (i / n) as f32 * 0.3 + 0.2 * noise(), noise()))
            .collect();
        let triangles = (0..n - 1)
            .flat_map(|y| (0..n - 1).map(move |x| (y * n + x) as u32))
            .flat_map(|a| [[a, a + 1, a + n as u32 + 1], [a, a + n as u32 + 1, a + n as u32]])
            .collect();
        TriMesh { positions_mm, triangles, uv: None }
    }

    fn check(m: &IntrinsicMesh) {
        for h in 0..m.twin.len() as u32 {
            let g = m.twin[h as usize];
            if g != NONE {
                assert_eq!(m.twin[g as usize], h);
                assert_eq!(m.origin[h as usize], m.target(g));
                assert!((m.length[h as usize] - m.length[g as usize]).abs() < 1e-9);
            }
        }
    }

    proptest! {
        #[test]
        fn flipping_ends_delaunay_with_weights_not_negative(seed in 0u64..200) {
            let mesh = grid(9, seed);
            let he = HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap();
            let mut m = IntrinsicMesh::new(&mesh, &he.twin);
            let area: f64 = (0..m.twin.len() as u32).step_by(3).map(|h| m.area(h)).sum();
            prop_assert!(m.make_delaunay() > 0);
            check(&m);
            let cotangents = m.cotangents();
            for (h, &g) in m.twin.iter().enumerate().filter(|(_, g)| **g != NONE) {
                prop_assert!(cotangents[h] + cotangents[g as usize] >= -2e-8);
                prop_assert!((cotangents[h] - m.cotangent(h as u32)).abs() <= 1e-12 * cotangents[h].abs().max(1.0));
            }
            // Flipping keeps lengths in the cone metric, so a flat pair keeps its area exactly.
            let after: f64 = (0..m.twin.len() as u32).step_by(3).map(|h| m.area(h)).sum();
            prop_assert!((after - area).abs() < 1e-6 * area);
        }
    }

    #[test]
    fn splitting_keeps_area_and_topology() {
        let mesh = grid(4, 3);
        let he = HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap();
        let mut m = IntrinsicMesh::new(&mesh, &he.twin);
        let total = |m: &IntrinsicMesh| (0..m.twin.len() as u32).step_by(3).map(|h| m.area(h)).sum::<f64>();
        let before = total(&m);
        let inner = (0..m.twin.len() as u32).find(|&h| m.twin[h as usize] != NONE).unwrap();
        let v = m.split(inner);
        assert_eq!(v as usize + 1, m.vertex_count);
        check(&m);
        assert!((total(&m) - before).abs() < 1e-6 * before);
        assert_eq!(m.origin.iter().filter(|&&o| o == v).count(), 4);
    }
}
