//! Where the daemon keeps sessions: the table `[sessions]` of a rig file.
//!
//! ```toml
//! [sessions]
//! directory = "sessions"         # relative to the rig file
//! segment_seconds = 600          # a new file after ten minutes
//! keep_days = 30
//! free_floor_bytes = 1000000000  # no recording when less is free
//! ```

use crate::device::DeviceError;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Where sessions go, when a recording goes on in a new file, and what is kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SessionsConfig {
    /// Folder of the sessions; a relative path starts at the rig's file.
    pub directory: PathBuf,
    /// Sensor time after which a recording goes on in a new file, seconds; at the next keyframe.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub segment_seconds: Option<f64>,
    /// Bytes after which a recording goes on in a new file; at the next keyframe.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub segment_bytes: Option<u64>,
    /// Days after which a session is deleted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_days: Option<f64>,
    /// Bytes of all sessions together, above which the oldest are deleted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_bytes: Option<u64>,
    /// Free bytes of the disk below which nothing is recorded.
    pub free_floor_bytes: u64,
    /// The same as a share of the disk, percent; the greater of the two counts.
    pub free_floor_percent: f64,
}

impl Default for SessionsConfig {
    fn default() -> Self {
        Self {
            directory: "sessions".into(),
            segment_seconds: None,
            segment_bytes: None,
            keep_days: None,
            keep_bytes: None,
            free_floor_bytes: 500_000_000,
            free_floor_percent: 1.0,
        }
    }
}

impl SessionsConfig {
    /// Checks ranges.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field.
    pub fn validate(&self) -> Result<(), DeviceError> {
        let fail = |field: &str, reason: String| Err(DeviceError::config(format!("sessions.{field}"), reason));
        if self.directory.as_os_str().is_empty() {
            return fail("directory", "empty; name a folder".into());
        }
        let ranges = [
            ("segment_seconds", self.segment_seconds, 1.0, 3.2e7),
            ("keep_days", self.keep_days, 0.0, 1e5),
            ("free_floor_percent", Some(self.free_floor_percent), 0.0, 99.0),
        ];
        for (field, value, low, high) in ranges {
            if let Some(value) = value.filter(|value| !(low..=high).contains(value)) {
                return fail(field, format!("{value} is outside {low} ..= {high}"));
            }
        }
        match self.segment_bytes {
            Some(bytes) if bytes < 65_536 => fail("segment_bytes", format!("{bytes} is less than 65536")),
            _ => Ok(()),
        }
    }

    /// Bytes that must stay free on a disk of `total_bytes`.
    pub fn floor_bytes(&self, total_bytes: u64) -> u64 {
        self.free_floor_bytes.max((total_bytes as f64 * self.free_floor_percent * 0.01) as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_of_a_rig_file() {
        let config: SessionsConfig = toml::from_str("directory = \"scans\"\nkeep_days = 2").unwrap();
        assert_eq!((config.directory, config.keep_days), ("scans".into(), Some(2.0)));
        assert!(toml::from_str::<SessionsConfig>("keep = 2").is_err());
    }

    #[test]
    fn ranges_name_the_field() {
        let fault = |change: fn(&mut SessionsConfig)| {
            let mut config = SessionsConfig::default();
            config.validate().unwrap();
            change(&mut config);
            config.validate().unwrap_err().to_string()
        };
        assert!(fault(|c| c.segment_seconds = Some(f64::NAN)).starts_with("sessions.segment_seconds"));
        assert!(fault(|c| c.free_floor_percent = 100.0).starts_with("sessions.free_floor_percent"));
        assert!(fault(|c| c.segment_bytes = Some(1)).starts_with("sessions.segment_bytes"));
        assert!(fault(|c| c.directory = PathBuf::new()).starts_with("sessions.directory"));
    }

    #[test]
    fn the_greater_floor_counts() {
        let config = SessionsConfig { free_floor_bytes: 100, free_floor_percent: 10.0, ..SessionsConfig::default() };
        assert_eq!((config.floor_bytes(500), config.floor_bytes(5000)), (100, 500));
    }
}
