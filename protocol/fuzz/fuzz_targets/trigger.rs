//! Arbitrary bytes as lines of the trigger's protocol, and to its model. Run from `protocol/` with
//! `cargo +nightly fuzz run trigger`.
#![no_main]

mod trigger_exercise;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| trigger_exercise::trigger(bytes));
