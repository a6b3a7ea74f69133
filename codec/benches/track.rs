//! Tracking kernels at 640x480.

use criterion::{Criterion, criterion_group, criterion_main};
use gv3_codec::motion::{
    CornerOptions, FloatPicture, FlowOptions, GREY_SIGMA_PX, GREY_VARIANCE_FLOOR, Mask, Pyramid, find_corners, follow,
    normalize,
};
use std::hint::black_box;

/// Speckle of a few pixels on a shaded surface, shifted by (dx, dy) px.
fn speckle(dx: f32, dy: f32) -> FloatPicture {
    let at = |i: u32| {
        let (x, y) = ((i % 640) as f32 - dx, (i / 640) as f32 - dy);
        let waves =
            (1.1 * x + 0.3 * y).sin() + (0.4 * x - 0.9 * y).cos() + (0.7 * x + 0.8 * y).sin() + (0.23 * x * 0.9).sin();
        120.0 + 0.05 * x + 8.0 * waves
    };
    FloatPicture::new(640, 480, (0..640 * 480).map(at).collect())
}

fn kernels(c: &mut Criterion) {
    let mask = Mask::full(640, 480);
    let normal = |p: &FloatPicture| normalize(p, &mask, GREY_SIGMA_PX, GREY_VARIANCE_FLOOR);
    let (first, second) = (speckle(0.0, 0.0), speckle(1.3, -0.8));
    c.bench_function("normalize 640x480", |b| b.iter(|| normal(black_box(&first))));
    let (from, to) = (Pyramid::new(&normal(&first), 3), Pyramid::new(&normal(&second), 3));
    c.bench_function("pyramid 640x480", |b| b.iter(|| Pyramid::new(black_box(&first), 3)));
    let allowed = mask.eroded(7);
    c.bench_function("corners 640x480", |b| {
        b.iter(|| find_corners(from.finest(), allowed.clone(), &[], &CornerOptions::default()));
    });
    let mut points = find_corners(from.finest(), allowed.clone(), &[], &CornerOptions::default());
    points.truncate(600);
    for window_px in [9, 15] {
        let options = FlowOptions { window_px, ..FlowOptions::default() };
        c.bench_function(&format!("flow {} points, window {window_px}", points.len()), |b| {
            b.iter(|| follow(&from, &to, black_box(&points), &options));
        });
    }
}

criterion_group!(benches, kernels);
criterion_main!(benches);
