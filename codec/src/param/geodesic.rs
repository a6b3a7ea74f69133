//! Discrete geodesics between points of a surface, started from the straight line on its disk and corrected.
//!
//! Path correction after Martínez, Velho and Carvalho 2005, "Computing geodesics on triangular meshes": each pass makes the
//! path straight over the edges it crosses, then leads it round the other side of every vertex where it bends although less
//! than pi lies there. Straightening is exact in a pass: the strip of triangles is unfolded into the plane and the shortest
//! path in it found by the funnel of Lee and Preparata 1984. So the length never grows.

use super::disk::signed_area;
use super::locate::Place;
use crate::mesh::half_edge::{NONE, next, prev};
use crate::mesh::{HalfEdges, TriMesh, angle_defects};
use crate::{CodecError, Result};
use glam::{DVec2, DVec3};
use std::f64::consts::PI;

/// Passes of the published correction.
pub const PUBLISHED_PASSES: usize = 5;

/// Bends below this, rad, are left.
const STRAIGHT_RAD: f64 = 1e-9;

/// A correction that gains less than this share of the length is rounding.
const LEAST_GAIN: f64 = 1e-6;

/// Ends on an edge or a vertex are moved this far into their triangle, in barycentric units: from an edge it spans half a
/// turn, and rounding would decide on which side the path begins.
const INWARD: f64 = 1e-7;

/// A point where a path starts, ends, or crosses an edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathPoint {
    /// On the surface, mm.
    pub position_mm: DVec3,
    /// On the disk.
    pub disk: DVec2,
}

/// A path on a surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Geodesic {
    /// Start, one point an edge crossed, end.
    pub points: Vec<PathPoint>,
    /// Length after straightening in the first strip and after each pass, mm; never grows.
    pub lengths_mm: Vec<f64>,
    /// Whether no vertex was left to be corrected.
    pub settled: bool,
}

impl Geodesic {
    /// Length of the path, mm.
    pub fn length_mm(&self) -> f64 {
        self.lengths_mm.last().copied().unwrap_or(0.0)
    }
}

/// A surface on which geodesics are drawn.
pub struct GeodesicSurface<'a> {
    pub(super) mesh: &'a TriMesh,
    pub(super) disk: &'a [DVec2],
    edges: HalfEdges,
    defects_rad: Vec<f64>,
}

/// Two ends of an edge as the path crosses it.
#[derive(Debug, Clone, Copy)]
struct Portal {
    right: DVec2,
    left: DVec2,
}

/// Where a path in a strip bends: the last portal that holds the vertex, and the side of the path on which it lies.
#[derive(Debug, Clone, Copy)]
struct Bend {
    portal: usize,
    on_left: bool,
    at: DVec2,
}

impl<'a> GeodesicSurface<'a> {
    /// A surface with its disk map, one point a vertex.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when the mesh is no oriented manifold or has not one point a vertex.
    pub fn new(mesh: &'a TriMesh, disk: &'a [DVec2]) -> Result<Self> {
        mesh.validate()?;
        if disk.len() != mesh.vertex_count() {
            return Err(CodecError::Mesh(format!("{} disk points for {} vertices", disk.len(), mesh.vertex_count())));
        }
        let edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
        Ok(Self { mesh, disk, edges, defects_rad: angle_defects(mesh)? })
    }

    /// The geodesic between two places that correction of the disk's straight line leads to, in at most `passes`
    /// ([`PUBLISHED_PASSES`], more for coarse starts). A geodesic is a shortest path among its neighbours, not always of all.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when a place lies on no triangle or the places lie on different pieces.
    pub fn between(&self, from: Place, to: Place, passes: usize) -> Result<Geodesic> {
        let count = self.mesh.triangles.len();
        if let Some(bad) = [from, to].iter().find(|p| p.triangle as usize >= count) {
            return Err(CodecError::Mesh(format!(
                "a path ends on triangle {} of {count}",
                u64::from(bad.triangle) + 1
            )));
        }
        let mut strip = self.straight_strip(from, to).map_or_else(|| self.nearest_strip(from, to), Ok)?;
        let mut path = self.straighten(&strip, from, to);
        let mut lengths_mm = vec![path.length_mm];
        let mut settled = false;
        for _ in 0..passes {
            // All bends at once, else the first one that by itself makes the path shorter: neighbours may be in each other's way.
            let choices = std::iter::once(None).chain((0..path.bends.len()).map(Some));
            let shorter = choices.into_iter().find_map(|only| {
                let corrected = self.corrected(&strip, &path, only)?;
                let candidate = self.straighten(&corrected, from, to);
                (candidate.length_mm < path.length_mm * (1.0 - LEAST_GAIN)).then_some((corrected, candidate))
            });
            let Some(shorter) = shorter else {
                settled = true;
                break;
            };
            (strip, path) = shorter;
            lengths_mm.push(path.length_mm);
        }
        Ok(Geodesic { points: self.points(&strip, &path, from, to), lengths_mm, settled })
    }

    fn disk_at(&self, place: Place) -> DVec2 {
        let corners = self.mesh.triangles[place.triangle as usize];
        corners.iter().zip(place.barycentric).map(|(&v, w)| self.disk[v as usize] * f64::from(w)).sum()
    }

    fn position(&self, v: u32) -> DVec3 {
        self.mesh.positions_mm[v as usize].as_dvec3()
    }

    /// Half-edges crossed by the straight line on the disk; `None` where the line leaves through a corner or the border, or
    /// meets triangles that the map turns over.
    fn straight_strip(&self, from: Place, to: Place) -> Option<Vec<u32>> {
        let (a, b) = (self.disk_at(from), self.disk_at(to));
        let on_left = |v: u32| (b - a).perp_dot(self.disk[v as usize] - a) >= 0.0;
        let mut strip = Vec::new();
        let mut triangle = from.triangle;
        while triangle != to.triangle {
            if signed_area(self.disk, self.mesh.triangles[triangle as usize]) <= 0.0
                || strip.len() > self.edges.origin.len()
            {
                return None;
            }
            // A line that passes a counter-clockwise triangle leaves by its edge from a corner on the right to one on the left.
            let exit = (3 * triangle..3 * triangle + 3)
                .find(|&h| !on_left(self.edges.from(h)) && on_left(self.edges.to(h)))?;
            let twin = self.edges.twin[exit as usize];
            if twin == NONE {
                return None;
            }
            strip.push(exit);
            triangle = twin / 3;
        }
        Some(strip)
    }

    /// Half-edges crossed by the path over the fewest triangles.
    fn nearest_strip(&self, from: Place, to: Place) -> Result<Vec<u32>> {
        let mut entered = vec![NONE; self.mesh.triangles.len()];
        let mut queue = std::collections::VecDeque::from([from.triangle]);
        while let Some(triangle) = queue.pop_front() {
            if triangle == to.triangle {
                break;
            }
            for h in 3 * triangle..3 * triangle + 3 {
                let twin = self.edges.twin[h as usize];
                if twin != NONE && twin / 3 != from.triangle && entered[(twin / 3) as usize] == NONE {
                    entered[(twin / 3) as usize] = h;
                    queue.push_back(twin / 3);
                }
            }
        }
        let (mut strip, mut at) = (Vec::new(), to.triangle);
        while at != from.triangle {
            let h = entered[at as usize];
            if h == NONE {
                return Err(CodecError::Mesh("the ends of a path lie on different pieces of the surface".into()));
            }
            strip.push(h);
            at = h / 3;
        }
        strip.reverse();
        Ok(strip)
    }

    /// Unfolds the strip and draws the funnel's path through it.
    fn straighten(&self, strip: &[u32], from: Place, to: Place) -> StripPath {
        let mut corners = [DVec2::ZERO; 3];
        let [a, b, c] = self.mesh.corners(from.triangle as usize).map(|p| p.as_dvec3());
        corners[1] = DVec2::X * a.distance(b);
        corners[2] = apex(corners[0], corners[1], a.distance(c), b.distance(c));
        let start = mean(corners, from);
        let mut portals = Vec::with_capacity(strip.len());
        for &h in strip {
            let portal = Portal { right: corners[(h % 3) as usize], left: corners[(next(h) % 3) as usize] };
            portals.push(portal);
            let twin = self.edges.twin[h as usize];
            let [right, left, opposite] = [self.edges.from(h), self.edges.to(h), self.edges.from(prev(twin))];
            let [right, left, opposite] = [right, left, opposite].map(|v| self.position(v));
            corners[(twin % 3) as usize] = portal.left;
            corners[(next(twin) % 3) as usize] = portal.right;
            corners[(prev(twin) % 3) as usize] =
                apex(portal.left, portal.right, left.distance(opposite), right.distance(opposite));
        }
        StripPath::new(start, mean(corners, to), portals)
    }

    /// The strip led round the other side of the vertices where less than pi lies there, or of `only` one bend; `None` when
    /// there is none.
    fn corrected(&self, strip: &[u32], path: &StripPath, only: Option<usize>) -> Option<Vec<u32>> {
        let ends = |k: usize| if k == 0 { path.start } else { path.bends[k - 1].at };
        let mut out = strip.to_vec();
        let mut changed = false;
        // From the end, so that the portals before keep their places; `untouched` is where the last change begins.
        let mut untouched = strip.len();
        for (k, bend) in path.bends.iter().enumerate().rev().filter(|(k, _)| only.is_none_or(|o| o == *k)) {
            let after = path.bends.get(k + 1).map_or(path.end, |b| b.at);
            let between = (ends(k) - bend.at).angle_to(after - bend.at).abs();
            let vertex = vertex_of(&self.edges, strip[bend.portal], bend.on_left);
            let holds = |i: &usize| vertex_of(&self.edges, strip[*i], bend.on_left) == vertex;
            let first = (0..=bend.portal).rev().take_while(holds).last().unwrap_or(bend.portal);
            let last = (bend.portal..strip.len()).take_while(holds).last().unwrap_or(bend.portal);
            let other_side_rad = between - self.defects_rad[vertex as usize];
            let shorter = other_side_rad < PI - STRAIGHT_RAD;
            if last >= untouched || self.edges.is_boundary_vertex(vertex) || !shorter {
                continue;
            }
            let ends = (strip[first] / 3, self.edges.twin[strip[last] as usize] / 3);
            let round = self.fan(vertex, ends, !bend.on_left);
            out.splice(first..=last, round);
            changed = true;
            untouched = first;
        }
        // Neighbours led round together meet on the edge between them: over it and straight back is no way.
        let mut kept: Vec<u32> = Vec::with_capacity(out.len());
        for h in out {
            if kept.last().is_some_and(|&k| self.edges.twin[k as usize] == h) {
                kept.pop();
            } else {
                kept.push(h);
            }
        }
        changed.then_some(kept)
    }

    /// Half-edges crossed on the way round an inner vertex from one of its triangles to another.
    fn fan(&self, vertex: u32, (from, to): (u32, u32), vertex_on_left: bool) -> Vec<u32> {
        let mut crossed = Vec::new();
        let mut triangle = from;
        while triangle != to {
            let leaving =
                (3 * triangle..3 * triangle + 3).find(|&h| self.edges.from(h) == vertex).unwrap_or(3 * triangle);
            let h = if vertex_on_left { prev(leaving) } else { leaving };
            crossed.push(h);
            triangle = self.edges.twin[h as usize] / 3;
        }
        crossed
    }

    fn points(&self, strip: &[u32], path: &StripPath, from: Place, to: Place) -> Vec<PathPoint> {
        let at_place = |place: Place| {
            let corners = self.mesh.triangles[place.triangle as usize];
            let position_mm =
                corners.iter().zip(place.barycentric).map(|(&v, w)| self.position(v) * f64::from(w)).sum();
            PathPoint { position_mm, disk: self.disk_at(place) }
        };
        let crossing = |(&h, share): (&u32, f64)| {
            let (right, left) = (self.edges.from(h), self.edges.to(h));
            PathPoint {
                position_mm: self.position(right).lerp(self.position(left), share),
                disk: self.disk[right as usize].lerp(self.disk[left as usize], share),
            }
        };
        let inner = strip.iter().zip(path.crossings()).map(crossing);
        std::iter::once(at_place(from)).chain(inner).chain(std::iter::once(at_place(to))).collect()
    }
}

/// End of a half-edge on the given side of a path that crosses it.
fn vertex_of(edges: &HalfEdges, h: u32, on_left: bool) -> u32 {
    if on_left { edges.to(h) } else { edges.from(h) }
}

/// Point to the left of a -> b at the given distances.
fn apex(a: DVec2, b: DVec2, from_a: f64, from_b: f64) -> DVec2 {
    let base = a.distance(b).max(f64::MIN_POSITIVE);
    let along = (from_a * from_a - from_b * from_b + base * base) / (2.0 * base);
    let up = (from_a * from_a - along * along).max(0.0).sqrt();
    let x = (b - a) / base;
    a + x * along + x.perp() * up
}

/// A place in its unfolded triangle, off the edges.
fn mean(corners: [DVec2; 3], place: Place) -> DVec2 {
    let weight = |w: f32| (f64::from(w) + INWARD) / (1.0 + 3.0 * INWARD);
    corners.iter().zip(place.barycentric).map(|(p, w)| *p * weight(w)).sum()
}

/// Shortest path in an unfolded strip.
struct StripPath {
    start: DVec2,
    end: DVec2,
    portals: Vec<Portal>,
    bends: Vec<Bend>,
    length_mm: f64,
}

impl StripPath {
    fn new(start: DVec2, end: DVec2, portals: Vec<Portal>) -> Self {
        let bends = funnel(start, end, &portals);
        let corners: Vec<DVec2> =
            std::iter::once(start).chain(bends.iter().map(|b| b.at)).chain(std::iter::once(end)).collect();
        let length_mm = corners.windows(2).map(|w| w[0].distance(w[1])).sum();
        Self { start, end, portals, bends, length_mm }
    }

    /// Where the path crosses each portal: share of the way from its right end to its left one.
    fn crossings(&self) -> Vec<f64> {
        let mut leg = 0;
        let mut crossings = Vec::with_capacity(self.portals.len());
        for (i, portal) in self.portals.iter().enumerate() {
            while self.bends.get(leg).is_some_and(|b| b.portal < i) {
                leg += 1;
            }
            if let Some(bend) = self.bends.get(leg).filter(|b| b.portal == i) {
                crossings.push(if bend.on_left { 1.0 } else { 0.0 });
                continue;
            }
            let from = if leg == 0 { self.start } else { self.bends[leg - 1].at };
            let to = self.bends.get(leg).map_or(self.end, |b| b.at);
            let (way, edge) = (to - from, portal.left - portal.right);
            let across = way.perp_dot(edge);
            let share = way.perp_dot(from - portal.right) / across;
            crossings.push(if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.5 });
        }
        crossings
    }
}

/// Bends of the shortest path through portals.
fn funnel(start: DVec2, end: DVec2, portals: &[Portal]) -> Vec<Bend> {
    let side = |apex: DVec2, through: DVec2, p: DVec2| (through - apex).perp_dot(p - apex);
    let mut bends = Vec::new();
    let (mut apex, mut right, mut left) = (start, start, start);
    let (mut right_at, mut left_at) = (0, 0);
    let mut i = 0;
    // Where a side of the funnel is its apex itself, it does not bound the other one.
    while i <= portals.len() {
        let portal = portals.get(i).copied().unwrap_or(Portal { right: end, left: end });
        if side(apex, right, portal.right) >= 0.0 {
            if apex == right || apex == left || side(apex, left, portal.right) < 0.0 {
                (right, right_at) = (portal.right, i);
            } else {
                bends.push(Bend { portal: left_at, on_left: true, at: left });
                (apex, right) = (left, left);
                (right_at, i) = (left_at, left_at + 1);
                continue;
            }
        }
        if side(apex, left, portal.left) <= 0.0 {
            if apex == left || apex == right || side(apex, right, portal.left) > 0.0 {
                (left, left_at) = (portal.left, i);
            } else {
                bends.push(Bend { portal: right_at, on_left: false, at: right });
                (apex, left) = (right, right);
                (left_at, i) = (right_at, right_at + 1);
                continue;
            }
        }
        i += 1;
    }
    // The end may close the funnel on one of its sides; a bend there has no portal.
    bends.retain(|b| b.portal < portals.len() && b.at != start && b.at != end);
    bends
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::test_surfaces::polar_disk;
    use crate::param::locate::DiskLocator;
    use glam::Vec3;
    use proptest::prelude::*;

    /// A surface over the disk and the geodesic between two of its points.
    fn geodesic(rings: u32, place: impl Fn(DVec2) -> DVec3, a: DVec2, b: DVec2, passes: usize) -> Geodesic {
        let (disk, triangles) = polar_disk(rings);
        let positions_mm: Vec<Vec3> = disk.iter().map(|&z| place(z).as_vec3()).collect();
        let mesh = TriMesh { positions_mm, triangles, uv: None };
        let surface = GeodesicSurface::new(&mesh, &disk).unwrap();
        let locator = DiskLocator::new(&disk, &mesh.triangles);
        let [from, to] = [a, b].map(|z| locator.locate(&disk, &mesh.triangles, z).unwrap());
        let found = surface.between(from, to, passes).unwrap();
        let walked: f64 = found.points.windows(2).map(|w| w[0].position_mm.distance(w[1].position_mm)).sum();
        assert!((walked - found.length_mm()).abs() < 1e-5 * (1.0 + walked), "{walked} {}", found.length_mm());
        assert!(found.lengths_mm.windows(2).all(|w| w[1] <= w[0]), "{:?}", found.lengths_mm);
        found
    }

    fn disk_point() -> impl Strategy<Value = DVec2> {
        (0.0..0.93f64, 0.0..std::f64::consts::TAU).prop_map(|(r, t)| DVec2::from_angle(t) * r)
    }

    /// The upper part of a sphere by inverse stereographic projection: straight lines of the disk are no great circles.
    fn cap(z: DVec2) -> DVec3 {
        let w = z * 0.8;
        let d = 1.0 + w.length_squared();
        (w * 2.0 / d).extend((2.0 - d) / d) * 100.0
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn on_a_plane_it_is_the_straight_line(a in disk_point(), b in disk_point(), shear in -0.8..0.8f64) {
            let plane = |z: DVec2| DVec3::new(z.x + shear * z.y, z.y, 0.5 * z.x) * 100.0;
            let found = geodesic(14, plane, a, b, 60);
            prop_assert!((found.length_mm() - plane(a).distance(plane(b))).abs() < 1e-2, "{:?}", found.lengths_mm);
        }

        #[test]
        fn on_a_sphere_it_is_a_great_circle(a in disk_point(), b in disk_point()) {
            let found = geodesic(24, cap, a, b, 60);
            let angle = cap(a).angle_between(cap(b));
            prop_assert!(found.settled);
            // A faceted sphere is smaller by (edge / radius)^2 / 24 at most, its ends lie under the sphere.
            let share = found.length_mm() / (100.0 * angle);
            prop_assert!((share - 1.0).abs() < 4e-3 || angle < 0.02, "{share} {angle} {:?}", found.lengths_mm);
        }

        #[test]
        fn on_a_cylinder_it_is_a_helix(a in disk_point(), b in disk_point()) {
            let roll = |z: DVec2| DVec3::new((z.x * 1.4).sin(), z.y * 1.4, (z.x * 1.4).cos()) * 100.0;
            let found = geodesic(24, roll, a, b, 60);
            prop_assert!((found.length_mm() - 140.0 * a.distance(b)).abs() < 0.2, "{:?}", found.lengths_mm);
        }

        #[test]
        fn on_a_saddle_length_falls_and_stays_above_the_chord(a in disk_point(), b in disk_point()) {
            let saddle = |z: DVec2| z.extend(0.9 * z.x * z.y).as_vec3().as_dvec3() * 100.0;
            let found = geodesic(16, saddle, a, b, PUBLISHED_PASSES);
            prop_assert!(found.length_mm() >= saddle(a).distance(saddle(b)) - 0.5);
            let line = 200;
            let on_line = |k: i32| saddle(a.lerp(b, f64::from(k) / f64::from(line)));
            let drawn: f64 = (0..line).map(|k| on_line(k).distance(on_line(k + 1))).sum();
            prop_assert!(found.length_mm() <= drawn + 0.3, "{} {drawn}", found.length_mm());
        }
    }

    #[test]
    fn five_passes_shorten_a_path_over_a_hill() {
        let hill = |z: DVec2| z.extend(0.8 * (-z.length_squared() * 12.0).exp()) * 100.0;
        let found = geodesic(20, hill, DVec2::new(-0.7, 0.05), DVec2::new(0.7, 0.05), PUBLISHED_PASSES);
        assert!(found.lengths_mm.len() > 1 && found.length_mm() < found.lengths_mm[0] - 1.0, "{:?}", found.lengths_mm);
        // Round the foot of the hill it is shorter than over it.
        let settled = geodesic(20, hill, DVec2::new(-0.7, 0.05), DVec2::new(0.7, 0.05), 100);
        assert!(settled.settled && settled.length_mm() <= found.length_mm());
        println!(
            "straight {:.2}, five passes {:.2}, settled {:.2} mm",
            found.lengths_mm[0],
            found.length_mm(),
            settled.length_mm()
        );
    }

    #[test]
    fn a_path_inside_one_triangle_is_a_segment_and_bad_ends_are_errors() {
        let (disk, triangles) = polar_disk(3);
        let mut mesh =
            TriMesh { positions_mm: disk.iter().map(|z| z.extend(0.0).as_vec3()).collect(), triangles, uv: None };
        let place = |triangle: u32, barycentric: [f32; 3]| Place { triangle, barycentric };
        let surface = GeodesicSurface::new(&mesh, &disk).unwrap();
        let found = surface.between(place(4, [1.0, 0.0, 0.0]), place(4, [0.0, 0.5, 0.5]), 5).unwrap();
        assert_eq!(found.points.len(), 2);
        assert!(surface.between(place(4, [1.0, 0.0, 0.0]), place(999, [1.0, 0.0, 0.0]), 5).is_err());
        assert!(GeodesicSurface::new(&mesh, &disk[1..]).is_err());
        // Two pieces.
        let (n, extra) = (mesh.vertex_count() as u32, mesh.clone());
        mesh.positions_mm.extend(extra.positions_mm);
        mesh.triangles.extend(extra.triangles.iter().map(|t| t.map(|v| v + n)));
        let both: Vec<DVec2> = disk.iter().chain(&disk).copied().collect();
        let surface = GeodesicSurface::new(&mesh, &both).unwrap();
        let far = mesh.triangles.len() as u32 - 1;
        let error = surface.between(place(0, [1.0, 0.0, 0.0]), place(far, [1.0, 0.0, 0.0]), 5).unwrap_err();
        assert!(error.to_string().contains("different pieces"), "{error}");
    }
}
