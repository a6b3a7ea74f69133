//! Partition of the disk by landmarks: Delaunay triangles between them, and the registration that carries barycentric
//! coordinates from a triangle to its image.
//!
//! Straight edges tile the disk without overlap whatever the surface; [`super::geodesic_partition`] registers within edges
//! that are geodesics.

use super::locate::DiskLocator;
use crate::{CodecError, Result};
use glam::DVec2;

/// Points on the circle that close the partition, at k pi/8.
const BORDER_POINTS: u32 = 16;

/// Landmarks nearer to each other or to the circle than this count as one point.
const LEAST_DISTANCE: f64 = 1e-6;

/// Delaunay triangles of landmarks and of 16 points on the circle.
#[derive(Debug, Clone)]
pub struct Partition {
    /// The landmarks, then the points on the circle.
    pub points: Vec<DVec2>,
    /// Counter-clockwise.
    pub triangles: Vec<[u32; 3]>,
    locator: DiskLocator,
}

impl Partition {
    /// Triangulates landmarks inside the unit disk.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when one does not lie inside the polygon of the circle's points or two coincide.
    pub fn new(landmarks: &[DVec2]) -> Result<Self> {
        let border = (0..BORDER_POINTS).map(|k| f64::from(k) * std::f64::consts::PI / 8.0);
        let mut points = landmarks.to_vec();
        points.extend(border.map(|t| DVec2::new(libm::cos(t), libm::sin(t))));
        let first = landmarks.len() as u32;
        let mut triangles: Vec<[u32; 3]> = (1..BORDER_POINTS - 1).map(|k| [first, first + k, first + k + 1]).collect();
        for v in 0..first {
            insert(&points, &mut triangles, v)?;
            make_delaunay(&points, &mut triangles, v);
        }
        let locator = DiskLocator::new(&points, &triangles);
        Ok(Self { points, triangles, locator })
    }

    /// The same triangles over moved landmarks, the circle's points where they are.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when there is not one image a landmark.
    pub fn moved(&self, images: &[DVec2]) -> Result<Self> {
        let count = self.points.len() - BORDER_POINTS as usize;
        if images.len() != count {
            return Err(CodecError::Mesh(format!("{} images for {count} landmarks", images.len())));
        }
        let points: Vec<DVec2> = images.iter().chain(&self.points[count..]).copied().collect();
        let locator = DiskLocator::new(&points, &self.triangles);
        Ok(Self { points, triangles: self.triangles.clone(), locator })
    }

    /// Landmarks, without the points on the circle.
    pub fn landmarks(&self) -> &[DVec2] {
        &self.points[..self.points.len() - BORDER_POINTS as usize]
    }

    /// Image of `z` when the landmarks go to `images` and the circle's points stay: the same barycentric coordinates in the
    /// image of its triangle. Continuous, exact at landmarks. Points between the polygon and the circle keep their offset.
    ///
    /// # Panics
    /// When there is not one image a landmark.
    pub fn register(&self, images: &[DVec2], z: DVec2) -> DVec2 {
        assert_eq!(images.len(), self.landmarks().len(), "one image a landmark");
        let Some(place) = self.locator.locate(&self.points, &self.triangles, z) else { return z };
        let moved = |v: u32| images.get(v as usize).map_or(DVec2::ZERO, |q| *q - self.points[v as usize]);
        let corners = self.triangles[place.triangle as usize];
        z + corners.iter().zip(place.barycentric).map(|(&v, w)| moved(v) * f64::from(w)).sum::<DVec2>()
    }

    /// Undirected edges (smaller index first), ascending.
    pub fn edges(&self) -> Vec<[u32; 2]> {
        let sides = self.triangles.iter().flat_map(|t| [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]]);
        let mut edges: Vec<[u32; 2]> = sides.map(|[a, b]| [a.min(b), a.max(b)]).collect();
        edges.sort_unstable();
        edges.dedup();
        edges
    }
}

/// Twice the signed area of three points.
fn area(points: &[DVec2], t: [u32; 3]) -> f64 {
    super::disk::signed_area(points, t)
}

/// Splits the triangle (or the two at an edge) that holds point `v`.
fn insert(points: &[DVec2], triangles: &mut Vec<[u32; 3]>, v: u32) -> Result<()> {
    let wrong = |why: &str| CodecError::Mesh(format!("landmark {} {why}", v + 1));
    let z = points[v as usize];
    let holds = |t: &[u32; 3]| [[t[0], t[1], v], [t[1], t[2], v], [t[2], t[0], v]].map(|s| area(points, s));
    let near = |w: u32| w != v && points[w as usize].distance(z) < LEAST_DISTANCE;
    if !z.is_finite() || !triangles.iter().any(|t| holds(t).iter().all(|a| *a >= 0.0)) {
        return Err(wrong("does not lie inside the disk"));
    }
    if triangles.iter().flatten().any(|&w| near(w)) {
        return Err(wrong("coincides with another"));
    }
    // On an edge two triangles hold it, and both are split; their slivers along the edge have no area and are left out.
    let (split, kept): (Vec<[u32; 3]>, Vec<[u32; 3]>) =
        triangles.iter().partition(|t| holds(t).iter().all(|a| *a >= 0.0));
    *triangles = kept;
    for t in split {
        let parts = [[t[0], t[1], v], [t[1], t[2], v], [t[2], t[0], v]];
        triangles.extend(parts.into_iter().filter(|s| area(points, *s) > 0.0));
    }
    Ok(())
}

/// Flips edges from those of the triangles at `v` outwards until no point lies inside the circle of a triangle
/// (Lawson 1977).
fn make_delaunay(points: &[DVec2], triangles: &mut [[u32; 3]], v: u32) {
    let sides = |t: [u32; 3]| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])];
    let mut suspect: Vec<(u32, u32)> = triangles.iter().filter(|t| t.contains(&v)).flat_map(|t| sides(*t)).collect();
    // Ends by itself in exact arithmetic; the bound guards against rounding.
    let mut flips_left = 4 * points.len();
    while let Some((a, b)) = suspect.pop() {
        let (Some((t, c)), Some((other, d))) = (at_edge(triangles, a, b), at_edge(triangles, b, a)) else { continue };
        let (first, second) = ([c, a, d], [d, b, c]);
        let convex = area(points, first) > 0.0 && area(points, second) > 0.0;
        if flips_left > 0 && convex && in_circle(points, [a, b, c], d) {
            (triangles[t], triangles[other]) = (first, second);
            suspect.extend([(c, a), (a, d), (d, b), (b, c)]);
            flips_left -= 1;
        }
    }
}

/// The triangle with the directed edge a -> b, and its third corner.
fn at_edge(triangles: &[[u32; 3]], a: u32, b: u32) -> Option<(usize, u32)> {
    triangles
        .iter()
        .enumerate()
        .find_map(|(i, t)| (0..3).find(|&k| t[k] == a && t[(k + 1) % 3] == b).map(|k| (i, t[(k + 2) % 3])))
}

/// Whether `d` lies inside the circle of the counter-clockwise triangle by more than rounding.
fn in_circle(points: &[DVec2], t: [u32; 3], d: u32) -> bool {
    let [a, b, c] = t.map(|v| points[v as usize] - points[d as usize]);
    let [aa, bb, cc] = [a, b, c].map(|p| p.length_squared());
    aa * b.perp_dot(c) - bb * a.perp_dot(c) + cc * a.perp_dot(b) > 1e-12
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn spiral(n: u32) -> Vec<DVec2> {
        let at = |k: u32| DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / f64::from(n)).sqrt() * 0.9;
        (0..n).map(at).collect()
    }

    #[test]
    fn triangles_are_delaunay_and_tile_the_polygon() {
        for n in [0, 1, 7, 68] {
            let partition = Partition::new(&spiral(n)).unwrap();
            let sum: f64 = partition.triangles.iter().map(|t| area(&partition.points, *t)).sum();
            assert!((sum - 16.0 * (std::f64::consts::PI / 8.0).sin()).abs() < 1e-9, "{n}: {sum}");
            assert!(partition.triangles.iter().all(|t| area(&partition.points, *t) > 0.0));
            // Euler: 2 (inner) + border - 2 triangles.
            assert_eq!(partition.triangles.len() as u32, 2 * n + 14);
            assert_eq!(partition.edges().len() as u32, 3 * n + 29);
            for t in &partition.triangles {
                for d in (0..partition.points.len() as u32).filter(|d| !t.contains(d)) {
                    assert!(!in_circle(&partition.points, *t, d), "{n}: {d} in {t:?}");
                }
            }
        }
    }

    #[test]
    fn landmarks_on_edges_split_both_sides_and_bad_ones_are_refused() {
        // The fan's first edges run from (1, 0); the second landmark lies on an edge of the first.
        let on_axis = [DVec2::ZERO, DVec2::new(0.5, 0.0), DVec2::new(-0.5, 0.0), DVec2::new(0.0, 0.25)];
        let partition = Partition::new(&on_axis).unwrap();
        assert_eq!(partition.triangles.len(), 2 * 4 + 14);
        assert!(Partition::new(&[DVec2::new(0.999, 0.03)]).is_err());
        assert!(Partition::new(&[DVec2::NAN]).is_err());
        assert!(Partition::new(&[DVec2::ZERO, DVec2::ZERO]).is_err());
    }

    proptest! {
        #[test]
        fn registration_is_exact_at_landmarks_continuous_and_keeps_affine_maps(
            x in -0.9..0.9f64, y in -0.4..0.4f64, angle in 0.0..6.2f64, phase in 0.0..9.0f64,
        ) {
            let from = spiral(40);
            let to: Vec<DVec2> = from.iter().enumerate()
                .map(|(i, p)| *p + DVec2::from_angle(i as f64 + phase) * 0.03).collect();
            let partition = Partition::new(&from).unwrap();
            for (p, q) in from.iter().zip(&to) {
                prop_assert!(partition.register(&to, *p).distance(*q) < 1e-6);
            }
            let z = DVec2::new(x, y);
            let step = DVec2::from_angle(angle) * 1e-4;
            // Slopes are bounded, so a jump across an edge would show.
            prop_assert!(partition.register(&to, z).distance(partition.register(&to, z + step)) < 2e-3);
            prop_assert!(partition.register(&from, z).distance(z) < 1e-12);
        }
    }
}
