//! Finding the base of a shot: the scan laid on the disk, a smooth lattice through it, and what is left along its normals.

use super::UNITS_PER_MM;
use super::base::{CONTROL_SIDE, CodedBase, DIRECTION_BITS, control_surface, on_disk, visit};
use super::lattice::{CELLS_PER_SPAN, GRID_CELLS, GRID_SIDE, Nodes};
use super::scan_image::ScanImage;
use super::view::View;
use crate::Result;
use crate::linalg::{LowerCsc, SparseLlt};
use crate::mesh::TriMesh;
use crate::param::disk::disk_map;
use crate::param::locate::DiskLocator;
use glam::{DVec2, DVec3, Vec3};

/// Radius of the grid's disk in units of the conformal disk: the border of the scan, and room to grow.
pub const GRID_RADIUS: f64 = 1.09;
/// Every this many grid nodes one sample of the control lattice.
const SAMPLE_STRIDE: usize = 2;
/// Farthest that the surface may lie from the control lattice, mm.
const REACH_MM: f64 = 12.0;

/// Steps of a base.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BaseOptions {
    /// Step of control points, units.
    pub control_step: i32,
    /// Step of displacements, units.
    pub displacement_step: i32,
    /// Residuals below this share of a step are not sent.
    pub dead_zone: f64,
    /// Weight of the lattice's second differences.
    pub bending: f64,
}

impl Default for BaseOptions {
    fn default() -> Self {
        Self { control_step: 64, displacement_step: 38, dead_zone: 0.62, bending: 0.02 }
    }
}

/// Fits a base to a disk that is seen in `image`.
///
/// # Errors
/// [`crate::CodecError::Mesh`] when the mesh is no disk or too degenerate.
pub fn fit_base(disk: &TriMesh, image: &ScanImage, view: &View, options: &BaseOptions) -> Result<CodedBase> {
    let map = disk_map(disk)?;
    let targets = targets(disk, &map.points);
    let control = quantized_control(&fit_control(&targets, options.bending)?, options);
    let (surface, normals) = control_surface(&control, options.control_step);
    let wanted = wanted_displacement(&surface, &normals, image, &view.moved(image.window.offset));
    Ok(coded(control, &smooth(&wanted), options))
}

/// Fits a base whose grid nodes stay the points that they are: `moved` is where the model before has them now, units; the
/// surface is taken from `image` where it is seen, and goes on smoothly elsewhere.
///
/// # Errors
/// [`crate::CodecError::Mesh`] when the positions are degenerate.
pub fn refit_base(moved: &[[i32; 3]], image: &ScanImage, view: &View, options: &BaseOptions) -> Result<CodedBase> {
    let to_mm = |p: [i32; 3]| (DVec3::from_array(p.map(f64::from)) / f64::from(UNITS_PER_MM)).as_vec3();
    let nodes =
        (0..GRID_SIDE).step_by(SAMPLE_STRIDE).flat_map(|y| (0..GRID_SIDE).step_by(SAMPLE_STRIDE).map(move |x| (x, y)));
    let targets: Vec<_> =
        nodes.filter(|&(x, y)| on_disk(x, y)).map(|(x, y)| (x, y, to_mm(moved[y * GRID_SIDE + x]))).collect();
    let control = quantized_control(&fit_control(&targets, options.bending)?, options);
    let (surface, normals) = control_surface(&control, options.control_step);
    let wanted = smooth(&wanted_displacement(&surface, &normals, image, &view.moved(image.window.offset)));
    Ok(coded(control, &wanted, options))
}

fn quantized_control(lattice: &[DVec3], options: &BaseOptions) -> Nodes {
    let per_step = f64::from(UNITS_PER_MM) / f64::from(options.control_step);
    lattice.iter().map(|c| (*c * per_step).to_array().map(|v| v.round() as i32)).collect()
}

fn coded(control: Nodes, wanted: &[Option<f64>], options: &BaseOptions) -> CodedBase {
    let residuals = quantize(wanted, options);
    CodedBase { control_step: options.control_step, control, displacement_step: options.displacement_step, residuals }
}

fn place(x: usize, y: usize) -> DVec2 {
    let half = GRID_CELLS as f64 / 2.0;
    DVec2::new(x as f64 - half, y as f64 - half) * (GRID_RADIUS / half)
}

/// Grid nodes inside the conformal disk and the points of the surface there.
fn targets(disk: &TriMesh, points: &[DVec2]) -> Vec<(usize, usize, Vec3)> {
    let locator = DiskLocator::new(points, &disk.triangles);
    let nodes =
        (0..GRID_SIDE).step_by(SAMPLE_STRIDE).flat_map(|y| (0..GRID_SIDE).step_by(SAMPLE_STRIDE).map(move |x| (x, y)));
    nodes
        .filter(|&(x, y)| place(x, y).length() <= 1.0)
        .filter_map(|(x, y)| {
            let at = locator.locate(points, &disk.triangles, place(x, y))?;
            Some((x, y, at.interpolate(&disk.triangles, &disk.positions_mm)))
        })
        .collect()
}

/// Least squares with bending: the control points, mm.
fn fit_control(targets: &[(usize, usize, Vec3)], bending: f64) -> Result<Vec<DVec3>> {
    let n = CONTROL_SIDE;
    let mut system = NormalEquations::new(n * n);
    let cells = CELLS_PER_SPAN * (super::lattice::FINE_SIDE - 3) / (n - 3);
    for &(x, y, p) in targets {
        let axis = |g: usize| {
            let span = (g / cells).min(n - 4);
            let phase = (g - span * cells) as f64 / cells as f64;
            (span, weights(phase))
        };
        let ((sx, wx), (sy, wy)) = (axis(x), axis(y));
        let row: Vec<(usize, f64)> = (0..16).map(|k| ((sy + k / 4) * n + sx + k % 4, wx[k % 4] * wy[k / 4])).collect();
        system.add(&row, p.as_dvec3(), 1.0);
    }
    for y in 0..n {
        for x in 1..n - 1 {
            system.add(&[(y * n + x - 1, 1.0), (y * n + x, -2.0), (y * n + x + 1, 1.0)], DVec3::ZERO, bending);
            system.add(&[((x - 1) * n + y, 1.0), (x * n + y, -2.0), ((x + 1) * n + y, 1.0)], DVec3::ZERO, bending);
        }
    }
    system.solve()
}

fn weights(t: f64) -> [f64; 4] {
    let q = 1.0 - t;
    [q * q * q, 3.0 * t * t * t - 6.0 * t * t + 4.0, 3.0 * q * q * q - 6.0 * q * q + 4.0, t * t * t].map(|w| w / 6.0)
}

struct NormalEquations {
    diagonal: Vec<f64>,
    entries: Vec<(u32, u32, f64)>,
    right: Vec<DVec3>,
}

impl NormalEquations {
    fn new(n: usize) -> Self {
        Self { diagonal: vec![1e-9; n], entries: Vec::new(), right: vec![DVec3::ZERO; n] }
    }

    fn add(&mut self, row: &[(usize, f64)], value: DVec3, weight: f64) {
        for (k, &(i, a)) in row.iter().enumerate() {
            self.diagonal[i] += weight * a * a;
            self.right[i] += value * (weight * a);
            for &(j, b) in &row[..k] {
                self.entries.push((i as u32, j as u32, weight * a * b));
            }
        }
    }

    fn solve(self) -> Result<Vec<DVec3>> {
        let n = self.diagonal.len();
        let factor = SparseLlt::factorize(&LowerCsc::assemble(&self.diagonal, &self.entries))?;
        let mut columns: Vec<f64> = (0..3).flat_map(|c| self.right.iter().map(move |r| r[c])).collect();
        factor.solve(&mut columns, 3);
        Ok((0..n).map(|i| DVec3::new(columns[i], columns[n + i], columns[2 * n + i])).collect())
    }
}

/// Displacement along the control normals to the scan, units; `None` where it is not seen.
fn wanted_displacement(surface: &[[i32; 3]], normals: &[[i32; 3]], image: &ScanImage, view: &View) -> Vec<Option<f64>> {
    let mut out = vec![None; surface.len()];
    for (i, out) in out.iter_mut().enumerate() {
        if on_disk(i % GRID_SIDE, i / GRID_SIDE) {
            *out = reach(surface[i], normals[i], image, view);
        }
    }
    out
}

/// Newton's method along a normal on the surface's tangent planes.
fn reach(from: [i32; 3], normal: [i32; 3], image: &ScanImage, view: &View) -> Option<f64> {
    let n = DVec3::from_array(normal.map(f64::from)) / f64::from(1 << DIRECTION_BITS);
    let units = f64::from(UNITS_PER_MM);
    let from_mm = DVec3::from_array(from.map(f64::from)) / units;
    let mut along = 0.0;
    for _ in 0..5 {
        let at = from_mm + n * along;
        let seen = view.project((at * units).to_array().map(|v| v.round() as i32))?;
        let sample = image.sample(seen.x, seen.y, 6 * UNITS_PER_MM)?;
        let slant = n.dot(sample.normal);
        if slant < 0.2 {
            return None;
        }
        let step = (sample.point_mm - at).dot(sample.normal) / slant;
        along += step;
        if along.abs() > REACH_MM {
            return None;
        }
        if step.abs() < 0.002 {
            return Some(along * units);
        }
    }
    None
}

/// Weighted mean of the 3x3 neighbourhood where it is known: the noise of a scan is no shape.
fn smooth(values: &[Option<f64>]) -> Vec<Option<f64>> {
    let mut out = vec![None; values.len()];
    for y in 1..GRID_CELLS {
        for x in 1..GRID_CELLS {
            let centre = y * GRID_SIDE + x;
            if values[centre].is_none() {
                continue;
            }
            let (mut sum, mut weight) = (0.0, 0.0);
            for k in 0..9 {
                let w = [1.0, 2.0, 1.0][k % 3] * [1.0, 2.0, 1.0][k / 3];
                if let Some(v) = values[(y + k / 3 - 1) * GRID_SIDE + x + k % 3 - 1] {
                    sum += w * v;
                    weight += w;
                }
            }
            out[centre] = Some(sum / weight);
        }
    }
    out
}

/// Closed loop: each residual against the prediction from decoded values.
fn quantize(wanted: &[Option<f64>], options: &BaseOptions) -> Vec<i32> {
    let step = f64::from(options.displacement_step);
    let mut values = vec![0; wanted.len()];
    let mut residuals = vec![0; wanted.len()];
    visit(|node| {
        let predicted = node.predict(&values);
        let i = node.index();
        let left = wanted[i].map_or(0.0, |w| (w - f64::from(predicted)) / step);
        let q = if left.abs() < options.dead_zone { 0 } else { left.round() as i32 };
        residuals[i] = q;
        values[i] = predicted + q * options.displacement_step;
    });
    residuals
}
