//! Arbitrary bytes as the host's side of a connection. Run from `daemon/` with `cargo +nightly fuzz run usbip`.
#![no_main]

mod usb_exercise;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| usb_exercise::usbip(bytes));
