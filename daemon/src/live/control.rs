//! Commands, one at a time: what runs, and how it is started and stopped.

use super::segments::SegmentedSink;
use super::status::ShownRecording;
use super::{Inner, LiveConfig, LiveError, LiveState, RecordingRequest, RecordingStarted, RecordingStopped};
use crate::device::{PacedCamera, Rig};
use crate::light::Calibration;
use crate::pipeline::record::session_metadata;
use crate::pipeline::{
    Ended, Pipeline, PipelineSettings, Progress, RawRecorded, RawRecorder, RawTap, Reconstructor, RecordError,
    Recording, SegmentLimits,
};
use crate::store::{SessionName, StoreError};
use gv3_codec::EncoderConfig;
use gv3_protocol::session::{Event, EventKind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

/// How long a recording may take to be finished: a queue full of scans on a slow machine, a disk that hangs.
const STOP_TIME: Duration = Duration::from_secs(60);
/// Longest mark, bytes.
const MAX_MARK_BYTES: usize = 1000;

/// What runs.
pub(super) struct Control {
    pub config: LiveConfig,
    /// Built when the configuration was checked, for the run that comes next.
    ready: Option<Reconstructor>,
    pub run: Option<Run>,
}

/// A running scanner.
pub(super) struct Run {
    pipeline: Pipeline,
    tap: RawTap,
    calibration: Calibration,
    period_nanos: u64,
    set_bytes: u64,
    recording: Option<Active>,
}

/// A running recording.
struct Active {
    name: SessionName,
    has_scans: bool,
    raw: Option<RawRecorder>,
    raw_folder: PathBuf,
    abort: Arc<AtomicBool>,
}

impl Control {
    pub fn new(config: LiveConfig, reconstructor: Reconstructor) -> Self {
        Self { config, ready: Some(reconstructor), run: None }
    }

    pub fn start_scanner(&mut self, inner: &Inner) -> Result<(), LiveError> {
        if inner.is_shut.load(Ordering::Relaxed) {
            return Err(LiveError::State("the engine is shut down".into()));
        }
        if self.run.as_ref().is_some_and(|run| run.pipeline.is_capturing()) {
            return Ok(());
        }
        // Its pictures have ended, and nobody has looked since.
        self.reap(inner);
        inner.show(LiveState::Starting, None);
        match self.begin_run(inner) {
            Ok(run) => {
                inner.shown().gauge = Some(run.pipeline.gauge());
                self.run = Some(run);
                inner.show(LiveState::Previewing, None);
                Ok(())
            }
            Err(error) => {
                inner.show(LiveState::Failed, Some(error.to_string()));
                Err(error)
            }
        }
    }

    fn begin_run(&mut self, inner: &Inner) -> Result<Run, LiveError> {
        let rig = (inner.ground.open_rig)(&self.config.rig)?;
        let (mut rig, tap) = RawTap::attach(paced(rig));
        rig.silence_limit = Duration::from_secs(self.config.rig.silence_limit_seconds.into());
        let calibration = rig.calibration;
        let patterns = rig.sequence.patterns.len();
        let period_nanos = rig.timing.set_period_nanos(patterns);
        let pixels = u64::from(calibration.camera.width_px) * u64::from(calibration.camera.height_px);
        let settings = PipelineSettings {
            scan_periods: None,
            is_live: true,
            stop: Arc::default(),
            monitor: Arc::clone(&inner.monitor),
        };
        let reconstructor = match self.ready.take() {
            Some(ready) => ready,
            None => Reconstructor::of(&rig).map_err(RecordError::from)?,
        };
        let pipeline = Pipeline::start(rig, reconstructor, settings, None)?;
        let set_bytes = pixels * patterns as u64;
        Ok(Run { pipeline, tap, calibration, period_nanos, set_bytes, recording: None })
    }

    pub fn stop_scanner(&mut self, inner: &Inner) -> Result<(), LiveError> {
        let Some(mut run) = self.run.take() else {
            inner.show(LiveState::Idle, None);
            return Ok(());
        };
        inner.show(LiveState::Stopping, None);
        let recorded = match run.recording.take() {
            Some(active) => finish_recording(&run, active, inner).map(drop),
            None => Ok(()),
        };
        let stopped = run.pipeline.finish().map_err(LiveError::from);
        inner.shown().gauge = None;
        let result = recorded.and(stopped);
        inner.show(LiveState::Idle, result.as_ref().err().map(ToString::to_string));
        result
    }

    pub fn start_recording(&mut self, inner: &Inner, request: RecordingRequest) -> Result<RecordingStarted, LiveError> {
        if let Some(active) = self.run.as_ref().and_then(|run| run.recording.as_ref()) {
            return Err(LiveError::State(format!("{} is being recorded; stop it first", active.name)));
        }
        if !request.scans && !request.raw {
            return Err(LiveError::Text("a recording without scans and without raw pictures holds nothing".into()));
        }
        let folder = self.config.sessions.directory.clone();
        let name = match &request.name {
            Some(name) => free(SessionName::new(name)?, &folder)?,
            None => SessionName::of_time((inner.ground.wall_clock)(), &folder)?,
        };
        self.check_space(inner)?;
        self.start_scanner(inner)?;
        let Some(run) = &mut self.run else { return Err(LiveError::State("the scanner has stopped".into())) };
        let shown = run.begin_recording(inner, &self.config, &name, &request)?;
        inner.shown().recording = Some(shown);
        inner.show(LiveState::Recording, None);
        Ok(RecordingStarted { session: name.to_string() })
    }

    fn check_space(&self, inner: &Inner) -> Result<(), LiveError> {
        let sessions = &self.config.sessions;
        let Some(space) = inner.ground.disk.space(&sessions.directory) else { return Ok(()) };
        let floor_bytes = sessions.floor_bytes(space.total_bytes);
        if space.free_bytes > floor_bytes {
            return Ok(());
        }
        Err(LiveError::Space { path: sessions.directory.clone(), free_bytes: space.free_bytes, floor_bytes })
    }

    pub fn stop_recording(&mut self, inner: &Inner) -> Result<RecordingStopped, LiveError> {
        self.end_recording(inner, None)
    }

    /// Ends the recording; why, when nobody asked for it.
    fn end_recording(&mut self, inner: &Inner, reason: Option<String>) -> Result<RecordingStopped, LiveError> {
        let none = || LiveError::State("nothing is being recorded".into());
        let run = self.run.as_mut().ok_or_else(none)?;
        let active = run.recording.take().ok_or_else(none)?;
        inner.show(LiveState::Stopping, reason.clone());
        let stopped = finish_recording(run, active, inner);
        let error = stopped.as_ref().err().map(ToString::to_string);
        inner.show(LiveState::Previewing, error.or(reason));
        stopped
    }

    pub fn mark(&mut self, inner: &Inner, text: &str) -> Result<u64, LiveError> {
        if text.len() > MAX_MARK_BYTES {
            return Err(LiveError::Text(format!("a mark of {} bytes; at most {MAX_MARK_BYTES}", text.len())));
        }
        let Some(run) = self.run.as_ref().filter(|run| run.recording.is_some()) else {
            return Err(LiveError::State("nothing is being recorded".into()));
        };
        Ok(run.tell(inner, EventKind::Mark { text: text.into() })?)
    }

    pub fn reload(&mut self, inner: &Inner, config: LiveConfig) -> Result<(), LiveError> {
        let reconstructor = config.check()?;
        let directory = &config.sessions.directory;
        std::fs::create_dir_all(directory).map_err(|e| LiveError::disk(directory, format!("cannot make it: {e}")))?;
        let is_recording = self.run.as_ref().is_some_and(|run| run.recording.is_some());
        let is_same_rig = config.rig == self.config.rig;
        if is_recording && (!is_same_rig || *directory != self.config.sessions.directory) {
            let reason = "a recording runs: stop it before the devices or the session directory change";
            return Err(LiveError::State(reason.into()));
        }
        let before = std::mem::replace(&mut self.config, config);
        self.ready = (!is_same_rig || self.run.is_none()).then_some(reconstructor);
        if !is_same_rig && self.run.is_some() {
            let restarted = self.stop_scanner(inner).and_then(|()| self.start_scanner(inner));
            if let Err(error) = restarted {
                (self.config, self.ready) = (before, None);
                // The error is that of the new configuration; the status tells how the old one fares.
                let _ = self.start_scanner(inner);
                return Err(error);
            }
        }
        inner.shown().take_config(&self.config, &*inner.ground.disk);
        Ok(())
    }

    /// Looks after what runs: ended pictures, failed recordings, the free space.
    pub fn look_after(&mut self, inner: &Inner) {
        let Some(run) = &self.run else { return };
        if !run.pipeline.is_capturing() {
            self.reap(inner);
            return;
        }
        let Some(active) = &run.recording else { return };
        if active.abort.load(Ordering::Relaxed) {
            let ended = self.end_recording(inner, None);
            tracing::error!(error = ended.err().map(|e| e.to_string()), "the recording ends here");
        } else if let Err(error) = self.check_space(inner) {
            tracing::error!(%error, "the recording ends here");
            let kind = EventKind::Fault { source: "disk".into(), message: error.to_string() };
            if let Some(run) = &self.run {
                let _ = run.tell(inner, kind);
            }
            let _ = self.end_recording(inner, Some(error.to_string()));
        }
    }

    /// Cleans up after a run whose pictures have ended.
    fn reap(&mut self, inner: &Inner) {
        let Some(mut run) = self.run.take() else { return };
        let recorded = match run.recording.take() {
            Some(active) => finish_recording(&run, active, inner).map(drop),
            None => Ok(()),
        };
        let ended = run.pipeline.finish().map_err(LiveError::from);
        inner.shown().gauge = None;
        let error = ended.as_ref().err().or(recorded.as_ref().err()).map(ToString::to_string);
        inner.show(if ended.is_err() { LiveState::Failed } else { LiveState::Idle }, error);
    }
}

impl Run {
    fn begin_recording(
        &mut self,
        inner: &Inner,
        config: &LiveConfig,
        name: &SessionName,
        request: &RecordingRequest,
    ) -> Result<ShownRecording, LiveError> {
        let folder = &config.sessions.directory;
        let raw_folder = folder.join(name.raw_folder());
        let sink = match request.scans {
            true => Some(self.sink(inner, config, name)?),
            false => None,
        };
        let raw = match request.raw {
            true => Some(RawRecorder::begin(&self.tap, self.calibration, &config.rig, &raw_folder)),
            false => None,
        };
        let raw = raw.transpose().inspect_err(|_| {
            // The session's first file holds nothing yet.
            let _ = std::fs::remove_file(folder.join(name.file(1)));
        })?;
        let (progress, abort) = (Arc::new(Progress::default()), Arc::new(AtomicBool::new(false)));
        if let Some(sink) = sink {
            self.pipeline.begin(Recording {
                encoder: EncoderConfig::new(self.period_nanos),
                limits: self.limits(config),
                observer: Box::new(|_| Ok(())),
                sink: Box::new(sink),
                progress: Arc::clone(&progress),
                abort: Arc::clone(&abort),
            })?;
        }
        self.recording = Some(Active { name: name.clone(), has_scans: request.scans, raw, raw_folder, abort });
        let (session, has_raw, set_bytes) = (name.to_string(), request.raw, self.set_bytes);
        Ok(ShownRecording { session, progress, has_raw, set_bytes })
    }

    fn sink(&self, inner: &Inner, config: &LiveConfig, name: &SessionName) -> Result<SegmentedSink, LiveError> {
        let fail = |e: &dyn std::fmt::Display| LiveError::State(format!("the configuration cannot be stored: {e}"));
        // The time of creation is set with every file.
        let metadata = session_metadata(&EncoderConfig::new(self.period_nanos), 0)
            .with_calibration(&self.calibration.to_toml().map_err(|e| fail(&e))?)
            .with_configuration(&toml::to_string(&config.rig).map_err(|e| fail(&e))?);
        let ground = Arc::clone(&inner.ground);
        Ok(SegmentedSink::create(ground, &config.sessions.directory, name, metadata)?)
    }

    fn limits(&self, config: &LiveConfig) -> SegmentLimits {
        let periods = |seconds: f64| (seconds * 1e9 / self.period_nanos as f64).round().max(1.0) as u64;
        SegmentLimits { periods: config.sessions.segment_seconds.map(periods), bytes: config.sessions.segment_bytes }
    }

    /// Writes down something at the newest frame set; gives its tick.
    fn tell(&self, inner: &Inner, kind: EventKind) -> Result<u64, RecordError> {
        let (tick, time_nanos) = inner.monitor.last_set();
        self.pipeline.tell(Event { time_nanos, tick, kind })?;
        Ok(tick)
    }
}

/// The name, if no session of the folder has it.
fn free(name: SessionName, folder: &Path) -> Result<SessionName, LiveError> {
    if name.is_free(folder)? { Ok(name) } else { Err(StoreError::Exists(name.to_string()).into()) }
}

/// Virtual time is held to the sensor's pace.
fn paced(rig: Rig) -> Rig {
    if !rig.camera.info().waits_for_reader {
        return rig;
    }
    Rig { camera: Box::new(PacedCamera::new(rig.camera)), ..rig }
}

/// Ends a recording in the stages and waits for it.
fn finish_recording(run: &Run, active: Active, inner: &Inner) -> Result<RecordingStopped, LiveError> {
    let begin = Instant::now();
    let reply = if active.has_scans { Some(run.pipeline.end(None)) } else { None };
    let raw = active.raw.map(|raw| raw.finish()).transpose();
    let ended = reply.map(|reply| reply.map_err(LiveError::from).and_then(|reply| wait(&reply))).transpose();
    inner.shown().recording = None;
    let (ended, raw) = (ended?, raw?);
    Ok(stopped(&active.name, &active.raw_folder, ended, raw, begin.elapsed()))
}

fn wait(reply: &Receiver<Result<Ended, RecordError>>) -> Result<Ended, LiveError> {
    match reply.recv_timeout(STOP_TIME) {
        Ok(ended) => Ok(ended?),
        Err(RecvTimeoutError::Timeout) => Err(LiveError::Timeout(STOP_TIME.as_secs())),
        Err(RecvTimeoutError::Disconnected) => Err(RecordError::Stage("write").into()),
    }
}

fn stopped(
    session: &SessionName,
    raw_folder: &Path,
    ended: Option<Ended>,
    raw: Option<RawRecorded>,
    took: Duration,
) -> RecordingStopped {
    let file_name = |path: &Path| path.file_name().map(|n| n.to_string_lossy().into_owned());
    let mut files: Vec<String> = Vec::new();
    let (mut scans, mut keyframes, mut bytes) = (0, 0, 0);
    if let Some(Ended { recorded, closed }) = ended {
        files.extend(closed.files.iter().filter_map(|path| file_name(path)));
        (scans, keyframes, bytes) = (recorded.scans, recorded.keyframes, closed.bytes);
    }
    if let Some(raw) = &raw {
        files.extend(file_name(raw_folder));
        bytes += raw.bytes;
    }
    let verified = raw.as_ref().is_none_or(RawRecorded::is_complete);
    let ms = took.as_secs_f64() * 1e3;
    let session = session.to_string();
    RecordingStopped { session, files, scans, keyframes, bytes, verified, ms, raw }
}
