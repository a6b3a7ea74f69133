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

/// Triangles up to this wide and high are small, 1/256 px: their areas fit 31 bits.
const SMALL: i32 = 32 << PX_BITS;
/// Normals are taken over so many pixels either side.
const REACH_PX: i32 = 2;

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
        let view = view.moved(window.offset);
        let depth = on_centres(scan, &view, window).unwrap_or_else(|| drawn(scan, &view, window));
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
        bilinear(d, weights(x, y), step_limit)
    }

    /// As [`Self::depth_at`] at the position and two pixels to the left, right, above and below.
    fn depth_around(&self, x: i32, y: i32, step_limit: i32) -> Option<[Option<f64>; 5]> {
        const AROUND: [[i32; 2]; 5] = [[0, 0], [-REACH_PX, 0], [REACH_PX, 0], [0, -REACH_PX], [0, REACH_PX]];
        let (px, py) = (x >> PX_BITS, y >> PX_BITS);
        let (width, height) = (self.window.width as i32, self.window.height as i32);
        let is_inside = px >= REACH_PX && py >= REACH_PX && px + REACH_PX + 1 < width && py + REACH_PX + 1 < height;
        if !is_inside {
            let depth = |[dx, dy]: [i32; 2]| self.depth_at(x + (dx << PX_BITS), y + (dy << PX_BITS), step_limit);
            return depth([0, 0]).map(|_| AROUND.map(depth));
        }
        let weights = weights(x, y);
        let depth = |[dx, dy]: [i32; 2]| {
            let at = ((py + dy) * width + px + dx) as usize;
            let (upper, lower) = (&self.depth[at..at + 2], &self.depth[at + width as usize..at + width as usize + 2]);
            bilinear([upper[0], upper[1], lower[0], lower[1]], weights, step_limit)
        };
        depth([0, 0]).map(|_| AROUND.map(depth))
    }

    /// Point (mm) under a picture position in 1/256 px at a depth in units.
    pub fn point_mm(&self, x: i32, y: i32, depth: f64) -> DVec3 {
        self.back.point_mm(f64::from(x) / 256.0, f64::from(y) / 256.0, depth)
    }

    /// Surface under a picture position in 1/256 px, its normal over two pixels either side.
    pub fn sample(&self, x: i32, y: i32, step_limit: i32) -> Option<Sample> {
        let [centre, left, right, above, below] = self.depth_around(x, y, step_limit)?;
        let centre = centre?;
        let slope = |a: Option<f64>, b: Option<f64>| match (a, b) {
            (Some(a), Some(b)) => Some((b - a) / 2.0),
            (Some(a), None) => Some(centre - a),
            (None, Some(b)) => Some(b - centre),
            _ => None,
        };
        let (sx, sy) = (slope(left, right)?, slope(above, below)?);
        let (x_px, y_px, reach) = (f64::from(x) / 256.0, f64::from(y) / 256.0, f64::from(REACH_PX));
        let row = self.back.row(y_px);
        let point_mm = row.point_mm(x_px, centre);
        let u = row.point_mm(x_px + reach, centre + sx) - point_mm;
        let v = self.back.point_mm(x_px, y_px + reach, centre + sy) - point_mm;
        // Rows go down: v x u looks at the camera.
        Some(Sample { point_mm, normal: v.cross(u).normalize_or_zero() })
    }
}

/// Weights of four pixels around a position in 1/256 px.
fn weights(x: i32, y: i32) -> [f64; 4] {
    let fraction = |v: i32| f64::from(v & 255) / 256.0;
    let (fx, fy) = (fraction(x), fraction(y));
    [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy]
}

/// Weighted sum of four depths that are on the surface within `step_limit` of each other.
fn bilinear(d: [i32; 4], weights: [f64; 4], step_limit: i32) -> Option<f64> {
    let (least, most) = (d[0].min(d[1]).min(d[2]).min(d[3]), d[0].max(d[1]).max(d[2]).max(d[3]));
    let is_surface = most != NOTHING && most - least <= step_limit;
    is_surface.then(|| d.iter().zip(weights).map(|(d, w)| f64::from(*d) * w).sum())
}

/// Depths of a scan whose vertices lie anywhere, as behind a lens that is not the view's.
fn drawn(scan: &Scan, view: &View, window: Window) -> Vec<i32> {
    // Halves away from zero, without the library's rounding.
    let to_units = |v: f32| {
        let units = f64::from(v) * f64::from(UNITS_PER_MM);
        (units + 0.5_f64.copysign(units)) as i32
    };
    let seen: Vec<Seen> = scan
        .mesh
        .positions_mm
        .iter()
        .map(|p| view.project(p.to_array().map(to_units)).unwrap_or(Seen::NOWHERE))
        .collect();
    let mut picture = DepthPicture::new(window.width, window.height);
    for (i, &[a, b, c]) in scan.mesh.triangles.iter().enumerate() {
        let (a, b, c) = (&seen[a as usize], &seen[b as usize], &seen[c as usize]);
        if !draw_small(&mut picture.depth, [window.width, window.height], a, b, c) {
            picture.draw(i as u32, [*a, *b, *c]);
        }
    }
    picture.depth
}

/// Draws the depth of a front-facing triangle as [`DepthPicture::draw`] does, edges included and depth in floating point, in a
/// fraction of its time for a triangle as small as a pixel; false for one that is not small.
fn draw_small(depth: &mut [i32], [width, height]: [usize; 2], a: &Seen, b: &Seen, c: &Seen) -> bool {
    let (x0, x1) = (a.x.min(b.x).min(c.x), a.x.max(b.x).max(c.x));
    let (y0, y1) = (a.y.min(b.y).min(c.y), a.y.max(b.y).max(c.y));
    if x1 - x0 > SMALL || y1 - y0 > SMALL {
        return false;
    }
    let up = |v: i32| ((v + 255) >> PX_BITS).max(0);
    let (columns, rows) =
        (up(x0)..((x1 >> PX_BITS) + 1).min(width as i32), up(y0)..((y1 >> PX_BITS) + 1).min(height as i32));
    let cross = |u: [i32; 2], v: [i32; 2]| u[1] * v[0] - u[0] * v[1];
    let (ab, ac) = ([b.x - a.x, b.y - a.y], [c.x - a.x, c.y - a.y]);
    let area = cross(ab, ac);
    if area <= 0 {
        return true;
    }
    for y in rows {
        for x in columns.clone() {
            let p = [(x << PX_BITS) - a.x, (y << PX_BITS) - a.y];
            let (of_b, of_c) = (cross(p, ac), cross(ab, p));
            if (of_b | of_c | (area - of_b - of_c)) >= 0 {
                let [to_b, to_c] = [b.depth - a.depth, c.depth - a.depth].map(|d| d as f32);
                let more = (of_b as f32 * to_b + of_c as f32 * to_c) / area as f32;
                let nearest = &mut depth[y as usize * width + x as usize];
                *nearest = (*nearest).min(a.depth.saturating_add((more + 0.5_f32.copysign(more)) as i32));
            }
        }
    }
    true
}

/// Depths of a scan whose vertices all lie on centres of pixels; `None` for any other.
fn on_centres(scan: &Scan, view: &View, window: Window) -> Option<Vec<i32>> {
    let units = f64::from(UNITS_PER_MM);
    let vector = |r: &[i64]| DVec3::new(r[0] as f64, r[1] as f64, r[2] as f64) * units;
    let [across, down, away] = [0, 1, 2].map(|r| (vector(&view.rows[r]), view.rows[r][3] as f64));
    let axis = view.back_projection();
    let tolerance = f64::from(CENTRE_TOLERANCE) / 256.0;
    let (width, height) = (window.width as f64, window.height as f64);
    let mut depth = vec![NOTHING; window.width * window.height];
    for p in scan.mesh.positions_mm.iter().map(|p| p.as_dvec3()) {
        let divisor = away.0.dot(p) + away.1;
        let by = 1.0 / divisor;
        let [x, y] = [across, down].map(|(row, constant)| (row.dot(p) + constant) * by);
        // Halves up, without the library's rounding.
        let [px, py] = [x, y].map(|v| (v + 0.5).floor());
        let is_near = (x - px).abs() <= tolerance && (y - py).abs() <= tolerance;
        let is_inside = px >= 0.0 && py >= 0.0 && px < width && py < height;
        if !(divisor > 0.0 && is_near && is_inside) {
            return None;
        }
        let at = py as usize * window.width + px as usize;
        depth[at] = depth[at].min((axis.depth_of(p) + 0.5).floor() as i32);
    }
    Some(depth)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn small_triangles_are_drawn_as_all_are(
            corners in prop::array::uniform3((-600_i32..6000, -600_i32..6000, 100_000_i32..110_000)),
        ) {
            let corners = corners.map(|(x, y, depth)| Seen { x, y, depth });
            let mut picture = DepthPicture::new(20, 20);
            picture.draw(0, corners);
            let mut depth = vec![NOTHING; 400];
            prop_assert!(draw_small(&mut depth, [20, 20], &corners[0], &corners[1], &corners[2]));
            // Slopes of slivers are large; a plane is that of its corners within a unit all the same.
            let cross = |u: [i64; 2], v: [i64; 2]| u[1] * v[0] - u[0] * v[1];
            let from = |to: Seen| [i64::from(to.x - corners[0].x), i64::from(to.y - corners[0].y)];
            let (ab, ac) = (from(corners[1]), from(corners[2]));
            for (i, (fine, exact)) in depth.iter().zip(&picture.depth).enumerate() {
                let p = from(Seen { x: ((i % 20) << PX_BITS) as i32, y: ((i / 20) << PX_BITS) as i32, depth: 0 });
                let is_on_edge = cross(p, ac) == 0 || cross(ab, p) == 0 || cross(ab, ac) == cross(p, ac) + cross(ab, p);
                prop_assert!((*fine == NOTHING) == (*exact == NOTHING) || is_on_edge);
                if *fine != NOTHING && *exact != NOTHING && cross(ab, ac) > 1 << 14 {
                    prop_assert!((fine - exact).abs() <= 2, "{fine} for {exact}");
                }
            }
        }
    }

    #[test]
    fn large_triangles_are_left_to_others() {
        let seen = |x: i32, y: i32| Seen { x, y, depth: 9 };
        let mut depth = vec![NOTHING; 4];
        let mut draw = |b: Seen, c: Seen| {
            let is_small = draw_small(&mut depth, [2, 2], &seen(0, 0), &b, &c);
            (is_small, depth.clone())
        };
        assert_eq!(draw(seen(0, SMALL + 1), seen(300, 0)), (false, vec![NOTHING; 4]));
        assert_eq!(draw(seen(300, 0), seen(0, SMALL)), (true, vec![NOTHING; 4]), "turned away");
        draw(seen(0, SMALL), seen(256, 0));
        assert_eq!(depth, [9, 9, 9, NOTHING]);
    }
}
