//! The daemon as a process under a service manager: what it says on the manager's socket, and SIGTERM in every state.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::{Place, Run, command};
use gv3_protocol::session::verify;
use std::io::{BufRead, BufReader};
use std::os::unix::net::UnixDatagram;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// Far longer than anything takes on the slowest machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// A daemon on the simulated scanner; killed when a test fails.
struct Daemon {
    child: Child,
    /// What it told the manager, who reads all the time.
    heard: Receiver<String>,
    address: String,
}

/// Binds the manager's socket and reads it from a thread, which ends with the receiver.
fn manage(place: &Place) -> Receiver<String> {
    let path = place.path("notify");
    // Of the daemon before; its manager is gone.
    let _ = std::fs::remove_file(&path);
    let manager = UnixDatagram::bind(path).unwrap();
    let (heard, told) = channel();
    std::thread::spawn(move || {
        let mut buffer = [0; 512];
        while let Ok(count) = manager.recv(&mut buffer) {
            if heard.send(String::from_utf8_lossy(&buffer[..count]).into_owned()).is_err() {
                return;
            }
        }
    });
    told
}

impl Daemon {
    /// Starts it and waits until it is ready.
    fn start(place: &Place) -> Self {
        let heard = manage(place);
        let mut command = command(&["serve", "--sim", "--sessions", "sessions", "--listen", "127.0.0.1:0"]);
        command.current_dir(place.path(".")).stdout(Stdio::null()).stderr(Stdio::piped());
        command.env("NOTIFY_SOCKET", place.path("notify")).env("WATCHDOG_USEC", "400000").env_remove("WATCHDOG_PID");
        let mut child = command.spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let address = lines.find_map(|line| Some(line.split_once("http://")?.1.split_once('/')?.0.to_owned())).unwrap();
        // Its messages are read on, so that it never waits for a reader.
        std::thread::spawn(move || lines.for_each(drop));
        let daemon = Self { child, heard, address };
        daemon.hears("READY=1");
        daemon
    }

    /// Waits for a message to the manager with this line.
    fn hears(&self, line: &str) {
        let begin = Instant::now();
        while !self.heard.recv_timeout(PATIENCE).unwrap().lines().any(|l| l.starts_with(line)) {
            assert!(begin.elapsed() < PATIENCE, "{line} never came");
        }
    }

    fn ctl(&self, place: &Place, arguments: &str) -> Run {
        place.gv3(&format!("ctl --server {} {arguments}", self.address))
    }

    fn signal(&self, name: &str) {
        assert!(Command::new("kill").args([name, &self.child.id().to_string()]).status().unwrap().success());
    }

    /// SIGTERM, and it ends as it should.
    fn stop(mut self) {
        self.signal("-TERM");
        self.hears("STOPPING=1");
        let begin = Instant::now();
        let status = loop {
            match self.child.try_wait().unwrap() {
                Some(status) => break status,
                None => assert!(begin.elapsed() < PATIENCE, "it never ended"),
            }
            std::thread::sleep(Duration::from_millis(5));
        };
        assert_eq!(status.code(), Some(0));
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn the_manager_hears_of_it_all_and_sigterm_leaves_whole_files_in_every_state() {
    let place = Place::new();
    // Idle; with a configuration read again, and a watchdog that is fed.
    let daemon = Daemon::start(&place);
    daemon.signal("-HUP");
    daemon.hears("RELOADING=1");
    daemon.hears("READY=1");
    daemon.hears("WATCHDOG=1");
    daemon.stop();
    // Previewing, and fed by frame sets that become scans.
    let daemon = Daemon::start(&place);
    daemon.ctl(&place, "preview").done();
    daemon.hears("WATCHDOG=1");
    daemon.hears("WATCHDOG=1");
    daemon.stop();
    // At the beginning of a recording, and in the middle of one.
    for (name, scans) in [("early", 0), ("later", 12)] {
        let daemon = Daemon::start(&place);
        daemon.ctl(&place, &format!("start {name}")).done();
        let begin = Instant::now();
        while daemon.ctl(&place, "status --json").json()["recording"]["scans"].as_u64().unwrap() < scans {
            assert!(begin.elapsed() < PATIENCE, "no scans came");
            std::thread::sleep(Duration::from_millis(100));
        }
        daemon.stop();
        let path = place.path(&format!("sessions/{name}.gv3"));
        // Stopped at once there may be no scan, and then there is no file.
        if scans > 0 || path.exists() {
            let verified = verify(&path).unwrap();
            assert!(verified.ok() && verified.finished, "{name}: {:?}", verified.problems);
        }
    }
}
