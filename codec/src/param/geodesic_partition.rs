//! Registration within a partition whose edges are the discrete geodesics between landmarks.
//!
//! On the disk a triangle of such a partition is a polygon, its sides the geodesics; the corners of its outline go to the
//! points of the image's sides at the same share of the length, and what lies inside follows by mean value coordinates
//! (Hormann and Floater 2006, "Mean value coordinates for arbitrary planar polygons"). Where sides are straight these are the
//! barycentric coordinates of [`Partition::register`]; they are linear along every side, so that neighbours agree.

use super::geodesic::GeodesicSurface;
use super::locate::DiskLocator;
use super::partition::Partition;
use crate::{CodecError, Result};
use glam::DVec2;

/// Shares of a side's length nearer than this are one.
const SAME_SHARE: f64 = 1e-9;

/// A way on the disk from one landmark to another.
#[derive(Debug, Clone)]
struct Side {
    points: Vec<DVec2>,
    /// Share of the length on the surface at each point: 0 to 1, ascending.
    shares: Vec<f64>,
}

/// The triangles of a [`Partition`] with geodesics for sides.
#[derive(Debug, Clone)]
pub struct GeodesicPartition {
    straight: Partition,
    /// One an edge of the partition, as [`Partition::edges`] lists them, from its smaller point.
    sides: Vec<Side>,
}

/// The registration of one geodesic partition with another of the same triangles.
#[derive(Debug, Clone)]
pub struct GeodesicRegistration {
    from: Partition,
    images: Vec<DVec2>,
    cells: Vec<Cell>,
}

/// Outline of a triangle and of its image, point by point.
#[derive(Debug, Clone)]
struct Cell {
    from: Vec<DVec2>,
    to: Vec<DVec2>,
    low: DVec2,
    high: DVec2,
}

impl GeodesicPartition {
    /// Draws the geodesics along the edges of `partition`, points of the disk of `surface`, each corrected in at most
    /// `passes`. Edges between points on the circle stay straight: they bound the partition.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when a point is found on no triangle or two lie on different pieces of the surface.
    pub fn new(partition: &Partition, surface: &GeodesicSurface<'_>, passes: usize) -> Result<Self> {
        let triangles = &surface.mesh.triangles;
        let locator = DiskLocator::new(surface.disk, triangles);
        let mut sides = Vec::new();
        for ends in partition.edges() {
            let [a, b] = ends.map(|v| partition.points[v as usize]);
            if ends.iter().all(|&v| v as usize >= partition.landmarks().len()) {
                sides.push(Side { points: vec![a, b], shares: vec![0.0, 1.0] });
                continue;
            }
            let place = |z| {
                let missing = || CodecError::Mesh("the disk has no upright triangle".into());
                locator.locate(surface.disk, triangles, z).ok_or_else(missing)
            };
            let path = surface.between(place(a)?, place(b)?, passes)?.points;
            let mut walked = 0.0;
            let mut shares = vec![0.0];
            for leg in path.windows(2) {
                walked += leg[0].position_mm.distance(leg[1].position_mm);
                shares.push(walked);
            }
            shares.iter_mut().for_each(|s| *s /= walked.max(f64::MIN_POSITIVE));
            let mut points: Vec<DVec2> = path.iter().map(|p| p.disk).collect();
            // Weights of places are single precision, and the circle's points lie off the mesh: neighbours meet exactly.
            let last = points.len() - 1;
            (points[0], points[last], shares[last]) = (a, b, 1.0);
            sides.push(Side { points, shares });
        }
        Ok(Self { straight: partition.clone(), sides })
    }

    /// The side from point `a` to `b` as it is seen from there.
    fn side(&self, edges: &[[u32; 2]], a: u32, b: u32) -> Option<Side> {
        let side = &self.sides[edges.binary_search(&[a.min(b), a.max(b)]).ok()?];
        if a < b {
            return Some(side.clone());
        }
        let points = side.points.iter().rev().copied().collect();
        Some(Side { points, shares: side.shares.iter().rev().map(|s| 1.0 - s).collect() })
    }
}

impl Side {
    /// Point at a share of the length.
    fn at(&self, share: f64) -> DVec2 {
        let end = self.shares.partition_point(|s| *s < share).clamp(1, self.shares.len() - 1);
        let (s0, s1) = (self.shares[end - 1], self.shares[end]);
        let along = if s1 > s0 { ((share - s0) / (s1 - s0)).clamp(0.0, 1.0) } else { 0.0 };
        self.points[end - 1].lerp(self.points[end], along)
    }
}

impl GeodesicRegistration {
    /// Registers `from` with `to`.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when they do not have the same triangles ([`Partition::moved`] keeps them).
    pub fn new(from: &GeodesicPartition, to: &GeodesicPartition) -> Result<Self> {
        if from.straight.triangles != to.straight.triangles {
            return Err(CodecError::Mesh("the partitions have different triangles".into()));
        }
        let edges = from.straight.edges();
        let cell = |t: &[u32; 3]| {
            let (mut outline, mut image) = (Vec::new(), Vec::new());
            for (a, b) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
                let (here, there) = (from.side(&edges, a, b)?, to.side(&edges, a, b)?);
                let mut shares: Vec<f64> = here.shares.iter().chain(&there.shares).copied().collect();
                shares.sort_unstable_by(f64::total_cmp);
                shares.dedup_by(|next, last| *next - *last < SAME_SHARE);
                // The end of a side is the start of the next.
                shares.retain(|s| *s < 1.0 - SAME_SHARE);
                outline.extend(shares.iter().map(|&s| here.at(s)));
                image.extend(shares.iter().map(|&s| there.at(s)));
            }
            let bounds = |pick: fn(DVec2, DVec2) -> DVec2| outline.iter().copied().reduce(pick);
            Some(Cell { low: bounds(DVec2::min)?, high: bounds(DVec2::max)?, from: outline, to: image })
        };
        let cells = from.straight.triangles.iter().filter_map(cell).collect();
        Ok(Self { from: from.straight.clone(), images: to.straight.landmarks().to_vec(), cells })
    }

    /// Image of `z`: exact at landmarks, along geodesics by their length. Beyond the polygon of the circle's points, and where
    /// geodesics that cross leave a gap, that of the straight partition.
    pub fn apply(&self, z: DVec2) -> DVec2 {
        let cell = self.cells.iter().find(|cell| cell.holds(z));
        cell.map_or_else(|| self.from.register(&self.images, z), |cell| cell.carry(z))
    }
}

impl Cell {
    /// Whether a ray from `z` crosses the outline an odd number of times.
    fn holds(&self, z: DVec2) -> bool {
        if z.cmplt(self.low).any() || z.cmpgt(self.high).any() {
            return false;
        }
        let sides = self.from.iter().zip(self.from.iter().cycle().skip(1));
        let crossed = |&(p, q): &(&DVec2, &DVec2)| {
            (p.y > z.y) != (q.y > z.y) && z.x < p.x + (z.y - p.y) / (q.y - p.y) * (q.x - p.x)
        };
        sides.filter(crossed).count() % 2 == 1
    }

    /// Mean value interpolation of the image's outline; on the outline itself, along it.
    fn carry(&self, z: DVec2) -> DVec2 {
        let n = self.from.len();
        let (mut sum, mut total) = (DVec2::ZERO, 0.0);
        for i in 0..n {
            let j = (i + 1) % n;
            let (s, t) = (self.from[i] - z, self.from[j] - z);
            let (r, q) = (s.length(), t.length());
            let (cross, dot) = (s.perp_dot(t), s.dot(t));
            if r == 0.0 {
                return self.to[i];
            }
            if cross.abs() <= 1e-15 * (1.0 + r * q) {
                if dot < 0.0 {
                    return self.to[i].lerp(self.to[j], r / (r + q));
                }
                continue;
            }
            // Tangent of half the angle at z between the two corners.
            let half = if dot > 0.0 { cross / (r * q + dot) } else { (r * q - dot) / cross };
            sum += self.to[i] * (half / r) + self.to[j] * (half / q);
            total += half / r + half / q;
        }
        sum / total
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::TriMesh;
    use crate::mesh::test_surfaces::polar_disk;
    use glam::Vec3;

    fn landmarks(turn: f64) -> Vec<DVec2> {
        let at = |k: u32| DVec2::from_angle(f64::from(k) * 2.399 + turn) * (f64::from(k) / 12.0).sqrt() * 0.8;
        (0..12).map(at).collect()
    }

    /// Partitions of a surface over the disk by landmarks and by their images, and the straight one.
    fn partitions(
        place: impl Fn(DVec2) -> Vec3,
        images: &[DVec2],
    ) -> (GeodesicPartition, GeodesicPartition, Partition) {
        let (disk, triangles) = polar_disk(16);
        let mesh = TriMesh { positions_mm: disk.iter().map(|&z| place(z)).collect(), triangles, uv: None };
        let surface = GeodesicSurface::new(&mesh, &disk).unwrap();
        let straight = Partition::new(&landmarks(0.0)).unwrap();
        let geodesic = |p: &Partition| GeodesicPartition::new(p, &surface, 20).unwrap();
        (geodesic(&straight), geodesic(&straight.moved(images).unwrap()), straight)
    }

    /// The upper part of a sphere by inverse stereographic projection: its geodesics bend outwards on the disk.
    fn cap(z: DVec2) -> Vec3 {
        let d = 1.0 + z.length_squared();
        (z * 2.0 / d).extend((1.0 - z.length_squared()) / d).as_vec3() * 100.0
    }

    #[test]
    fn on_a_flat_disk_it_is_the_barycentric_registration() {
        let images: Vec<DVec2> = landmarks(0.0).iter().map(|z| *z * 0.95 + DVec2::new(0.02, -0.01)).collect();
        let (from, to, straight) = partitions(|z| z.extend(0.0).as_vec3() * 100.0, &images);
        let registration = GeodesicRegistration::new(&from, &to).unwrap();
        for k in 0..400 {
            let z = DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / 400.0).sqrt();
            let (found, expected) = (registration.apply(z), straight.register(&images, z));
            assert!(found.distance(expected) < 1e-4, "{z}: {found}, not {expected}");
        }
    }

    #[test]
    fn on_a_cap_landmarks_and_geodesics_go_to_theirs_and_sides_agree() {
        let images = landmarks(0.08);
        let (from, to, straight) = partitions(cap, &images);
        let registration = GeodesicRegistration::new(&from, &to).unwrap();
        for (z, image) in landmarks(0.0).into_iter().zip(&images) {
            assert!(registration.apply(z).distance(*image) < 1e-4);
        }
        let (mut bent, mut between) = (0f64, 0);
        for (here, there) in from.sides.iter().zip(&to.sides) {
            let (a, b) = (here.points[0], here.points[here.points.len() - 1]);
            for share in [0.25, 0.5, 0.75] {
                let z = here.at(share);
                bent = bent.max((z - a).perp_dot((b - a).normalize()).abs());
                // From either side of the geodesic.
                for aside in [DVec2::X, DVec2::Y, -DVec2::X, -DVec2::Y] {
                    let found = registration.apply(z + aside * 1e-7);
                    assert!(found.distance(there.at(share)) < 1e-3, "{z}: {found}, not {}", there.at(share));
                    between += 1;
                }
            }
        }
        assert!(bent > 0.02 && between > 300, "the geodesics are no chords: {bent}");
        let apart = |z: &DVec2| registration.apply(*z).distance(straight.register(&images, *z));
        let grid: Vec<DVec2> =
            (0..400).map(|k| DVec2::new(f64::from(k % 20), f64::from(k / 20)) / 16.0 - 0.6).collect();
        assert!(grid.iter().map(apart).fold(0.0, f64::max) > 1e-3, "not the straight registration");
    }

    #[test]
    fn a_partition_registered_with_itself_stays_and_others_are_refused() {
        let (from, _, straight) = partitions(cap, &landmarks(0.05));
        let registration = GeodesicRegistration::new(&from, &from).unwrap();
        for k in 0..400 {
            let z = DVec2::from_angle(f64::from(k) * 1.3) * (f64::from(k) / 400.0);
            assert!(registration.apply(z).distance(z) < 1e-9, "{z}");
        }
        let mut other = from.clone();
        other.straight.triangles.swap(0, 1);
        assert!(GeodesicRegistration::new(&from, &other).is_err());
        assert!(straight.moved(&landmarks(0.0)[1..]).is_err());
    }
}
