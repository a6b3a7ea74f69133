//! The serial trigger controller's protocol, as TRIGGER.md writes it down: lines in and out of bytes, no I/O.
//!
//! The host encodes a [`Request`] and decodes [`Message`]s that a [`LineReader`] cuts out of what arrives; a controller does
//! the reverse, as [`TriggerModel`] shows.

mod error;
mod fields;
pub mod line;
mod message;
mod model;
pub mod request;

pub use error::TriggerError;
pub use fields::MAX_WORD_BYTES;
pub use line::LineReader;
pub use message::{Answer, Event, Identity, Message, Refusal, State, Status};
pub use model::{FIRE_DELAY_NANOS, TIMER_NANOS, TriggerModel, TriggerPulse};
pub use request::{ArmSettings, Command, Request};

/// Version of the protocol that this crate speaks.
pub const PROTOCOL_VERSION: u16 = 1;
