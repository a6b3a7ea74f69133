//! Triangle mesh of the camera's pixel grid.

use super::LightError;
use super::mask::{PixelMask, Rejection};
use super::triangulate::PointGrid;
use glam::Vec3;
use gv3_codec::{GreyPicture, mesh::TriMesh};
use serde::{Deserialize, Serialize};

/// Limits on triangles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MeshLimits {
    /// Largest difference of depth along a triangle's edge, mm.
    pub max_depth_step_mm: f32,
    /// Largest angle between a triangle's normal and the camera's ray, degrees.
    pub max_angle_deg: f32,
    /// Pieces of the surface with fewer pixels than this are left out; 0 keeps all.
    pub min_piece_px: u32,
}

impl Default for MeshLimits {
    fn default() -> Self {
        Self { max_depth_step_mm: 3.0, max_angle_deg: 80.0, min_piece_px: 400 }
    }
}

impl MeshLimits {
    /// Checks step and angle.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the limit.
    pub fn validate(&self) -> Result<(), LightError> {
        if !(self.max_depth_step_mm > 0.0 && self.max_depth_step_mm.is_finite()) {
            return Err(LightError::field("mesh.max_depth_step_mm", "expected millimetres above 0"));
        }
        if !(self.max_angle_deg > 0.0 && self.max_angle_deg < 90.0) {
            return Err(LightError::field("mesh.max_angle_deg", "expected an angle above 0 and below 90"));
        }
        Ok(())
    }
}

/// How one cell, the square of four neighbouring pixels, is triangulated: three corners a triangle, corners numbered
/// 0 top left, 1 top right, 2 bottom left, 3 bottom right, counter-clockwise seen from the camera.
const TRIANGLES: [[usize; 3]; 4] = [[0, 2, 1], [1, 2, 3], [0, 2, 3], [0, 3, 1]];
/// Pairs of [`TRIANGLES`] that share the diagonal 1-2, and 0-3.
const RISING: [u8; 2] = [0, 1];
const FALLING: [u8; 2] = [2, 3];

/// Bit c: corner c is part of the triangles that an index's bits name.
const CORNERS: [u8; 16] = {
    let mut corners = [0; 16];
    let mut bits = 0;
    while bits < 16 {
        let mut k = 0;
        while k < 4 {
            if bits >> k & 1 != 0 {
                let [a, b, c] = TRIANGLES[k];
                corners[bits] |= 1 << a | 1 << b | 1 << c;
            }
            k += 1;
        }
        bits += 1;
    }
    corners
};

/// Makes meshes of point grids; keeps its buffers between scans.
#[derive(Debug, Clone)]
pub struct GridMesher {
    limits: MeshLimits,
    min_cosine_squared: f32,
    /// Bit k: triangle k of [`TRIANGLES`] is in the mesh; one byte a cell, `width - 1` cells a row.
    cells: Vec<u8>,
    vertex_of_pixel: Vec<u32>,
}

/// A run of cells with triangles in one row of cells.
#[derive(Debug, Clone, Copy)]
struct Run {
    start: u32,
    end: u32,
    piece: u32,
}

impl GridMesher {
    /// A mesher with these limits.
    ///
    /// # Errors
    /// [`LightError::Field`] for limits that cannot work.
    pub fn new(limits: MeshLimits) -> Result<Self, LightError> {
        limits.validate()?;
        let cosine = limits.max_angle_deg.to_radians().cos();
        Ok(Self { limits, min_cosine_squared: cosine * cosine, cells: Vec::new(), vertex_of_pixel: Vec::new() })
    }

    /// The mesh of all points, one vertex a pixel in row-major order, uv at the pixel's centre, normals towards the camera.
    /// Pixels left without a triangle are rejected in `mask`.
    ///
    /// # Panics
    /// When grid and mask differ in size.
    pub fn mesh(&mut self, grid: &PointGrid, mask: &mut PixelMask) -> TriMesh {
        assert_eq!(grid.points_mm.len(), mask.verdicts.len(), "grid and mask differ in size");
        if grid.width_px < 2 || grid.height_px < 2 {
            return TriMesh { uv: Some(Vec::new()), ..TriMesh::default() };
        }
        self.triangulate_cells(grid);
        if self.limits.min_piece_px > 0 {
            self.drop_small_pieces(grid.width_px - 1);
        }
        self.number_vertices(grid, mask);
        self.emit(grid)
    }

    fn triangulate_cells(&mut self, grid: &PointGrid) {
        let (w, h) = (grid.width_px, grid.height_px);
        let mut cells = std::mem::take(&mut self.cells);
        cells.clear();
        cells.resize((w - 1) * (h - 1), 0);
        for y in 0..h - 1 {
            let top = &grid.points_mm[y * w..][..w];
            let bottom = &grid.points_mm[(y + 1) * w..][..w];
            for (x, cell) in cells[y * (w - 1)..][..w - 1].iter_mut().enumerate() {
                *cell = self.triangulate_cell([top[x], top[x + 1], bottom[x], bottom[x + 1]]);
            }
        }
        self.cells = cells;
    }

    #[inline]
    fn triangulate_cell(&self, p: [Vec3; 4]) -> u8 {
        // Most cells are all there or all missing: one branch each.
        let missing = p.iter().enumerate().fold(0, |bits, (k, c)| bits | u8::from(c.x.is_nan()) << k);
        let candidates: &[u8] = match missing {
            0b0000 if p[1].distance_squared(p[2]) <= p[0].distance_squared(p[3]) => &RISING,
            0b0000 => &FALLING,
            0b1000 => &[0],
            0b0001 => &[1],
            0b0010 => &[2],
            0b0100 => &[3],
            _ => return 0,
        };
        let mut bits = 0;
        for &k in candidates {
            let [a, b, c] = TRIANGLES[k as usize].map(|corner| p[corner]);
            bits |= u8::from(self.is_surface(a, b, c)) << k;
        }
        bits
    }

    /// Whether the triangle is neither a depth jump nor seen too flat; the camera is the origin.
    #[inline]
    fn is_surface(&self, a: Vec3, b: Vec3, c: Vec3) -> bool {
        let step = (a.z - b.z).abs().max((b.z - c.z).abs()).max((c.z - a.z).abs());
        let normal = (b - a).cross(c - a);
        let towards = -normal.dot(a);
        step <= self.limits.max_depth_step_mm
            && towards > 0.0
            && towards * towards >= self.min_cosine_squared * normal.length_squared() * a.length_squared()
    }

    /// Clears the cells of pieces below the size limit; pieces are cells connected along rows and columns.
    fn drop_small_pieces(&mut self, width: usize) {
        let mut runs: Vec<Run> = Vec::new();
        let mut row_starts = vec![0];
        let mut parents: Vec<u32> = Vec::new();
        for row in self.cells.chunks_exact(width) {
            let above = row_starts[row_starts.len().saturating_sub(2)]..runs.len();
            collect_runs(row, &mut runs, &mut parents);
            join_runs(&runs[above.clone()], &runs[above.end..], &mut parents);
            row_starts.push(runs.len());
        }
        let mut sizes = vec![0u32; parents.len()];
        for run in &runs {
            sizes[root(&mut parents, run.piece) as usize] += run.end - run.start;
        }
        for (y, bounds) in row_starts.windows(2).enumerate() {
            for run in &runs[bounds[0]..bounds[1]] {
                if sizes[root(&mut parents, run.piece) as usize] < self.limits.min_piece_px {
                    self.cells[y * width + run.start as usize..y * width + run.end as usize].fill(0);
                }
            }
        }
    }

    fn number_vertices(&mut self, grid: &PointGrid, mask: &mut PixelMask) {
        let w = grid.width_px;
        self.vertex_of_pixel.clear();
        self.vertex_of_pixel.resize(grid.points_mm.len(), u32::MAX);
        for (y, row) in self.cells.chunks_exact(w - 1).enumerate() {
            for (x, &bits) in row.iter().enumerate().filter(|(_, bits)| **bits != 0) {
                let used = CORNERS[bits as usize];
                for corner in (0..4).filter(|corner| used >> corner & 1 != 0) {
                    self.vertex_of_pixel[(y + corner / 2) * w + x + corner % 2] = 0;
                }
            }
        }
        let mut next = 0;
        for (vertex, verdict) in self.vertex_of_pixel.iter_mut().zip(mask.verdicts.iter_mut()) {
            if *vertex == 0 {
                *vertex = next;
                next += 1;
            } else if *verdict == Rejection::Kept {
                *verdict = Rejection::Unmeshed;
            }
        }
    }

    fn emit(&self, grid: &PointGrid) -> TriMesh {
        let w = grid.width_px;
        let picture = GreyPicture { width_px: w as u32, height_px: grid.height_px as u32, pixels: Vec::new() };
        let mut positions_mm = Vec::with_capacity(grid.points_mm.len() / 2);
        let mut uv = Vec::with_capacity(grid.points_mm.len() / 2);
        for (i, &point) in grid.points_mm.iter().enumerate().filter(|(i, _)| self.vertex_of_pixel[*i] != u32::MAX) {
            positions_mm.push(point);
            uv.push(picture.px_to_uv([(i % w) as f32, (i / w) as f32]));
        }
        let mut triangles = Vec::with_capacity(2 * positions_mm.len());
        for (y, row) in self.cells.chunks_exact(w - 1).enumerate() {
            for (x, &bits) in row.iter().enumerate().filter(|(_, bits)| **bits != 0) {
                for_each_triangle(bits, |corners| {
                    triangles.push(corners.map(|c| self.vertex_of_pixel[(y + c / 2) * w + x + c % 2]));
                });
            }
        }
        TriMesh { positions_mm, triangles, uv: Some(uv) }
    }
}

#[inline]
fn for_each_triangle(bits: u8, mut visit: impl FnMut([usize; 3])) {
    let mut rest = bits;
    while rest != 0 {
        visit(TRIANGLES[rest.trailing_zeros() as usize]);
        rest &= rest - 1;
    }
}

fn collect_runs(row: &[u8], runs: &mut Vec<Run>, parents: &mut Vec<u32>) {
    let mut x = 0;
    while x < row.len() {
        if row[x] == 0 {
            x += 1;
            continue;
        }
        let length = row[x..].iter().take_while(|&&bits| bits != 0).count();
        let piece = parents.len() as u32;
        parents.push(piece);
        runs.push(Run { start: x as u32, end: (x + length) as u32, piece });
        x += length;
    }
}

/// Joins the pieces of runs that overlap; both rows are sorted.
fn join_runs(above: &[Run], below: &[Run], parents: &mut [u32]) {
    let (mut i, mut j) = (0, 0);
    while i < above.len() && j < below.len() {
        if above[i].start < below[j].end && below[j].start < above[i].end {
            let (a, b) = (root(parents, above[i].piece), root(parents, below[j].piece));
            parents[a.max(b) as usize] = a.min(b);
        }
        if above[i].end < below[j].end {
            i += 1;
        } else {
            j += 1;
        }
    }
}

fn root(parents: &mut [u32], piece: u32) -> u32 {
    let mut p = piece;
    while parents[p as usize] != p {
        parents[p as usize] = parents[parents[p as usize] as usize];
        p = parents[p as usize];
    }
    p
}

/// The texture of a scan: the background A, in which the fringes average out, rounded to 8 bits.
///
/// # Panics
/// When `background` is not of the given size.
pub fn texture(width_px: u32, height_px: u32, background: &[f32]) -> GreyPicture {
    // Adding a half and cutting rounds; background is never negative.
    let pixels = background.iter().map(|a| (a + 0.5) as u8).collect();
    GreyPicture::new(width_px, height_px, pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(width_px: usize, height_px: usize) -> PointGrid {
        let mut grid = PointGrid::new(width_px, height_px);
        for (i, p) in grid.points_mm.iter_mut().enumerate() {
            let (x, y) = ((i % width_px) as f32, (i / width_px) as f32);
            *p = Vec3::new(x * 0.5, -y * 0.5, -600.0);
        }
        grid
    }

    fn mesh_of(grid: &PointGrid, limits: MeshLimits) -> (TriMesh, PixelMask) {
        let mut mask = PixelMask::new(grid.width_px, grid.height_px);
        for (verdict, p) in mask.verdicts.iter_mut().zip(&grid.points_mm) {
            *verdict = if p.is_nan() { Rejection::LowModulation } else { Rejection::Kept };
        }
        let mesh = GridMesher::new(limits).unwrap().mesh(grid, &mut mask);
        mesh.validate().unwrap();
        (mesh, mask)
    }

    fn limits(min_piece_px: u32) -> MeshLimits {
        MeshLimits { min_piece_px, ..MeshLimits::default() }
    }

    #[test]
    fn a_plane_is_a_disk_that_faces_the_camera_with_uv_at_pixels() {
        let (mesh, _) = mesh_of(&flat(30, 20), limits(0));
        assert_eq!((mesh.vertex_count(), mesh.triangles.len()), (600, 2 * 29 * 19));
        assert!((0..mesh.triangles.len()).all(|t| mesh.area_normal(t).z > 0.0));
        assert!((mesh.area_mm2() - 0.25 * 29.0 * 19.0).abs() < 1e-3);
        let px = GreyPicture::filled(30, 20, 0).uv_to_px(mesh.uv.unwrap()[37]);
        assert!((px[0] - 7.0).abs() < 1e-4 && (px[1] - 1.0).abs() < 1e-4);
    }

    #[test]
    fn every_missing_corner_leaves_one_triangle() {
        for missing in 0..4 {
            let mut grid = flat(2, 2);
            grid.points_mm[missing] = Vec3::NAN;
            let (mesh, mask) = mesh_of(&grid, limits(0));
            assert_eq!((mesh.vertex_count(), mesh.triangles.len()), (3, 1), "corner {missing}");
            assert!(mesh.area_normal(0).z > 0.0);
            assert_eq!(mask.count().total(), 1);
        }
    }

    #[test]
    fn depth_jumps_and_grazing_triangles_are_cut() {
        let mut grid = flat(40, 10);
        for (i, p) in grid.points_mm.iter_mut().enumerate().filter(|(i, _)| i % 40 >= 20) {
            p.z -= if i % 40 < 30 { 2.9 } else { 40.0 };
        }
        let (mesh, _) = mesh_of(&grid, limits(0));
        assert_eq!(
            mesh.triangles.len(),
            2 * 9 * (19 + 9 + 9),
            "2.9 mm in a pixel of 0.5 mm is steeper than 80 degrees"
        );
    }

    #[test]
    fn specks_are_removed_and_counted_and_large_pieces_stay() {
        let mut grid = flat(60, 40);
        for (i, p) in grid.points_mm.iter_mut().enumerate() {
            let (x, y) = (i % 60, i / 60);
            let in_speck = (50..54).contains(&x) && (4..8).contains(&y);
            // A U of two arms that meet only at the bottom: one piece.
            let in_piece = x < 40 && (y >= 30 || !(10..30).contains(&x));
            if !in_speck && !in_piece {
                *p = Vec3::NAN;
            }
        }
        let (all, _) = mesh_of(&grid, limits(0));
        let (mesh, mask) = mesh_of(&grid, limits(400));
        assert_eq!(all.vertex_count() - mesh.vertex_count(), 16);
        assert_eq!(mask.count().unmeshed, 16);
        assert_eq!(mesh.vertex_count() as u64 + mask.count().total(), 2400);
    }

    #[test]
    fn the_shorter_diagonal_is_taken() {
        let mut grid = flat(2, 2);
        grid.points_mm[0].z -= 1.0;
        let (mesh, _) = mesh_of(&grid, limits(0));
        assert!(mesh.triangles.iter().all(|t| t.contains(&1) && t.contains(&2)));
    }
}
