//! The engine on the simulated rig: recordings, faults of disk and devices, stopping in every state.

mod day;

use super::*;
use crate::device::{Camera, CameraInfo, CameraSettings, Frame};
use crate::files::SessionsConfig;
use crate::pipeline::test_rig::small_rig;
use crate::replay::Replay;
use crate::store::{SessionDirectory, SessionName, SessionPlayer};
use gv3_protocol::session::{Event, EventKind, SessionError, SessionFile, SessionReader, SyncData, recover, verify};
use std::collections::BTreeMap;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU8, AtomicU64};
use std::time::Duration;

/// Far longer than anything takes on the slowest machine.
const PATIENCE: Duration = Duration::from_secs(120);

fn sessions(folder: &Path) -> SessionsConfig {
    SessionsConfig {
        directory: folder.join("sessions"),
        free_floor_bytes: 0,
        free_floor_percent: 0.0,
        ..SessionsConfig::default()
    }
}

fn config(folder: &Path) -> LiveConfig {
    LiveConfig { rig: small_rig(), sessions: sessions(folder) }
}

#[track_caller]
fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !is_so() {
        assert!(begin.elapsed() < PATIENCE, "{what} never came");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn named(name: &str) -> RecordingRequest {
    RecordingRequest { name: Some(name.into()), ..RecordingRequest::default() }
}

fn wait_for_scans(live: &Live, scans: u64) {
    wait_until("scans", || live.status().recording.is_some_and(|r| r.scans >= scans));
}

/// A whole session: every checksum, and its last scan decodes; gives its events.
#[track_caller]
fn check_session(path: &Path) -> Vec<Event> {
    let report = verify(path).unwrap();
    assert!(report.ok() && report.finished, "{report:?}");
    let mut replay = Replay::open(path).unwrap();
    let last = replay.stamps().last().unwrap().time_nanos;
    assert!(!replay.scan_at(last).unwrap().mesh.triangles.is_empty());
    replay.reader_mut().events().unwrap()
}

#[test]
fn recordings_begin_and_end_while_the_scanner_runs() {
    let folder = tempfile::tempdir().unwrap();
    let live = Live::open(config(folder.path())).unwrap();
    assert_eq!(live.status().state, LiveState::Idle);
    let (mut scans, mut groups) = (live.scans(), live.groups());
    live.start_scanner().unwrap();
    live.start_scanner().unwrap();
    live.want_scan();
    wait_until("a scan", || scans.borrow_and_update().is_some());
    assert_eq!(live.status().state, LiveState::Previewing);
    for name in ["one", "two"] {
        assert_eq!(live.start_recording(named(name)).unwrap().session, name);
        assert!(matches!(live.start_recording(named("other")), Err(LiveError::State(_))));
        wait_for_scans(&live, 15);
        let tick = live.mark("here").unwrap();
        let stopped = live.stop_recording().unwrap();
        assert!(stopped.verified && stopped.scans >= 15 && stopped.keyframes >= 2, "{stopped:?}");
        assert_eq!(stopped.files, [format!("{name}.gv3")]);
        let path = folder.path().join("sessions").join(&stopped.files[0]);
        assert_eq!(std::fs::metadata(&path).unwrap().len(), stopped.bytes);
        let events = check_session(&path);
        let mark = EventKind::Mark { text: "here".into() };
        assert!(events.iter().any(|e| e.kind == mark && e.tick == tick), "{events:?}");
        assert_eq!(live.status().state, LiveState::Previewing);
    }
    assert_eq!(groups.try_recv().unwrap().kind, LiveGroupKind::Header);
    assert_eq!(groups.try_recv().unwrap().kind, LiveGroupKind::Geometry);
    assert!(matches!(live.stop_recording(), Err(LiveError::State(_))));
    live.stop_scanner().unwrap();
    assert_eq!(live.status().state, LiveState::Idle);
    live.shut_down().unwrap();
}

#[test]
fn raw_pictures_beside_or_instead_of_scans_are_a_device() {
    let folder = tempfile::tempdir().unwrap();
    let live = Live::open(config(folder.path())).unwrap();
    live.start_recording(RecordingRequest { raw: true, ..named("both") }).unwrap();
    wait_for_scans(&live, 11);
    let both = live.stop_recording().unwrap();
    assert_eq!(both.files, ["both.gv3", "both.raw"]);
    live.start_recording(RecordingRequest { raw: true, scans: false, ..named("raw") }).unwrap();
    std::thread::sleep(Duration::from_millis(200));
    let raw = live.stop_recording().unwrap();
    assert_eq!((raw.files, raw.scans), (vec!["raw.raw".to_owned()], 0));
    assert!(raw.raw.unwrap().pictures > 0);
    live.shut_down().unwrap();
    // What was recorded plays as a scanner, and its end is the end of the run.
    let path = folder.path().join("sessions/both.raw");
    let recorded = device::RecordedConfig { path, pace: device::Pace::Fast, is_loop: false };
    let rig = RigConfig::recorded(recorded).unwrap();
    let live = Live::open(LiveConfig { rig, sessions: sessions(folder.path()) }).unwrap();
    live.start_recording(named("again")).unwrap();
    wait_until("the end of the recording", || live.status().state == LiveState::Idle);
    assert_eq!((live.status().error, live.status().source), (None, "recorded"));
    check_session(&folder.path().join("sessions/again.gv3"));
}

#[test]
fn segments_follow_one_another_and_each_decodes_alone() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config(folder.path());
    config.sessions.segment_seconds = Some(1.0);
    let live = Live::open(config).unwrap();
    live.start_recording(named("long")).unwrap();
    wait_until("a third file", || live.status().recording.is_some_and(|r| r.segment >= 3));
    let stopped = live.stop_recording().unwrap();
    live.shut_down().unwrap();
    assert!(stopped.files.starts_with(&["long.gv3".into(), "long.0002.gv3".into()]), "{stopped:?}");
    let (mut scans, mut last_tick) = (0, None);
    for file in &stopped.files {
        let path = folder.path().join("sessions").join(file);
        check_session(&path);
        let replay = Replay::open(&path).unwrap();
        let stamps = replay.stamps();
        scans += stamps.len() as u64;
        // Ticks may only be missing where sets were dropped.
        assert!(last_tick.is_none_or(|last| stamps[0].tick > last));
        assert!(stamps[0].is_key);
        last_tick = stamps.last().map(|s| s.tick);
    }
    assert_eq!(scans, stopped.scans);
}

#[test]
fn a_file_that_is_being_recorded_is_read_on_and_not_again() {
    let folder = tempfile::tempdir().unwrap();
    let live = Live::open(config(folder.path())).unwrap();
    let directory = SessionDirectory::open(&folder.path().join("sessions")).unwrap();
    live.start_recording(named("growing")).unwrap();
    wait_for_scans(&live, 15);
    live.mark("early").unwrap();
    wait_for_scans(&live, 35);
    let (name, path) = (SessionName::new("growing").unwrap(), folder.path().join("sessions/growing.gv3"));
    let early = directory.detail(&name).unwrap();
    assert!(early.groups.len() >= 2 && early.events.iter().any(|event| event["text"] == "early"), "{early:?}");
    // What was read before may go bad: nobody looks at it again.
    let first = SessionReader::open(&path).unwrap().groups()[0];
    let file = std::fs::File::options().write(true).open(&path).unwrap();
    std::os::unix::fs::FileExt::write_all_at(&file, &[0xff; 16], first.chunk_offset + first.chunk_bytes / 2).unwrap();
    assert_eq!(SessionReader::open(&path).unwrap().groups().len(), 0);
    live.mark("late").unwrap();
    let known = live.status().recording.unwrap().scans;
    wait_for_scans(&live, known + 21);
    let late = directory.detail(&name).unwrap();
    assert_eq!(late.groups[..early.groups.len()], early.groups);
    assert!(late.groups.len() > early.groups.len(), "{late:?}");
    let texts: Vec<_> = late.events.iter().filter_map(|event| event["text"].as_str()).collect();
    assert_eq!(texts, ["early", "late"]);
    // Whether its end finds the damage is another matter.
    let _ = live.shut_down();
}

#[test]
fn a_clock_that_jumps_changes_labels_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let jumps = AtomicU64::new(0);
    // Ten years on and back again, and before 1970, from one look to the next.
    let wall_clock = move || {
        let years = [30, 40, 20, 0][jumps.fetch_add(1, Ordering::Relaxed) as usize % 4];
        SystemTime::UNIX_EPOCH + Duration::from_secs(years * 31_557_600) - Duration::from_secs(1)
    };
    let ground = Ground { wall_clock: Box::new(wall_clock), ..Ground::default() };
    let mut config = config(folder.path());
    config.sessions.segment_seconds = Some(1.0);
    let live = Live::open_on(config, ground).unwrap();
    let session = live.start_recording(RecordingRequest::default()).unwrap().session;
    assert!(session.starts_with("2000-01-01_"), "{session}");
    wait_until("a third file", || live.status().recording.is_some_and(|r| r.segment >= 3));
    let stopped = live.stop_recording().unwrap();
    live.shut_down().unwrap();
    let directory = SessionDirectory::open(&folder.path().join("sessions")).unwrap();
    let name = SessionName::new(&session).unwrap();
    let (summary, detail) = (directory.summary(&name, None).unwrap(), directory.detail(&name).unwrap());
    let ticks = detail.last_tick - detail.first_tick;
    assert_eq!(summary.seconds, ticks as f64 * detail.period_nanos as f64 * 1e-9);
    assert_eq!((summary.scans, detail.missing_ticks), (stopped.scans, ticks + 1 - stopped.scans));
    assert!(summary.ratio.is_some_and(|ratio| (10.0..10_000.0).contains(&ratio)), "{summary:?}");
    assert_eq!(summary.tolerance_mm, Some(0.1));
    let mut player = SessionPlayer::open(&directory.files(&name).unwrap(), None).unwrap();
    assert!(player.stamps().windows(2).all(|w| w[0].time_nanos < w[1].time_nanos));
    let last = player.stamps().last().unwrap().time_nanos;
    assert!(!player.scan_at(last).unwrap().mesh.triangles.is_empty());
}

#[test]
fn stopping_works_in_every_state_and_leaves_whole_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join("sessions").join(name);
    let live = Live::open(config(folder.path())).unwrap();
    live.stop_scanner().unwrap();
    assert!(matches!(live.stop_recording(), Err(LiveError::State(_))));
    // At once: no scan, or one.
    for n in 0..10 {
        live.start_recording(named(&format!("short{n}"))).unwrap();
        std::thread::sleep(Duration::from_millis(13 * n));
        let stopped = live.stop_recording().unwrap();
        assert_eq!(stopped.files.len(), usize::from(stopped.scans > 0), "{stopped:?}");
        stopped.files.iter().for_each(|file| drop(check_session(&path(file))));
        assert_eq!(path(&format!("short{n}.gv3")).exists(), stopped.scans > 0);
        if n % 3 == 0 {
            live.stop_scanner().unwrap();
        }
    }
    live.start_recording(named("scanner")).unwrap();
    wait_for_scans(&live, 1);
    live.stop_scanner().unwrap();
    check_session(&path("scanner.gv3"));
    live.start_recording(named("shut")).unwrap();
    wait_for_scans(&live, 1);
    let handle = live.clone();
    live.shut_down().unwrap();
    check_session(&path("shut.gv3"));
    assert!(matches!(handle.start_scanner(), Err(LiveError::State(_))));
    assert!(matches!(handle.start_recording(named("late")), Err(LiveError::State(_))));
    // Without its last handle the engine ends by itself.
    let live = Live::open(config(folder.path())).unwrap();
    live.start_recording(named("dropped")).unwrap();
    wait_for_scans(&live, 1);
    drop(live);
    wait_until("a whole file", || verify(path("dropped.gv3")).is_ok_and(|report| report.finished && report.ok()));
}

#[test]
fn a_configuration_is_taken_whole_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let before = config(folder.path());
    let live = Live::open(before.clone()).unwrap();
    live.start_scanner().unwrap();
    let mut bad = before.clone();
    (bad.sessions.keep_days, bad.rig.camera.width_px) = (Some(1.0), 99);
    assert!(matches!(live.reload(bad), Err(LiveError::Config(_))));
    assert_eq!(live.config(), before);
    live.start_recording(named("one")).unwrap();
    let mut other = before.clone();
    other.rig.sim.seed = 5;
    assert!(matches!(live.reload(other.clone()), Err(LiveError::State(_))));
    let mut kept = before.clone();
    kept.sessions.keep_days = Some(3.0);
    live.reload(kept.clone()).unwrap();
    assert_eq!((live.config(), live.status().state), (kept, LiveState::Recording));
    live.stop_recording().unwrap();
    live.reload(other.clone()).unwrap();
    assert_eq!((live.config(), live.status().state), (other, LiveState::Previewing));
    // A configuration whose devices fail gives way to the one before.
    let mut missing = before.clone();
    missing.rig.camera.backend = device::Backend::Recorded;
    missing.rig.projector.backend = device::Backend::Recorded;
    assert!(live.reload(missing).is_err());
    assert_eq!((live.config().rig.sim.seed, live.status().state), (5, LiveState::Previewing));
}

/// What is wrong with a disk.
#[derive(Default)]
struct DiskFaults {
    /// Bytes after which it refuses; 0 is never.
    room: AtomicU64,
    /// Whether it refuses because it was mounted anew for reading alone, not because it is full.
    is_read_only: AtomicBool,
    /// How long it takes to make bytes durable.
    sync_millis: AtomicU64,
    /// What it says is free; 0 is plenty.
    free: AtomicU64,
    /// Bytes of each file that a power cut leaves.
    durable: Mutex<BTreeMap<PathBuf, u64>>,
}

struct FaultyDisk(Arc<DiskFaults>);

struct FaultyFile {
    file: SessionFile,
    faults: Arc<DiskFaults>,
    written: u64,
}

impl Disk for FaultyDisk {
    fn create(&self, path: &Path) -> Result<Box<dyn DiskFile>, SessionError> {
        Ok(Box::new(FaultyFile { file: SessionFile::create(path, false)?, faults: Arc::clone(&self.0), written: 0 }))
    }

    fn space(&self, _: &Path) -> Option<DiskSpace> {
        let free_bytes = match self.0.free.load(Ordering::Relaxed) {
            0 => 1 << 40,
            free => free,
        };
        Some(DiskSpace { free_bytes, total_bytes: 1 << 41 })
    }
}

impl Write for FaultyFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let room = self.faults.room.load(Ordering::Relaxed);
        if room > 0 && self.written + bytes.len() as u64 > room {
            return Err(match self.faults.is_read_only.load(Ordering::Relaxed) {
                true => io::ErrorKind::ReadOnlyFilesystem.into(),
                false => io::ErrorKind::StorageFull.into(),
            });
        }
        let count = self.file.write(bytes)?;
        self.written += count as u64;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for FaultyFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

impl SyncData for FaultyFile {
    fn sync_data(&mut self) -> io::Result<()> {
        std::thread::sleep(Duration::from_millis(self.faults.sync_millis.load(Ordering::Relaxed)));
        self.file.sync_data()?;
        self.faults.durable.lock().unwrap().insert(self.file.path().into(), self.written);
        Ok(())
    }
}

/// An engine on a disk with faults.
fn on_faulty_disk(folder: &Path) -> (Live, Arc<DiskFaults>) {
    let faults = Arc::new(DiskFaults::default());
    let ground = Ground { disk: Arc::new(FaultyDisk(Arc::clone(&faults))), ..Ground::default() };
    let mut config = config(folder);
    config.sessions.free_floor_bytes = 1000;
    (Live::open_on(config, ground).unwrap(), faults)
}

#[test]
fn a_disk_that_is_full_or_turns_read_only_ends_the_recording_and_nothing_else() {
    for is_read_only in [false, true] {
        end_by_disk(is_read_only);
    }
}

fn end_by_disk(is_read_only: bool) {
    let folder = tempfile::tempdir().unwrap();
    let (live, faults) = on_faulty_disk(folder.path());
    faults.is_read_only.store(is_read_only, Ordering::Relaxed);
    live.start_recording(named("full")).unwrap();
    wait_for_scans(&live, 12);
    faults.room.store(1, Ordering::Relaxed);
    wait_until("the end of the recording", || live.status().state == LiveState::Previewing);
    let status = live.status();
    assert!(status.recording.is_none() && status.error.is_some(), "{status:?}");
    let path = folder.path().join("sessions/full.gv3");
    assert!(SessionReader::open(&path).unwrap().groups().len() >= 2);
    assert!(matches!(live.start_recording(named("none")), Err(LiveError::Record(_))));
    assert!(!folder.path().join("sessions/none.gv3").exists());
    // Room again, and all is well.
    faults.room.store(0, Ordering::Relaxed);
    live.start_recording(named("next")).unwrap();
    assert_eq!(live.status().error, None);
    wait_for_scans(&live, 1);
    live.stop_recording().unwrap();
    check_session(&folder.path().join("sessions/next.gv3"));
}

#[test]
fn at_the_free_space_floor_a_recording_stops_cleanly_and_none_begins() {
    let folder = tempfile::tempdir().unwrap();
    let (live, faults) = on_faulty_disk(folder.path());
    live.start_recording(named("floor")).unwrap();
    wait_for_scans(&live, 1);
    faults.free.store(999, Ordering::Relaxed);
    wait_until("the end of the recording", || live.status().state == LiveState::Previewing);
    assert!(live.status().error.unwrap().contains("999 bytes are free"));
    let events = check_session(&folder.path().join("sessions/floor.gv3"));
    let told = |e: &Event| matches!(&e.kind, EventKind::Fault { source, .. } if source == "disk");
    assert!(events.iter().any(told), "{events:?}");
    assert!(matches!(live.start_recording(named("none")), Err(LiveError::Space { free_bytes: 999, .. })));
}

#[test]
fn a_slow_disk_holds_up_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let (live, faults) = on_faulty_disk(folder.path());
    faults.sync_millis.store(300, Ordering::Relaxed);
    live.start_recording(named("slow")).unwrap();
    wait_for_scans(&live, 30);
    let stopped = live.stop_recording().unwrap();
    assert!(stopped.verified && stopped.scans >= 30, "{stopped:?}");
    check_session(&folder.path().join("sessions/slow.gv3"));
}

#[test]
fn after_a_power_cut_every_group_that_was_announced_is_there() {
    let folder = tempfile::tempdir().unwrap();
    let (live, faults) = on_faulty_disk(folder.path());
    let mut groups = live.groups();
    live.start_recording(named("cut")).unwrap();
    let path = folder.path().join("sessions/cut.gv3");
    for cut in 0..4 {
        let mut last = None;
        wait_until("a group", || {
            while let Ok(group) = groups.try_recv() {
                last = (group.kind == LiveGroupKind::Geometry).then_some(group.key_tick).or(last);
            }
            last.is_some()
        });
        // What was synced, and a torn piece of what came after it.
        let durable = faults.durable.lock().unwrap()[&path] as usize;
        let bytes = std::fs::read(&path).unwrap();
        let left = folder.path().join(format!("left{cut}.gv3"));
        std::fs::write(&left, &bytes[..(durable + 7 * cut).min(bytes.len())]).unwrap();
        let whole = folder.path().join(format!("whole{cut}.gv3"));
        recover(&left, &whole, false).unwrap();
        check_session(&whole);
        let groups = SessionReader::open(&whole).unwrap().groups().to_vec();
        assert!(groups.last().is_some_and(|group| Some(group.key_tick) >= last), "cut {cut}: {groups:?}, {last:?}");
    }
    live.shut_down().unwrap();
}

/// What is wrong with a camera.
const WELL: u8 = 0;
const STALLED: u8 = 1;
const UNPLUGGED: u8 = 2;

struct FaultyCamera {
    inner: Box<dyn Camera>,
    fault: Arc<AtomicU8>,
}

impl Camera for FaultyCamera {
    fn info(&self) -> CameraInfo {
        self.inner.info()
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        self.inner.configure(want)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        match self.fault.load(Ordering::Relaxed) {
            UNPLUGGED => Err(DeviceError::Disconnected("the camera".into())),
            _ => self.inner.start(),
        }
    }

    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        match self.fault.load(Ordering::Relaxed) {
            WELL => self.inner.next_frame(deadline),
            STALLED => {
                std::thread::sleep(Duration::from_millis(20));
                Err(DeviceError::Timeout("stalled".into()))
            }
            _ => Err(DeviceError::Disconnected("the camera".into())),
        }
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.inner.stop()
    }
}

/// An engine with a camera that has faults.
fn with_faulty_camera(folder: &Path, silence_limit_seconds: u32) -> (Live, Arc<AtomicU8>) {
    let fault = Arc::new(AtomicU8::new(WELL));
    let seen = Arc::clone(&fault);
    let open_rig = move |config: &RigConfig| {
        let rig = device::open(config)?;
        Ok(Rig { camera: Box::new(FaultyCamera { inner: rig.camera, fault: Arc::clone(&seen) }), ..rig })
    };
    let mut config = config(folder);
    config.rig.silence_limit_seconds = silence_limit_seconds;
    let ground = Ground { open_rig: Box::new(open_rig), ..Ground::default() };
    (Live::open_on(config, ground).unwrap(), fault)
}

#[test]
fn a_recording_outlasts_a_stall_and_a_cable_that_is_put_back() {
    let folder = tempfile::tempdir().unwrap();
    let (live, fault) = with_faulty_camera(folder.path(), 60);
    live.start_recording(named("faults")).unwrap();
    let mut scans = 0;
    for kind in [STALLED, UNPLUGGED] {
        wait_for_scans(&live, scans + 12);
        fault.store(kind, Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(300));
        scans = live.status().recording.unwrap().scans;
        fault.store(WELL, Ordering::Relaxed);
    }
    wait_for_scans(&live, scans + 12);
    live.stop_recording().unwrap();
    let events = check_session(&folder.path().join("sessions/faults.gv3"));
    let faults = events.iter().filter(|e| matches!(&e.kind, EventKind::Fault { source, .. } if source == "capture"));
    assert!(faults.count() >= 2, "{events:?}");
}

#[test]
fn a_device_that_stays_away_ends_the_recording_whole_and_can_be_started_again() {
    let folder = tempfile::tempdir().unwrap();
    let (live, fault) = with_faulty_camera(folder.path(), 1);
    let mut events = live.events();
    live.start_recording(named("away")).unwrap();
    wait_for_scans(&live, 12);
    fault.store(UNPLUGGED, Ordering::Relaxed);
    wait_until("the failure", || live.status().state == LiveState::Failed);
    assert!(live.status().error.unwrap().contains("disconnected"));
    check_session(&folder.path().join("sessions/away.gv3"));
    let states = std::iter::from_fn(|| events.try_recv().ok()).filter_map(|event| match event {
        LiveEvent::State { state, .. } => Some(state),
        LiveEvent::Happened(_) => None,
    });
    let states: Vec<&str> = states.collect();
    assert_eq!(states, ["starting", "previewing", "recording", "failed"]);
    assert!(live.start_scanner().is_ok_and(|()| live.status().state != LiveState::Idle));
    wait_until("the failure again", || live.status().state == LiveState::Failed);
    fault.store(WELL, Ordering::Relaxed);
    live.start_recording(named("back")).unwrap();
    wait_for_scans(&live, 1);
    live.stop_recording().unwrap();
    check_session(&folder.path().join("sessions/back.gv3"));
}
