//! Errors of session files: each names the file, the byte where there is one, and what to do.

use std::io;
use std::path::{Path, PathBuf};

/// What went wrong with a session file.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The operating system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// File concerned.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// The system's answer.
        source: io::Error,
    },
    /// Writing to the sink failed; what was written before is recoverable.
    #[error("writing the session failed: {0}")]
    Write(#[source] io::Error),
    /// Not a session at all: a directory, an empty file, another format.
    #[error("{}: not a gv3 session: {reason}", path.display())]
    NotASession {
        /// File concerned.
        path: PathBuf,
        /// What was found instead.
        reason: String,
    },
    /// Written by a newer version of the format.
    #[error(
        "{}: written by a newer version of gv3 (format {found}; this program reads up to {supported}); update gv3 \
         to open it",
        path.display()
    )]
    NewerVersion {
        /// File concerned.
        path: PathBuf,
        /// Version in the file.
        found: u32,
        /// Newest version this build reads.
        supported: u32,
    },
    /// The bytes break SESSION.md.
    #[error("{}, byte {offset}: {reason}; `gv3 recover` keeps every intact group", path.display())]
    Damaged {
        /// File concerned.
        path: PathBuf,
        /// Offset in bytes from the start of the file.
        offset: u64,
        /// What was found and what was expected.
        reason: String,
    },
    /// The output exists and overwriting was not asked for.
    #[error("{}: exists already; choose another name, or overwrite it (--force)", path.display())]
    Exists {
        /// File concerned.
        path: PathBuf,
    },
    /// No complete group survived.
    #[error("{}: nothing to recover: {reason}", path.display())]
    NothingToRecover {
        /// File concerned.
        path: PathBuf,
        /// What was found.
        reason: String,
    },
    /// The caller broke the order or the limits of a session.
    #[error("session: {0}")]
    Usage(String),
}

/// Result of the session file.
pub type Result<T> = std::result::Result<T, SessionError>;

/// An error below the level that knows the file's name.
#[derive(Debug)]
pub(crate) enum Fault {
    Io(io::Error),
    Damaged { offset: u64, reason: String },
    Newer { found: u32, supported: u32 },
}

impl Fault {
    pub fn damaged(offset: u64, reason: impl Into<String>) -> Self {
        Fault::Damaged { offset, reason: reason.into() }
    }

    pub fn in_file(self, path: &Path) -> SessionError {
        let path = path.to_path_buf();
        match self {
            Fault::Io(source) => SessionError::Io { path, action: "read", source },
            Fault::Damaged { offset, reason } => SessionError::Damaged { path, offset, reason },
            Fault::Newer { found, supported } => SessionError::NewerVersion { path, found, supported },
        }
    }
}

impl From<io::Error> for Fault {
    fn from(error: io::Error) -> Self {
        Fault::Io(error)
    }
}
