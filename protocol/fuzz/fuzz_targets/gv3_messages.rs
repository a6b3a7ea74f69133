//! Arbitrary bytes as messages of the vendor protocol. Run from `protocol/` with `cargo +nightly fuzz run gv3_messages`.
#![no_main]

mod gv3_exercise;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| gv3_exercise::messages(bytes));
