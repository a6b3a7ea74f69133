//! Arbitrary bytes as a segment of a raw recording. Run from `protocol/` with `cargo +nightly fuzz run raw_segment`.
#![no_main]

mod raw_exercise;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| raw_exercise::segment(bytes));
