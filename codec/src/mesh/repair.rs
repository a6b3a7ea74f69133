//! Makes any scan a topological disk: one piece, one boundary loop, no holes, no handles.
//!
//! Triangles are taken away first (their neighbours are unlinked, nothing is paired twice), then holes are filled,
//! the border is smoothed and the result is checked.

use super::half_edge::{HalfEdges, NONE, components, next, pair_edges, prev};
use super::{TriMesh, hole_fill::fill_hole};
use crate::{CodecError, Result};
use glam::Vec3;
use std::fmt;

/// How far a border vertex may shrink the quality of its triangles while it is smoothed.
const MIN_SMOOTHED_QUALITY: f32 = 0.1;

/// What [`to_disk`] may do.
#[derive(Debug, Clone, PartialEq)]
pub struct RepairOptions {
    /// Times that thin triangles are peeled off the border.
    pub trim_rounds: u32,
    /// Border triangles below this shape quality (1 equilateral, 0 degenerate) are peeled.
    pub min_border_quality: f32,
    /// Times that the outer border is smoothed along itself, within the tangent planes.
    pub smooth_rounds: u32,
    /// Largest hole that is filled, in boundary edges.
    pub max_hole_edges: usize,
    /// Whether a closed mesh is opened, by keeping the largest patch that faces +z; an error otherwise.
    pub open_closed: bool,
}

impl Default for RepairOptions {
    fn default() -> Self {
        Self { trim_rounds: 3, min_border_quality: 0.15, smooth_rounds: 5, max_hole_edges: 4096, open_closed: false }
    }
}

/// What [`to_disk`] did. Triangle counts are disjoint: each lost triangle is counted once.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RepairReport {
    /// Triangles that repeated a vertex or had one that is not finite.
    pub unusable_triangles: usize,
    /// Triangles on edges with more than two triangles.
    pub crowded_edge_triangles: usize,
    /// Triangles turned round, so that all agree with the majority of their piece.
    pub flipped_triangles: usize,
    /// Triangles of smaller pieces.
    pub other_piece_triangles: usize,
    /// Triangles that faced away from +z on a closed mesh.
    pub opened_triangles: usize,
    /// Slivers, teeth and whiskers at the border.
    pub border_triangles: usize,
    /// Triangles of the smaller fans where several met in one vertex.
    pub bow_tie_triangles: usize,
    /// Holes filled.
    pub holes: usize,
    /// Boundary edges of the largest of them.
    pub largest_hole_edges: usize,
    /// New vertices, the last ones of the mesh.
    pub filled_vertices: usize,
    /// New triangles, the last ones of the mesh.
    pub filled_triangles: usize,
    /// Border vertices moved.
    pub smoothed_vertices: usize,
    /// Farthest that one moved, mm.
    pub largest_move_mm: f32,
    /// For each vertex of the result its index in the input; `u32::MAX` for filled ones. Ascending otherwise.
    pub source: Vec<u32>,
}

impl RepairReport {
    /// Whether more was mended than a ragged border, which every scan has.
    pub fn has_damage(&self) -> bool {
        let counts = [
            self.unusable_triangles,
            self.crowded_edge_triangles,
            self.flipped_triangles,
            self.other_piece_triangles,
            self.opened_triangles,
            self.holes,
        ];
        counts.iter().any(|&c| c > 0)
    }
}

impl fmt::Display for RepairReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counts = [
            (self.unusable_triangles, "unusable triangles dropped"),
            (self.crowded_edge_triangles, "triangles at non-manifold edges dropped"),
            (self.flipped_triangles, "triangles turned round"),
            (self.other_piece_triangles, "triangles of other pieces dropped"),
            (self.opened_triangles, "triangles facing away dropped"),
            (self.border_triangles, "border triangles trimmed"),
            (self.bow_tie_triangles, "bow-tie triangles dropped"),
        ];
        for (count, what) in counts.into_iter().filter(|(count, _)| *count > 0) {
            write!(f, "{count} {what}, ")?;
        }
        write!(
            f,
            "{} holes filled with {} vertices (largest {} edges), {} border vertices moved by at most {:.3} mm",
            self.holes, self.filled_vertices, self.largest_hole_edges, self.smoothed_vertices, self.largest_move_mm
        )
    }
}

/// Repairs `mesh` into a topological disk: the largest piece, oriented, without non-manifold edges or vertices, its
/// border trimmed and smoothed, all boundary loops but the longest filled. Every vertex of the result is used; vertices
/// and triangles keep their order.
///
/// # Errors
/// [`CodecError::Mesh`] when indices or texture coordinates do not fit the vertices, nothing is left, the surface has
/// no consistent orientation, is closed (unless `open_closed`), has handles, or a hole is larger than allowed.
pub fn to_disk(mesh: &TriMesh, options: &RepairOptions) -> Result<(TriMesh, RepairReport)> {
    let mut report = RepairReport::default();
    let mut surface = Surface::new(mesh, &mut report)?;
    report.other_piece_triangles += surface.keep_largest_piece();
    if surface.is_closed() {
        if !options.open_closed {
            return Err(CodecError::Mesh("is closed; a scan has a border (--open-closed cuts its back away)".into()));
        }
        report.opened_triangles = surface.remove_where(|s, t| s.normal(t).z <= 0.0);
        report.other_piece_triangles += surface.keep_largest_piece();
    }
    surface.trim(options, &mut report);
    let (mut disk, source) = surface.into_mesh();
    report.source = source;
    if disk.triangles.is_empty() {
        return Err(CodecError::Mesh("no usable surface is left after repair".into()));
    }
    let border = fill_holes(&mut disk, options, &mut report)?;
    let half_edges = HalfEdges::build(disk.vertex_count(), &disk.triangles)?;
    if !half_edges.is_disk() {
        let (chi, loops) = (half_edges.euler_characteristic(), half_edges.boundary_loops().len());
        return Err(CodecError::Mesh(format!("is no disk after repair: Euler characteristic {chi}, {loops} borders")));
    }
    smooth_border(&mut disk, &half_edges, &border, options.smooth_rounds, &mut report);
    Ok((disk, report))
}

/// The input with triangles taken away.
struct Surface<'a> {
    mesh: &'a TriMesh,
    origin: Vec<u32>,
    twin: Vec<u32>,
    alive: Vec<bool>,
}

impl<'a> Surface<'a> {
    /// Usable triangles, paired and oriented; edges with more than two triangles are cut out.
    fn new(mesh: &'a TriMesh, report: &mut RepairReport) -> Result<Self> {
        check_indices(mesh)?;
        let usable = |t: &&[u32; 3]| {
            let finite = t.iter().all(|&v| mesh.positions_mm[v as usize].is_finite());
            finite && t[0] != t[1] && t[1] != t[2] && t[2] != t[0]
        };
        let triangles: Vec<[u32; 3]> = mesh.triangles.iter().filter(usable).copied().collect();
        report.unusable_triangles = mesh.triangles.len() - triangles.len();
        let origin = triangles.as_flattened().to_vec();
        let mut crowded = Vec::new();
        let twin = pair_edges(mesh.vertex_count(), &origin, |group| crowded.extend(group.iter().map(|h| h / 3)));
        let mut surface = Self { mesh, origin, twin, alive: vec![true; triangles.len()] };
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
    fn remove_where(&mut self, test: impl Fn(&Self, usize) -> bool) -> usize {
        let list: Vec<usize> = (0..self.alive.len()).filter(|&t| self.alive[t] && test(self, t)).collect();
        list.iter().filter(|&&t| self.remove(t)).count()
    }

    fn corners(&self, t: usize) -> [Vec3; 3] {
        [0, 1, 2].map(|k| self.mesh.positions_mm[self.origin[3 * t + k] as usize])
    }

    fn normal(&self, t: usize) -> Vec3 {
        let [a, b, c] = self.corners(t);
        (b - a).cross(c - a)
    }

    fn is_border_triangle(&self, t: usize) -> bool {
        self.twin[3 * t..3 * t + 3].contains(&NONE)
    }

    fn is_closed(&self) -> bool {
        let mut pieces = (0..self.alive.len()).filter(|&t| self.alive[t]).peekable();
        pieces.peek().is_some() && pieces.all(|t| !self.is_border_triangle(t))
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
    fn keep_largest_piece(&mut self) -> usize {
        let (label, count) = components(&self.twin);
        let mut sizes = vec![0usize; count];
        for (t, &piece) in label.iter().enumerate() {
            sizes[piece as usize] += usize::from(self.alive[t]);
        }
        let largest = (0..count).rev().max_by_key(|&piece| sizes[piece]).unwrap_or(0);
        self.remove_where(|_, t| label[t] as usize != largest)
    }

    /// Peels thin triangles off the borders, opens the surface (triangles without an inner vertex go, and with them
    /// teeth, whiskers and bridges), and cuts bow-ties, until nothing changes.
    fn trim(&mut self, options: &RepairOptions, report: &mut RepairReport) {
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
        let mut suspects: Vec<u32> = (0..self.mesh.vertex_count() as u32).rev().collect();
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

    fn into_mesh(self) -> (TriMesh, Vec<u32>) {
        let triangles = self.origin.chunks_exact(3).zip(&self.alive).filter(|(_, alive)| **alive);
        let kept = TriMesh {
            positions_mm: self.mesh.positions_mm.clone(),
            triangles: triangles.map(|(t, _)| [t[0], t[1], t[2]]).collect(),
            uv: self.mesh.uv.clone(),
        };
        kept.submesh(|_| true)
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
        _ => Ok(()),
    }
}

/// Shape of a triangle: 4 sqrt(3) area / sum of squared edges; 1 equilateral, 0 degenerate.
pub(crate) fn quality([a, b, c]: [Vec3; 3]) -> f32 {
    let squares = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
    2.0 * 3f32.sqrt() * (b - a).cross(c - a).length() / squares.max(f32::MIN_POSITIVE)
}

/// Fills all boundary loops but the longest, which is returned.
fn fill_holes(mesh: &mut TriMesh, options: &RepairOptions, report: &mut RepairReport) -> Result<Vec<u32>> {
    let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    let mut loops = half_edges.boundary_loops();
    let handles = (2 - loops.len() as i64 - half_edges.euler_characteristic()) / 2;
    if handles > 0 {
        return Err(CodecError::Mesh(format!("has {handles} handles; a scan seen from one side has none")));
    }
    let length_mm = |ring: &Vec<u32>| -> f64 {
        let point = |i: usize| mesh.positions_mm[ring[i % ring.len()] as usize];
        (0..ring.len()).map(|i| f64::from((point(i + 1) - point(i)).length())).sum()
    };
    let lengths: Vec<f64> = loops.iter().map(length_mm).collect();
    let longest = (0..loops.len()).rev().max_by(|&i, &j| lengths[i].total_cmp(&lengths[j]));
    let Some(longest) = longest else { return Err(CodecError::Mesh("has no border after repair".into())) };
    let border = loops.swap_remove(longest);
    let (vertices, triangles) = (mesh.vertex_count(), mesh.triangles.len());
    for ring in &loops {
        if ring.len() > options.max_hole_edges {
            return Err(CodecError::Mesh(format!(
                "hole of {} edges at vertex {} is larger than the {} that are filled",
                ring.len(),
                report.source[ring[0] as usize] + 1,
                options.max_hole_edges
            )));
        }
        fill_hole(mesh, &half_edges, ring);
    }
    report.holes = loops.len();
    report.largest_hole_edges = loops.iter().map(Vec::len).max().unwrap_or(0);
    report.filled_vertices = mesh.vertex_count() - vertices;
    report.filled_triangles = mesh.triangles.len() - triangles;
    report.source.resize(mesh.vertex_count(), NONE);
    Ok(border)
}

/// Moves each border vertex half-way to the middle of its border neighbours, within its tangent plane, unless that
/// would turn or squeeze a triangle.
fn smooth_border(mesh: &mut TriMesh, half_edges: &HalfEdges, border: &[u32], rounds: u32, report: &mut RepairReport) {
    let n = border.len();
    let before: Vec<Vec3> = border.iter().map(|&v| mesh.positions_mm[v as usize]).collect();
    for _ in 0..rounds {
        for i in 0..n {
            smooth_vertex(mesh, half_edges, [border[(i + n - 1) % n], border[i], border[(i + 1) % n]]);
        }
    }
    for (&v, old) in border.iter().zip(before) {
        let moved = (mesh.positions_mm[v as usize] - old).length();
        report.smoothed_vertices += usize::from(moved > 0.0);
        report.largest_move_mm = report.largest_move_mm.max(moved);
    }
}

fn smooth_vertex(mesh: &mut TriMesh, half_edges: &HalfEdges, [previous, v, following]: [u32; 3]) {
    let [p, here, q] = [previous, v, following].map(|v| mesh.positions_mm[v as usize]);
    let normal = half_edges.fan(v).map(|h| mesh.area_normal(h as usize / 3)).sum::<Vec3>().normalize_or_zero();
    let step = ((p + q) * 0.5 - here) * 0.5;
    let moved = here + step - normal * step.dot(normal);
    let allowed = half_edges.fan(v).all(|h| {
        let mut corners = mesh.corners(h as usize / 3);
        let (old_normal, old_quality) = (mesh.area_normal(h as usize / 3), quality(corners));
        corners[h as usize % 3] = moved;
        let [a, b, c] = corners;
        (b - a).cross(c - a).dot(old_normal) > 0.0 && quality(corners) >= MIN_SMOOTHED_QUALITY.min(old_quality)
    });
    if allowed {
        mesh.positions_mm[v as usize] = moved;
        if let Some(uv) = &mut mesh.uv {
            let [p, here, q] = [previous, v, following].map(|v| uv[v as usize]);
            uv[v as usize] = std::array::from_fn(|c| here[c] * 0.5 + (p[c] + q[c]) * 0.25);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_surfaces::sphere;
    use super::*;
    use proptest::prelude::*;

    /// Flat camera grid of 1 mm in which `seen` pixels have a vertex.
    fn scan(width: u32, height: u32, seen: impl Fn(u32, u32) -> bool) -> TriMesh {
        let pixels = (0..width * height).map(|i| (i % width, i / width));
        let mut mesh = TriMesh {
            positions_mm: pixels.clone().map(|(x, y)| Vec3::new(x as f32, y as f32, (x as f32 * 0.3).sin())).collect(),
            triangles: Vec::new(),
            uv: Some(pixels.map(|(x, y)| [x as f32 / width as f32, y as f32 / height as f32]).collect()),
        };
        for (x, y) in (0..height - 1).flat_map(|y| (0..width - 1).map(move |x| (x, y))) {
            let a = y * width + x;
            for t in [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]] {
                if t.iter().all(|&(dx, dy)| seen(x + dx, y + dy)) {
                    mesh.triangles.push(t.map(|(dx, dy)| a + dx + dy * width));
                }
            }
        }
        mesh
    }

    fn repair(mesh: &TriMesh) -> (TriMesh, RepairReport) {
        let (disk, report) = to_disk(mesh, &RepairOptions::default()).unwrap();
        disk.validate().unwrap();
        assert!(HalfEdges::build(disk.vertex_count(), &disk.triangles).unwrap().is_disk());
        assert_eq!(report.source.len(), disk.vertex_count());
        (disk, report)
    }

    fn refusal(mesh: &TriMesh) -> String {
        to_disk(mesh, &RepairOptions::default()).unwrap_err().to_string()
    }

    #[test]
    fn a_sound_disk_only_has_its_border_smoothed() {
        let whole = scan(20, 15, |_, _| true);
        let options = RepairOptions { smooth_rounds: 0, ..Default::default() };
        let (disk, report) = to_disk(&whole, &options).unwrap();
        assert_eq!(report.border_triangles, 2, "the two corners of the grid that are ears");
        assert_eq!(disk.vertex_count(), 298);
        let (_, report) = repair(&whole);
        assert!(report.smoothed_vertices > 0 && report.largest_move_mm < 1.5, "{report}");
    }

    #[test]
    fn holes_specks_whiskers_and_pinches_are_repaired() {
        let mesh = scan(60, 50, |x, y| {
            let (dx, dy) = (x as f32 - 25.0, y as f32 - 25.0);
            let face = dx.hypot(dy) < 20.0 && dx.hypot(dy - 6.0) > 5.0 && (x, y) != (14, 14);
            let whisker = (24..=25).contains(&y) && (44..50).contains(&x);
            let speck = x > 52 && y > 40;
            face || whisker || speck
        });
        let (disk, report) = repair(&mesh);
        assert!(report.other_piece_triangles > 50 && report.border_triangles >= 8, "{report}");
        assert_eq!(report.holes, 2);
        assert!(report.filled_vertices > 40 && report.largest_hole_edges > 25);
        let kept = disk.vertex_count() - report.filled_vertices;
        assert!(report.source[..kept].is_sorted() && report.source[kept..].iter().all(|&v| v == NONE));
        assert!(report.to_string().contains("2 holes filled"));
    }

    #[test]
    fn non_manifold_edges_bow_ties_and_bad_vertices_are_cut_out() {
        let mut mesh = scan(20, 20, |x, y| !(x == 10 && y < 10 || x == 11 && y == 0));
        let n = mesh.vertex_count() as u32;
        mesh.positions_mm.extend([Vec3::new(5.0, 5.0, 9.0), Vec3::new(6.0, 5.0, 9.0)]);
        mesh.uv.as_mut().unwrap().extend([[0.0; 2]; 2]);
        mesh.triangles.extend([[105, 106, n], [0, n, n + 1], [7, 7, 8]]);
        mesh.positions_mm[15 * 20 + 15].x = f32::NAN;
        let (_, report) = repair(&mesh);
        assert_eq!(report.unusable_triangles, 7);
        assert_eq!(report.crowded_edge_triangles, 3);
        assert_eq!(report.holes, 2);
    }

    #[test]
    fn the_larger_fan_of_a_bow_tie_stays() {
        let mesh = scan(30, 20, |x, y| (x <= 12 || y >= 10) && (x >= 12 || y <= 10) || (x, y) == (12, 10));
        let (disk, report) = repair(&mesh);
        assert!(report.border_triangles + report.bow_tie_triangles + report.other_piece_triangles > 0);
        assert!(disk.vertex_count() > 120);
    }

    #[test]
    fn orientation_follows_the_majority() {
        let whole = scan(20, 15, |_, _| true);
        let mut mixed = whole.clone();
        mixed.triangles.iter_mut().step_by(3).for_each(|t| t.swap(1, 2));
        let (disk, report) = repair(&mixed);
        assert_eq!(report.flipped_triangles, whole.triangles.len().div_ceil(3));
        assert!((0..disk.triangles.len()).all(|t| disk.area_normal(t).z > 0.0));
        let strip: Vec<[u32; 3]> = (0..9).map(|i| [i, (i + 1) % 9, (i + 2) % 9]).collect();
        let moebius = TriMesh { positions_mm: vec![Vec3::ZERO; 9], triangles: strip, uv: None };
        assert!(refusal(&moebius).contains("orientation"));
    }

    #[test]
    fn closed_surfaces_are_refused_or_opened() {
        let ball = sphere(12, 10.0);
        assert!(refusal(&ball).contains("closed"));
        let (half, report) = to_disk(&ball, &RepairOptions { open_closed: true, ..Default::default() }).unwrap();
        assert!(report.opened_triangles >= ball.triangles.len() / 2);
        assert!(half.positions_mm.iter().all(|p| p.z > -2.0));
    }

    #[test]
    fn handles_oversized_holes_and_nonsense_are_refused() {
        let mut torus = TriMesh::default();
        for y in 0..12u32 {
            for x in 0..12u32 {
                torus.positions_mm.push(Vec3::new(x as f32, y as f32, (x * y) as f32 * 0.1));
                let at = |dx: u32, dy: u32| (x + dx) % 12 + (y + dy) % 12 * 12;
                torus.triangles.extend([[at(0, 0), at(1, 0), at(1, 1)], [at(0, 0), at(1, 1), at(0, 1)]]);
            }
        }
        torus.triangles.retain(|t| !t.contains(&66));
        assert!(refusal(&torus).contains("1 handles"));
        let holed = scan(30, 30, |x, y| x.abs_diff(15).max(y.abs_diff(15)) > 5);
        let options = RepairOptions { max_hole_edges: 10, ..Default::default() };
        assert!(to_disk(&holed, &options).unwrap_err().to_string().contains("larger than the 10"));
        assert!(refusal(&TriMesh::default()).contains("no usable surface"));
        let far = TriMesh { positions_mm: vec![Vec3::ZERO; 3], triangles: vec![[0, 1, 3]], uv: None };
        assert!(refusal(&far).contains("triangle 1"));
    }

    proptest! {
        #[test]
        fn random_masks_become_disks(
            noise in proptest::collection::vec(0u32..100, 900), threshold in 1u32..25, drop in 0usize..40,
        ) {
            let mut mesh = scan(30, 30, |x, y| noise[(y * 30 + x) as usize] >= threshold);
            mesh.triangles.iter_mut().take(drop).for_each(|t| t.rotate_left(1));
            if let Ok((disk, report)) = to_disk(&mesh, &RepairOptions::default()) {
                prop_assert!(disk.validate().is_ok());
                let half_edges = HalfEdges::build(disk.vertex_count(), &disk.triangles).unwrap();
                prop_assert!(half_edges.is_disk());
                let lost = report.border_triangles + report.bow_tie_triangles + report.other_piece_triangles;
                prop_assert_eq!(mesh.triangles.len() - lost + report.filled_triangles, disk.triangles.len());
            } else {
                prop_assert!(false, "a planar grid can always be repaired");
            }
        }

        #[test]
        fn random_triangles_never_panic(
            triangles in proptest::collection::vec(prop::array::uniform3(0u32..24), 0..80)
        ) {
            let positions_mm = (0..24).map(|i| Vec3::new((i % 5) as f32, (i / 5) as f32, (i * 7 % 3) as f32)).collect();
            let mesh = TriMesh { positions_mm, triangles, uv: None };
            let options = RepairOptions { open_closed: true, ..Default::default() };
            if let Ok((disk, _)) = to_disk(&mesh, &options) {
                prop_assert!(HalfEdges::build(disk.vertex_count(), &disk.triangles).unwrap().is_disk());
            }
        }
    }
}
