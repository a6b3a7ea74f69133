//! What is asked of the engine, and what it answers.

use crate::pipeline::RawRecorded;
use serde::{Deserialize, Serialize};

/// A recording that is asked for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RecordingRequest {
    /// Its name; made of date and time when none is given.
    pub name: Option<String>,
    /// Keep the camera's pictures.
    pub raw: bool,
    /// Code scans; without them a recording has its raw pictures alone.
    pub scans: bool,
}

impl Default for RecordingRequest {
    fn default() -> Self {
        Self { name: None, raw: false, scans: true }
    }
}

/// A recording that has begun.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RecordingStarted {
    /// Its name.
    pub session: String,
}

/// A recording that has ended.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingStopped {
    /// Its name.
    pub session: String,
    /// Names of its files in the session directory, in their order.
    pub files: Vec<String>,
    /// Scans in them.
    pub scans: u64,
    /// Keyframes in them.
    pub keyframes: u64,
    /// Bytes of the files.
    pub bytes: u64,
    /// Every file was opened again when it was closed: its summary is intact, and it ends with the group written last.
    pub verified: bool,
    /// From the call until everything was verified, milliseconds.
    pub ms: f64,
    /// The raw pictures, if they were asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub raw: Option<RawRecorded>,
}
