//! Arbitrary bytes as a texture payload. Run from `codec/` with `cargo +nightly fuzz run texture`.
#![no_main]

#[allow(dead_code)]
mod payloads;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| payloads::texture(bytes));
