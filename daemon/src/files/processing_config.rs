//! The processing choices of a rig file or of a folder of pictures.
//!
//! ```toml
//! [processing]
//! unwrap = "geometric"        # auto (default), geometric, spatial
//! motion = "phase_rate"       # none (default), phase_rate
//! gamma_file = "gamma.toml"   # from gv3 calibrate-gamma
//! ```

use super::error::{FileError, Result, read_limited};
use crate::light::{GammaTable, MotionCorrection, Processing, Unwrap};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Largest table read.
const MAX_TABLE_BYTES: u64 = 16 << 20;

/// Processing choices as text has them.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ProcessingConfig {
    /// How fringe orders are found.
    pub unwrap: Unwrap,
    /// What is done about motion.
    pub motion: MotionCorrection,
    /// Phase errors of the projector (TOML); a relative path starts at the file that names it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gamma_file: Option<PathBuf>,
}

impl ProcessingConfig {
    /// Whether nothing is chosen.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Makes a relative path start at the folder of `file`, which names it.
    pub fn start_at(&mut self, file: &Path) {
        if let (Some(gamma), Some(folder)) = (&mut self.gamma_file, file.parent()) {
            *gamma = folder.join(&*gamma);
        }
    }

    /// The choices with the table's content.
    ///
    /// # Errors
    /// [`FileError`] naming the table's file: not readable, or no table.
    pub fn read(&self) -> Result<Processing> {
        let gamma = self.gamma_file.as_deref().map(read_gamma).transpose()?;
        Ok(Processing { unwrap: self.unwrap, motion: self.motion, gamma })
    }
}

/// Reads a table of phase errors.
///
/// # Errors
/// [`FileError`]: not readable, or no table.
pub fn read_gamma(path: &Path) -> Result<GammaTable> {
    let bytes = read_limited(path, MAX_TABLE_BYTES)?;
    let text = String::from_utf8(bytes).map_err(|e| FileError::content(path, format!("no text: {e}")))?;
    GammaTable::from_toml(&text).map_err(|e| FileError::content(path, e.to_string()))
}
