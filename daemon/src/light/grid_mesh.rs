//! Triangle mesh of the camera's pixel grid.

use super::LightError;
use super::mask::{PixelMask, Rejection};
use super::triangulate::PointGrid;
use glam::Vec3;
use gv3_codec::{GreyPicture, mesh::TriMesh};
use serde::{Deserialize, Serialize};
use std::ops::Range;

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

/// Bits of a cell, the square of four neighbouring pixels (corners 0 top left, 1 top right, 2 bottom left, 3 bottom right),
/// one a triangle, counter-clockwise seen from the camera: 0-2-1 and 1-2-3 share one diagonal, 0-2-3 and 0-3-1 the other.
const RISING: u8 = 0b0011;
/// Places to shift the bits of [`RISING`] by for the other diagonal.
const FALLING_SHIFT: u32 = 2;

/// Makes meshes of point grids; keeps its buffers between scans.
#[derive(Debug, Clone)]
pub struct GridMesher {
    limits: MeshLimits,
    min_cosine_squared: f32,
    /// Bits of the triangles in the mesh; one byte a cell, `width - 1` cells a row.
    cells: Vec<u8>,
    /// Cells of every row outside of which there are no triangles.
    spans: Vec<Range<usize>>,
    rows: [PointRow; 2],
    emitter: RowEmitter,
}

/// Coordinates of one row of points, each by itself so that loops over them vectorize.
#[derive(Debug, Clone, Default)]
struct PointRow {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    /// From the first point that is there to the last.
    span: Range<usize>,
}

impl PointRow {
    fn fill(&mut self, points: &[Vec3]) {
        let n = points.len();
        let is_there = |p: &Vec3| !p.x.is_nan();
        let first = points.iter().position(is_there).unwrap_or(n);
        self.span = first..points.iter().rposition(is_there).map_or(n, |last| last + 1);
        for axis in [&mut self.x, &mut self.y, &mut self.z] {
            axis.clear();
            axis.resize(n, f32::NAN);
        }
        let [x, y, z] = [&mut self.x, &mut self.y, &mut self.z].map(|axis| &mut axis[self.span.clone()]);
        for (p, (x, (y, z))) in points[self.span.clone()].iter().zip(x.iter_mut().zip(y.iter_mut().zip(z))) {
            (*x, *y, *z) = (p.x, p.y, p.z);
        }
    }
}

/// Vertices and triangles of one row of pixels on their way into the mesh.
#[derive(Debug, Clone, Default)]
struct RowEmitter {
    is_used: Vec<u8>,
    /// Vertex of every pixel of this row and of the row above; of pixels in use only.
    vertex: Vec<u32>,
    vertex_above: Vec<u32>,
    positions_mm: Vec<Vec3>,
    uv: Vec<[f32; 2]>,
    triangles: Vec<[u32; 3]>,
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
        Ok(Self {
            limits,
            min_cosine_squared: cosine * cosine,
            cells: Vec::new(),
            spans: Vec::new(),
            rows: Default::default(),
            emitter: RowEmitter::default(),
        })
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
        self.emit(grid, mask)
    }

    fn triangulate_cells(&mut self, grid: &PointGrid) {
        let w = grid.width_px;
        let mut cells = std::mem::take(&mut self.cells);
        cells.clear();
        cells.resize((w - 1) * (grid.height_px - 1), 0);
        self.spans.clear();
        let [mut above, mut here] = std::mem::take(&mut self.rows);
        above.fill(&grid.points_mm[..w]);
        for (points, cells) in grid.points_mm[w..].chunks_exact(w).zip(cells.chunks_exact_mut(w - 1)) {
            here.fill(points);
            let mut span = above.span.start.min(here.span.start)..above.span.end.max(here.span.end) - 1;
            if above.span.is_empty() || here.span.is_empty() {
                // A triangle has corners in both rows.
                span = 0..0;
            }
            self.triangulate_row(&above, &here, span.clone(), &mut cells[span.clone()]);
            self.spans.push(span);
            std::mem::swap(&mut above, &mut here);
        }
        self.cells = cells;
        self.rows = [above, here];
    }

    /// Bits of the cells of a span. Points that are missing are NaN, for which no comparison holds.
    fn triangulate_row(&self, top: &PointRow, bottom: &PointRow, span: Range<usize>, cells: &mut [u8]) {
        let corner = span.start..span.end + 1;
        let [tx, ty, tz] = [&top.x, &top.y, &top.z].map(|axis| &axis[corner.clone()]);
        let [bx, by, bz] = [&bottom.x, &bottom.y, &bottom.z].map(|axis| &axis[corner.clone()]);
        for i in 0..cells.len().min(tx.len() - 1) {
            let p0 = Vec3::new(tx[i], ty[i], tz[i]);
            let p1 = Vec3::new(tx[i + 1], ty[i + 1], tz[i + 1]);
            let p2 = Vec3::new(bx[i], by[i], bz[i]);
            let p3 = Vec3::new(bx[i + 1], by[i + 1], bz[i + 1]);
            let falling2 = (p0 - p3).length_squared();
            // Without 0 or 3 only this diagonal is left; without 1 or 2 the comparison fails, and only the other.
            let is_rising = ((p1 - p2).length_squared() <= falling2) | falling2.is_nan();
            let pick = |rising: Vec3, falling: Vec3| {
                let axis = |r: f32, f: f32| if is_rising { r } else { f };
                Vec3::new(axis(rising.x, falling.x), axis(rising.y, falling.y), axis(rising.z, falling.z))
            };
            // Both triangles turn about one end of the diagonal: 1 with 0-2-3, or 0 with 2-3-1.
            let hub = pick(p1, p0);
            let edges = [pick(p0, p2) - hub, pick(p2, p3) - hub, pick(p3, p1) - hub];
            let first = self.is_surface(hub, edges[0], edges[1]);
            let second = self.is_surface(hub, edges[1], edges[2]);
            let bits = u8::from(first) | u8::from(second) << 1;
            cells[i] = if is_rising { bits } else { bits << FALLING_SHIFT };
        }
    }

    /// Whether the triangle of a corner and two edges from it is neither a depth jump nor seen too flat; the camera is the
    /// origin.
    #[inline(always)]
    fn is_surface(&self, corner: Vec3, b: Vec3, c: Vec3) -> bool {
        let larger = |a: f32, b: f32| if a > b { a } else { b };
        let step = larger(larger(b.z.abs(), c.z.abs()), (b.z - c.z).abs());
        let normal = b.cross(c);
        let towards = -normal.dot(corner);
        (step <= self.limits.max_depth_step_mm)
            & (towards > 0.0)
            & (towards * towards >= self.min_cosine_squared * normal.length_squared() * corner.length_squared())
    }

    /// Clears the cells of pieces below the size limit; pieces are cells connected along rows and columns.
    fn drop_small_pieces(&mut self, width: usize) {
        let mut runs: Vec<Run> = Vec::new();
        let mut row_starts = vec![0];
        let mut parents: Vec<u32> = Vec::new();
        for (row, span) in self.cells.chunks_exact(width).zip(&self.spans) {
            let above = row_starts[row_starts.len().saturating_sub(2)]..runs.len();
            collect_runs(row, span.clone(), &mut runs, &mut parents);
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

    fn emit(&mut self, grid: &PointGrid, mask: &mut PixelMask) -> TriMesh {
        let (w, h) = (grid.width_px, grid.height_px);
        let picture = GreyPicture { width_px: w as u32, height_px: h as u32, pixels: Vec::new() };
        let column_uv: Vec<f32> = (0..w).map(|x| picture.px_to_uv([x as f32, 0.0])[0]).collect();
        let cell_count = self.cells.iter().filter(|bits| **bits != 0).count();
        let mut mesh = TriMesh {
            positions_mm: Vec::with_capacity(cell_count + w + h),
            triangles: Vec::with_capacity(2 * cell_count),
            uv: None,
        };
        let mut uv = Vec::with_capacity(cell_count + w + h);
        let no_cells = vec![0; w - 1];
        let row_of_cells = |y: usize| match self.spans.get(y) {
            Some(span) => (&self.cells[y * (w - 1)..][..w - 1], span.clone()),
            None => (&no_cells[..], 0..0),
        };
        let (mut above, mut span_above) = (&no_cells[..], 0..0);
        for y in 0..h {
            let (below, span_below) = row_of_cells(y);
            let row = y * w..(y + 1) * w;
            self.emitter.use_pixels(above, below, &mut mask.verdicts[row.clone()]);
            // A cell reaches one pixel further than its number.
            let pixels = span_above.start.min(span_below.start)..span_above.end.max(span_below.end) + 1;
            let first = mesh.positions_mm.len() as u32;
            let row_uv = picture.px_to_uv([0.0, y as f32])[1];
            self.emitter.push_vertices(pixels, &grid.points_mm[row], &column_uv, row_uv, first);
            mesh.positions_mm.extend_from_slice(&self.emitter.positions_mm);
            uv.extend_from_slice(&self.emitter.uv);
            mesh.triangles.extend_from_slice(self.emitter.triangles_of(above, span_above));
            (above, span_above) = (below, span_below);
        }
        TriMesh { uv: Some(uv), ..mesh }
    }
}

impl RowEmitter {
    /// Finds the pixels with a triangle in the cells above or below them, and rejects the others.
    fn use_pixels(&mut self, above: &[u8], below: &[u8], verdicts: &mut [Rejection]) {
        let n = verdicts.len();
        self.is_used.clear();
        self.is_used.resize(n, 0);
        // Corner c of a cell is in use when one of the three triangles that have it is there.
        for ((b, a), used) in below.iter().zip(above).zip(&mut self.is_used) {
            *used |= (b | b >> 2 | b >> 3 | a | a >> 1 | a >> 2) & 1;
        }
        for ((b, a), used) in below.iter().zip(above).zip(&mut self.is_used[1..]) {
            *used |= (b | b >> 1 | b >> 3 | a >> 1 | a >> 2 | a >> 3) & 1;
        }
        for (verdict, used) in verdicts.iter_mut().zip(&self.is_used) {
            let is_left = (*verdict == Rejection::Kept) & (*used == 0);
            *verdict = if is_left { Rejection::Unmeshed } else { *verdict };
        }
    }

    /// Numbers the pixels in use from `next` on and gathers their points; without branches, since outlines are ragged.
    fn push_vertices(&mut self, pixels: Range<usize>, points_mm: &[Vec3], column_uv: &[f32], row_uv: f32, next: u32) {
        std::mem::swap(&mut self.vertex, &mut self.vertex_above);
        for vertices in [&mut self.vertex, &mut self.vertex_above] {
            vertices.resize(points_mm.len(), 0);
        }
        self.positions_mm.resize(pixels.len(), Vec3::ZERO);
        self.uv.resize(pixels.len(), [0.0; 2]);
        let mut count = 0;
        let (positions_mm, uv) = (&mut self.positions_mm[..], &mut self.uv[..]);
        let (used, vertices) = (&self.is_used[pixels.clone()], &mut self.vertex[pixels.clone()]);
        let inputs = points_mm[pixels.clone()].iter().zip(&column_uv[pixels]);
        for ((point, u), (used, vertex)) in inputs.zip(used.iter().zip(vertices)) {
            *vertex = next + count as u32;
            positions_mm[count] = *point;
            uv[count] = [*u, row_uv];
            count += usize::from(*used);
        }
        self.positions_mm.truncate(count);
        self.uv.truncate(count);
    }

    /// Triangles of a row of cells between the last two rows of pixels.
    fn triangles_of(&mut self, cells: &[u8], span: Range<usize>) -> &[[u32; 3]] {
        self.triangles.resize(2 * cells.len(), [0; 3]);
        let (triangles, mut count) = (&mut self.triangles[..], 0);
        let corners = span.start..(span.end + 1).min(self.vertex.len());
        let corners = self.vertex_above[corners.clone()].windows(2).zip(self.vertex[corners].windows(2));
        for (&bits, (top, bottom)) in cells[span].iter().zip(corners) {
            let (v0, v1, v2, v3) = (top[0], top[1], bottom[0], bottom[1]);
            // Which diagonal is taken hangs on noise, so no branch could guess it.
            let falling = 0u32.wrapping_sub(u32::from(bits > RISING));
            let pick = |rising: u32, other: u32| rising ^ ((rising ^ other) & falling);
            triangles[count] = [v0, v2, pick(v1, v3)];
            count += usize::from((bits | bits >> FALLING_SHIFT) & 1);
            triangles[count] = [pick(v1, v0), pick(v2, v3), pick(v3, v1)];
            count += usize::from((bits | bits >> FALLING_SHIFT) >> 1 & 1);
        }
        &self.triangles[..count]
    }
}

fn collect_runs(row: &[u8], span: Range<usize>, runs: &mut Vec<Run>, parents: &mut Vec<u32>) {
    let mut x = span.start;
    while x < span.end {
        if row[x] == 0 {
            x += 1;
            continue;
        }
        let length = row[x..span.end].iter().take_while(|&&bits| bits != 0).count();
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
