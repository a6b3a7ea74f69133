//! A small moving face: an oval height field that sways and speaks, seen by an orthographic camera.
//!
//! Scans have about 2400 vertices, so that a suite that codes dozens of them takes seconds.

use glam::{Vec2, Vec3};
use gv3::files::{ExportFormat, ExportWriter};
use gv3_codec::mesh::TriMesh;
use gv3_codec::{GreyPicture, Scan};
use std::path::Path;

/// Nanoseconds of one tick: what `gv3 encode --fps 30` takes.
pub const PERIOD_NANOS: u64 = 33_333_333;

const COLUMNS: usize = 50;
const ROWS: usize = 60;
/// Half the face's width and height, mm.
const HALF_SIZE_MM: Vec2 = Vec2::new(70.0, 90.0);
const WIDTH_PX: u32 = 200;
const HEIGHT_PX: u32 = 240;
const PX_PER_MM: f32 = 1.2;

/// The face at a tick, textured.
pub fn scan(tick: u64) -> Scan {
    let time_nanos = tick * PERIOD_NANOS;
    let t = time_nanos as f32 * 1e-9;
    let sway_mm = Vec3::new(4.0 * (5.0 * t).sin(), 2.0 * (4.0 * t).sin(), 2.0 * (3.0 * t).cos());
    let mouth_mm = 3.0 * (6.0 * t).sin();
    let picture = picture(sway_mm.truncate());
    let mut mesh = oval();
    for p in &mut mesh.positions_mm {
        p.z = relief_mm(p.truncate(), mouth_mm);
        *p += sway_mm;
    }
    mesh.uv = Some(mesh.positions_mm.iter().map(|p| picture.px_to_uv(to_px(p.truncate()).into())).collect());
    Scan { tick, time_nanos, mesh, texture: Some(picture) }
}

/// A closed surface with texture coordinates: an octahedron, its triangles split in four `levels` times, on a sphere.
pub fn closed(levels: u32) -> TriMesh {
    let mut triangles: Vec<[Vec3; 3]> = Vec::new();
    for (x, y, z) in [(1.0, 1.0, 1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, -1.0)] {
        let [a, b, c] = [Vec3::X * x, Vec3::Y * y, Vec3::Z * z];
        triangles.extend([[a, b, c], [b, a, -c]]);
    }
    for _ in 0..levels {
        let split = |[a, b, c]: [Vec3; 3]| {
            let [ab, bc, ca] = [(a + b).normalize(), (b + c).normalize(), (c + a).normalize()];
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        };
        triangles = triangles.into_iter().flat_map(split).collect();
    }
    let mut mesh = TriMesh::default();
    for t in triangles {
        mesh.triangles.push(t.map(|p| {
            let p = p * 60.0;
            let known = mesh.positions_mm.iter().position(|q| q.distance(p) < 1e-3);
            known.unwrap_or_else(|| {
                mesh.positions_mm.push(p);
                mesh.positions_mm.len() - 1
            }) as u32
        }));
    }
    mesh.uv = Some(mesh.positions_mm.iter().map(|p| [0.5 + p.x / 200.0, 0.5 + p.y / 200.0]).collect());
    mesh
}

/// Writes the scans of some ticks as `frame_0000.obj` and so on with their pictures.
///
/// # Panics
/// When the folder cannot be written.
pub fn write_scans(folder: &Path, format: ExportFormat, scans: impl IntoIterator<Item = Scan>) {
    let writer = ExportWriter::create(folder, format, false).expect("a folder for scans");
    for scan in scans {
        writer.write(scan.tick, &scan.mesh, scan.texture.as_ref()).expect("a scan on disk");
    }
}

/// The grid points inside an ellipse, z = 0, in millimetres at rest.
fn oval() -> TriMesh {
    let at = |column: usize, row: usize| {
        let unit = Vec2::new(column as f32 / (COLUMNS - 1) as f32, row as f32 / (ROWS - 1) as f32);
        (unit * 2.0 - 1.0) * HALF_SIZE_MM
    };
    let mut mesh = TriMesh::default();
    let mut index = vec![None; COLUMNS * ROWS];
    for (i, slot) in index.iter_mut().enumerate() {
        let p = at(i % COLUMNS, i / COLUMNS);
        if (p / HALF_SIZE_MM).length_squared() <= 1.0 {
            *slot = Some(mesh.positions_mm.len() as u32);
            mesh.positions_mm.push(p.extend(0.0));
        }
    }
    for i in (0..(ROWS - 1) * COLUMNS).filter(|i| i % COLUMNS + 1 < COLUMNS) {
        let [a, b, c, d] = [index[i], index[i + 1], index[i + COLUMNS + 1], index[i + COLUMNS]];
        mesh.triangles.extend(a.zip(b).zip(c).map(|((a, b), c)| [a, b, c]));
        mesh.triangles.extend(a.zip(c).zip(d).map(|((a, c), d)| [a, c, d]));
    }
    mesh.submesh(|_| true).0
}

/// Dome, nose and a mouth that moves.
fn relief_mm(p: Vec2, mouth_mm: f32) -> f32 {
    let bump = |centre: Vec2, radius_mm: f32| (-(p - centre).length_squared() / (radius_mm * radius_mm)).exp();
    let dome = 40.0 * (1.0 - 0.8 * (p / HALF_SIZE_MM).length_squared());
    dome + 18.0 * bump(Vec2::new(0.0, 5.0), 16.0) + mouth_mm * bump(Vec2::new(0.0, -40.0), 22.0)
}

fn to_px(p: Vec2) -> Vec2 {
    let centre = Vec2::new(WIDTH_PX as f32, HEIGHT_PX as f32) * 0.5;
    centre + Vec2::new(p.x, -p.y) * PX_PER_MM
}

/// What the camera sees: skin that moves with the face.
fn picture(shift_mm: Vec2) -> GreyPicture {
    let pixels = (0..WIDTH_PX * HEIGHT_PX).map(|i| {
        let px = Vec2::new((i % WIDTH_PX) as f32, (i / WIDTH_PX) as f32);
        let p = (px - to_px(Vec2::ZERO)) / PX_PER_MM * Vec2::new(1.0, -1.0) - shift_mm;
        (128.0 + 90.0 * spots(p / 5.0)).clamp(0.0, 255.0) as u8
    });
    GreyPicture::new(WIDTH_PX, HEIGHT_PX, pixels.collect())
}

/// Value noise, -1 to 1, smooth, one random level a unit square.
fn spots(p: Vec2) -> f32 {
    let level = |x: i32, y: i32| {
        let mut h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77);
        h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
        h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
        (h ^ (h >> 15)) as f32 / u32::MAX as f32 * 2.0 - 1.0
    };
    let (cell, f) = (p.floor(), p - p.floor());
    let s = f * f * (3.0 - 2.0 * f);
    let (x, y) = (cell.x as i32, cell.y as i32);
    let row = |y: i32| level(x, y) + (level(x + 1, y) - level(x, y)) * s.x;
    row(y) + (row(y + 1) - row(y)) * s.y
}
