//! Arbitrary bytes as reports of a DLPC350 and of its host. Run from `protocol/` with `cargo +nightly fuzz run dlpc350_reports`.
#![no_main]

mod dlpc350_exercise;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| dlpc350_exercise::reports(bytes));
