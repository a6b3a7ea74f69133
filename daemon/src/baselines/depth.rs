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
use std::collections::BTreeMap;

/// A vertex farther than this from the middle of a pixel is on none, pixels.
const MAX_OFF_PX: f32 = 0.1;
/// x and y may be off by this after fitting, root mean square.
const MAX_FIT_RMS_MM: f64 = 0.02;
/// A picture's corner farther than this from the first's is none.
const MAX_CORNER_PX: f64 = 4096.0;
/// Unit of columns and rows in the fit.
const SCALE_PX: f64 = 512.0;
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
    /// By tick: where the scan's own picture, which may be a part of the camera's, lies in the common one.
    corners: BTreeMap<u64, Corner>,
}

/// Upper left corner of a scan's picture: the pixel, and what remains when the pictures are not in step, pixels.
#[derive(Debug, Clone, Copy, Default)]
struct Corner {
    pixel: [i32; 2],
    rest: [f32; 2],
}

impl DepthGrid {
    /// Fits the grid to scans, or says why they are no depth pictures.
    pub(super) fn fit(input: &SweepInput) -> Result<Self, String> {
        let mut grid = Self {
            width: 0,
            height: 0,
            weights: [[0.0; 6]; 2],
            max_step_mm: 0.0,
            is_clockwise: false,
            corners: BTreeMap::new(),
        };
        let (mut rows, mut facing) = (Vec::new(), 0.0);
        let (mut low, mut high) = ([i32::MAX; 2], [i32::MIN; 2]);
        for scan in &input.scans {
            let own = own_pixels(scan)?;
            let fitted = || own.iter().zip(&scan.mesh.positions_mm).step_by(FIT_EVERY);
            if rows.is_empty() {
                // The first scan says where the camera is, the others where in its picture they lie.
                rows.extend(fitted().map(|(&at, &p)| (terms(at, [0.0; 2], p.z), p)));
                grid.solve(&rows)?;
            }
            let corner = grid.corner(fitted()).map_err(|off| format!("tick {}: {off}", scan.tick))?;
            grid.corners.insert(scan.tick, corner);
            let pixels: Vec<[i32; 2]> =
                own.iter().map(|at| [at[0] + corner.pixel[0], at[1] + corner.pixel[1]]).collect();
            for k in 0..2 {
                low[k] = pixels.iter().fold(low[k], |low, at| low.min(at[k]));
                high[k] = pixels.iter().fold(high[k], |high, at| high.max(at[k]));
            }
            for (t, corners) in scan.mesh.triangles.iter().enumerate() {
                let [a, b, c] = scan.mesh.corners(t).map(|p| p.z);
                grid.max_step_mm = grid.max_step_mm.max(a.max(b).max(c) - a.min(b).min(c));
                facing += turn(corners.map(|v| pixels[v as usize]));
            }
        }
        grid.corners.values_mut().for_each(|c| c.pixel = [c.pixel[0] - low[0], c.pixel[1] - low[1]]);
        [grid.width, grid.height] = [0, 1].map(|k| (high[k] - low[k] + 1).max(1) as usize);
        grid.is_clockwise = facing > 0.0;
        grid.refit(input)?;
        Ok(grid)
    }

    /// Fits the camera again, to all scans and in columns and rows of the common picture.
    fn refit(&mut self, input: &SweepInput) -> Result<(), String> {
        let mut rows = Vec::new();
        for scan in &input.scans {
            let pixels = self.pixels(scan)?;
            let fitted = pixels.iter().zip(&scan.mesh.positions_mm).step_by(FIT_EVERY);
            let rest = self.rest_px(scan);
            rows.extend(fitted.map(|(&at, &p)| (self.terms_at(at, rest, p.z), p)));
        }
        self.solve(&rows)
    }

    fn solve(&mut self, rows: &[([f64; 6], Vec3)]) -> Result<(), String> {
        let terms = Mat::from_fn(rows.len(), 6, |i, j| rows[i].0[j]);
        let places = Mat::from_fn(rows.len(), 2, |i, j| f64::from(rows[i].1[j]));
        let solution = terms.col_piv_qr().solve_lstsq(&places);
        self.weights = [0, 1].map(|j| std::array::from_fn(|i| solution[(i, j)]));
        let off2 = |(terms, p): &([f64; 6], Vec3)| {
            let [x, y] = self.place(terms);
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

    /// x and y of a vertex, mm.
    fn place(&self, terms: &[f64; 6]) -> [f64; 2] {
        self.weights.map(|w| w.iter().zip(terms).map(|(w, t)| w * t).sum())
    }

    /// Where in the first scan's picture another one's begins: least squares on what x and y differ by.
    fn corner<'a>(&self, vertices: impl Iterator<Item = (&'a [i32; 2], &'a Vec3)>) -> Result<Corner, String> {
        let (mut normal, mut right) = ([[0.0; 2]; 2], [0.0; 2]);
        for (&at, p) in vertices {
            let terms = terms(at, [0.0; 2], p.z);
            let place = self.place(&terms);
            for (k, w) in self.weights.iter().enumerate() {
                let off = f64::from(p[k]) - place[k];
                let slope = [(w[1] + w[4] * terms[3]) / SCALE_PX, (w[2] + w[5] * terms[3]) / SCALE_PX];
                for i in 0..2 {
                    right[i] += slope[i] * off;
                    (0..2).for_each(|j| normal[i][j] += slope[i] * slope[j]);
                }
            }
        }
        let [[a, b], [c, d]] = normal;
        let determinant = a * d - b * c;
        let shift = [(d * right[0] - b * right[1]) / determinant, (a * right[1] - c * right[0]) / determinant];
        if !shift.iter().all(|s: &f64| s.abs() < MAX_CORNER_PX) {
            return Err(format!("its picture lies {:.0}, {:.0} pixels from that of the first", shift[0], shift[1]));
        }
        let pixel = shift.map(|s| s.round() as i32);
        Ok(Corner { pixel, rest: [0, 1].map(|k| (shift[k] - shift[k].round()) as f32) })
    }

    /// By how much the pixels of a scan are out of step with the common picture, pixels; the decoder must know.
    pub(super) fn rest_px(&self, scan: &Scan) -> [f32; 2] {
        self.corners.get(&scan.tick).map_or([0.0; 2], |corner| corner.rest)
    }

    /// Terms at an index into the common picture.
    fn terms_at(&self, at: usize, rest: [f32; 2], z: f32) -> [f64; 6] {
        terms([(at % self.width) as i32, (at / self.width) as i32], rest, z)
    }

    /// Index into the common picture of every vertex.
    fn pixels(&self, scan: &Scan) -> Result<Vec<usize>, String> {
        let corner = self.corners.get(&scan.tick).ok_or_else(|| format!("tick {} is of another session", scan.tick))?;
        let index = |at: [i32; 2]| {
            let [column, row] = [at[0] + corner.pixel[0], at[1] + corner.pixel[1]].map(|k| usize::try_from(k).ok());
            let (column, row) = (column.filter(|&k| k < self.width)?, row.filter(|&k| k < self.height)?);
            Some(row * self.width + column)
        };
        let pixels: Option<Vec<usize>> = own_pixels(scan)?.into_iter().map(index).collect();
        pixels.ok_or_else(|| format!("vertices of tick {} lie outside the picture", scan.tick))
    }

    /// Depth of every pixel, NaN where there is no vertex.
    pub(super) fn depths_mm(&self, scan: &Scan) -> Result<Vec<f32>, String> {
        let mut depths = vec![f32::NAN; self.width * self.height];
        for (at, p) in self.pixels(scan)?.into_iter().zip(&scan.mesh.positions_mm) {
            depths[at] = p.z;
        }
        Ok(depths)
    }

    /// The surface of a depth picture whose depths were rounded to a step and whose pixels are out of step by `rest_px`.
    pub(super) fn mesh(&self, depths_mm: &[f32], rounding_mm: f32, rest_px: [f32; 2]) -> TriMesh {
        let mut mesh = TriMesh::default();
        let mut vertex = vec![u32::MAX; depths_mm.len()];
        for (at, &z) in depths_mm.iter().enumerate().filter(|(_, z)| z.is_finite()) {
            vertex[at] = mesh.positions_mm.len() as u32;
            let [x, y] = self.place(&self.terms_at(at, rest_px, z));
            mesh.positions_mm.push(Vec3::new(x as f32, y as f32, z));
        }
        let joined = |corners: &[usize; 3]| {
            let depths = corners.map(|at| depths_mm[at]);
            let [a, b, c] = depths;
            depths.iter().all(|z| z.is_finite()) && a.max(b).max(c) - a.min(b).min(c) <= self.max_step_mm + rounding_mm
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

/// Scaled so that the columns of the fit are alike.
fn terms([column, row]: [i32; 2], rest: [f32; 2], z: f32) -> [f64; 6] {
    let [u, v] = [f64::from(column) + f64::from(rest[0]), f64::from(row) + f64::from(rest[1])].map(|k| k / SCALE_PX);
    let z = f64::from(z) * 1e-2;
    [1.0, u, v, z, z * u, z * v]
}

/// Column and row of every vertex in the scan's own picture.
fn own_pixels(scan: &Scan) -> Result<Vec<[i32; 2]>, String> {
    let picture = scan.texture.as_ref().ok_or("the scans have no pictures, so no pixels are known")?;
    let uv = scan.mesh.uv.as_ref().ok_or("the scans have no texture coordinates, so no pixels are known")?;
    let pixel = |&uv: &[f32; 2]| {
        let [x, y] = picture.uv_to_px(uv);
        let off = (x - x.round()).abs().max((y - y.round()).abs());
        (off <= MAX_OFF_PX).then_some([x.round() as i32, y.round() as i32])
    };
    let pixels: Option<Vec<[i32; 2]>> = uv.iter().map(pixel).collect();
    pixels.ok_or_else(|| format!("vertices of tick {} are not on the pixels of the picture", scan.tick))
}

/// Twice the signed area of a triangle of pixels; positive when it runs clockwise on the picture, whose y points down.
fn turn([a, b, c]: [[i32; 2]; 3]) -> f64 {
    f64::from(b[0] - a[0]) * f64::from(c[1] - a[1]) - f64::from(b[1] - a[1]) * f64::from(c[0] - a[0])
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
mod tests {
    use super::*;
    use crate::sweep::test_scans::rising;
    use gv3_codec::GreyPicture;

    #[test]
    fn surfaces_become_pictures_and_come_back() {
        let input = rising(40, 3);
        let grid = DepthGrid::fit(&input).unwrap();
        for scan in &input.scans {
            let back = grid.mesh(&grid.depths_mm(scan).unwrap(), 0.0, grid.rest_px(scan));
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
        let back = grid.mesh(&grid.depths_mm(&input.scans[1]).unwrap(), 0.0, [0.0; 2]);
        let off = back.positions_mm.iter().zip(&input.scans[1].mesh.positions_mm).map(|(a, b)| a.distance(*b));
        assert!(off.fold(0.0, f32::max) < 1e-3);
    }

    #[test]
    fn pictures_cut_from_the_cameras_are_laid_over_each_other() {
        let mut input = rising(40, 3);
        let picture = GreyPicture::filled(50, 60, 0);
        let scan = &mut input.scans[1];
        let cut = |t: &[f32; 2]| {
            let [x, y] = GreyPicture::filled(40, 40, 0).uv_to_px(*t);
            picture.px_to_uv([x + 3.0, y + 17.0])
        };
        scan.mesh.uv = scan.mesh.uv.as_ref().map(|uv| uv.iter().map(cut).collect());
        scan.texture = Some(picture.clone());
        let grid = DepthGrid::fit(&input).unwrap();
        // The disk spans 38 pixels; the cut one begins 3 left and 17 above of the others.
        assert!((37..=39).contains(&grid.width) && (37..=39).contains(&grid.height), "{} {}", grid.width, grid.height);
        let depths = [0, 1, 2].map(|i| grid.depths_mm(&input.scans[i]).unwrap());
        for (a, b) in depths[0].iter().zip(&depths[1]) {
            assert!((a + 0.2 - b).abs() < 1e-4 || a.is_nan() && b.is_nan());
        }
    }

    #[test]
    fn pictures_out_of_step_by_part_of_a_pixel_are_fitted() {
        let mut input = rising(40, 2);
        input.scans[1].mesh.positions_mm.iter_mut().for_each(|p| *p += Vec3::new(0.15, -0.2, 0.0));
        let grid = DepthGrid::fit(&input).unwrap();
        let scan = &input.scans[1];
        let back = grid.mesh(&grid.depths_mm(scan).unwrap(), 0.0, grid.rest_px(scan));
        let off = back.positions_mm.iter().zip(&scan.mesh.positions_mm).map(|(a, b)| a.distance(*b));
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
