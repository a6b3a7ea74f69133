//! Errors of DLPC350 messages: each names the message and the byte.

/// What is wrong with a message of a DLPC350.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Dlpc350Error {
    /// A report of the wrong size.
    #[error("report of {found} bytes, expected {}", super::REPORT_BYTES)]
    ReportSize {
        /// Bytes found.
        found: usize,
    },
    /// A length field that cannot be.
    #[error("byte 2: a length of {found} bytes, expected {expected}")]
    MessageSize {
        /// Bytes by the length field, or of the message to be sent.
        found: usize,
        /// What is possible.
        expected: &'static str,
    },
    /// A payload of the wrong length.
    #[error("{name}: {found} bytes of data, expected {expected}")]
    PayloadSize {
        /// The command.
        name: &'static str,
        /// Bytes found.
        found: usize,
        /// Bytes needed.
        expected: usize,
    },
    /// A byte outside the command's range.
    #[error("{name}: byte {offset} of the data is {found}, expected {expected}")]
    Value {
        /// The command.
        name: &'static str,
        /// Offset from the start of the data.
        offset: usize,
        /// Value found.
        found: u32,
        /// What is valid.
        expected: &'static str,
    },
    /// A setting that no byte of the command stands for.
    #[error("{name}: {reason}")]
    Setting {
        /// The command.
        name: &'static str,
        /// What was asked and what is possible.
        reason: String,
    },
}

/// Result of DLPC350 messages.
pub type Result<T> = std::result::Result<T, Dlpc350Error>;
