//! Makes sessions whole again that a killed writer left unfinished.

use super::{SessionDirectory, SessionName, StoreError};
use gv3_protocol::session::{SessionError, SessionReader, SessionState, recover};
use std::path::PathBuf;

/// A file that was unfinished.
#[derive(Debug)]
pub struct Repaired {
    /// The session.
    pub name: SessionName,
    /// The file.
    pub path: PathBuf,
    /// Groups kept, or why nothing could be done; the file is as it was then.
    pub outcome: Result<usize, SessionError>,
}

/// Recovers every unfinished file in place, each whole or untouched. `is_recording` is asked before each file, so that a
/// recording begun meanwhile is left alone.
///
/// # Errors
/// [`StoreError::Io`] when the directory cannot be read.
pub fn repair(
    directory: &SessionDirectory,
    is_recording: impl Fn(&SessionName) -> bool,
) -> Result<Vec<Repaired>, StoreError> {
    let mut repaired = Vec::new();
    for (name, segments) in directory.segments()? {
        for path in segments.into_iter().map(|s| s.path) {
            if is_recording(&name) {
                break;
            }
            let is_unfinished =
                SessionReader::open(&path).is_ok_and(|r| matches!(r.state(), SessionState::Unfinished { .. }));
            if is_unfinished {
                let outcome = recover(&path, &path, true).map(|report| report.groups);
                repaired.push(Repaired { name: name.clone(), path, outcome });
            }
        }
    }
    Ok(repaired)
}
