//! Errors of reading and writing files: each names the file, the place in it, and what to do.

use std::path::{Path, PathBuf};

/// What went wrong with a file or a folder.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system refused.
    #[error("{path}: cannot {action}: {source}")]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What was tried, as a verb: `read`, `write`, `create the folder`.
        action: &'static str,
        /// The system's answer.
        source: std::io::Error,
    },
    /// A line of a text file breaks its format.
    #[error("{path}, line {line}: {reason}")]
    Line {
        /// File.
        path: PathBuf,
        /// 1-based.
        line: usize,
        /// What was found, what was expected, what to do.
        reason: String,
    },
    /// Bytes of a binary file break its format.
    #[error("{path}, byte {offset}: {reason}")]
    Byte {
        /// File.
        path: PathBuf,
        /// Bytes read when the fault was met.
        offset: usize,
        /// What was found, what was expected, what to do.
        reason: String,
    },
    /// The content as a whole cannot be used.
    #[error("{path}: {reason}")]
    Content {
        /// File or folder.
        path: PathBuf,
        /// What was found, what was expected, what to do.
        reason: String,
    },
}

/// Result of reading or writing files.
pub type Result<T> = std::result::Result<T, FileError>;

impl FileError {
    pub(super) fn io(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { path: path.into(), action, source }
    }

    pub(super) fn line(path: &Path, line: usize, reason: impl Into<String>) -> Self {
        Self::Line { path: path.into(), line, reason: reason.into() }
    }

    pub(super) fn byte(path: &Path, offset: usize, reason: impl Into<String>) -> Self {
        Self::Byte { path: path.into(), offset, reason: reason.into() }
    }

    pub(super) fn content(path: &Path, reason: impl Into<String>) -> Self {
        Self::Content { path: path.into(), reason: reason.into() }
    }
}

/// Reads a whole file of at most `limit` bytes; its size is checked before memory is taken.
pub(super) fn read_limited(path: &Path, limit: u64) -> Result<Vec<u8>> {
    use std::io::Read;
    let file = std::fs::File::open(path).map_err(FileError::io(path, "open"))?;
    let size = file.metadata().map_err(FileError::io(path, "read"))?.len();
    check_size(size, limit, path)?;
    let mut bytes = Vec::with_capacity(size as usize);
    // A file that grows while it is read stays within the limit too.
    file.take(limit + 1).read_to_end(&mut bytes).map_err(FileError::io(path, "read"))?;
    check_size(bytes.len() as u64, limit, path)?;
    Ok(bytes)
}

/// Refuses more than `limit` bytes.
pub(super) fn check_size(size: u64, limit: u64, path: &Path) -> Result<()> {
    if size <= limit {
        return Ok(());
    }
    let mib = limit >> 20;
    Err(FileError::content(path, format!("{size} bytes, more than the limit of {mib} MiB for such a file; split it")))
}
