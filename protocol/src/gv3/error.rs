//! What can be wrong with an intact message, and what a device answers to it.

/// Why a message's body cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BodyError {
    /// A version that this build does not speak.
    #[error("protocol version {0}, this build speaks {version}; update gv3 or the device", version = super::VERSION)]
    Version(u8),
    /// A kind that does not exist, or is no request, reply or event where one was expected.
    #[error("message of unknown kind {0:#04x}")]
    Kind(u8),
    /// A payload of another length than its kind has.
    #[error("{field}: {found} bytes, expected {expected}")]
    Length {
        /// Name of the body.
        field: &'static str,
        /// Bytes found.
        found: usize,
        /// Bytes expected.
        expected: usize,
    },
    /// A field outside its range.
    #[error("byte {offset}, {field}: {reason}")]
    Field {
        /// Offset in the payload, bytes.
        offset: usize,
        /// Name of the field as in GV3.md.
        field: &'static str,
        /// What was found and what was expected.
        reason: String,
    },
    /// The device refused the request.
    #[error("the device refused: {refusal}: {text}")]
    Refused {
        /// Why.
        refusal: Refusal,
        /// The device's words.
        text: String,
    },
}

/// Why a device refuses a request; the status byte of its reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Refusal {
    /// No request of this kind.
    Kind = 1,
    /// A payload of the wrong length.
    Length = 2,
    /// A field outside its range, or one that this device cannot do.
    Field = 3,
    /// Not allowed in this state.
    State = 4,
    /// A version of the protocol that the device does not speak.
    Version = 5,
    /// A fault stands in the way.
    Fault = 6,
    /// Any code that is not in this list.
    Other = 255,
}

impl Refusal {
    /// By status byte, which is not 0.
    pub(super) fn from_code(code: u8) -> Self {
        [Self::Kind, Self::Length, Self::Field, Self::State, Self::Version, Self::Fault]
            .into_iter()
            .find(|refusal| *refusal as u8 == code)
            .unwrap_or(Self::Other)
    }
}

impl From<&BodyError> for Refusal {
    fn from(error: &BodyError) -> Self {
        match error {
            BodyError::Version(_) => Self::Version,
            BodyError::Kind(_) => Self::Kind,
            BodyError::Length { .. } => Self::Length,
            BodyError::Field { .. } => Self::Field,
            BodyError::Refused { refusal, .. } => *refusal,
        }
    }
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Kind => "unknown request",
            Self::Length => "wrong length",
            Self::Field => "field out of range",
            Self::State => "not in this state",
            Self::Version => "unknown protocol version",
            Self::Fault => "fault",
            Self::Other => "unknown reason",
        })
    }
}
