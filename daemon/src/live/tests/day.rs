//! A day of work in virtual time: a scan every ten seconds, recordings that begin and end, files that rotate, sessions that
//! expire.

use super::*;
use crate::live::gate::Gate;
use crate::store::{Retention, SessionDirectory, expire};
use std::time::{SystemTime, UNIX_EPOCH};

/// Picture period of six pictures in ten seconds, or a little less: what is six hours old is not older.
const PICTURE_NANOS: u64 = 1_666_666_666;
const PICTURES_A_SET: u64 = 6;
/// Of every hour, 50 minutes are recorded, in files of 20 minutes.
const RECORDED_SCANS: u64 = 300;
const PAUSED_SCANS: u64 = 60;
const SEGMENT_SECONDS: f64 = 1200.0;
const FILES_A_RECORDING: usize = 3;
const KEEP_HOURS: u64 = 6;

/// A day, or some hours of it, on an engine of its own.
struct Day {
    folder: tempfile::TempDir,
    live: Live,
    gate: Gate,
}

impl Day {
    fn begin() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut config = config(folder.path());
        config.rig.timing.picture_period_nanos = PICTURE_NANOS;
        config.rig.sim.motion = 0.0;
        config.sessions.segment_seconds = Some(SEGMENT_SECONDS);
        let (gate, ground) = Gate::new(&config.rig);
        Self { folder, live: Live::open_on(config, ground).unwrap(), gate }
    }

    fn sessions(&self) -> PathBuf {
        self.folder.path().join("sessions")
    }

    fn now(&self) -> SystemTime {
        UNIX_EPOCH
            + Duration::from_secs(2_000_000_000)
            + Duration::from_nanos(PICTURE_NANOS * PICTURES_A_SET) * self.gate.scans() as u32
    }

    /// Records for 50 minutes; every file is whole and as old as it is in virtual time.
    fn record(&mut self, name: &str) {
        self.live.start_recording(named(name)).unwrap();
        self.gate.pass(&self.live, RECORDED_SCANS);
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
        day.gate.pass(&day.live, PAUSED_SCANS);
    }
    assert_eq!(day.live.metrics().drops, BTreeMap::new());
    let Day { folder: _folder, live, gate } = day;
    drop(gate);
    live.shut_down().unwrap();
}

/// 300 scans in three files, and 60 that nobody records.
#[test]
fn an_hour_of_recording_rotating_and_pausing_loses_nothing() {
    work_for(1);
}

/// `cargo test -p gv3 --lib live::tests::day -- --ignored`: 8640 scans.
#[test]
#[ignore = "takes minutes"]
fn a_day_of_starting_stopping_rotating_and_expiring_loses_nothing() {
    work_for(24);
}
