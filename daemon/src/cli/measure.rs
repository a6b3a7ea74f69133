//! `gv3 measure`: ratio against distortion.

use super::Outcome;
use super::progress::{bar, human_bytes};
use crate::files::ScanFolder;
use crate::measure::{Errors, MeasureReport, Measurement, ScanFigures, measure};
use crate::replay::Replay;
use crate::view::plot::{Marks, Series, error_over_time};
use anyhow::{Context, Result, anyhow};
use clap::Args;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Compare a session with the scans it was made from: compression ratio, distances both ways, coverage, texture.
///
/// Every scan is measured, those between keyframes too.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  gv3 measure smile.gv3 --against recordings/smile --plot smile.svg")]
pub struct Measure {
    /// Session to measure.
    session: PathBuf,
    /// Folder of the scans it was made from.
    #[arg(long)]
    against: PathBuf,
    /// Plot of the error over time to write (SVG).
    #[arg(long)]
    plot: Option<PathBuf>,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

impl Measure {
    pub(super) fn run(self) -> Result<Outcome> {
        let mut replay = Replay::open(&self.session)?;
        let mut folder = ScanFolder::open(&self.against)?;
        let bar = bar(folder.len() as u64, "measure");
        let (Measurement { report, curve }, _) = measure(&mut replay, &mut folder, |_, _| (), || bar.inc(1))?;
        bar.finish_and_clear();
        if let Some(path) = &self.plot {
            write_plot(path, &curve, replay.header().scan_period_nanos)?;
        }
        Outcome::of(self.json, &report, || describe(&report))
    }
}

/// Writes the error over time as SVG; missing ticks are shaded.
pub fn write_plot(path: &Path, curve: &[ScanFigures], period_nanos: u64) -> Result<()> {
    let series = |name: &str, value: fn(&ScanFigures) -> f64| Series {
        name: name.into(),
        points: curve.iter().map(|c| (c.time_s, value(c))).collect(),
    };
    let period_s = period_nanos as f64 * 1e-9;
    let gap = |w: &[ScanFigures]| {
        (w[1].tick > w[0].tick + 1).then(|| (w[0].time_s + 0.5 * period_s, w[1].time_s - 0.5 * period_s))
    };
    let marks = Marks {
        keyframes_s: curve.iter().filter(|c| c.is_key).map(|c| c.time_s).collect(),
        gaps_s: curve.windows(2).filter_map(gap).collect(),
    };
    let lines = [
        series("scan to replay, rms", |c| c.scan_to_replay_rms_mm),
        series("replay to scan, rms", |c| c.replay_to_scan_rms_mm),
        series("scan to replay, p95", |c| c.scan_to_replay_p95_mm),
    ];
    let svg = error_over_time(&lines, &marks, "Error of the replay over time", "mm").map_err(|e| anyhow!(e))?;
    std::fs::write(path, svg).with_context(|| format!("{}: cannot write the plot", path.display()))
}

/// The report in words.
pub fn describe(r: &MeasureReport) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{} scans, {} keyframes", r.scans, r.keyframes);
    let _ = writeln!(
        text,
        "  size       {}: geometry {}, textures {}, container {}",
        human_bytes(r.bytes.session),
        human_bytes(r.bytes.geometry),
        human_bytes(r.bytes.texture),
        human_bytes(r.bytes.container)
    );
    let raw = [
        ("OBJ+BMP", Some((r.raw_bytes.obj_bmp, r.percent_of_raw.obj_bmp))),
        ("binary meshes", Some((r.raw_bytes.binary, r.percent_of_raw.binary))),
        ("fringe pictures", r.raw_bytes.fringe.zip(r.percent_of_raw.fringe)),
    ];
    for (name, (bytes, percent)) in raw.into_iter().filter_map(|(n, v)| Some((n, v?))) {
        let _ = writeln!(
            text,
            "             {percent:.3} % of {} as {name} (1 : {:.0})",
            human_bytes(bytes),
            100.0 / percent
        );
    }
    let mut line = |name: &str, e: &Errors| {
        let _ =
            writeln!(text, "  {name:<32} rms {:.3}  p95 {:.3}  p99 {:.3}  max {:.2} mm", e.rms, e.p95, e.p99, e.max);
    };
    let (there, back) = (&r.surface_mm.scan_to_replay, &r.surface_mm.replay_to_scan);
    line("scan to replay, keyframes", &there.keyframes);
    line("scan to replay, in between", &there.in_between);
    line("replay to scan, keyframes", &back.keyframes);
    line("replay to scan, in between", &back.in_between);
    let _ = writeln!(
        text,
        "  coverage   {:.3} % missing, {:.3} % invented",
        100.0 * r.coverage.missing,
        100.0 * r.coverage.invented
    );
    if let (Some(all), Some(keys)) = (r.texture_psnr_db, r.texture_psnr_keyframes_db) {
        let _ = writeln!(text, "  texture    {all:.1} dB, keyframes {keys:.1} dB");
    }
    let _ = write!(text, "  time       ");
    if let Some(ms) = r.encode_ms_per_scan {
        let _ = write!(text, "encode {ms:.1} ms a scan, ");
    }
    let _ = writeln!(text, "decode {:.1} ms a scan", r.decode_ms_per_scan);
    text
}
