//! Corners worth following: the best of each cell of a grid.
//!
//! Shi, Tomasi: Good features to track, CVPR 1994: a window can be followed if the smaller eigenvalue of its structure
//! tensor is large. Buckets keep the landmarks spread over the whole surface instead of crowding on brows and lips.

use super::Mask;
use super::pyramid::{Level, PAD_PX};

/// Side of a cell.
const CELL: usize = 12;
/// Half of the window that the structure tensor is summed over.
const RADIUS: usize = 3;
/// A new corner keeps this far (in x or y) from every landmark: without it a moving surface would gather ever more of them,
/// as each cell that a landmark leaves is filled again.
const SPACING: usize = 10;
/// Side of the block of gradients that a cell needs.
const BLOCK: usize = CELL + 2 * RADIUS;

/// Which corners count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CornerOptions {
    /// Least smaller eigenvalue, mean over the window, (normalised grey / px)².
    pub min_eigenvalue: f32,
}

impl Default for CornerOptions {
    fn default() -> Self {
        Self { min_eigenvalue: 0.01 }
    }
}

/// The best corner of every 12 px cell that holds none of `occupied` (px), at pixels where `allowed` is set (a mask
/// eroded by half the tracking window) and not within 10 px of `occupied`. Row by row of cells.
///
/// # Panics
/// When picture and mask differ in size.
pub fn find_corners(
    picture: &Level,
    mut allowed: Mask,
    occupied: &[[f32; 2]],
    options: &CornerOptions,
) -> Vec<[f32; 2]> {
    let (w, h) = (picture.width, picture.height);
    assert_eq!((w, h), (allowed.width_px as usize, allowed.height_px as usize), "picture and mask differ in size");
    let (columns, rows) = (w.div_ceil(CELL), h.div_ceil(CELL));
    let mut taken = vec![false; columns * rows];
    for px in occupied.iter().filter(|px| picture.contains(**px)) {
        let (x, y) = ((px[0] + 0.5) as usize, (px[1] + 0.5) as usize);
        taken[y / CELL * columns + x / CELL] = true;
        for row in y.saturating_sub(SPACING)..(y + SPACING + 1).min(h) {
            allowed.inside[row * w + x.saturating_sub(SPACING)..row * w + (x + SPACING + 1).min(w)].fill(false);
        }
    }
    let cells = (0..columns * rows).filter(|&c| !taken[c]);
    cells.filter_map(|c| best_of_cell(picture, &allowed, (c % columns) * CELL, (c / columns) * CELL, options)).collect()
}

/// The allowed pixel of the cell at (x0, y0) with the largest smaller eigenvalue.
fn best_of_cell(picture: &Level, allowed: &Mask, x0: usize, y0: usize, options: &CornerOptions) -> Option<[f32; 2]> {
    let (columns, rows) = (CELL.min(picture.width - x0), CELL.min(picture.height - y0));
    let flags = |y: usize| &allowed.inside[(y0 + y) * picture.width + x0..][..columns];
    if !(0..rows).any(|y| flags(y).contains(&true)) {
        return None;
    }
    let eigenvalues = smaller_eigenvalues(picture, x0, y0);
    let mut best = (options.min_eigenvalue, None);
    for (y, row) in eigenvalues[..rows].iter().enumerate() {
        for ((x, &value), _) in row.iter().enumerate().zip(flags(y)).filter(|(_, allowed)| **allowed) {
            if value > best.0 {
                best = (value, Some([(x0 + x) as f32, (y0 + y) as f32]));
            }
        }
    }
    best.1
}

/// Smaller eigenvalue of the mean structure tensor over 7x7 px about each pixel of a cell.
fn smaller_eigenvalues(picture: &Level, x0: usize, y0: usize) -> [[f32; CELL]; CELL] {
    let mut tensor = [[[0.0_f32; BLOCK]; 3]; CELL];
    for r in 0..BLOCK {
        let start = (y0 + r + PAD_PX - RADIUS) * picture.stride + x0 + PAD_PX - RADIUS - 1;
        let [above, here, below] =
            [start - picture.stride, start, start + picture.stride].map(|s| &picture.padded[s..][..BLOCK + 2]);
        let mut products = [[0.0_f32; BLOCK]; 3];
        for x in 0..BLOCK {
            let (gx, gy) = (0.5 * (here[x + 2] - here[x]), 0.5 * (below[x + 1] - above[x + 1]));
            products[0][x] = gx * gx;
            products[1][x] = gx * gy;
            products[2][x] = gy * gy;
        }
        for sums in &mut tensor[r.saturating_sub(2 * RADIUS)..=r.min(CELL - 1)] {
            for (sum, product) in sums.as_flattened_mut().iter_mut().zip(products.as_flattened()) {
                *sum += product;
            }
        }
    }
    let scale = 1.0 / ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;
    tensor.map(|rows| {
        let mean = rows.map(|row| {
            let mut sums = [0.0_f32; CELL];
            for d in 0..=2 * RADIUS {
                for x in 0..CELL {
                    sums[x] += row[x + d];
                }
            }
            sums.map(|s| s * scale)
        });
        let mut smaller = [0.0_f32; CELL];
        for x in 0..CELL {
            let (xx, xy, yy) = (mean[0][x], mean[1][x], mean[2][x]);
            smaller[x] = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        }
        smaller
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::test_texture::{Warp, render};
    use crate::motion::{FloatPicture, Pyramid};

    #[test]
    fn smaller_eigenvalues_follow_their_definition() {
        let picture = render(&Warp::still(), 40, 40);
        let got = smaller_eigenvalues(Pyramid::new(&picture, 1).finest(), 12, 12);
        let at = |x: usize, y: usize| f64::from(picture.pixels[y * 40 + x]);
        for (x, y) in [(12, 12), (17, 20), (23, 23)] {
            let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
            for v in y - 3..=y + 3 {
                for u in x - 3..=x + 3 {
                    let (gx, gy) = ((at(u + 1, v) - at(u - 1, v)) / 2.0, (at(u, v + 1) - at(u, v - 1)) / 2.0);
                    (xx, xy, yy) = (xx + gx * gx / 49.0, xy + gx * gy / 49.0, yy + gy * gy / 49.0);
                }
            }
            let want = (xx + yy) / 2.0 - ((xx - yy) * (xx - yy) / 4.0 + xy * xy).sqrt();
            assert!((f64::from(got[y - 12][x - 12]) - want).abs() < 1e-5);
        }
    }

    #[test]
    fn finds_the_corner_of_a_square_and_nothing_on_its_edges() {
        let inside = |i: u32| f32::from(u8::from(i % 60 >= 30 && i / 60 >= 30));
        let p = Pyramid::new(&FloatPicture::new(60, 60, (0..3600).map(inside).collect()), 1);
        let corners = find_corners(p.finest(), Mask::full(60, 60).eroded(8), &[], &CornerOptions::default());
        assert!(!corners.is_empty());
        assert!(corners.iter().all(|c| (c[0] - 29.5).abs() < 5.0 && (c[1] - 29.5).abs() < 5.0), "{corners:?}");
    }

    #[test]
    fn one_a_cell_inside_the_mask_and_none_in_occupied_cells() {
        let p = Pyramid::new(&render(&Warp::still(), 100, 61), 1);
        let mask = Mask::new(100, 61, (0..6100).map(|i| i % 100 < 70).collect()).eroded(7);
        let all = find_corners(p.finest(), mask.clone(), &[], &CornerOptions::default());
        let cell = |c: &[f32; 2]| (c[0] as usize / 12, c[1] as usize / 12);
        let mut cells: Vec<_> = all.iter().map(cell).collect();
        cells.sort_unstable();
        cells.dedup();
        assert!(cells.len() == all.len() && all.len() > 20);
        assert!(all.iter().all(|c| mask.contains(*c)));
        assert!(find_corners(p.finest(), mask.clone(), &all, &CornerOptions::default()).is_empty());
        let rest = find_corners(p.finest(), mask.clone(), &all[3..], &CornerOptions::default());
        assert!(!rest.is_empty() && rest.len() <= 3);
        let far = |c: &[f32; 2]| all[3..].iter().all(|o| (c[0] - o[0]).abs() > 10.0 || (c[1] - o[1]).abs() > 10.0);
        assert!(rest.iter().all(far));
    }
}
