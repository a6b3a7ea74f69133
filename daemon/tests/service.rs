//! The service as systemd sees it: the installed units are valid, and little of the machine is open to them.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::Place;
use std::process::{Command, Output};

/// What `systemd-analyze security` may say at most, in tenths; 100 is a service with nothing closed.
const MOST_EXPOSURE: &str = "20";

/// The tool with these arguments; `None`, and a word why, where it is not there.
fn systemd_analyze(place: &Place, arguments: &[&str]) -> Option<Output> {
    let mut command = Command::new("systemd-analyze");
    // The user's manager is looked for here.
    command.args(arguments).current_dir(place.path(".")).env("XDG_RUNTIME_DIR", place.path("."));
    match command.output() {
        Ok(output) if String::from_utf8_lossy(&output.stderr).contains("unrecognized option") => {
            eprintln!("skipped: systemd-analyze is too old for {arguments:?}");
            None
        }
        Ok(output) => Some(output),
        Err(error) => {
            eprintln!("skipped: systemd-analyze cannot be run: {error}");
            None
        }
    }
}

/// Installs below a folder and gives a unit there that names the program where it really is.
fn unit(place: &Place, installed: &str, arguments: &str) -> String {
    place.gv3(&format!("install --root root {arguments}")).done();
    let text = String::from_utf8(place.read(installed)).unwrap();
    let line = text.lines().find(|line| line.starts_with("ExecStart=")).unwrap();
    let program = line.strip_prefix("ExecStart=").unwrap().split(' ').next().unwrap();
    place.write("gv3.service", text.replace(line, &line.replace(program, env!("CARGO_BIN_EXE_gv3"))));
    place.path("gv3.service").to_str().unwrap().to_owned()
}

#[track_caller]
fn is_accepted(output: &Output) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    // A warning about what the unit says names it.
    let said = text(&output.stderr);
    assert!(output.status.success() && !said.contains("gv3.service:"), "{said}{}", text(&output.stdout));
}

#[test]
fn systemd_takes_the_unit_of_the_machine_and_finds_it_closed() {
    let place = Place::new();
    let unit = unit(&place, "root/etc/systemd/system/gv3.service", "");
    let Some(verified) = systemd_analyze(&place, &["verify", "--man=no", "--recursive-errors=no", &unit]) else {
        return;
    };
    is_accepted(&verified);
    let threshold = format!("--threshold={MOST_EXPOSURE}");
    let Some(closed) = systemd_analyze(&place, &["security", "--offline=true", &threshold, &unit]) else { return };
    is_accepted(&closed);
    // The threshold is looked at.
    let strict = systemd_analyze(&place, &["security", "--offline=true", "--threshold=1", &unit]).unwrap();
    assert!(!strict.status.success());
}

#[test]
fn systemd_takes_the_unit_of_one_user() {
    let place = Place::new();
    let home = format!("root{}/.config/systemd/user/gv3.service", std::env::var("HOME").unwrap_or_default());
    if std::env::var_os("XDG_CONFIG_HOME").is_some() || !home.contains("root/") {
        eprintln!("skipped: this user's configuration is elsewhere");
        return;
    }
    let unit = unit(&place, &home, "--user");
    let verify = ["--user", "verify", "--man=no", "--recursive-errors=no", &unit];
    let Some(verified) = systemd_analyze(&place, &verify) else { return };
    is_accepted(&verified);
}
