//! Where each pixel of a drawn surface lies in the pictures of scans that are decoded already.
//!
//! A triangle carries its pixels along; beside the surface the nearest pixel's motion and depth go on.

use super::bisection::Connectivity;
use super::raster::{DepthPicture, NOTHING};
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
    let count = picture.depth.len();
    let mut carried = Carried { depth: picture.depth.clone(), places: vec![vec![NOWHERE; count]; references.len()] };
    let mut maps = vec![Affine::default(); references.len()];
    let mut known = u32::MAX;
    for i in 0..count {
        if picture.depth[i] == NOTHING {
            continue;
        }
        let triangle = picture.triangle[i];
        if triangle != known {
            known = triangle;
            let corners = connectivity.triangles[triangle as usize];
            let here = corners.map(|v| seen[v as usize]);
            for (map, reference) in maps.iter_mut().zip(references) {
                *map = Affine::new(here, corners.map(|v| reference[v as usize]));
            }
        }
        let pixel = [((i % picture.width) as i32) << PX_BITS, ((i / picture.width) as i32) << PX_BITS];
        for (places, map) in carried.places.iter_mut().zip(&maps) {
            places[i] = map.apply(pixel);
        }
    }
    continue_beside(&mut carried, picture.width);
    carried
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
    fn new(here: [Seen; 3], there: [Seen; 3]) -> Self {
        let [a, b, c] = here.map(|s| [i64::from(s.x), i64::from(s.y)]);
        let (e1, e2) = ([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]]);
        let determinant = e1[0] * e2[1] - e1[1] * e2[0];
        let [ta, tb, tc] = there.map(|s| [i64::from(s.x), i64::from(s.y)]);
        let gradient = [0, 1].map(|k| {
            let (d1, d2) = (tb[k] - ta[k], tc[k] - ta[k]);
            let along = [d1 * e2[1] - d2 * e1[1], d2 * e1[0] - d1 * e2[0]];
            let slope = |n: i64| ((n << GRADIENT_BITS) / determinant).clamp(-MAX_GRADIENT, MAX_GRADIENT);
            along.map(|n| if determinant == 0 { 0 } else { slope(n) })
        });
        Self { from: [here[0].x, here[0].y], to: [there[0].x, there[0].y], gradient }
    }

    fn apply(&self, p: [i32; 2]) -> [i32; 2] {
        let d = [0, 1].map(|k| i64::from(p[k]) - i64::from(self.from[k]));
        [0, 1].map(|k| {
            let moved = (self.gradient[k][0] * d[0] + self.gradient[k][1] * d[1]) >> GRADIENT_BITS;
            (i64::from(self.to[k]) + moved).clamp(-(1 << 28), 1 << 28) as i32
        })
    }
}

/// Each pixel beside the surface takes over from its nearest one on it.
fn continue_beside(carried: &mut Carried, width: usize) {
    let nearest = nearest_drawn(&carried.depth, width);
    for (i, j) in nearest.into_iter().enumerate().map(|(i, j)| (i, j as usize)).filter(|(i, j)| i != j) {
        carried.depth[i] = carried.depth[j];
        let offset = [(i % width) as i32 - (j % width) as i32, (i / width) as i32 - (j / width) as i32];
        for places in &mut carried.places {
            if places[j] != NOWHERE {
                let [x, y] = places[j];
                places[i] = [x + (offset[0] << PX_BITS), y + (offset[1] << PX_BITS)];
            }
        }
    }
}

/// For each pixel the index of the one nearest to it, in city-block steps, whose depth is known; itself where there is
/// none. Two passes of a distance transform (Rosenfeld, Pfaltz: Sequential operations in digital picture processing, 1966).
pub fn nearest_drawn(depth: &[i32], width: usize) -> Vec<u32> {
    let count = depth.len();
    let mut steps: Vec<u32> = depth.iter().map(|d| if *d == NOTHING { u32::MAX - 1 } else { 0 }).collect();
    let mut nearest: Vec<u32> = (0..count as u32).collect();
    let mut take = |i: usize, j: usize| {
        if steps[j] + 1 < steps[i] {
            (steps[i], nearest[i]) = (steps[j] + 1, nearest[j]);
        }
    };
    for i in 0..count {
        if i % width > 0 {
            take(i, i - 1);
        }
        if i >= width {
            take(i, i - width);
        }
    }
    for i in (0..count).rev() {
        if i % width + 1 < width {
            take(i, i + 1);
        }
        if i + width < count {
            take(i, i + width);
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
