//! What can be wrong with a line of the trigger protocol.

/// Why a line was not understood. Texts of the line itself are no longer than a line.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TriggerError {
    /// No line end within the longest line.
    #[error("a line is longer than {} bytes", super::line::MAX_LINE_BYTES)]
    TooLong,
    /// A byte outside printable ASCII.
    #[error("byte {offset} of a line is {byte:#04x}, which is no printable ASCII")]
    NotText {
        /// Bytes from the start of the line.
        offset: usize,
        /// The byte.
        byte: u8,
    },
    /// No `*` and four hexadecimal digits at the end.
    #[error("a line ends without a checksum")]
    NoChecksum,
    /// The line was damaged on its way.
    #[error("a line's checksum is {found:04X}, {expected:04X} expected")]
    Checksum {
        /// As the line says.
        found: u16,
        /// Of its bytes.
        expected: u16,
    },
    /// A field is missing.
    #[error("field {0} is missing")]
    Missing(&'static str),
    /// A field holds what it must not.
    #[error("field {field} is \"{found}\": {reason}")]
    Field {
        /// Name in TRIGGER.md.
        field: &'static str,
        /// What stands there.
        found: String,
        /// What may stand there.
        reason: &'static str,
    },
    /// Fields after the last one.
    #[error("\"{0}\" follows the last field")]
    Surplus(String),
}
