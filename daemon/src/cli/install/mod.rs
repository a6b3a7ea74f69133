//! `gv3 install` and `gv3 uninstall`: the daemon as a service of this machine or of one user.

pub(super) mod placed;
mod places;
#[cfg(test)]
mod tests;

use super::Outcome;
use anyhow::{Context, Result, ensure};
use clap::Args;
use placed::{Change, Placed, blame};
use places::Places;
use serde::Serialize;
use std::path::PathBuf;

/// Put the daemon in place as a service: binary, systemd unit, device rules, an example rig, man pages, completions.
///
/// Files that are already right stay untouched, a rig file of your own always does, and nothing is started: the report ends
/// with what to do next. Needs root, except with --user or --dry-run.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  gv3 install --dry-run\n  sudo gv3 install\n  gv3 install --user\n  \
                        gv3 install --root pkg --prefix /usr")]
pub struct Install {
    #[command(flatten)]
    into: Target,
}

/// Take away what `gv3 install` put in place; sessions and a rig file that was edited stay.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  gv3 uninstall --dry-run\n  sudo gv3 uninstall\n  gv3 uninstall --user")]
pub struct Uninstall {
    #[command(flatten)]
    from: Target,
}

#[derive(Debug, Args)]
struct Target {
    /// Say what would be done, and do nothing.
    #[arg(long)]
    dry_run: bool,
    /// For this user alone: below ~/.local, with a unit of the user's own service manager.
    #[arg(long)]
    user: bool,
    /// Of binary, man pages, completions and examples: /usr/local, or ~/.local with --user.
    #[arg(long, value_name = "DIR")]
    prefix: Option<PathBuf>,
    /// Put everything below this folder instead of /, as for a package.
    #[arg(long, value_name = "DIR")]
    root: Option<PathBuf>,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Report {
    dry_run: bool,
    files: Vec<FileReport>,
    next: Vec<String>,
}

#[derive(Debug, Serialize)]
struct FileReport {
    path: PathBuf,
    change: Change,
}

impl Install {
    pub(super) fn run(self) -> Result<Outcome> {
        let program = std::env::current_exe().context("this program's own file cannot be found")?;
        let binary = std::fs::read(&program).with_context(|| format!("{}: cannot read", program.display()))?;
        self.into.install(binary)
    }
}

impl Uninstall {
    pub(super) fn run(self) -> Result<Outcome> {
        self.from.uninstall()
    }
}

impl Target {
    fn places(&self) -> Result<Places> {
        if let Some(prefix) = &self.prefix {
            ensure!(prefix.is_absolute(), "{}: give --prefix as an absolute path", prefix.display());
        }
        let variable = |name| std::env::var_os(name).map(PathBuf::from).filter(|path: &PathBuf| path.is_absolute());
        let root = self.root.clone().unwrap_or_default();
        if self.user {
            let home = variable("HOME").context("HOME names no folder; give the whole machine's: gv3 install")?;
            return Ok(Places::user(root, self.prefix.clone(), &home, variable("XDG_CONFIG_HOME")));
        }
        let prefix = self.prefix.clone().unwrap_or_else(|| "/usr/local".into());
        Ok(Places::system(root, prefix))
    }

    fn install(&self, binary: Vec<u8>) -> Result<Outcome> {
        const AS_ROOT: &str = "sudo gv3 install, or for yourself: gv3 install --user";
        let files = self.places()?.files(binary)?;
        // Before anything is done, so that what cannot be read leaves everything as it is.
        let changes = files.iter().map(Placed::needed).collect::<Result<Vec<_>>>()?;
        if !self.dry_run {
            for (file, change) in files.iter().zip(&changes) {
                if matches!(change, Change::Written | Change::Replaced) {
                    let folder = file.path.parent().context("a file has a folder")?;
                    let made = std::fs::create_dir_all(folder).map_err(anyhow::Error::from);
                    blame(made, AS_ROOT).with_context(|| format!("{}: cannot make it", folder.display()))?;
                    file.put(AS_ROOT)?;
                }
            }
        }
        self.report(&files, &changes, self.next_after_install())
    }

    fn uninstall(&self) -> Result<Outcome> {
        const AS_ROOT: &str = "sudo gv3 uninstall";
        let mut files = self.places()?.files(Vec::new())?;
        // What starts the others goes first.
        files.reverse();
        let changes = files.iter().map(Placed::removal).collect::<Result<Vec<_>>>()?;
        if !self.dry_run {
            for (file, change) in files.iter().zip(&changes) {
                if *change == Change::Removed {
                    file.remove(AS_ROOT)?;
                }
            }
        }
        self.report(&files, &changes, self.next_after_uninstall())
    }

    fn next_after_install(&self) -> Vec<String> {
        if self.root.is_some() {
            return Vec::new();
        }
        let commands: &[&str] = match self.user {
            true => &[
                "systemctl --user daemon-reload",
                "systemctl --user enable --now gv3",
                "loginctl enable-linger      # to have it run while you are not logged in",
                "sudo gv3 install-udev       # access to the devices",
            ],
            false => &[
                "sudo systemd-sysusers       # the user gv3 and the groups of its devices",
                "sudo udevadm control --reload && sudo udevadm trigger",
                "sudo systemctl daemon-reload",
                "sudo systemctl enable --now gv3",
            ],
        };
        let rig = if self.user { "~/.config/gv3/rig.toml" } else { "/etc/gv3/rig.toml" };
        let edit = format!("edit {rig}, which describes the simulated scanner, for your own");
        commands.iter().map(|c| (*c).to_owned()).chain([edit, "open http://127.0.0.1:8433/".into()]).collect()
    }

    fn next_after_uninstall(&self) -> Vec<String> {
        let commands: &[&str] = match (self.user, self.root.is_some()) {
            (_, true) => &[],
            (true, false) => &["systemctl --user disable --now gv3", "systemctl --user daemon-reload"],
            (false, false) => &["sudo systemctl disable --now gv3", "sudo systemctl daemon-reload"],
        };
        let sessions = "sessions are kept, in /var/lib/gv3 or where a user's service keeps its state";
        commands.iter().chain(&[sessions]).map(|line| (*line).to_owned()).collect()
    }

    fn report(&self, files: &[Placed], changes: &[Change], next: Vec<String>) -> Result<Outcome> {
        let files = files.iter().zip(changes).map(|(f, &change)| FileReport { path: f.path.clone(), change }).collect();
        let report = Report { dry_run: self.dry_run, files, next };
        Outcome::of(self.json, &report, || text(&report))
    }
}

fn text(report: &Report) -> String {
    let mut lines: Vec<String> = report.files.iter().map(|f| f.change.text(&f.path, report.dry_run)).collect();
    if !report.next.is_empty() {
        lines.push("next:".into());
        lines.extend(report.next.iter().map(|step| format!("  {step}")));
    }
    lines.join("\n")
}
