//! `gv3 doctor`: what keeps a rig from scanning.

use super::Outcome;
use super::progress::bar;
use crate::device::RigConfig;
use crate::doctor::{self, CHECK_COUNT, Report};
use anyhow::{Context, Result};
use clap::Args;
use std::fmt::Write;
use std::path::PathBuf;

/// Check a rig: rights, devices, trigger, order of pictures and patterns, light, linearity, calibration, clocks, USB and disk.
///
/// Plays the rig's patterns, and some of its own, for about two seconds; put something bright into the working range. Every
/// check says pass, fail or skip, what was seen and what to do. Exit code 1 when any fails.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  gv3 doctor --config rig.toml\n  gv3 doctor --sim --json")]
pub struct Doctor {
    /// Rig file; else the built-in simulated scanner.
    #[arg(long)]
    config: Option<PathBuf>,
    /// The built-in simulated scanner.
    #[arg(long, conflicts_with = "config")]
    sim: bool,
    /// Folder that sessions will be written to; its disk is checked.
    #[arg(long, value_name = "DIR", default_value = ".")]
    out: PathBuf,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

impl Doctor {
    pub(super) fn run(self) -> Result<Outcome> {
        let config = match &self.config {
            Some(path) => RigConfig::read(path).with_context(|| path.display().to_string())?,
            None => RigConfig::simulated(),
        };
        let bar = bar(CHECK_COUNT as u64, "doctor");
        let report = doctor::run_in(&config, &self.out, |_| bar.inc(1));
        bar.finish_and_clear();
        let mut outcome = Outcome::of(self.json, &report, || table(&config.name, &report))?;
        outcome.is_fault = !report.is_well();
        Ok(outcome)
    }
}

fn table(name: &str, report: &Report) -> String {
    let mut text = format!("{name}\n");
    for check in &report.checks {
        let verdict = match check.outcome {
            doctor::Outcome::Pass => "pass",
            doctor::Outcome::Fail => "FAIL",
            doctor::Outcome::Skip => "skip",
        };
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{verdict}  {:<12} {}", check.name, check.detail);
        if !check.action.is_empty() {
            let _ = writeln!(text, "{:>19}-> {}", "", check.action);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Check;

    #[test]
    fn a_failed_check_says_what_to_do() {
        let check = |name, outcome, action: &str| Check { name, outcome, detail: "seen".into(), action: action.into() };
        let checks =
            vec![check("disk", doctor::Outcome::Pass, ""), check("clock", doctor::Outcome::Fail, "set the time")];
        let expected = "rig\npass  disk         seen\nFAIL  clock        seen\n                   -> set the time\n";
        assert_eq!(table("rig", &Report { checks }), expected);
        let json = serde_json::to_string(&check("disk", doctor::Outcome::Skip, "")).unwrap();
        assert_eq!(json, r#"{"name":"disk","outcome":"skip","detail":"seen","action":""}"#);
    }
}
