//! Decimation where flat: right-triangle bisection of the domain grid, refined until midpoints lie close to their edges.
//!
//! The conforming hierarchy of Evans, Kirkpatrick, Townsend: Right-triangulated irregular networks (Algorithmica 2001),
//! the triangulation of a restricted quadtree. It follows from decoded positions alone, so nothing is sent for it.

use super::base::on_disk;
use super::lattice::{GRID_CELLS, GRID_SIDE};

/// A decimated base: grid nodes in use and the triangles between them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Connectivity {
    /// Grid index of each vertex, increasing.
    pub nodes: Vec<u32>,
    /// Three vertices a triangle, counter-clockwise on the disk.
    pub triangles: Vec<[u32; 3]>,
}

/// The triangles of the hierarchy whose midpoints lie within `tolerance` units of their edges; only those on the disk.
///
/// # Panics
/// When there is not one position a grid node.
pub fn bisect(positions: &[[i32; 3]], tolerance: i32) -> Connectivity {
    assert_eq!(positions.len(), GRID_SIDE * GRID_SIDE, "one position a grid node");
    let errors = midpoint_errors(positions);
    let tolerance2 = i64::from(tolerance) * i64::from(tolerance);
    let last = GRID_CELLS as i32;
    let mut triangles = Vec::new();
    let mut stack = vec![[[0, 0], [last, last], [last, 0]], [[last, last], [0, 0], [0, last]]];
    while let Some([a, b, c]) = stack.pop() {
        let m = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
        let bisectable = (a[0] - c[0]).abs() + (a[1] - c[1]).abs() > 1;
        if bisectable && errors[index(m)] > tolerance2 {
            stack.push([b, c, m]);
            stack.push([c, a, m]);
        } else if [a, b, c].iter().all(|p| on_disk(p[0] as usize, p[1] as usize)) {
            triangles.push([a, c, b].map(|p| index(p) as u32));
        }
    }
    compact(triangles)
}

fn index(p: [i32; 2]) -> usize {
    p[1] as usize * GRID_SIDE + p[0] as usize
}

/// Squared distance of each node from the middle of the edge it bisects, at least that of all nodes that depend on it.
/// Nodes that carry triangles across the rim of the disk are always used.
fn midpoint_errors(positions: &[[i32; 3]]) -> Vec<i64> {
    let mut errors = vec![0; positions.len()];
    let mut order = Vec::new();
    let last = GRID_CELLS as i32;
    let mut level = vec![[[0, 0], [last, last], [last, 0]], [[last, last], [0, 0], [0, last]]];
    while let Some(&[a, _, c]) = level.first() {
        if (a[0] - c[0]).abs() + (a[1] - c[1]).abs() <= 1 {
            break;
        }
        let mut finer = Vec::with_capacity(2 * level.len());
        for &[a, b, c] in &level {
            let m = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
            order.push([a, b, c]);
            finer.push([c, a, m]);
            finer.push([b, c, m]);
        }
        level = finer;
    }
    for &[a, b, c] in order.iter().rev() {
        let m = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
        let children = [[(a[0] + c[0]) / 2, (a[1] + c[1]) / 2], [(b[0] + c[0]) / 2, (b[1] + c[1]) / 2]];
        let own = own_error(positions, a, b, c, m);
        let deeper = if (a[0] - c[0]).abs() + (a[1] - c[1]).abs() > 1 && (a[0] - m[0]).abs() + (a[1] - m[1]).abs() > 1 {
            children.iter().map(|k| errors[index(*k)]).max().unwrap_or(0)
        } else {
            0
        };
        let at = index(m);
        errors[at] = errors[at].max(own).max(deeper);
    }
    errors
}

fn own_error(positions: &[[i32; 3]], a: [i32; 2], b: [i32; 2], c: [i32; 2], m: [i32; 2]) -> i64 {
    let inside = [a, b, c].iter().filter(|p| on_disk(p[0] as usize, p[1] as usize)).count();
    if inside == 0 {
        return 0;
    }
    if inside < 3 {
        return i64::MAX;
    }
    let (pa, pb, pm) = (positions[index(a)], positions[index(b)], positions[index(m)]);
    (0..3).map(|i| i64::from((pa[i] + pb[i]) / 2 - pm[i]).pow(2)).sum()
}

fn compact(triangles: Vec<[u32; 3]>) -> Connectivity {
    let mut vertex = vec![u32::MAX; GRID_SIDE * GRID_SIDE];
    for &n in triangles.iter().flatten() {
        vertex[n as usize] = 0;
    }
    let mut nodes = Vec::new();
    for (i, v) in vertex.iter_mut().enumerate().filter(|(_, v)| **v == 0) {
        *v = nodes.len() as u32;
        nodes.push(i as u32);
    }
    let triangles = triangles.into_iter().map(|t| t.map(|n| vertex[n as usize])).collect();
    Connectivity { nodes, triangles }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::HalfEdges;

    fn surface(z: impl Fn(f64, f64) -> f64) -> Vec<[i32; 3]> {
        let at = |i: usize| {
            let (x, y) = ((i % GRID_SIDE) as f64 - 128.0, (i / GRID_SIDE) as f64 - 128.0);
            [(x * 256.0) as i32, (y * 256.0) as i32, (z(x, y) * 256.0) as i32]
        };
        (0..GRID_SIDE * GRID_SIDE).map(at).collect()
    }

    #[test]
    fn a_plane_is_coarse_and_a_bump_is_fine_and_both_are_disks() {
        let flat = bisect(&surface(|_, _| 0.0), 4);
        let bump = bisect(&surface(|x, y| 20.0 * (-(x * x + y * y) / 400.0).exp()), 4);
        assert!(flat.nodes.len() < 4000 && bump.nodes.len() > flat.nodes.len() + 1000);
        for c in [flat, bump] {
            let edges = HalfEdges::build(c.nodes.len(), &c.triangles).unwrap();
            assert!(edges.is_disk());
        }
    }
}
