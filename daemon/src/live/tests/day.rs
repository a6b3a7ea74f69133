//! A day of work in virtual time: a scan every ten seconds, recordings that begin and end, files that rotate, sessions that
//! expire.

use super::*;
use crate::store::{Retention, SessionDirectory, expire};
use std::time::{SystemTime, UNIX_EPOCH};

/// Picture period of six pictures in ten seconds.
const PICTURE_NANOS: u64 = 1_666_666_667;
const PICTURES_A_SET: u64 = 6;
/// Of every hour, 50 minutes are recorded, in files of 20 minutes.
const RECORDED_SCANS: u64 = 300;
const PAUSED_SCANS: u64 = 60;
const SEGMENT_SECONDS: f64 = 1200.0;
const FILES_A_RECORDING: usize = 3;
const KEEP_HOURS: u64 = 6;
/// Sets that may be on their way at once; the queue before reconstruction takes more.
const MOST_UNDERWAY: u64 = 4;

/// A live camera whose time stands still but for the pictures that are allowed.
struct GatedCamera {
    inner: Box<dyn Camera>,
    allowed: Arc<AtomicU64>,
    given: u64,
}

impl Camera for GatedCamera {
    fn info(&self) -> CameraInfo {
        CameraInfo { waits_for_reader: false, ..self.inner.info() }
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        self.inner.configure(want)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        self.inner.start()
    }

    /// The deadline is one of real time, which does not count here.
    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        while self.given >= self.allowed.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_micros(200));
        }
        self.given += 1;
        self.inner.next_frame(deadline)
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.inner.stop()
    }
}

/// A day, or some hours of it, on an engine of its own.
struct Day {
    folder: tempfile::TempDir,
    live: Live,
    allowed: Arc<AtomicU64>,
    scans: u64,
}

impl Day {
    fn begin() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let allowed = Arc::new(AtomicU64::new(0));
        let gate = Arc::clone(&allowed);
        let open_rig = move |config: &RigConfig| {
            let rig = device::open(config)?;
            Ok(Rig { camera: Box::new(GatedCamera { inner: rig.camera, allowed: Arc::clone(&gate), given: 0 }), ..rig })
        };
        let mut config = config(folder.path());
        config.rig.timing.picture_period_nanos = PICTURE_NANOS;
        config.rig.sim.motion = 0.0;
        config.sessions.segment_seconds = Some(SEGMENT_SECONDS);
        let live = Live::open_on(config, Ground { open_rig: Box::new(open_rig), ..Ground::default() }).unwrap();
        Self { folder, live, allowed, scans: 0 }
    }

    fn sessions(&self) -> PathBuf {
        self.folder.path().join("sessions")
    }

    /// Lets so many scans pass.
    fn pass(&mut self, scans: u64) {
        let end = self.scans + scans;
        while self.scans < end {
            self.scans = (self.scans + MOST_UNDERWAY).min(end);
            self.allowed.store(self.scans * PICTURES_A_SET, Ordering::Relaxed);
            wait_until("a scan", || self.live.metrics().scans >= self.scans);
        }
    }

    fn now(&self) -> SystemTime {
        UNIX_EPOCH
            + Duration::from_secs(2_000_000_000)
            + Duration::from_nanos(PICTURE_NANOS * PICTURES_A_SET) * self.scans as u32
    }

    /// Records for 50 minutes; every file is whole and as old as it is in virtual time.
    fn record(&mut self, name: &str) {
        self.live.start_recording(named(name)).unwrap();
        self.pass(RECORDED_SCANS);
        let stopped = self.live.stop_recording().unwrap();
        assert!(stopped.verified, "{stopped:?}");
        assert_eq!((stopped.scans, stopped.files.len()), (RECORDED_SCANS, FILES_A_RECORDING), "{stopped:?}");
        for file in &stopped.files {
            let path = self.sessions().join(file);
            check_session(&path);
            std::fs::File::options().write(true).open(path).unwrap().set_modified(self.now()).unwrap();
        }
    }
}

fn work_for(hours: u64) {
    let mut day = Day::begin();
    let directory = SessionDirectory::open(&day.sessions()).unwrap();
    let retention = Retention { keep_days: Some(KEEP_HOURS as f64 / 24.0), keep_bytes: None };
    day.live.start_scanner().unwrap();
    for hour in 0..hours {
        day.record(&format!("hour{hour:02}"));
        expire(&directory, &retention, day.now(), None).unwrap();
        let kept: Vec<String> = directory.list(None).unwrap().iter().map(|s| s.name.to_string()).collect();
        let expected: Vec<String> = (hour.saturating_sub(KEEP_HOURS)..=hour).map(|h| format!("hour{h:02}")).collect();
        assert_eq!(kept.len(), expected.len(), "{kept:?}");
        assert!(expected.iter().all(|name| kept.contains(name)), "{kept:?}");
        day.pass(PAUSED_SCANS);
    }
    assert_eq!(day.live.metrics().drops, BTreeMap::new());
    day.allowed.store(u64::MAX, Ordering::Relaxed);
    day.live.clone().shut_down().unwrap();
}

/// `cargo test -p gv3 --lib live::tests::day -- --ignored`: 720 scans.
#[test]
#[ignore = "slow"]
fn hours_of_starting_stopping_and_rotating_lose_nothing() {
    work_for(2);
}

/// `cargo test -p gv3 --lib live::tests::day -- --ignored`: 8640 scans.
#[test]
#[ignore = "takes minutes"]
fn a_day_of_starting_stopping_rotating_and_expiring_loses_nothing() {
    work_for(24);
}
