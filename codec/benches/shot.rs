//! The default mode on a generated surface that waves, of about 110,000 pixels with a speckled picture.
//! `cargo bench -p gv3-codec --bench shot -- decode` prints the decoder's times.

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use glam::Vec3;
use gv3_codec::shot::anchors::Anchors;
use gv3_codec::shot::as_scan::as_scan;
use gv3_codec::shot::camera::ShotCamera;
use gv3_codec::shot::encoder::{Encoder, ShotConfig};
use gv3_codec::shot::group::{Chain, Parts, Wanted};
use gv3_codec::shot::register::{RegisterOptions, register};
use gv3_codec::shot::scan_image::ScanImage;
use gv3_codec::shot::steps::Steps;
use gv3_codec::{GreyPicture, Result, Scan, mesh::TriMesh};
use std::hint::black_box;

/// Pixels a side, what one covers, and the radius that the surface fills.
const SIDE: u32 = 400;
const PIXEL_MM: f32 = 0.5;
const RADIUS_MM: f32 = 94.0;
const PERIOD_NANOS: u64 = 33_333_333;
/// Scans up to the second keyframe.
const SCANS: u64 = 11;

/// The surface at a tick: a dome whose waves travel, and that sways.
fn scan(tick: u64) -> Scan {
    let time = tick as f32 * 0.1;
    let centred = |x: u32, y: u32| [x, y].map(|v| (v as f32 - SIDE as f32 / 2.0) * PIXEL_MM);
    let sway = 3.0 * time.sin();
    let seen = |x: u32, y: u32| {
        let [px, py] = centred(x, y);
        (px - sway).hypot(py) < RADIUS_MM
    };
    let position = |x: u32, y: u32| {
        let [px, py] = centred(x, y);
        let u = px - sway;
        let waves = 1.5 * (0.09 * u + time).sin() * (0.07 * py).cos() + 0.05 * (1.7 * u).sin() * (1.3 * py).sin();
        Vec3::new(px, -py, (130f32 * 130.0 - u * u - py * py).sqrt() + waves)
    };
    let grey = |x: u32, y: u32| {
        let [px, py] = centred(x, y);
        let u = px - sway;
        let speckle = (2.1 * u + 0.6 * py).sin() + (0.8 * u - 1.9 * py).cos() + (1.3 * u + 1.6 * py).sin();
        (120.0 + 25.0 * speckle) as u8
    };
    let pixels = || (0..SIDE * SIDE).map(|i| (i % SIDE, i / SIDE));
    let picture = GreyPicture::new(SIDE, SIDE, pixels().map(|(x, y)| grey(x, y)).collect());
    let mut triangles = Vec::new();
    for (x, y) in pixels().filter(|&(x, y)| x + 1 < SIDE && y + 1 < SIDE) {
        if [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)].iter().all(|&(x, y)| seen(x, y)) {
            let a = y * SIDE + x;
            triangles.extend([[a, a + SIDE, a + SIDE + 1], [a, a + SIDE + 1, a + 1]]);
        }
    }
    let whole = TriMesh {
        positions_mm: pixels().map(|(x, y)| position(x, y)).collect(),
        triangles,
        uv: Some(pixels().map(|(x, y)| picture.px_to_uv([x as f32, y as f32])).collect()),
    };
    let mesh = whole.submesh(|_| true).0;
    Scan { tick, time_nanos: tick * PERIOD_NANOS, mesh, texture: Some(picture) }
}

/// An encoder that has taken the first keyframe, and that keyframe's payload.
fn begun(first: &Scan) -> Result<(Encoder, Vec<u8>)> {
    let mut encoder = Encoder::new(ShotConfig::new(PERIOD_NANOS))?;
    let pushed = encoder.push(first.clone())?;
    Ok((encoder, pushed.group.map(|g| g.geometry).unwrap_or_default()))
}

/// Pushes scans up to the next keyframe; its group's payload.
fn push_all(encoder: &mut Encoder, scans: Vec<Scan>) -> Result<Vec<u8>> {
    let mut payload = Vec::new();
    for scan in scans {
        payload.extend(encoder.push(scan)?.group.into_iter().flat_map(|g| g.geometry));
    }
    Ok(payload)
}

fn bench(c: &mut Criterion) {
    let scans: Vec<Scan> = (0..SCANS).map(scan).collect();
    let steps = Steps::default();
    let (mut encoder, first) = begun(&scans[0]).expect("the generated scan can be a keyframe");
    let header = encoder.header();
    let second = push_all(&mut encoder, scans[1..].to_vec()).expect("the scans follow one another");
    let read = |payload: &'static [u8]| Parts::read(&header, payload).expect("it was just encoded");
    let (first, second): (&'static [u8], &'static [u8]) = (first.leak(), second.leak());
    let before: Chain = read(first).decode_key(&steps, None).expect("it begins a shot");
    let parts = read(second);
    let after = parts.decode_key(&steps, Some(&before)).expect("it follows");
    let key = &after.keys.scans[&parts.key_stamp().tick];
    let camera = ShotCamera::of(&scans[1]).expect("texture coordinates show a camera");
    let window = camera.window(&scans[1]).expect("it sees its scan");
    let image = ScanImage::new(&scans[1], &before.model.view, window);
    let still = &before.keys.scans[&0].placed.motion;

    let mut group = c.benchmark_group(format!("shot of {} pixels", scans[0].mesh.vertex_count()));
    group.sample_size(20);
    group.bench_function("decode of a key scan", |b| {
        b.iter(|| black_box(&parts).decode_key(&steps, Some(&before)));
    });
    group.bench_function("decode of nine scans between", |b| {
        b.iter(|| black_box(&parts).decode_between(&steps, Some(&before), &after, Wanted::All));
    });
    group.bench_function("as_scan", |b| b.iter(|| as_scan(&after.model, black_box(key))));
    group.bench_function("register without tracked points", |b| {
        let options = RegisterOptions::default();
        let points = (&Anchors::default(), &[][..]);
        b.iter(|| register(&before.model, still, black_box(&image), points, &steps.motion, &options));
    });
    group.sample_size(10);
    group.bench_function("encode of ten scans, the last one key", |b| {
        let setup = || (begun(&scans[0]).expect("as before").0, scans[1..].to_vec());
        b.iter_batched(setup, |(mut encoder, scans)| push_all(&mut encoder, scans), BatchSize::PerIteration);
    });
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
