//! The session directory: what it holds, under which names, and for how long.
//!
//! A recording is `NAME.gv3` and, when it was cut, `NAME.0002.gv3`, `NAME.0003.gv3` and so on; its raw pictures are in
//! the folder `NAME.raw`. All calls block; none follows a symbolic link.

mod contents;
mod directory;
mod file_cache;
mod growing_file;
mod name;
mod player;
mod repair;
mod retention;
mod time_text;

pub use contents::{Curve, FileContents, FileGroups, GroupFigures, SessionDetail, event_value};
pub use directory::{SessionDirectory, SessionSummary, State};
pub use name::SessionName;
pub use player::{SessionPlayer, middle_keyframe};
pub use repair::{Repaired, repair};
pub use retention::{Expired, Retention, expire};
pub use time_text::rfc3339;

use crate::measure::Output;
use gv3_protocol::session::SessionError;
use std::io;
use std::path::{Path, PathBuf};

/// What went wrong with the session directory.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A name that no session may have.
    #[error("session name {name:?}: {reason}")]
    Name {
        /// As it was given.
        name: String,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// There is no such session.
    #[error("there is no session {0:?}")]
    NotFound(String),
    /// There are raw pictures of that name and no session.
    #[error("{0:?} has raw pictures alone; `gv3 capture OUT.gv3 --from-raw` makes a session of them")]
    RawOnly(String),
    /// A session of that name is there already.
    #[error("there is a session {0:?} already; choose another name")]
    Exists(String),
    /// The session cannot be shown like that.
    #[error("a session of mode {mode} has no output {wanted:?}; it has {outputs:?}")]
    Output {
        /// What was asked for.
        wanted: Output,
        /// The session's mode.
        mode: &'static str,
        /// What it has.
        outputs: &'static [Output],
    },
    /// The session is being recorded.
    #[error("session {0:?} is being recorded; stop the recording first")]
    Recording(String),
    /// Another process has the directory.
    #[error("{}: another gv3 uses this directory{holder}; stop it, or give this one a directory of its own (--sessions)", path.display())]
    Locked {
        /// The directory.
        path: PathBuf,
        /// Which process, as ` (process 123)`, where that is known.
        holder: String,
    },
    /// The operating system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// The system's answer.
        source: io::Error,
    },
    /// A session file.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A session's content.
    #[error(transparent)]
    Replay(#[from] crate::replay::ReplayError),
}

impl StoreError {
    fn io(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_path_buf();
        move |source| Self::Io { path, action, source }
    }
}
