//! What a device tells unasked: one message, one packet of the interrupt endpoint.

use super::{BodyError, DeviceFault, Message, VERSION};
use crate::session::bytes::Bytes;

const EXPOSURE: u8 = 0x40;
const FAULT: u8 = 0x41;

/// An event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// A pattern was shown and its trigger given.
    Exposure(Exposure),
    /// The device went dark by itself.
    Fault(FaultEvent),
}

/// Proof of what was shown when.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exposure {
    /// Triggers since the start, from 0.
    pub trigger: u64,
    /// Sets since the start, from 0.
    pub set: u64,
    /// Position in the set, from 0.
    pub position: u16,
    /// Pattern that the order has there.
    pub pattern: u16,
    /// Middle of the exposure on the device's clock, nanoseconds.
    pub device_time_nanos: u64,
    /// Length of the exposure, nanoseconds.
    pub exposure_nanos: u64,
}

/// What went wrong when.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FaultEvent {
    /// What.
    pub fault: DeviceFault,
    /// When, on the device's clock, nanoseconds.
    pub device_time_nanos: u64,
}

impl Event {
    /// Its message with a number.
    pub fn message(&self, sequence: u16) -> Message {
        let mut payload = Vec::new();
        let kind = match self {
            Self::Exposure(e) => {
                payload.extend([e.trigger, e.set].into_iter().flat_map(u64::to_le_bytes));
                payload.extend([e.position, e.pattern, 0, 0].into_iter().flat_map(u16::to_le_bytes));
                payload.extend([e.device_time_nanos, e.exposure_nanos].into_iter().flat_map(u64::to_le_bytes));
                EXPOSURE
            }
            Self::Fault(e) => {
                payload.extend([e.fault.code(), 0, 0, 0].into_iter().flat_map(u16::to_le_bytes));
                payload.extend(e.device_time_nanos.to_le_bytes());
                FAULT
            }
        };
        Message::new(kind, 0, sequence, payload)
    }

    /// Reads a message.
    ///
    /// # Errors
    /// [`BodyError`] when it is no event of this version.
    pub fn decode(message: &Message) -> Result<Self, BodyError> {
        if message.version != VERSION {
            return Err(BodyError::Version(message.version));
        }
        let found = message.payload.len();
        match message.kind {
            EXPOSURE => {
                Self::exposure(&message.payload).ok_or(BodyError::Length { field: "exposure", found, expected: 40 })
            }
            FAULT => {
                let wrong = BodyError::Length { field: "fault", found, expected: 16 };
                let (code, device_time_nanos) = Self::fault(&message.payload).ok_or(wrong)?;
                let none = BodyError::Field { offset: 0, field: "fault", reason: "0 is no fault".into() };
                Ok(Self::Fault(FaultEvent { fault: DeviceFault::from_code(code).ok_or(none)?, device_time_nanos }))
            }
            other => Err(BodyError::Kind(other)),
        }
    }

    fn exposure(payload: &[u8]) -> Option<Self> {
        let mut fields = Bytes(payload);
        let (trigger, set, position, pattern) = (fields.u64()?, fields.u64()?, fields.u16()?, fields.u16()?);
        fields.u32()?;
        let (device_time_nanos, exposure_nanos) = (fields.u64()?, fields.u64()?);
        let exposure = Exposure { trigger, set, position, pattern, device_time_nanos, exposure_nanos };
        fields.0.is_empty().then_some(Self::Exposure(exposure))
    }

    fn fault(payload: &[u8]) -> Option<(u16, u64)> {
        let mut fields = Bytes(payload);
        let code = fields.u16()?;
        fields.slice(6)?;
        let device_time_nanos = fields.u64()?;
        fields.0.is_empty().then_some((code, device_time_nanos))
    }
}
