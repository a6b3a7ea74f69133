//! Rate-distortion-optimized quantization: coordinate descent over the integers on the normal equations.

use super::base::DIRECTION_BITS;
use super::fit::LevelSystem;
use super::frames::Frame;
use super::lattice::GRID_CELLS;
use glam::DVec3;

/// Most sweeps over a level.
const MAX_SWEEPS: usize = 4;

/// Coefficients of one level: normal and two tangents a node, in steps.
pub type Coefficients = Vec<[i32; 3]>;

/// True for nodes whose basis function reaches the disk.
pub fn active(node: usize, side: usize) -> bool {
    let cells = (GRID_CELLS / (side - 3)) as i64;
    let centred = [node % side, node / side].map(|k| (k as i64 - 1) * cells - GRID_CELLS as i64 / 2);
    let reach = GRID_CELLS as i64 / 2 + cells;
    centred[0] * centred[0] + centred[1] * centred[1] <= reach * reach
}

/// Integers that lower `distortion + lambda * bits`, from zero; `gradient` is left as it is at them.
pub fn descend(
    system: &LevelSystem,
    gradient: &mut [DVec3],
    frames: &[Frame],
    steps_mm: [f64; 3],
    lambda: f64,
) -> Coefficients {
    let side = system.side;
    let mut q: Coefficients = vec![[0; 3]; side * side];
    let nodes: Vec<usize> = (0..side * side).filter(|&n| active(n, side)).collect();
    for _ in 0..MAX_SWEEPS {
        let mut changed = false;
        for &node in &nodes {
            for channel in 0..3 {
                let unit = DVec3::from_array(frames[node][channel].map(f64::from)) / f64::from(1 << DIRECTION_BITS);
                let v = unit * steps_mm[channel];
                let curvature = system.curvature(node, v);
                if curvature <= 0.0 {
                    continue;
                }
                let now = q[node][channel];
                let best_real = f64::from(now) + gradient[node].dot(v) / curvature;
                let near = neighbours(&q, side, node, channel);
                let price = |c: i32| curvature * (f64::from(c) - best_real).powi(2) + lambda * bits(c, near);
                let rounded = best_real.round().clamp(-1e6, 1e6) as i32;
                let toward = rounded - rounded.signum();
                let best = [toward, 0, now].into_iter().fold(rounded, |b, c| if price(c) < price(b) { c } else { b });
                if best != now {
                    q[node][channel] = best;
                    system.subtract(node, v * f64::from(best - now), gradient);
                    changed = true;
                }
            }
        }
        if !changed {
            break;
        }
    }
    q
}

/// Nonzero coefficients among the four neighbours.
fn neighbours(q: &[[i32; 3]], side: usize, node: usize, channel: usize) -> usize {
    let (x, y) = (node % side, node / side);
    let mut count = 0;
    for (inside, at) in [
        (x > 0, node.wrapping_sub(1)),
        (x + 1 < side, node + 1),
        (y > 0, node.wrapping_sub(side)),
        (y + 1 < side, node + side),
    ] {
        count += usize::from(inside && q[at][channel] != 0);
    }
    count
}

/// What a coefficient is expected to cost beside `near` nonzero neighbours.
fn bits(value: i32, near: usize) -> f64 {
    const ZERO: [f64; 5] = [0.06, 0.32, 0.62, 0.9, 1.2];
    const NONZERO: [f64; 5] = [5.6, 3.4, 2.5, 2.2, 1.9];
    if value == 0 { ZERO[near] } else { NONZERO[near] + f64::from(value.unsigned_abs().min(14)) * 1.1 }
}
