//! `gv3 serve` as a process: signals in every state, kill, configurations that are wrong, directories that refuse.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]
#![cfg(target_os = "linux")]

mod common;

use common::test_rig::small_rig;
use common::{Place, command};
use gv3_protocol::session::{SessionReader, verify};
use rustix::fs::IFlags;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, ChildStderr, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// Far longer than anything takes on the slowest machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// A folder with a rig file.
fn place() -> Place {
    let place = Place::new();
    place.write("rig.toml", rig_text());
    place
}

fn rig_text() -> String {
    let floors = "\n[sessions]\nfree_floor_bytes = 0\nfree_floor_percent = 0.0\n";
    toml::to_string(&small_rig()).unwrap() + floors
}

/// A daemon; killed when a test fails.
struct Daemon {
    child: Child,
    log: BufReader<ChildStderr>,
    address: String,
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn spawn(place: &Place) -> Child {
    let arguments = ["serve", "--config", "rig.toml", "--listen", "127.0.0.1:0"];
    command(&arguments).current_dir(place.path(".")).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap()
}

impl Daemon {
    fn start(place: &Place) -> Self {
        let mut child = spawn(place);
        let log = BufReader::new(child.stderr.take().unwrap());
        let mut daemon = Self { child, log, address: String::new() };
        let line = daemon.wait_for_line("serving http://");
        let rest = line.split("http://").nth(1).unwrap();
        daemon.address = rest.split('/').next().unwrap().to_owned();
        daemon
    }

    /// The next line of the log that contains a text.
    #[track_caller]
    fn wait_for_line(&mut self, text: &str) -> String {
        let mut all = String::new();
        loop {
            let begin = all.len();
            assert!(self.log.read_line(&mut all).unwrap() > 0, "{text} is not in: {all}");
            if all[begin..].contains(text) {
                return all[begin..].to_owned();
            }
        }
    }

    /// Status and body of an answer.
    fn ask(&self, method: &str, path: &str, body: &str) -> (u16, Value) {
        let mut stream = TcpStream::connect(&self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let head = format!("{method} /api/v1{path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n", self.address);
        let length = format!("Content-Type: application/json\r\nContent-Length: {}\r\n\r\n", body.len());
        stream.write_all((head + &length + body).as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        // A picture's bytes are not looked at.
        let answer = String::from_utf8_lossy(&answer);
        let status = answer.split(' ').nth(1).unwrap().parse().unwrap();
        let body = answer.split_once("\r\n\r\n").map_or("", |(_, body)| body);
        (status, serde_json::from_str(body).unwrap_or_default())
    }

    fn post(&self, path: &str, body: &str) -> u16 {
        self.ask("POST", path, body).0
    }

    #[track_caller]
    fn wait_until(&self, what: &str, is_so: impl Fn(&Value) -> bool) {
        let begin = Instant::now();
        while !is_so(&self.ask("GET", "/status", "").1) {
            assert!(begin.elapsed() < PATIENCE, "{what} never came: {}", self.ask("GET", "/status", "").1);
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn record(&self, name: &str, scans: u64) {
        assert_eq!(self.post("/recording/start", &format!("{{\"name\":\"{name}\"}}")), 201);
        self.wait_until("scans", |s| s["recording"]["scans"].as_u64().is_some_and(|n| n >= scans));
    }

    fn signal(&self, signal: Signal) {
        send(&self.child, signal);
    }

    /// Waits for the end, reading on what it says.
    fn wait(mut self) -> ExitStatus {
        let mut rest = String::new();
        self.log.read_to_string(&mut rest).unwrap();
        assert!(!rest.contains("panicked"), "{rest}");
        self.child.wait().unwrap()
    }
}

fn send(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).unwrap();
}

/// Every file of a session, whole; its scans.
#[track_caller]
fn check_session(path: &Path) {
    let report = verify(path).unwrap();
    assert!(report.ok() && report.finished, "{report:?}");
}

#[test]
fn sigterm_ends_it_well_in_every_state() {
    let place = place();
    for state in ["idle", "starting", "previewing", "recording", "stopping"] {
        let daemon = Daemon::start(&place);
        match state {
            "previewing" => {
                assert_eq!(daemon.post("/scanner/start", ""), 204);
                daemon.wait_until("a scan", |s| s["scans_per_second"].as_f64() > Some(0.0));
            }
            "recording" | "stopping" => daemon.record(state, 15),
            _ => {}
        }
        // Sent without waiting for what comes of it.
        let asked = match state {
            "starting" => Some("/recording/start"),
            "stopping" => Some("/recording/stop"),
            _ => None,
        };
        let waiting = asked.map(|path| {
            let mut stream = TcpStream::connect(&daemon.address).unwrap();
            let head = format!("POST /api/v1{path} HTTP/1.1\r\nHost: {}\r\n", daemon.address);
            stream.write_all((head + "Content-Length: 0\r\n\r\n").as_bytes()).unwrap();
            stream
        });
        std::thread::sleep(Duration::from_millis(if state == "starting" { 3 } else { 0 }));
        daemon.signal(Signal::TERM);
        assert_eq!(daemon.wait().code(), Some(0), "{state}");
        drop(waiting);
    }
    let files: Vec<String> = place.names().into_iter().filter(|n| n.ends_with(".gv3")).collect();
    files.iter().for_each(|file| check_session(&place.path(file)));
    for state in ["recording", "stopping"] {
        assert!(files.contains(&format!("sessions/{state}.gv3")), "{files:?}");
    }
    place.gv3("verify sessions/recording.gv3").done();
}

#[test]
fn sigterm_at_any_moment_of_the_start_ends_it() {
    let place = place();
    for millis in [0, 5, 10, 20, 40, 80, 160] {
        let mut child = spawn(&place);
        std::thread::sleep(Duration::from_millis(millis));
        send(&child, Signal::TERM);
        let mut log = String::new();
        child.stderr.take().unwrap().read_to_string(&mut log).unwrap();
        let ended = child.wait().unwrap();
        // Before it looks out for signals there is nothing to finish.
        assert!(ended.success() || ended.signal() == Some(Signal::TERM.as_raw()), "{millis} ms: {ended} {log}");
    }
    let daemon = Daemon::start(&place);
    daemon.signal(Signal::INT);
    assert_eq!(daemon.wait().code(), Some(0));
}

#[test]
fn a_wrong_configuration_changes_nothing_and_a_right_one_is_taken() {
    let place = place();
    let mut daemon = Daemon::start(&place);
    daemon.record("on", 1);
    let other = rig_text().replace("simulated scanner", "another");
    for wrong in ["", "name = [", "\0\0\0", &rig_text().replace("160", "161"), &other] {
        place.write("rig.toml", wrong);
        daemon.signal(Signal::HUP);
        daemon.wait_for_line("the old one stays");
        let code = daemon.post("/config/reload", "");
        assert!([409, 422].contains(&code), "{code}");
        let status = daemon.ask("GET", "/status", "").1;
        assert_eq!((&status["state"], &status["rig"]), (&"recording".into(), &"simulated scanner".into()));
    }
    assert_eq!(daemon.post("/recording/stop", ""), 200);
    daemon.signal(Signal::HUP);
    daemon.wait_for_line("configuration reloaded");
    assert_eq!(daemon.ask("GET", "/status", "").1["rig"], "another");
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.wait().code(), Some(0));
    check_session(&place.path("sessions/on.gv3"));
}

#[test]
fn what_a_killed_daemon_left_is_repaired_by_the_next() {
    let place = place();
    let daemon = Daemon::start(&place);
    daemon.record("killed", 25);
    daemon.signal(Signal::KILL);
    assert_eq!(daemon.wait().signal(), Some(9));
    let path = place.path("sessions/killed.gv3");
    let groups = SessionReader::open(&path).unwrap().groups().len();
    assert!(groups >= 3 && !verify(&path).unwrap().finished);
    // A repair that was killed, too.
    place.write("sessions/killed.gv3.part", "half");
    let mut daemon = Daemon::start(&place);
    daemon.wait_for_line("unfinished session repaired");
    let listed = daemon.ask("GET", "/sessions", "").1;
    assert_eq!(
        (&listed["sessions"][0]["name"], &listed["sessions"][0]["state"]),
        (&"killed".into(), &"complete".into())
    );
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.wait().code(), Some(0));
    check_session(&path);
    assert_eq!(SessionReader::open(&path).unwrap().groups().len(), groups);
    assert!(!place.path("sessions/killed.gv3.part").exists());
}

/// A folder in which nothing can be made, not even by root, as long as this lives.
struct Frozen(File);

impl Frozen {
    fn new(folder: &Path) -> Option<Self> {
        let folder = File::open(folder).unwrap();
        rustix::fs::ioctl_setflags(&folder, IFlags::IMMUTABLE).ok()?;
        Some(Self(folder))
    }
}

impl Drop for Frozen {
    fn drop(&mut self) {
        let _ = rustix::fs::ioctl_setflags(&self.0, IFlags::empty());
    }
}

#[test]
fn a_directory_that_becomes_read_only_refuses_recordings_and_nothing_else() {
    let place = place();
    let daemon = Daemon::start(&place);
    daemon.record("before", 12);
    let Some(frozen) = Frozen::new(&place.path("sessions")) else {
        println!("skipped: this user or this file system cannot make a folder immutable");
        return;
    };
    // The open file is not concerned.
    let (code, stopped) = daemon.ask("POST", "/recording/stop", "");
    assert_eq!((code, &stopped["verified"]), (200, &true.into()), "{stopped}");
    let (code, problem) = daemon.ask("POST", "/recording/start", "{\"name\":\"refused\"}");
    assert!(code == 503 && problem["detail"].as_str().unwrap().contains("refused.gv3"), "{code} {problem}");
    let codes = [
        daemon.ask("PATCH", "/sessions/before", "{\"name\":\"after\"}").0,
        daemon.ask("DELETE", "/sessions/before", "").0,
        daemon.ask("GET", "/sessions/before", "").0,
        daemon.ask("GET", "/sessions/before/thumbnail.png", "").0,
    ];
    assert_eq!(codes, [500, 500, 200, 200]);
    daemon.wait_until("scans", |s| s["state"] == "previewing" && s["scans_per_second"].as_f64() > Some(0.0));
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.wait().code(), Some(0));
    // A daemon that could not record at all does not begin.
    drop(frozen);
    std::fs::remove_file(place.path("sessions/.gv3.lock")).unwrap();
    let frozen = Frozen::new(&place.path("sessions")).unwrap();
    place.gv3("serve --config rig.toml --listen 127.0.0.1:0").failed(&["sessions", "cannot create"]);
    drop(frozen);
    let daemon = Daemon::start(&place);
    daemon.record("again", 1);
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.wait().code(), Some(0));
    check_session(&place.path("sessions/again.gv3"));
}
