//! `gv3 demo`: the whole way on the simulated scanner, measured and shown.

use super::Outcome;
use super::capture::{record_session, seconds};
use super::measure::{describe, write_plot};
use super::progress::bar;
use crate::device::RigConfig;
use crate::device::sim::{Fault, FaultKind, SimWorld};
use crate::files::ScanSpool;
use crate::measure::{Errors, MeasureReport, Measurement, Output, ScanFigures, SessionOutput, measure};
use crate::pipeline::Recorded;
use crate::replay::Replay;
use crate::view::compare::{Comparison, png_bytes};
use crate::view::render::ViewSide;
use anyhow::{Context, Result};
use clap::Args;
use gv3_codec::Scan;
use gv3_codec::mesh::{Bvh, TriMesh};
use gv3_codec::metrics::{ErrorHistogram, compare};
use gv3_protocol::session::{Event, EventKind};
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// Capture a simulated talking head, write the session, replay it, and measure it against scans and truth.
///
/// Needs no hardware and no configuration. One picture is lost on purpose, so that the session has a gap.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  gv3 demo --seconds 3 --out gv3-demo")]
pub struct Demo {
    /// Sensor time to capture.
    #[arg(long, default_value = "3", value_parser = seconds)]
    seconds: f64,
    /// Folder for the session, the report and the pictures.
    #[arg(long, default_value = "gv3-demo")]
    out: PathBuf,
    /// Another head, motion and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

/// Names of the files that the demo leaves.
const SESSION: &str = "demo.gv3";
const REPORT: &str = "report.json";
const PLOT: &str = "error.svg";
const PICTURE: &str = "comparison.png";

#[derive(Debug, Serialize)]
struct DemoReport {
    /// What the recording did.
    capture: Recorded,
    /// The session against the captured scans.
    measure: MeasureReport,
    /// Against the simulator's true surface, millimetres.
    truth_mm: TruthReport,
    /// What happened during capture, as stored in the session.
    events: Vec<Event>,
    /// Wall time, seconds.
    capture_s: f64,
    /// Wall time, seconds.
    measure_s: f64,
    /// Largest memory of the process so far, bytes; none where the system does not tell.
    peak_memory_bytes: Option<u64>,
    /// Error of every scan.
    curve: Vec<ScanFigures>,
}

#[derive(Debug, Serialize)]
struct TruthReport {
    /// Every vertex of the captured scans to the true surface at their time.
    scan_to_truth: Errors,
    /// Every vertex of the replayed scans to the true surface.
    replay_to_truth: Errors,
}

impl Demo {
    pub(super) fn run(self) -> Result<Outcome> {
        std::fs::create_dir_all(&self.out)
            .with_context(|| format!("{}: cannot create the folder", self.out.display()))?;
        let session = self.out.join(SESSION);
        let config = self.rig();
        let begin = Instant::now();
        let (capture, mut spool) = capture(&config, &session, self.seconds, &self.out)?;
        let capture_s = begin.elapsed().as_secs_f64();
        let mut replay = Replay::open(&session)?;
        let begin = Instant::now();
        let (measurement, truth_mm) = measure_all(&config, &mut replay, &mut spool)?;
        write_plot(&self.out.join(PLOT), &measurement.curve, replay.header().scan_period_nanos)?;
        draw_typical(&measurement, &mut replay, &mut spool, &self.out.join(PICTURE))?;
        let report = DemoReport {
            capture,
            measure: measurement.report(Output::of(replay.header().mode)[0], &replay),
            truth_mm,
            events: replay.reader_mut().events()?,
            capture_s,
            measure_s: begin.elapsed().as_secs_f64(),
            peak_memory_bytes: peak_memory_bytes(),
            curve: measurement.curve,
        };
        let path = self.out.join(REPORT);
        let json = serde_json::to_string_pretty(&report)?;
        std::fs::write(&path, json).with_context(|| format!("{}: cannot write the report", path.display()))?;
        Outcome::of(self.json, &report, || self.describe(&report))
    }

    /// The built-in rig with one picture lost past the middle of the run.
    fn rig(&self) -> RigConfig {
        let mut config = RigConfig::simulated();
        config.sim.seed = self.seed;
        let sets = (self.seconds * 30.0) as u64;
        if sets >= 4 {
            config.sim.faults = vec![Fault { kind: FaultKind::Lost, set: sets / 2 + 1, picture: 4 }];
        }
        config
    }

    fn describe(&self, r: &DemoReport) -> String {
        let mut text = describe(&r.measure);
        let truth = &r.truth_mm;
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "  truth      scans rms {:.3} mm, replay rms {:.3} mm",
            truth.scan_to_truth.rms, truth.replay_to_truth.rms
        );
        let per_set = r.capture.rejected_pixels.total() / r.capture.frame_sets.max(1);
        let _ = writeln!(
            text,
            "  capture    {} frame sets, {} dropped, {per_set} pixels a set without surface, {:.1} ms reconstruction a scan",
            r.capture.frame_sets,
            r.capture.drops.sets(),
            r.capture.reconstruct_ms_per_scan
        );
        for event in &r.events {
            let what = match &event.kind {
                EventKind::Drop { cause, count } => format!("{count} dropped: {cause}"),
                EventKind::Gap { ticks } => format!("gap of {ticks} ticks"),
                other => format!("{other:?}"),
            };
            let _ = writeln!(text, "  event      tick {}: {what}", event.tick);
        }
        let memory = r.peak_memory_bytes.map_or(String::new(), |b| format!(", peak memory {:.0} MB", b as f64 * 1e-6));
        let _ = writeln!(
            text,
            "  took       capture {:.1} s, replay and measurement {:.1} s{memory}",
            r.capture_s, r.measure_s
        );
        let _ = write!(text, "look at {0}/{PICTURE} and {0}/{PLOT}; all figures in {0}/{REPORT}", self.out.display());
        text
    }
}

/// Records the session and keeps the scans on disk to measure against.
fn capture(config: &RigConfig, session: &Path, seconds: f64, folder: &Path) -> Result<(Recorded, ScanSpool)> {
    let spool = Arc::new(Mutex::new(Some(ScanSpool::create(folder)?)));
    let for_observer = Arc::clone(&spool);
    let observer = move |scan: &Scan| -> Result<(), String> {
        let mut spool = for_observer.lock().unwrap_or_else(PoisonError::into_inner);
        spool.as_mut().map_or(Ok(()), |s| s.push(scan)).map_err(|e| e.to_string())
    };
    let recorded = record_session(config, session, true, Some(seconds), Box::new(observer))?;
    let spool = spool.lock().unwrap_or_else(PoisonError::into_inner).take();
    Ok((recorded, spool.context("the scans are gone")?))
}

fn measure_all(config: &RigConfig, replay: &mut Replay, spool: &mut ScanSpool) -> Result<(Measurement, TruthReport)> {
    let world = SimWorld::new(config)?;
    let bar = bar(spool.len() as u64, "measure");
    let against_truth = |scan: &Scan, replayed: &Scan, _: &[f32]| {
        let truth = Bvh::new(&world.truth_mesh(scan.time_nanos));
        Ok((distances(&scan.mesh, &truth), distances(&replayed.mesh, &truth)))
    };
    let (measurement, truth) = measure(&mut SessionOutput::new(replay, None)?, spool, against_truth, || bar.inc(1))?;
    bar.finish_and_clear();
    let (mut scans, mut replays) = (ErrorHistogram::default(), ErrorHistogram::default());
    for (scan, replay) in &truth {
        scans.merge(scan);
        replays.merge(replay);
    }
    Ok((measurement, TruthReport { scan_to_truth: (&scans).into(), replay_to_truth: (&replays).into() }))
}

fn distances(mesh: &TriMesh, truth: &Bvh) -> ErrorHistogram {
    let mut histogram = ErrorHistogram::default();
    for &p in &mesh.positions_mm {
        if let Some(nearest) = truth.nearest(p, f32::INFINITY) {
            histogram.add(f64::from(nearest.distance2_mm2).sqrt());
        }
    }
    histogram
}

/// Draws the in-between scan of median error: scan, replay, error map.
fn draw_typical(measurement: &Measurement, replay: &mut Replay, spool: &mut ScanSpool, path: &Path) -> Result<()> {
    let figures = measurement.typical().context("nothing was captured")?;
    let index = (0..spool.len()).find(|&i| spool.tick(i) == figures.tick).context("the scan is gone")?;
    let scan = spool.load(index)?;
    let replayed = replay.scan_at(scan.time_nanos)?;
    let errors = compare(&scan, &replayed).vertex_error_mm;
    let kind = if figures.is_key { "a keyframe" } else { "between keyframes" };
    let caption = format!("tick {}, {kind}: rms {:.3} mm", figures.tick, figures.scan_to_replay_rms_mm);
    let picture = Comparison {
        scan: &scan.mesh,
        scan_texture: scan.texture.as_ref(),
        replay: &replayed.mesh,
        replay_texture: replayed.texture.as_ref(),
        error_mm: &errors,
        full_scale_mm: None,
        caption: &caption,
        side: ViewSide::default(),
    };
    std::fs::write(path, png_bytes(&picture.draw())).with_context(|| format!("{}: cannot write", path.display()))
}

/// VmHWM of /proc/self/status.
fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
}
