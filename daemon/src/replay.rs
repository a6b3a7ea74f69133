//! A session opened for replay: any scan at any time.

use gv3_codec::{CodecError, Output, Player, Scan, StreamHeader, decode_stamps};
use gv3_protocol::session::{SessionError, SessionReader, SessionState};
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Why a session cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The container.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A payload.
    #[error("{path}, group {group}: {source}")]
    Payload {
        /// Session file.
        path: PathBuf,
        /// Group, from 0.
        group: usize,
        /// What the codec found.
        source: CodecError,
    },
    /// Something between groups, or no group at all.
    #[error("{path}: {reason}")]
    Content {
        /// Session file.
        path: PathBuf,
        /// What was found and what to do.
        reason: String,
    },
}

impl From<CodecError> for ReplayError {
    fn from(error: CodecError) -> Self {
        Self::Content { path: PathBuf::new(), reason: error.to_string() }
    }
}

/// A scan that the session holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReplayStamp {
    /// Sensor time in scan periods.
    pub tick: u64,
    /// Sensor time, nanoseconds since the run began.
    pub time_nanos: u64,
    /// Whether it is a keyframe.
    pub is_key: bool,
}

/// A run: groups under one stream header.
struct Run {
    header: StreamHeader,
    groups: Range<usize>,
    player: Player,
}

/// An open session and the decoders of its runs: any moment, without a list of the scans that there are.
pub struct Moments {
    path: PathBuf,
    reader: SessionReader<File>,
    header: StreamHeader,
    runs: Vec<Run>,
}

impl Moments {
    /// Opens a session, finished or not, to show the tracked mesh or each scan as it was seen; sessions of the seed mode have
    /// one output. Reads none of its groups, however many there are.
    ///
    /// # Errors
    /// [`ReplayError`] naming the file and the byte.
    pub fn open(path: &Path, output: Output) -> Result<Self, ReplayError> {
        let mut reader = SessionReader::open(path)?;
        let fail = |reason: String| ReplayError::Content { path: path.into(), reason };
        let (groups, streams) = (reader.groups().to_vec(), reader.streams().to_vec());
        if groups.is_empty() {
            return Err(fail(format!("no complete group to replay ({})", describe(reader.state()))));
        }
        let (mut runs, mut first_header) = (Vec::new(), None);
        for (i, stream) in streams.iter().enumerate() {
            let end = streams.get(i + 1).map_or(groups.len(), |next| next.first_group);
            let range = stream.first_group..end.max(stream.first_group);
            let header = StreamHeader::decode(&reader.read_stream(i)?).map_err(|e| fail(e.to_string()))?;
            let times = groups[range.clone()].iter().map(|g| g.time_nanos).collect();
            first_header.get_or_insert(header);
            if !range.is_empty() {
                let player = Player::new(header, times, output).map_err(|e| fail(e.to_string()))?;
                runs.push(Run { header, groups: range, player });
            }
        }
        let header = first_header.ok_or_else(|| fail("no stream header; the session cannot be decoded".into()))?;
        Ok(Self { path: path.into(), reader, header, runs })
    }

    fn show(&mut self, output: Output) -> Result<(), ReplayError> {
        let groups = self.reader.groups();
        for run in &mut self.runs {
            let times = groups[run.groups.clone()].iter().map(|g| g.time_nanos).collect();
            run.player = Player::new(run.header, times, output)?;
        }
        Ok(())
    }

    /// The container.
    pub fn reader(&self) -> &SessionReader<File> {
        &self.reader
    }

    /// Stamps of all scans, in time order.
    fn stamps(&mut self) -> Result<Vec<ReplayStamp>, ReplayError> {
        let mut stamps = Vec::new();
        for run in &self.runs {
            for group in run.groups.clone() {
                stamps.extend(group_stamps(&self.path, &mut self.reader, &run.header, group)?);
            }
        }
        Ok(stamps)
    }

    /// The scan at a sensor time; before the first and after the last keyframe those are held. Cheapest when times
    /// increase.
    ///
    /// # Errors
    /// [`ReplayError`] naming the group that cannot be decoded.
    pub fn scan_at(&mut self, time_nanos: u64) -> Result<Scan, ReplayError> {
        let groups = self.reader.groups();
        let later = self.runs.partition_point(|r| groups[r.groups.start].time_nanos <= time_nanos);
        let run = &mut self.runs[later.saturating_sub(1)];
        let (reader, start) = (&mut self.reader, run.groups.start);
        let mut at = start;
        let mut fetch = |i: usize| -> Result<_, ReplayError> {
            at = start + i;
            let stored = reader.read_group(at)?;
            Ok((stored.geometry, stored.texture))
        };
        run.player.scan_at(time_nanos, &mut fetch).map_err(|error| match error {
            ReplayError::Content { path, reason } if path.as_os_str().is_empty() => {
                ReplayError::Content { path: self.path.clone(), reason: format!("group {at} or near it: {reason}") }
            }
            other => other,
        })
    }
}

/// A session opened for replay, and the stamps of its scans.
pub struct Replay {
    moments: Moments,
    stamps: Vec<ReplayStamp>,
}

impl Replay {
    /// Opens a session, finished or not, and reads the stamps of its scans.
    ///
    /// # Errors
    /// [`ReplayError`] naming the file and the group or byte.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        Self::open_as(path, Output::default())
    }

    /// As [`Self::open`], showing the tracked mesh or each scan as it was seen; sessions of the seed mode have one output.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_as(path: &Path, output: Output) -> Result<Self, ReplayError> {
        let mut moments = Moments::open(path, output)?;
        Ok(Self { stamps: moments.stamps()?, moments })
    }

    /// Stream header of the first run.
    pub fn header(&self) -> StreamHeader {
        self.moments.header
    }

    /// Shows the tracked mesh or each scan as it was seen from now on.
    ///
    /// # Errors
    /// [`ReplayError`] as [`Self::open`].
    pub fn show(&mut self, output: Output) -> Result<(), ReplayError> {
        self.moments.show(output)
    }

    /// The container.
    pub fn reader(&self) -> &SessionReader<File> {
        &self.moments.reader
    }

    /// The container, for reading events.
    pub fn reader_mut(&mut self) -> &mut SessionReader<File> {
        &mut self.moments.reader
    }

    /// Scans of the session in time order.
    pub fn stamps(&self) -> &[ReplayStamp] {
        &self.stamps
    }

    /// As [`Moments::scan_at`].
    ///
    /// # Errors
    /// [`ReplayError`] naming the group that cannot be decoded.
    pub fn scan_at(&mut self, time_nanos: u64) -> Result<Scan, ReplayError> {
        self.moments.scan_at(time_nanos)
    }
}

fn group_stamps(
    path: &Path,
    reader: &mut SessionReader<File>,
    header: &StreamHeader,
    group: usize,
) -> Result<Vec<ReplayStamp>, ReplayError> {
    let stored = reader.read_group(group)?;
    let stamps = decode_stamps(header, &stored.geometry).map_err(|source| ReplayError::Payload {
        path: path.into(),
        group,
        source,
    })?;
    let key = stored.entry.key_tick;
    Ok(stamps.iter().map(|s| ReplayStamp { tick: s.tick, time_nanos: s.time_nanos, is_key: s.tick == key }).collect())
}

/// How a session ends, in words.
pub fn describe(state: &SessionState) -> String {
    match state {
        SessionState::Clean => "finished".into(),
        SessionState::Unfinished { complete_groups, valid_bytes, reason } => {
            format!("unfinished: {complete_groups} complete groups in the first {valid_bytes} bytes; {reason}")
        }
    }
}
