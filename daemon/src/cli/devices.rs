//! `gv3 devices`: what is plugged in.

use super::Outcome;
use crate::device::plugged::{Plugged, PluggedCamera, PluggedPort, PluggedProjector};
use anyhow::Result;
use clap::Args;
use std::fmt::Write;

/// List the cameras, projectors and serial ports that are plugged in, and say what stands in the way of using them.
///
/// Nothing is set or started. Exit code 1 when something is there but cannot be used.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  gv3 devices\n  gv3 devices --json")]
pub struct Devices {
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

impl Devices {
    pub(super) fn run(self) -> Result<Outcome> {
        let found = Plugged::find();
        let mut outcome = Outcome::of(self.json, &found, || table(&found))?;
        outcome.is_fault = !found.is_usable();
        Ok(outcome)
    }
}

fn table(found: &Plugged) -> String {
    let mut text = String::new();
    section(&mut text, "cameras", found.cameras.iter().map(camera));
    section(&mut text, "projectors", found.projectors.iter().map(projector));
    section(&mut text, "serial ports (a trigger controller may be one)", found.serial_ports.iter().map(port));
    if !found.problems.is_empty() {
        section(&mut text, "problems", found.problems.iter().cloned());
    }
    text
}

fn section(text: &mut String, name: &str, lines: impl Iterator<Item = String>) {
    let lines: Vec<String> = lines.collect();
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{name}{}", if lines.is_empty() { ": none" } else { "" });
    for line in lines {
        let _ = writeln!(text, "  {line}");
    }
}

fn serial(serial: &str) -> String {
    if serial.is_empty() { "no serial number".into() } else { format!("serial {serial}") }
}

fn problem(problem: Option<&String>) -> String {
    problem.map_or(String::new(), |problem| format!("\n    cannot be used: {problem}"))
}

fn camera(c: &PluggedCamera) -> String {
    let formats = if c.formats.is_empty() { "no formats".into() } else { c.formats.join(" ") };
    format!("{}  \"{}\", {}, {}, {}; {formats}", c.node, c.name, c.driver, c.bus, serial(&c.serial))
}

fn projector(p: &PluggedProjector) -> String {
    let node = p.node.as_ref().map_or(String::new(), |node| format!(", {node}"));
    let speed = p.speed.as_ref().map_or(String::new(), |speed| format!(", {speed} speed"));
    format!("{} at {}, {}{node}{speed}{}", p.backend, p.bus_path, serial(&p.serial), problem(p.problem.as_ref()))
}

fn port(p: &PluggedPort) -> String {
    let product = if p.product.is_empty() { "unnamed" } else { &p.product };
    format!("{}  {product} ({}), {}{}", p.port, p.usb_id, serial(&p.serial), problem(p.problem.as_ref()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_found_is_said_with_its_problem() {
        let found = Plugged {
            cameras: vec![PluggedCamera {
                node: "/dev/video2".into(),
                name: "Test camera".into(),
                driver: "uvcvideo".into(),
                bus: "usb-1".into(),
                serial: String::new(),
                formats: vec!["GREY".into(), "YUYV".into()],
            }],
            projectors: vec![PluggedProjector {
                backend: "gv3_usb",
                serial: "A7".into(),
                bus_path: "3-1.2".into(),
                node: None,
                speed: Some("high".into()),
                problem: Some("no rights".into()),
            }],
            ..Plugged::default()
        };
        let expected = "cameras\n  /dev/video2  \"Test camera\", uvcvideo, usb-1, no serial number; GREY YUYV\n\
            projectors\n  gv3_usb at 3-1.2, serial A7, high speed\n    cannot be used: no rights\n\
            serial ports (a trigger controller may be one): none\n";
        assert_eq!(table(&found), expected);
    }
}
