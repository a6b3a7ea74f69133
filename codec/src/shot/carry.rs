//! Where each pixel of a drawn surface lies in the pictures of scans that are decoded already.
//!
//! A triangle carries its pixels along; beside the surface the nearest pixel's motion and depth go on.

use super::bisection::Connectivity;
use super::raster::{DepthPicture, NOTHING};
use super::reciprocal::Reciprocal;
use super::view::{PX_BITS, Seen};

/// Fraction bits of a gradient.
const GRADIENT_BITS: u32 = 16;
/// Steepest gradient: slivers have steeper ones, whose products with a triangle's extent would overflow.
const MAX_GRADIENT: i64 = 1 << 40;
/// Position of a pixel that no surface carries.
pub const NOWHERE: [i32; 2] = [i32::MIN; 2];

/// Depth of the model at each pixel and places in reference pictures, beside the surface as at the nearest pixel on it.
#[derive(Debug, Clone)]
pub struct Carried {
    /// Depth in units; [`NOTHING`] everywhere when nothing was drawn.
    pub depth: Vec<i32>,
    /// For each reference the position of each pixel in it, 1/256 px; [`NOWHERE`] when nothing was drawn.
    pub places: Vec<Vec<[i32; 2]>>,
}

/// Carries the pixels of `picture`, drawn from `seen`, into references that saw the same vertices at `references`.
pub fn carry(picture: &DepthPicture, seen: &[Seen], connectivity: &Connectivity, references: &[&[Seen]]) -> Carried {
    let depth = picture.depth.clone();
    if depth.iter().all(|d| *d == NOTHING) {
        return Carried { places: vec![vec![NOWHERE; depth.len()]; references.len()], depth };
    }
    let mut carried = Carried { places: vec![vec![[0; 2]; depth.len()]; references.len()], depth };
    if !references.is_empty() {
        carry_drawn(picture, seen, connectivity, references, &mut carried.places);
    }
    continue_beside(&mut carried, picture.width);
    carried
}

/// The pixels on the surface. A triangle's maps are costly and its pixels few: triangle by triangle, not pixel by pixel.
fn carry_drawn(
    picture: &DepthPicture,
    seen: &[Seen],
    connectivity: &Connectivity,
    references: &[&[Seen]],
    places: &mut [Vec<[i32; 2]>],
) {
    let mut maps = vec![Affine::default(); references.len()];
    // Only triangles that were drawn: their extents are bounded.
    let drawn = picture.triangle.iter().max().map_or(0, |last| *last as usize + 1);
    for (index, corners) in connectivity.triangles.iter().enumerate().take(drawn) {
        let here = corners.map(|v| seen[v as usize]);
        let [e1, e2] = edges(here);
        if e1[0] * e2[1] >= e1[1] * e2[0] {
            continue;
        }
        let Some([columns, rows]) = picture.around(here) else { continue };
        let mut is_mapped = false;
        for y in rows {
            for x in columns.clone() {
                let i = y as usize * picture.width + x as usize;
                if picture.triangle[i] != index as u32 || picture.depth[i] == NOTHING {
                    continue;
                }
                if !is_mapped {
                    is_mapped = true;
                    let frame = Frame::new(here);
                    for (map, reference) in maps.iter_mut().zip(references) {
                        *map = frame.to(corners.map(|v| reference[v as usize]));
                    }
                }
                for (places, map) in places.iter_mut().zip(&maps) {
                    places[i] = map.apply([x << PX_BITS, y << PX_BITS]);
                }
            }
        }
    }
}

/// A triangle's edges from its first corner, ready to be mapped.
struct Frame {
    origin: [i32; 2],
    edges: [[i64; 2]; 2],
    /// By the magnitude of the edges' determinant, and its sign; none for a triangle without area.
    by: Option<(Reciprocal, i64)>,
}

impl Frame {
    fn new(here: [Seen; 3]) -> Self {
        let [e1, e2] = edges(here);
        let determinant = e1[0] * e2[1] - e1[1] * e2[0];
        let by = (determinant != 0).then(|| (Reciprocal::new(determinant.abs()), determinant.signum()));
        Self { origin: [here[0].x, here[0].y], edges: [e1, e2], by }
    }

    /// The map that takes the corners to `there`.
    fn to(&self, there: [Seen; 3]) -> Affine {
        let ([e1, e2], [d1, d2]) = (self.edges, edges(there));
        let gradient = [0, 1].map(|k| {
            let along = [d1[k] * e2[1] - d2[k] * e1[1], d2[k] * e1[0] - d1[k] * e2[0]];
            let slope = |n: i64| self.by.map_or(0, |(by, sign)| sign * by.truncated(n << GRADIENT_BITS));
            along.map(|n| slope(n).clamp(-MAX_GRADIENT, MAX_GRADIENT))
        });
        Affine { from: self.origin, to: [there[0].x, there[0].y], gradient }
    }
}

/// Both edges from a triangle's first corner.
fn edges([a, b, c]: [Seen; 3]) -> [[i64; 2]; 2] {
    [b, c].map(|s| [i64::from(s.x) - i64::from(a.x), i64::from(s.y) - i64::from(a.y)])
}

/// The affine map that takes a triangle's corners to where a reference sees them.
#[derive(Debug, Clone, Copy, Default)]
struct Affine {
    from: [i32; 2],
    to: [i32; 2],
    /// Change of each coordinate along x and along y, times 2^16.
    gradient: [[i64; 2]; 2],
}

impl Affine {
    fn apply(&self, p: [i32; 2]) -> [i32; 2] {
        let d = [i64::from(p[0]) - i64::from(self.from[0]), i64::from(p[1]) - i64::from(self.from[1])];
        let along = |k: usize| {
            // Maps of slivers may wrap around: they are cut off below.
            let [gx, gy] = self.gradient[k];
            let moved = gx.wrapping_mul(d[0]).wrapping_add(gy.wrapping_mul(d[1])) >> GRADIENT_BITS;
            i64::from(self.to[k]).wrapping_add(moved).clamp(-(1 << 28), 1 << 28) as i32
        };
        [along(0), along(1)]
    }
}

/// Each pixel beside the surface takes over from its nearest one on it.
fn continue_beside(carried: &mut Carried, width: usize) {
    let nearest = nearest_drawn(&carried.depth, width);
    for (y, row) in nearest.chunks_exact(width).enumerate() {
        for (x, &j) in row.iter().enumerate() {
            let (i, j) = (y * width + x, j as usize);
            if i == j {
                continue;
            }
            carried.depth[i] = carried.depth[j];
            let offset = [x as i32 - (j % width) as i32, y as i32 - (j / width) as i32];
            for places in &mut carried.places {
                let [x, y] = places[j];
                places[i] = [x + (offset[0] << PX_BITS), y + (offset[1] << PX_BITS)];
            }
        }
    }
}

/// For each pixel the index of the one nearest to it, in city-block steps, whose depth is known; itself where there is
/// none. Two passes of a distance transform (Rosenfeld, Pfaltz: Sequential operations in digital picture processing, 1966).
pub fn nearest_drawn(depth: &[i32], width: usize) -> Vec<u32> {
    let mut steps: Vec<u32> = depth.iter().map(|d| if *d == NOTHING { u32::MAX - 1 } else { 0 }).collect();
    let mut nearest: Vec<u32> = (0..depth.len() as u32).collect();
    let mut take = |i: usize, j: usize| {
        if steps[i] > 0 && steps[j] + 1 < steps[i] {
            (steps[i], nearest[i]) = (steps[j] + 1, nearest[j]);
        }
    };
    let height = depth.len() / width.max(1);
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
        for i in 0..picture.depth.len() {
            let (x, y) = (((i % 20) as i32) << 8, ((i / 20) as i32) << 8);
            assert_eq!(carried.places[0][i], [x, y]);
            if picture.depth[i] != NOTHING {
                let [a, b] = carried.places[1][i];
                assert!((a - (x + y / 2 + 300)).abs() <= 1 && (b - (y - 77)).abs() <= 1);
                assert_eq!(carried.depth[i], picture.depth[i]);
            }
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
        assert!(carried.places[0].iter().flatten().all(|v| v.abs() <= (1 << 28) + (20 << 8)));
    }

    #[test]
    fn an_empty_picture_carries_nothing() {
        let (seen, connectivity) = two_triangles();
        let carried = carry(&DepthPicture::new(4, 3), &seen, &connectivity, &[&seen]);
        assert!(carried.depth.iter().all(|d| *d == NOTHING) && carried.places[0].iter().all(|p| *p == NOWHERE));
    }
}
