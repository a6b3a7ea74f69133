//! Raw recording beside whatever else is done with the pictures: a camera that passes on what it sees.

use super::capture::{CaptureItem, capture};
use super::flow::Outlet;
use super::record::RecordError;
use super::{DropCounts, FrameSet, FrameSetAssembler, Monitor};
use crate::device::{self, Camera, CameraInfo, CameraSettings, DeviceError, Frame, Rig, RigConfig};
use crate::light::Calibration;
use gv3_protocol::raw::{FaultCode, RawError, RawStamp, RawWriter};
use serde::Serialize;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tracing::{error, warn};

/// Pictures that wait for the disk: 0.7 s of 180 pictures/s, 39 MB of 640x480.
const QUEUE: usize = 128;

/// What a raw recording did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RawRecorded {
    /// Pictures written.
    pub pictures: u64,
    /// Bytes written.
    pub bytes: u64,
    /// Pixels of the pictures written, bytes.
    pub pixel_bytes: u64,
    /// Pictures left out because the disk was too slow.
    pub dropped_by_queue: u64,
    /// Pictures left out after writing failed.
    pub dropped_by_disk: u64,
    /// Mean time to code and write a picture, milliseconds.
    pub ms_per_picture: f64,
    /// Why writing failed.
    pub error: Option<String>,
}

impl RawRecorded {
    /// Whether every picture is in the recording.
    pub fn is_complete(&self) -> bool {
        self.dropped_by_queue + self.dropped_by_disk == 0 && self.error.is_none()
    }
}

enum Entry {
    Frame(Frame),
    Fault(FaultCode, u64, String),
}

/// Where a camera's pictures can be had while it runs.
#[derive(Clone, Default)]
pub struct RawTap(Arc<Mutex<Option<Tapped>>>);

/// Whoever takes the pictures.
struct Tapped {
    queue: SyncSender<Entry>,
    dropped: Arc<AtomicU64>,
}

impl RawTap {
    /// Puts a tap behind a rig's camera.
    pub fn attach(rig: Rig) -> (Rig, Self) {
        let tap = Self::default();
        let waits = rig.camera.info().waits_for_reader;
        let tee = RawTee { inner: rig.camera, tap: tap.clone(), waits, last: (0, Instant::now()) };
        (Rig { camera: Box::new(tee), ..rig }, tap)
    }

    fn tapped(&self) -> MutexGuard<'_, Option<Tapped>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Writes what a rig's camera gives into a folder, in a thread of its own.
pub struct RawRecorder {
    tap: RawTap,
    thread: JoinHandle<RawRecorded>,
}

impl RawRecorder {
    /// Begins a recording in an empty or new `folder` of all that the rig's camera will give. `config` is stored in it, with
    /// the calibration in place.
    ///
    /// # Errors
    /// [`RecordError::Raw`] when the folder cannot be used.
    pub fn attach(rig: Rig, config: &RigConfig, folder: &Path) -> Result<(Rig, Self), RecordError> {
        let calibration = rig.calibration;
        let (rig, tap) = RawTap::attach(rig);
        Self::begin(&tap, calibration, config, folder).map(|recorder| (rig, recorder))
    }

    /// As [`Self::attach`], of a camera with a tap, from its next picture on.
    ///
    /// # Errors
    /// [`RecordError::Raw`] when the folder cannot be used.
    pub fn begin(
        tap: &RawTap,
        calibration: Calibration,
        config: &RigConfig,
        folder: &Path,
    ) -> Result<Self, RecordError> {
        let mut stored = config.clone();
        (stored.calibration_file, stored.calibration) = (None, Some(calibration));
        let text = toml::to_string(&stored).map_err(|e| RawError::Usage(format!("the configuration: {e}")))?;
        let created = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
        let writer = RawWriter::create(folder, &text, created)?;
        let (queue, entries) = sync_channel(QUEUE);
        let dropped = Arc::new(AtomicU64::new(0));
        let seen = Arc::clone(&dropped);
        let thread = std::thread::Builder::new()
            .name("gv3-raw".into())
            .spawn(move || write_all(writer, &entries, &seen))
            .map_err(|_| RecordError::Stage("raw"))?;
        *tap.tapped() = Some(Tapped { queue, dropped });
        Ok(Self { tap: tap.clone(), thread })
    }

    /// Takes no more pictures and waits until those it has are on disk.
    ///
    /// # Errors
    /// [`RecordError::Stage`] when the writing thread died.
    pub fn finish(self) -> Result<RawRecorded, RecordError> {
        self.tap.tapped().take();
        self.thread.join().map_err(|_| RecordError::Stage("raw"))
    }
}

fn write_all(mut writer: RawWriter, entries: &Receiver<Entry>, dropped: &AtomicU64) -> RawRecorded {
    let (mut failure, mut dropped_by_disk, mut pixel_bytes) = (None, 0, 0);
    let mut busy = Duration::ZERO;
    while let Ok(entry) = entries.recv() {
        if failure.is_some() {
            dropped_by_disk += u64::from(matches!(entry, Entry::Frame(_)));
            continue;
        }
        let begin = Instant::now();
        let written = match &entry {
            Entry::Fault(code, host_time_nanos, message) => writer.fault(*code, *host_time_nanos, message),
            Entry::Frame(frame) => writer.picture(&stamp(frame), size_px(frame), &frame.picture.pixels),
        };
        busy += begin.elapsed();
        match (written, entry) {
            (Ok(()), Entry::Frame(frame)) => pixel_bytes += frame.picture.pixels.len() as u64,
            (Ok(()), Entry::Fault(..)) => {}
            (Err(reason), entry) => {
                error!(%reason, "raw recording ends here; what is written stays readable");
                dropped_by_disk += u64::from(matches!(entry, Entry::Frame(_)));
                failure = Some(reason.to_string());
            }
        }
    }
    let (pictures, bytes) = (writer.pictures(), writer.bytes());
    let dropped_by_queue = dropped.load(Ordering::Relaxed);
    let ms_per_picture = busy.as_secs_f64() * 1e3 / pictures.max(1) as f64;
    let error = failure.or_else(|| writer.finish(dropped_by_queue).err().map(|e| e.to_string()));
    RawRecorded { pictures, bytes, pixel_bytes, dropped_by_queue, dropped_by_disk, ms_per_picture, error }
}

fn stamp(frame: &Frame) -> RawStamp {
    RawStamp {
        sequence: frame.sequence,
        pattern: frame.pattern.0,
        device_time_nanos: frame.device_time_nanos,
        host_time_nanos: frame.host_time_nanos,
        exposure_nanos: frame.exposure_nanos,
    }
}

fn size_px(frame: &Frame) -> [u32; 2] {
    [frame.picture.width_px, frame.picture.height_px]
}

/// A camera whose frames and faults go to the recorder too, while there is one.
struct RawTee {
    inner: Box<dyn Camera>,
    tap: RawTap,
    /// Nothing is lost by letting the camera wait.
    waits: bool,
    /// Host time of the last frame, nanoseconds, and when it was passed on.
    last: (u64, Instant),
}

impl RawTee {
    fn record(&mut self, entry: impl FnOnce() -> Entry) {
        let tapped = self.tap.tapped();
        let Some(Tapped { queue, dropped }) = &*tapped else { return };
        let sent = match self.waits {
            true => queue.send(entry()).map_err(|_| ()),
            false => queue.try_send(entry()).map_err(|_| ()),
        };
        if sent.is_err() && dropped.fetch_add(1, Ordering::Relaxed) == 0 {
            warn!("the disk is too slow for the raw recording: pictures are left out and counted");
        }
    }
}

impl Camera for RawTee {
    fn info(&self) -> CameraInfo {
        self.inner.info()
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        self.inner.configure(want)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        self.inner.start()
    }

    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        let result = self.inner.next_frame(deadline);
        let host_nanos = self.last.0.saturating_add(self.last.1.elapsed().as_nanos() as u64);
        let (code, message) = match &result {
            Ok(frame) => {
                self.last = (frame.host_time_nanos, Instant::now());
                self.record(|| Entry::Frame(frame.clone()));
                return result;
            }
            // The end of a recording that is recorded again is no fault, nor is a call out of order.
            Err(DeviceError::Ended(_) | DeviceError::State(_)) => return result,
            Err(DeviceError::Timeout(reason)) => (FaultCode::Timeout, reason.clone()),
            Err(DeviceError::Disconnected(device)) => (FaultCode::Disconnected, device.clone()),
            Err(other) => (FaultCode::Other, other.to_string()),
        };
        self.record(|| Entry::Fault(code, host_nanos, message));
        result
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.inner.stop()
    }
}

/// Runs a rig for its raw recording alone; returns complete frame sets and what was wrong with the others.
///
/// # Errors
/// [`RecordError`] of the devices.
pub fn run_rig(
    rig: Rig,
    scan_periods: Option<u64>,
    stop: &AtomicBool,
    progress: &AtomicU64,
) -> Result<(u64, DropCounts), RecordError> {
    let (out, mut sets) = tokio::sync::mpsc::channel::<CaptureItem>(4);
    let monitor = Arc::new(Monitor::default());
    std::thread::scope(|scope| {
        let outlet = Outlet::new(out, None, Arc::clone(&monitor));
        let capture = scope.spawn(|| capture(rig, scan_periods, stop, outlet, &monitor));
        let mut count = 0;
        while let Some(item) = sets.blocking_recv() {
            count += u64::from(item.is_set());
            progress.store(count, Ordering::Relaxed);
        }
        let captured = capture.join().map_err(|_| RecordError::Stage("capture"))??;
        Ok((count, captured.drops))
    })
}

/// The frame sets of a raw recording.
pub struct RawSets {
    rig: Rig,
    assembler: FrameSetAssembler,
}

impl RawSets {
    /// Plays the recording that a configuration names, from its beginning.
    ///
    /// # Errors
    /// [`DeviceError`] of the recorded devices.
    pub fn open(config: &RigConfig) -> Result<Self, DeviceError> {
        let mut rig = device::open(config)?;
        rig.camera.configure(&config.camera_settings())?;
        rig.projector.load(&rig.sequence)?;
        rig.camera.start()?;
        rig.projector.play(&rig.timing)?;
        let assembler = FrameSetAssembler::new(&rig.sequence, &rig.timing);
        Ok(Self { rig, assembler })
    }

    /// The rig, for its calibration, sequence and limits.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The next complete set, `None` at the end; faults of the camera are passed over.
    ///
    /// # Errors
    /// [`DeviceError`] when the recording cannot be read.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>, DeviceError> {
        loop {
            // A recording at its fastest pace never waits, so the deadline does not matter.
            match self.rig.camera.next_frame(Instant::now() + Duration::from_secs(60)) {
                Ok(frame) => {
                    if let Some(set) = self.assembler.push(frame) {
                        return Ok(Some(set));
                    }
                }
                Err(DeviceError::Ended(_)) => return Ok(None),
                Err(DeviceError::Disconnected(_)) => self.assembler.restart(),
                Err(DeviceError::Timeout(_) | DeviceError::Failed(_)) => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// What was dropped, an open set at the end included.
    pub fn finish(mut self) -> DropCounts {
        self.assembler.finish()
    }
}
