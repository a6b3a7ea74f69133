//! Raw recordings on the command line: what `gv3 info` and `gv3 verify` say of them, scans of them, and `gv3 export-raw`.

use super::Outcome;
use super::progress::{bar, human_bytes};
use crate::device::{Pace, RecordedConfig, RigConfig};
use crate::files::picture::{PictureFormat, picture_bytes};
use crate::files::raw_folder::PictureNames;
use crate::files::{ExportFormat, ExportWriter, ProcessingConfig, RawFolder};
use crate::light::{MotionCorrection, RejectedPixels};
use crate::pipeline::{DropCounts, FrameSet, RawSets, Reconstructor};
use anyhow::{Context, Result, bail};
use clap::Args;
use gv3_protocol::raw::{RawReport, verify_raw};
use serde::Serialize;
use std::fmt::Write;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// The rig of a recording at its fastest pace.
fn stored_rig(folder: &Path) -> Result<RigConfig> {
    Ok(RigConfig::recorded(RecordedConfig { path: folder.to_path_buf(), pace: Pace::Fast, is_loop: false })?)
}

#[derive(Debug, Serialize)]
struct RawInfo {
    rig: String,
    camera_px: [u32; 2],
    patterns: usize,
    seconds: f64,
    picture_period_nanos: u64,
    #[serde(flatten)]
    content: RawReport,
}

/// What a recording holds, by its heads and checksums.
pub(super) fn info(folder: &Path, json: bool) -> Result<Outcome> {
    let config = stored_rig(folder)?;
    let content = verify_raw(folder, false)?;
    let info = RawInfo {
        rig: config.name.clone(),
        camera_px: [config.camera.width_px, config.camera.height_px],
        patterns: config.sequence.patterns.len(),
        seconds: content.device_time_nanos.map_or(0.0, |[first, last]| last.saturating_sub(first) as f64 * 1e-9),
        picture_period_nanos: config.timing.picture_period_nanos,
        content,
    };
    Outcome::of(json, &info, || {
        let (c, [width, height]) = (&info.content, info.camera_px);
        let state = if c.end.is_some() { "finished" } else { "cut off" };
        let mut text = format!("{}: raw recording, {state}\n", folder.display());
        // Writing to a String cannot fail.
        let _ = writeln!(text, "  rig          {}, {width} x {height}, {} patterns", info.rig, info.patterns);
        let _ = writeln!(
            text,
            "  pictures     {} in {} segments, {} missing, {} faults",
            c.pictures, c.segments, c.missing_pictures, c.faults
        );
        let _ = writeln!(
            text,
            "  length       {:.3} s at {:.3} ms a picture",
            info.seconds,
            info.picture_period_nanos as f64 * 1e-6
        );
        let ratio = c.pixel_bytes as f64 / c.bytes.max(1) as f64;
        let _ = writeln!(
            text,
            "  size         {} of {} (1 : {ratio:.2})",
            human_bytes(c.bytes),
            human_bytes(c.pixel_bytes)
        );
        if let Some(dropped) = c.end.map(|e| e.dropped_by_queue).filter(|&n| n > 0) {
            let _ = writeln!(text, "  left out     {dropped} pictures: the disk was too slow");
        }
        text + &problems(c)
    })
}

/// Every checksum and every picture of a recording.
pub(super) fn verify(folder: &Path, json: bool) -> Result<Outcome> {
    let report = verify_raw(folder, true)?;
    let mut outcome = Outcome::of(json, &report, || {
        let verdict = match (report.ok(), report.end) {
            (true, _) => "intact",
            (false, None) if report.problems.is_empty() => "cut off",
            (false, _) => "damaged",
        };
        let name = folder.display();
        format!(
            "{name}: {verdict}; {} pictures in {} segments decoded\n{}",
            report.pictures,
            report.segments,
            problems(&report)
        )
    })?;
    outcome.is_fault = !report.ok();
    Ok(outcome)
}

fn problems(report: &RawReport) -> String {
    let line = |p: &gv3_protocol::raw::RawProblem| {
        format!("  {}, byte {}, {}: {}\n", p.path.display(), p.offset, human_bytes(p.bytes), p.reason)
    };
    report.problems.iter().map(line).collect()
}

/// Scans made of a recording.
#[derive(Debug, Default, Serialize)]
pub(super) struct RawScans {
    scans: u64,
    vertices: u64,
    rejected_pixels: RejectedPixels,
    /// Ticks of sets that gave no surface.
    empty: Vec<u64>,
    drops: DropCounts,
    bytes: u64,
}

/// Reconstructs every complete frame set of a recording into a folder of scans.
pub(super) fn reconstruct(folder: &Path, out: &Path, format: ExportFormat, force: bool, json: bool) -> Result<Outcome> {
    let mut sets = RawSets::open(&stored_rig(folder)?)?;
    let rig = sets.rig();
    let mut reconstructor = Reconstructor::of(rig)?;
    let writer = ExportWriter::create(out, format, force)?;
    let mut report = RawScans::default();
    let bar = bar(0, "reconstruct");
    while let Some(set) = sets.next_set()? {
        let result = reconstructor.reconstruct(&set).with_context(|| format!("frame set {}", set.tick))?;
        report.rejected_pixels += result.rejected;
        bar.inc(1);
        if result.scan.mesh.triangles.is_empty() {
            report.empty.push(set.tick);
            continue;
        }
        report.scans += 1;
        report.vertices += result.scan.mesh.vertex_count() as u64;
        report.bytes += writer.write(set.tick, &result.scan.mesh, result.scan.texture.as_ref())?;
    }
    bar.finish_and_clear();
    report.drops = sets.finish();
    if report.scans == 0 {
        bail!(
            "{}: no frame set gave a surface ({} empty, {} dropped)",
            folder.display(),
            report.empty.len(),
            report.drops.sets()
        );
    }
    Outcome::of(json, &report, || {
        let (mean, bytes) = (report.vertices / report.scans, human_bytes(report.bytes));
        format!(
            "{}: {} scans of {mean} vertices, {bytes}; {} frame sets dropped, {} without a surface",
            out.display(),
            report.scans,
            report.drops.sets(),
            report.empty.len()
        )
    })
}

/// Write the pictures of a raw recording as PNG files, a folder a frame set, with what `gv3 reconstruct` needs.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  gv3 export-raw smile-raw -o pictures --sets 0..3\n  gv3 reconstruct pictures/set_0002 --sequence pictures/sequence.toml --calibration pictures/calibration.toml -o scan"
)]
pub struct ExportRaw {
    /// Folder of the recording.
    recording: PathBuf,
    /// Folder to write.
    #[arg(short, long)]
    out: PathBuf,
    /// First and last frame set by tick, as 0..3.
    #[arg(long, value_parser = tick_range)]
    sets: Option<RangeInclusive<u64>>,
    /// Write into a folder that is not empty.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

fn tick_range(text: &str) -> Result<RangeInclusive<u64>, String> {
    let parts = text.split_once("..").and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
    match parts {
        Some((first, last)) if first <= last => Ok(first..=last),
        _ => Err("a range of ticks is written like 0..3".into()),
    }
}

#[derive(Debug, Serialize)]
struct ExportReport {
    sets: u64,
    pictures: u64,
    bytes: u64,
}

impl ExportRaw {
    pub(super) fn run(self) -> Result<Outcome> {
        let config = stored_rig(&self.recording)?;
        let mut sets = RawSets::open(&config)?;
        // Takes the folder or refuses it as every export does.
        ExportWriter::create(&self.out, ExportFormat::Obj, self.force)?;
        let description = RawFolder {
            pictures: PictureNames::Numbered("picture_###.png".into()),
            first: 0,
            sequence: config.sequence.clone(),
            limits: Some(config.limits),
            // A single set has no set before it to tell motion from.
            processing: ProcessingConfig { motion: MotionCorrection::None, ..config.processing.clone() },
        };
        self.write("sequence.toml", description.to_toml()?.as_bytes())?;
        self.write("calibration.toml", config.calibration()?.to_toml()?.as_bytes())?;
        let names = description.names()?;
        let mut report = ExportReport { sets: 0, pictures: 0, bytes: 0 };
        while let Some(set) = sets.next_set()? {
            if self.sets.as_ref().is_none_or(|range| range.contains(&set.tick)) {
                self.write_set(&set, &names, &mut report)?;
            }
            if self.sets.as_ref().is_some_and(|range| set.tick >= *range.end()) {
                break;
            }
        }
        if report.sets == 0 {
            bail!("{}: no complete frame set in that range", self.recording.display());
        }
        Outcome::of(self.json, &report, || {
            let bytes = human_bytes(report.bytes);
            format!("{}: {} frame sets, {} pictures, {bytes}", self.out.display(), report.sets, report.pictures)
        })
    }

    fn write_set(&self, set: &FrameSet, names: &[String], report: &mut ExportReport) -> Result<()> {
        let folder = format!("set_{:04}", set.tick);
        std::fs::create_dir_all(self.out.join(&folder)).with_context(|| folder.clone())?;
        for (frame, name) in set.frames.iter().zip(names) {
            let name = format!("{folder}/{name}");
            let bytes = picture_bytes(&frame.picture, PictureFormat::Png, &self.out.join(&name))?;
            self.write(&name, &bytes)?;
            report.pictures += 1;
            report.bytes += bytes.len() as u64;
        }
        report.sets += 1;
        Ok(())
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let path = self.out.join(name);
        std::fs::write(&path, bytes).with_context(|| format!("{}: cannot write", path.display()))
    }
}
