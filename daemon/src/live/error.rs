//! Why the engine did not do what was asked.

use crate::device::DeviceError;
use crate::pipeline::RecordError;
use crate::store::StoreError;
use std::path::{Path, PathBuf};

/// Why the engine did not do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// Not now.
    #[error("{0}")]
    State(String),
    /// A text that cannot be taken.
    #[error("{0}")]
    Text(String),
    /// A name that cannot be taken, or a session directory that cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A configuration that cannot work.
    #[error("{0}")]
    Config(DeviceError),
    /// A device that does not do what it is asked.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// Scanning or recording failed.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A folder cannot be used.
    #[error("{}: {reason}", path.display())]
    Disk {
        /// The folder.
        path: PathBuf,
        /// What was found and what to do.
        reason: String,
    },
    /// Too little room for a recording.
    #[error("{}: {free_bytes} bytes are free, recordings need {floor_bytes}; delete sessions, or lower the floor", path.display())]
    Space {
        /// The session directory.
        path: PathBuf,
        /// Free bytes.
        free_bytes: u64,
        /// Bytes that must stay free.
        floor_bytes: u64,
    },
    /// The stages did not answer in time.
    #[error("the recording was not finished within {0} s; it is still being written")]
    Timeout(u64),
}

impl LiveError {
    pub(super) fn disk(path: &Path, reason: String) -> Self {
        Self::Disk { path: path.into(), reason }
    }
}
