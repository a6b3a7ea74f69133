//! What the stages do, for those who look on: counts, latencies, the newest picture and scan, what happened.

use super::degrade::Degradation;
use super::latency::{Latencies, LatencySummary};
use super::reconstruct::PhaseMaps;
use crate::device::Frame;
use gv3_codec::{EncodedGroup, GreyPicture, Scan};
use gv3_protocol::session::{Event, EventKind};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{broadcast, watch};

/// Events and groups that wait for a slow reader; it is told how many it missed.
const BROADCAST: usize = 256;
/// Every how many pixels the exposure is looked at.
const EXPOSURE_STRIDE: usize = 17;
/// Grey level from which a pixel is as good as clipped, and below which it tells nothing.
const SATURATED_LEVEL: u8 = 250;
const DARK_LEVEL: u8 = 12;
/// Share of clipped pixels that is too much.
const MOST_SATURATED: f64 = 0.01;
/// The brightest hundredth of all pixels should reach this level.
const BRIGHT_LEVEL: usize = 80;

/// The newest frame set.
#[derive(Debug, Clone)]
pub struct LivePicture {
    /// Sensor time in scan periods.
    pub tick: u64,
    /// Sensor time, nanoseconds since the run began.
    pub time_nanos: u64,
    /// One picture a pattern, in the sequence's order.
    pub frames: Vec<GreyPicture>,
    /// What was decoded of them, when someone asked ([`Monitor::want_maps`]) and the set was reconstructed.
    pub maps: Option<PhaseMaps>,
}

/// The newest scan.
#[derive(Debug, Clone)]
pub struct LiveScan {
    /// Sensor time in scan periods.
    pub tick: u64,
    /// Sensor time, nanoseconds since the run began.
    pub time_nanos: u64,
    /// The surface with its texture.
    pub scan: Scan,
    /// From the arrival of its last picture until now, nanoseconds.
    pub latency_nanos: u64,
}

/// What a piece of a recording is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum LiveGroupKind {
    /// The codec's stream header: a file begins.
    Header = 0,
    /// Geometry of a group.
    Geometry = 1,
    /// Texture of the group before.
    Texture = 2,
}

/// A piece of the running recording that is on disk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LiveGroup {
    /// What it is.
    pub kind: LiveGroupKind,
    /// Tick of the group's first scan.
    pub first_tick: u64,
    /// Tick of its keyframe.
    pub key_tick: u64,
    /// Sensor time of its keyframe, nanoseconds.
    pub time_nanos: u64,
    /// The codec's payload.
    pub payload: Vec<u8>,
}

/// What happened, for those who look on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum LiveEvent {
    /// In the stages; recordings hold it, too.
    Happened(Event),
    /// The scanner's state is another; `event` is `state`.
    State {
        /// Always `state`.
        event: &'static str,
        /// The new state.
        state: &'static str,
        /// What went wrong last.
        error: Option<String>,
    },
}

/// How the pictures are exposed.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ExposureStatus {
    /// Share of pixels that are clipped.
    pub saturated_share: f64,
    /// Share of pixels that are dark in every pattern or in none: background included.
    pub dark_share: f64,
    /// What to do.
    pub hint: ExposureHint,
}

/// Whether to change the exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ExposureHint {
    /// Leave it.
    #[default]
    Ok,
    /// Less light, or a shorter exposure.
    TooBright,
    /// More light, or a longer exposure.
    TooDark,
}

impl ExposureStatus {
    /// Of a sample of the pixels.
    fn of(frames: &[Frame]) -> Self {
        let mut histogram = [0u32; 256];
        for frame in frames {
            frame.picture.pixels.iter().step_by(EXPOSURE_STRIDE).for_each(|&p| histogram[usize::from(p)] += 1);
        }
        let total = f64::from(histogram.iter().sum::<u32>().max(1));
        let share = |levels: &[u32]| f64::from(levels.iter().sum::<u32>()) / total;
        let saturated_share = share(&histogram[usize::from(SATURATED_LEVEL)..]);
        let hint = match (saturated_share > MOST_SATURATED, share(&histogram[BRIGHT_LEVEL..]) < 0.01) {
            (true, _) => ExposureHint::TooBright,
            (_, true) => ExposureHint::TooDark,
            _ => ExposureHint::Ok,
        };
        Self { saturated_share, dark_share: share(&histogram[..usize::from(DARK_LEVEL)]), hint }
    }
}

/// Stages of the pipeline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Pictures to frame sets.
    Capture,
    /// Frame sets to scans.
    Reconstruct,
    /// Scans to groups.
    Encode,
    /// Pictures of groups.
    Pictures,
    /// Groups to disk.
    Write,
}

/// Counters of a pipeline since it was made.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LiveMetrics {
    /// Pictures taken.
    pub pictures: u64,
    /// Complete frame sets.
    pub sets: u64,
    /// Scans reconstructed.
    pub scans: u64,
    /// What was dropped, by cause.
    pub drops: BTreeMap<String, u64>,
    /// From the arrival of a scan's last picture to its mesh.
    pub picture_to_mesh: LatencySummary,
    /// From the arrival of a group's last picture until the group is durable.
    pub group_on_disk: LatencySummary,
    /// Processor time of the stages' threads, seconds: capture (with the simulator's rendering), reconstruct, encode, pictures,
    /// write.
    pub cpu_seconds: [f64; 5],
}

/// Shared between the stages and those who look on.
#[derive(Debug)]
pub struct Monitor {
    pictures: AtomicU64,
    sets: AtomicU64,
    scans: AtomicU64,
    last: Mutex<(u64, u64)>,
    drops: Mutex<BTreeMap<String, u64>>,
    picture_to_mesh: Mutex<Latencies>,
    group_on_disk: Mutex<Latencies>,
    cpu_nanos: [AtomicU64; 5],
    exposure: Mutex<ExposureStatus>,
    degradation: AtomicU8,
    /// A scan could not be the keyframe that is due.
    pub(super) is_key_refused: AtomicBool,
    maps_wanted: AtomicUsize,
    is_scan_wanted: AtomicBool,
    picture: watch::Sender<Option<Arc<LivePicture>>>,
    scan: watch::Sender<Option<Arc<LiveScan>>>,
    header: Mutex<Option<Arc<LiveGroup>>>,
    groups: broadcast::Sender<Arc<LiveGroup>>,
    events: broadcast::Sender<LiveEvent>,
}

impl Default for Monitor {
    fn default() -> Self {
        Self {
            pictures: AtomicU64::new(0),
            sets: AtomicU64::new(0),
            scans: AtomicU64::new(0),
            last: Mutex::default(),
            drops: Mutex::default(),
            picture_to_mesh: Mutex::default(),
            group_on_disk: Mutex::default(),
            cpu_nanos: Default::default(),
            exposure: Mutex::default(),
            degradation: AtomicU8::new(0),
            is_key_refused: AtomicBool::new(false),
            maps_wanted: AtomicUsize::new(0),
            is_scan_wanted: AtomicBool::new(false),
            picture: watch::Sender::new(None),
            scan: watch::Sender::new(None),
            header: Mutex::default(),
            groups: broadcast::Sender::new(BROADCAST),
            events: broadcast::Sender::new(BROADCAST),
        }
    }
}

/// While it lives, frame sets come with their maps.
#[derive(Debug)]
pub struct MapsWanted(Arc<Monitor>);

impl Drop for MapsWanted {
    fn drop(&mut self) {
        self.0.maps_wanted.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Monitor {
    /// The newest frame sets.
    pub fn pictures(&self) -> watch::Receiver<Option<Arc<LivePicture>>> {
        self.picture.subscribe()
    }

    /// Scans as they are asked for by [`Self::want_scan`].
    pub fn scans(&self) -> watch::Receiver<Option<Arc<LiveScan>>> {
        self.scan.subscribe()
    }

    /// Has the next scan be shown. Some ten megabytes are copied for it, so that each is asked for.
    pub fn want_scan(&self) {
        self.is_scan_wanted.store(true, Ordering::Relaxed);
    }

    /// Stream header of the newest file of a recording, for those who come after it was sent.
    pub fn stream_header(&self) -> Option<Arc<LiveGroup>> {
        lock(&self.header).clone()
    }

    /// Groups as they come to be on disk, after the stream header of their file.
    pub fn groups(&self) -> broadcast::Receiver<Arc<LiveGroup>> {
        self.groups.subscribe()
    }

    /// Drops, faults, gaps, marks and changes of state as they happen.
    pub fn events(&self) -> broadcast::Receiver<LiveEvent> {
        self.events.subscribe()
    }

    /// Has frame sets come with their maps for as long as what this returns lives.
    pub fn want_maps(self: &Arc<Self>) -> MapsWanted {
        self.maps_wanted.fetch_add(1, Ordering::Relaxed);
        MapsWanted(Arc::clone(self))
    }

    /// What is left out at the moment.
    pub fn degradation(&self) -> Degradation {
        Degradation::of(self.degradation.load(Ordering::Relaxed))
    }

    /// How the last frame set is exposed.
    pub fn exposure(&self) -> ExposureStatus {
        *lock(&self.exposure)
    }

    /// What was dropped, by cause.
    pub fn drops(&self) -> BTreeMap<String, u64> {
        lock(&self.drops).clone()
    }

    /// Tick and sensor time in nanoseconds of the last complete frame set.
    pub fn last_set(&self) -> (u64, u64) {
        *lock(&self.last)
    }

    /// Picture to mesh of the last scans: median and 99th percentile, milliseconds.
    pub fn recent_latency_ms(&self) -> [f64; 2] {
        lock(&self.picture_to_mesh).recent_ms()
    }

    /// Pictures taken and scans made.
    pub fn pictures_and_scans(&self) -> [u64; 2] {
        [&self.pictures, &self.scans].map(|n| n.load(Ordering::Relaxed))
    }

    /// All counters.
    pub fn metrics(&self) -> LiveMetrics {
        LiveMetrics {
            pictures: self.pictures.load(Ordering::Relaxed),
            sets: self.sets.load(Ordering::Relaxed),
            scans: self.scans.load(Ordering::Relaxed),
            drops: self.drops(),
            picture_to_mesh: lock(&self.picture_to_mesh).summary(),
            group_on_disk: lock(&self.group_on_disk).summary(),
            cpu_seconds: std::array::from_fn(|i| self.cpu_nanos[i].load(Ordering::Relaxed) as f64 * 1e-9),
        }
    }

    pub(super) fn took_picture(&self) {
        self.pictures.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn took_set(&self, tick: u64, time_nanos: u64) {
        self.sets.fetch_add(1, Ordering::Relaxed);
        *lock(&self.last) = (tick, time_nanos);
    }

    pub(super) fn exposed(&self, frames: &[Frame]) {
        *lock(&self.exposure) = ExposureStatus::of(frames);
    }

    pub(super) fn are_maps_wanted(&self) -> bool {
        self.maps_wanted.load(Ordering::Relaxed) > 0
    }

    pub(super) fn is_picture_wanted(&self) -> bool {
        self.picture.receiver_count() > 0
    }

    pub(super) fn show_picture(&self, picture: LivePicture) {
        self.picture.send_replace(Some(Arc::new(picture)));
    }

    /// A scan was made of pictures of which the last arrived at `arrived`; a copy is kept when someone asked for it.
    pub(super) fn show_scan(&self, scan: &Scan, arrived: Instant) {
        let latency = arrived.elapsed();
        self.scans.fetch_add(1, Ordering::Relaxed);
        lock(&self.picture_to_mesh).add(latency);
        if self.is_scan_wanted.swap(false, Ordering::Relaxed) {
            let (tick, time_nanos, latency_nanos) = (scan.tick, scan.time_nanos, latency.as_nanos() as u64);
            self.scan.send_replace(Some(Arc::new(LiveScan { tick, time_nanos, scan: scan.clone(), latency_nanos })));
        }
    }

    pub(super) fn stored(&self, group: EncodedGroup, arrived: Instant) {
        lock(&self.group_on_disk).add(arrived.elapsed());
        let [first_tick, key_tick, time_nanos] = [group.first.tick, group.key.tick, group.key.time_nanos];
        let payloads = [(LiveGroupKind::Geometry, Some(group.geometry)), (LiveGroupKind::Texture, group.texture)];
        for (kind, payload) in payloads {
            let Some(payload) = payload else { continue };
            // Nobody may be listening.
            let _ = self.groups.send(Arc::new(LiveGroup { kind, first_tick, key_tick, time_nanos, payload }));
        }
    }

    pub(super) fn began_file(&self, header: Vec<u8>) {
        let (tick, time_nanos) = self.last_set();
        let kind = LiveGroupKind::Header;
        let header = Arc::new(LiveGroup { kind, first_tick: tick, key_tick: tick, time_nanos, payload: header });
        *lock(&self.header) = Some(Arc::clone(&header));
        let _ = self.groups.send(header);
    }

    pub(super) fn set_degradation(&self, level: Degradation) {
        self.degradation.store(level as u8, Ordering::Relaxed);
    }

    /// Counts and shows something that happened.
    pub(super) fn happened(&self, event: &Event) {
        if let EventKind::Drop { cause, count } = &event.kind {
            self.count_drop(cause, *count);
        }
        let _ = self.events.send(LiveEvent::Happened(event.clone()));
    }

    /// Shows that the state is another.
    pub fn announce(&self, state: &'static str, error: Option<String>) {
        let _ = self.events.send(LiveEvent::State { event: "state", state, error });
    }

    pub(super) fn count_drop(&self, cause: &str, count: u64) {
        *lock(&self.drops).entry(cause.to_owned()).or_default() += count;
    }

    /// Takes over the processor time of the calling thread, which is this stage.
    pub(super) fn used_cpu(&self, stage: Stage, since: Duration) {
        let used = thread_cpu().saturating_sub(since);
        self.cpu_nanos[stage as usize].fetch_add(used.as_nanos() as u64, Ordering::Relaxed);
    }
}

/// Processor time of the calling thread; zero where the system does not tell.
pub(super) fn thread_cpu() -> Duration {
    #[cfg(target_os = "linux")]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
    }
    #[cfg(not(target_os = "linux"))]
    Duration::ZERO
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::PatternIndex;

    fn frames(levels: impl Fn(usize) -> u8) -> Vec<Frame> {
        let picture = GreyPicture::new(100, 100, (0..10_000).map(levels).collect());
        let frame = Frame {
            sequence: 0,
            pattern: PatternIndex(0),
            device_time_nanos: 0,
            host_time_nanos: 0,
            exposure_nanos: 0,
            picture,
        };
        vec![frame]
    }

    #[test]
    fn exposure_hints() {
        let hint = |levels: fn(usize) -> u8| ExposureStatus::of(&frames(levels)).hint;
        assert_eq!(hint(|i| (i % 200) as u8), ExposureHint::Ok);
        assert_eq!(hint(|i| if i % 10 == 0 { 255 } else { 100 }), ExposureHint::TooBright);
        assert_eq!(hint(|_| 30), ExposureHint::TooDark);
        let dark = ExposureStatus::of(&frames(|i| if i % 4 == 0 { 0 } else { 120 }));
        assert!((dark.dark_share - 0.25).abs() < 0.01 && dark.saturated_share == 0.0, "{dark:?}");
    }
}
