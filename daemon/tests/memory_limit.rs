//! A limit on memory: a recording at full rate stays far within that of the service, and what a limit kills recovers.
//! `cargo test -p gv3 --test memory_limit -- --ignored`.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::{Place, command};
use gv3_protocol::session::{SessionReader, recover, verify};
use rustix::process::{Pid, Resource, Rlimit, prlimit};
use std::path::PathBuf;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

/// Far longer than anything takes on the slowest machine.
const PATIENCE: Duration = Duration::from_secs(300);
/// Of data in memory, bytes; the service's MemoryMax is twice that.
const LIMIT: u64 = 512 << 20;

/// The engine recording live; killed when a test fails.
struct Recording(Child);

impl Recording {
    fn start(place: &Place, seconds: &str) -> Self {
        let arguments = ["bench", "live", "--sim", "--patterns", "3", "--seconds", seconds, "--folder", "."];
        let mut command = command(&arguments);
        command.current_dir(place.path(".")).stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().unwrap())
    }

    /// Sets a limit on the data that it may have, as `ulimit -d` does.
    fn limit(&self, bytes: u64) {
        let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
        prlimit(Some(Pid::from_child(&self.0)), Resource::Data, limit).unwrap();
    }

    fn wait(&mut self) -> std::process::ExitStatus {
        let begin = Instant::now();
        loop {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status;
            }
            assert!(begin.elapsed() < PATIENCE, "it never ended");
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn session(place: &Place) -> Option<PathBuf> {
    let name = place.names().into_iter().find(|name| name.ends_with("sessions/bench.gv3"))?;
    Some(place.path(&name))
}

fn groups(place: &Place) -> usize {
    session(place).and_then(|path| SessionReader::open(path).ok()).map_or(0, |reader| reader.groups().len())
}

#[test]
#[ignore = "slow: records at full rate"]
fn full_rate_stays_within_a_limit() {
    let place = Place::new();
    let mut recording = Recording::start(&place, "3");
    recording.limit(LIMIT);
    assert!(recording.wait().success());
}

#[test]
#[ignore = "slow: records at full rate"]
fn what_a_limit_kills_recovers_to_its_last_group() {
    let place = Place::new();
    let mut recording = Recording::start(&place, "3600");
    let begin = Instant::now();
    while groups(&place) < 2 {
        assert!(begin.elapsed() < PATIENCE, "no group came");
        std::thread::sleep(Duration::from_millis(5));
    }
    // Less than it has: nothing can be added.
    recording.limit(1 << 20);
    assert!(!recording.wait().success());
    let killed = session(&place).unwrap();
    let complete = SessionReader::open(&killed).unwrap().groups().len();
    assert!(complete >= 2);
    let whole = place.path("whole.gv3");
    assert_eq!(recover(&killed, &whole, false).unwrap().groups, complete);
    let verified = verify(&whole).unwrap();
    assert!(verified.ok() && verified.finished, "{:?}", verified.problems);
}
