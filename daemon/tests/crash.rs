//! A recording that is killed keeps every complete group; one that is told to stop finishes its file.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::{Place, Run, command};
use gv3_protocol::session::{SessionReader, SessionState};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Far longer than a recording needs to get anywhere on the slowest machine.
const PATIENCE: Duration = Duration::from_secs(300);

/// A recording in progress; killed when a test fails.
struct Recording(Option<Child>);

impl Recording {
    fn start(place: &Place) -> Self {
        let mut command = command(&["capture", "killed.gv3", "--sim", "--seconds", "20"]);
        command.current_dir(place.path(".")).stdout(Stdio::piped()).stderr(Stdio::piped());
        Self(Some(command.spawn().unwrap()))
    }

    /// Waits until the file holds so many complete groups.
    fn wait_for_groups(&mut self, place: &Place, count: usize) {
        let begin = Instant::now();
        loop {
            let groups = SessionReader::open(place.path("killed.gv3")).map(|r| r.groups().len());
            if groups.is_ok_and(|n| n >= count) {
                return;
            }
            let ended = self.0.as_mut().unwrap().try_wait().unwrap();
            assert!(ended.is_none() && begin.elapsed() < PATIENCE, "{count} groups never came: {ended:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn kill(mut self) {
        let mut child = self.0.take().unwrap();
        child.kill().unwrap();
        assert_eq!(child.wait().unwrap().code(), None, "ended by itself");
    }

    /// Sends a signal and waits for the end.
    fn signal(mut self, signal: &str) -> Run {
        let child = self.0.take().unwrap();
        let sent = Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
        assert!(sent.success());
        Run::of(child.wait_with_output().unwrap())
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        if let Some(mut child) = self.0.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

#[test]
fn killed_before_the_first_group_there_is_nothing_and_nothing_is_made_up() {
    let place = Place::new();
    let mut recording = Recording::start(&place);
    recording.wait_for_groups(&place, 0);
    recording.kill();
    // The first group may have come between the look and the kill.
    if SessionReader::open(place.path("killed.gv3")).unwrap().groups().is_empty() {
        place.gv3("info killed.gv3").failed(&["killed.gv3", "no complete group"]);
        place.gv3("decode killed.gv3 -o back").failed(&["killed.gv3", "no complete group"]);
        place.gv3("recover killed.gv3 -o whole.gv3").failed(&["killed.gv3", "nothing to recover"]);
        assert_eq!(place.names(), ["killed.gv3"]);
    }
}

#[test]
fn killed_after_some_groups_these_replay_and_recover() {
    for (groups, later_millis) in [(1, 0), (1, 300), (2, 0)] {
        let place = Place::new();
        let mut recording = Recording::start(&place);
        recording.wait_for_groups(&place, groups);
        std::thread::sleep(Duration::from_millis(later_millis));
        recording.kill();
        check_killed(&place, groups);
    }
}

/// The file of a recording that was killed after `groups` complete groups or more.
fn check_killed(place: &Place, groups: usize) {
    let reader = SessionReader::open(place.path("killed.gv3")).unwrap();
    let SessionState::Unfinished { complete_groups, .. } = reader.state() else { panic!("{:?}", reader.state()) };
    assert!(*complete_groups >= groups && *complete_groups == reader.groups().len());
    let last = reader.groups()[complete_groups - 1].key_tick;
    let info = place.gv3("info killed.gv3").done();
    assert!(info.contains(&format!("unfinished: {complete_groups} complete groups")), "{info}");
    let info = place.gv3("info killed.gv3 --json").json();
    assert_eq!((info["scans"].as_u64(), info["last_tick"].as_u64()), (Some(last + 1), Some(last)));
    assert!(info["has_calibration"].as_bool().unwrap());
    assert_eq!(place.gv3("verify killed.gv3").code, Some(1));

    place.gv3("recover killed.gv3 -o whole.gv3").done();
    place.gv3("verify whole.gv3").done();
    assert!(place.gv3("info whole.gv3").done().starts_with("whole.gv3: finished"));
    let ticks = format!("--scans 0..{last}");
    let [a, b] =
        ["killed", "whole"].map(|name| place.gv3(&format!("decode {name}.gv3 -o {name} --json {ticks}")).json());
    assert_eq!((a["files"].as_u64(), b["files"].as_u64()), (Some(last + 1), Some(last + 1)));
    let names = place.names();
    let files: Vec<&str> = names.iter().filter_map(|n| n.strip_prefix("killed/")).collect();
    assert_eq!(files.len() as u64, 3 * (last + 1));
    for file in files {
        assert!(place.read(&format!("killed/{file}")) == place.read(&format!("whole/{file}")), "{file} differs");
    }
    place.gv3("recover killed.gv3").done();
    assert!(place.read("killed.gv3") == place.read("whole.gv3"), "recovery in place differs");
}

#[test]
fn told_to_stop_a_recording_finishes_its_file() {
    for signal in ["-INT", "-TERM"] {
        let place = Place::new();
        let mut recording = Recording::start(&place);
        recording.wait_for_groups(&place, 1);
        let report = recording.signal(signal).done();
        assert!(report.starts_with("killed.gv3: "), "{report}");
        assert!(place.gv3("info killed.gv3").done().starts_with("killed.gv3: finished"));
        place.gv3("verify killed.gv3").done();
    }
}
