//! Matching of two disks: 68 landmarks, a source disk of about 20,000 vertices.

use criterion::{Criterion, criterion_group, criterion_main};
use glam::DVec2;
use gv3_codec::param::clamped_plate::ClampedPlate;
use gv3_codec::param::matching::{DiskMatch, SourceDisk, WarpKind};
use gv3_codec::param::mobius::Mobius;
use gv3_codec::param::thin_plate::ThinPlate;
use std::hint::black_box;

/// Rings of points over the disk and the triangles between them.
fn disk(rings: u32, around: u32) -> (Vec<DVec2>, Vec<[u32; 3]>) {
    let mut points = vec![DVec2::ZERO];
    for k in 1..=rings {
        let at = |j: u32| DVec2::from_angle(std::f64::consts::TAU * f64::from(j) / f64::from(around));
        points.extend((0..around).map(|j| at(j) * f64::from(k) / f64::from(rings)));
    }
    let vertex = |k: u32, j: u32| 1 + (k - 1) * around + j % around;
    let mut triangles: Vec<[u32; 3]> = (0..around).map(|j| [0, vertex(1, j), vertex(1, j + 1)]).collect();
    for (k, j) in (1..rings).flat_map(|k| (0..around).map(move |j| (k, j))) {
        let [a, b, c, d] = [vertex(k, j), vertex(k + 1, j), vertex(k + 1, j + 1), vertex(k, j + 1)];
        triangles.extend([[a, b, c], [a, c, d]]);
    }
    (points, triangles)
}

fn matching(c: &mut Criterion) {
    let (points, triangles) = disk(80, 250);
    let spot = |k: u32| DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / 68.0).sqrt() * 0.9;
    let from: Vec<DVec2> = (0..68).map(spot).collect();
    let shake = |p: &DVec2| *p + DVec2::new((7.0 * p.y).sin(), (5.0 * p.x).cos()) * 0.03 * (1.0 - p.length());
    let to: Vec<DVec2> = from.iter().map(shake).collect();
    c.bench_function("Möbius fit, 68 landmarks", |b| b.iter(|| Mobius::fit(black_box(&from), &to)));
    c.bench_function("clamped plate fit, 68 landmarks", |b| b.iter(|| ClampedPlate::fit(black_box(&from), &to)));
    let plate = ClampedPlate::fit(&from, &to).unwrap_or_else(|e| panic!("{e}"));
    c.bench_function("clamped plate evaluation, 20,000 vertices", |b| {
        b.iter(|| plate.images(black_box(&points)));
    });
    let plate = ThinPlate::fit(&from, &to, 1e-3).unwrap_or_else(|e| panic!("{e}"));
    c.bench_function("thin plate evaluation, 20,000 vertices", |b| {
        b.iter(|| plate.images(black_box(&points)));
    });
    let source = SourceDisk { points: &points, triangles: &triangles };
    for (name, kind) in [("clamped plate", WarpKind::ClampedPlate), ("thin plate", WarpKind::ThinPlate)] {
        c.bench_function(&format!("{name}: Möbius, fit, evaluation, fold check, 20,000 vertices"), |b| {
            b.iter(|| DiskMatch::fit(black_box(&from), &to, source, &kind));
        });
    }
}

criterion_group!(benches, matching);
criterion_main!(benches);
