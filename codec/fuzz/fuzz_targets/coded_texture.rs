//! Arbitrary bytes as a coded texture. Run from `codec/` with `cargo +nightly fuzz run coded_texture`.
#![no_main]

#[allow(dead_code)]
mod payloads;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| payloads::coded_texture(bytes));
