//! Plays a session of any number of segments.

use super::StoreError;
use crate::measure::Output;
use crate::replay::{Replay, ReplayError, ReplayStamp};
use gv3_codec::Scan;
use std::path::PathBuf;

/// The segments of a session as one replay.
pub struct SessionPlayer {
    /// In time order; at least one.
    segments: Vec<Replay>,
    stamps: Vec<ReplayStamp>,
    output: Output,
}

impl SessionPlayer {
    /// Opens every segment that holds a complete group, to show an output, or the usual one of the session's mode.
    ///
    /// # Errors
    /// [`StoreError::Replay`] when no segment does, or one is damaged; [`StoreError::Output`] when the session has no such
    /// output.
    pub fn open(files: &[PathBuf], wanted: Option<Output>) -> Result<Self, StoreError> {
        let (mut segments, mut refused) = (Vec::new(), None);
        for file in files {
            match Replay::open(file) {
                Ok(replay) => segments.push(replay),
                Err(error) => refused = Some(error),
            }
        }
        let stamps: Vec<ReplayStamp> = segments.iter().flat_map(|s: &Replay| s.stamps()).copied().collect();
        if stamps.is_empty() {
            let path = files.first().cloned().unwrap_or_default();
            let empty = || ReplayError::Content { path, reason: "no scan to replay".into() };
            return Err(refused.unwrap_or_else(empty).into());
        }
        let mode = segments[0].header().mode;
        let outputs = Output::of(mode);
        let output = wanted.unwrap_or(outputs[0]);
        if !outputs.contains(&output) {
            return Err(StoreError::Output { wanted: output, mode: mode.name(), outputs });
        }
        segments.iter_mut().try_for_each(|segment| segment.show(output.played()))?;
        Ok(Self { segments, stamps, output })
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
        self.stamps[self.stamps.len() - 1].time_nanos.saturating_sub(self.first_nanos()) as f64 * 1e-9
    }

    /// What is shown.
    pub fn output(&self) -> Output {
        self.output
    }

    /// All that can be shown of this session.
    pub fn outputs(&self) -> &'static [Output] {
        Output::of(self.segments[0].header().mode)
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
