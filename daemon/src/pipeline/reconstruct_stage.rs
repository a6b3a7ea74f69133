//! Frame sets to scans, in a thread of its own: shows both to those who look, and hands scans on while a recording runs.

use super::degrade::{Degradation, Degrader};
use super::flow::{End, Item, Outlet};
use super::monitor::{LivePicture, Monitor, Stage, thread_cpu};
use super::record::RecordError;
use super::recording::{Rebuilt, Recording};
use super::{FrameSet, Reconstruction, Reconstructor};
use crate::light::RejectedPixels;
use gv3_codec::Scan;
use gv3_protocol::session::{Event, EventKind};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;
use tokio::sync::mpsc::Receiver;
use tracing::{debug_span, warn};

/// Cause of drop: left out so that the encoder can catch up.
pub(super) const LEFT_OUT: &str = "degradation_between";
/// Cause of drop: the set's own frequencies contradict each other.
pub(super) const CONTRADICTORY: &str = "patterns_contradict";
/// Fewer pixels than this say nothing about a whole set.
const LEAST_MEASURED: u64 = 1000;
/// Cause of drop: the queue before the encoder is full.
pub(super) const QUEUE_ENCODE: &str = "queue_encode";

/// The stage.
pub(super) struct ReconstructStage {
    reconstructor: Reconstructor,
    out: Outlet<Scan>,
    monitor: Arc<Monitor>,
    /// None of a pipeline that waits.
    degrader: Option<Degrader>,
    queue: usize,
    rebuilt: Rebuilt,
    recording: Option<Keys>,
}

/// Which scans will be keyframes.
struct Keys {
    interval: u64,
    next_tick: u64,
}

impl ReconstructStage {
    pub fn new(
        reconstructor: Reconstructor,
        out: Outlet<Scan>,
        monitor: Arc<Monitor>,
        is_live: bool,
        queue: usize,
    ) -> Self {
        let degrader = is_live.then(Degrader::new);
        Self { reconstructor, out, monitor, degrader, queue, rebuilt: Rebuilt::default(), recording: None }
    }

    pub fn run(mut self, mut sets: Receiver<Item<FrameSet>>) -> Result<(), RecordError> {
        while let Some(item) = sets.blocking_recv() {
            let cpu = thread_cpu();
            match item {
                Item::Work(set, arrived) => self.set(set, arrived)?,
                Item::Event(event) => self.out.pass_event(event)?,
                Item::Begin(recording) => self.begin(recording)?,
                Item::Segment(header, encoded) => self.out.pass(Item::Segment(header, encoded))?,
                Item::End(end) => self.end(end)?,
            }
            self.monitor.used_cpu(Stage::Reconstruct, cpu);
        }
        Ok(())
    }

    fn begin(&mut self, recording: Box<Recording>) -> Result<(), RecordError> {
        let interval = u64::from(recording.encoder.header().keyframe_interval.max(1));
        self.recording = Some(Keys { interval, next_tick: 0 });
        self.rebuilt = Rebuilt::default();
        self.monitor.is_key_refused.store(false, Ordering::Relaxed);
        self.out.pass(Item::Begin(recording))
    }

    fn end(&mut self, mut end: Box<End>) -> Result<(), RecordError> {
        self.recording = None;
        end.rebuilt = std::mem::take(&mut self.rebuilt);
        if self.degrader.is_some() {
            self.degrader = Some(Degrader::new());
            self.monitor.set_degradation(Degradation::None);
        }
        self.out.pass(Item::End(end))
    }

    fn set(&mut self, set: FrameSet, arrived: Instant) -> Result<(), RecordError> {
        let span = debug_span!("reconstruct", tick = set.tick);
        let _entered = span.enter();
        self.monitor.exposed(&set.frames);
        let is_key = self.is_key(set.tick);
        if self.degrade(&set)? == Degradation::NoBetweenScans && !is_key {
            self.out.drop_work(LEFT_OUT, set.tick, set.time_nanos);
            self.show(set);
            return Ok(());
        }
        let begin = Instant::now();
        let result = self.reconstructor.reconstruct(&set)?;
        self.rebuilt.time += begin.elapsed();
        self.rebuilt.sets += 1;
        self.rebuilt.rejected += result.rejected;
        if is_contradictory(&result) {
            warn!(
                tick = set.tick,
                "these are not the pictures of these patterns; `gv3 doctor` tells by how many they are off"
            );
            self.out.drop_work(CONTRADICTORY, set.tick, set.time_nanos);
            self.show(set);
            return Ok(());
        }
        if let Some(event) = empty_event(&result) {
            self.out.tell(event)?;
        }
        self.monitor.show_scan(&result.scan, arrived);
        self.show_with_maps(set);
        self.hand_on(result.scan, arrived, is_key)
    }

    /// Whether the encoder will want this scan for a keyframe.
    fn is_key(&self, tick: u64) -> bool {
        let is_refused = self.monitor.is_key_refused.load(Ordering::Relaxed);
        self.recording.as_ref().is_none_or(|keys| tick >= keys.next_tick || is_refused)
    }

    /// Scans go on while a recording runs; for a keyframe there is always time.
    fn hand_on(&mut self, scan: Scan, arrived: Instant, is_key: bool) -> Result<(), RecordError> {
        let Some(keys) = &mut self.recording else { return Ok(()) };
        if is_key {
            keys.next_tick = (scan.tick / keys.interval + 1) * keys.interval;
            return self.out.pass(Item::Work(scan, arrived));
        }
        let stamp = (scan.tick, scan.time_nanos);
        self.out.offer(scan, arrived, stamp).map(drop)
    }

    /// The level for this set; a change is told.
    fn degrade(&mut self, set: &FrameSet) -> Result<Degradation, RecordError> {
        let (Some(degrader), Some(_)) = (&mut self.degrader, &self.recording) else { return Ok(Degradation::None) };
        let before = self.monitor.degradation();
        let level = degrader.update(Instant::now(), self.out.depth() as f64 / self.queue as f64);
        if level != before {
            warn!(tick = set.tick, level = level.name(), "degradation");
            self.monitor.set_degradation(level);
            let kind = EventKind::Degradation { level: level.name().into() };
            self.out.tell(Event { time_nanos: set.time_nanos, tick: set.tick, kind })?;
        }
        Ok(level)
    }

    fn show_with_maps(&self, set: FrameSet) {
        let maps = self.monitor.are_maps_wanted().then(|| self.reconstructor.maps());
        self.show_picture(set, maps.flatten());
    }

    fn show(&self, set: FrameSet) {
        self.show_picture(set, None);
    }

    fn show_picture(&self, set: FrameSet, maps: Option<super::reconstruct::PhaseMaps>) {
        if self.monitor.is_picture_wanted() {
            let FrameSet { tick, time_nanos, frames } = set;
            let frames = frames.into_iter().map(|frame| frame.picture).collect();
            self.monitor.show_picture(LivePicture { tick, time_nanos, frames, maps });
        }
    }
}

/// Whether the pictures of a set are not of its patterns. Numbers and times cannot tell that a sensor skipped the first trigger of
/// a run; pictures can: of patterns one further on, two frequencies give phases that have nothing to do with each other. One
/// pixel in five is refused for its fringe order, and of the others less than half make a surface. Noise and motion refuse far
/// less than one in ten; a projector whose gamma is not corrected refuses more, but most of the rest is in its place. A
/// sequence of one period has no such witness.
fn is_contradictory(result: &Reconstruction) -> bool {
    let RejectedPixels { fringe_order, depth_range, unmeshed, .. } = result.rejected;
    let kept = result.scan.mesh.positions_mm.len() as u64;
    let ordered = depth_range + unmeshed + kept;
    let measured = fringe_order + ordered;
    measured >= LEAST_MEASURED && 10 * fringe_order > measured && 2 * kept < ordered
}

/// Says of a scan without a surface what rejected most of its pixels: `empty_scan_low_modulation` when all was dark.
fn empty_event(result: &Reconstruction) -> Option<Event> {
    let Scan { tick, time_nanos, mesh, .. } = &result.scan;
    let (cause, pixels) = result.rejected.main_cause().filter(|_| mesh.triangles.is_empty())?;
    warn!(tick, cause, pixels, "empty scan");
    let kind = EventKind::Drop { cause: format!("empty_scan_{cause}"), count: 1 };
    Some(Event { time_nanos: *time_nanos, tick: *tick, kind })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::{self, Frame, PatternIndex, RigConfig};
    use gv3_codec::GreyPicture;
    use std::time::Duration;

    /// What becomes of six pictures in a row, from any place in two sets of the simulator's.
    #[test]
    fn pictures_of_other_patterns_are_told_by_what_they_show() {
        for (projector_gamma, velocity_mm_s) in [(1.0, [0.0; 3]), (2.2, [0.0; 3]), (1.0, [150.0, 0.0, 150.0])] {
            let mut config = RigConfig::simulated();
            (config.sim.projector_gamma, config.sim.velocity_mm_s) = (projector_gamma, velocity_mm_s);
            let mut rig = device::open(&config).unwrap();
            rig.camera.configure(&config.camera_settings()).unwrap();
            rig.projector.load(&rig.sequence).unwrap();
            rig.camera.start().unwrap();
            rig.projector.play(&rig.timing).unwrap();
            let mut next = || rig.camera.next_frame(Instant::now() + Duration::from_secs(20)).unwrap();
            let frames: Vec<Frame> = (0..12).map(|_| next()).collect();
            let mut reconstructor = Reconstructor::new(&rig.calibration, &rig.sequence, &rig.limits).unwrap();
            for skipped in 0..=6 {
                let set = FrameSet { tick: 0, time_nanos: 0, frames: frames[skipped..skipped + 6].to_vec() };
                let result = reconstructor.reconstruct(&set).unwrap();
                let is_other = skipped % 6 != 0;
                assert_eq!(
                    is_contradictory(&result),
                    is_other,
                    "{skipped} skipped, gamma {projector_gamma}: {:?}",
                    result.rejected
                );
            }
        }
    }

    #[test]
    fn a_set_all_dark_or_clipped_is_an_event_by_its_cause() {
        let config = RigConfig::simulated();
        let calibration = config.calibration().unwrap();
        let mut reconstructor = Reconstructor::new(&calibration, &config.sequence, &config.limits).unwrap();
        for (level, cause) in [(0, "empty_scan_low_modulation"), (255, "empty_scan_saturated")] {
            let frame = |n: u16| Frame {
                sequence: u64::from(n),
                pattern: PatternIndex(n),
                device_time_nanos: 0,
                host_time_nanos: 0,
                exposure_nanos: 0,
                picture: GreyPicture::filled(640, 480, level),
            };
            let set = FrameSet { tick: 7, time_nanos: 9, frames: (0..6).map(frame).collect() };
            let event = empty_event(&reconstructor.reconstruct(&set).unwrap()).unwrap();
            let kind = EventKind::Drop { cause: cause.into(), count: 1 };
            assert_eq!(event, Event { time_nanos: 9, tick: 7, kind });
        }
    }
}
