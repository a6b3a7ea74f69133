//! Errors of the codec: bad bytes name the payload section and offset, bad geometry names the element.

/// What went wrong while coding or decoding.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum CodecError {
    /// A payload does not follow FORMAT.md.
    #[error("{section}, byte {offset}: {reason}")]
    Payload {
        /// Section of FORMAT.md that the bytes break.
        section: &'static str,
        /// Offset in bytes from the start of that section.
        offset: usize,
        /// What was found and what was expected.
        reason: String,
    },
    /// A payload written by a newer version of the format.
    #[error("format version {found} is newer than {supported}, which this program reads; update gv3 to open it")]
    NewerVersion {
        /// Version in the payload.
        found: u32,
        /// Newest version this build reads.
        supported: u32,
    },
    /// A mesh that cannot be used as asked.
    #[error("mesh: {0}")]
    Mesh(String),
    /// Texture coding failed.
    #[error("texture: {0}")]
    Texture(String),
    /// A caller broke the order of a stream (ticks going back, decoding before the header).
    #[error("stream: {0}")]
    Stream(String),
}

/// Result of the codec.
pub type Result<T> = std::result::Result<T, CodecError>;
