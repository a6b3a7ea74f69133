//! The corpora of the fuzz targets, without the fuzzer: no payload found so far panics.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

#[path = "../fuzz/fuzz_targets/payloads.rs"]
mod payloads;

use std::path::Path;

/// Runs every seed of a target, and every seed with a byte changed in a few ways.
fn run(target: &str, check: fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target);
    let mut seeds = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let mut bytes = std::fs::read(entry.unwrap().path()).unwrap();
        check(&bytes);
        for i in 0..bytes.len() {
            let was = bytes[i];
            for value in [0, 0x7f, 0xff, was.wrapping_add(1), was.wrapping_sub(1)] {
                bytes[i] = value;
                check(&bytes);
            }
            bytes[i] = was;
        }
        seeds += 1;
    }
    assert!(seeds >= 3, "{seeds} seeds of {target}");
}

/// Runs every seed of a target that takes long, and every seed with a few bytes changed.
fn run_some(target: &str, check: fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target);
    let mut seeds = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let mut bytes = std::fs::read(entry.unwrap().path()).unwrap();
        check(&bytes);
        for k in 1..=CHANGES {
            let i = k * bytes.len() / (CHANGES + 1);
            bytes[i] ^= 1 << k;
            check(&bytes);
            bytes[i] ^= 1 << k;
        }
        seeds += 1;
    }
    assert!(seeds >= 3, "{seeds} seeds of {target}");
}

/// Bytes of a seed that are changed one after another.
const CHANGES: usize = 3;

#[test]
fn groups_of_shots() {
    run_some("shots", payloads::shots);
}

#[test]
fn textures_of_groups() {
    run_some("textures", payloads::textures);
}

#[test]
fn coded_textures() {
    run("coded_texture", payloads::coded_texture);
}

#[test]
fn stream_headers() {
    run("stream_header", payloads::stream_header);
}

#[test]
fn groups() {
    run("group", payloads::group);
}

#[test]
fn textures() {
    run("texture", payloads::texture);
}
