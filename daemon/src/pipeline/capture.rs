//! From a rig's devices to frame sets, through unplugging and silence.
//!
//! A device that is gone does not end a capture: the devices are set going again until pictures come, or until the rig's
//! silence limit has passed. What comes after is never joined with what came before, sensor time goes on, and the ticks show
//! the gap.

use super::flow::{Captured, Item, Outlet};
use super::monitor::{Monitor, Stage, thread_cpu};
use super::record::RecordError;
use super::{DropCounts, FrameSet, FrameSetAssembler};
use crate::device::{CameraSettings, DeviceError, Frame, Rig, TriggerSource};
use gv3_protocol::session::{Event, EventKind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tracing::{debug, info, warn};

/// How long the camera may be silent before a timeout is counted.
const PICTURE_DEADLINE: Duration = Duration::from_secs(2);
/// Timeouts in a row after which the devices are set going anew.
const MOST_TIMEOUTS: u32 = 5;
/// Time between two attempts to set them going.
const RETRY: Duration = Duration::from_millis(200);

/// What capture sends: frame sets, and what happened between them.
pub(super) type CaptureItem = Item<FrameSet>;

impl CaptureItem {
    /// Whether it is a frame set.
    pub(super) fn is_set(&self) -> bool {
        matches!(self, Self::Work(..))
    }
}

/// Runs a rig for `periods` scan periods or until told to stop; gives what was dropped and the bytes of all pictures.
///
/// # Errors
/// [`RecordError`] of the devices; of unplugging and silence only when they outlast the rig's limit.
pub(super) fn capture(
    mut rig: Rig,
    periods: Option<u64>,
    stop: &AtomicBool,
    out: Outlet<FrameSet>,
    monitor: &Monitor,
) -> Result<Captured, RecordError> {
    rig.camera.configure(&CameraSettings {
        width_px: rig.calibration.camera.width_px,
        height_px: rig.calibration.camera.height_px,
        exposure_nanos: rig.timing.exposure_nanos,
        trigger: TriggerSource::Projector,
    })?;
    begin(&mut rig)?;
    let mut run = Capture::new(&mut rig, periods, stop, (out, monitor));
    let captured = run.run();
    let is_away = run.is_away;
    // All are told to stop even if one fails; the first error counts.
    let stopped = [disarm(&mut rig), rig.projector.stop(), rig.camera.stop()];
    let captured = captured?;
    // Who ends the wait for a device knows that it is gone.
    let is_news = |error: &DeviceError| !is_away || !matches!(error, DeviceError::Disconnected(_));
    match stopped.into_iter().filter_map(Result::err).find(is_news) {
        Some(error) => Err(error.into()),
        None => Ok(captured),
    }
}

/// Sets the devices going: first who must be ready for whom.
fn begin(rig: &mut Rig) -> Result<(), DeviceError> {
    rig.projector.load(&rig.sequence)?;
    rig.camera.start()?;
    rig.projector.play(&rig.timing)?;
    if let Some(trigger) = &mut rig.trigger {
        trigger.arm(&rig.timing)?;
    }
    Ok(())
}

fn disarm(rig: &mut Rig) -> Result<(), DeviceError> {
    rig.trigger.as_mut().map_or(Ok(0), |trigger| trigger.disarm()).map(drop)
}

/// A run of the devices.
struct Capture<'a> {
    rig: &'a mut Rig,
    periods: Option<u64>,
    stop: &'a AtomicBool,
    out: Outlet<FrameSet>,
    monitor: &'a Monitor,
    set_nanos: u64,
    assembler: FrameSetAssembler,
    /// Drops that were sent as events.
    told: DropCounts,
    frame_bytes: u64,
    /// Sensor time of the first frame, and of the last.
    start_nanos: Option<u64>,
    last_nanos: u64,
    last_tick: Option<u64>,
    timeouts: u32,
    /// Of the last frame.
    arrival: Instant,
    is_away: bool,
}

impl<'a> Capture<'a> {
    fn new(
        rig: &'a mut Rig,
        periods: Option<u64>,
        stop: &'a AtomicBool,
        (out, monitor): (Outlet<FrameSet>, &'a Monitor),
    ) -> Self {
        Self {
            set_nanos: rig.timing.set_period_nanos(rig.sequence.patterns.len()),
            assembler: FrameSetAssembler::new(&rig.sequence, &rig.timing),
            rig,
            periods,
            stop,
            out,
            monitor,
            told: DropCounts::default(),
            frame_bytes: 0,
            start_nanos: None,
            last_nanos: 0,
            last_tick: None,
            timeouts: 0,
            arrival: Instant::now(),
            is_away: false,
        }
    }

    fn run(&mut self) -> Result<Captured, RecordError> {
        let mut cpu = thread_cpu();
        while !self.stop.load(Ordering::Relaxed) {
            self.monitor.used_cpu(Stage::Capture, std::mem::replace(&mut cpu, thread_cpu()));
            match self.rig.camera.next_frame(Instant::now() + PICTURE_DEADLINE) {
                Ok(frame) if self.is_over(self.elapsed_nanos(&frame)) => break,
                Ok(frame) => {
                    let elapsed_nanos = self.elapsed_nanos(&frame);
                    self.take(frame, elapsed_nanos)?;
                    // Without waiting for a picture that is not wanted.
                    if self.is_over(elapsed_nanos.saturating_add(self.rig.timing.picture_period_nanos)) {
                        break;
                    }
                }
                Err(DeviceError::Ended(device)) => {
                    info!(device, "end of the pictures");
                    break;
                }
                Err(error @ DeviceError::Timeout(_)) => {
                    self.timeouts += 1;
                    warn!(%error, timeouts = self.timeouts, "no picture");
                    if self.timeouts >= MOST_TIMEOUTS {
                        self.resume(error)?;
                    }
                }
                Err(error @ DeviceError::Disconnected(_)) => self.resume(error)?,
                Err(error) => return Err(error.into()),
            }
        }
        Ok(Captured { drops: self.assembler.finish(), frame_bytes: Some(self.frame_bytes) })
    }

    /// Sensor time of a frame since the first.
    fn elapsed_nanos(&self, frame: &Frame) -> u64 {
        self.start_nanos.map_or(0, |start| frame.device_time_nanos.saturating_sub(start))
    }

    fn is_over(&self, nanos: u64) -> bool {
        let half_picture_nanos = self.rig.timing.picture_period_nanos / 2;
        self.periods.is_some_and(|p| nanos.saturating_add(half_picture_nanos) >= p.saturating_mul(self.set_nanos))
    }

    fn take(&mut self, frame: Frame, elapsed_nanos: u64) -> Result<(), RecordError> {
        if std::mem::take(&mut self.is_away) {
            info!("pictures come again");
        }
        (self.timeouts, self.arrival) = (0, Instant::now());
        self.last_nanos = frame.device_time_nanos;
        self.start_nanos.get_or_insert(frame.device_time_nanos);
        self.frame_bytes += frame.picture.pixels.len() as u64;
        self.monitor.took_picture();
        let set = self.assembler.push(frame);
        self.tell_drops(elapsed_nanos / self.set_nanos)?;
        let Some(set) = set else { return Ok(()) };
        if let Some(gap) = gap_event(self.last_tick, &set) {
            self.out.tell(gap)?;
        }
        self.last_tick = Some(set.tick);
        let stamp = (set.tick, set.time_nanos);
        self.monitor.took_set(stamp.0, stamp.1);
        self.out.offer(set, self.arrival, stamp).map(drop)
    }

    /// Drops since this was last called; of the set at `tick` if no set was open.
    fn tell_drops(&mut self, tick: u64) -> Result<(), RecordError> {
        let tick = self.assembler.last_dropped_tick().unwrap_or(tick);
        let told = std::mem::replace(&mut self.told, self.assembler.drops());
        for event in drop_events(&told, &self.told, self.last_nanos, tick) {
            self.out.tell(event)?;
        }
        Ok(())
    }

    /// Sets the devices going again after `error`, once it was said.
    fn resume(&mut self, mut error: DeviceError) -> Result<(), RecordError> {
        let tick = self.last_tick.map_or(0, |tick| tick.saturating_add(1));
        self.assembler.restart();
        self.tell_drops(tick)?;
        if !std::mem::replace(&mut self.is_away, true) {
            warn!(%error, "the capture is interrupted; waiting for the device");
            let kind = EventKind::Fault { source: "capture".into(), message: error.to_string() };
            self.out.tell(Event { time_nanos: self.last_nanos, tick, kind })?;
        }
        while self.arrival.elapsed() < self.rig.silence_limit {
            std::thread::sleep(RETRY.min(self.rig.silence_limit));
            if self.stop.load(Ordering::Relaxed) {
                return Ok(());
            }
            // Whoever is still there begins anew, too; whoever is not cannot be stopped.
            let quiet = disarm(self.rig).and(self.rig.projector.stop());
            match begin(self.rig) {
                Ok(()) => {
                    self.timeouts = 0;
                    return Ok(());
                }
                Err(reason) => {
                    debug!(%reason, ?quiet, "not back yet");
                    error = reason;
                }
            }
        }
        Err(error.into())
    }
}

/// One event for every cause whose count grew.
fn drop_events(before: &DropCounts, after: &DropCounts, time_nanos: u64, tick: u64) -> Vec<Event> {
    let causes = [
        ("picture_lost", before.lost, after.lost),
        ("picture_doubled", before.doubled, after.doubled),
        ("picture_late", before.late, after.late),
        ("picture_disordered", before.disordered, after.disordered),
        ("picture_stray", before.stray_frames, after.stray_frames),
    ];
    causes
        .iter()
        .filter(|(_, before, after)| after > before)
        .map(|(cause, before, after)| {
            warn!(cause, count = after - before, tick, "dropped");
            let kind = EventKind::Drop { cause: (*cause).into(), count: after - before };
            Event { time_nanos, tick, kind }
        })
        .collect()
}

fn gap_event(last_tick: Option<u64>, set: &FrameSet) -> Option<Event> {
    let first_missing = last_tick? + 1;
    let ticks = set.tick.checked_sub(first_missing).filter(|&n| n > 0)?;
    Some(Event { time_nanos: set.time_nanos, tick: first_missing, kind: EventKind::Gap { ticks } })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::gv3_usb::{Gv3Projector, Socket};
    use crate::device::sim::{Fault, FaultKind, Gv3Device, SceneConfig, SimCamera, SimWorld};
    use crate::device::{self, ProvenCamera, RigConfig};
    use gv3_codec::GreyPicture;
    use std::sync::{Arc, Mutex};
    use tokio::sync::mpsc::{Receiver, Sender, channel};

    fn config() -> RigConfig {
        let mut config = RigConfig::simulated();
        config.sim.scene = SceneConfig::Plane;
        config
    }

    fn capture_into(
        rig: Rig,
        periods: Option<u64>,
        stop: &AtomicBool,
        queue: Sender<CaptureItem>,
    ) -> Result<DropCounts, RecordError> {
        let monitor = Arc::new(Monitor::default());
        let out = Outlet::new(queue, None, Arc::clone(&monitor));
        capture(rig, periods, stop, out, &monitor).map(|captured| captured.drops)
    }

    fn difference(a: &GreyPicture, b: &GreyPicture) -> u64 {
        a.pixels.iter().zip(&b.pixels).map(|(a, b)| u64::from(a.abs_diff(*b))).sum()
    }

    /// Every picture shows the pattern of its place: it is most like the first set's.
    fn check_pictures(sets: &[FrameSet]) {
        let first = &sets[0].frames;
        for set in sets {
            for (i, frame) in set.frames.iter().enumerate() {
                let nearest = (0..first.len()).min_by_key(|&j| difference(&first[j].picture, &frame.picture));
                assert_eq!(nearest, Some(i), "tick {}", set.tick);
                assert_eq!(usize::from(frame.pattern.0), i);
            }
        }
        assert!(sets.windows(2).all(|w| w[0].tick < w[1].tick && w[0].time_nanos < w[1].time_nanos));
    }

    fn events_and_sets(items: Vec<CaptureItem>) -> (Vec<Event>, Vec<FrameSet>) {
        let (mut events, mut sets) = (Vec::new(), Vec::new());
        for item in items {
            match item {
                Item::Event(event) => events.push(event),
                Item::Work(set, _) => sets.push(set),
                _ => unreachable!("capture sends nothing else"),
            }
        }
        (events, sets)
    }

    fn told_faults(events: &[Event]) -> Vec<String> {
        let fault = |e: &Event| match &e.kind {
            EventKind::Fault { message, .. } => Some(message.clone()),
            _ => None,
        };
        events.iter().filter_map(fault).collect()
    }

    #[test]
    fn a_camera_that_is_plugged_in_again_goes_on_after_a_gap() {
        let mut config = config();
        config.sim.faults = vec![Fault { kind: FaultKind::Unplugged, set: 3, picture: 2 }];
        let rig = device::open(&config).unwrap();
        let (out, mut items) = channel(1000);
        let drops = capture_into(rig, Some(40), &AtomicBool::new(false), out).unwrap();
        let (events, sets) = events_and_sets(std::iter::from_fn(|| items.try_recv().ok()).collect());
        check_pictures(&sets);
        let ticks: Vec<u64> = sets.iter().map(|s| s.tick).collect();
        // A second is 30 scans; the last set is cut off by the end.
        assert_eq!(ticks, [0, 1, 2, 33, 34, 35, 36, 37, 38]);
        assert_eq!(drops, DropCounts { lost: 31, ..DropCounts::default() });
        assert_eq!(told_faults(&events), ["the simulated camera is disconnected"]);
        assert!(events.iter().any(|e| e.kind == EventKind::Gap { ticks: 30 } && e.tick == 3), "{events:?}");
    }

    /// A simulated camera in the light of a projector behind a cable that can be pulled.
    fn plugged() -> (Arc<Socket>, Rig) {
        let config = config();
        let world = Arc::new(Mutex::new(SimWorld::new(&config).unwrap()));
        let socket = Socket::in_world(projector(), Arc::clone(&world));
        let projector = Gv3Projector::open(socket.opener()).unwrap();
        let (camera, exposures) = (Box::new(SimCamera::new(world)), device::Projector::exposures(&projector));
        let camera = Box::new(ProvenCamera::new(camera, None, exposures, config.timing.picture_period_nanos, 6));
        (socket, Rig { camera, projector: Box::new(projector), ..device::open(&config).unwrap() })
    }

    fn projector() -> Gv3Device {
        Gv3Device::simulated([912, 1140], "T1")
    }

    fn next_sets(items: &mut Receiver<CaptureItem>, all: &mut Vec<CaptureItem>, count: usize) {
        let mut sets = 0;
        while sets < count {
            let item = items.blocking_recv().expect("the capture goes on");
            sets += usize::from(item.is_set());
            all.push(item);
        }
    }

    #[test]
    fn a_projector_that_is_plugged_in_again_gives_no_wrong_set() {
        let (socket, rig) = plugged();
        let stop = &AtomicBool::new(false);
        let (out, mut items) = channel(1);
        let mut all = Vec::new();
        let drops = std::thread::scope(|scope| {
            let thread = scope.spawn(move || capture_into(rig, None, stop, out));
            for away in [Duration::ZERO, Duration::from_millis(300), Duration::from_millis(3)] {
                next_sets(&mut items, &mut all, 3);
                socket.unplug();
                std::thread::sleep(away);
                socket.plug(projector());
                // What was on its way before, and what comes after.
                next_sets(&mut items, &mut all, 4);
            }
            stop.store(true, Ordering::Relaxed);
            while !thread.is_finished() {
                all.extend(items.try_recv());
                std::thread::sleep(Duration::from_millis(1));
            }
            thread.join().unwrap().unwrap()
        });
        let (events, sets) = events_and_sets(all);
        check_pictures(&sets);
        assert!(sets.len() >= 21, "{}", sets.len());
        let faults = told_faults(&events);
        // The pause of 300 ms cannot go unnoticed.
        assert!((1..=12).contains(&faults.len()), "{faults:?}");
        // Time stands while no picture is taken: only torn sets are missing, and a cable pulled between two sets tears none.
        assert!(drops.sets() <= 12, "{drops:?}");
    }
}
