//! What a host asks, and the replies.

use super::{BodyError, MAX_LEVELS, MAX_ORDER, Message, Refusal, Status, VERSION};
use crate::session::bytes::Bytes;

const STATUS: u8 = 0x01;
const CLEAR: u8 = 0x10;
const PATTERN: u8 = 0x11;
const ORDER: u8 = 0x12;
const TIMING: u8 = 0x13;
const ARM: u8 = 0x20;
const START: u8 = 0x21;
const STOP: u8 = 0x22;
const SHOW: u8 = 0x23;
const CLEAR_FAULT: u8 = 0x24;
/// A reply's kind is its request's with this bit.
const REPLY: u8 = 0x80;
/// Longest text of a refusal, bytes.
const MAX_TEXT_BYTES: usize = 120;

/// What a pattern's levels follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// One level a column; every row is alike.
    Columns,
    /// One level a row; every column is alike.
    Rows,
}

/// When patterns are shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// From one exposure to the next, nanoseconds.
    pub period_nanos: u64,
    /// Exposure within it, nanoseconds.
    pub exposure_nanos: u64,
}

/// A request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// How is it?
    Status,
    /// Forget patterns, order and timing.
    Clear,
    /// Store a pattern.
    Pattern {
        /// Where, from 0.
        index: u16,
        /// What the levels follow.
        axis: Axis,
        /// Levels, 0 dark to 255 bright, linear in the light that comes out as far as the device can.
        levels: Vec<u8>,
    },
    /// Patterns of a set in the order shown.
    Order(Vec<u16>),
    /// When patterns are shown.
    Timing(Timing),
    /// Get ready to start at once.
    Arm,
    /// Show sets one after the other.
    Start,
    /// Go dark.
    Stop,
    /// Show the pattern at a position of the set until told otherwise.
    Show(u16),
    /// Leave the fault state.
    ClearFault,
}

impl Request {
    fn kind(&self) -> u8 {
        match self {
            Self::Status => STATUS,
            Self::Clear => CLEAR,
            Self::Pattern { .. } => PATTERN,
            Self::Order(_) => ORDER,
            Self::Timing(_) => TIMING,
            Self::Arm => ARM,
            Self::Start => START,
            Self::Stop => STOP,
            Self::Show(_) => SHOW,
            Self::ClearFault => CLEAR_FAULT,
        }
    }

    /// Its name in GV3.md.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Status => "STATUS",
            Self::Clear => "CLEAR",
            Self::Pattern { .. } => "PATTERN",
            Self::Order(_) => "ORDER",
            Self::Timing(_) => "TIMING",
            Self::Arm => "ARM",
            Self::Start => "START",
            Self::Stop => "STOP",
            Self::Show(_) => "SHOW",
            Self::ClearFault => "CLEAR_FAULT",
        }
    }

    /// Its message with a number.
    ///
    /// # Panics
    /// When a pattern has more than [`MAX_LEVELS`] levels or an order more than [`MAX_ORDER`] positions.
    pub fn message(&self, sequence: u16) -> Message {
        let mut payload = Vec::new();
        match self {
            Self::Pattern { index, axis, levels } => {
                assert!(levels.len() <= MAX_LEVELS, "{} levels", levels.len());
                payload.extend(index.to_le_bytes());
                payload.extend([u8::from(*axis == Axis::Rows), 0]);
                payload.extend(levels);
            }
            Self::Order(order) => {
                assert!(order.len() <= MAX_ORDER, "{} positions", order.len());
                payload.extend(order.iter().flat_map(|index| index.to_le_bytes()));
            }
            Self::Timing(timing) => payload = timing.encode(),
            Self::Show(position) => payload.extend(position.to_le_bytes()),
            _ => {}
        }
        Message::new(self.kind(), 0, sequence, payload)
    }

    /// Reads a message.
    ///
    /// # Errors
    /// [`BodyError`] when it is no request of this version, which a device answers with the [`Refusal`] of the error.
    pub fn decode(message: &Message) -> Result<Self, BodyError> {
        if message.version != VERSION {
            return Err(BodyError::Version(message.version));
        }
        let payload = &message.payload[..];
        let empty = |request| no_payload(payload).map(|()| request);
        match message.kind {
            STATUS => empty(Self::Status),
            CLEAR => empty(Self::Clear),
            PATTERN => Self::pattern(payload),
            ORDER => Self::order(payload),
            TIMING => Timing::decode(payload).map(Self::Timing),
            ARM => empty(Self::Arm),
            START => empty(Self::Start),
            STOP => empty(Self::Stop),
            SHOW => match payload {
                &[low, high] => Ok(Self::Show(u16::from_le_bytes([low, high]))),
                other => Err(BodyError::Length { field: "show", found: other.len(), expected: 2 }),
            },
            CLEAR_FAULT => empty(Self::ClearFault),
            other => Err(BodyError::Kind(other)),
        }
    }

    fn pattern(payload: &[u8]) -> Result<Self, BodyError> {
        let Some((&[low, high, axis, _], levels)) = payload.split_first_chunk::<4>().filter(|(_, l)| !l.is_empty())
        else {
            return Err(BodyError::Length { field: "pattern", found: payload.len(), expected: 5 });
        };
        let axis = match axis {
            0 => Axis::Columns,
            1 => Axis::Rows,
            other => {
                let reason = format!("{other}, expected 0 or 1");
                return Err(BodyError::Field { offset: 2, field: "axis", reason });
            }
        };
        Ok(Self::Pattern { index: u16::from_le_bytes([low, high]), axis, levels: levels.to_vec() })
    }

    fn order(payload: &[u8]) -> Result<Self, BodyError> {
        let (pairs, rest) = payload.as_chunks::<2>();
        if pairs.is_empty() || pairs.len() > MAX_ORDER || !rest.is_empty() {
            let expected = 2 * pairs.len().clamp(1, MAX_ORDER);
            return Err(BodyError::Length { field: "order", found: payload.len(), expected });
        }
        Ok(Self::Order(pairs.iter().map(|pair| u16::from_le_bytes(*pair)).collect()))
    }

    /// The device's reply with a body to a request of this kind and number.
    pub fn reply(request: &Message, result: Result<Reply, BodyError>) -> Message {
        let (status, payload) = match result {
            Ok(reply) => (0, reply.encode()),
            Err(error) => {
                let mut text = match &error {
                    BodyError::Refused { text, .. } => text.clone(),
                    other => other.to_string(),
                };
                let end = (0..=text.len().min(MAX_TEXT_BYTES)).rev().find(|&end| text.is_char_boundary(end));
                text.truncate(end.unwrap_or(0));
                (Refusal::from(&error) as u8, text.into_bytes())
            }
        };
        Message::new(request.kind | REPLY, status, request.sequence, payload)
    }

    /// Reads the reply to this request.
    ///
    /// # Errors
    /// [`BodyError::Refused`] when the device refused, another when the reply is none to this request.
    pub fn decode_reply(&self, message: &Message) -> Result<Reply, BodyError> {
        if message.kind != self.kind() | REPLY {
            return Err(BodyError::Kind(message.kind));
        }
        if message.status != 0 {
            let text = String::from_utf8_lossy(&message.payload).into_owned();
            return Err(BodyError::Refused { refusal: Refusal::from_code(message.status), text });
        }
        if message.version != VERSION {
            return Err(BodyError::Version(message.version));
        }
        match self {
            Self::Status => Status::decode(&message.payload).map(Reply::Status),
            Self::Timing(_) => Timing::decode(&message.payload).map(Reply::Timing),
            _ => no_payload(&message.payload).map(|()| Reply::Done),
        }
    }
}

fn no_payload(payload: &[u8]) -> Result<(), BodyError> {
    match payload.len() {
        0 => Ok(()),
        found => Err(BodyError::Length { field: "payload", found, expected: 0 }),
    }
}

/// What a device replies when it did what was asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reply {
    /// Done.
    Done,
    /// How it is.
    Status(Status),
    /// The timing it will keep, the nearest to the one asked.
    Timing(Timing),
}

impl Reply {
    fn encode(&self) -> Vec<u8> {
        match self {
            Self::Done => Vec::new(),
            Self::Status(status) => status.encode(),
            Self::Timing(timing) => timing.encode(),
        }
    }
}

impl Timing {
    fn encode(&self) -> Vec<u8> {
        [self.period_nanos, self.exposure_nanos].into_iter().flat_map(u64::to_le_bytes).collect()
    }

    fn decode(payload: &[u8]) -> Result<Self, BodyError> {
        let mut fields = Bytes(payload);
        match (fields.u64(), fields.u64(), fields.0) {
            (Some(period_nanos), Some(exposure_nanos), []) => Ok(Self { period_nanos, exposure_nanos }),
            _ => Err(BodyError::Length { field: "timing", found: payload.len(), expected: 16 }),
        }
    }
}
