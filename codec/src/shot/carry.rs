//! Where the blocks of a drawn surface lie in the pictures of scans that are decoded already.
//!
//! A block goes along with the point of the surface that one of its pixels shows; beside the surface the nearest block's
//! motion and the nearest depth of a row go on.

use super::bisection::Connectivity;
use super::raster::{DepthPicture, NOTHING};
use super::reciprocal::Reciprocal;
use super::view::{PX_BITS, Seen};
use crate::texture::coded::{BLOCK, NOWHERE, Offsets, continue_unknown};

/// Farthest offset, 1/256 px.
const MAX_OFFSET: i64 = 1 << 28;
/// Pixels of a block in the order in which they speak for it: those in the middle first.
const ORDER: [[usize; 2]; BLOCK * BLOCK] = [
    [1, 1],
    [2, 1],
    [1, 2],
    [2, 2],
    [1, 0],
    [2, 0],
    [0, 1],
    [3, 1],
    [0, 2],
    [3, 2],
    [1, 3],
    [2, 3],
    [0, 0],
    [3, 0],
    [0, 3],
    [3, 3],
];

/// Depth of the model at each pixel and offsets to reference pictures, beside the surface as at the nearest one on it.
#[derive(Debug, Clone)]
pub struct Carried {
    /// Depth in units.
    pub depth: Vec<i32>,
    /// To each reference; [`NOWHERE`] when nothing was drawn.
    pub offsets: Vec<Offsets>,
}

/// Carries the pixels of `picture`, drawn from `seen`, into references that saw the same vertices at `references`.
pub fn carry(picture: &DepthPicture, seen: &[Seen], connectivity: &Connectivity, references: &[&[Seen]]) -> Carried {
    Carried { depth: continued_depth(picture), offsets: offsets(picture, seen, connectivity, references) }
}

/// Depth of a picture, beside the surface that of the nearest pixel of the row on it, or of the nearest row; 0 where nothing
/// was drawn.
pub fn continued_depth(picture: &DepthPicture) -> Vec<i32> {
    let mut depth = picture.depth.clone();
    if !continue_unknown(&mut depth, picture.width, NOTHING) {
        depth.fill(0);
    }
    depth
}

/// Offsets of a picture's blocks to each reference.
pub fn offsets(
    picture: &DepthPicture,
    seen: &[Seen],
    connectivity: &Connectivity,
    references: &[&[Seen]],
) -> Vec<Offsets> {
    let mut offsets = vec![Offsets::even(picture.width, picture.height, NOWHERE); references.len()];
    let Some(first) = offsets.first() else { return offsets };
    let (columns, count) = (first.columns, first.blocks.len());
    for block in 0..count {
        let [x0, y0] = [block % columns * BLOCK, block / columns * BLOCK];
        let is_drawn = |[x, y]: &[usize; 2]| {
            *x < picture.width && *y < picture.height && picture.depth[y * picture.width + x] != NOTHING
        };
        let Some([x, y]) = ORDER.iter().map(|[x, y]| [x0 + x, y0 + y]).find(is_drawn) else { continue };
        let corners = connectivity.triangles[picture.triangle[y * picture.width + x] as usize];
        let point = Point::new(corners.map(|v| seen[v as usize]), [x, y].map(|v| (v as i32) << PX_BITS));
        for (offsets, reference) in offsets.iter_mut().zip(references) {
            offsets.blocks[block] = point.offset_to(corners.map(|v| reference[v as usize]));
        }
    }
    let nearest = nearest_known(&offsets[0].blocks, |o| *o != NOWHERE, columns);
    for offsets in &mut offsets {
        for (block, j) in nearest.iter().enumerate() {
            offsets.blocks[block] = offsets.blocks[*j as usize];
        }
    }
    offsets
}

/// A point of a triangle, ready to be found again.
struct Point {
    corners: [Seen; 3],
    /// Areas that belong to the second and third corner; the whole one.
    areas: [i64; 2],
    by: Option<Reciprocal>,
}

impl Point {
    /// The point seen at `at` (1/256 px) in a front-facing triangle.
    fn new(corners: [Seen; 3], at: [i32; 2]) -> Self {
        let [a, b, c] = corners;
        let from = |s: [i32; 2]| [i64::from(s[0]) - i64::from(a.x), i64::from(s[1]) - i64::from(a.y)];
        let (p, e1, e2) = (from(at), from([b.x, b.y]), from([c.x, c.y]));
        let cross = |u: [i64; 2], v: [i64; 2]| u[1] * v[0] - u[0] * v[1];
        let whole = cross(e1, e2);
        Self { corners, areas: [cross(p, e2), cross(e1, p)], by: (whole > 0).then(|| Reciprocal::new(whole)) }
    }

    /// How far the point lies from here where a reference sees the corners `there`.
    fn offset_to(&self, there: [Seen; 3]) -> [i32; 2] {
        let moved = |k: usize| {
            let of = |i: usize| {
                let (from, to) = (self.corners[i], there[i]);
                if k == 0 { i64::from(to.x) - i64::from(from.x) } else { i64::from(to.y) - i64::from(from.y) }
            };
            // Corners that are out of sight may wrap around: offsets are cut off below.
            let [second, third] = [1, 2].map(|i| self.areas[i - 1].wrapping_mul(of(i) - of(0)));
            let more = self.by.map_or(0, |by| by.floor(second.wrapping_add(third)));
            of(0).saturating_add(more).clamp(-MAX_OFFSET, MAX_OFFSET) as i32
        };
        [moved(0), moved(1)]
    }
}

/// For each element of a grid the index of the one nearest to it, in city-block steps, that is known; itself where there is
/// none. Two passes of a distance transform (Rosenfeld, Pfaltz: Sequential operations in digital picture processing, 1966).
pub fn nearest_known<T>(values: &[T], is_known: impl Fn(&T) -> bool, width: usize) -> Vec<u32> {
    let mut steps: Vec<u32> = values.iter().map(|v| if is_known(v) { 0 } else { u32::MAX - 1 }).collect();
    let mut nearest: Vec<u32> = (0..values.len() as u32).collect();
    let mut take = |i: usize, j: usize| {
        if steps[i] > 0 && steps[j] + 1 < steps[i] {
            (steps[i], nearest[i]) = (steps[j] + 1, nearest[j]);
        }
    };
    let height = values.len() / width.max(1);
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            if x > 0 {
                take(i, i - 1);
            }
            if y > 0 {
                take(i, i - width);
            }
        }
    }
    for y in (0..height).rev() {
        for x in (0..width).rev() {
            let i = y * width + x;
            if x + 1 < width {
                take(i, i + 1);
            }
            if y + 1 < height {
                take(i, i + width);
            }
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_triangles() -> (Vec<Seen>, Connectivity) {
        let at = |x: i32, y: i32| Seen { x: x << 8, y: y << 8, depth: 100 + 7 * x - 3 * y };
        let seen = vec![at(2, 2), at(2, 12), at(12, 12), at(12, 2)];
        (seen, Connectivity { nodes: vec![0, 1, 2, 3], triangles: vec![[0, 1, 2], [0, 2, 3]] })
    }

    fn drawn(seen: &[Seen], connectivity: &Connectivity) -> DepthPicture {
        let mut picture = DepthPicture::new(20, 16);
        for (i, t) in connectivity.triangles.iter().enumerate() {
            picture.draw(i as u32, t.map(|v| seen[v as usize]));
        }
        picture
    }

    #[test]
    fn what_did_not_move_is_where_it_was_and_what_moved_is_where_it_went() {
        let (seen, connectivity) = two_triangles();
        let picture = drawn(&seen, &connectivity);
        let moved: Vec<Seen> = seen.iter().map(|s| Seen { x: s.x + s.y / 2 + 300, y: s.y - 77, ..*s }).collect();
        let carried = carry(&picture, &seen, &connectivity, &[&seen, &moved]);
        assert!(carried.offsets[0].blocks.iter().all(|o| *o == [0; 2]));
        // Of the block's second pixel in both directions, where it is on the surface.
        for [bx, by] in [[1, 1], [0, 2], [2, 1]] {
            let y = (by * BLOCK + 1) as i32 * 256;
            let [dx, dy] = carried.offsets[1].at(bx * BLOCK, by * BLOCK);
            assert!((dx - (y / 2 + 300)).abs() <= 1 && (dy + 77).abs() <= 1, "{bx} {by}: {dx} {dy}");
        }
        // Beside the surface the motion of the nearest block.
        assert_eq!(carried.offsets[1].at(17, 5), carried.offsets[1].at(12, 5));
        for (depth, drawn) in carried.depth.iter().zip(&picture.depth).filter(|(_, d)| **d != NOTHING) {
            assert_eq!(depth, drawn);
        }
        // Beside the surface the depth of the nearest pixel.
        assert_eq!(carried.depth[5 * 20 + 18], picture.depth[5 * 20 + 11]);
    }

    #[test]
    fn a_sliver_whose_corner_is_out_of_sight_stays_in_range() {
        let at = |x: i32, y: i32| Seen { x, y, depth: 5 };
        // A fiftieth of a pixel high, around the centre of pixel (3, 2).
        let seen = vec![at(0, 510), at(2049, 514), at(768, 514)];
        let connectivity = Connectivity { nodes: vec![0, 1, 2], triangles: vec![[0, 2, 1], [0, 1, 2]] };
        let picture = drawn(&seen, &connectivity);
        assert_eq!(picture.depth[2 * 20 + 3], 5);
        let away = [Seen::NOWHERE, at(-(1 << 24), 1 << 24), at(1 << 24, 0)];
        let carried = carry(&picture, &seen, &connectivity, &[&away]);
        assert!(carried.offsets[0].blocks.iter().flatten().all(|v| v.abs() <= 1 << 28));
    }

    #[test]
    fn an_empty_picture_carries_nothing() {
        let (seen, connectivity) = two_triangles();
        let carried = carry(&DepthPicture::new(4, 3), &seen, &connectivity, &[&seen]);
        assert!(carried.depth.iter().all(|d| *d == 0) && carried.offsets[0].blocks.iter().all(|o| *o == NOWHERE));
    }
}
