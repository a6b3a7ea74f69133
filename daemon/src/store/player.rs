//! Plays a session of any number of segments.

use super::StoreError;
use crate::measure::Output;
use crate::replay::{Replay, ReplayError, ReplayStamp};
use gv3_codec::{Player, Scan, StreamHeader};
use gv3_protocol::session::SessionReader;
use std::fs::File;
use std::path::{Path, PathBuf};

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

/// The keyframe in the middle of a session, as its usual output shows it. Of the other groups only those are read that it
/// rests on.
///
/// # Errors
/// [`StoreError::Session`] and [`StoreError::Replay`] of the segment in the middle; segments without a group are passed over.
pub fn middle_keyframe(files: &[PathBuf]) -> Result<Scan, StoreError> {
    let (before, after) = files.split_at(files.len() / 2);
    for path in after.iter().chain(before.iter().rev()) {
        let mut reader = SessionReader::open(path)?;
        let groups: Vec<u64> = reader.groups().iter().map(|g| g.time_nanos).collect();
        if !groups.is_empty() {
            return keyframe(path, &mut reader, &groups, groups.len() / 2);
        }
    }
    let path = files.first().cloned().unwrap_or_default();
    Err(ReplayError::Content { path, reason: "no scan to show".into() }.into())
}

/// The keyframe of one group of a file whose groups have these times.
fn keyframe(path: &Path, reader: &mut SessionReader<File>, groups: &[u64], at: usize) -> Result<Scan, StoreError> {
    let fail = |reason: String| ReplayError::Content { path: path.into(), reason };
    let streams = reader.streams().to_vec();
    let run = streams.partition_point(|s| s.first_group <= at).checked_sub(1);
    let run = run.ok_or_else(|| fail("no stream header; the session cannot be decoded".into()))?;
    let first = streams[run].first_group;
    let end = streams.get(run + 1).map_or(groups.len(), |next| next.first_group);
    let header = StreamHeader::decode(&reader.read_stream(run)?).map_err(|e| fail(e.to_string()))?;
    let output = Output::of(header.mode)[0].played();
    let player = Player::new(header, groups[first..end].to_vec(), output);
    let mut fetch = |group: usize| -> Result<_, ReplayError> {
        let stored = reader.read_group(first + group)?;
        Ok((stored.geometry, stored.texture))
    };
    Ok(player.map_err(|e| fail(e.to_string()))?.scan_at(groups[at], &mut fetch)?)
}
