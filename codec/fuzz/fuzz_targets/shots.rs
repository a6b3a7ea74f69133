//! Arbitrary bytes as a group of shots in a run. Run from `codec/` with `cargo +nightly fuzz run shots`.
#![no_main]

#[allow(dead_code)]
mod payloads;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| payloads::shots(bytes));
