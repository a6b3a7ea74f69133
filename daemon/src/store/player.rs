//! Plays a session of any number of segments.

use super::StoreError;
use crate::replay::{Replay, ReplayError, ReplayStamp};
use gv3_codec::{Mode, Output, Scan};
use std::path::PathBuf;

/// The segments of a session as one replay.
pub struct SessionPlayer {
    /// In time order; at least one.
    segments: Vec<Replay>,
    stamps: Vec<ReplayStamp>,
}

impl SessionPlayer {
    /// Opens every segment that holds a complete group.
    ///
    /// # Errors
    /// [`StoreError::Replay`] when none does, or one is damaged.
    pub fn open(files: &[PathBuf], output: Output) -> Result<Self, StoreError> {
        let (mut segments, mut refused) = (Vec::new(), None);
        for file in files {
            match Replay::open_as(file, output) {
                Ok(replay) => segments.push(replay),
                Err(error) => refused = Some(error),
            }
        }
        let stamps: Vec<ReplayStamp> = segments.iter().flat_map(|s: &Replay| s.stamps()).copied().collect();
        match refused {
            Some(error) if stamps.is_empty() => Err(error.into()),
            _ if stamps.is_empty() => {
                Err(ReplayError::Content { path: PathBuf::new(), reason: "no scan to replay".into() }.into())
            }
            _ => Ok(Self { segments, stamps }),
        }
    }

    /// Scans of the session in time order; at least one.
    pub fn stamps(&self) -> &[ReplayStamp] {
        &self.stamps
    }

    /// Sensor time of the first scan, nanoseconds.
    pub fn first_nanos(&self) -> u64 {
        self.stamps[0].time_nanos
    }

    /// From the first scan to the last.
    pub fn seconds(&self) -> f64 {
        (self.stamps[self.stamps.len() - 1].time_nanos - self.first_nanos()) as f64 * 1e-9
    }

    /// Coding mode.
    pub fn mode(&self) -> Mode {
        self.segments[0].header().mode
    }

    /// Nanoseconds of one tick.
    pub fn period_nanos(&self) -> u64 {
        self.segments[0].header().scan_period_nanos
    }

    /// The scan at a sensor time, as [`Replay::scan_at`].
    ///
    /// # Errors
    /// [`StoreError::Replay`] naming the group that cannot be decoded.
    pub fn scan_at(&mut self, time_nanos: u64) -> Result<Scan, StoreError> {
        let later = self.segments.partition_point(|s| s.stamps().first().is_some_and(|f| f.time_nanos <= time_nanos));
        Ok(self.segments[later.saturating_sub(1)].scan_at(time_nanos)?)
    }
}
