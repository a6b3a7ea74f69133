//! The engine on the simulated rig: recordings, faults of disk and devices, stopping in every state.

use super::*;
use crate::files::SessionsConfig;
use crate::replay::Replay;
use gv3_protocol::session::{Event, EventKind, verify};
use std::path::Path;
use std::time::Duration;

/// Far longer than anything takes on the slowest machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// The simulated scanner with a camera of 160x120 at 30 scans a second: little work.
fn small_rig() -> RigConfig {
    let mut rig = RigConfig::simulated();
    let mut calibration = rig.calibration.unwrap();
    let camera = &mut calibration.camera;
    (camera.width_px, camera.height_px) = (160, 120);
    for px in [&mut camera.fx_px, &mut camera.fy_px, &mut camera.cx_px, &mut camera.cy_px] {
        *px /= 4.0;
    }
    rig.calibration = Some(calibration);
    (rig.camera.width_px, rig.camera.height_px) = (160, 120);
    rig.limits.mesh.min_piece_px = 50;
    rig
}

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
