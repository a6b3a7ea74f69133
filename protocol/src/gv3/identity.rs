//! What a device says of itself.

use super::{BodyError, VERSION};
use crate::session::bytes::Bytes;

/// Answer to [`super::CONTROL_IDENTIFY`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Version of the firmware: major times 256 plus minor.
    pub firmware_version: u16,
    /// Columns.
    pub width_px: u16,
    /// Rows.
    pub height_px: u16,
    /// Patterns it can store.
    pub max_patterns: u16,
    /// Positions a set can have.
    pub max_order: u16,
    /// Shortest time from one exposure to the next, nanoseconds.
    pub min_period_nanos: u64,
    /// Longest time from one exposure to the next, nanoseconds.
    pub max_period_nanos: u64,
    /// Maker and model, at most 32 bytes of UTF-8.
    pub model: String,
    /// Serial number, at most 32 bytes of UTF-8; that of the USB descriptor.
    pub serial: String,
}

impl Identity {
    /// Length, bytes.
    pub const BYTES: usize = 96;

    /// Its bytes; texts are cut at 32 bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![VERSION, 0];
        let numbers = [self.firmware_version, self.width_px, self.height_px, self.max_patterns, self.max_order, 0, 0];
        bytes.extend(numbers.into_iter().flat_map(u16::to_le_bytes));
        bytes.extend([self.min_period_nanos, self.max_period_nanos].into_iter().flat_map(u64::to_le_bytes));
        for text in [&self.model, &self.serial] {
            let end = (0..=text.len().min(32)).rev().find(|&end| text.is_char_boundary(end)).unwrap_or(0);
            let begin = bytes.len();
            bytes.extend(&text.as_bytes()[..end]);
            bytes.resize(begin + 32, 0);
        }
        bytes
    }

    /// Reads it.
    ///
    /// # Errors
    /// [`BodyError`] for another version, a wrong length, or a size or period of nothing.
    pub fn decode(bytes: &[u8]) -> Result<Self, BodyError> {
        let wrong = BodyError::Length { field: "identity", found: bytes.len(), expected: Self::BYTES };
        match bytes.first() {
            None => return Err(wrong),
            Some(&VERSION) => {}
            Some(&other) => return Err(BodyError::Version(other)),
        }
        let identity = Self::fields(bytes).ok_or(wrong)?;
        let zero = |offset, field| Err(BodyError::Field { offset, field, reason: "0, expected more".into() });
        match &identity {
            Self { width_px: 0, .. } => zero(4, "width_px"),
            Self { height_px: 0, .. } => zero(6, "height_px"),
            Self { max_patterns: 0, .. } => zero(8, "max_patterns"),
            Self { max_order: 0, .. } => zero(10, "max_order"),
            Self { min_period_nanos: 0, .. } => zero(16, "min_period_nanos"),
            _ => Ok(identity),
        }
    }

    fn fields(bytes: &[u8]) -> Option<Self> {
        let mut fields = Bytes(bytes);
        fields.slice(2)?;
        let mut numbers = [0; 7];
        for number in &mut numbers {
            *number = fields.u16()?;
        }
        let [firmware_version, width_px, height_px, max_patterns, max_order, ..] = numbers;
        let identity = Self {
            firmware_version,
            width_px,
            height_px,
            max_patterns,
            max_order,
            min_period_nanos: fields.u64()?,
            max_period_nanos: fields.u64()?,
            model: text(fields.slice(32)?),
            serial: text(fields.slice(32)?),
        };
        fields.0.is_empty().then_some(identity)
    }
}

/// Text up to the first zero; what is no UTF-8 is replaced, for it is for people to read.
fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}
