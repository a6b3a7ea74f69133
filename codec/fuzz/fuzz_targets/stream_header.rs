//! Arbitrary bytes as a stream header payload. Run from `codec/` with `cargo +nightly fuzz run stream_header`.
#![no_main]

#[allow(dead_code)]
mod payloads;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| payloads::stream_header(bytes));
