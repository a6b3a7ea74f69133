//! The vendor protocol's messages: golden bytes, round trips, damage at every byte, pieces of every size.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

#[path = "../fuzz/fuzz_targets/gv3_exercise.rs"]
mod gv3_exercise;

use gv3_protocol::gv3::{
    Axis, BodyError, Decoder, DeviceFault, DeviceState, Event, Exposure, FRAMING_BYTES, FaultEvent, Identity,
    MAX_EVENT_BYTES, MAX_LEVELS, MAX_ORDER, Message, Refusal, Reply, Request, Status, Timing,
};
use proptest::prelude::*;
use std::fs;
use std::path::Path;

fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.bytes().filter(|b| !b.is_ascii_whitespace()).collect();
    digits.chunks(2).map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap()).collect()
}

fn decode_all(bytes: &[u8]) -> (Vec<Message>, u64) {
    let (mut decoder, mut messages) = (Decoder::default(), Vec::new());
    decoder.push(bytes);
    while let Some(message) = decoder.next_message() {
        messages.push(message);
    }
    (messages, decoder.damaged_bytes())
}

fn one(bytes: &[u8]) -> Message {
    let (mut messages, damaged) = decode_all(bytes);
    assert_eq!((messages.len(), damaged), (1, 0));
    messages.remove(0)
}

fn status() -> Status {
    Status {
        state: DeviceState::Running,
        fault: None,
        pattern_count: 6,
        order_count: 7,
        triggers: 0x0102_0304_0506,
        device_time_nanos: 5_555_556,
        events_lost: 3,
        board_millidegrees: Some(-1500),
        light_millidegrees: None,
    }
}

const EXPOSURE: Exposure =
    Exposure { trigger: 13, set: 2, position: 1, pattern: 5, device_time_nanos: 72_222_228, exposure_nanos: 5_000_000 };

fn identity() -> Identity {
    Identity {
        firmware_version: 0x0102,
        width_px: 912,
        height_px: 1140,
        max_patterns: 256,
        max_order: 1024,
        min_period_nanos: 5_000_000,
        max_period_nanos: 10_000_000_000,
        model: "Streifenlicht 3 für Köpfe".into(),
        serial: "A-0001".into(),
    }
}

/// What GV3.md freezes. A change here is another version.
#[test]
fn golden_messages() {
    let pattern = Request::Pattern { index: 3, axis: Axis::Rows, levels: vec![0, 128, 255] };
    let timing = Timing { period_nanos: 5_555_556, exposure_nanos: 5_000_000 };
    let show = Request::Show(2).message(7);
    let refusal = BodyError::Refused { refusal: Refusal::State, text: "ARM while Idle".into() };
    let fault = FaultEvent { fault: DeviceFault::Temperature, device_time_nanos: 9 };
    let golden = [
        ("show", show.encode(), GOLDEN[0]),
        ("shown", Request::reply(&show, Ok(Reply::Done)).encode(), GOLDEN[1]),
        ("pattern", pattern.message(0xfffe).encode(), GOLDEN[2]),
        ("order", Request::Order(vec![0, 1, 258]).message(1).encode(), GOLDEN[3]),
        ("timing", Request::Timing(timing).message(2).encode(), GOLDEN[4]),
        ("status", Request::reply(&Request::Status.message(3), Ok(Reply::Status(status()))).encode(), GOLDEN[5]),
        ("refusal", Request::reply(&Request::Arm.message(4), Err(refusal)).encode(), GOLDEN[6]),
        ("exposure", Event::Exposure(EXPOSURE).message(13).encode(), GOLDEN[7]),
        ("fault", Event::Fault(fault).message(14).encode(), GOLDEN[8]),
        ("identity", identity().encode(), GOLDEN[9]),
    ];
    let text = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    let wrong = golden.iter().filter(|(_, found, expected)| *found != hex(expected));
    let wrong: Vec<String> = wrong.map(|(name, found, _)| format!("{name} {}", text(found))).collect();
    assert!(wrong.is_empty(), "changed:\n{}", wrong.join("\n"));
}

const GOLDEN: [&str; 10] = [
    "677633 01 23 00 0700 0200 a9bf 0200 a259b3af",
    "677633 01 a3 00 0700 0000 f3c9 9deed941",
    "677633 01 11 00 feff 0700 8a80 030001000080ff c5af2440",
    "677633 01 12 00 0100 0600 79f1 000001000201 b514a95e",
    "677633 01 13 00 0200 1000 e538 64c5540000000000404b4c0000000000 657bf9b9",
    "677633 01 81 00 0300 2800 3354 0300000006000700060504030201000064c554000000000003000000000000002 \
     4faffff00000080 520bcdaa",
    "677633 01 a0 04 0400 0e00 fd9f 41524d207768696c652049646c65 9829ce39",
    "677633 01 40 00 0d00 2800 11ee 0d000000000000000200000000000000010005000000000014064e04000000004 \
     04b4c0000000000 22f95dd2",
    "677633 01 41 00 0e00 1000 a12e 01000000000000000900000000000000 f91dd71f",
    "01000201900374040001000400000000404b4c000000000000e40b5402000000537472656966656e6c69636874203320 \
     66c3bc72204bc3b67066650000000000412d303030310000000000000000000000000000000000000000000000000000",
];

/// Examples in GV3.md are the golden ones.
#[test]
fn the_page_shows_the_golden_messages() {
    let page = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("GV3.md")).unwrap();
    let shown: String = page.chars().filter(|c| !c.is_whitespace()).collect();
    for golden in &GOLDEN[..2] {
        assert!(shown.contains(&golden.replace(' ', "")), "{golden}");
    }
}

#[test]
fn every_request_and_its_reply_come_back() {
    let timing = Timing { period_nanos: u64::MAX, exposure_nanos: 1 };
    let requests = [
        Request::Status,
        Request::Clear,
        Request::Pattern { index: 9, axis: Axis::Columns, levels: vec![7; MAX_LEVELS] },
        Request::Order(vec![1; MAX_ORDER]),
        Request::Timing(timing),
        Request::Arm,
        Request::Start,
        Request::Stop,
        Request::Show(65_535),
        Request::ClearFault,
    ];
    for (k, request) in (0..).zip(&requests) {
        let message = one(&request.message(k).encode());
        assert_eq!(message.sequence, k);
        assert_eq!(Request::decode(&message).as_ref(), Ok(request));
        let reply = match request {
            Request::Status => Reply::Status(status()),
            Request::Timing(timing) => Reply::Timing(*timing),
            _ => Reply::Done,
        };
        let answer = one(&Request::reply(&message, Ok(reply)).encode());
        assert_eq!((answer.sequence, request.decode_reply(&answer)), (k, Ok(reply)));
        let other = &requests[(usize::from(k) + 1) % requests.len()];
        assert!(matches!(other.decode_reply(&answer), Err(BodyError::Kind(_))));
        let refused = Request::reply(&message, Err(Request::Status.decode_reply(&message).unwrap_err()));
        let error = request.decode_reply(&one(&refused.encode())).unwrap_err();
        assert!(
            matches!(&error, BodyError::Refused { refusal: Refusal::Kind, text } if text.contains("0x")),
            "{error}"
        );
    }
}

#[test]
fn events_come_back_in_one_packet() {
    let fault = FaultEvent { fault: DeviceFault::Other(0x8001), device_time_nanos: u64::MAX };
    for event in [Event::Exposure(EXPOSURE), Event::Fault(fault)] {
        let bytes = event.message(65_535).encode();
        assert!(bytes.len() <= MAX_EVENT_BYTES);
        assert_eq!(Event::decode(&one(&bytes)), Ok(event));
    }
}

#[test]
fn an_identity_comes_back_and_says_what_is_wrong_with_it() {
    let bytes = identity().encode();
    assert_eq!((bytes.len(), Identity::decode(&bytes)), (Identity::BYTES, Ok(identity())));
    // A text that is too long is cut between characters.
    let long = Identity { model: "ä".repeat(17), ..identity() };
    assert_eq!(Identity::decode(&long.encode()).unwrap().model, "ä".repeat(16));
    let error = |change: fn(&mut Vec<u8>)| {
        let mut bytes = identity().encode();
        change(&mut bytes);
        Identity::decode(&bytes).unwrap_err()
    };
    assert!(matches!(error(|b| b[0] = 2), BodyError::Version(2)));
    assert!(matches!(error(|b| b.truncate(95)), BodyError::Length { found: 95, .. }));
    assert!(matches!(error(|b| b.push(0)), BodyError::Length { found: 97, .. }));
    assert!(matches!(error(Vec::clear), BodyError::Length { found: 0, .. }));
    assert!(matches!(error(|b| b[4..6].fill(0)), BodyError::Field { offset: 4, field: "width_px", .. }));
}

#[test]
fn bodies_out_of_range_are_refused_by_name() {
    let refusal = |kind: u8, payload: &[u8]| {
        let message = Message::new(kind, 0, 1, payload.to_vec());
        let error = Request::decode(&message).unwrap_err();
        (Refusal::from(&error), error.to_string())
    };
    assert_eq!(refusal(0x3f, &[]).0, Refusal::Kind);
    assert_eq!(refusal(0x81, &[]).0, Refusal::Kind);
    for (kind, payload) in
        [(0x01, &[0][..]), (0x11, &[0; 4]), (0x12, &[]), (0x12, &[0; 3]), (0x13, &[0; 15]), (0x23, &[0])]
    {
        assert_eq!(refusal(kind, payload).0, Refusal::Length, "{kind:#x} {payload:?}");
    }
    assert_eq!(refusal(0x12, &[0; 2 * MAX_ORDER + 2]).0, Refusal::Length);
    let (code, text) = refusal(0x11, &[0, 0, 2, 0, 9]);
    assert!(code == Refusal::Field && text.contains("axis") && text.contains("byte 2"), "{text}");
    let newer = Message { version: 2, ..Request::Arm.message(1) };
    assert_eq!(Request::decode(&one(&newer.encode())), Err(BodyError::Version(2)));
    assert_eq!(Event::decode(&Request::Arm.message(1)), Err(BodyError::Kind(0x20)));
    let no_fault = Message::new(0x41, 0, 0, vec![0; 16]);
    assert!(matches!(Event::decode(&no_fault), Err(BodyError::Field { field: "fault", .. })));
    let mut odd = Request::reply(&Request::Status.message(1), Ok(Reply::Status(status())));
    odd.payload[0] = 6;
    assert!(matches!(Request::Status.decode_reply(&odd), Err(BodyError::Field { field: "state", .. })));
}

/// Messages of all lengths that matter, one after the other.
fn stream() -> (Vec<Message>, Vec<u8>) {
    let messages = vec![
        Request::Stop.message(1),
        Request::Pattern { index: 0, axis: Axis::Columns, levels: b"gv3gv3\x01".repeat(40) }.message(2),
        Event::Exposure(EXPOSURE).message(3),
        Request::Show(1).message(4),
    ];
    let bytes = messages.iter().flat_map(Message::encode).collect();
    (messages, bytes)
}

#[test]
fn a_changed_byte_costs_its_own_message_only() {
    let (messages, bytes) = stream();
    let mut begin = 0;
    for (k, message) in messages.iter().enumerate() {
        let end = begin + FRAMING_BYTES + message.payload.len();
        for at in begin..end {
            for flip in [0x01, 0x80, 0xff] {
                let mut damaged = bytes.clone();
                damaged[at] ^= flip;
                let mut others = messages.clone();
                others.remove(k);
                assert_eq!(decode_all(&damaged), (others, (end - begin) as u64), "byte {at}");
            }
        }
        begin = end;
    }
}

#[test]
fn a_cut_off_message_costs_itself_only() {
    let (messages, bytes) = stream();
    let whole = messages[1].encode();
    for length in 0..whole.len() {
        let cut = [&whole[..length], &bytes].concat();
        let (mut decoder, mut found) = (Decoder::default(), Vec::new());
        decoder.push(&cut);
        // What follows must be as long as the cut message claims before the cut shows.
        decoder.push(&vec![0; whole.len()]);
        while let Some(message) = decoder.next_message() {
            found.push(message);
        }
        assert_eq!(found, messages, "{length}");
        decoder.push(&Request::Arm.message(9).encode());
        assert_eq!(decoder.next_message(), Some(Request::Arm.message(9)));
    }
}

#[test]
fn a_length_beyond_the_limit_is_not_waited_for() {
    let mut bytes = Message::new(0x11, 0, 1, vec![0; 16]).encode();
    bytes[8..10].copy_from_slice(&16_389u16.to_le_bytes());
    let check = crc32fast::hash(&bytes[..10]) as u16;
    bytes[10..12].copy_from_slice(&check.to_le_bytes());
    bytes.extend(Request::Stop.message(2).encode());
    assert_eq!(decode_all(&bytes).0, [Request::Stop.message(2)]);
}

fn any_message() -> impl Strategy<Value = Message> {
    let payload = prop::collection::vec(any::<u8>(), 0..200);
    (any::<u8>(), any::<u8>(), any::<u8>(), any::<u16>(), payload)
        .prop_map(|(version, kind, status, sequence, payload)| Message { version, kind, status, sequence, payload })
}

proptest! {
    #[test]
    fn messages_between_noise_come_back_in_any_pieces(
        messages in prop::collection::vec((any_message(), prop::collection::vec(any::<u8>(), 0..30)), 1..6),
        piece_bytes in 1usize..100,
    ) {
        let mut bytes = Vec::new();
        for (message, noise) in &messages {
            bytes.extend(message.encode());
            // Noise without a marker's first byte is no beginning of anything.
            bytes.extend(noise.iter().map(|b| if *b == b'g' { 0 } else { *b }));
        }
        let (mut decoder, mut found) = (Decoder::default(), Vec::new());
        for piece in bytes.chunks(piece_bytes) {
            decoder.push(piece);
            while let Some(message) = decoder.next_message() {
                found.push(message);
            }
        }
        let sent: Vec<Message> = messages.iter().map(|(message, _)| message.clone()).collect();
        prop_assert_eq!(found, sent);
    }

    #[test]
    fn any_bytes_are_read_the_same_in_any_pieces(bytes in prop::collection::vec(prop_oneof![any::<u8>(), Just(b'g'), Just(b'v'), Just(b'3')], 0..400)) {
        gv3_exercise::messages(&bytes);
    }

    #[test]
    fn any_payload_is_a_body_or_an_error(message in any_message()) {
        gv3_exercise::messages(&Message { version: 1, ..message }.encode());
    }
}

/// The corpus of the fuzz target, replayed by every test run.
#[test]
fn the_fuzz_corpus_never_panics() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/gv3_messages");
    let files: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert!(files.len() >= 5, "the corpus is missing");
    files.iter().for_each(|path| gv3_exercise::messages(&fs::read(path).unwrap()));
}
