//! From one shot to the next: their disks matched conformally, then a morph along the match.

use super::base_fit::GRID_RADIUS;
use super::bisection::Connectivity;
use super::lattice::{GRID_CELLS, GRID_SIDE};
use crate::mesh::{Bvh, TriMesh};
use crate::param::locate::DiskLocator;
use crate::param::matching::{DiskMatch, SourceDisk, WarpKind};
use glam::{DVec2, Vec3};

/// Points that the match rests on.
const SAMPLES: usize = 160;
/// Farthest that a point may have moved in the time of the change, mm.
const REACH_MM: f32 = 10.0;
/// Share of the disk from which points are taken: its rim is where a surface was cut off.
const INSIDE: f64 = 0.9;

/// A surface on its disk.
#[derive(Debug, Clone)]
pub struct OnDisk {
    /// Positions, mm, and triangles.
    pub mesh: TriMesh,
    /// Point of the disk for each vertex.
    pub points: Vec<DVec2>,
}

impl OnDisk {
    /// Moved grid nodes with their places on the domain grid as disk.
    pub fn new(positions_mm: Vec<Vec3>, nodes: &Connectivity) -> Self {
        let half = GRID_CELLS as f64 / 2.0;
        let point = |n: &u32| {
            let (x, y) = (*n as usize % GRID_SIDE, *n as usize / GRID_SIDE);
            // Within the unit disk, which matching wants: the grid reaches a little beyond the scan it began with.
            DVec2::new(x as f64 - half, y as f64 - half) / half
        };
        let mesh = TriMesh { positions_mm, triangles: nodes.triangles.clone(), uv: None };
        Self { mesh, points: nodes.nodes.iter().map(point).collect() }
    }
}

/// The way from the last scan of a shot to the first of the next.
#[derive(Debug, Clone)]
pub struct Change {
    /// Where the points of the later surface come from, mm.
    from_mm: Vec<Vec3>,
    /// The later surface.
    later: OnDisk,
}

impl Change {
    /// Matches the disks of two surfaces (Möbius, then a thin plate through points of the one and those nearest to them on
    /// the other) and looks up each point of the later one on the earlier.
    pub fn new(earlier: &OnDisk, later: OnDisk) -> Self {
        let (from, to) = pairs(earlier, &later);
        let source = SourceDisk { points: &later.points, triangles: &later.mesh.triangles };
        let backward = DiskMatch::fit(&from, &to, source, &WarpKind::ThinPlate);
        let locator = DiskLocator::new(&earlier.points, &earlier.mesh.triangles);
        let images = backward.images(&later.points);
        let from_mm = images
            .iter()
            .zip(&later.mesh.positions_mm)
            .map(|(&z, &p)| {
                let place = locator.locate(&earlier.points, &earlier.mesh.triangles, z);
                place.map_or(p, |place| place.interpolate(&earlier.mesh.triangles, &earlier.mesh.positions_mm))
            })
            .collect();
        Self { from_mm, later }
    }

    /// The surface at a share of the way.
    pub fn at(&self, share: f32) -> TriMesh {
        let between = |(a, b): (&Vec3, &Vec3)| a.lerp(*b, share);
        let positions_mm = self.from_mm.iter().zip(&self.later.mesh.positions_mm).map(between).collect();
        TriMesh { positions_mm, triangles: self.later.mesh.triangles.clone(), uv: None }
    }
}

/// Points of the later disk and those of the earlier one whose surface lies nearest to theirs.
fn pairs(earlier: &OnDisk, later: &OnDisk) -> (Vec<DVec2>, Vec<DVec2>) {
    let bvh = Bvh::new(&earlier.mesh);
    let radius = INSIDE / GRID_RADIUS;
    let inside: Vec<usize> = (0..later.points.len()).filter(|&v| later.points[v].length() < radius).collect();
    (inside.iter().step_by(inside.len().div_ceil(SAMPLES).max(1)))
        .filter_map(|&v| {
            let nearest = bvh.nearest(later.mesh.positions_mm[v], REACH_MM)?;
            let corners = earlier.mesh.triangles[nearest.triangle as usize];
            let there: DVec2 =
                corners.iter().zip(nearest.barycentric).map(|(&c, w)| earlier.points[c as usize] * f64::from(w)).sum();
            Some((later.points[v], there))
        })
        .unzip()
}
