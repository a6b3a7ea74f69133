//! `gv3 install-udev`: access to scanner hardware without root.

use super::Outcome;
use super::install::placed::{Change, Placed};
use anyhow::{Context, Result, bail};
use clap::Args;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The rules of this build.
pub(super) const RULES: &str = include_str!("../../../udev/70-gv3.rules");
/// Their file's name.
pub(super) const RULES_NAME: &str = "70-gv3.rules";
const GROUP: &str = "plugdev";
/// What makes the rules take effect: read them, then apply them to what is plugged in.
const RELOAD: [&[&str]; 2] = [
    &["udevadm", "control", "--reload"],
    &["udevadm", "trigger", "--subsystem-match=usb", "--subsystem-match=hidraw", "--subsystem-match=tty"],
];

/// Give the user at the seat and the group `plugdev` access to projectors and trigger controllers.
///
/// Writes the rules of this build of gv3 to udev's folder and has udev read them. Needs root, except with --dry-run.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  gv3 install-udev --dry-run\n  sudo gv3 install-udev\n  \
                        gv3 install-udev --rules-dir pkg/usr/lib/udev/rules.d --no-reload")]
pub struct InstallUdev {
    /// Say what would be done, and do nothing.
    #[arg(long)]
    dry_run: bool,
    /// Folder to write to.
    #[arg(long, value_name = "DIR", default_value = "/etc/udev/rules.d")]
    rules_dir: PathBuf,
    /// Only write the file, as for a package.
    #[arg(long)]
    no_reload: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct InstallReport {
    dry_run: bool,
    rules: PathBuf,
    change: Change,
    commands: Vec<String>,
    group: &'static str,
    group_exists: bool,
}

impl InstallUdev {
    pub(super) fn run(self) -> Result<Outcome> {
        let rules = Placed::new(self.rules_dir.join(RULES_NAME), RULES);
        let change = rules.needed()?;
        let commands: &[&[&str]] = if self.no_reload { &[] } else { &RELOAD };
        if !self.dry_run {
            if change != Change::Unchanged {
                rules.put("sudo gv3 install-udev")?;
            }
            commands.iter().try_for_each(|command| run_command(command, &rules.path))?;
        }
        let report = InstallReport {
            dry_run: self.dry_run,
            rules: rules.path,
            change,
            commands: commands.iter().map(|c| c.join(" ")).collect(),
            group: GROUP,
            group_exists: group_exists(&std::fs::read_to_string("/etc/group").unwrap_or_default()),
        };
        Outcome::of(self.json, &report, || text(&report))
    }
}

/// Runs a program directly, without a shell.
fn run_command(command: &[&str], rules: &Path) -> Result<()> {
    let shown = command.join(" ");
    let later = format!("{} is in place and takes effect at the next start", rules.display());
    let output = Command::new(command[0]).args(&command[1..]).output();
    let output = output.with_context(|| format!("{shown}: cannot be run; {later}"))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        bail!("{shown}: {}: {}; {later}", output.status, said.trim());
    }
    Ok(())
}

/// Whether a text as `/etc/group` names the group.
fn group_exists(groups: &str) -> bool {
    groups.lines().any(|line| line.split(':').next() == Some(GROUP))
}

fn text(report: &InstallReport) -> String {
    let done = report.change.text(&report.rules, report.dry_run);
    let ran = if report.dry_run { "would run" } else { "ran" };
    let mut lines = vec![done];
    lines.extend(report.commands.iter().map(|command| format!("{ran} {command}")));
    let group = report.group;
    lines.push(if report.group_exists {
        format!("access: the user at the seat, and the group {group} (sudo usermod -aG {group} USER)")
    } else {
        format!("access: the user at the seat; for other users and daemons create the group: sudo groupadd -r {group}")
    });
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        install: InstallUdev,
    }

    fn run(folder: &Path, more: &[&str]) -> Result<String> {
        let fixed = ["gv3", "--rules-dir", folder.to_str().unwrap()];
        Ok(Line::try_parse_from(fixed.iter().chain(more))?.install.run()?.report)
    }

    #[test]
    fn the_rules_are_written_once() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(RULES_NAME);
        let dry = run(folder.path(), &["--dry-run"]).unwrap();
        assert!(dry.contains("would write") && dry.contains("would run udevadm control --reload"), "{dry}");
        assert!(!file.exists());
        assert!(run(folder.path(), &["--no-reload"]).unwrap().contains(": written\n"));
        assert_eq!(std::fs::read_to_string(&file).unwrap(), RULES);
        assert!(run(folder.path(), &["--no-reload"]).unwrap().contains("already as it should be"));
        std::fs::write(&file, "# older").unwrap();
        assert!(run(folder.path(), &["--dry-run"]).unwrap().contains("would replace"));
        assert!(run(folder.path(), &["--no-reload"]).unwrap().contains(": replaced\n"));
        assert_eq!(std::fs::read_to_string(&file).unwrap(), RULES);
        let json = run(folder.path(), &["--no-reload", "--json"]).unwrap();
        assert!(json.contains(r#""change": "unchanged""#) && json.contains(r#""commands": []"#), "{json}");
    }

    #[test]
    fn failures_say_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let missing = run(&folder.path().join("none"), &["--no-reload"]).unwrap_err();
        assert!(format!("{missing:#}").contains("none/70-gv3.rules: cannot write"), "{missing:#}");
        let gone = run_command(&["gv3-no-such-program"], Path::new("/r")).unwrap_err();
        assert!(format!("{gone:#}").starts_with("gv3-no-such-program: cannot be run; /r is in place"), "{gone:#}");
        let failed = run_command(&["false"], Path::new("/r")).unwrap_err().to_string();
        assert!(failed.starts_with("false: exit status: 1"), "{failed}");
    }

    #[test]
    fn the_group_is_looked_up_by_its_whole_name() {
        assert!(group_exists("root:x:0:\nplugdev:x:46:someone\n"));
        assert!(!group_exists("plugdevs:x:46:\nx:x:1:plugdev\n"));
    }

    /// Every device that gv3 opens by its identifiers has a rule.
    #[test]
    fn the_rules_know_the_projector() {
        use gv3_protocol::dlpc350::{PRODUCT_ID, VENDOR_ID};
        let ids = |attr: &str| {
            format!(r#"{attr}{{idVendor}}=="{VENDOR_ID:04x}", {attr}{{idProduct}}=="{PRODUCT_ID:04x}", MODE="0660""#)
        };
        assert!(RULES.contains(&ids("ATTR")) && RULES.contains(&ids("ATTRS")));
        assert!(RULES.lines().filter(|l| l.contains("MODE=")).all(|l| l.contains(r#"TAG+="uaccess""#)));
    }
}
