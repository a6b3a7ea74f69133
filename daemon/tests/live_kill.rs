//! A live recording that is killed at any moment recovers to its last complete group.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::{Place, command};
use gv3_protocol::session::{SessionReader, recover, verify};
use std::path::PathBuf;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

/// Far longer than a recording needs to get anywhere on the slowest machine.
const PATIENCE: Duration = Duration::from_secs(300);

/// The engine recording live; killed when a test fails.
struct Recording(Child);

impl Drop for Recording {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(place: &Place) -> Recording {
    let mut command = command(&["bench", "live", "--sim", "--patterns", "3", "--seconds", "3600", "--folder", "."]);
    command.current_dir(place.path(".")).stdout(Stdio::null()).stderr(Stdio::null());
    Recording(command.spawn().unwrap())
}

fn session(place: &Place) -> Option<PathBuf> {
    let name = place.names().into_iter().find(|name| name.ends_with("sessions/bench.gv3"))?;
    Some(place.path(&name))
}

/// Groups that a reader sees.
fn groups(place: &Place) -> usize {
    session(place).and_then(|path| SessionReader::open(path).ok()).map_or(0, |reader| reader.groups().len())
}

/// Kills a recording some time after its first group, and checks what is left.
fn kill_after(delay: Duration) {
    let place = Place::new();
    let recording = start(&place);
    let begin = Instant::now();
    while groups(&place) == 0 {
        assert!(begin.elapsed() < PATIENCE, "no group came");
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(delay);
    let seen = groups(&place);
    drop(recording);
    let killed = session(&place).unwrap();
    let complete = SessionReader::open(&killed).unwrap().groups().len();
    assert!(complete >= seen, "{complete} groups, {seen} were there before");
    let whole = place.path("whole.gv3");
    let report = recover(&killed, &whole, false).unwrap();
    assert_eq!(report.groups, complete, "after {delay:?}: {report:?}");
    let verified = verify(&whole).unwrap();
    assert!(verified.ok() && verified.finished, "after {delay:?}: {:?}", verified.problems);
    place.gv3("verify whole.gv3").done();
}

/// Times from nothing to more than two groups take, each different.
fn kill_often(times: u64) {
    for n in 0..times {
        kill_after(Duration::from_micros(n * 618_034 % 1_000_000));
    }
}

#[test]
fn killed_live_it_recovers() {
    kill_often(3);
}

/// `cargo test -p gv3 --test live_kill -- --ignored`: some ten minutes.
#[test]
#[ignore = "takes ten minutes"]
fn killed_live_200_times_it_recovers() {
    kill_often(200);
}
