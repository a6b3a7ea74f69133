//! Finds shifts that bring a source onto the wanted picture.
//!
//! Lucas and Kanade's step (An iterative image registration technique, IJCAI 1981) at all nodes of the grid at a time, on
//! smoothed pictures first; slow changes of brightness are taken out before.

use super::carried::Source;
use super::offsets::NOWHERE;
use super::planes::Planes;
use super::shifts::{MAX_SHIFT, SHIFT_BITS, SPACING, Shifts};

/// Smoothing of each step: half the side of a box, px.
const STEPS_PX: [usize; 4] = [2, 1, 0, 0];
/// Half the side of the box whose mean is the slow change of brightness, px.
const SLOW_PX: usize = 4;
/// Differences above this count less (16 grey levels).
const OUTLIER: f32 = 256.0;
/// Added to the sums of squared gradients: a node without texture stays.
const DAMPING: f32 = 2e5;
/// Steps are lengthened, since the system's matrix is replaced by its row sums.
const LENGTHENING: f32 = 1.5;
/// Longest step, px.
const MAX_STEP_PX: f32 = 2.0;
/// Weight of a node against each of its four neighbours after a step.
const STIFFNESS: f32 = 8.0;

/// Shifts of `source` for the picture `wanted`.
pub fn search(wanted: &Planes, mask: &[bool], source: &Source<'_>) -> Shifts {
    let (width, height) = (wanted.width, wanted.height);
    let mut shifts = Shifts::none(width, height);
    if width < 3 || height < 3 || source.planes.width < 2 || source.planes.height < 2 {
        return shifts;
    }
    let is_shown = |i: usize| source.offsets.at(i % width, i / width) != NOWHERE;
    let counts: Vec<f32> = mask.iter().enumerate().map(|(i, m)| f32::from(u8::from(*m && is_shown(i)))).collect();
    let mut exact_px = vec![[0.0_f32; 2]; shifts.nodes.len()];
    for smoothing_px in STEPS_PX {
        let (carried, missing) = compare(wanted, &counts, source, &shifts);
        let slow = masked_mean(&missing, &counts, width, SLOW_PX);
        let missing: Vec<f32> = missing.iter().zip(&slow).zip(&counts).map(|((m, s), c)| c * (m - s)).collect();
        let missing = masked_mean(&missing, &counts, width, smoothing_px);
        let carried = masked_mean(&carried, &counts, width, smoothing_px);
        let mut sums = vec![[0.0; 5]; shifts.nodes.len()];
        for y in 1..height - 1 {
            add_row(&mut sums, y, width, &shifts, [&carried, &missing, &counts]);
        }
        for (exact, sums) in exact_px.iter_mut().zip(&sums) {
            let step = solve(sums);
            (exact[0], exact[1]) = (exact[0] + step[0], exact[1] + step[1]);
        }
        stiffen(&mut exact_px, shifts.columns);
        for (node, exact) in shifts.nodes.iter_mut().zip(&exact_px) {
            *node = exact.map(|v| ((v * (1 << SHIFT_BITS) as f32).round() as i32).clamp(-MAX_SHIFT, MAX_SHIFT));
        }
    }
    shifts
}

/// The source as the shifts carry it, and what is missing to the wanted picture, where pixels count.
fn compare(wanted: &Planes, counts: &[f32], source: &Source<'_>, shifts: &Shifts) -> (Vec<f32>, Vec<f32>) {
    let (mut carried, mut missing) = (vec![0.0; counts.len()], vec![0.0; counts.len()]);
    for i in (0..counts.len()).filter(|i| counts[*i] > 0.0) {
        let at = [i % wanted.width, i / wanted.width];
        let (offset, shift) = (source.offsets.at(at[0], at[1]), shifts.at(at[0], at[1]));
        let place = |k: usize| offset[k].saturating_add(((at[k] as i32) << 8) + shift[k]);
        carried[i] = bilinear(source.planes, [place(0), place(1)]);
        missing[i] = f32::from(wanted.levels[0][i]) - carried[i];
    }
    (carried, missing)
}

fn bilinear(planes: &Planes, at: [i32; 2]) -> f32 {
    let x = (at[0] >> 8).clamp(0, planes.width as i32 - 2) as usize;
    let y = (at[1] >> 8).clamp(0, planes.height as i32 - 2) as usize;
    let (fx, fy) = ((at[0] & 255) as f32 / 256.0, (at[1] & 255) as f32 / 256.0);
    let start = y * planes.width + x;
    let row = |i: usize| {
        let (a, b) = (f32::from(planes.levels[0][i]), f32::from(planes.levels[0][i + 1]));
        a + (b - a) * fx
    };
    let (above, below) = (row(start), row(start + planes.width));
    above + (below - above) * fy
}

/// Adds a row's terms g gᵀ and g r to the nodes around each pixel: gradient g of the carried picture, r what is missing.
fn add_row(sums: &mut [[f32; 5]], y: usize, width: usize, shifts: &Shifts, [carried, missing, counts]: [&[f32]; 3]) {
    let fy = (y % SPACING) as f32 / SPACING as f32;
    for x in 1..width - 1 {
        let i = y * width + x;
        if counts[i] * counts[i - 1] * counts[i + 1] * counts[i - width] * counts[i + width] == 0.0 {
            continue;
        }
        let (gx, gy) = (0.5 * (carried[i + 1] - carried[i - 1]), 0.5 * (carried[i + width] - carried[i - width]));
        let r = missing[i];
        let trust = 1.0 / (1.0 + (r / OUTLIER) * (r / OUTLIER));
        let terms = [gx * gx, gx * gy, gy * gy, gx * r, gy * r];
        let node = y / SPACING * shifts.columns + x / SPACING;
        let fx = (x % SPACING) as f32 / SPACING as f32;
        for (offset, share) in [(0, 1.0 - fy), (shifts.columns, fy)] {
            for (n, weight) in [(node + offset, trust * share * (1.0 - fx)), (node + offset + 1, trust * share * fx)] {
                for (sum, term) in sums[n].iter_mut().zip(terms) {
                    *sum += weight * term;
                }
            }
        }
    }
}

/// Step of a node, px.
fn solve([xx, xy, yy, xr, yr]: &[f32; 5]) -> [f32; 2] {
    let (xx, yy) = (xx + DAMPING, yy + DAMPING);
    let determinant = xx * yy - xy * xy;
    let step = [(yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant];
    step.map(|s| (LENGTHENING * s).clamp(-MAX_STEP_PX, MAX_STEP_PX))
}

/// Draws each node towards its neighbours.
fn stiffen(nodes: &mut [[f32; 2]], columns: usize) {
    let before = nodes.to_vec();
    for (n, node) in nodes.iter_mut().enumerate() {
        let x = n % columns;
        let mut neighbours = [None; 4];
        neighbours[0] = (x > 0).then(|| before[n - 1]);
        neighbours[1] = (x + 1 < columns).then(|| before[n + 1]);
        neighbours[2] = n.checked_sub(columns).map(|m| before[m]);
        neighbours[3] = before.get(n + columns).copied();
        let count = neighbours.iter().flatten().count() as f32;
        for k in 0..2 {
            let sum: f32 = neighbours.iter().flatten().map(|m| m[k]).sum();
            node[k] = (STIFFNESS * before[n][k] + sum) / (STIFFNESS + count);
        }
    }
}

/// Mean over a box of (2 radius + 1)^2 px of those that count.
fn masked_mean(values: &[f32], counts: &[f32], width: usize, radius_px: usize) -> Vec<f32> {
    if radius_px == 0 {
        return values.to_vec();
    }
    let (sums, counts) = (box_sum(values, width, radius_px), box_sum(counts, width, radius_px));
    sums.iter().zip(&counts).map(|(s, c)| if *c > 0.5 { s / c } else { 0.0 }).collect()
}

fn box_sum(values: &[f32], width: usize, radius_px: usize) -> Vec<f32> {
    let height = values.len() / width;
    let mut rows = vec![0.0_f32; values.len()];
    for (row, out) in values.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        let mut sum: f32 = row[..radius_px.min(width)].iter().sum();
        for (x, out) in out.iter_mut().enumerate() {
            sum += row.get(x + radius_px).unwrap_or(&0.0);
            sum -= if x > radius_px { row[x - radius_px - 1] } else { 0.0 };
            *out = sum;
        }
    }
    let mut out = vec![0.0_f32; values.len()];
    let mut sums = vec![0.0_f32; width];
    let add = |sums: &mut [f32], y: usize, sign: f32| {
        sums.iter_mut().zip(&rows[y * width..(y + 1) * width]).for_each(|(s, v)| *s += sign * v);
    };
    (0..radius_px.min(height)).for_each(|y| add(&mut sums, y, 1.0));
    for y in 0..height {
        if y + radius_px < height {
            add(&mut sums, y + radius_px, 1.0);
        }
        if y > radius_px {
            add(&mut sums, y - radius_px - 1, -1.0);
        }
        out[y * width..(y + 1) * width].copy_from_slice(&sums);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::Offsets;
    use super::*;

    #[test]
    fn a_box_counts_what_is_inside() {
        let values: Vec<f32> = (0..35).map(|i| (i * i % 17) as f32).collect();
        let sums = box_sum(&values, 7, 2);
        for (i, sum) in sums.iter().enumerate() {
            let near = |j: &usize| (j % 7).abs_diff(i % 7) <= 2 && (j / 7).abs_diff(i / 7) <= 2;
            let wanted: f32 = (0..35).filter(near).map(|j| values[j]).sum();
            assert!((sum - wanted).abs() < 1e-3, "{i}: {sum} {wanted}");
        }
    }

    #[test]
    fn a_smooth_error_of_the_map_is_found_under_changing_light() {
        let (w, h) = (96, 80);
        let level = |x: f64, y: f64| 2000.0 + 500.0 * ((0.9 * x + 0.3 * y).sin() + (0.8 * y - 0.4 * x).sin());
        let truth = |x: f64, y: f64| [1.2 * (y / 30.0).sin(), 0.8 - x / 100.0];
        let picture = |f: &dyn Fn(f64, f64) -> f64| Planes {
            width: w,
            height: h,
            levels: vec![(0..w * h).map(|i| f((i % w) as f64, (i / w) as f64) as i16).collect()],
        };
        let reference = picture(&level);
        let wanted = picture(&|x, y| level(x + truth(x, y)[0], y + truth(x, y)[1]) * 0.8 + 2.0 * x);
        let offsets = Offsets::even(w, h, [0; 2]);
        let source = Source { planes: &reference, offsets: &offsets, weight: 256 };
        let shifts = search(&wanted, &vec![true; w * h], &source);
        let (mut error, mut before, mut count) = (0.0, 0.0, 0.0);
        for y in 10..h - 10 {
            for x in 10..w - 10 {
                let (s, t) = (shifts.at(x, y), truth(x as f64, y as f64));
                for k in 0..2 {
                    error += (f64::from(s[k]) / 256.0 - t[k]).powi(2);
                    before += t[k] * t[k];
                    count += 1.0;
                }
            }
        }
        let (error, before) = ((error / count).sqrt(), f64::sqrt(before / count));
        assert!(error < 0.15 && before > 0.5, "{before} px became {error} px");
    }
}
