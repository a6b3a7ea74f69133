//! Messages: head, payload and checksums, found again after damage.

use super::{FRAMING_BYTES, MAX_PAYLOAD_BYTES, VERSION};
use crc32fast::hash as crc32;

const MARKER: [u8; 3] = *b"gv3";
const HEAD_BYTES: usize = 12;

/// A message whose checksums are right. The layout is the same in every version.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// Version of the protocol.
    pub version: u8,
    /// Kind of body.
    pub kind: u8,
    /// 0, or why a request is refused.
    pub status: u8,
    /// A request's number and that of its reply; an event's number.
    pub sequence: u16,
    /// The body, at most [`MAX_PAYLOAD_BYTES`].
    pub payload: Vec<u8>,
}

impl Message {
    /// A message of this build's version.
    ///
    /// # Panics
    /// When the payload is longer than [`MAX_PAYLOAD_BYTES`].
    pub fn new(kind: u8, status: u8, sequence: u16, payload: Vec<u8>) -> Self {
        assert!(payload.len() <= MAX_PAYLOAD_BYTES, "{} bytes of payload", payload.len());
        Self { version: VERSION, kind, status, sequence, payload }
    }

    /// Its bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(FRAMING_BYTES + self.payload.len());
        bytes.extend(MARKER);
        bytes.extend([self.version, self.kind, self.status]);
        bytes.extend(self.sequence.to_le_bytes());
        // Payloads are at most MAX_PAYLOAD_BYTES, which 16 bits hold.
        bytes.extend((self.payload.len() as u16).to_le_bytes());
        bytes.extend(head_check(&bytes));
        bytes.extend(&self.payload);
        bytes.extend(crc32(&bytes).to_le_bytes());
        bytes
    }

    /// The message at the beginning of `bytes` and its length; `None` when what is there cannot be one.
    fn parse(bytes: &[u8]) -> Parsed {
        let Some(head) = bytes.first_chunk::<HEAD_BYTES>() else {
            return if bytes.starts_with(&MARKER[..bytes.len().min(3)]) { Parsed::Partial } else { Parsed::Damage };
        };
        let payload_bytes = usize::from(u16::from_le_bytes([head[8], head[9]]));
        let is_head =
            head[..3] == MARKER && head_check(&head[..10]) == head[10..] && payload_bytes <= MAX_PAYLOAD_BYTES;
        if !is_head {
            return Parsed::Damage;
        }
        let end = HEAD_BYTES + payload_bytes;
        let Some(check) = bytes.get(end..end + 4) else { return Parsed::Partial };
        if crc32(&bytes[..end]).to_le_bytes() != check {
            return Parsed::Damage;
        }
        let sequence = u16::from_le_bytes([head[6], head[7]]);
        let payload = bytes[HEAD_BYTES..end].to_vec();
        Parsed::Whole(Self { version: head[3], kind: head[4], status: head[5], sequence, payload })
    }
}

/// The low half of the head's CRC, so that a broken length is not believed.
fn head_check(head: &[u8]) -> [u8; 2] {
    (crc32(head) as u16).to_le_bytes()
}

enum Parsed {
    Whole(Message),
    Partial,
    Damage,
}

/// Finds messages in bytes that come in pieces. After damage it goes on at the next place where head and payload have the
/// right checksums. Holds at most one message and the piece pushed last.
#[derive(Debug, Default)]
pub struct Decoder {
    bytes: Vec<u8>,
    /// Bytes at the front that are used up.
    used: usize,
    damaged_bytes: u64,
}

impl Decoder {
    /// Takes the next piece; [`Self::next_message`] is to be asked until it gives nothing.
    pub fn push(&mut self, piece: &[u8]) {
        self.bytes.drain(..self.used);
        self.used = 0;
        self.bytes.extend_from_slice(piece);
    }

    /// The next whole message, if its last byte has come.
    pub fn next_message(&mut self) -> Option<Message> {
        while self.used < self.bytes.len() {
            match Message::parse(&self.bytes[self.used..]) {
                Parsed::Whole(message) => {
                    self.used += FRAMING_BYTES + message.payload.len();
                    return Some(message);
                }
                Parsed::Partial => return None,
                Parsed::Damage => self.skip(),
            }
        }
        None
    }

    /// Passes over at least a byte, up to where a marker may begin.
    fn skip(&mut self) {
        let rest = &self.bytes[self.used + 1..];
        let next = 1 + rest.iter().position(|byte| *byte == MARKER[0]).unwrap_or(rest.len());
        self.used += next;
        self.damaged_bytes += next as u64;
    }

    /// Bytes passed over so far because they were no part of an intact message.
    pub fn damaged_bytes(&self) -> u64 {
        self.damaged_bytes
    }

    /// Gives up what is there of a message whose end will not come.
    pub fn discard(&mut self) {
        self.damaged_bytes += (self.bytes.len() - self.used) as u64;
        self.bytes.clear();
        self.used = 0;
    }
}
