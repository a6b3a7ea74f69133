//! A small moving surface on a camera's pixels, made of sums, products, quotients and roots alone, so that every machine
//! and every build has the same numbers.

use glam::Vec3;
use gv3_codec::mesh::TriMesh;
use gv3_codec::{GreyPicture, Scan};

/// Columns of the picture.
pub const WIDTH: usize = 48;
/// Rows of the picture.
pub const HEIGHT: usize = 40;
/// Nanoseconds of a tick.
pub const PERIOD_NANOS: u64 = 33_333_333;
const PITCH_MM: f32 = 2.0;

/// Which of two surfaces is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Surface {
    /// A dome with a bump that wanders.
    Dome,
    /// A bowl elsewhere, which nothing takes for the dome.
    Bowl,
}

/// The surface at a tick.
pub fn scan(tick: u64, surface: Surface) -> Scan {
    let phase = wave(tick as f32);
    let mut mesh = TriMesh::default();
    let mut vertex = vec![None; WIDTH * HEIGHT];
    let mut uv = Vec::new();
    let picture = picture(phase);
    for (i, v) in vertex.iter_mut().enumerate() {
        let [x, y] = [(i % WIDTH) as f32, (i / WIDTH) as f32];
        if let Some(z) = depth_mm(surface, (x - 23.5) * PITCH_MM, (19.5 - y) * PITCH_MM, phase) {
            *v = Some(mesh.positions_mm.len() as u32);
            mesh.positions_mm.push(Vec3::new((x - 23.5) * PITCH_MM, (19.5 - y) * PITCH_MM, z));
            uv.push(picture.px_to_uv([x, y]));
        }
    }
    for i in (0..(HEIGHT - 1) * WIDTH).filter(|i| i % WIDTH + 1 < WIDTH) {
        // Rows go down: a b above d c, counter-clockwise as seen.
        let [a, b, c, d] = [vertex[i], vertex[i + 1], vertex[i + WIDTH + 1], vertex[i + WIDTH]];
        mesh.triangles.extend(a.zip(d).zip(c).map(|((a, d), c)| [a, d, c]));
        mesh.triangles.extend(a.zip(c).zip(b).map(|((a, c), b)| [a, c, b]));
    }
    mesh.uv = Some(uv);
    Scan { tick, time_nanos: tick * PERIOD_NANOS, mesh, texture: Some(picture) }
}

/// Height above the image plane, mm; nothing off the surface.
fn depth_mm(surface: Surface, x: f32, y: f32, phase: f32) -> Option<f32> {
    let (cx, cy, radius) = match surface {
        Surface::Dome => (1.5 * phase, 0.5 * phase, 33.0),
        Surface::Bowl => (-6.0, 2.0, 30.0),
    };
    let (dx, dy) = (x - cx, y - cy);
    let r2 = (dx * dx + dy * dy) / (radius * radius);
    let bump = |x: f32, y: f32, width: f32| {
        let q = 1.0 + ((dx - x) * (dx - x) + (dy - y) * (dy - y)) / (width * width);
        1.0 / (q * q)
    };
    (r2 < 1.0).then(|| match surface {
        Surface::Dome => 25.0 * (1.0 - 0.7 * r2) + 8.0 * bump(2.0, 4.0, 9.0) + (2.0 + phase) * bump(-9.0, -12.0, 7.0),
        Surface::Bowl => -70.0 + 60.0 * r2 + 4.0 * bump(5.0, 5.0, 8.0),
    })
}

/// A smooth periodic function of the tick, -1 to 1: parabolas through zeros 8 ticks apart.
fn wave(tick: f32) -> f32 {
    let turn = tick / 16.0 - (tick / 16.0).floor();
    let half = |t: f32| 16.0 * t * (0.5 - t);
    if turn < 0.5 { half(turn) } else { -half(turn - 0.5) }
}

/// Spots that move with the dome.
fn picture(phase: f32) -> GreyPicture {
    let level = |x: i32, y: i32| {
        let h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77);
        ((h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d) >> 16) as f32 / 65536.0
    };
    let pixels = (0..WIDTH * HEIGHT).map(|i| {
        let [x, y] = [(i % WIDTH) as f32 - 0.75 * phase, (i / WIDTH) as f32 + 0.25 * phase].map(|v| v / 4.0 + 8.0);
        let (column, row) = (x.floor(), y.floor());
        let (fx, fy) = (x - column, y - row);
        let at = |dx: i32, dy: i32| level(column as i32 + dx, row as i32 + dy);
        let line = |dy: i32| at(0, dy) * (1.0 - fx) + at(1, dy) * fx;
        (60.0 + 140.0 * (line(0) * (1.0 - fy) + line(1) * fy)) as u8
    });
    GreyPicture::new(WIDTH as u32, HEIGHT as u32, pixels.collect())
}
