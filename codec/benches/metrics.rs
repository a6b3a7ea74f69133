//! Comparison of a scan with its replay: 122,500 vertices against 20,164.

use criterion::{Criterion, criterion_group, criterion_main};
use glam::Vec3;
use gv3_codec::mesh::TriMesh;
use gv3_codec::{GreyPicture, Scan, metrics};
use std::hint::black_box;

/// A face-like height field of `n` by `n` vertices over 180 by 180 mm: a dome with a ridge, two hollows, and ripples
/// of `noise_mm`.
fn face(n: u32, noise_mm: f32) -> Scan {
    let height = |x: f32, y: f32| {
        let bump = |cx: f32, cy: f32, sx: f32, sy: f32| {
            (-((x - cx) / sx) * ((x - cx) / sx) - ((y - cy) / sy) * ((y - cy) / sy)).exp()
        };
        let shape = 70.0 * bump(0.0, 0.0, 80.0, 95.0) + 25.0 * bump(0.0, -8.0, 10.0, 22.0)
            - 8.0 * (bump(-30.0, 20.0, 14.0, 9.0) + bump(30.0, 20.0, 14.0, 9.0));
        shape + noise_mm * ((x * 37.0).sin() + (y * 41.0).cos())
    };
    let at = |k: u32| [(k % n) as f32 / (n - 1) as f32, (k / n) as f32 / (n - 1) as f32];
    let point = |[u, v]: [f32; 2]| {
        let (x, y) = (180.0 * u - 90.0, 180.0 * v - 90.0);
        Vec3::new(x, y, height(x, y))
    };
    let quads = (0..n * (n - 1)).filter(|k| k % n < n - 1);
    let mesh = TriMesh {
        positions_mm: (0..n * n).map(|k| point(at(k))).collect(),
        triangles: quads.flat_map(|a| [[a, a + 1, a + n + 1], [a, a + n + 1, a + n]]).collect(),
        uv: Some((0..n * n).map(at).collect()),
    };
    let texture = GreyPicture::new(640, 480, (0..640 * 480).map(|k| (k * 7 / 5 % 251) as u8).collect());
    Scan { mesh, texture: Some(texture), ..Scan::default() }
}

fn compare(c: &mut Criterion) {
    let (scan, replay) = (face(350, 0.03), face(142, 0.0));
    c.bench_function("compare", |b| b.iter(|| metrics::compare(black_box(&scan), black_box(&replay))));
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(20);
    targets = compare
}
criterion_main!(benches);
