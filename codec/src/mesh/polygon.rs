//! Triangulation of a closed polygon in space.

use glam::Vec3;

/// Polygons up to this size are triangulated at once, O(n³); larger ones are cut at their bottlenecks first.
const LEAST_AREA_VERTICES: usize = 80;

/// Triangles over the polygon's vertices; fan centres count on from there.
type Triangles = Vec<[u32; 3]>;

/// Polygon with what decides which chords may be drawn.
struct Polygon<'a, F> {
    points: &'a [Vec3],
    /// Normal of the surface at each vertex: the inside lies on the left seen from its tip.
    normals: &'a [Vec3],
    /// Whether two vertices that are not neighbours have an edge elsewhere.
    taken: F,
    triangles: Triangles,
    centres: Vec<Vec<u32>>,
}

/// Triangulates the polygon through `points` with nearly the least area, using no chord that is `taken`.
/// `normals` point to where the polygon is seen counter-clockwise. Where chords do not suffice, a fan is drawn around
/// a new vertex: the second result lists, for each, the polygon vertices around it; new vertices number on from
/// `points.len()`.
pub(crate) fn triangulate(
    points: &[Vec3],
    normals: &[Vec3],
    taken: impl Fn(usize, usize) -> bool,
) -> (Triangles, Vec<Vec<u32>>) {
    let mut polygon = Polygon { points, normals, taken, triangles: Vec::new(), centres: Vec::new() };
    let mut parts = vec![(0..points.len() as u32).collect::<Vec<u32>>()];
    while let Some(part) = parts.pop() {
        let chord = if part.len() > LEAST_AREA_VERTICES { polygon.bottleneck(&part) } else { None };
        if let Some((i, j)) = chord {
            parts.push([&part[..=i], &part[j..]].concat());
            parts.push(part[i..=j].to_vec());
        } else if part.len() > 4 * LEAST_AREA_VERTICES || !polygon.least_area(&part) {
            polygon.fan(&part);
        }
    }
    (polygon.triangles, polygon.centres)
}

impl<F: Fn(usize, usize) -> bool> Polygon<'_, F> {
    fn point(&self, v: u32) -> Vec3 {
        self.points[v as usize]
    }

    /// The chord i < j shortest for the length of rim it cuts off, among those that leave a sixth on either side and
    /// run inside the polygon at both ends.
    fn bottleneck(&self, part: &[u32]) -> Option<(usize, usize)> {
        let n = part.len();
        let mut arc = vec![0.0];
        for i in 0..n {
            arc.push(arc[i] + (self.point(part[(i + 1) % n]) - self.point(part[i])).length());
        }
        let gap = n / 6;
        let mut best = (f32::INFINITY, None);
        for i in 0..n - gap {
            for j in i + gap..n.min(i + n - gap + 1) {
                let rim = (arc[j] - arc[i]).min(arc[n] - arc[j] + arc[i]);
                let ratio = (self.point(part[i]) - self.point(part[j])).length() / rim.max(f32::MIN_POSITIVE);
                if ratio < best.0
                    && self.opens_towards(part, i, j)
                    && self.opens_towards(part, j, i)
                    && !(self.taken)(part[i] as usize, part[j] as usize)
                {
                    best = (ratio, Some((i, j)));
                }
            }
        }
        best.1
    }

    /// Whether the chord from corner `i` to `j` starts inside the corner.
    fn opens_towards(&self, part: &[u32], i: usize, j: usize) -> bool {
        let n = part.len();
        let (here, normal) = (self.point(part[i]), self.normals[part[i] as usize]);
        let [out, back, chord] = [(i + 1) % n, (i + n - 1) % n, j].map(|k| self.point(part[k]) - here);
        let left = |a: Vec3, b: Vec3| a.cross(b).dot(normal) > 0.0;
        if left(out, back) { left(out, chord) && left(chord, back) } else { left(out, chord) || left(chord, back) }
    }

    /// Least total area by dynamic programming over chords (Barequet, Sharir 1995). False when chords do not suffice.
    fn least_area(&mut self, part: &[u32]) -> bool {
        let n = part.len();
        let mut cost = vec![f32::INFINITY; n * n];
        let mut apex = vec![0u32; n * n];
        for i in 0..n - 1 {
            cost[i * n + i + 1] = 0.0;
        }
        for span in 2..n {
            for i in 0..n - span {
                let j = i + span;
                if span < n - 1 && (self.taken)(part[i] as usize, part[j] as usize) {
                    continue;
                }
                let (a, ab) = (self.point(part[i]), self.point(part[j]) - self.point(part[i]));
                for k in i + 1..j {
                    let rest = cost[i * n + k] + cost[k * n + j];
                    if rest < cost[i * n + j] {
                        let total = rest + ab.cross(self.point(part[k]) - a).length();
                        if total < cost[i * n + j] {
                            cost[i * n + j] = total;
                            apex[i * n + j] = k as u32;
                        }
                    }
                }
            }
        }
        if cost[n - 1].is_infinite() {
            return false;
        }
        let mut chords = vec![(0, n - 1)];
        while let Some((i, j)) = chords.pop() {
            if j - i >= 2 {
                let k = apex[i * n + j] as usize;
                self.triangles.push([part[i], part[k], part[j]]);
                chords.extend([(i, k), (k, j)]);
            }
        }
        true
    }

    fn fan(&mut self, part: &[u32]) {
        let centre = (self.points.len() + self.centres.len()) as u32;
        self.centres.push(part.to_vec());
        let sides = part.iter().zip(part.iter().cycle().skip(1));
        self.triangles.extend(sides.map(|(&a, &b)| [a, b, centre]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn area(points: &[Vec3], triangles: &[[u32; 3]]) -> f32 {
        let corner = |v: u32| points[v as usize];
        triangles.iter().map(|t| (corner(t[1]) - corner(t[0])).cross(corner(t[2]) - corner(t[0])).length() * 0.5).sum()
    }

    #[test]
    fn an_l_shape_is_covered_once() {
        let points = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)].map(|(x, y)| Vec3::new(x as f32, y as f32, 0.0));
        let (triangles, centres) = triangulate(&points, &[Vec3::Z; 6], |_, _| false);
        assert_eq!((triangles.len(), centres.len()), (4, 0));
        assert!((area(&points, &triangles) - 3.0).abs() < 1e-6);
    }

    #[test]
    fn taken_chords_are_avoided_and_a_fan_is_the_last_resort() {
        let points = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
        let (triangles, _) = triangulate(&points, &[Vec3::Z; 4], |i, j| i.min(j) == 0 && i.max(j) == 2);
        assert!(triangles.iter().all(|t| t.contains(&1) && t.contains(&3)));
        let (triangles, centres) = triangulate(&points, &[Vec3::Z; 4], |_, _| true);
        assert_eq!((triangles.len(), centres), (4, vec![vec![0, 1, 2, 3]]));
    }

    proptest! {
        /// Stars around the origin, small and large: n - 2 triangles, all counter-clockwise would mean exact area;
        /// a few folds at bottleneck cuts are allowed for.
        #[test]
        fn star_polygons_are_covered(radii in proptest::collection::vec(6f32..10.0, 3..400)) {
            let n = radii.len();
            let angle = |i: usize| i as f32 / n as f32 * std::f32::consts::TAU;
            let points: Vec<Vec3> =
                radii.iter().enumerate().map(|(i, r)| Vec3::new(angle(i).cos() * r, angle(i).sin() * r, 0.0)).collect();
            let (triangles, centres) = triangulate(&points, &vec![Vec3::Z; n], |_, _| false);
            prop_assert_eq!(triangles.len() + 2, n + 2 * centres.len());
            let exact: f32 = (0..n).map(|i| points[i].cross(points[(i + 1) % n]).z * 0.5).sum();
            let covered = area(&points, &triangles);
            prop_assert!(covered > 0.999 * exact && (n > LEAST_AREA_VERTICES || covered < 1.001 * exact));
        }
    }
}
