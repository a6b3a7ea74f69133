//! A frame at each lattice node: motion along the surface is cheap, motion across it is shape.

use super::base::{Base, DIRECTION_BITS, cross, unit};
use super::lattice::{GRID_CELLS, GRID_SIDE, LEVEL_SIDES};

/// Farthest that one coefficient's node may move, 1/16 units: 16 m.
const MAX_MOVE: i64 = 1 << 26;

/// Normal and two tangents of a node, unit vectors times 2^14.
pub type Frame = [[i32; 3]; 3];

/// Frames of all levels of a base.
pub fn frames(base: &Base) -> [Vec<Frame>; 3] {
    LEVEL_SIDES.map(|side| (0..side * side).map(|i| frame(base, i % side, i / side, side)).collect())
}

fn frame(base: &Base, i: usize, j: usize, side: usize) -> Frame {
    let (x, y) = disk_node(i, j, side);
    let n = base.normals[y * GRID_SIDE + x];
    let (left, right) = (x.saturating_sub(4), (x + 4).min(GRID_CELLS));
    let (a, b) = (base.positions[y * GRID_SIDE + left], base.positions[y * GRID_SIDE + right]);
    let along = [0, 1, 2].map(|c| i64::from(b[c]) - i64::from(a[c]));
    let normal = n.map(i64::from);
    let across: i64 = (0..3).map(|c| (along[c] * normal[c]) >> DIRECTION_BITS).sum();
    let tangent = unit([0, 1, 2].map(|c| along[c] - ((across * normal[c]) >> DIRECTION_BITS)));
    let other = unit(cross(normal, tangent.map(i64::from)));
    [n, tangent, other]
}

/// Grid node nearest to a lattice node, moved onto the disk.
fn disk_node(i: usize, j: usize, side: usize) -> (usize, usize) {
    let cells = (GRID_CELLS / (side - 3)) as i64;
    let half = GRID_CELLS as i64 / 2;
    let centred = [i, j].map(|k| (k as i64 - 1) * cells - half);
    let length2 = (centred[0] * centred[0] + centred[1] * centred[1]) as u64;
    let length = length2.isqrt() as i64;
    // Two cells inside the rim, where central differences are still on the disk.
    let most = half - 4;
    let on = |c: i64| if length > most { c * most / length } else { c } + half;
    (on(centred[0]) as usize, on(centred[1]) as usize)
}

/// The vector of coefficients (normal, two tangents; in steps) in a frame, in 1/16 units, at most 2^26 a channel.
pub fn to_space(frame: &Frame, steps: [i32; 3], q: [i32; 3]) -> [i32; 3] {
    [0, 1, 2].map(|c| {
        let sum: i64 = (0..3).map(|d| i64::from(frame[d][c]) * i64::from(q[d]) * i64::from(steps[d])).sum();
        let rounded = (sum + (1 << (DIRECTION_BITS - 5))) >> (DIRECTION_BITS - 4);
        rounded.clamp(-MAX_MOVE, MAX_MOVE) as i32
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shot::base::normals;

    #[test]
    fn frames_are_right_angled_and_of_unit_length() {
        let at = |i: usize| {
            let (x, y) = ((i % GRID_SIDE) as i32 - 128, (i / GRID_SIDE) as i32 - 128);
            [200 * x + 30 * y, -180 * y, 20_000 - (x * x + 2 * y * y) / 2]
        };
        let positions: Vec<_> = (0..GRID_SIDE * GRID_SIDE).map(at).collect();
        let base = Base { normals: normals(&positions), positions };
        // Projections are rounded to units, of which eight cells have some 1600.
        for frame in frames(&base).iter().flatten() {
            let dot = |a: usize, b: usize| -> f64 {
                (0..3).map(|c| f64::from(frame[a][c]) * f64::from(frame[b][c])).sum::<f64>() / f64::from(1 << 28)
            };
            for (a, b) in [(0, 1), (0, 2), (1, 2)] {
                assert!((dot(a, a) - 1.0).abs() < 5e-3 && (dot(b, b) - 1.0).abs() < 5e-3 && dot(a, b).abs() < 5e-3);
            }
        }
    }

    #[test]
    fn coefficients_are_lengths_along_the_frame_and_end_at_the_limit() {
        let one = 1 << DIRECTION_BITS;
        let frame = [[0, 0, one], [one, 0, 0], [0, one, 0]];
        assert_eq!(to_space(&frame, [3, 5, 5], [2, -1, 4]), [-80, 320, 96]);
        assert_eq!(to_space(&frame, [4096; 3], [1 << 15, -(1 << 15), 0]), [-(1 << 26), 0, 1 << 26]);
    }
}
