//! A surface from which triangles are taken away: pieces, orientation, thin borders, bow-ties.
//!
//! Taking a triangle away unlinks its neighbours; nothing is paired twice.

use super::{RepairOptions, RepairReport};
use crate::mesh::half_edge::{HalfEdges, NONE, components, next, pair_edges, prev};
use crate::mesh::{TriMesh, quality};
use crate::{CodecError, Result};
use glam::{Vec3, Vec4};

/// The input with triangles taken away.
pub(super) struct Surface<'a> {
    mesh: &'a TriMesh,
    origin: Vec<u32>,
    twin: Vec<u32>,
    alive: Vec<bool>,
}

impl<'a> Surface<'a> {
    /// Usable triangles, paired and oriented; edges with more than two triangles are cut out.
    pub(super) fn new(mesh: &'a TriMesh, report: &mut RepairReport) -> Result<Self> {
        check_indices(mesh)?;
        let all_finite = mesh.positions_mm.iter().all(|p| p.is_finite());
        let finite = |t: &[u32; 3]| all_finite || t.iter().all(|&v| mesh.positions_mm[v as usize].is_finite());
        let mut origin = Vec::with_capacity(3 * mesh.triangles.len());
        for t in mesh.triangles.iter().filter(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0] && finite(t)) {
            origin.extend(t);
        }
        let triangles = origin.len() / 3;
        report.unusable_triangles = mesh.triangles.len() - triangles;
        let mut crowded = Vec::new();
        let twin = pair_edges(mesh.vertex_count(), &origin, |group| crowded.extend(group.iter().map(|h| h / 3)));
        let mut surface = Self { mesh, origin, twin, alive: vec![true; triangles] };
        report.crowded_edge_triangles = crowded.into_iter().filter(|&t| surface.remove(t as usize)).count();
        report.flipped_triangles = surface.orient()?;
        Ok(surface)
    }

    /// Takes triangle `t` away; false when it was gone already.
    fn remove(&mut self, t: usize) -> bool {
        for h in 3 * t..3 * t + 3 {
            let twin = std::mem::replace(&mut self.twin[h], NONE);
            if twin != NONE {
                self.twin[twin as usize] = NONE;
            }
        }
        std::mem::replace(&mut self.alive[t], false)
    }

    /// Takes away every triangle for which `test` holds on the surface as it is now.
    pub(super) fn remove_where(&mut self, test: impl Fn(&Self, usize) -> bool) -> usize {
        let list: Vec<usize> = (0..self.alive.len()).filter(|&t| self.alive[t] && test(self, t)).collect();
        list.iter().filter(|&&t| self.remove(t)).count()
    }

    fn corners(&self, t: usize) -> [Vec3; 3] {
        [0, 1, 2].map(|k| self.mesh.positions_mm[self.origin[3 * t + k] as usize])
    }

    pub(super) fn normal(&self, t: usize) -> Vec3 {
        let [a, b, c] = self.corners(t);
        (b - a).cross(c - a)
    }

    fn is_border_triangle(&self, t: usize) -> bool {
        self.twin[3 * t..3 * t + 3].contains(&NONE)
    }

    pub(super) fn is_closed(&self) -> bool {
        let mut pieces = (0..self.alive.len()).filter(|&t| self.alive[t]).peekable();
        pieces.peek().is_some() && pieces.all(|t| !self.is_border_triangle(t))
    }

    /// Why a closed surface is refused, with an edge that shows it.
    pub(super) fn closed_message(&self) -> String {
        let h = 3 * self.alive.iter().position(|&alive| alive).unwrap_or(0);
        let (a, b) = (self.origin[h] + 1, self.origin[h + 1] + 1);
        format!(
            "is closed: edge {a}-{b}, like all others, has two triangles; a scan has a border (--open-closed cuts its back away)"
        )
    }

    /// Turns triangles round until neighbours agree, the majority of every piece unturned; how many were turned.
    fn orient(&mut self) -> Result<usize> {
        let same = |s: &Self, h: usize| s.twin[h] != NONE && s.origin[s.twin[h] as usize] == s.origin[h];
        if !(0..self.twin.len()).any(|h| same(self, h)) {
            return Ok(0);
        }
        let mut turned: Vec<Option<bool>> = vec![None; self.alive.len()];
        for seed in 0..self.alive.len() {
            if turned[seed].is_some() {
                continue;
            }
            turned[seed] = Some(false);
            let mut piece = vec![seed];
            let mut reached = 0;
            while let Some(&t) = piece.get(reached) {
                reached += 1;
                for h in (3 * t..3 * t + 3).filter(|&h| self.twin[h] != NONE) {
                    let other = self.twin[h] as usize / 3;
                    let wanted = turned[t].map(|turned| turned != same(self, h));
                    if turned[other].is_none() {
                        turned[other] = wanted;
                        piece.push(other);
                    } else if turned[other] != wanted {
                        return Err(CodecError::Mesh(format!(
                            "has no consistent orientation (like a Möbius strip) near vertex {}",
                            self.origin[h] + 1
                        )));
                    }
                }
            }
            if 2 * piece.iter().filter(|&&t| turned[t] == Some(true)).count() > piece.len() {
                piece.iter().for_each(|&t| turned[t] = turned[t].map(|turned| !turned));
            }
        }
        let count = (0..turned.len()).filter(|&t| turned[t] == Some(true) && self.alive[t]).count();
        self.turn(|t| turned[t] == Some(true));
        Ok(count)
    }

    /// Swaps corners 1 and 2 of triangles: half-edges 0 and 2 change places.
    fn turn(&mut self, turned: impl Fn(usize) -> bool) {
        let moved = |h: u32| if turned(h as usize / 3) { h / 3 * 3 + (2 - h % 3) } else { h };
        for twin in self.twin.iter_mut().filter(|twin| **twin != NONE) {
            *twin = moved(*twin);
        }
        for t in (0..self.alive.len()).filter(|&t| turned(t)) {
            self.origin.swap(3 * t + 1, 3 * t + 2);
            self.twin.swap(3 * t, 3 * t + 2);
        }
    }

    /// Drops every piece but that with the most triangles, the first of equals.
    pub(super) fn keep_largest_piece(&mut self) -> usize {
        let (label, count) = components(&self.twin);
        let mut sizes = vec![0usize; count];
        for (t, &piece) in label.iter().enumerate() {
            sizes[piece as usize] += usize::from(self.alive[t]);
        }
        let largest = (0..count).rev().max_by_key(|&piece| sizes[piece]).unwrap_or(0);
        self.remove_where(|_, t| label[t] as usize != largest)
    }

    /// Takes away what stands in the way of a map inside the surface; holes are left, to be filled afresh: the triangles
    /// around spikes, vertices far from the middle of their neighbours for the size of the ring these form, then those
    /// around the blunt corner of slivers.
    pub(super) fn cut_spikes_and_slivers(&mut self, options: &RepairOptions, report: &mut RepairReport) {
        let (rings, slivers) = self.rings_and_slivers(options.min_inner_quality);
        let spike = |v: u32| {
            let (away, length) = (rings[v as usize].truncate(), rings[v as usize].w);
            away.length_squared() > (options.max_spike_ratio * 2.0 * length).powi(2)
        };
        let mut cut: Vec<bool> = (0..self.mesh.vertex_count() as u32).map(spike).collect();
        report.spike_triangles += self.remove_around(&cut);
        cut.fill(false);
        for t in slivers.into_iter().filter(|&t| self.alive[t]) {
            let [a, b, c] = self.corners(t);
            let opposite2 = [b.distance_squared(c), c.distance_squared(a), a.distance_squared(b)];
            let blunt = (1..3).fold(0, |best, k| if opposite2[k] >= opposite2[best] { k } else { best });
            cut[self.origin[3 * t + blunt] as usize] = true;
        }
        report.sliver_triangles += self.remove_around(&cut);
    }

    /// For each vertex the sum of the edges that leave it, each as often as a triangle has it, and the length of the edges
    /// across from it; and the triangles of a shape quality below `min_quality`.
    fn rings_and_slivers(&self, min_quality: f32) -> (Vec<Vec4>, Vec<usize>) {
        let mut rings = vec![Vec4::ZERO; self.mesh.vertex_count()];
        let mut slivers = Vec::new();
        for t in (0..self.alive.len()).filter(|&t| self.alive[t]) {
            let [a, b, c] = self.corners(t);
            let [ab, bc, ca] = [b - a, c - b, a - c];
            let squares = [bc, ca, ab].map(Vec3::length_squared);
            for (k, away) in [ab - ca, bc - ab, ca - bc].into_iter().enumerate() {
                rings[self.origin[3 * t + k] as usize] += away.extend(squares[k].sqrt());
            }
            // Quality below the least, without a root.
            let least = min_quality * (squares[0] + squares[1] + squares[2]);
            if 12.0 * ab.cross(bc).length_squared() < least * least {
                slivers.push(t);
            }
        }
        (rings, slivers)
    }

    fn remove_around(&mut self, cut: &[bool]) -> usize {
        if !cut.contains(&true) {
            return 0;
        }
        self.remove_where(|s, t| (3 * t..3 * t + 3).any(|h| cut[s.origin[h] as usize]))
    }

    /// Peels thin triangles off the borders, opens the surface (triangles without an inner vertex go, and with them
    /// teeth, whiskers and bridges), and cuts bow-ties, until nothing changes.
    pub(super) fn trim(&mut self, options: &RepairOptions, report: &mut RepairReport) {
        for _ in 0..options.trim_rounds {
            let thin =
                |s: &Self, t: usize| s.is_border_triangle(t) && quality(s.corners(t)) < options.min_border_quality;
            let removed = self.remove_where(thin);
            report.border_triangles += removed;
            if removed == 0 {
                break;
            }
        }
        loop {
            report.border_triangles += self.open();
            report.other_piece_triangles += self.keep_largest_piece();
            let cut = self.cut_bow_ties();
            report.bow_tie_triangles += cut;
            if cut == 0 {
                return;
            }
        }
    }

    /// Morphological opening by one ring; a surface without any inner vertex stays as it is.
    fn open(&mut self) -> usize {
        let mut inner = vec![true; self.mesh.vertex_count()];
        for h in (0..self.twin.len()).filter(|&h| self.alive[h / 3] && self.twin[h] == NONE) {
            inner[self.origin[h] as usize] = false;
            inner[self.origin[next(h as u32) as usize] as usize] = false;
        }
        let has_inner = |s: &Self, t: usize| (3 * t..3 * t + 3).any(|h| inner[s.origin[h] as usize]);
        if !(0..self.alive.len()).any(|t| self.alive[t] && has_inner(self, t)) {
            return 0;
        }
        self.remove_where(|s, t| !has_inner(s, t))
    }

    /// Where several fans meet in a vertex keeps the largest, the first of equals.
    fn cut_bow_ties(&mut self) -> usize {
        let mut suspects = self.bow_ties();
        if suspects.is_empty() {
            return 0;
        }
        suspects.reverse();
        let mut start = vec![0u32; self.mesh.vertex_count() + 1];
        let alive_corners = || (0..self.origin.len()).filter(|&h| self.alive[h / 3]);
        alive_corners().for_each(|h| start[self.origin[h] as usize + 1] += 1);
        for v in 0..self.mesh.vertex_count() {
            start[v + 1] += start[v];
        }
        let (mut fill, mut corners) = (start.clone(), vec![0u32; start[self.mesh.vertex_count()] as usize]);
        for h in alive_corners() {
            let slot = &mut fill[self.origin[h] as usize];
            corners[*slot as usize] = h as u32;
            *slot += 1;
        }
        let mut removed = 0;
        while let Some(v) = suspects.pop() {
            let around = &corners[start[v as usize] as usize..start[v as usize + 1] as usize];
            let Some(keep) = self.largest_fan(around) else { continue };
            for &h in around.iter().filter(|h| !keep.contains(h)) {
                let t = h as usize / 3;
                if self.remove(t) {
                    removed += 1;
                    suspects.extend(&self.origin[3 * t..3 * t + 3]);
                }
            }
        }
        removed
    }

    /// Vertices with more triangles than one walk round them meets, ascending.
    fn bow_ties(&self) -> Vec<u32> {
        let mut corners = vec![0u32; self.mesh.vertex_count()];
        let mut outgoing = vec![NONE; self.mesh.vertex_count()];
        for h in (0..self.origin.len()).filter(|&h| self.alive[h / 3]) {
            let v = self.origin[h] as usize;
            corners[v] += 1;
            if outgoing[v] == NONE || self.twin[h] == NONE {
                outgoing[v] = h as u32;
            }
        }
        let walk = |first: u32| {
            let onward = move |&h: &u32| Some(self.twin[prev(h) as usize]).filter(|&h| h != NONE && h != first);
            std::iter::successors(Some(first), onward).count()
        };
        let tied = |&v: &u32| {
            let (count, first) = (corners[v as usize], outgoing[v as usize]);
            count > 0 && walk(first) != count as usize
        };
        (0..self.mesh.vertex_count() as u32).filter(tied).collect()
    }

    /// Half-edges of the largest fan among those that leave one vertex; `None` when there is but one fan.
    fn largest_fan(&self, around: &[u32]) -> Option<Vec<u32>> {
        let alive = |h: &&u32| self.alive[**h as usize / 3];
        let count = around.iter().filter(alive).count();
        let first = *around.iter().find(alive)?;
        if self.fan(first).count() == count {
            return None;
        }
        let mut fans: Vec<Vec<u32>> = Vec::new();
        for &h in around.iter().filter(alive) {
            if !fans.iter().any(|fan| fan.contains(&h)) {
                fans.push(self.fan(h).collect());
            }
        }
        fans.into_iter().rev().max_by_key(Vec::len)
    }

    /// All half-edges that leave the vertex of `h` in its fan.
    fn fan(&self, h: u32) -> impl Iterator<Item = u32> + '_ {
        let clockwise = |h: u32| Some(self.twin[h as usize]).filter(|&twin| twin != NONE).map(next);
        let mut first = h;
        while let Some(back) = clockwise(first) {
            first = back;
            if back == h {
                break;
            }
        }
        std::iter::successors(Some(first), move |&h| {
            Some(self.twin[prev(h) as usize]).filter(|&onward| onward != NONE && onward != first)
        })
    }

    /// What is left, without unused vertices, its connectivity, and for each vertex its index in the input.
    pub(super) fn into_mesh(self) -> (TriMesh, HalfEdges, Vec<u32>) {
        let mut new_vertex = vec![NONE; self.mesh.vertex_count()];
        for (corners, _) in self.origin.chunks_exact(3).zip(&self.alive).filter(|(_, alive)| **alive) {
            corners.iter().for_each(|&v| new_vertex[v as usize] = 0);
        }
        let mut source = Vec::with_capacity(new_vertex.len());
        for (v, new) in (0..).zip(&mut new_vertex).filter(|(_, new)| **new == 0) {
            *new = source.len() as u32;
            source.push(v);
        }
        let half_edge = |h: usize| (self.origin[h], self.twin[h]);
        let half_edges = HalfEdges::of_kept(&self.alive, half_edge, &new_vertex, source.len());
        let mesh = TriMesh {
            positions_mm: source.iter().map(|&v| self.mesh.positions_mm[v as usize]).collect(),
            triangles: half_edges.origin.as_chunks::<3>().0.to_vec(),
            uv: self.mesh.uv.as_ref().map(|uv| source.iter().map(|&v| uv[v as usize]).collect()),
        };
        (mesh, half_edges, source)
    }
}

fn check_indices(mesh: &TriMesh) -> Result<()> {
    let n = mesh.vertex_count();
    if n >= NONE as usize || mesh.triangles.len() >= NONE as usize / 3 {
        return Err(CodecError::Mesh(format!("{n} vertices are more than 32-bit indices can name")));
    }
    if let Some(t) = mesh.triangles.iter().position(|t| t.iter().any(|&v| v as usize >= n)) {
        return Err(CodecError::Mesh(format!("triangle {} names a vertex beyond the {n} there are", t + 1)));
    }
    match &mesh.uv {
        Some(uv) if uv.len() != n => {
            Err(CodecError::Mesh(format!("{} texture coordinates for {n} vertices", uv.len())))
        }
        Some(uv) => match uv.iter().position(|uv| !(uv[0].is_finite() && uv[1].is_finite())) {
            Some(i) => Err(CodecError::Mesh(format!("texture coordinate {} is not finite", i + 1))),
            None => Ok(()),
        },
        None => Ok(()),
    }
}
