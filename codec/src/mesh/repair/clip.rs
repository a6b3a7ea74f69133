//! Clips a staircase border along a smooth curve: a level set of the smoothed depth below the border.
//!
//! Crossings near a vertex are snapped to it: the vertex moves onto the curve, and no sliver is made.

use super::border::longest_loop;
use crate::mesh::half_edge::{NONE, next};
use crate::mesh::{HalfEdges, TriMesh};

/// Rings of vertices below the border in which depth is told apart.
const RINGS: u8 = 6;
/// Rounds of averaging that smooth the depth, over about the root of it in vertices.
const SMOOTH_ROUNDS: usize = 8;
/// Share of the border that lies above the curve; the rest is deep enough in notches to stay as it is.
const CLIPPED_SHARE: f64 = 0.9;
/// Crossings nearer to a vertex than this share of their edge move it.
const SNAP: f32 = 0.3;

/// The mesh below the curve, and for each of its vertices the index before, [`NONE`] for new ones, which come last.
/// Moved vertices keep theirs. Only the longest border is clipped.
pub(super) fn clip_border(mesh: &TriMesh, half_edges: &HalfEdges) -> (TriMesh, Vec<u32>) {
    let mut depth = smooth_depth(half_edges, &longest_loop(mesh, &half_edges.boundary_loops()));
    let mut clipped = mesh.clone();
    snap(&mut clipped, half_edges, &mut depth);
    let triangles = cut(&mut clipped, half_edges, &depth);
    clipped.triangles = triangles;
    let (clipped, mut source) = clipped.submesh(|_| true);
    source.iter_mut().filter(|v| **v as usize >= mesh.vertex_count()).for_each(|v| *v = NONE);
    (clipped, source)
}

/// Smoothed number of edges down from the border, less the level of the curve: what is negative goes.
fn smooth_depth(half_edges: &HalfEdges, border: &[u32]) -> Vec<f32> {
    let mut ring = vec![RINGS; half_edges.vertex_count()];
    border.iter().for_each(|&b| ring[b as usize] = 0);
    let mut queue = border.to_vec();
    let mut head = 0;
    while head < queue.len() {
        let (v, below) = (queue[head], ring[queue[head] as usize] + 1);
        head += 1;
        for w in half_edges.neighbours(v) {
            if below < ring[w as usize] {
                ring[w as usize] = below;
                queue.push(w);
            }
        }
    }
    let mut depth: Vec<f32> = ring.iter().map(|&r| f32::from(r)).collect();
    for _ in 0..SMOOTH_ROUNDS {
        let mean = |&v: &u32| {
            let (sum, count) = half_edges
                .neighbours(v)
                .fold((depth[v as usize], 1.0), |(sum, count), w| (sum + depth[w as usize], count + 1.0));
            sum / count
        };
        let means: Vec<f32> = queue.iter().map(mean).collect();
        queue.iter().zip(means).for_each(|(&v, mean)| depth[v as usize] = mean);
    }
    let mut levels: Vec<f32> = border.iter().map(|&b| depth[b as usize]).collect();
    let at = ((levels.len() as f64 * CLIPPED_SHARE) as usize).min(levels.len().saturating_sub(1));
    let level = if levels.is_empty() { 0.0 } else { *levels.select_nth_unstable_by(at, f32::total_cmp).1 };
    depth.iter_mut().for_each(|d| *d -= level);
    depth
}

/// Moves vertices onto the curve where it crosses one of their edges close by; their depth becomes zero.
fn snap(mesh: &mut TriMesh, half_edges: &HalfEdges, depth: &mut [f32]) {
    let mut nearest = vec![(SNAP, NONE); depth.len()];
    for h in 0..half_edges.origin.len() as u32 {
        for (v, w) in [(half_edges.from(h), half_edges.to(h)), (half_edges.to(h), half_edges.from(h))] {
            let (here, there) = (depth[v as usize], depth[w as usize]);
            let share = here / (here - there);
            if here * there < 0.0 && share < nearest[v as usize].0 {
                nearest[v as usize] = (share, w);
            }
        }
    }
    let before = mesh.clone();
    for (v, (share, towards)) in nearest.into_iter().enumerate().filter(|(_, (_, w))| *w != NONE) {
        let w = towards as usize;
        mesh.positions_mm[v] = before.positions_mm[v].lerp(before.positions_mm[w], share);
        if let (Some(uv), Some(old)) = (&mut mesh.uv, &before.uv) {
            uv[v] = [0, 1].map(|c| old[v][c] + (old[w][c] - old[v][c]) * share);
        }
        depth[v] = 0.0;
    }
}

/// The parts of the triangles on the curve or below it; where it crosses an edge it gets a vertex.
fn cut(mesh: &mut TriMesh, half_edges: &HalfEdges, depth: &[f32]) -> Vec<[u32; 3]> {
    let mut crossing = vec![NONE; half_edges.origin.len()];
    let mut kept = Vec::with_capacity(mesh.triangles.len());
    for t in 0..half_edges.triangle_count() as u32 {
        let corners = [0, 1, 2].map(|k| half_edges.from(3 * t + k));
        let here = corners.map(|v| depth[v as usize]);
        if here.iter().all(|&d| d <= 0.0) {
            continue;
        }
        if here.iter().all(|&d| d >= 0.0) {
            kept.push(corners);
            continue;
        }
        let mut polygon = Vec::with_capacity(4);
        for h in 3 * t..3 * t + 3 {
            let (a, b) = (half_edges.from(h), half_edges.origin[next(h) as usize]);
            if depth[a as usize] >= 0.0 {
                polygon.push(a);
            }
            if depth[a as usize] * depth[b as usize] < 0.0 {
                let twin = half_edges.twin[h as usize];
                let slot = if twin == NONE { h } else { h.min(twin) } as usize;
                if crossing[slot] == NONE {
                    crossing[slot] = add_between(mesh, a, b, depth);
                }
                polygon.push(crossing[slot]);
            }
        }
        push_polygon(&mesh.positions_mm, &polygon, &mut kept);
    }
    kept
}

fn add_between(mesh: &mut TriMesh, a: u32, b: u32, depth: &[f32]) -> u32 {
    let (i, j) = (a as usize, b as usize);
    let share = depth[i] / (depth[i] - depth[j]);
    mesh.positions_mm.push(mesh.positions_mm[i].lerp(mesh.positions_mm[j], share));
    if let Some(uv) = &mut mesh.uv {
        uv.push([0, 1].map(|c| uv[i][c] + (uv[j][c] - uv[i][c]) * share));
    }
    mesh.positions_mm.len() as u32 - 1
}

/// A triangle, or a quadrilateral along its shorter diagonal.
fn push_polygon(points: &[glam::Vec3], polygon: &[u32], triangles: &mut Vec<[u32; 3]>) {
    match *polygon {
        [a, b, c] => triangles.push([a, b, c]),
        [a, b, c, d] => {
            let length = |v: u32, w: u32| points[v as usize].distance_squared(points[w as usize]);
            let split = if length(a, c) <= length(b, d) { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] };
            triangles.extend(split);
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::quality;
    use crate::mesh::test_surfaces::jittered_plate;
    use glam::{Vec2, Vec3};

    /// A round piece of a grid of 1 mm, its border a staircase.
    fn staircase() -> TriMesh {
        let mut mesh = jittered_plate(60, 0);
        mesh.positions_mm = (0..3600).map(|i| Vec3::new((i % 60) as f32, (i / 60) as f32, 0.0)).collect();
        mesh.uv = Some(mesh.positions_mm.iter().map(|p| [p.x / 60.0, p.y / 60.0]).collect());
        let inside = |v: u32| mesh.positions_mm[v as usize].truncate().distance(Vec2::splat(30.0)) < 25.3;
        mesh.submesh(|t| mesh.triangles[t].iter().all(|&v| inside(v))).0
    }

    fn clipped(mesh: &TriMesh) -> (TriMesh, Vec<u32>) {
        clip_border(mesh, &HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap())
    }

    /// Sum of the turns of the border; a full turn when it is convex, far more on a staircase.
    fn turning(mesh: &TriMesh) -> f32 {
        let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap();
        let ring = &half_edges.boundary_loops()[0];
        let n = ring.len();
        let at = |i: usize| mesh.positions_mm[ring[i % n] as usize].truncate();
        (0..n).map(|i| (at(i + 1) - at(i)).angle_to(at(i + 2) - at(i + 1)).abs()).sum()
    }

    #[test]
    fn the_border_becomes_smooth_and_little_is_lost() {
        let mesh = staircase();
        let (clipped, source) = clipped(&mesh);
        clipped.validate().unwrap();
        assert!(HalfEdges::build(clipped.vertex_count(), &clipped.triangles).unwrap().is_disk());
        assert!(turning(&clipped) < 0.35 * turning(&mesh), "{} of {}", turning(&clipped), turning(&mesh));
        assert!(clipped.area_mm2() > 0.85 * mesh.area_mm2(), "{} of {}", clipped.area_mm2(), mesh.area_mm2());
        let worst = (0..clipped.triangles.len()).map(|t| quality(clipped.corners(t))).fold(1.0, f32::min);
        assert!(worst > 0.1, "{worst}");
        assert!((0..clipped.triangles.len()).all(|t| clipped.area_normal(t).z > 0.0));
        let kept = source.iter().position(|&v| v == NONE).unwrap();
        assert!(source[..kept].is_sorted() && source[kept..].iter().all(|&v| v == NONE));
        for (p, uv) in clipped.positions_mm.iter().zip(clipped.uv.as_ref().unwrap()) {
            assert!((Vec2::from(*uv) * 60.0).distance(p.truncate()) < 1e-3);
        }
    }

    #[test]
    fn inner_vertices_stay() {
        let mesh = staircase();
        let (clipped, source) = clipped(&mesh);
        let deep = |p: Vec3| p.truncate().distance(Vec2::splat(30.0)) < 20.0;
        let count = clipped.positions_mm.iter().zip(&source).filter(|(p, _)| deep(**p));
        assert!(count.clone().all(|(p, v)| mesh.positions_mm[*v as usize] == *p));
        assert_eq!(count.count(), mesh.positions_mm.iter().filter(|p| deep(**p)).count());
    }
}
