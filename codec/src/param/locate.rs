//! Point location on a triangulated disk by a uniform grid over [-1, 1]^2.

use super::disk::signed_area;
pub use crate::mesh::Place;
use glam::DVec2;

/// Most cells a triangle touches on average: scans touch three or four, slivers across the disk a good part of the grid.
const CELLS_PER_TRIANGLE: usize = 32;

/// Finds the triangle of a disk that holds a point.
#[derive(Debug, Clone)]
pub struct DiskLocator {
    side: usize,
    start: Vec<u32>,
    triangles: Vec<u32>,
}

impl DiskLocator {
    /// Sorts the triangles that the map does not turn over into about one cell for every two triangles, into fewer when
    /// the triangles are so long that they would fill many.
    pub fn new(points: &[DVec2], mesh_triangles: &[[u32; 3]]) -> Self {
        let kept = |t: &[u32; 3]| signed_area(points, *t) > 0.0;
        let mut side = ((mesh_triangles.len() as f64 / 2.0).sqrt() as usize).clamp(1, 1024);
        let entries = |side: usize| -> usize {
            let area = |([x0, y0], [x1, y1]): ([usize; 2], [usize; 2])| (x1 - x0 + 1) * (y1 - y0 + 1);
            mesh_triangles.iter().filter(|t| kept(t)).map(|t| area(cell_box(points, *t, side))).sum()
        };
        while side > 1 && entries(side) > CELLS_PER_TRIANGLE * mesh_triangles.len() {
            side /= 2;
        }
        let mut start = vec![0u32; side * side + 1];
        let cells_of = |t: &[u32; 3]| {
            let ([x0, y0], [x1, y1]) = cell_box(points, *t, side);
            (y0..=y1).flat_map(move |y| (x0..=x1).map(move |x| y * side + x))
        };
        for t in mesh_triangles.iter().filter(|t| kept(t)) {
            cells_of(t).for_each(|c| start[c + 1] += 1);
        }
        for c in 0..side * side {
            start[c + 1] += start[c];
        }
        let mut fill = start.clone();
        let mut triangles = vec![0u32; start[side * side] as usize];
        for (i, t) in mesh_triangles.iter().enumerate().filter(|(_, t)| kept(t)) {
            for c in cells_of(t) {
                triangles[fill[c] as usize] = i as u32;
                fill[c] += 1;
            }
        }
        Self { side, start, triangles }
    }

    /// Triangle that holds `z`, else the nearest one with clamped coordinates (the chord polygon leaves slivers to the
    /// circle, and warps may point outside). `None` only when the disk has no upright triangle.
    pub fn locate(&self, points: &[DVec2], mesh_triangles: &[[u32; 3]], z: DVec2) -> Option<Place> {
        let (cx, cy) = cell(z, self.side);
        let mut best: Option<(f64, Place)> = None;
        for ring in 0..self.side as isize {
            for (x, y) in ring_cells(cx as isize, cy as isize, ring, self.side as isize) {
                let c = y * self.side + x;
                for &t in &self.triangles[self.start[c] as usize..self.start[c + 1] as usize] {
                    let corners = mesh_triangles[t as usize].map(|v| points[v as usize]);
                    let (distance2, barycentric) = nearest_in_triangle(corners, z);
                    if best.is_none_or(|(d, _)| distance2 < d) {
                        best = Some((distance2, Place { triangle: t, barycentric }));
                    }
                    if distance2 == 0.0 {
                        return best.map(|b| b.1);
                    }
                }
            }
            // A nearer triangle can only lie in a cell closer than the best distance.
            let reach = ring as f64 * 2.0 / self.side as f64;
            if best.is_some_and(|(d, _)| d <= reach * reach) {
                break;
            }
        }
        best.map(|b| b.1)
    }
}

/// First and last cells (x, y) that a triangle's box touches.
fn cell_box(points: &[DVec2], t: [u32; 3], side: usize) -> ([usize; 2], [usize; 2]) {
    let [a, b, c] = t.map(|v| points[v as usize]);
    (cell(a.min(b).min(c), side).into(), cell(a.max(b).max(c), side).into())
}

fn cell(z: DVec2, side: usize) -> (usize, usize) {
    let to = |x: f64| (((x + 1.0) * 0.5 * side as f64).max(0.0) as usize).min(side - 1);
    (to(z.x), to(z.y))
}

/// Cells at Chebyshev distance `ring` from (cx, cy) that lie inside the grid.
fn ring_cells(cx: isize, cy: isize, ring: isize, side: isize) -> impl Iterator<Item = (usize, usize)> {
    (-ring..=ring).flat_map(move |dy| {
        let step = if dy.abs() == ring || ring == 0 { 1 } else { 2 * ring };
        (-ring..=ring).step_by(step as usize).filter_map(move |dx| {
            let (x, y) = (cx + dx, cy + dy);
            ((0..side).contains(&x) && (0..side).contains(&y)).then_some((x as usize, y as usize))
        })
    })
}

/// Squared distance from `z` to a counter-clockwise triangle (0 inside) and the barycentric coordinates of the
/// nearest point.
fn nearest_in_triangle([a, b, c]: [DVec2; 3], z: DVec2) -> (f64, [f32; 3]) {
    let area = (b - a).perp_dot(c - a);
    let w = [(c - b).perp_dot(z - b) / area, (a - c).perp_dot(z - c) / area, (b - a).perp_dot(z - a) / area];
    if w.iter().all(|&x| x >= 0.0) {
        return (0.0, w.map(|x| x as f32));
    }
    let mut best = (f64::INFINITY, [0.0; 3]);
    for (k, [p, q]) in [[a, b], [b, c], [c, a]].into_iter().enumerate() {
        let s = ((z - p).dot(q - p) / p.distance_squared(q)).clamp(0.0, 1.0);
        let d = z.distance_squared(p.lerp(q, s));
        if d < best.0 {
            let mut w = [0.0; 3];
            w[k] = 1.0 - s as f32;
            w[(k + 1) % 3] = s as f32;
            best = (d, w);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn fan(n: u32) -> (Vec<DVec2>, Vec<[u32; 3]>) {
        let mut points = vec![DVec2::ZERO];
        points.extend((0..n).map(|k| DVec2::from_angle(std::f64::consts::TAU * f64::from(k) / f64::from(n))));
        (points, (0..n).map(|k| [0, 1 + k, 1 + (k + 1) % n]).collect())
    }

    proptest! {
        #[test]
        fn returns_the_nearest_point_of_all_triangles(x in -1.5..1.5f64, y in -1.5..1.5f64, n in 3u32..60) {
            let (points, triangles) = fan(n);
            let locator = DiskLocator::new(&points, &triangles);
            let z = DVec2::new(x, y);
            let place = locator.locate(&points, &triangles, z).unwrap();
            let best = triangles.iter().map(|t| nearest_in_triangle(t.map(|v| points[v as usize]), z).0)
                .fold(f64::INFINITY, f64::min);
            let found: DVec2 = triangles[place.triangle as usize].iter().zip(place.barycentric)
                .map(|(&v, w)| points[v as usize] * f64::from(w)).sum();
            prop_assert!((found.distance(z) - best.sqrt()).abs() < 1e-6);
            prop_assert!((place.barycentric.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn slivers_across_the_disk_take_memory_in_proportion() {
        let (points, triangles) = fan(50_000);
        let locator = DiskLocator::new(&points, &triangles);
        assert!(locator.triangles.len() <= CELLS_PER_TRIANGLE * triangles.len(), "{}", locator.triangles.len());
        let z = DVec2::new(0.3, -0.6);
        let place = locator.locate(&points, &triangles, z).unwrap();
        let found: DVec2 = triangles[place.triangle as usize]
            .iter()
            .zip(place.barycentric)
            .map(|(&v, w)| points[v as usize] * f64::from(w))
            .sum();
        assert!(found.distance(z) < 1e-6);
    }

    #[test]
    fn no_upright_triangle_gives_none() {
        let (points, triangles) = fan(5);
        let turned: Vec<_> = triangles.iter().map(|t| [t[0], t[2], t[1]]).collect();
        assert!(DiskLocator::new(&points, &turned).locate(&points, &turned, DVec2::ZERO).is_none());
    }
}
