//! Arbitrary bytes as the host's side of a connection. Run from `daemon/` with `cargo +nightly fuzz run usbredir`.
#![no_main]

mod checks;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| checks::usbredir(bytes));
