//! A scan as its camera saw it: a depth for each pixel.

use super::UNITS_PER_MM;
use super::model::Window;
use super::raster::{DepthPicture, NOTHING};
use super::view::{BackProjection, PX_BITS, Seen, View};
use crate::Scan;
use glam::DVec3;

/// Later scans of a shot may be steeper than its first by this factor.
const EDGE_ROOM: f64 = 1.3;
/// Neighbours that differ by less than this are joined, units.
const LEAST_EDGE_STEP: i32 = 3 * UNITS_PER_MM;
/// Vertices within this of a pixel centre (1/256 px) count as that pixel.
const CENTRE_TOLERANCE: i32 = 16;

/// Depths of a scan on the pixels of a view.
#[derive(Debug, Clone)]
pub struct ScanImage {
    /// Its pixels.
    pub window: Window,
    /// Depth in units, [`NOTHING`] off the surface.
    pub depth: Vec<i32>,
    back: BackProjection,
}

/// A place on the scan under a picture position.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Point of the scan, mm.
    pub point_mm: DVec3,
    /// Unit normal of the scan there, towards the camera.
    pub normal: DVec3,
}

impl ScanImage {
    /// Draws a scan. A mesh whose vertices lie on pixel centres, as a scanner's do, is taken over pixel by pixel.
    pub fn new(scan: &Scan, view: &View, window: Window) -> Self {
        let (view, Window { width, height, .. }) = (view.moved(window.offset), window);
        let to_units = |v: f32| (f64::from(v) * f64::from(UNITS_PER_MM)).round() as i32;
        let seen: Vec<Option<Seen>> =
            scan.mesh.positions_mm.iter().map(|p| view.project(p.to_array().map(to_units))).collect();
        let depth = on_centres(&seen, width, height).unwrap_or_else(|| {
            let mut picture = DepthPicture::new(width, height);
            for (i, t) in scan.mesh.triangles.iter().enumerate() {
                if let [Some(a), Some(b), Some(c)] = t.map(|v| seen[v as usize]) {
                    picture.draw(i as u32, [a, b, c]);
                }
            }
            picture.depth
        });
        Self { window, depth, back: view.back_projection() }
    }

    /// Depth of a pixel, `None` off the picture or the surface.
    pub fn at(&self, x: i32, y: i32) -> Option<i32> {
        let inside = x >= 0 && y >= 0 && (x as usize) < self.window.width && (y as usize) < self.window.height;
        inside.then(|| self.depth[y as usize * self.window.width + x as usize]).filter(|d| *d != NOTHING)
    }

    /// Which pixels are on the surface.
    pub fn mask(&self) -> Vec<bool> {
        self.depth.iter().map(|d| *d != NOTHING).collect()
    }

    /// Squared cosine between the viewing direction and the normal at each pixel, which turns squared depth into squared
    /// distance; that of 45 degrees a direction where a neighbour is missing.
    pub fn across(&self) -> Vec<f32> {
        let Window { width, height, .. } = self.window;
        let pitch = self.pitch();
        let slope = |a: usize, b: usize| match (self.depth[a], self.depth[b]) {
            (NOTHING, _) | (_, NOTHING) => 1.0,
            (a, b) => (b - a) as f32 / (2.0 * pitch),
        };
        let mut out = vec![0.5; self.depth.len()];
        for y in 1..height.saturating_sub(1) {
            let row = &mut out[y * width..(y + 1) * width];
            for (x, out) in row.iter_mut().enumerate().take(width - 1).skip(1) {
                let i = y * width + x;
                if self.depth[i] != NOTHING {
                    let (x, y) = (slope(i - 1, i + 1), slope(i - width, i + width));
                    *out = 1.0 / (1.0 + x * x + y * y);
                }
            }
        }
        out
    }

    /// Distance of neighbouring pixels on the surface, units.
    fn pitch(&self) -> f32 {
        let Some(middle) = (0..self.depth.len()).filter(|i| self.depth[*i] != NOTHING).nth(self.area() / 2) else {
            return UNITS_PER_MM as f32;
        };
        let (x, y) = ((middle % self.window.width) as f64, (middle / self.window.width) as f64);
        let at = |x: f64| self.back.point_mm(x, y, f64::from(self.depth[middle]));
        ((at(x + 1.0) - at(x)).length() * f64::from(UNITS_PER_MM)).max(1e-3) as f32
    }

    /// The largest depth step along an edge of the scan, units: neighbours farther apart are not joined.
    pub fn edge_step(&self, scan: &Scan) -> i32 {
        let depth: Vec<f64> = scan.mesh.positions_mm.iter().map(|p| self.back.depth_of(p.as_dvec3())).collect();
        let mut steps: Vec<f64> = scan
            .mesh
            .triangles
            .iter()
            .map(|t| {
                let d = t.map(|v| depth[v as usize]);
                d.iter().copied().fold(f64::MIN, f64::max) - d.iter().copied().fold(f64::MAX, f64::min)
            })
            .collect();
        steps.sort_by(f64::total_cmp);
        // A few triangles of a mended mesh may be longer than any of the scanner's.
        let step = steps.get(steps.len().saturating_sub(1 + steps.len() / 2000)).copied().unwrap_or(0.0);
        ((EDGE_ROOM * step).ceil() as i32).clamp(LEAST_EDGE_STEP, 1 << 20)
    }

    /// Pixels on the surface.
    pub fn area(&self) -> usize {
        self.depth.iter().filter(|d| **d != NOTHING).count()
    }

    /// Bilinear depth (units) at a position in 1/256 px; `None` unless all four pixels are on the surface within
    /// `step_limit` units of each other.
    pub fn depth_at(&self, x: i32, y: i32, step_limit: i32) -> Option<f64> {
        let (px, py) = (x >> PX_BITS, y >> PX_BITS);
        let d = [self.at(px, py)?, self.at(px + 1, py)?, self.at(px, py + 1)?, self.at(px + 1, py + 1)?];
        if d.iter().max()? - d.iter().min()? > step_limit {
            return None;
        }
        let fraction = |v: i32| f64::from(v & 255) / 256.0;
        let (fx, fy) = (fraction(x), fraction(y));
        let d = d.map(f64::from);
        Some((d[0] * (1.0 - fx) + d[1] * fx) * (1.0 - fy) + (d[2] * (1.0 - fx) + d[3] * fx) * fy)
    }

    /// Point (mm) under a picture position in 1/256 px at a depth in units.
    pub fn point_mm(&self, x: i32, y: i32, depth: f64) -> DVec3 {
        self.back.point_mm(f64::from(x) / 256.0, f64::from(y) / 256.0, depth)
    }

    /// Surface under a picture position in 1/256 px, its normal over two pixels either side.
    pub fn sample(&self, x: i32, y: i32, step_limit: i32) -> Option<Sample> {
        let reach = 2 << PX_BITS;
        let depth = |dx: i32, dy: i32| self.depth_at(x + dx, y + dy, step_limit);
        let centre = depth(0, 0)?;
        let slope = |a: Option<f64>, b: Option<f64>| match (a, b) {
            (Some(a), Some(b)) => Some((b - a) / 2.0),
            (Some(a), None) => Some(centre - a),
            (None, Some(b)) => Some(b - centre),
            _ => None,
        };
        let sx = slope(depth(-reach, 0), depth(reach, 0))?;
        let sy = slope(depth(0, -reach), depth(0, reach))?;
        let point_mm = self.point_mm(x, y, centre);
        let u = self.point_mm(x + reach, y, centre + sx) - point_mm;
        let v = self.point_mm(x, y + reach, centre + sy) - point_mm;
        // Rows go down: v x u looks at the camera.
        Some(Sample { point_mm, normal: v.cross(u).normalize_or_zero() })
    }
}

fn on_centres(seen: &[Option<Seen>], width: usize, height: usize) -> Option<Vec<i32>> {
    let mut depth = vec![NOTHING; width * height];
    for s in seen.iter().flatten() {
        let (x, y) = ((s.x + 128) >> PX_BITS, (s.y + 128) >> PX_BITS);
        let near = |v: i32, p: i32| (v - (p << PX_BITS)).abs() <= CENTRE_TOLERANCE;
        let inside = x >= 0 && y >= 0 && (x as usize) < width && (y as usize) < height;
        if !(near(s.x, x) && near(s.y, y) && inside) {
            return None;
        }
        let at = y as usize * width + x as usize;
        depth[at] = depth[at].min(s.depth);
    }
    Some(depth)
}
