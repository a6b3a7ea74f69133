//! A recording in the foreground: the whole pipeline for one session.

use super::flow::Captured;
use super::monitor::Monitor;
use super::recording::{Closed, GroupSink, Progress, Recording, SegmentLimits};
use super::stages::{Pipeline, PipelineSettings};
use super::{DropCounts, Reconstructor};
use crate::device::{DeviceError, Rig};
use crate::light::{LightError, RejectedPixels};
use gv3_codec::{CodecError, EncodedGroup, EncoderConfig, StreamHeader};
use gv3_protocol::session::{
    Event, GroupRecord, MetadataGroup, SessionError, SessionFile, SessionMetadata, SessionWriter, SyncData,
};
use std::io::{Seek, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64};

pub use super::recording::ScanObserver;

/// Why a recording ended early. What was complete before is in the file.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// A device failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// Reconstruction cannot work with this rig.
    #[error(transparent)]
    Light(#[from] LightError),
    /// The encoder refused its input.
    #[error(transparent)]
    Codec(#[from] CodecError),
    /// The session could not be written.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A file that was closed is not what was written.
    #[error("{}: {reason}", path.display())]
    Verify {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The raw recording could not be begun.
    #[error(transparent)]
    Raw(#[from] gv3_protocol::raw::RawError),
    /// The caller's observer failed.
    #[error("{0}")]
    Observer(String),
    /// A stage could not be started or died.
    #[error("stage {0} ended unexpectedly")]
    Stage(&'static str),
}

/// How to record.
pub struct RecordSettings {
    /// Scan periods to record; until told to stop when none.
    pub scan_periods: Option<u64>,
    /// Encoder settings.
    pub encoder: EncoderConfig,
    /// Called with every scan.
    pub observer: ScanObserver,
    /// Set to end the recording; what is on its way is finished.
    pub stop: Arc<AtomicBool>,
    /// Scans encoded so far, for progress.
    pub progress: Arc<AtomicU64>,
}

/// What a recording did.
#[derive(Debug, Clone, Default, serde::Serialize)]
pub struct Recorded {
    /// Complete frame sets.
    pub frame_sets: u64,
    /// Frame sets dropped, by cause.
    pub drops: DropCounts,
    /// Pixels rejected in all scans, by cause.
    pub rejected_pixels: RejectedPixels,
    /// Scans that the encoder could not use.
    pub unusable_scans: u64,
    /// Scans in the session.
    pub scans: u64,
    /// Keyframes in the session.
    pub keyframes: u64,
    /// Mean reconstruction time, milliseconds a scan.
    pub reconstruct_ms_per_scan: f64,
    /// Mean encoding time, milliseconds a scan.
    pub encode_ms_per_scan: f64,
    /// What the pictures took, bytes.
    pub raw_fringe_bytes: u64,
}

/// Records until the wanted length, the stop flag, or an error; the session is finished in every case where the file can
/// still be written.
///
/// # Errors
/// [`RecordError`] of the first stage that failed.
pub async fn record(
    rig: Rig,
    settings: RecordSettings,
    writer: SessionWriter<SessionFile>,
) -> Result<Recorded, RecordError> {
    let (done, result) = tokio::sync::oneshot::channel();
    let work = move || {
        // Who waited may have given up.
        let _ = done.send(record_here(rig, settings, writer));
    };
    std::thread::Builder::new().name("gv3-record".into()).spawn(work).map_err(|_| RecordError::Stage("record"))?;
    result.await.unwrap_or(Err(RecordError::Stage("record")))
}

fn record_here(
    rig: Rig,
    settings: RecordSettings,
    writer: SessionWriter<SessionFile>,
) -> Result<Recorded, RecordError> {
    let recording = Recording {
        encoder: settings.encoder,
        limits: SegmentLimits::default(),
        observer: settings.observer,
        sink: Box::new(FileSink { writer: Some(writer) }),
        progress: Arc::new(Progress { encoded: settings.progress, ..Progress::default() }),
        abort: Arc::clone(&settings.stop),
    };
    let running = PipelineSettings {
        scan_periods: settings.scan_periods,
        is_live: !rig.camera.info().waits_for_reader,
        stop: settings.stop,
        monitor: Arc::new(Monitor::default()),
    };
    let reconstructor = Reconstructor::of(&rig)?;
    let mut pipeline = Pipeline::start(rig, reconstructor, running, Some(recording))?;
    let (cause, captured) = match pipeline.wait() {
        Ok(captured) => (None, captured),
        Err(error) => (Some(error), Captured::default()),
    };
    let ended = pipeline.end_after(cause, captured);
    let ended = ended.and_then(|reply| reply.recv().unwrap_or(Err(RecordError::Stage("write"))));
    pipeline.finish()?;
    ended.map(|ended| ended.recorded)
}

/// One session file.
struct FileSink {
    writer: Option<SessionWriter<SessionFile>>,
}

impl FileSink {
    fn writer(&mut self) -> Result<&mut SessionWriter<SessionFile>, RecordError> {
        self.writer.as_mut().ok_or(RecordError::Stage("write"))
    }
}

impl GroupSink for FileSink {
    fn begin(&mut self, header: &StreamHeader) -> Result<(), RecordError> {
        Ok(self.writer()?.write_stream(&header.encode())?)
    }

    fn group(&mut self, group: &EncodedGroup, events: &[Event]) -> Result<(), RecordError> {
        Ok(write_group(self.writer()?, group, events)?)
    }

    fn end(&mut self, events: &[Event], statistics: &MetadataGroup) -> Result<(), RecordError> {
        let mut writer = self.writer.take().ok_or(RecordError::Stage("write"))?;
        events.iter().try_for_each(|event| writer.write_event(event))?;
        writer.finish(statistics)?;
        Ok(())
    }

    fn closed(&self) -> Closed {
        Closed::default()
    }
}

/// Metadata of a session of scans coded in this way, begun `created_unix_nanos` after 1970-01-01 UTC.
pub fn session_metadata(encoder: &EncoderConfig, created_unix_nanos: u64) -> SessionMetadata {
    let producer = concat!("gv3 ", env!("CARGO_PKG_VERSION"));
    let metadata = SessionMetadata::new(encoder.header().mode.name(), producer, created_unix_nanos);
    match encoder.tolerance_mm() {
        Some(tolerance_mm) => metadata.with_tolerance_mm(tolerance_mm),
        None => metadata,
    }
}

/// Writes a group with the events since the one before; durable when this returns.
///
/// # Errors
/// As [`SessionWriter::write_group`].
pub fn write_group<W: Write + Seek + SyncData>(
    writer: &mut SessionWriter<W>,
    group: &EncodedGroup,
    events: &[Event],
) -> Result<(), SessionError> {
    writer.write_group(GroupRecord {
        first_tick: group.first.tick,
        key_tick: group.key.tick,
        time_nanos: group.key.time_nanos,
        geometry: &group.geometry,
        texture: group.texture.as_deref(),
        events,
    })
}
