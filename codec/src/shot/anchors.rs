//! Tracked points of the texture, anchored on the base: they say where the surface went along itself.

use super::fit::{base_at_mm, displacement_at_mm};
use super::lattice::GRID_SIDE;
use super::model::Model;
use super::motion::Motion;
use super::raster::NOTHING;
use super::register::Hit;
use super::scan_image::ScanImage;
use super::seen_scan::SeenScan;
use super::view::PX_BITS;
use glam::{DMat3, DVec2, DVec3};
use std::collections::BTreeMap;

/// Scale of the Cauchy weight, mm.
const SCALE_MM: f64 = 1.5;
/// A point that ends farther from the model than this was tracked wrongly, mm.
const LOST_MM: f64 = 1.5;
/// Depth steps beyond this hold no tracked point, units.
const STEP_LIMIT: i32 = 2 * super::UNITS_PER_MM;

/// A tracked point in a scan: its number and its pixel.
pub type TrackedPixel = (u32, [f32; 2]);

/// Where tracked points lie on the base.
#[derive(Debug, Clone, Default)]
pub struct Anchors {
    grid: BTreeMap<u32, [f64; 2]>,
}

impl Anchors {
    /// Forgets all: the grid has a new meaning.
    pub fn clear(&mut self) {
        self.grid.clear();
    }

    /// The three equations of each anchored point that the scan shows.
    pub fn hits(
        &self,
        tracked: &[TrackedPixel],
        model: &Model,
        motion: &Motion,
        (image, weight): (&ScanImage, f64),
    ) -> Vec<Hit> {
        let mut hits = Vec::with_capacity(3 * tracked.len());
        for (id, px) in tracked {
            let (Some(grid), Some(target)) = (self.grid.get(id), lift(image, *px)) else { continue };
            let at_mm = point_mm(model, motion, *grid);
            let missing = target - at_mm;
            let weight = weight / (1.0 + missing.length_squared() / (SCALE_MM * SCALE_MM));
            for normal in DVec3::AXES {
                hits.push(Hit { grid: *grid, at_mm, normal, distance_mm: missing.dot(normal), weight });
            }
        }
        hits
    }

    /// After a keyframe: points that ended elsewhere and points that ended themselves are forgotten, new ones anchored.
    pub fn renew(&mut self, tracked: &[TrackedPixel], model: &Model, scan: &SeenScan, image: &ScanImage) {
        let before = std::mem::take(&mut self.grid);
        for (id, px) in tracked {
            let kept = before.get(id).copied().filter(|grid| {
                let target = lift(image, *px);
                target.is_some_and(|t| (t - point_mm(model, &scan.placed.motion, *grid)).length() < LOST_MM)
            });
            if let Some(grid) = kept.or_else(|| grid_of(model, scan, *px)) {
                self.grid.insert(*id, grid);
            }
        }
    }
}

fn lift(image: &ScanImage, px: [f32; 2]) -> Option<DVec3> {
    let [x, y] = px.map(|v| (v * f32::from(1_u16 << PX_BITS)).round() as i32);
    let depth = image.depth_at(x, y, STEP_LIMIT)?;
    Some(image.point_mm(x, y, depth))
}

fn point_mm(model: &Model, motion: &Motion, grid: [f64; 2]) -> DVec3 {
    let rotation = DMat3::from_cols_array_2d(&motion.pose.matrix().rotation()).transpose();
    let shift = DVec3::from_array(motion.pose.shift.map(f64::from)) / f64::from(super::UNITS_PER_MM);
    rotation * (base_at_mm(&model.base, grid) + displacement_at_mm(&motion.nodes, grid)) + shift
}

/// Place on the domain grid of what a decoded scan shows at a pixel.
fn grid_of(model: &Model, scan: &SeenScan, px: [f32; 2]) -> Option<[f64; 2]> {
    let (x, y) = (px[0].round() as i64, px[1].round() as i64);
    let inside = x >= 0 && y >= 0 && x < scan.placed.window.width as i64 && y < scan.placed.window.height as i64;
    let i = inside.then(|| y as usize * scan.placed.window.width + x as usize)?;
    if !scan.mask[i] || scan.drawn.picture.depth[i] == NOTHING {
        return None;
    }
    let corners = model.connectivity.triangles[scan.drawn.picture.triangle[i] as usize];
    let p = DVec2::new(f64::from(px[0]), f64::from(px[1])) * f64::from(1 << PX_BITS);
    let [a, b, c] = corners.map(|v| {
        let s = scan.drawn.seen[v as usize];
        DVec2::new(f64::from(s.x), f64::from(s.y))
    });
    let area = (b - a).perp_dot(c - a);
    let (v, w) = ((p - a).perp_dot(c - a) / area, (b - a).perp_dot(p - a) / area);
    let nodes = corners.map(|k| {
        let n = model.connectivity.nodes[k as usize] as usize;
        DVec2::new((n % GRID_SIDE) as f64, (n / GRID_SIDE) as f64)
    });
    let at = nodes[0] * (1.0 - v - w) + nodes[1] * v + nodes[2] * w;
    let last = (GRID_SIDE - 1) as f64;
    (at.is_finite() && at.min_element() >= 0.0 && at.max_element() <= last).then_some([at.x, at.y])
}
