// What the fuzz target does with its bytes; `tests/gv3_messages.rs` runs the same on the corpus.

use gv3_protocol::gv3::{Decoder, Event, FRAMING_BYTES, Identity, Message, Request};

/// Every byte is in a message, passed over, or still waiting; pieces do not matter; what is understood is written as it was read.
pub fn messages(bytes: &[u8]) {
    let whole = decode(bytes, bytes.len().max(1));
    assert_eq!(whole, decode(bytes, 7));
    for message in &whole.0 {
        if let Ok(request) = Request::decode(message) {
            assert_eq!(Request::decode(&request.message(message.sequence)).as_ref(), Ok(&request));
            drop(request.decode_reply(message));
        }
        if let Ok(event) = Event::decode(message) {
            assert_eq!(Event::decode(&event.message(message.sequence)), Ok(event));
        }
        for request in [Request::Status, Request::Arm] {
            drop(request.decode_reply(message));
        }
    }
    if let Ok(identity) = Identity::decode(bytes) {
        assert_eq!(identity.encode().len(), Identity::BYTES);
    }
}

fn decode(bytes: &[u8], piece_bytes: usize) -> (Vec<Message>, u64) {
    let (mut decoder, mut messages) = (Decoder::default(), Vec::new());
    for piece in bytes.chunks(piece_bytes) {
        decoder.push(piece);
        while let Some(message) = decoder.next_message() {
            messages.push(message);
        }
    }
    let in_messages: usize = messages.iter().map(|m| FRAMING_BYTES + m.payload.len()).sum();
    assert!(in_messages as u64 + decoder.damaged_bytes() <= bytes.len() as u64);
    decoder.discard();
    assert_eq!(in_messages as u64 + decoder.damaged_bytes(), bytes.len() as u64);
    (messages, decoder.damaged_bytes())
}
