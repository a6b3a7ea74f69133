//! The outer border of a surface, made smooth.

use super::RepairReport;
use crate::mesh::{HalfEdges, TriMesh, quality};
use glam::Vec3;

/// How far a border vertex may shrink the quality of its triangles while it is smoothed.
const MIN_SMOOTHED_QUALITY: f32 = 0.1;

/// Moves each border vertex half-way to the middle of its border neighbours, within its tangent plane, unless that
/// would turn or squeeze a triangle.
pub(super) fn smooth_border(
    mesh: &mut TriMesh,
    half_edges: &HalfEdges,
    border: &[u32],
    rounds: u32,
    report: &mut RepairReport,
) {
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

/// The longest of several loops, the first of equals; none when there is none.
pub(super) fn longest_loop(mesh: &TriMesh, loops: &[Vec<u32>]) -> Vec<u32> {
    let length_mm = |ring: &Vec<u32>| -> f64 {
        let point = |i: usize| mesh.positions_mm[ring[i % ring.len()] as usize];
        (0..ring.len()).map(|i| f64::from((point(i + 1) - point(i)).length())).sum()
    };
    let lengths: Vec<f64> = loops.iter().map(length_mm).collect();
    let longest = (0..loops.len()).rev().max_by(|&i, &j| lengths[i].total_cmp(&lengths[j]));
    longest.map_or_else(Vec::new, |i| loops[i].clone())
}
