//! `gv3 verify`: every checksum and every payload.

use super::Outcome;
use crate::replay::Replay;
use anyhow::Result;
use clap::Args;
use gv3_codec::Checker;
use gv3_protocol::raw::RawReader;
use gv3_protocol::session::{VerifyReport, verify};
use serde::Serialize;
use std::fmt::Write;
use std::path::PathBuf;

/// Check a session or a raw recording: every checksum, the index against the content, and that every payload decodes.
///
/// Exit code 1 when anything is wrong.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  gv3 verify smile.gv3 && echo intact")]
pub struct Verify {
    /// Session, or folder of a raw recording, to check.
    session: PathBuf,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct FullReport {
    ok: bool,
    #[serde(flatten)]
    container: VerifyReport,
    decoded_groups: usize,
    payload_problems: Vec<String>,
}

impl Verify {
    pub(super) fn run(self) -> Result<Outcome> {
        if RawReader::is_recording(&self.session) {
            return super::raw::verify(&self.session, self.json);
        }
        let container = verify(&self.session)?;
        let mut report = FullReport { ok: false, container, decoded_groups: 0, payload_problems: Vec::new() };
        match Replay::open(&self.session) {
            Ok(mut replay) => self.decode_all(&mut replay, &mut report),
            Err(error) => report.payload_problems.push(error.to_string()),
        }
        report.ok = report.container.ok() && report.payload_problems.is_empty();
        let mut outcome = Outcome::of(self.json, &report, || self.describe(&report))?;
        outcome.is_fault = !report.ok;
        Ok(outcome)
    }

    fn decode_all(&self, replay: &mut Replay, report: &mut FullReport) {
        let mut checker = Checker::new(replay.header());
        for i in 0..replay.reader().groups().len() {
            let decoded = replay.reader_mut().read_group(i).map_err(|e| e.to_string()).and_then(|stored| {
                checker.check(&stored.geometry, stored.texture.as_deref()).map_err(|e| e.to_string())
            });
            match decoded {
                Ok(_) => report.decoded_groups += 1,
                Err(reason) => report.payload_problems.push(format!("group {i}: {reason}")),
            }
        }
    }

    fn describe(&self, r: &FullReport) -> String {
        let c = &r.container;
        let verdict = match (c.ok(), r.ok) {
            (_, true) => "intact",
            (true, false) => "cannot be decoded",
            (false, false) => "damaged",
        };
        let mut text = format!(
            "{}: {verdict}; {} groups ({} decoded), {} textures, {} chunks with the right checksum",
            self.session.display(),
            c.groups,
            r.decoded_groups,
            c.textures,
            c.chunks
        );
        for problem in &c.problems {
            let _ = write!(text, "\n  byte {}: {}", problem.offset, problem.reason);
        }
        for problem in &r.payload_problems {
            let _ = write!(text, "\n  {problem}");
        }
        // Recovery copies groups as they are: it helps only where checksums are wrong.
        if !c.ok() {
            let _ = write!(text, "\n  `gv3 recover {0} -o whole.gv3` keeps what is intact", self.session.display());
        }
        text
    }
}
