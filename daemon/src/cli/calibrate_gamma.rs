//! `gv3 calibrate-gamma`: the projector's response from pictures of a flat board.

use super::Outcome;
use super::reconstruct::{RawCapture, named};
use crate::light::Processing;
use crate::light::gamma::BoardFigures;
use crate::pipeline::StillReconstructor;
use anyhow::{Context, Result};
use clap::Args;
use gv3_protocol::AtomicFile;
use serde::Serialize;
use std::io::Write;
use std::path::PathBuf;

/// Measure the phase error of a projector's gamma on a flat, evenly lit board.
///
/// Capture the board once with the sequence in use. The table goes into a rig file (gamma_file of [processing]) or to
/// `gv3 reconstruct --gamma`.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  gv3 calibrate-gamma board --sequence sequence.toml --calibration rig.toml -o gamma.toml"
)]
pub struct CalibrateGamma {
    /// Pictures of the board.
    #[command(flatten)]
    capture: RawCapture,
    /// Table to write, TOML.
    #[arg(short, long)]
    out: PathBuf,
    /// Replace an existing table.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct GammaReport {
    out: PathBuf,
    bursts: usize,
    #[serde(flatten)]
    figures: BoardFigures,
}

impl CalibrateGamma {
    pub(super) fn run(self) -> Result<Outcome> {
        let opened = self.capture.open()?;
        let reconstructor =
            StillReconstructor::with(&opened.calibration, &opened.raw.sequence, &opened.limits, &Processing::default())
                .with_context(|| self.capture.name())?;
        let pictures = opened.pictures()?;
        let measured = reconstructor.measure_gamma(&pictures);
        let (table, figures) = measured.map_err(|e| named(e, &opened.folder, &opened.names))?;
        let mut file = AtomicFile::create(&self.out, self.force)?;
        file.write_all(table.to_toml()?.as_bytes()).with_context(|| self.out.display().to_string())?;
        file.commit()?;
        let report = GammaReport { out: self.out, bursts: table.bursts.len(), figures };
        Outcome::of(self.json, &report, || {
            format!(
                "{}: {} bursts from {} pixels of the board\n  phase error of the finest: {:.4} rad rms, {:.4} rad with the table",
                report.out.display(),
                report.bursts,
                figures.pixels,
                figures.before_rad,
                figures.after_rad
            )
        })
    }
}
