//! Errors of raw recordings: each names the file, the byte where there is one, and what to do.

use std::io;
use std::path::{Path, PathBuf};

/// What went wrong with a raw recording.
#[derive(Debug, thiserror::Error)]
pub enum RawError {
    /// The operating system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// File or folder concerned.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// The system's answer.
        source: io::Error,
    },
    /// No raw recording: another folder, another format.
    #[error("{}: not a raw recording: {reason}", path.display())]
    NotARecording {
        /// File or folder concerned.
        path: PathBuf,
        /// What was found instead.
        reason: String,
    },
    /// Written by a newer version of the format.
    #[error("{}: written by a newer version of gv3 (raw format {found}; this program reads up to {supported}); update gv3", path.display())]
    NewerVersion {
        /// File concerned.
        path: PathBuf,
        /// Version in the file.
        found: u16,
        /// Newest version this build reads.
        supported: u16,
    },
    /// The folder holds a recording or other files already.
    #[error("{}: not empty; give another folder, or remove the recording in it first", path.display())]
    Exists {
        /// Folder concerned.
        path: PathBuf,
    },
    /// The caller broke a limit of the format, or goes on after a failure.
    #[error("raw recording: {0}")]
    Usage(String),
}

/// Result of raw recordings.
pub type Result<T> = std::result::Result<T, RawError>;

/// An I/O error of `path` while trying `action`.
pub(super) fn io_error(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> RawError {
    let path = path.to_path_buf();
    move |source| RawError::Io { path, action, source }
}
