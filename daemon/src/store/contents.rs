//! What session files hold, read without decoding a surface.

use super::StoreError;
use crate::measure::Output;
use crate::replay::ReplayError;
use gv3_codec::{StreamHeader, decode_stamps};
use gv3_protocol::session::{Event, EventKind, SessionReader, SessionState, key};
use serde::Serialize;
use serde_json::{Map, Value};
use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

/// Figures of one session file.
#[derive(Debug, Clone, PartialEq)]
pub struct FileContents {
    /// Whether it ends with an intact summary.
    pub is_finished: bool,
    /// Coding mode.
    pub mode: String,
    /// What can be shown of it, the usual first.
    pub outputs: &'static [Output],
    /// When it was begun, nanoseconds since 1970.
    pub created_unix_nanos: Option<u64>,
    /// Scans.
    pub scans: u64,
    /// Keyframes.
    pub keyframes: u64,
    /// Tick of the first scan.
    pub first_tick: u64,
    /// Tick of the last scan.
    pub last_tick: u64,
    /// Nanoseconds of one tick.
    pub period_nanos: u64,
    /// Size of the same scans as OBJ and BMP files, bytes, where it is known.
    pub obj_bmp_bytes: Option<u64>,
    /// Error that the coding was told is worth correcting, mm, where the mode has one.
    pub tolerance_mm: Option<f64>,
}

impl FileContents {
    /// Reads the index; where the file has no statistics, the stamps of its groups too.
    ///
    /// # Errors
    /// [`StoreError::Session`] when it is no session, [`StoreError::Replay`] when a group's stamps do not decode.
    pub fn read(path: &Path) -> Result<Self, StoreError> {
        let mut reader = SessionReader::open(path)?;
        let statistics = reader.metadata().statistics();
        let number = |name| statistics.and_then(|s| s.number::<u64>(name));
        let (stored_scans, obj_bmp_bytes) = (number(key::SCANS), number(key::RAW_OBJ_BMP_BYTES));
        let session = reader.metadata().group(key::SESSION);
        let mode = session.and_then(|s| s.get(key::MODE)).unwrap_or("unknown").to_owned();
        let tolerance_mm = session.and_then(|s| s.number(key::TOLERANCE_MM)).filter(|mm: &f64| mm.is_finite());
        let created_unix_nanos = session.and_then(|s| s.number(key::CREATED_UNIX_NANOS)).filter(|&nanos| nanos > 0);
        let (period_nanos, outputs): (u64, &[Output]) = match reader.streams().is_empty() {
            true => (0, &[]),
            false => {
                let header = header(path, &mut reader, 0)?;
                (header.scan_period_nanos, Output::of(header.mode))
            }
        };
        let groups = reader.groups();
        let ends = groups.first().zip(groups.last()).map_or((0, 0), |(a, b)| (a.first_tick, b.key_tick));
        let keyframes = groups.len() as u64;
        let scans = match stored_scans {
            Some(scans) => scans,
            None => group_figures(path, &mut reader, 0)?.iter().map(|g| g.ticks.len() as u64).sum(),
        };
        Ok(Self {
            is_finished: *reader.state() == SessionState::Clean,
            mode,
            outputs,
            created_unix_nanos,
            scans,
            keyframes,
            first_tick: ends.0,
            last_tick: ends.1,
            period_nanos,
            obj_bmp_bytes,
            tolerance_mm,
        })
    }
}

/// One group of a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct GroupFigures {
    /// Tick of its keyframe.
    pub key_tick: u64,
    /// Bytes of geometry and texture.
    pub bytes: u64,
    /// Scans.
    pub scans: u64,
    /// Ticks of the scans, increasing; the keyframe's is the last.
    #[serde(skip)]
    pub ticks: Vec<u64>,
}

/// Everything about a session that is listed when it is opened.
#[derive(Debug, Clone, Default, Serialize)]
pub struct SessionDetail {
    /// Tick of the first scan.
    pub first_tick: u64,
    /// Tick of the last scan.
    pub last_tick: u64,
    /// Nanoseconds of one tick.
    pub period_nanos: u64,
    /// Events, each with `tick`, `time_nanos`, `kind` and what belongs to the kind.
    pub events: Vec<Value>,
    /// Scans and frame sets left out, by cause.
    pub drops: BTreeMap<String, u64>,
    /// Ticks from first to last that have no scan.
    pub missing_ticks: u64,
    /// Groups in time order.
    pub groups: Vec<GroupFigures>,
}

/// Bytes scan by scan: a group's bytes are shared evenly among its scans, what does not divide goes to the keyframe.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Curve {
    /// Ticks of the scans.
    pub ticks: Vec<u64>,
    /// Bytes of each.
    pub bytes: Vec<u64>,
    /// Whether each is a keyframe.
    pub is_key: Vec<bool>,
}

/// What every group of one file holds, and its events.
#[derive(Debug, Clone, Default)]
pub struct FileGroups {
    period_nanos: u64,
    groups: Vec<GroupFigures>,
    events: Vec<Event>,
}

impl FileGroups {
    /// Reads all groups.
    ///
    /// # Errors
    /// As [`FileContents::read`].
    pub fn read(path: &Path) -> Result<Self, StoreError> {
        let mut groups = Self::default();
        groups.add_from(0, path, &mut SessionReader::open(path)?)?;
        Ok(groups)
    }

    /// Adds what a reader has found at `offset` of its file and after it.
    pub(super) fn add_from(
        &mut self,
        offset: u64,
        path: &Path,
        reader: &mut SessionReader<File>,
    ) -> Result<(), StoreError> {
        if !reader.streams().is_empty() {
            self.period_nanos = header(path, reader, 0)?.scan_period_nanos;
        }
        self.groups.extend(group_figures(path, reader, self.groups.len())?);
        self.events.extend(reader.events_from(offset)?);
        Ok(())
    }

    /// Scans and events.
    pub fn entries(&self) -> u64 {
        self.groups.iter().map(|g| g.scans).sum::<u64>() + self.events.len() as u64
    }
}

impl SessionDetail {
    /// Of a session's files in time order.
    pub fn of(files: &[Arc<FileGroups>]) -> Self {
        let mut detail = Self::default();
        for file in files {
            detail.period_nanos = file.period_nanos;
            detail.groups.extend_from_slice(&file.groups);
            for event in &file.events {
                if let EventKind::Drop { cause, count } = &event.kind {
                    *detail.drops.entry(cause.clone()).or_default() += count;
                }
                detail.events.push(event_value(event));
            }
        }
        let ends = detail.groups.first().zip(detail.groups.last());
        if let Some((first, last)) = ends.and_then(|(a, b)| a.ticks.first().copied().zip(Some(b.key_tick))) {
            let scans: u64 = detail.groups.iter().map(|g| g.scans).sum();
            (detail.first_tick, detail.last_tick) = (first, last);
            detail.missing_ticks = (last.saturating_sub(first) + 1).saturating_sub(scans);
        }
        detail
    }
}

impl Curve {
    /// Of a session's files in time order.
    pub fn of(files: &[Arc<FileGroups>]) -> Self {
        let mut curve = Self::default();
        for group in files.iter().flat_map(|file| &file.groups) {
            let share = group.bytes / group.scans.max(1);
            for &tick in &group.ticks {
                let is_key = tick == group.key_tick;
                curve.ticks.push(tick);
                curve.bytes.push(if is_key { group.bytes - share * (group.scans - 1) } else { share });
                curve.is_key.push(is_key);
            }
        }
        curve
    }
}

fn header(path: &Path, reader: &mut SessionReader<File>, stream: usize) -> Result<StreamHeader, StoreError> {
    let bytes = reader.read_stream(stream)?;
    Ok(StreamHeader::decode(&bytes)
        .map_err(|e| ReplayError::Content { path: path.into(), reason: format!("stream header {stream}: {e}") })?)
}

/// Of the groups from number `first` on.
fn group_figures(path: &Path, reader: &mut SessionReader<File>, first: usize) -> Result<Vec<GroupFigures>, StoreError> {
    let streams = reader.streams().to_vec();
    let mut figures = Vec::with_capacity(reader.groups().len() - first);
    for (at, stream) in streams.iter().enumerate() {
        let end = streams.get(at + 1).map_or(reader.groups().len(), |next| next.first_group);
        if end <= first {
            continue;
        }
        let header = header(path, reader, at)?;
        for group in stream.first_group.max(first)..end {
            let stored = reader.read_group(group)?;
            let stamps = decode_stamps(&header, &stored.geometry).map_err(|source| ReplayError::Payload {
                path: path.into(),
                group,
                source,
            })?;
            let (entry, ticks) = (stored.entry, stamps.iter().map(|s| s.tick).collect::<Vec<_>>());
            let bytes = entry.geometry_bytes + entry.texture_bytes;
            figures.push(GroupFigures { key_tick: entry.key_tick, bytes, scans: ticks.len() as u64, ticks });
        }
    }
    Ok(figures)
}

/// An event as the interface shows it: its kind under `kind`.
pub fn event_value(event: &impl Serialize) -> Value {
    let mut fields = match serde_json::to_value(event) {
        Ok(Value::Object(fields)) => fields,
        _ => Map::new(),
    };
    if let Some(kind) = fields.remove("event") {
        fields.insert("kind".into(), kind);
    }
    Value::Object(fields)
}
