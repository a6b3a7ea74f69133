//! The DLPC350's bytes: sequences as other drivers send them, and what must hold for any bytes.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3_protocol::dlpc350::*;
use proptest::prelude::*;
use std::fs;
use std::path::Path;

#[path = "../fuzz/fuzz_targets/dlpc350_exercise.rs"]
mod exercise;

/// A report by its first bytes.
fn report(hex: &str) -> Report {
    let mut report = [0; REPORT_BYTES];
    for (byte, text) in report.iter_mut().zip(hex.split_whitespace()) {
        *byte = u8::from_str_radix(text, 16).unwrap();
    }
    report
}

fn sent<R: Register>(value: &R) -> Report {
    let reports = Request::write(0, value).reports().unwrap();
    assert_eq!(reports.len(), 1);
    reports[0]
}

fn entry(trigger: StartTrigger, pattern: u8, bits: u8, swaps_buffer: bool) -> LutEntry {
    LutEntry {
        trigger,
        pattern,
        depth: BitDepth::new(bits).unwrap(),
        leds: Leds::WHITE,
        inverted: false,
        black_after: false,
        swaps_buffer,
        shares_trigger: false,
    }
}

fn assert_bytes(pairs: &[(Report, &str)]) {
    for (found, hex) in pairs {
        assert_eq!(found, &report(hex), "{hex}");
    }
}

/// Three 7-bit patterns of a video frame, as pyCrafter4500 sends them.
#[test]
fn a_video_sequence_has_the_known_bytes() {
    let control = LutControl { patterns: 3, repeats: true, trigger_2_every: 3, images: 1 };
    let table = |trigger, pattern| sent(&PatternLut(vec![entry(trigger, pattern, 7, false)]));
    assert_bytes(&[
        (sent(&Playback::Stop), "40 00 03 00 24 1a 00"),
        (sent(&DisplayMode::PatternSequence), "40 00 03 00 1b 1a 01"),
        (sent(&PatternSource::Video), "40 00 03 00 22 1a 00"),
        // pyCrafter4500 forgets that images count less one; the controller passes over the byte for video.
        (sent(&control), "40 00 06 00 31 1a 02 01 02 00"),
        (sent(&TriggerMode::VerticalSync), "40 00 03 00 23 1a 00"),
        (sent(&ExposurePeriod { exposure_us: 4504, period_us: 4504 }), "40 00 0a 00 29 1a 98 11 00 00 98 11 00 00"),
        (sent(&Mailbox::Patterns), "40 00 03 00 33 1a 02"),
        (sent(&MailboxOffset(2)), "40 00 03 00 32 1a 02"),
        (table(StartTrigger::Rising, 0), "40 00 05 00 34 1a 01 77 00"),
        (table(StartTrigger::Continue, 1), "40 00 05 00 34 1a 07 77 00"),
        (table(StartTrigger::Continue, 2), "40 00 05 00 34 1a 0b 77 00"),
        (sent(&Mailbox::Closed), "40 00 03 00 33 1a 00"),
        (sent(&Validate), "40 00 03 00 1a 1a 00"),
        (sent(&Playback::Start), "40 00 03 00 24 1a 02"),
    ]);
}

/// Twice three 7-bit patterns from two flash images.
#[test]
fn a_flash_sequence_has_the_known_bytes() {
    use StartTrigger::{Continue, Internal};
    let table = [(Internal, 0, true), (Continue, 1, false), (Continue, 2, false)];
    let second = [(Continue, 0, true), (Continue, 1, false), (Continue, 2, false)];
    let entries = table.iter().chain(&second).map(|&(trigger, pattern, swap)| entry(trigger, pattern, 7, swap));
    let control = LutControl { patterns: 6, repeats: true, trigger_2_every: 6, images: 2 };
    let zero = TriggerDelay::ZERO;
    assert_bytes(&[
        (sent(&PatternSource::Flash), "40 00 03 00 22 1a 03"),
        (sent(&control), "40 00 06 00 31 1a 05 01 05 01"),
        (sent(&ExposurePeriod { exposure_us: 5555, period_us: 5555 }), "40 00 0a 00 29 1a b3 15 00 00 b3 15 00 00"),
        (sent(&TriggerMode::Internal), "40 00 03 00 23 1a 01"),
        (sent(&TriggerOut1 { inverted: false, rising: zero, falling: zero }), "40 00 05 00 1d 1a 00 bb bb"),
        (sent(&TriggerOut2 { inverted: false, rising: zero }), "40 00 04 00 1e 1a 00 bb"),
        (
            sent(&PatternLut(entries.collect())),
            "40 00 14 00 34 1a 00 77 04 07 77 00 0b 77 00 03 77 04 07 77 00 0b 77 00",
        ),
        (sent(&Mailbox::Images), "40 00 03 00 33 1a 01"),
        // Exactly two images go over the cable in reverse.
        (sent(&ImageLut(vec![0, 1])), "40 00 04 00 34 1a 01 00"),
        (sent(&ImageLut(vec![4, 5, 6])), "40 00 05 00 34 1a 04 05 06"),
        (Request::read::<Validation>(0).reports().unwrap()[0], "c0 00 02 00 1a 1a"),
        (Request::read::<HardwareStatus>(9).reports().unwrap()[0], "c0 09 02 00 0a 1a"),
        (Request::read::<SystemStatus>(0).reports().unwrap()[0], "c0 00 02 00 0b 1a"),
        (Request::read::<MainStatus>(0).reports().unwrap()[0], "c0 00 02 00 0c 1a"),
    ]);
}

#[test]
fn other_registers_have_the_known_bytes() {
    let leds = LedCurrent { rgb: [0, 255, 60] };
    assert_bytes(&[
        (sent(&leds), "40 00 05 00 01 0b ff 00 c3"),
        (sent(&LedEnable { rgb: [false, true, false], by_sequencer: true }), "40 00 03 00 07 1a 0a"),
        (sent(&Power::Standby), "40 00 03 00 00 02 01"),
        (sent(&InputSource { input: Input::FpdLink, port_width: 1 }), "40 00 03 00 00 1a 0b"),
    ]);
    let [red, green, blue] = leds.amperes();
    assert!((red - 0.4495).abs() < 1e-9 && (green - 4.9742).abs() < 1e-9 && (blue - 1.1129).abs() < 1e-9);
    // The entries that other drivers use for 8-bit patterns of one image.
    let entries = [(0, true), (1, false), (2, false)].map(|(p, swap)| entry(StartTrigger::Internal, p, 8, swap));
    assert_eq!(PatternLut(entries.to_vec()).encode(), [0x00, 0x78, 0x04, 0x04, 0x78, 0x00, 0x08, 0x78, 0x00]);
}

#[test]
fn a_long_message_goes_on_without_a_header() {
    let table = PatternLut(vec![entry(StartTrigger::Continue, 5, 4, false); MAX_PATTERNS]);
    let reports = Request::write(77, &table).reports().unwrap();
    // 2 command bytes and 384 of payload, behind 4 of header: 390 bytes.
    assert_eq!(reports.len(), 7);
    assert_eq!(&reports[0][..6], [0x40, 77, 0x82, 0x01, 0x34, 0x1a]);
    let bytes: Vec<u8> = reports.concat();
    assert_eq!(bytes[6..390], table.encode());
    assert!(bytes[390..].iter().all(|&b| b == 0));
    let too_long = Request { payload: vec![0; 511], ..Request::write(0, &table) };
    assert_eq!(too_long.reports().unwrap_err().to_string(), "byte 2: a length of 513 bytes, expected at most 512");
}

#[test]
fn replies_are_told_apart() {
    let request = Request::read::<MainStatus>(200);
    let reply = Reply::parse(&report("c0 c8 01 00 02")).unwrap();
    assert!(reply.answers(&request) && !reply.is_nack);
    assert!(MainStatus::decode(&reply.data).unwrap().is_running);
    assert!(!Reply::parse(&report("c0 c7 01 00 02")).unwrap().answers(&request));
    assert!(!Reply::parse(&report("40 c8 00 00")).unwrap().answers(&request));
    // Refused: by its flag, or a read without data.
    assert!(Reply::parse(&report("e0 c8 01 00 02")).unwrap().is_nack);
    assert!(Reply::parse(&report("c0 c8 00 00")).unwrap().is_nack);
    assert!(!Reply::parse(&report("40 c8 03 00")).unwrap().is_nack);
    let long = Reply::parse(&report("c0 c8 3d 00")).unwrap_err().to_string();
    assert_eq!(long, "byte 2: a length of 61 bytes, expected at most 60");
    assert_eq!(Reply::parse(&[0; 65]).unwrap_err().to_string(), "report of 65 bytes, expected 64");
}

#[test]
fn errors_name_register_and_byte() {
    let error = |result: std::result::Result<_, Dlpc350Error>| match result {
        Ok(()) => String::new(),
        Err(e) => e.to_string(),
    };
    let depth = error(PatternLut::decode(&[0, 0x77, 0, 0, 0x70, 0]).map(drop));
    assert_eq!(depth, "pattern table: byte 4 of the data is 112, expected a bit depth of 1 to 8 in its low four bits");
    assert!(error(PatternLut::decode(&[0, 0x77, 0x10]).map(drop)).contains("byte 2"));
    assert!(error(PatternLut::decode(&[0; 4]).map(drop)).starts_with("pattern table: 4 bytes"));
    assert_eq!(error(Version::decode(&[0; 15]).map(drop)), "version: 15 bytes of data, expected 16");
    assert!(error(LutControl::decode(&[0, 0, 0, 64]).map(drop)).contains("byte 3"));
    assert!(error(Playback::decode(&[3]).map(drop)).contains("expected 0 stop, 1 pause or 2 start"));
    assert!(error(TriggerOut1::decode(&[0, 0, 0xd6]).map(drop)).contains("byte 2"));
}

#[test]
fn exposure_and_period_keep_their_gap() {
    let check = |exposure_us, period_us| ExposurePeriod { exposure_us, period_us }.check(4500);
    for (exposure_us, period_us) in [(4500, 4500), (4500, 4730), (5555, 5555), (5000, 60_000)] {
        check(exposure_us, period_us).unwrap();
    }
    for (exposure_us, period_us) in [(4499, 9000), (4500, 4501), (4500, 4729), (4600, 4599)] {
        check(exposure_us, period_us).unwrap_err();
    }
    let hint = check(5500, 5555).unwrap_err().to_string();
    assert!(hint.contains("give 5555 us of light, or 5325 us or less"), "{hint}");
}

#[test]
fn trigger_delays_are_in_steps() {
    let byte = |nanos| TriggerOut2 { inverted: true, rising: TriggerDelay::from_nanos(nanos).unwrap() }.encode()[1];
    assert_eq!([-20_046, 0, 2787].map(byte), [0x00, 0xbb, 0xd5]);
    assert!((TriggerDelay::from_nanos(-1000).unwrap().nanos() + 1000.0).abs() <= 53.6);
    for nanos in [-20_110, 2850] {
        assert!(TriggerDelay::from_nanos(nanos).unwrap_err().to_string().contains("outside -20046 to 2787 ns"));
    }
}

#[test]
fn a_firmware_tag_cannot_garble_the_terminal() {
    let FirmwareTag(tag) = FirmwareTag::decode(b"LCR4500 \x1b[2J v3\0rest").unwrap();
    assert_eq!(tag, "LCR4500 ?[2J v3");
    let version = Version { application: 0x0304_0001, ..Version::default() };
    assert_eq!(version.firmware(), "3.4.1");
}

/// The corpus of the fuzz target, replayed by every test run.
#[test]
fn the_fuzz_corpus_never_panics() {
    let mut count = 0;
    for entry in fs::read_dir(corpus()).unwrap() {
        exercise::reports(&fs::read(entry.unwrap().path()).unwrap());
        count += 1;
    }
    assert!(count >= 4, "the corpus is missing");
}

fn corpus() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/dlpc350_reports")
}

/// Writes the corpus of the fuzz target: replies, refusals, requests, a long request, one that is cut off.
#[test]
#[ignore = "writes into the source tree"]
fn make_the_fuzz_corpus() {
    let reply = |data: Vec<u8>| Reply { is_read: true, is_nack: false, sequence: 3, data }.encode();
    let table = PatternLut(vec![entry(StartTrigger::Internal, 1, 8, true); 60]);
    let control = LutControl { patterns: 60, repeats: true, trigger_2_every: 60, images: 20 };
    let version = Version { application: 0x0404_0000, ..Version::default() };
    let requests = Request::write(4, &table).reports().unwrap();
    fs::create_dir_all(corpus()).unwrap();
    let write = |name: &str, reports: &[Report]| fs::write(corpus().join(name), reports.concat()).unwrap();
    let replies =
        [reply(version.encode()), reply(FirmwareTag("LightCrafter".into()).encode()), reply(control.encode())];
    write("replies", &replies);
    write("refused", &[report("e0 01 00 00"), report("60 02 00 00"), report("c0 01 00 00")]);
    write(
        "requests",
        &[sent(&control), sent(&Mailbox::Images), sent(&ImageLut(vec![0, 1])), sent(&PatternLut(vec![table.0[0]]))],
    );
    write("long_request", &requests);
    write("cut_off", &requests[..2]);
    write("impossible_length", &[report("40 00 ff ff 24 1a"), report("c0 00 ff 00")]);
}

proptest! {
    #[test]
    fn any_request_comes_back(
        kind in prop::sample::select(vec![RequestKind::Read, RequestKind::Write, RequestKind::WriteUnanswered]),
        sequence: u8, command: u16, payload in prop::collection::vec(any::<u8>(), 0..=510),
    ) {
        let request = Request { kind, sequence, command, payload };
        let mut device = RequestAssembler::default();
        let reports = request.reports().unwrap();
        for (i, report) in reports.iter().enumerate() {
            let whole = (i + 1 == reports.len()).then_some(&request);
            let found = device.push(report).unwrap();
            prop_assert_eq!(found.as_ref(), whole);
        }
    }

    #[test]
    fn any_reply_comes_back(is_nack: bool, sequence: u8, data in prop::collection::vec(any::<u8>(), 1..=60)) {
        let reply = Reply { is_read: true, is_nack, sequence, data };
        prop_assert_eq!(&Reply::parse(&reply.encode()).unwrap(), &reply);
    }

    #[test]
    fn any_bytes_are_understood_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..260)) {
        exercise::reports(&bytes);
    }

    /// Mostly valid headers, so that payloads are reached.
    #[test]
    fn any_data_is_understood_or_refused(
        flags in prop::sample::select(vec![0x40u8, 0xc0, 0xe0]), data in prop::collection::vec(any::<u8>(), 0..=60),
    ) {
        let bytes = [&[flags, 1, data.len() as u8, 0][..], &data, &vec![0; 60 - data.len()]].concat();
        exercise::reports(&bytes);
    }

    #[test]
    fn any_table_comes_back(cells in prop::collection::vec((0u8..4, 0u8..64, 1u8..=8, 0u8..128), 0..=128)) {
        let triggers =
            [StartTrigger::Internal, StartTrigger::Rising, StartTrigger::Falling, StartTrigger::Continue];
        let entries = cells.iter().map(|&(trigger, pattern, bits, flags)| LutEntry {
            leds: Leds { rgb: [flags & 1 > 0, flags & 2 > 0, flags & 4 > 0] },
            inverted: flags & 8 > 0,
            black_after: flags & 16 > 0,
            shares_trigger: flags & 64 > 0,
            ..entry(triggers[usize::from(trigger)], pattern, bits, flags & 32 > 0)
        });
        let table = PatternLut(entries.collect());
        prop_assert_eq!(PatternLut::decode(&table.encode()), Ok(table));
    }
}
