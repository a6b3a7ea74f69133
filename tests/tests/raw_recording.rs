//! A session made live and one made of its raw recording are the same; what went wrong is in both.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3::device::sim::{Fault, FaultKind};
use gv3::device::{self, Camera, CameraInfo, CameraSettings, DeviceError, Frame, Pace, RecordedConfig, Rig, RigConfig};
use gv3::pipeline::{RawRecorder, RawSets, RecordSettings, Recorded, record};
use gv3_codec::EncoderConfig;
use gv3_codec::Scan;
use gv3_protocol::raw::verify_raw;
use gv3_protocol::session::{Event, SessionFile, SessionMetadata, SessionReader, SessionWriter};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Records a rig into a session; its scans too.
fn record_to(path: &Path, rig: Rig, periods: Option<u64>) -> (Recorded, Vec<Scan>) {
    let encoder = EncoderConfig::new(rig.timing.set_period_nanos(rig.sequence.patterns.len()));
    let metadata = SessionMetadata::new(encoder.header().mode.name(), "gv3-tests", 0);
    let writer = SessionWriter::create(SessionFile::create(path, false).unwrap(), &metadata).unwrap();
    let scans: Arc<Mutex<Vec<Scan>>> = Arc::default();
    let seen = Arc::clone(&scans);
    let settings = RecordSettings {
        scan_periods: periods,
        encoder,
        observer: Box::new(move |scan| {
            seen.lock().unwrap().push(scan.clone());
            Ok(())
        }),
        stop: Arc::default(),
        progress: Arc::default(),
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let recorded = runtime.block_on(record(rig, settings, writer)).unwrap();
    let scans = std::mem::take(&mut *scans.lock().unwrap());
    (recorded, scans)
}

type Payloads = Vec<(Vec<u8>, Option<Vec<u8>>)>;

fn payloads(path: &Path) -> (Payloads, Vec<Event>) {
    let mut reader = SessionReader::open(path).unwrap();
    let groups = (0..reader.groups().len()).map(|i| reader.read_group(i).unwrap());
    (groups.map(|g| (g.geometry, g.texture)).collect(), reader.events().unwrap())
}

fn play(path: &Path) -> RigConfig {
    RigConfig::recorded(RecordedConfig { path: path.into(), pace: Pace::Fast, is_loop: false }).unwrap()
}

#[test]
fn a_session_from_the_recording_is_the_live_one() {
    let folder = tempfile::tempdir().unwrap();
    let [live, again, raw] = ["live.gv3", "again.gv3", "raw"].map(|name| folder.path().join(name));
    let mut config = RigConfig::simulated();
    let fault = |kind, set, picture| Fault { kind, set, picture };
    config.sim.faults =
        vec![fault(FaultKind::Lost, 2, 4), fault(FaultKind::Doubled, 4, 1), fault(FaultKind::Late, 6, 2)];
    let (rig, recorder) = RawRecorder::attach(device::open(&config).unwrap(), &config, &raw).unwrap();
    let (first, first_scans) = record_to(&live, rig, Some(11));
    let kept = recorder.finish().unwrap();
    assert!(kept.is_complete(), "{kept:?}");
    // One picture lost, one twice.
    assert_eq!(kept.pictures, 66);
    assert!(kept.bytes * 2 < kept.pixel_bytes, "{kept:?}");
    let (second, second_scans) = record_to(&again, device::open(&play(&raw)).unwrap(), None);
    assert_eq!(
        (first.drops, first.frame_sets, first.raw_fringe_bytes),
        (second.drops, second.frame_sets, second.raw_fringe_bytes)
    );
    assert_eq!((first.drops.lost, first.drops.doubled, first.drops.late), (1, 1, 1));
    assert_eq!(first.rejected_pixels, second.rejected_pixels);
    assert_eq!(first_scans.len(), second_scans.len());
    for (a, b) in first_scans.iter().zip(&second_scans) {
        assert_eq!((a.tick, a.time_nanos, &a.texture), (b.tick, b.time_nanos, &b.texture));
        assert!(a.mesh == b.mesh, "tick {}", a.tick);
    }
    let (a, b) = (payloads(&live), payloads(&again));
    assert!(a.0 == b.0, "payloads differ");
    assert_eq!(a.1, b.1);
    check_sets(&raw, first.frame_sets, &first_scans);
    // A recording of the recording is the recording.
    let copy = folder.path().join("copy");
    let config = play(&raw);
    let (rig, recorder) = RawRecorder::attach(device::open(&config).unwrap(), &config, &copy).unwrap();
    gv3::pipeline::raw::run_rig(rig, None, &Default::default(), &Default::default()).unwrap();
    assert_eq!(recorder.finish().unwrap().pictures, kept.pictures);
    let [was, is] = [&raw, &copy].map(|path| verify_raw(path, true).unwrap());
    assert!(was.ok() && is.ok());
    assert_eq!((was.pictures, was.missing_pictures, was.device_time_nanos), (is.pictures, 1, is.device_time_nanos));
}

fn check_sets(raw: &Path, count: u64, scans: &[Scan]) {
    let mut sets = RawSets::open(&play(raw)).unwrap();
    let mut ticks = Vec::new();
    while let Some(set) = sets.next_set().unwrap() {
        ticks.push(set.tick);
    }
    assert_eq!(ticks, scans.iter().map(|s| s.tick).collect::<Vec<_>>());
    assert_eq!((ticks.len() as u64, sets.finish().sets()), (count, 3));
}

/// A camera that is silent once and then gone.
struct Failing {
    inner: Box<dyn Camera>,
    calls: u32,
}

impl Camera for Failing {
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
        self.calls += 1;
        match self.calls {
            8 => Err(DeviceError::Timeout("nothing on the line".into())),
            15 => Err(DeviceError::Disconnected("camera 7".into())),
            _ => self.inner.next_frame(deadline),
        }
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.inner.stop()
    }
}

#[test]
fn silence_and_unplugging_come_out_as_they_were() {
    let folder = tempfile::tempdir().unwrap();
    let raw = folder.path().join("raw");
    let config = RigConfig::simulated();
    let rig = device::open(&config).unwrap();
    let rig = Rig {
        camera: Box::new(Failing { inner: rig.camera, calls: 0 }),
        // Without waiting for the camera to come back.
        silence_limit: Duration::ZERO,
        ..rig
    };
    let (rig, recorder) = RawRecorder::attach(rig, &config, &raw).unwrap();
    let error = gv3::pipeline::raw::run_rig(rig, None, &Default::default(), &Default::default()).unwrap_err();
    assert_eq!(error.to_string(), "camera 7 is disconnected");
    assert_eq!(recorder.finish().unwrap().pictures, 13);
    let report = verify_raw(&raw, true).unwrap();
    assert!(report.ok() && report.faults == 2, "{report:?}");
    let config = play(&raw);
    let mut rig = device::open(&config).unwrap();
    rig.camera.configure(&config.camera_settings()).unwrap();
    rig.projector.load(&rig.sequence).unwrap();
    rig.camera.start().unwrap();
    rig.projector.play(&rig.timing).unwrap();
    let came: Vec<String> = (0..16)
        .map(|_| rig.camera.next_frame(Instant::now()).map_or_else(|e| e.to_string(), |f| f.sequence.to_string()))
        .collect();
    assert_eq!(came[6..9], ["6", "no picture before the deadline: nothing on the line", "7"]);
    assert_eq!((came[13].as_str(), came[14].as_str()), ("12", "camera 7 is disconnected"));
    assert!(came[15].ends_with("has ended"), "{}", came[15]);
}

#[test]
fn what_was_recorded_after_an_unplugging_is_played_too() {
    let folder = tempfile::tempdir().unwrap();
    let raw = folder.path().join("raw");
    let mut config = RigConfig::simulated();
    config.sim.faults = vec![Fault { kind: FaultKind::Unplugged, set: 2, picture: 3 }];
    let (rig, recorder) = RawRecorder::attach(device::open(&config).unwrap(), &config, &raw).unwrap();
    let (sets, drops) = gv3::pipeline::raw::run_rig(rig, Some(36), &Default::default(), &Default::default()).unwrap();
    assert!(recorder.finish().unwrap().is_complete());
    assert!(sets >= 4 && drops.lost >= 30, "{sets} {drops:?}");
    let rig = device::open(&play(&raw)).unwrap();
    let again = gv3::pipeline::raw::run_rig(rig, None, &Default::default(), &Default::default()).unwrap();
    assert_eq!(again, (sets, drops));
    let mut played = RawSets::open(&play(&raw)).unwrap();
    let mut ticks = Vec::new();
    while let Some(set) = played.next_set().unwrap() {
        assert!(set.frames.iter().enumerate().all(|(i, f)| usize::from(f.pattern.0) == i));
        ticks.push(set.tick);
    }
    assert_eq!((ticks.len() as u64, played.finish()), (sets, drops));
    assert!(ticks[..2] == [0, 1] && ticks[2] > 30 && ticks.is_sorted(), "{ticks:?}");
}

#[test]
fn a_torn_recording_plays_to_its_last_whole_picture() {
    let folder = tempfile::tempdir().unwrap();
    let raw = folder.path().join("raw");
    let config = RigConfig::simulated();
    let (rig, recorder) = RawRecorder::attach(device::open(&config).unwrap(), &config, &raw).unwrap();
    gv3::pipeline::raw::run_rig(rig, Some(3), &Default::default(), &Default::default()).unwrap();
    recorder.finish().unwrap();
    let path = raw.join("pictures_000000.gv3raw");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() * 3 / 4]).unwrap();
    let report = verify_raw(&raw, true).unwrap();
    assert!(!report.ok() && report.end.is_none() && report.pictures >= 12, "{report:?}");
    let (recorded, _) = record_to(&folder.path().join("s.gv3"), device::open(&play(&raw)).unwrap(), None);
    assert_eq!(recorded.frame_sets, 2);
}
