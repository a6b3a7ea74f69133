//! Arbitrary bytes as the textures of a group of shots. Run from `codec/` with `cargo +nightly fuzz run textures`.
#![no_main]

#[allow(dead_code)]
mod payloads;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| payloads::textures(bytes));
