//! Fields of a line, separated by single spaces; one way to write each value.

use super::TriggerError;

/// Longest model or serial number, bytes.
pub const MAX_WORD_BYTES: usize = 24;

/// The fields not read yet.
pub(super) struct Fields<'a>(std::str::Split<'a, char>);

impl<'a> Fields<'a> {
    pub fn new(body: &'a str) -> Self {
        Self(body.split(' '))
    }

    pub fn text(&mut self, field: &'static str) -> Result<&'a str, TriggerError> {
        self.0.next().filter(|text| !text.is_empty()).ok_or(TriggerError::Missing(field))
    }

    /// Decimal digits without a sign and without leading zeros.
    pub fn number<T: TryFrom<u64>>(&mut self, field: &'static str) -> Result<T, TriggerError> {
        let found = self.text(field)?;
        let is_plain = found == "0" || !found.starts_with(['0', '+']);
        let number = found.parse::<u64>().ok().filter(|_| is_plain).and_then(|n| T::try_from(n).ok());
        number.ok_or_else(|| wrong(field, found, "not a decimal number in range"))
    }

    /// Letters, digits, `.`, `_` and `-`.
    pub fn word(&mut self, field: &'static str) -> Result<String, TriggerError> {
        let found = self.text(field)?;
        if is_word(found) { Ok(found.to_owned()) } else { Err(wrong(field, found, "not a word of at most 24 bytes")) }
    }

    pub fn end(mut self) -> Result<(), TriggerError> {
        self.0.next().map_or(Ok(()), |surplus| Err(TriggerError::Surplus(surplus.to_owned())))
    }
}

/// An error about a field.
pub(super) fn wrong(field: &'static str, found: &str, reason: &'static str) -> TriggerError {
    TriggerError::Field { field, found: found.to_owned(), reason }
}

pub(super) fn is_word(text: &str) -> bool {
    let is_part = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-');
    (1..=MAX_WORD_BYTES).contains(&text.len()) && text.bytes().all(is_part)
}
