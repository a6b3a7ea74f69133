//! `gv3 recover`: a clean session from an unfinished or damaged one.

use super::Outcome;
use super::progress::human_bytes;
use anyhow::Result;
use clap::Args;
use gv3_protocol::session::recover;
use std::fmt::Write;
use std::path::PathBuf;

/// Make a clean session of every complete group of an unfinished or damaged one.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 recover killed.gv3 -o whole.gv3\n  gv3 recover killed.gv3            (in place)"
)]
pub struct Recover {
    /// Session to read.
    session: PathBuf,
    /// Session to write; the input is replaced when none is given.
    #[arg(short, long)]
    out: Option<PathBuf>,
    /// Replace an existing output.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

impl Recover {
    pub(super) fn run(self) -> Result<Outcome> {
        let out = self.out.clone().unwrap_or_else(|| self.session.clone());
        let report = recover(&self.session, &out, self.force || self.out.is_none())?;
        Outcome::of(self.json, &report, || {
            let mut text = format!(
                "{}: {} groups kept, ticks {} to {}; {} left out",
                out.display(),
                report.groups,
                report.first_tick,
                report.last_tick,
                human_bytes(report.lost_bytes)
            );
            for span in &report.lost {
                let _ = write!(text, "\n  byte {}, {}: {}", span.offset, human_bytes(span.bytes), span.reason);
            }
            text
        })
    }
}
