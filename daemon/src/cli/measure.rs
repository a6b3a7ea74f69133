//! `gv3 measure`: ratio against distortion.

use super::Outcome;
use super::progress::{bar, human_bytes};
use crate::files::{ScanFolder, write_whole};
use crate::measure::{
    Decoded, DistortionReport, DriftErrors, DriftReport, Errors, MeasureReport, Output, ScanFigures, SessionOutput,
    TruthReport, TruthScans, measure, measure_drift,
};
use crate::replay::Replay;
use crate::view::compare::png_bytes;
use crate::view::error_map::ErrorMap;
use crate::view::plot::{Marks, Series, error_over_time};
use anyhow::{Result, anyhow};
use clap::Args;
use gv3_codec::Scan;
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Compare a session with the scans it was made from: compression ratio, distances both ways, coverage, normals, texture.
///
/// Every scan is measured, those between keyframes too.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 measure smile.gv3 --against recordings/smile --plot smile.svg --error-map smile.png\n  gv3 measure talk.gv3 --against scans --truth clean --correspondence tracked --json"
)]
pub struct Measure {
    /// Session to measure.
    session: PathBuf,
    /// Folder of the scans it was made from.
    #[arg(long)]
    against: PathBuf,
    /// Output of the session to measure, when it has several.
    #[arg(long = "as", value_enum)]
    output: Option<Output>,
    /// Folder of the same scans without noise, under the same names: how far scan and replay are from them.
    #[arg(long, value_name = "DIR")]
    truth: Option<PathBuf>,
    /// Folder of true scans that all have the same triangles, under the same names: how far points of the mesh drift.
    #[arg(long, value_name = "DIR")]
    correspondence: Option<PathBuf>,
    /// Plot of the error over time to write (SVG).
    #[arg(long)]
    plot: Option<PathBuf>,
    /// Map of where the errors are to write (PNG).
    #[arg(long, value_name = "FILE")]
    error_map: Option<PathBuf>,
    /// Report as JSON, with the figures of every scan.
    #[arg(long)]
    json: bool,
}

/// The report with what was asked for besides.
#[derive(Debug, Serialize)]
struct FullReport {
    #[serde(flatten)]
    measure: MeasureReport,
    truth: Option<TruthReport>,
    correspondence: Option<DriftReport>,
    /// Figures of every scan in time order.
    curve: Vec<ScanFigures>,
}

impl Measure {
    pub(super) fn run(self) -> Result<Outcome> {
        let mut replay = Replay::open(&self.session)?;
        let mut folder = ScanFolder::open(&self.against)?;
        let open_truth = |path: &Option<PathBuf>| path.as_ref().map(|p| TruthScans::open(p, &folder)).transpose();
        let (truth, tracked) = (open_truth(&self.truth)?, open_truth(&self.correspondence)?);
        let map = match &self.error_map {
            Some(_) => Some(Mutex::new(ErrorMap::new(&folder.load(0, 1)?.scan.mesh))),
            None => None,
        };
        let mut output = SessionOutput::new(&mut replay, self.output)?;
        let scans_bar = bar(folder.len() as u64, "measure");
        let inspect = |scan: &Scan, replayed: &Scan, error_mm: &[f32]| {
            if let Some(map) = &map {
                map.lock().unwrap_or_else(PoisonError::into_inner).add(&scan.mesh, error_mm);
            }
            truth.as_ref().map_or(Ok(None), |t| t.compare(scan, replayed))
        };
        let (measurement, compared) = measure(&mut output, &mut folder, inspect, || scans_bar.inc(1))?;
        scans_bar.finish_and_clear();
        let correspondence = tracked.map(|tracked| follow(&mut output, &tracked)).transpose()?;
        let report = FullReport {
            measure: measurement.report(output.output(), output.replay()),
            truth: truth.map(|_| TruthScans::total(compared)),
            correspondence,
            curve: measurement.curve,
        };
        if let Some(path) = &self.plot {
            write_plot(path, &report.curve, output.period_nanos())?;
        }
        if let Some((path, map)) = self.error_map.as_ref().zip(map) {
            let d = &report.measure.distortion;
            let caption = format!("{} scans: rms {:.3} mm", d.scans, d.surface_mm.scan_to_replay.all.rms);
            let picture = map.into_inner().unwrap_or_else(PoisonError::into_inner).draw(&caption);
            write_whole(path, &png_bytes(&picture))?;
        }
        Outcome::of(self.json, &report, || report.describe())
    }
}

fn follow(output: &mut SessionOutput<'_>, tracked: &TruthScans) -> Result<DriftReport> {
    let bar = bar(output.stamps().len() as u64, "follow");
    let report = measure_drift(output, tracked, || bar.inc(1))?;
    bar.finish_and_clear();
    Ok(report)
}

impl FullReport {
    fn describe(&self) -> String {
        let mut text = describe(&self.measure);
        // Writing to a String cannot fail.
        if let Some(t) = &self.truth {
            let _ = writeln!(
                text,
                "  truth      {} scans: scan rms {:.4}, replay rms {:.4} mm; replay closer on {:.1} % of the surface",
                t.scans,
                t.scan_to_truth_mm.rms,
                t.replay_to_truth_mm.rms,
                100.0 * t.replay_closer
            );
        }
        if let Some(c) = &self.correspondence {
            let mut line = |name: String, e: &DriftErrors| {
                let _ = writeln!(
                    text,
                    "  drift      {name}: median {:.3}, p95 {:.3}, max {:.2} mm",
                    e.median_mm, e.p95_mm, e.max_mm
                );
            };
            line(format!("{} scans, {} connectivities", c.scans, c.shots), &c.all);
            let ages = [1, 2, 5, 10, 20, 50, 100, 200, 500].into_iter();
            for (n, errors) in ages.filter_map(|n| Some((n, c.after_scans.get(n)?))) {
                line(format!("after {n} scans"), errors);
            }
            let _ = writeln!(text, "  folded     {:.4} % of the faces", 100.0 * c.folded_faces);
        }
        text
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
    write_whole(path, svg.as_bytes())?;
    Ok(())
}

/// The report in words.
pub fn describe(r: &MeasureReport) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let d = &r.distortion;
    let _ = writeln!(text, "{} scans, {} keyframes", d.scans, d.keyframes);
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
    describe_distortion(&mut text, d);
    let _ = write!(text, "  time       ");
    if let Some(ms) = r.encode_ms_per_scan {
        let _ = write!(text, "encode {ms:.1} ms a scan, ");
    }
    let _ = writeln!(text, "decode {:.1} ms a scan", r.decode_ms_per_scan);
    text
}

/// Distances, coverage, normals and texture in words.
fn describe_distortion(text: &mut String, d: &DistortionReport) {
    let mut line = |name: &str, e: &Errors| {
        let _ =
            writeln!(text, "  {name:<32} rms {:.3}  p95 {:.3}  p99 {:.3}  max {:.2} mm", e.rms, e.p95, e.p99, e.max);
    };
    let (there, back) = (&d.surface_mm.scan_to_replay, &d.surface_mm.replay_to_scan);
    line("scan to replay, keyframes", &there.keyframes);
    line("scan to replay, in between", &there.in_between);
    line("replay to scan, keyframes", &back.keyframes);
    line("replay to scan, in between", &back.in_between);
    if let (Some(d1), Some(d2), Some(deg)) = (d.d1_psnr_db, d.d2_psnr_db, d.normal_rms_deg) {
        let _ = writeln!(text, "  surface    D1 {d1:.1} dB, D2 {d2:.1} dB, normals {deg:.1} degrees rms");
    }
    let _ = writeln!(
        text,
        "  coverage   {:.3} % missing, {:.3} % invented",
        100.0 * d.coverage.missing,
        100.0 * d.coverage.invented
    );
    if let (Some(all), Some(keys)) = (d.texture_psnr_db, d.texture_psnr_keyframes_db) {
        let _ = writeln!(text, "  texture    {all:.1} dB, keyframes {keys:.1} dB");
    }
}
