//! `gv3 decode`: a session becomes files that other programs open.

use super::Outcome;
use super::encode::fps;
use super::progress::{bar, human_bytes};
use crate::files::picture::PictureFormat;
use crate::files::{ExportFormat, SequenceWriter};
use crate::measure::{Output, SessionOutput};
use crate::replay::Replay;
use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;
use std::path::PathBuf;

/// Write the scans of a session as numbered OBJ+BMP, PLY or glTF files: those that were taken, or any frame rate or times.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 decode smile.gv3 -o smile\n  gv3 decode smile.gv3 -o slow --fps 120 --format ply\n  gv3 decode smile.gv3 -o stills --times 0.5,1.25\n  gv3 decode smile.gv3 -o clip --as mesh --format gltf    (a .glb a shot, which moves in Blender)"
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
    /// Binary glTF; scans of one connectivity, as a shot of the tracked mesh, are one file with an animation.
    #[value(alias = "glb")]
    Gltf,
}

impl Format {
    pub(super) fn export(self) -> ExportFormat {
        match self {
            Self::Obj => ExportFormat::Obj,
            Self::Ply => ExportFormat::Ply { picture: PictureFormat::Png },
            Self::Gltf => ExportFormat::Gltf,
        }
    }
}

fn tick_range(text: &str) -> Result<(u64, u64), String> {
    let parsed = text.split_once("..").and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
    parsed.filter(|(a, b)| a <= b).ok_or_else(|| "give two ticks as A..B with A not above B".into())
}

#[derive(Debug, Serialize)]
struct DecodeReport {
    scans: u64,
    files: u64,
    bytes: u64,
}

impl Decode {
    pub(super) fn run(self) -> Result<Outcome> {
        let mut replay = Replay::open(&self.session)?;
        SessionOutput::new(&mut replay, self.output)?;
        let times = self.times_nanos(&replay)?;
        let mut writer = SequenceWriter::create(&self.out, self.format.export(), self.force)?;
        let bar = bar(times.len() as u64, "decode");
        let scans = times.len() as u64;
        for (number, time_nanos) in times {
            writer.write(number, &replay.scan_at(time_nanos)?)?;
            bar.inc(1);
        }
        writer.finish()?;
        bar.finish_and_clear();
        let report = DecodeReport { scans, files: writer.files(), bytes: writer.bytes() };
        Outcome::of(self.json, &report, || {
            let clips = match report.files {
                files if files == scans => String::new(),
                1 => " in one file".into(),
                files => format!(" in {files} files"),
            };
            format!("{}: {scans} scans{clips}, {}", self.out.display(), human_bytes(report.bytes))
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
