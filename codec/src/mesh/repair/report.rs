//! What a repair did.

use std::fmt;

/// What [`super::to_disk`] did. Triangle counts are disjoint: each lost triangle is counted once.
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
    /// Triangles around spikes inside the surface, filled afresh.
    pub spike_triangles: usize,
    /// Triangles around the blunt corners of slivers inside the surface, filled afresh.
    pub sliver_triangles: usize,
    /// Triangles beyond the smooth curve along which the border was clipped.
    pub clipped_triangles: usize,
    /// Holes filled.
    pub holes: usize,
    /// Boundary edges of the largest of them.
    pub largest_hole_edges: usize,
    /// New vertices in holes, the last ones of the mesh.
    pub filled_vertices: usize,
    /// New triangles, the last ones of the mesh.
    pub filled_triangles: usize,
    /// Border vertices moved.
    pub smoothed_vertices: usize,
    /// Farthest that one moved, mm.
    pub largest_move_mm: f32,
    /// For each vertex of the result its index in the input; `u32::MAX` for filled ones and those on a clipped border. Ascending otherwise.
    pub source: Vec<u32>,
}

impl RepairReport {
    /// Number in the input, from 1, of the first vertex of `ring` that was in it.
    pub(super) fn first_known(&self, ring: &[u32]) -> Option<String> {
        ring.iter().map(|&v| self.source[v as usize]).find(|&v| v != u32::MAX).map(|v| (v + 1).to_string())
    }

    /// Whether more was mended than a ragged border, which every scan has.
    pub fn has_damage(&self) -> bool {
        let counts = [
            self.unusable_triangles,
            self.crowded_edge_triangles,
            self.flipped_triangles,
            self.other_piece_triangles,
            self.opened_triangles,
            self.spike_triangles,
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
            (self.spike_triangles, "triangles around spikes made anew"),
            (self.sliver_triangles, "triangles around slivers made anew"),
            (self.clipped_triangles, "triangles clipped off a ragged border"),
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
