//! A decoded scan as a mesh on its camera's pixels: each scan as it was seen.

use super::carry::nearest_drawn;
use super::model::Model;
use super::raster::NOTHING;
use super::seen_scan::SeenScan;
use super::view::{BackProjection, PX_BITS};
use crate::mesh::TriMesh;
use glam::{DVec2, Vec3};

/// No vertex.
const NONE: u32 = u32::MAX;

/// The surface of a scan: a vertex a pixel of its mask, neighbours joined where depth does not jump; with texture
/// coordinates for a picture of the scan's own size.
pub fn as_scan(model: &Model, scan: &SeenScan) -> TriMesh {
    let back = model.view.moved(scan.window.offset).back_projection();
    let (width, height) = (scan.window.width, scan.window.height);
    let mut vertex = vec![NONE; scan.mask.len()];
    let mut mesh = TriMesh::default();
    let mut uv = Vec::new();
    for (i, v) in vertex.iter_mut().enumerate().filter(|(i, _)| scan.mask[*i]) {
        *v = mesh.positions_mm.len() as u32;
        mesh.positions_mm.push(position(&back, scan, i));
        let (x, y) = ((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
        uv.push([x / width as f32, 1.0 - y / height as f32]);
    }
    mesh.uv = Some(uv);
    mesh.triangles = triangles(scan, &vertex, model.edge_step);
    mesh
}

/// As [`as_scan`], its surface moved by what each vertex of the model moves, mm.
pub fn as_scan_at(model: &Model, scan: &SeenScan, by_mm: &[Vec3]) -> TriMesh {
    let mut mesh = as_scan(model, scan);
    let nearest = nearest_drawn(&scan.drawn.picture.depth, scan.window.width);
    let pixels = (0..scan.mask.len()).filter(|i| scan.mask[*i]);
    for (p, i) in mesh.positions_mm.iter_mut().zip(pixels) {
        let j = nearest[i] as usize;
        if scan.drawn.picture.depth[j] != NOTHING {
            *p += displacement(model, scan, j, by_mm);
        }
    }
    mesh
}

/// Mean of the corners of the triangle that a pixel shows, by its place in it.
fn displacement(model: &Model, scan: &SeenScan, pixel: usize, by_mm: &[Vec3]) -> Vec3 {
    let corners = model.connectivity.triangles[scan.drawn.picture.triangle[pixel] as usize];
    let width = scan.window.width;
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

fn position(back: &BackProjection, scan: &SeenScan, i: usize) -> Vec3 {
    let (x, y) = ((i % scan.window.width) as f64, (i / scan.window.width) as f64);
    back.point_mm(x, y, f64::from(scan.depth(i))).as_vec3()
}

/// Two triangles a square of pixels, split along the diagonal whose ends differ less in depth; one where a corner is
/// missing.
fn triangles(scan: &SeenScan, vertex: &[u32], edge_step: i32) -> Vec<[u32; 3]> {
    let width = scan.window.width;
    let mut out = Vec::new();
    let mut add = |corners: [usize; 3]| {
        let t = corners.map(|c| vertex[c]);
        let depth = corners.map(|c| scan.depth(c));
        let step = depth[0].max(depth[1]).max(depth[2]) - depth[0].min(depth[1]).min(depth[2]);
        if !t.contains(&NONE) && step <= edge_step {
            out.push(t);
        }
    };
    for y in 1..scan.window.height {
        for x in 1..width {
            let d = y * width + x;
            // Rows go down: a b above c d; counter-clockwise as seen.
            let (a, b, c) = (d - width - 1, d - width, d - 1);
            let on = [a, b, c, d].map(|i| vertex[i] != NONE);
            let falling = (scan.depth(a) - scan.depth(d)).abs() <= (scan.depth(b) - scan.depth(c)).abs();
            match on {
                [true, true, true, true] if falling => [[a, c, d], [a, d, b]].into_iter().for_each(&mut add),
                [true, true, true, true] => [[a, c, b], [b, c, d]].into_iter().for_each(&mut add),
                [true, true, true, false] => add([a, c, b]),
                [true, true, false, true] => add([a, d, b]),
                [true, false, true, true] => add([a, c, d]),
                [false, true, true, true] => add([b, c, d]),
                _ => {}
            }
        }
    }
    out
}
