//! Scans of one camera as depth pictures, and back.
//!
//! A scanner's mesh has a vertex a pixel, and its texture coordinates say which. With the depth along the camera's axis
//! (the z of its files) x and y of a vertex are linear in 1, u, v, z, z u, z v: for an orthographic camera the terms with
//! z vanish, for a pinhole all others. Twelve numbers for a whole session bring x and y back.

use crate::sweep::SweepInput;
use faer::Mat;
use faer::linalg::solvers::SolveLstsq;
use glam::Vec3;
use gv3_codec::Scan;
use gv3_codec::mesh::TriMesh;

/// A vertex farther than this from the middle of a pixel is on none, pixels.
const MAX_OFF_PX: f32 = 0.1;
/// x and y may be off by this after fitting, root mean square.
const MAX_FIT_RMS_MM: f64 = 0.02;
/// Vertices fitted: one in this many.
const FIT_EVERY: usize = 11;
/// What the decoder must be told besides pictures: twelve numbers, and the largest step.
pub(super) const SIDE_BYTES: u64 = 13 * 4;

/// How pictures and surfaces of a session belong together.
#[derive(Debug, Clone)]
pub(super) struct DepthGrid {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Weights of 1, u, v, z, z u, z v for x and for y.
    weights: [[f64; 6]; 2],
    /// Neighbouring pixels farther apart in depth are not joined.
    max_step_mm: f32,
    /// Whether triangles run clockwise in the picture.
    is_clockwise: bool,
}

impl DepthGrid {
    /// Fits the grid to scans, or says why they are no depth pictures.
    pub(super) fn fit(input: &SweepInput) -> Result<Self, String> {
        let size = |scan: &Scan| scan.texture.as_ref().map(|t| (t.width_px as usize, t.height_px as usize));
        let (width, height) = size(&input.scans[0]).ok_or("the scans have no pictures, so no pixels are known")?;
        let mut grid = Self { width, height, weights: [[0.0; 6]; 2], max_step_mm: 0.0, is_clockwise: false };
        let (mut rows, mut facing) = (Vec::new(), 0.0);
        for scan in &input.scans {
            if size(scan) != Some((width, height)) {
                return Err(format!("the picture of tick {} has another size than the first", scan.tick));
            }
            let pixels = grid.pixels(scan)?;
            let fitted = pixels.iter().zip(&scan.mesh.positions_mm).step_by(FIT_EVERY);
            rows.extend(fitted.map(|(&at, &p)| (grid.terms(at, p.z), p)));
            for (t, corners) in scan.mesh.triangles.iter().enumerate() {
                let [a, b, c] = scan.mesh.corners(t).map(|p| p.z);
                grid.max_step_mm = grid.max_step_mm.max(a.max(b).max(c) - a.min(b).min(c));
                facing += turn(corners.map(|v| pixels[v as usize]), width);
            }
        }
        grid.is_clockwise = facing > 0.0;
        grid.solve(&rows)?;
        Ok(grid)
    }

    fn solve(&mut self, rows: &[([f64; 6], Vec3)]) -> Result<(), String> {
        let terms = Mat::from_fn(rows.len(), 6, |i, j| rows[i].0[j]);
        let places = Mat::from_fn(rows.len(), 2, |i, j| f64::from(rows[i].1[j]));
        let solution = terms.col_piv_qr().solve_lstsq(&places);
        self.weights = [0, 1].map(|j| std::array::from_fn(|i| solution[(i, j)]));
        let off2 = |(terms, p): &([f64; 6], Vec3)| {
            let [x, y] = self.weights.map(|w| w.iter().zip(terms).map(|(w, t)| w * t).sum::<f64>());
            (x - f64::from(p.x)).powi(2) + (y - f64::from(p.y)).powi(2)
        };
        let rms_mm = (rows.iter().map(off2).sum::<f64>() / rows.len().max(1) as f64).sqrt();
        if rms_mm > MAX_FIT_RMS_MM || !rms_mm.is_finite() {
            return Err(format!(
                "the scans are no depth pictures of one camera along z: x and y are off by {rms_mm:.3} mm rms"
            ));
        }
        Ok(())
    }

    /// Scaled to the picture's size, so that the columns of the fit are alike.
    fn terms(&self, at: usize, z: f32) -> [f64; 6] {
        let (u, v) = ((at % self.width) as f64 / self.width as f64, (at / self.width) as f64 / self.height as f64);
        let z = f64::from(z) * 1e-2;
        [1.0, u, v, z, z * u, z * v]
    }

    /// Pixel of every vertex.
    fn pixels(&self, scan: &Scan) -> Result<Vec<usize>, String> {
        let (picture, uv) =
            scan.texture.as_ref().zip(scan.mesh.uv.as_ref()).ok_or("a scan has no texture coordinates")?;
        let pixel = |&uv: &[f32; 2]| {
            let [x, y] = picture.uv_to_px(uv);
            let is_on = (x - x.round()).abs().max((y - y.round()).abs()) <= MAX_OFF_PX;
            let (column, row) = (x.round(), y.round());
            let inside = column >= 0.0 && row >= 0.0 && (column as usize) < self.width && (row as usize) < self.height;
            (is_on && inside).then(|| row as usize * self.width + column as usize)
        };
        let pixels: Option<Vec<usize>> = uv.iter().map(pixel).collect();
        pixels.ok_or_else(|| format!("vertices of tick {} are not on the pixels of the picture", scan.tick))
    }

    /// Depth of every pixel, NaN where there is no vertex.
    pub(super) fn depths_mm(&self, scan: &Scan) -> Result<Vec<f32>, String> {
        let mut depths = vec![f32::NAN; self.width * self.height];
        for (at, p) in self.pixels(scan)?.into_iter().zip(&scan.mesh.positions_mm) {
            depths[at] = p.z;
        }
        Ok(depths)
    }

    /// The surface of a depth picture.
    pub(super) fn mesh(&self, depths_mm: &[f32]) -> TriMesh {
        let mut mesh = TriMesh::default();
        let mut vertex = vec![u32::MAX; depths_mm.len()];
        for (at, &z) in depths_mm.iter().enumerate().filter(|(_, z)| z.is_finite()) {
            vertex[at] = mesh.positions_mm.len() as u32;
            let terms = self.terms(at, z);
            let [x, y] = self.weights.map(|w| w.iter().zip(terms).map(|(w, t)| w * t).sum::<f64>());
            mesh.positions_mm.push(Vec3::new(x as f32, y as f32, z));
        }
        let joined = |corners: &[usize; 3]| {
            let [a, b, c] = corners.map(|at| depths_mm[at]);
            // NaN, where there is no vertex, is not within the step.
            a + b + c == a + b + c && a.max(b).max(c) - a.min(b).min(c) <= self.max_step_mm
        };
        for row in 0..self.height.saturating_sub(1) {
            for column in 0..self.width - 1 {
                let a = row * self.width + column;
                let (b, c, d) = (a + 1, a + self.width, a + self.width + 1);
                // Both ways to cut the cell in two; the other one where a corner of the first is missing.
                let (first, second) = ([[a, b, d], [a, d, c]], [[a, b, c], [b, d, c]]);
                let cut = if depths_mm[a].is_finite() && depths_mm[d].is_finite() { first } else { second };
                for corners in cut.iter().filter(|corners| joined(corners)) {
                    let [p, q, r] = corners.map(|at| vertex[at]);
                    mesh.triangles.push(if self.is_clockwise { [p, q, r] } else { [p, r, q] });
                }
            }
        }
        mesh
    }
}

/// Twice the signed area of a triangle of pixels; positive when it runs clockwise on the picture, whose y points down.
fn turn(corners: [usize; 3], width: usize) -> f64 {
    let [a, b, c] = corners.map(|at| ((at % width) as f64, (at / width) as f64));
    (b.0 - a.0) * (c.1 - a.1) - (b.1 - a.1) * (c.0 - a.0)
}

/// Fills pixels without value smoothly from those with (push-pull: S. J. Gortler et al., "The lumigraph", 1996), so that a
/// picture codec finds no edge there. Zeros when there are no values at all.
pub(super) fn push_pull(values: &mut [f32], width: usize, height: usize) {
    if values.iter().all(|v| v.is_finite()) {
        return;
    }
    if width <= 1 && height <= 1 {
        values.fill(0.0);
        return;
    }
    let (w, h) = (width.div_ceil(2), height.div_ceil(2));
    let (mut sums, mut counts) = (vec![0f32; w * h], vec![0u32; w * h]);
    for (at, v) in values.iter().enumerate().filter(|(_, v)| v.is_finite()) {
        let up = at / width / 2 * w + at % width / 2;
        sums[up] += v;
        counts[up] += 1;
    }
    let mut coarse: Vec<f32> =
        sums.iter().zip(&counts).map(|(s, &n)| if n > 0 { s / n as f32 } else { f32::NAN }).collect();
    push_pull(&mut coarse, w, h);
    for (at, value) in values.iter_mut().enumerate().filter(|(_, v)| !v.is_finite()) {
        let (x, y) = (((at % width) as f32 - 0.5) / 2.0, ((at / width) as f32 - 0.5) / 2.0);
        let (x, y) = (x.clamp(0.0, (w - 1) as f32), y.clamp(0.0, (h - 1) as f32));
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let row = |y: usize| coarse[y * w + x0] * (1.0 - fx) + coarse[y * w + x1] * fx;
        *value = row(y0) * (1.0 - fy) + row(y1) * fy;
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use gv3_codec::GreyPicture;

    /// A smooth hill on a disk of n by n pixels of 0.5 mm, with texture coordinates on the pixels' middles, moved up by
    /// `lift_mm`.
    pub fn hill(n: usize, lift_mm: f32) -> Scan {
        let picture = GreyPicture::filled(n as u32, n as u32, 100);
        let grid = DepthGrid {
            width: n,
            height: n,
            weights: [[0.0, 0.5 * n as f64, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, -0.5 * n as f64, 0.0, 0.0, 0.0]],
            max_step_mm: 9.0,
            is_clockwise: false,
        };
        let middle = n as f32 / 2.0;
        let depth = |at: usize| {
            let (x, y) = ((at % n) as f32 - middle, (at / n) as f32 - middle);
            let r2 = (x * x + y * y) / (middle * middle);
            if r2 < 0.9 { 10.0 * (-2.0 * r2).exp() + 0.5 * (x * 0.3).sin() + lift_mm } else { f32::NAN }
        };
        let depths: Vec<f32> = (0..n * n).map(depth).collect();
        let uv = (0..n * n)
            .filter(|&at| depths[at].is_finite())
            .map(|at| picture.px_to_uv([(at % n) as f32, (at / n) as f32]))
            .collect();
        let mesh = TriMesh { uv: Some(uv), ..grid.mesh(&depths) };
        Scan { mesh, texture: Some(picture), ..Scan::default() }
    }

    /// Hills that rise, as a sweep's input.
    pub fn rising(n: usize, scans: usize) -> SweepInput {
        let scan = |i: usize| Scan { tick: i as u64, time_nanos: 10 * i as u64, ..hill(n, 0.2 * i as f32) };
        let scans: Vec<Scan> = (0..scans).map(scan).collect();
        SweepInput { scans, period_nanos: 10, obj_bmp_bytes: 1, binary_bytes: 1 }
    }

    #[test]
    fn surfaces_become_pictures_and_come_back() {
        let input = rising(40, 3);
        let grid = DepthGrid::fit(&input).unwrap();
        for scan in &input.scans {
            let back = grid.mesh(&grid.depths_mm(scan).unwrap());
            assert_eq!(back.triangles, scan.mesh.triangles);
            let off = back.positions_mm.iter().zip(&scan.mesh.positions_mm).map(|(a, b)| a.distance(*b));
            assert!(off.fold(0.0, f32::max) < 1e-4);
        }
    }

    #[test]
    fn a_pinhole_camera_is_fitted_too() {
        let mut input = rising(40, 2);
        for p in input.scans.iter_mut().flat_map(|s| &mut s.mesh.positions_mm) {
            p.z += 300.0;
            (p.x, p.y) = ((p.x - 7.0) * p.z / 300.0, (p.y + 9.0) * p.z / 300.0);
        }
        let grid = DepthGrid::fit(&input).unwrap();
        let back = grid.mesh(&grid.depths_mm(&input.scans[1]).unwrap());
        let off = back.positions_mm.iter().zip(&input.scans[1].mesh.positions_mm).map(|(a, b)| a.distance(*b));
        assert!(off.fold(0.0, f32::max) < 1e-3);
    }

    #[test]
    fn scans_that_are_no_depth_pictures_are_refused_with_the_reason() {
        let mut input = rising(20, 1);
        input.scans[0].mesh.positions_mm.iter_mut().for_each(|p| p.x += 0.01 * p.z * p.z);
        assert!(DepthGrid::fit(&input).unwrap_err().contains("no depth pictures"));
        let mut input = rising(20, 1);
        input.scans[0].mesh.uv = None;
        assert!(DepthGrid::fit(&input).unwrap_err().contains("texture coordinates"));
        let mut input = rising(20, 1);
        input.scans[0].texture = None;
        assert!(DepthGrid::fit(&input).unwrap_err().contains("no pictures"));
    }

    #[test]
    fn holes_are_filled_within_the_range_of_the_values() {
        let mut values: Vec<f32> =
            (0..33 * 17).map(|k| if (k % 33) < 12 { (k / 33) as f32 } else { f32::NAN }).collect();
        let known = values.clone();
        push_pull(&mut values, 33, 17);
        assert!(values.iter().all(|v| (0.0..=16.0).contains(v)));
        assert!(values.iter().zip(&known).all(|(v, k)| k.is_nan() || v == k));
        let mut none = vec![f32::NAN; 6];
        push_pull(&mut none, 3, 2);
        assert_eq!(none, [0.0; 6]);
    }
}
