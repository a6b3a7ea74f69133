// What the fuzz target does with its bytes; `tests/trigger.rs` runs the same on the corpus.

use gv3_protocol::trigger::{Answer, Command, LineReader, Message, Request, TriggerModel};

/// What is decoded is encoded to the same line; a model that hears the bytes keeps its bounds and still answers.
pub fn trigger(bytes: &[u8]) {
    let mut reader = LineReader::default();
    reader.feed(bytes, |line| {
        let Ok(body) = line else { return };
        let line_of = |body: &str| gv3_protocol::trigger::line::seal(body);
        if let Ok(message) = Message::decode(body) {
            assert_eq!(message.encode(), line_of(body));
        }
        if let Ok(request) = Request::decode(body) {
            assert_eq!(request.encode(), line_of(body));
        }
    });
    let mut model = TriggerModel::new("fuzz");
    for piece in bytes.chunks(50) {
        model.receive(piece);
        for _ in 0..100 {
            if model.advance(model.now_nanos() + 1_000_000).is_none() {
                break;
            }
        }
    }
    assert!(model.take_output(usize::MAX).len() <= 8192);
    model.receive(b"\n");
    model.take_output(usize::MAX);
    // The same number twice is answered alike, so two numbers: one of them is new.
    for id in [40_001, 40_002] {
        model.receive(Request { id, command: Command::Disarm }.encode().as_bytes());
    }
    let (mut reader, mut answers) = (LineReader::default(), Vec::new());
    reader.feed(&model.take_output(usize::MAX), |line| answers.push(line.map(Message::decode)));
    let last = answers.pop().and_then(Result::ok).and_then(Result::ok);
    assert!(matches!(last, Some(Message::Reply { id: 40_002, answer: Answer::Disarm(_) })), "{last:?}");
    assert_eq!(model.next_pulse_nanos(), None);
}
