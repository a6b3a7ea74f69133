//! The projector's side of GV3.md.

use super::gv3_device::*;
use gv3_protocol::gv3::{
    Axis, BodyError, CONTROL_IDENTIFY, CONTROL_RESET, Decoder, DeviceFault, DeviceState, Event, Identity, Refusal,
    Reply, Request, Timing,
};
use proptest::prelude::*;

const TIMING: Timing = Timing { period_nanos: 5_555_556, exposure_nanos: 5_000_000 };

fn device() -> Gv3Device {
    Gv3Device::simulated([8, 4], "T1")
}

fn ask(device: &mut Gv3Device, sequence: u16, request: &Request) -> Result<Reply, BodyError> {
    device.write_out(&request.message(sequence).encode());
    let mut decoder = Decoder::default();
    decoder.push(&device.read_in(512).unwrap());
    assert_eq!(device.read_in(512), None);
    let reply = decoder.next_message().unwrap();
    assert_eq!(reply.sequence, sequence);
    request.decode_reply(&reply)
}

fn state(device: &mut Gv3Device) -> DeviceState {
    match ask(device, 9999, &Request::Status) {
        Ok(Reply::Status(status)) => status.state,
        other => panic!("{other:?}"),
    }
}

fn loaded() -> Gv3Device {
    let mut device = device();
    let levels = |k: u8| (0..8).map(|u| u * k).collect();
    for k in 0..3 {
        let pattern = Request::Pattern { index: k, axis: Axis::Columns, levels: levels(k as u8) };
        ask(&mut device, 100 + k, &pattern).unwrap();
    }
    ask(&mut device, 110, &Request::Order(vec![2, 0])).unwrap();
    ask(&mut device, 111, &Request::Timing(TIMING)).unwrap();
    device
}

/// A device in a state.
fn in_state(wanted: DeviceState) -> Gv3Device {
    let mut device = if wanted == DeviceState::Idle { device() } else { loaded() };
    let requests: &[Request] = match wanted {
        DeviceState::Armed => &[Request::Arm],
        DeviceState::Running => &[Request::Arm, Request::Start],
        DeviceState::Showing => &[Request::Show(1)],
        _ => &[],
    };
    for (sequence, request) in (200..).zip(requests) {
        ask(&mut device, sequence, request).unwrap();
    }
    if wanted == DeviceState::Fault {
        device.fail(DeviceFault::Light);
    }
    assert_eq!(state(&mut device), wanted);
    device
}

/// The table of states of GV3.md, read from the page itself.
#[test]
fn the_table_of_states_is_kept() {
    use DeviceState::{Armed, Fault, Idle, Ready, Running, Showing};
    let page = include_str!("../../../../protocol/GV3.md");
    let table = page.split("| request | IDLE |").nth(1).unwrap();
    let pattern = Request::Pattern { index: 0, axis: Axis::Rows, levels: vec![1; 4] };
    let requests = [
        Request::Status,
        Request::Clear,
        pattern,
        Request::Order(vec![0]),
        Request::Timing(TIMING),
        Request::Arm,
        Request::Start,
        Request::Stop,
        Request::Show(0),
        Request::ClearFault,
    ];
    for (row, request) in table.lines().skip(2).zip(&requests) {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        assert_eq!(cells[1], request.name());
        for (cell, before) in cells[2..8].iter().zip([Idle, Ready, Armed, Running, Showing, Fault]) {
            let mut device = in_state(before);
            if before == Idle && matches!(request, Request::Order(_)) {
                let pattern = Request::Pattern { index: 0, axis: Axis::Rows, levels: vec![1; 4] };
                ask(&mut device, 1, &pattern).unwrap();
            }
            let found = ask(&mut device, 2, request);
            let refusal = found.as_ref().err().map(|error| Refusal::from(error) as u8);
            let expected = match (*cell, before) {
                ("=", _) => (None, before),
                ("IDLE", _) => (None, Idle),
                ("READY" | "READY or IDLE", _) => (None, Ready),
                ("ARMED, or 4 without a timing", _) => (None, Armed),
                ("RUNNING", _) => (None, Running),
                ("SHOWING", _) => (None, Showing),
                (code, _) => (Some(code.parse().unwrap()), before),
            };
            assert_eq!((refusal, state(&mut device)), expected, "{} while {before:?}: {found:?}", request.name());
        }
    }
}

#[test]
fn a_repeated_request_is_answered_again_and_done_once() {
    let mut device = loaded();
    ask(&mut device, 1, &Request::Arm).unwrap();
    ask(&mut device, 2, &Request::Start).unwrap();
    assert_eq!(ask(&mut device, 2, &Request::Start), Ok(Reply::Done));
    let again = ask(&mut device, 3, &Request::Start).unwrap_err();
    assert!(matches!(again, BodyError::Refused { refusal: Refusal::State, .. }));
    // The same number with another request is another request.
    assert_eq!(ask(&mut device, 3, &Request::Stop), Ok(Reply::Done));
    assert_eq!(device.light(), Light::Dark);
}

#[test]
fn requests_in_pieces_and_between_noise_are_understood() {
    let mut device = loaded();
    let bytes = [b"\0gv3\x01".to_vec(), Request::Show(1).message(1).encode()].concat();
    for byte in &bytes {
        assert_eq!(device.read_in(512), None);
        device.write_out(std::slice::from_ref(byte));
    }
    assert!(device.read_in(512).is_some());
    assert_eq!(device.light(), Light::Still(1));
    let mut damaged = Request::Show(0).message(2).encode();
    damaged[13] ^= 1;
    device.write_out(&damaged);
    assert_eq!((device.read_in(512), device.light()), (None, Light::Still(1)));
}

#[test]
fn a_reply_that_fills_its_packets_is_followed_by_an_empty_one() {
    let mut device = device().with_bulk_packet_bytes(16);
    let reply = |device: &mut Gv3Device, sequence, max: &[usize]| -> Vec<Option<usize>> {
        device.write_out(&Request::Clear.message(sequence).encode());
        max.iter().map(|max| device.read_in(*max).map(|part| part.len())).collect()
    };
    // A reply of 16 bytes: the empty packet ends a transfer with room for more, or makes one of its own.
    assert_eq!(reply(&mut device, 1, &[512, 512]), [Some(16), None]);
    assert_eq!(reply(&mut device, 2, &[16, 16, 16]), [Some(16), Some(0), None]);
    let mut device = device.with_bulk_packet_bytes(64);
    assert_eq!(reply(&mut device, 3, &[64, 64]), [Some(16), None]);
}

#[test]
fn events_tell_pattern_set_and_time_and_count_what_is_lost() {
    let mut device = loaded();
    device.advance_to(1_000_000);
    ask(&mut device, 1, &Request::Arm).unwrap();
    ask(&mut device, 2, &Request::Start).unwrap();
    let start_nanos = 1_000_000 + TIMING.period_nanos;
    assert_eq!(device.light(), Light::Playing { timing: TIMING, start_nanos });
    assert_eq!(device.poll_events(start_nanos - 1), None);
    let next = |device: &mut Gv3Device, now_nanos: u64| {
        let mut decoder = Decoder::default();
        decoder.push(&device.poll_events(now_nanos)?);
        let message = decoder.next_message().unwrap();
        match Event::decode(&message).unwrap() {
            Event::Exposure(exposure) => Some((message.sequence, exposure)),
            Event::Fault(_) => None,
        }
    };
    for k in 0..5 {
        let now_nanos = start_nanos + k * TIMING.period_nanos;
        let (sequence, told) = next(&mut device, now_nanos).unwrap();
        assert_eq!((u64::from(sequence), told.trigger, told.set, u64::from(told.position)), (k, k, k / 2, k % 2));
        assert_eq!((told.pattern, told.device_time_nanos), ([2, 0][usize::from(told.position)], now_nanos));
        assert_eq!(device.poll_events(now_nanos), None);
    }
    // 100 more, of which 64 find room.
    let later_nanos = start_nanos + 104 * TIMING.period_nanos;
    let waiting = (0..).map_while(|_| next(&mut device, later_nanos)).count();
    assert_eq!(waiting, 64);
    let Ok(Reply::Status(status)) = ask(&mut device, 3, &Request::Status) else { panic!() };
    assert_eq!((status.triggers, status.events_lost), (105, 36));
    let (sequence, told) = next(&mut device, later_nanos + TIMING.period_nanos).unwrap();
    assert_eq!((sequence, told.trigger), (105, 105));
    device.fail(DeviceFault::Timing);
    assert_eq!(device.light(), Light::Dark);
    assert!(device.poll_events(later_nanos + 9 * TIMING.period_nanos).is_some());
    assert_eq!(device.poll_events(later_nanos + 99 * TIMING.period_nanos), None);
}

#[test]
fn wrong_fields_are_refused_and_change_nothing() {
    let mut device = loaded();
    let number = device.patterns_number();
    let refusals = [
        (Request::Order(vec![0, 3]), Refusal::Field),
        (Request::Show(2), Refusal::Field),
        (Request::Timing(Timing { period_nanos: 1000, exposure_nanos: 10 }), Refusal::Field),
        (Request::Timing(Timing { exposure_nanos: TIMING.period_nanos + 1, ..TIMING }), Refusal::Field),
        (Request::Timing(Timing { period_nanos: u64::MAX, ..TIMING }), Refusal::Field),
    ];
    for (sequence, (request, expected)) in (1..).zip(refusals) {
        let error = ask(&mut device, sequence, &request).unwrap_err();
        assert_eq!(Refusal::from(&error), expected, "{error}");
    }
    assert_eq!((device.patterns_number(), state(&mut device)), (number, DeviceState::Ready));
    let mut empty = self::device();
    let long = Request::Pattern { index: 0, axis: Axis::Columns, levels: vec![0; 9] };
    assert_eq!(Refusal::from(&ask(&mut empty, 1, &long).unwrap_err()), Refusal::Length);
    let far = Request::Pattern { index: 256, axis: Axis::Columns, levels: vec![0; 8] };
    assert_eq!(Refusal::from(&ask(&mut empty, 2, &far).unwrap_err()), Refusal::Field);
}

#[test]
fn control_requests_identify_reset_and_stall() {
    let mut device = loaded();
    let control = |d: &mut Gv3Device, kind: u8, request: u8, value_high: u8, value_low: u8, index: u8| {
        d.handle_control([kind, request, value_low, value_high, index, 0, 255, 0], &[])
    };
    let identity = control(&mut device, 0xc1, CONTROL_IDENTIFY, 0, 0, 0).unwrap();
    assert_eq!(&Identity::decode(&identity).unwrap(), device.identity());
    device.write_out(&Request::Show(0).message(1).encode());
    device.write_out(&Request::Show(0).message(2).encode()[..9]);
    assert_eq!(control(&mut device, 0x41, CONTROL_RESET, 0, 0, 0), Ok(Vec::new()));
    assert_eq!((device.read_in(512), device.light(), state(&mut device)), (None, Light::Dark, DeviceState::Idle));
    for (kind, request) in [(0xc1, 0x7f), (0x41, 0x7f), (0x21, 9), (0x00, 7)] {
        assert_eq!(control(&mut device, kind, request, 0, 0, 0), Err(Stall));
    }
    assert_eq!(control(&mut device, 0x02, 3, 0, 0, Gv3Device::IN), Ok(Vec::new()));
    assert!(device.is_halted(Gv3Device::IN) && !device.is_halted(Gv3Device::OUT));
    assert_eq!(control(&mut device, 0x82, 0, 0, 0, Gv3Device::IN), Ok(vec![1, 0]));
    assert_eq!(control(&mut device, 0x02, 1, 0, 0, Gv3Device::IN), Ok(Vec::new()));
    assert!(!device.is_halted(Gv3Device::IN));
    let serial = control(&mut device, 0x80, 6, 3, 3, 0).unwrap();
    assert_eq!(serial, [6, 3, b'T', 0, b'1', 0]);
    assert_eq!(device.handle_control([0x80, 6, 0, 1, 0, 0, 8, 0], &[]).unwrap().len(), 8);
    assert_eq!(control(&mut device, 0x80, 6, 2, 1, 0), Err(Stall));
}

proptest! {
    #[test]
    fn any_bytes_leave_a_device_that_answers(
        pieces in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..60), 0..20),
        setup in any::<[u8; 8]>(),
        now_nanos in any::<u64>(),
    ) {
        let mut device = loaded();
        for piece in &pieces {
            device.write_out(piece);
            drop(device.read_in(64));
        }
        drop(device.handle_control(setup, &[]));
        drop(device.poll_events(now_nanos));
        while device.read_in(512).is_some() {}
        device.handle_control([0x41, CONTROL_RESET, 0, 0, 0, 0, 0, 0], &[]).unwrap();
        prop_assert_eq!(state(&mut device), DeviceState::Idle);
    }
}
