//! What the engine is told: a rig, and where its sessions go.

use super::LiveError;
use crate::device::{DeviceError, RigConfig};
use crate::files::SessionsConfig;
use crate::pipeline::Reconstructor;
use std::path::Path;

/// A rig and its session directory.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveConfig {
    /// The rig, without its table `[sessions]`.
    pub rig: RigConfig,
    /// That table.
    pub sessions: SessionsConfig,
}

impl LiveConfig {
    /// Takes a rig's own table `[sessions]`, or the defaults.
    pub fn of(mut rig: RigConfig) -> Self {
        let sessions = rig.sessions.take().unwrap_or_default();
        Self { rig, sessions }
    }

    /// Reads a rig file.
    ///
    /// # Errors
    /// As [`RigConfig::read`].
    pub fn read(path: &Path) -> Result<Self, DeviceError> {
        RigConfig::read(path).map(Self::of)
    }

    /// Checks everything that can be checked without the devices; gives what had to be built for that, to run with it.
    ///
    /// # Errors
    /// [`LiveError::Config`] naming the field.
    pub fn check(&self) -> Result<Reconstructor, LiveError> {
        self.reconstructor().map_err(LiveError::Config)
    }

    fn reconstructor(&self) -> Result<Reconstructor, DeviceError> {
        self.rig.validate()?;
        self.sessions.validate()?;
        let processing = self.rig.processing.read();
        let processing = processing.map_err(|e| DeviceError::config("processing.gamma_file", e.to_string()))?;
        let calibration = self.rig.calibration()?;
        Ok(Reconstructor::with(&calibration, &self.rig.sequence, &self.rig.limits, &processing)?)
    }
}
