//! How things stand, as JSON.

use super::{Disk, ExposureStatus, LiveConfig, Monitor};
use crate::device::Backend;
use crate::pipeline::{Progress, QueueDepths, QueueGauge};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Causes that are shown even when nothing was dropped.
const CAUSES: [&str; 8] = [
    "picture_lost",
    "picture_doubled",
    "picture_late",
    "picture_disordered",
    "picture_stray",
    "queue_reconstruct",
    "queue_encode",
    "degradation_between",
];

/// States of the engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LiveState {
    /// Devices are off.
    Idle,
    /// Devices are being opened.
    Starting,
    /// The scanner runs.
    Previewing,
    /// It runs, and what it sees is recorded.
    Recording,
    /// A recording is being finished, or devices are being stopped.
    Stopping,
    /// Devices failed; `error` tells why.
    Failed,
}

impl LiveState {
    /// As in JSON.
    pub fn name(self) -> &'static str {
        ["idle", "starting", "previewing", "recording", "stopping", "failed"][self as usize]
    }
}

/// The running recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingStatus {
    /// Its name.
    pub session: String,
    /// File being written, from 1.
    pub segment: u64,
    /// Sensor time on disk, seconds.
    pub seconds: f64,
    /// Scans on disk.
    pub scans: u64,
    /// Keyframes on disk.
    pub keyframes: u64,
    /// Bytes of groups on disk.
    pub bytes: u64,
    /// Bytes of pictures for one of them.
    pub ratio: f64,
    /// Whether the camera's pictures are kept.
    pub raw: bool,
}

/// Picture to mesh over the last half minute.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LatencyStatus {
    /// Median, milliseconds.
    pub p50: f64,
    /// 99th percentile, milliseconds.
    pub p99: f64,
}

/// Room for sessions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DiskStatus {
    /// Bytes that can still be written.
    pub free_bytes: u64,
    /// Size of the disk, bytes.
    pub total_bytes: u64,
    /// Bytes that must stay free.
    pub floor_bytes: u64,
    /// How long the running recording can go on as it does; `null` without one.
    pub seconds_left: Option<f64>,
}

/// How things stand.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LiveStatus {
    /// State.
    pub state: LiveState,
    /// What went wrong last; gone when something is started.
    pub error: Option<String>,
    /// Where pictures come from: `simulated`, `recorded` or `hardware`.
    pub source: &'static str,
    /// Name of the rig.
    pub rig: String,
    /// The running recording.
    pub recording: Option<RecordingStatus>,
    /// Scans made lately.
    pub scans_per_second: f64,
    /// Pictures taken lately.
    pub pictures_per_second: f64,
    /// Picture to mesh.
    pub latency_ms: LatencyStatus,
    /// What is left out so that the encoder keeps up: `none`, `no_between_correction` or `no_between_scans`.
    pub degradation: &'static str,
    /// What was dropped since the start, by cause.
    pub drops: BTreeMap<String, u64>,
    /// What waits between the stages.
    pub queues: QueueDepths,
    /// How the pictures are exposed.
    pub exposure: ExposureStatus,
    /// Room for sessions.
    pub disk: DiskStatus,
    /// Since the engine was opened, seconds.
    pub uptime_seconds: f64,
    /// Of the program.
    pub version: &'static str,
}

/// What is known of the running recording.
#[derive(Clone)]
pub(super) struct ShownRecording {
    pub session: String,
    pub progress: Arc<Progress>,
    pub has_raw: bool,
    /// Bytes of the pictures of one scan.
    pub set_bytes: u64,
}

/// What the status shows of the engine.
pub(super) struct Shown {
    pub state: LiveState,
    pub error: Option<String>,
    pub source: &'static str,
    pub rig: String,
    pub folder: PathBuf,
    pub recording: Option<ShownRecording>,
    pub gauge: Option<QueueGauge>,
    /// Pictures and scans a second.
    pub rates: [f64; 2],
    pub disk: DiskStatus,
}

impl Shown {
    pub fn of(config: &LiveConfig, disk: &dyn Disk) -> Self {
        let mut shown = Self {
            state: LiveState::Idle,
            error: None,
            source: "",
            rig: String::new(),
            folder: PathBuf::new(),
            recording: None,
            gauge: None,
            rates: [0.0; 2],
            disk: DiskStatus { free_bytes: 0, total_bytes: 0, floor_bytes: 0, seconds_left: None },
        };
        shown.take_config(config, disk);
        shown
    }

    /// Shows another configuration.
    pub fn take_config(&mut self, config: &LiveConfig, disk: &dyn Disk) {
        self.source = match config.rig.camera.backend {
            Backend::Simulated => "simulated",
            Backend::Recorded => "recorded",
            _ => "hardware",
        };
        (self.rig, self.folder) = (config.rig.name.clone(), config.sessions.directory.clone());
        self.disk.floor_bytes = 0;
        if let Some(space) = disk.space(&self.folder) {
            let floor_bytes = config.sessions.floor_bytes(space.total_bytes);
            self.disk = DiskStatus {
                free_bytes: space.free_bytes,
                total_bytes: space.total_bytes,
                floor_bytes,
                seconds_left: None,
            };
        }
    }

    pub fn status(&self, monitor: &Monitor, uptime: Duration) -> LiveStatus {
        let [p50, p99] = monitor.recent_latency_ms();
        let mut drops: BTreeMap<String, u64> = CAUSES.iter().map(|cause| ((*cause).to_owned(), 0)).collect();
        drops.extend(monitor.drops());
        LiveStatus {
            state: self.state,
            error: self.error.clone(),
            source: self.source,
            rig: self.rig.clone(),
            recording: self.recording.as_ref().map(ShownRecording::status),
            scans_per_second: self.rates[1],
            pictures_per_second: self.rates[0],
            latency_ms: LatencyStatus { p50, p99 },
            degradation: monitor.degradation().name(),
            drops,
            queues: self.gauge.as_ref().map_or_else(QueueDepths::default, QueueGauge::depths),
            exposure: monitor.exposure(),
            disk: self.disk,
            uptime_seconds: uptime.as_secs_f64(),
            version: env!("CARGO_PKG_VERSION"),
        }
    }
}

impl ShownRecording {
    pub fn status(&self) -> RecordingStatus {
        let of = |n: &std::sync::atomic::AtomicU64| n.load(Ordering::Relaxed);
        let p = &self.progress;
        let (scans, bytes) = (of(&p.scans), of(&p.bytes));
        RecordingStatus {
            session: self.session.clone(),
            segment: of(&p.segments).max(1),
            seconds: of(&p.last_nanos).saturating_sub(of(&p.first_nanos)) as f64 * 1e-9,
            scans,
            keyframes: of(&p.keyframes),
            bytes,
            ratio: (scans * self.set_bytes) as f64 / bytes.max(1) as f64,
            raw: self.has_raw,
        }
    }
}
