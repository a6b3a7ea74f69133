//! The trigger's protocol: its golden lines, what every line must keep, and the model as a host sees it.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

#[path = "../fuzz/fuzz_targets/trigger_exercise.rs"]
mod exercise;

use gv3_protocol::trigger::line::{MAX_LINE_BYTES, seal};
use gv3_protocol::trigger::{
    Answer, ArmSettings, Command, Event, FIRE_DELAY_NANOS, Identity, LineReader, Message, Refusal, Request, State,
    Status, TriggerError, TriggerModel,
};
use proptest::prelude::*;
use std::path::Path;

const ARM: ArmSettings = ArmSettings { period_nanos: 5_555_556, width_nanos: 100_000, report_every: 1 };

fn bodies(bytes: &[u8]) -> Vec<Result<String, TriggerError>> {
    let (mut reader, mut lines) = (LineReader::default(), Vec::new());
    reader.feed(bytes, |line| lines.push(line.map(str::to_owned)));
    lines
}

fn messages(bytes: &[u8]) -> Vec<Message> {
    bodies(bytes).into_iter().map(|line| Message::decode(&line.unwrap()).unwrap()).collect()
}

/// The lines of TRIGGER.md's examples, byte by byte.
#[test]
fn golden_lines() {
    let requests = [
        (1, Command::Hello, "1 hello*E648\n"),
        (2, Command::Time, "2 time*6E63\n"),
        (3, Command::Arm(ARM), "3 arm 5555556 100000 1*B4ED\n"),
        (4, Command::Fire { count: 12 }, "4 fire 12*14D3\n"),
        (5, Command::Status, "5 status*DCA0\n"),
        (65535, Command::Disarm, "65535 disarm*389C\n"),
    ];
    for (id, command, line) in requests {
        let request = Request { id, command };
        assert_eq!(request.encode(), line);
        assert_eq!(Request::decode(bodies(line.as_bytes())[0].as_ref().unwrap()), Ok(request));
    }
    let identity = Identity { version: 1, model: "nano-v3".into(), serial: "A7.01".into(), min_period_nanos: 250_000 };
    let status = Status { state: State::Firing, fired: 7, lost_events: 0, time_nanos: 1_050_000_000 };
    let set = ArmSettings { period_nanos: 5_555_500, ..ARM };
    let reply = |id, answer| Message::Reply { id, answer };
    let messages = [
        (Message::Event(Event::Boot { version: 1 }), "! boot 1*626E\n"),
        (reply(1, Answer::Hello(identity)), "1 ok hello gv3-trigger 1 nano-v3 A7.01 250000*F388\n"),
        (reply(2, Answer::Time(1_000_000_000)), "2 ok time 1000000000*4462\n"),
        (reply(3, Answer::Arm(set)), "3 ok arm 5555500 100000 1*91BF\n"),
        (reply(3, Answer::Refused(Refusal::Range("period"))), "3 no range period*127C\n"),
        (reply(4, Answer::Fire(1_011_000_000)), "4 ok fire 1011000000*D2CF\n"),
        (reply(4, Answer::Refused(Refusal::State)), "4 no state*762C\n"),
        (reply(5, Answer::Status(status)), "5 ok status firing 7 0 1050000000*973C\n"),
        (reply(65535, Answer::Disarm(12)), "65535 ok disarm 12*7A16\n"),
        (Message::Event(Event::Pulse { counter: 0, time_nanos: 1_011_000_000 }), "! pulse 0 1011000000*009D\n"),
        (Message::Event(Event::Done { fired: 12, time_nanos: 1_077_666_000 }), "! done 12 1077666000*DCCD\n"),
        (Message::Event(Event::Overrun { counter: 8 }), "! overrun 8*5D04\n"),
        (Message::Event(Event::Reject), "! reject*B6AC\n"),
    ];
    for (message, line) in messages {
        assert_eq!(message.encode(), line);
        assert_eq!(Message::decode(bodies(line.as_bytes())[0].as_ref().unwrap()), Ok(message));
    }
}

#[test]
fn what_is_wrong_is_named() {
    let request = |body: &str| Request::decode(body).unwrap_err().to_string();
    assert_eq!(request("1"), "field verb is missing");
    assert_eq!(request("0 hello"), "field id is \"0\": numbers begin with 1");
    assert!(request("70000 hello").starts_with("field id is \"70000\""));
    assert!(request("1 launch").starts_with("field verb is \"launch\""));
    assert_eq!(request("1 arm 1000000 20000"), "field report is missing");
    assert!(request("1 arm 01000000 20000 1").starts_with("field period is"));
    assert!(request("1 fire -1").starts_with("field count is \"-1\""));
    assert_eq!(request("1 time "), "\"\" follows the last field");
    let message = |body: &str| Message::decode(body).unwrap_err().to_string();
    assert!(message("1 ok hello marlin 1 a b 1").contains("this is another device"));
    assert!(message("! pulse 4294967296 0").starts_with("field counter is"));
    assert!(message("1 yes").starts_with("field result is \"yes\""));
}

/// A host that knows one model.
struct Host {
    model: TriggerModel,
    id: u16,
}

impl Host {
    fn new() -> Self {
        let mut host = Self { model: TriggerModel::new("test-1"), id: 0 };
        assert_eq!(messages(&host.model.take_output(usize::MAX)), [Message::Event(Event::Boot { version: 1 })]);
        host
    }

    fn ask(&mut self, command: Command) -> Answer {
        self.id += 1;
        self.model.receive(Request { id: self.id, command }.encode().as_bytes());
        match &messages(&self.model.take_output(usize::MAX))[..] {
            [Message::Reply { id, answer }] if *id == self.id => answer.clone(),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn the_model_fires_what_it_was_asked_for() {
    let mut host = Host::new();
    assert!(matches!(host.ask(Command::Hello), Answer::Hello(i) if i.serial == "test-1" && i.version == 1));
    assert_eq!(host.ask(Command::Fire { count: 3 }), Answer::Refused(Refusal::State));
    assert_eq!(host.model.advance(1_000_000_000), None);
    assert_eq!(host.ask(Command::Time), Answer::Time(1_000_000_000));
    let Answer::Arm(set) = host.ask(Command::Arm(ARM)) else { panic!("not armed") };
    assert_eq!(set, ArmSettings { period_nanos: 5_555_500, ..ARM });
    let first = 1_000_000_000 + FIRE_DELAY_NANOS;
    assert_eq!(host.ask(Command::Fire { count: 3 }), Answer::Fire(first));
    assert_eq!(host.ask(Command::Arm(ARM)), Answer::Refused(Refusal::State));
    let pulses: Vec<_> = std::iter::from_fn(|| host.model.advance(2_000_000_000)).collect();
    let times: Vec<u64> = pulses.iter().map(|p| p.time_nanos).collect();
    assert_eq!(times, [first, first + set.period_nanos, first + 2 * set.period_nanos]);
    let told = messages(&host.model.take_output(usize::MAX));
    let pulse =
        |(counter, time_nanos): (usize, &u64)| Event::Pulse { counter: counter as u32, time_nanos: *time_nanos };
    let done = Event::Done { fired: 3, time_nanos: first + 3 * set.period_nanos };
    let expected: Vec<_> = times.iter().enumerate().map(pulse).chain([done]).map(Message::Event).collect();
    assert_eq!(told, expected);
    let status = Status { state: State::Armed, fired: 3, lost_events: 0, time_nanos: 2_000_000_000 };
    assert_eq!(host.ask(Command::Status), Answer::Status(status));
    // Counters begin anew with every arm.
    assert_eq!(host.ask(Command::Fire { count: 1 }), Answer::Refused(Refusal::State));
    assert!(matches!(host.ask(Command::Arm(ARM)), Answer::Arm(_)));
    assert!(matches!(host.ask(Command::Fire { count: 0 }), Answer::Fire(_)));
    let pulses = std::iter::from_fn(|| host.model.advance(3_000_000_000)).count();
    assert_eq!(host.model.take_output(usize::MAX).is_empty(), pulses == 0);
    assert_eq!(host.ask(Command::Disarm), Answer::Disarm(pulses as u32));
    assert_eq!(host.model.advance(9_000_000_000), None);
}

#[test]
fn a_repeated_request_is_answered_and_not_done_again() {
    let mut host = Host::new();
    host.ask(Command::Arm(ARM));
    let fire = Request { id: 9, command: Command::Fire { count: 0 } }.encode();
    host.model.receive(fire.as_bytes());
    let first = host.model.take_output(usize::MAX);
    while host.model.advance(50_000_000).is_some() {}
    host.model.take_output(usize::MAX);
    host.model.receive(fire.as_bytes());
    assert_eq!(host.model.take_output(usize::MAX), first);
    assert!(matches!(host.ask(Command::Status), Answer::Status(Status { state: State::Firing, .. })));
}

#[test]
fn what_a_controller_does_not_know_is_refused_and_what_is_damaged_rejected() {
    let mut host = Host::new();
    let said = |host: &mut Host, line: &str| {
        host.model.receive(line.as_bytes());
        messages(&host.model.take_output(usize::MAX))
    };
    let refused = Message::Reply { id: 8, answer: Answer::Refused(Refusal::Syntax) };
    assert_eq!(said(&mut host, &seal("8 strobe 100")), [refused]);
    for line in ["8 status*0000\n", "status\n", &seal("status"), &"x".repeat(500), "\n"] {
        let expected = if line.ends_with('x') { vec![] } else { vec![Message::Event(Event::Reject)] };
        assert_eq!(said(&mut host, line), expected, "{line}");
    }
}

#[test]
fn a_host_that_does_not_read_loses_events_and_is_told_how_many() {
    let mut host = Host::new();
    host.ask(Command::Arm(ArmSettings { period_nanos: 100_000, width_nanos: 10_000, report_every: 1 }));
    host.ask(Command::Fire { count: 0 });
    let fired = std::iter::from_fn(|| host.model.advance(1_000_000_000)).count() as u32;
    host.model.receive(Request { id: 77, command: Command::Status }.encode().as_bytes());
    let told = messages(&host.model.take_output(usize::MAX));
    let Some(Message::Reply { id: 77, answer: Answer::Status(status) }) = told.last() else { panic!("{told:?}") };
    assert_eq!((status.fired, status.lost_events), (fired, fired - (told.len() as u32 - 1)));
    assert!(status.lost_events > 0 && told.len() > 10);
    // Counters tell which.
    assert!(
        matches!(told[told.len() - 2], Message::Event(Event::Pulse { counter, .. }) if counter == told.len() as u32 - 2)
    );
}

#[test]
fn the_fuzz_corpus_keeps_what_it_must() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/trigger");
    let files: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert!(files.len() >= 8, "{} files", files.len());
    files.iter().for_each(|path| exercise::trigger(&std::fs::read(path).unwrap()));
}

fn command() -> impl Strategy<Value = Command> {
    prop_oneof![
        Just(Command::Hello),
        Just(Command::Time),
        Just(Command::Disarm),
        Just(Command::Status),
        any::<u32>().prop_map(|count| Command::Fire { count }),
        (any::<u64>(), any::<u64>(), any::<u32>()).prop_map(|(period_nanos, width_nanos, report_every)| {
            Command::Arm(ArmSettings { period_nanos, width_nanos, report_every })
        }),
    ]
}

fn message() -> impl Strategy<Value = Message> {
    let state = prop_oneof![Just(State::Idle), Just(State::Armed), Just(State::Firing)];
    let refusal = prop_oneof![
        Just(Refusal::State),
        Just(Refusal::Syntax),
        prop_oneof![Just("period"), Just("width"), Just("report")].prop_map(Refusal::Range),
    ];
    let answer = prop_oneof![
        ("[A-Za-z0-9._-]{1,24}", "[A-Za-z0-9._-]{1,24}", any::<u16>(), any::<u64>()).prop_map(
            |(model, serial, version, min_period_nanos)| {
                Answer::Hello(Identity { version, model, serial, min_period_nanos })
            }
        ),
        any::<u64>().prop_map(Answer::Time),
        any::<u64>().prop_map(Answer::Fire),
        any::<u32>().prop_map(Answer::Disarm),
        (any::<u64>(), any::<u64>(), any::<u32>()).prop_map(|(period_nanos, width_nanos, report_every)| {
            Answer::Arm(ArmSettings { period_nanos, width_nanos, report_every })
        }),
        (state, any::<u32>(), any::<u32>(), any::<u64>()).prop_map(|(state, fired, lost_events, time_nanos)| {
            Answer::Status(Status { state, fired, lost_events, time_nanos })
        }),
        refusal.prop_map(Answer::Refused),
    ];
    let event = prop_oneof![
        (any::<u32>(), any::<u64>()).prop_map(|(counter, time_nanos)| Event::Pulse { counter, time_nanos }),
        (any::<u32>(), any::<u64>()).prop_map(|(fired, time_nanos)| Event::Done { fired, time_nanos }),
        any::<u16>().prop_map(|version| Event::Boot { version }),
        any::<u32>().prop_map(|counter| Event::Overrun { counter }),
        Just(Event::Reject),
    ];
    prop_oneof![
        (1..=u16::MAX, answer).prop_map(|(id, answer)| Message::Reply { id, answer }),
        event.prop_map(Message::Event),
    ]
}

proptest! {
    #[test]
    fn lines_come_back_in_pieces_of_any_length(
        said in prop::collection::vec(message(), 1..8), cuts in prop::collection::vec(1usize..40, 1..40),
    ) {
        let bytes: Vec<u8> = said.iter().flat_map(|m| m.encode().into_bytes()).collect();
        let (mut reader, mut heard, mut rest) = (LineReader::default(), Vec::new(), &bytes[..]);
        for cut in cuts.iter().cycle() {
            let (piece, after) = rest.split_at((*cut).min(rest.len()));
            reader.feed(piece, |line| heard.push(Message::decode(line.unwrap()).unwrap()));
            rest = after;
            if rest.is_empty() { break }
        }
        prop_assert_eq!(heard, said);
    }

    #[test]
    fn every_line_is_within_the_limit(id in 1..=u16::MAX, command in command(), message in message()) {
        let request = Request { id, command };
        let line = request.encode();
        prop_assert!(line.len() <= MAX_LINE_BYTES + 1 && message.encode().len() <= MAX_LINE_BYTES + 1);
        prop_assert_eq!(Request::decode(bodies(line.as_bytes())[0].as_ref().unwrap()), Ok(request));
    }

    #[test]
    fn one_damaged_byte_never_passes(message in message(), at in any::<prop::sample::Index>(), flip in 1u8..=255) {
        let line = message.encode();
        let mut bytes = line.clone().into_bytes();
        let at = at.index(bytes.len() - 1);
        bytes[at] ^= flip;
        for line in bodies(&bytes) {
            prop_assert!(line.is_err(), "{:?}", line);
        }
    }

    #[test]
    fn pulses_keep_their_period(
        period_nanos in 100_000u64..1_000_000_000, count in 1u32..200, report_every in 1u32..10, hops in 1u64..50,
    ) {
        let mut host = Host::new();
        let wanted = ArmSettings { period_nanos, width_nanos: 10_000, report_every };
        let Answer::Arm(set) = host.ask(Command::Arm(wanted)) else { panic!("refused") };
        prop_assert!(set.period_nanos.abs_diff(period_nanos) <= 250);
        let Answer::Fire(start) = host.ask(Command::Fire { count }) else { panic!("refused") };
        let end = start + u64::from(count) * set.period_nanos;
        let (mut pulses, mut said) = (Vec::new(), Vec::new());
        for hop in 0..=hops {
            pulses.extend(std::iter::from_fn(|| {
                let pulse = host.model.advance(end / hops * hop + end % hops);
                said.extend(messages(&host.model.take_output(usize::MAX)));
                pulse
            }));
        }
        let due = |k: u32| start + u64::from(k) * set.period_nanos;
        prop_assert!(pulses.iter().map(|p| (p.counter, p.time_nanos)).eq((0..count).map(|k| (k, due(k)))));
        let told = (0..count).step_by(report_every as usize);
        let told = told.map(|counter| Event::Pulse { counter, time_nanos: due(counter) });
        let told = told.chain([Event::Done { fired: count, time_nanos: end }]).map(Message::Event);
        prop_assert!(said.into_iter().eq(told));
    }

    #[test]
    fn any_bytes_leave_a_model_that_answers(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        exercise::trigger(&bytes);
    }

    #[test]
    fn lines_of_any_words_leave_a_model_that_answers(
        words in prop::collection::vec(
            "(1|2|3|0|hello|arm|fire|disarm|status|time|100000|1000|18446744073709551615|-1| )", 0..40),
    ) {
        let lines: String = words.chunks(5).map(|body| seal(&body.join(" "))).collect();
        exercise::trigger(lines.as_bytes());
    }
}
