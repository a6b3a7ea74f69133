//! `gv3 decode`: a session becomes files that other programs open.

use super::Outcome;
use super::encode::fps;
use super::progress::{bar, human_bytes};
use crate::files::picture::PictureFormat;
use crate::files::{ExportFormat, ExportWriter};
use crate::measure::{Output, SessionOutput};
use crate::replay::Replay;
use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;
use std::path::PathBuf;

/// Write the scans of a session as numbered OBJ+BMP or PLY files: those that were taken, or any frame rate or times.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 decode smile.gv3 -o smile\n  gv3 decode smile.gv3 -o slow --fps 120 --format ply\n  gv3 decode smile.gv3 -o stills --times 0.5,1.25"
)]
pub struct Decode {
    /// Session to read.
    session: PathBuf,
    /// Folder to write.
    #[arg(short, long)]
    out: PathBuf,
    /// Files to write.
    #[arg(long, value_enum, default_value_t = Format::Obj)]
    format: Format,
    /// What to write: each scan as it was seen (the default where the session has it), or the tracked mesh.
    #[arg(long = "as", value_enum)]
    output: Option<Output>,
    /// This many scans a second from the first to the last, instead of the original times.
    #[arg(long, value_parser = fps, conflicts_with = "times")]
    fps: Option<f64>,
    /// These times, seconds after the first scan.
    #[arg(long, value_delimiter = ',', value_name = "S,S...")]
    times: Option<Vec<f64>>,
    /// Only the scans with ticks A to B (A..B, B included).
    #[arg(long, value_parser = tick_range, value_name = "A..B", conflicts_with_all = ["fps", "times"])]
    scans: Option<(u64, u64)>,
    /// Write into a folder that holds files.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Format {
    /// OBJ with a BMP and an MTL that joins them.
    Obj,
    /// Binary PLY with a PNG.
    Ply,
}

fn tick_range(text: &str) -> Result<(u64, u64), String> {
    let parsed = text.split_once("..").and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
    parsed.filter(|(a, b)| a <= b).ok_or_else(|| "give two ticks as A..B with A not above B".into())
}

#[derive(Debug, Default, Serialize)]
struct DecodeReport {
    files: u64,
    bytes: u64,
}

impl Decode {
    pub(super) fn run(self) -> Result<Outcome> {
        let mut replay = Replay::open(&self.session)?;
        SessionOutput::new(&mut replay, self.output)?;
        let times = self.times_nanos(&replay)?;
        let format = match self.format {
            Format::Obj => ExportFormat::Obj,
            Format::Ply => ExportFormat::Ply { picture: PictureFormat::Png },
        };
        let writer = ExportWriter::create(&self.out, format, self.force)?;
        let bar = bar(times.len() as u64, "decode");
        let mut report = DecodeReport::default();
        for (number, time_nanos) in times {
            let scan = replay.scan_at(time_nanos)?;
            report.bytes += writer.write(number, &scan.mesh, scan.texture.as_ref())?;
            report.files += 1;
            bar.inc(1);
        }
        bar.finish_and_clear();
        Outcome::of(self.json, &report, || {
            format!("{}: {} scans, {}", self.out.display(), report.files, human_bytes(report.bytes))
        })
    }

    /// (number in the file name, sensor time): ticks for original times, else a running number.
    fn times_nanos(&self, replay: &Replay) -> Result<Vec<(u64, u64)>> {
        let stamps = replay.stamps();
        let (first, last) = (stamps[0].time_nanos, stamps[stamps.len() - 1].time_nanos);
        let times: Vec<(u64, u64)> = match (&self.fps, &self.times) {
            (Some(fps), _) => {
                let count = ((last - first) as f64 * 1e-9 * fps + 1e-6) as u64 + 1;
                (0..count).map(|i| (i, first + (i as f64 * 1e9 / fps).round() as u64)).collect()
            }
            (None, Some(times)) => {
                let length_s = (last - first) as f64 * 1e-9;
                if let Some(bad) = times.iter().find(|t| !(0.0..=length_s + 1e-9).contains(*t)) {
                    bail!("--times: {bad} s is outside the session, which lasts {length_s:.3} s");
                }
                (0..).zip(times).map(|(i, t)| (i, first + (t * 1e9).round() as u64)).collect()
            }
            (None, None) => {
                let (a, b) = self.scans.unwrap_or((0, u64::MAX));
                stamps.iter().filter(|s| (a..=b).contains(&s.tick)).map(|s| (s.tick, s.time_nanos)).collect()
            }
        };
        if times.is_empty() {
            bail!(
                "--scans: no scan of the session lies in that range; its ticks are {} to {}",
                stamps[0].tick,
                stamps[stamps.len() - 1].tick
            );
        }
        Ok(times)
    }
}
