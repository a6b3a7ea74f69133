//! Ratio and speed of raw recording and its playback, 640x480, on pictures of the simulated scanner.
#![allow(missing_docs, clippy::unwrap_used)]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use gv3::device::{self, Frame, RigConfig};
use gv3_protocol::raw::{RawReader, RawStamp, RawWriter, filter};
use std::path::Path;
use std::time::Instant;

fn frames(count: usize) -> Vec<Frame> {
    let config = RigConfig::simulated();
    let mut rig = device::open(&config).unwrap();
    rig.camera.configure(&config.camera_settings()).unwrap();
    rig.projector.load(&rig.sequence).unwrap();
    rig.camera.start().unwrap();
    rig.projector.play(&rig.timing).unwrap();
    (0..count).map(|_| rig.camera.next_frame(Instant::now()).unwrap()).collect()
}

fn write(folder: &Path, frames: &[Frame]) -> u64 {
    let mut writer = RawWriter::create(folder, "", 0).unwrap();
    for frame in frames {
        let stamp = RawStamp { sequence: frame.sequence, ..RawStamp::default() };
        writer.picture(&stamp, [640, 480], &frame.picture.pixels).unwrap();
    }
    let bytes = writer.bytes();
    writer.finish(0).unwrap();
    bytes
}

fn raw(c: &mut Criterion) {
    let frames = frames(60);
    let folder = tempfile::tempdir().unwrap();
    let bytes = write(&folder.path().join("one"), &frames);
    let pixels = (frames.len() * 640 * 480) as f64;
    println!("{:.3} bits a pixel, 1 : {:.2}", 8.0 * bytes as f64 / pixels, pixels / bytes as f64);
    let mut group = c.benchmark_group("raw");
    group.sample_size(20);
    let mut residuals = vec![0; 640 * 480];
    group.throughput(Throughput::Elements(1));
    group.bench_function("residuals", |b| b.iter(|| filter::residuals(&frames[3].picture.pixels, 640, &mut residuals)));
    group.bench_function("undo", |b| {
        b.iter_batched_ref(|| residuals.clone(), |bytes| filter::undo(bytes, 640), criterion::BatchSize::LargeInput);
    });
    group.throughput(Throughput::Elements(frames.len() as u64));
    let mut number = 0;
    group.bench_function("write_60", |b| {
        b.iter(|| {
            number += 1;
            let path = folder.path().join(number.to_string());
            write(&path, &frames);
            std::fs::remove_dir_all(path).unwrap();
        });
    });
    let mut reader = RawReader::open(&folder.path().join("one")).unwrap();
    group.bench_function("read_60", |b| {
        b.iter(|| {
            reader.rewind();
            while reader.next(true).unwrap().is_some() {}
        });
    });
    group.finish();
}

criterion_group!(benches, raw);
criterion_main!(benches);
