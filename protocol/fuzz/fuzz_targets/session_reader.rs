//! Arbitrary bytes through everything that reads a session. Run from `protocol/` with
//! `cargo +nightly fuzz run session_reader`.
#![no_main]

use std::io::Cursor;

use gv3_protocol::session::{SessionReader, recover_source, verify_source};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(mut reader) = SessionReader::from_source(Cursor::new(bytes), "fuzz") {
        for index in 0..reader.groups().len() {
            let _ = reader.read_group(index);
        }
        let _ = (reader.events(), reader.telemetry(), reader.totals());
    }
    let _ = verify_source(Cursor::new(bytes), "fuzz");
    if let Ok((sink, _)) = recover_source(Cursor::new(bytes), "fuzz", Cursor::new(Vec::new())) {
        let verified = verify_source(Cursor::new(sink.into_inner()), "fuzz");
        assert!(verified.is_ok_and(|report| report.ok()), "recovery wrote a session that does not verify");
    }
});
