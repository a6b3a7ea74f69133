//! The pipeline: capture, reconstruct, encode, pictures and write, each in a named thread, joined by bounded queues. The scanner runs with
//! or without a recording; a recording begins and ends in the stream of what travels down the queues, so that it has exactly
//! the scans between the two.

use super::capture::capture;
use super::encode_stage::EncodeStage;
use super::flow::{Captured, End, Ended, Item, Outlet};
use super::monitor::Monitor;
use super::picture_stage::PictureStage;
use super::reconstruct_stage::{QUEUE_ENCODE, ReconstructStage};
use super::record::RecordError;
use super::recording::{Encoded, Rebuilt, Recording};
use super::write_stage::WriteStage;
use super::{FrameSet, Reconstructor};
use crate::device::Rig;
use crate::light::DepthRange;
use gv3_codec::{EncodedGroup, Scan};
use gv3_protocol::session::Event;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc as replies;
use std::thread::JoinHandle;
use tokio::sync::mpsc::{Sender, WeakSender, channel};
use tracing::info;

/// Frame sets that wait for reconstruction: 15 MB of six pictures of 640x480.
const SETS: usize = 8;
/// Scans that wait for the encoder while it codes a keyframe with all that came before it: a second, some 5 MB each.
const SCANS: usize = 32;
/// Groups that wait for their pictures to be coded, some 30 MB each: the encoder waits then, and scans before it.
const CODED: usize = 1;
/// Groups that wait for the disk: ten seconds.
const GROUPS: usize = 32;
/// Cause of drop: the queue before reconstruction is full.
pub(super) const QUEUE_RECONSTRUCT: &str = "queue_reconstruct";

/// How a pipeline runs.
pub struct PipelineSettings {
    /// Scan periods to run; until told to stop when none.
    pub scan_periods: Option<u64>,
    /// The camera does not wait for its reader: what finds no room is dropped and counted, and never holds it up.
    pub is_live: bool,
    /// Set to end the run.
    pub stop: Arc<AtomicBool>,
    /// Kept up to date.
    pub monitor: Arc<Monitor>,
}

/// Items in the queues before reconstruction, encoding and writing.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct QueueDepths {
    /// Frame sets.
    pub sets: usize,
    /// Scans.
    pub scans: usize,
    /// Groups, those that wait for their pictures to be coded among them.
    pub groups: usize,
}

/// Looks at a pipeline's queues; they are empty when it has ended.
#[derive(Clone)]
pub struct QueueGauge {
    sets: WeakSender<Item<FrameSet>>,
    scans: WeakSender<Item<Scan>>,
    coded: WeakSender<Item<EncodedGroup>>,
    groups: WeakSender<Item<EncodedGroup>>,
}

impl QueueGauge {
    /// What waits in the queues.
    pub fn depths(&self) -> QueueDepths {
        fn depth<T>(queue: &WeakSender<T>) -> usize {
            queue.upgrade().map_or(0, |queue| queue.max_capacity() - queue.capacity())
        }
        let groups = depth(&self.coded) + depth(&self.groups);
        QueueDepths { sets: depth(&self.sets), scans: depth(&self.scans), groups }
    }
}

/// Ends the run when it goes.
struct Stop(Arc<AtomicBool>);

impl Drop for Stop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// The running stages; they end when it is dropped.
pub struct Pipeline {
    input: Sender<Item<FrameSet>>,
    gauge: QueueGauge,
    stop: Stop,
    monitor: Arc<Monitor>,
    capture: Option<JoinHandle<Result<Captured, RecordError>>>,
    stages: Vec<JoinHandle<Result<(), RecordError>>>,
}

impl Pipeline {
    /// Starts the stages around the rig's reconstructor, and the scanner with them; a recording given here has its first scan.
    ///
    /// # Errors
    /// [`RecordError::Stage`] without threads.
    pub fn start(
        rig: Rig,
        reconstructor: Reconstructor,
        settings: PipelineSettings,
        first: Option<Recording>,
    ) -> Result<Self, RecordError> {
        if let Some(DepthRange { near_mm, far_mm }) = reconstructor.valid_depth() {
            info!("one frequency: fringe orders are right from {near_mm:.0} to {far_mm:.0} mm");
        }
        let PipelineSettings { scan_periods, is_live, stop, monitor } = settings;
        let pixels = u64::from(rig.calibration.camera.width_px) * u64::from(rig.calibration.camera.height_px);
        let set_bytes = pixels * rig.sequence.patterns.len() as u64;
        let ((input, sets), (scan_out, scans)) = (channel(SETS), channel(SCANS));
        let ((coded_out, coded), (group_out, groups)) = (channel(CODED), channel(GROUPS));
        if let Some(recording) = first {
            input.try_send(Item::Begin(Box::new(recording))).map_err(|_| RecordError::Stage("record"))?;
        }
        let gauge = QueueGauge {
            sets: input.downgrade(),
            scans: scan_out.downgrade(),
            coded: coded_out.downgrade(),
            groups: group_out.downgrade(),
        };
        let drops_as = |cause| is_live.then_some(cause);
        let set_outlet = Outlet::new(input.clone(), drops_as(QUEUE_RECONSTRUCT), Arc::clone(&monitor));
        let scan_outlet = Outlet::new(scan_out, drops_as(QUEUE_ENCODE), Arc::clone(&monitor));
        let group_outlet = Outlet::new(group_out, None, Arc::clone(&monitor));
        let reconstruct = ReconstructStage::new(reconstructor, scan_outlet, Arc::clone(&monitor), is_live, SCANS);
        let coded_outlet = Outlet::new(coded_out, None, Arc::clone(&monitor));
        let encode = EncodeStage::new(coded_outlet, Arc::clone(&monitor));
        let pictures = PictureStage::new(group_outlet, Arc::clone(&monitor));
        let write = WriteStage::new(Arc::clone(&monitor), set_bytes);
        let stages = vec![
            thread("reconstruct", move || reconstruct.run(sets))?,
            thread("encode", move || encode.run(scans))?,
            thread("pictures", move || pictures.run(coded))?,
            thread("write", move || write.run(groups))?,
        ];
        let (asked, seen) = (Arc::clone(&stop), Arc::clone(&monitor));
        let capture = thread("capture", move || capture(rig, scan_periods, &asked, set_outlet, &seen))?;
        Ok(Self { input, gauge, stop: Stop(stop), monitor, capture: Some(capture), stages })
    }

    /// Begins a recording with the next frame set.
    ///
    /// # Errors
    /// [`RecordError::Stage`] when the stages have ended.
    pub fn begin(&self, recording: Recording) -> Result<(), RecordError> {
        self.send(Item::Begin(Box::new(recording)))
    }

    /// Ends the recording with the last frame set; what became of it comes once its file is closed.
    ///
    /// # Errors
    /// [`RecordError::Stage`] when the stages have ended.
    pub fn end(
        &self,
        cause: Option<RecordError>,
    ) -> Result<replies::Receiver<Result<Ended, RecordError>>, RecordError> {
        self.end_after(cause, Captured::default())
    }

    pub(super) fn end_after(
        &self,
        cause: Option<RecordError>,
        captured: Captured,
    ) -> Result<replies::Receiver<Result<Ended, RecordError>>, RecordError> {
        let (reply, ended) = replies::channel();
        let end = End { cause, rebuilt: Rebuilt::default(), encoded: [Encoded::default(); 2], captured, reply };
        self.send(Item::End(Box::new(end)))?;
        Ok(ended)
    }

    /// Writes down something that happened outside the stages.
    ///
    /// # Errors
    /// [`RecordError::Stage`] when the stages have ended.
    pub fn tell(&self, event: Event) -> Result<(), RecordError> {
        self.monitor.happened(&event);
        self.send(Item::Event(event))
    }

    /// Looks at the queues.
    pub fn gauge(&self) -> QueueGauge {
        self.gauge.clone()
    }

    /// Whether pictures still come, or are waited for.
    pub fn is_capturing(&self) -> bool {
        self.capture.as_ref().is_some_and(|capture| !capture.is_finished())
    }

    /// Waits for the end of the run.
    pub(super) fn wait(&mut self) -> Result<Captured, RecordError> {
        let capture = self.capture.take().ok_or(RecordError::Stage("capture"))?;
        capture.join().unwrap_or(Err(RecordError::Stage("capture")))
    }

    /// Stops the scanner and ends the stages, a recording that still runs with them.
    ///
    /// # Errors
    /// [`RecordError`] of the first stage that failed; a later stage's error is the cause of those before it.
    pub fn finish(mut self) -> Result<(), RecordError> {
        self.stop.0.store(true, Ordering::Relaxed);
        let captured = if self.capture.is_some() { self.wait().map(drop) } else { Ok(()) };
        drop(self.input);
        let names = ["reconstruct", "encode", "pictures", "write"];
        let joined = self.stages.into_iter().zip(names);
        let ended: Vec<_> = joined.map(|(s, name)| s.join().unwrap_or(Err(RecordError::Stage(name)))).collect();
        ended.into_iter().rev().find(Result::is_err).unwrap_or(captured)
    }

    fn send(&self, item: Item<FrameSet>) -> Result<(), RecordError> {
        self.input.blocking_send(item).map_err(|_| RecordError::Stage("reconstruct"))
    }
}

fn thread<T: Send + 'static>(
    name: &'static str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, RecordError> {
    let thread = std::thread::Builder::new().name(format!("gv3-{name}"));
    thread.spawn(work).map_err(|_| RecordError::Stage(name))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::{self, PacedCamera};
    use crate::pipeline::test_rig::small_rig;
    use crate::pipeline::{Closed, Degradation, GroupSink, Progress, SegmentLimits};
    use gv3_codec::{EncoderConfig, StreamHeader};
    use gv3_protocol::session::{EventKind, MetadataGroup};
    use std::sync::{Mutex, PoisonError};
    use std::time::{Duration, Instant};

    /// Keeps what comes.
    #[derive(Clone, Default)]
    struct Kept(Arc<Mutex<(Vec<EncodedGroup>, Vec<Event>)>>);

    impl GroupSink for Kept {
        fn begin(&mut self, _: &StreamHeader) -> Result<(), RecordError> {
            Ok(())
        }
        fn group(&mut self, group: &EncodedGroup, events: &[Event]) -> Result<(), RecordError> {
            let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            kept.0.push(group.clone());
            kept.1.extend_from_slice(events);
            Ok(())
        }
        fn end(&mut self, events: &[Event], _: &MetadataGroup) -> Result<(), RecordError> {
            self.0.lock().unwrap_or_else(PoisonError::into_inner).1.extend_from_slice(events);
            Ok(())
        }
        fn closed(&self) -> Closed {
            Closed::default()
        }
    }

    #[test]
    fn behind_a_slow_encoder_scans_between_are_left_out_and_keyframes_never() {
        let rig = device::open(&small_rig()).unwrap();
        let period_nanos = rig.timing.set_period_nanos(rig.sequence.patterns.len());
        let rig = Rig { camera: Box::new(PacedCamera::new(rig.camera)), ..rig };
        let reconstructor = Reconstructor::of(&rig).unwrap();
        let monitor = Arc::new(Monitor::default());
        let settings =
            PipelineSettings { scan_periods: None, is_live: true, stop: Arc::default(), monitor: Arc::clone(&monitor) };
        let kept = Kept::default();
        let recording = Recording {
            encoder: EncoderConfig::new(period_nanos),
            limits: SegmentLimits::default(),
            // Three times what there is time for.
            observer: Box::new(|_| {
                std::thread::sleep(Duration::from_millis(100));
                Ok(())
            }),
            sink: Box::new(kept.clone()),
            progress: Arc::<Progress>::default(),
            abort: Arc::default(),
        };
        let pipeline = Pipeline::start(rig, reconstructor, settings, Some(recording)).unwrap();
        let begin = Instant::now();
        while monitor.drops().get("degradation_between").is_none_or(|n| *n < 30) {
            assert!(begin.elapsed() < Duration::from_secs(120), "it never degraded: {:?}", monitor.metrics());
            std::thread::sleep(Duration::from_millis(5));
        }
        let ended = pipeline.end(None).unwrap().recv().unwrap().unwrap();
        assert_eq!(monitor.degradation(), Degradation::None);
        pipeline.finish().unwrap();
        let (groups, events) = &*kept.0.lock().unwrap();
        assert_eq!(ended.recorded.keyframes, groups.len() as u64);
        let levels: Vec<&str> = events
            .iter()
            .filter_map(|e| match &e.kind {
                EventKind::Degradation { level } => Some(level.as_str()),
                _ => None,
            })
            .collect();
        assert!(levels.starts_with(&["no_between_correction", "no_between_scans"]), "{levels:?}");
        let left_out: u64 = events
            .iter()
            .filter_map(|e| match &e.kind {
                EventKind::Drop { cause, count } if cause == "degradation_between" => Some(*count),
                _ => None,
            })
            .sum();
        assert!(left_out >= 30, "{events:?}");
        // A keyframe in every tenth of the ticks; the last group is closed by whatever scan was the last.
        let keys: Vec<u64> = groups.iter().map(|g| g.key.tick / 10).collect();
        // Unless the machine had no time for reconstruction.
        let is_starved = monitor.drops().contains_key("queue_reconstruct");
        assert!(is_starved || keys.windows(2).all(|w| w[1] - w[0] <= 1), "{keys:?}");
        assert!(keys.len() >= 3, "{keys:?}");
    }
}
