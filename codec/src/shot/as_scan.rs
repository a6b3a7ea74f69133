//! A decoded scan as a mesh on its camera's pixels: each scan as it was seen.

use super::carry::nearest_known;
use super::model::Model;
use super::raster::NOTHING;
use super::seen_scan::SeenScan;
use super::view::PX_BITS;
use crate::mesh::TriMesh;
use glam::{DVec2, Vec3};

/// No vertex.
const NONE: u32 = u32::MAX;

/// The surface of a scan: a vertex a pixel of its mask, neighbours joined where depth does not jump; with texture
/// coordinates for a picture of the scan's own size. Pixels that no neighbour joins are no surface.
pub fn as_scan(model: &Model, scan: &SeenScan) -> TriMesh {
    joined(pixels(model, scan))
}

/// The mesh without vertices that no triangle has.
fn joined(mesh: TriMesh) -> TriMesh {
    let mut is_joined = vec![false; mesh.vertex_count()];
    mesh.triangles.iter().flatten().for_each(|v| is_joined[*v as usize] = true);
    if is_joined.contains(&false) { mesh.submesh(|_| true).0 } else { mesh }
}

/// All pixels of the mask in rows, those on their own too.
fn pixels(model: &Model, scan: &SeenScan) -> TriMesh {
    let back = model.view.moved(scan.placed.window.offset).back_projection();
    let (width, height) = (scan.placed.window.width, scan.placed.window.height);
    let count = scan.mask.iter().filter(|on| **on).count();
    let mut positions_mm = Vec::with_capacity(count);
    let mut uv = Vec::with_capacity(count);
    let mut triangles = Vec::with_capacity(2 * count);
    let columns: Vec<f32> = (0..width).map(|x| (x as f32 + 0.5) / width as f32).collect();
    let nothing = Corner { vertex: NONE, depth: 0 };
    let (mut above, mut below) = (vec![nothing; width], vec![nothing; width]);
    for y in 0..height {
        let row = back.row(y as f64);
        let v = 1.0 - (y as f32 + 0.5) / height as f32;
        let pixels = y * width..(y + 1) * width;
        for ((x, corner), i) in below.iter_mut().enumerate().zip(pixels) {
            *corner = Corner { vertex: NONE, depth: scan.depth(i) };
            if scan.mask[i] {
                corner.vertex = positions_mm.len() as u32;
                positions_mm.push(row.point_mm(x as f64, f64::from(corner.depth)).as_vec3());
                uv.push([columns[x], v]);
            }
        }
        if y > 0 {
            join(&above, &below, model.edge_step, &mut triangles);
        }
        std::mem::swap(&mut above, &mut below);
    }
    TriMesh { positions_mm, triangles, uv: Some(uv) }
}

/// As [`as_scan`], its surface moved by what each vertex of the model moves, mm.
pub fn as_scan_at(model: &Model, scan: &SeenScan, by_mm: &[Vec3]) -> TriMesh {
    let mut mesh = pixels(model, scan);
    let nearest = nearest_known(&scan.drawn.picture.depth, |d| *d != NOTHING, scan.placed.window.width);
    let pixels = (0..scan.mask.len()).filter(|i| scan.mask[*i]);
    for (p, i) in mesh.positions_mm.iter_mut().zip(pixels) {
        let j = nearest[i] as usize;
        if scan.drawn.picture.depth[j] != NOTHING {
            *p += displacement(model, scan, j, by_mm);
        }
    }
    joined(mesh)
}

/// Mean of the corners of the triangle that a pixel shows, by its place in it.
fn displacement(model: &Model, scan: &SeenScan, pixel: usize, by_mm: &[Vec3]) -> Vec3 {
    let corners = model.connectivity.triangles[scan.drawn.picture.triangle[pixel] as usize];
    let width = scan.placed.window.width;
    let p = DVec2::new((pixel % width) as f64, (pixel / width) as f64) * f64::from(1 << PX_BITS);
    let [a, b, c] = corners.map(|v| {
        let s = scan.drawn.seen[v as usize];
        DVec2::new(f64::from(s.x), f64::from(s.y))
    });
    let area = (b - a).perp_dot(c - a);
    let (v, w) = ((p - a).perp_dot(c - a) / area, (b - a).perp_dot(p - a) / area);
    let weights = [1.0 - v - w, v, w];
    corners.iter().zip(weights).map(|(&k, w)| by_mm[k as usize] * w as f32).sum()
}

/// A pixel: its vertex, and its depth in units.
#[derive(Debug, Clone, Copy)]
struct Corner {
    vertex: u32,
    depth: i32,
}

/// Two triangles a square of pixels of two rows, split along the diagonal whose ends differ less in depth; one where a
/// corner is missing.
fn join(above: &[Corner], below: &[Corner], edge_step: i32, out: &mut Vec<[u32; 3]>) {
    let mut add = |corners: [Corner; 3]| {
        let depth = corners.map(|c| c.depth);
        let step = depth[0].max(depth[1]).max(depth[2]) - depth[0].min(depth[1]).min(depth[2]);
        if step <= edge_step {
            out.push(corners.map(|c| c.vertex));
        }
    };
    for (up, down) in above.windows(2).zip(below.windows(2)) {
        // Rows go down: a b above c d; counter-clockwise as seen.
        let (a, b, c, d) = (up[0], up[1], down[0], down[1]);
        match [a, b, c, d].map(|k| k.vertex != NONE) {
            [true, true, true, true] => {
                let falling = (a.depth - d.depth).abs() <= (b.depth - c.depth).abs();
                let (first, second) = if falling { ([a, c, d], [a, d, b]) } else { ([a, c, b], [b, c, d]) };
                add(first);
                add(second);
            }
            [true, true, true, false] => add([a, c, b]),
            [true, true, false, true] => add([a, d, b]),
            [true, false, true, true] => add([a, c, d]),
            [false, true, true, true] => add([b, c, d]),
            _ => {}
        }
    }
}
