//! Coded textures of the size and content of a face scan: 337x438 px, an ellipse of speckled skin under moving light.

use criterion::{Criterion, criterion_group, criterion_main};
use gv3_codec::texture::coded::{Models, Offsets, Options, Planes, Source, decode, encode};
use std::hint::black_box;

const SIZE: [usize; 2] = [337, 438];

fn scene(shift: f32, light: f32) -> (Planes, Vec<bool>) {
    let [width, height] = SIZE;
    let at = |i: usize| ((i % width) as f32, (i / width) as f32);
    let inside = |i: usize| ((at(i).0 - 168.0 - shift) / 160.0).powi(2) + ((at(i).1 - 219.0) / 210.0).powi(2) < 1.0;
    let level = |i: usize| {
        let (x, y) = (at(i).0 - shift, at(i).1);
        let speckle = (1.1 * x + 0.3 * y).sin() + (0.4 * x - 0.9 * y).cos() + (0.7 * x + 0.8 * y).sin();
        let noise = ((i as u32 ^ (light as u32) << 20).wrapping_mul(2_654_435_761) >> 24) as f32 / 64.0 - 2.0;
        ((110.0 + light + 0.1 * y + 0.1 * x + 8.0 * speckle + noise) * 16.0) as i16
    };
    let count = width * height;
    (Planes { width, height, levels: vec![(0..count).map(level).collect()] }, (0..count).map(inside).collect())
}

fn pictures(c: &mut Criterion) {
    let [width, height] = SIZE;
    let ((first, first_mask), (second, mask)) = (scene(0.0, 0.0), scene(3.0, 5.0));
    let options = Options::with_step(150);
    c.bench_function("texture: encode a first picture", |b| {
        b.iter(|| encode(black_box(&first), &first_mask, &[], &mut Models::default(), &options));
    });
    let (first_bytes, decoded) = encode(&first, &first_mask, &[], &mut Models::default(), &options);
    c.bench_function("texture: decode a first picture", |b| {
        b.iter(|| decode(black_box(&first_bytes), (1, SIZE), &first_mask, &[], &mut Models::default()));
    });
    let offsets = Offsets::even(width, height, [90 - 3 * 256, -40]);
    let source = Source { planes: &decoded.planes, offsets: &offsets, weight: 256 };
    c.bench_function("texture: encode a predicted picture", |b| {
        b.iter(|| encode(black_box(&second), &mask, &[source], &mut Models::default(), &options));
    });
    let (bytes, _) = encode(&second, &mask, &[source], &mut Models::default(), &options);
    c.bench_function("texture: decode a predicted picture", |b| {
        b.iter(|| decode(black_box(&bytes), (1, SIZE), &mask, &[source], &mut Models::default()));
    });
    let half = Source { weight: 128, ..source };
    let coarse = Options::with_step(400);
    c.bench_function("texture: encode a picture between two", |b| {
        b.iter(|| encode(black_box(&second), &mask, &[half, half], &mut Models::default(), &coarse));
    });
}

criterion_group!(benches, pictures);
criterion_main!(benches);
