//! What jobs do: verify, recover, export, compare.

use super::jobs::Progress;
use super::problem::Problem;
use super::zip::ZipWriter;
use crate::files::picture::PictureFormat;
use crate::files::{ExportFormat, SequenceWriter};
use crate::live::{DiskStatus, Live};
use crate::measure::Output;
use crate::replay::Replay;
use crate::store::SessionPlayer;
use gv3_codec::{Checker, metrics};
use serde::Deserialize;
use serde_json::{Value, json};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// Scans that one export may hold.
const MAX_EXPORTED: usize = 1_000_000;
/// Scans a second that may be asked for.
const FPS_LIMITS: std::ops::RangeInclusive<f64> = 0.01..=1000.0;

/// Free bytes above the floor that exports leave to recordings.
const SPARED_BYTES: u64 = 200_000_000;

/// What a job found.
pub struct Report(pub Value);

/// One job's work.
pub enum Work {
    /// Every checksum, index and payload.
    Verify {
        /// Segments.
        files: Vec<PathBuf>,
    },
    /// Make unfinished segments whole.
    Recover {
        /// Segments.
        files: Vec<PathBuf>,
    },
    /// Files that other programs open, in one archive.
    Export {
        /// Segments.
        files: Vec<PathBuf>,
        /// Which.
        export: Export,
        /// Knows what room must be left for recordings.
        live: Live,
    },
    /// Distances between two sessions, tick by tick.
    Compare {
        /// Segments of the one.
        files: Vec<PathBuf>,
        /// Segments of the other.
        with: Vec<PathBuf>,
    },
}

/// What is exported.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Export {
    /// Output of the session; the usual one of its mode if none is given.
    #[serde(default, rename = "as")]
    output: Option<Output>,
    /// Kind of files.
    format: Format,
    /// First tick; the first scan if none is given.
    first_tick: Option<u64>,
    /// Last tick.
    last_tick: Option<u64>,
    /// Scans a second instead of the original times.
    fps: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Format {
    Obj,
    Ply,
    Gltf,
}

impl Export {
    /// Checks what can be checked without the session.
    ///
    /// # Errors
    /// [`Problem`] 400 naming the field.
    pub fn check(&self) -> Result<(), Problem> {
        if self.fps.is_some_and(|fps| !FPS_LIMITS.contains(&fps)) {
            return Err(Problem::bad_request("fps: from 0.01 to 1000"));
        }
        if self.first_tick.zip(self.last_tick).is_some_and(|(first, last)| first > last) {
            return Err(Problem::bad_request("first_tick is after last_tick"));
        }
        Ok(())
    }

    /// Number in the file name and sensor time of every scan: ticks at original times, else a running number.
    fn times(&self, player: &SessionPlayer) -> Result<Vec<(u64, u64)>, String> {
        let ticks = self.first_tick.unwrap_or(0)..=self.last_tick.unwrap_or(u64::MAX);
        let chosen: Vec<_> = player.stamps().iter().filter(|s| ticks.contains(&s.tick)).collect();
        let (Some(first), Some(last)) = (chosen.first(), chosen.last()) else {
            return Err("no scan of the session lies between first_tick and last_tick".into());
        };
        let Some(fps) = self.fps else { return Ok(chosen.iter().map(|s| (s.tick, s.time_nanos)).collect()) };
        let count = ((last.time_nanos - first.time_nanos) as f64 * 1e-9 * fps + 1e-6) as usize + 1;
        if count > MAX_EXPORTED {
            return Err(format!("{count} scans; at most {MAX_EXPORTED} are exported at once"));
        }
        Ok((0..count as u64).map(|i| (i, first.time_nanos + (i as f64 * 1e9 / fps).round() as u64)).collect())
    }
}

/// The report, or none when the work was asked to end; an error in words.
type Ended = Result<Option<Report>, String>;

fn words(error: impl std::fmt::Display) -> String {
    error.to_string()
}

impl Work {
    /// Its name.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Verify { .. } => "verify",
            Self::Recover { .. } => "recover",
            Self::Export { .. } => "export",
            Self::Compare { .. } => "compare",
        }
    }

    /// Ending of its result's file.
    pub fn ending(&self) -> &'static str {
        if matches!(self, Self::Export { .. }) { "zip" } else { "json" }
    }

    /// Does it; what is too large for a report goes to `result`.
    pub fn run(&self, progress: &Progress, result: &Path) -> Ended {
        match self {
            Self::Verify { files } => verify(files, progress),
            Self::Recover { files } => recover(files, progress),
            Self::Export { files, export, live } => run_export(files, export, live, progress, result),
            Self::Compare { files, with } => compare(files, with, progress, result),
        }
    }
}

fn verify(files: &[PathBuf], progress: &Progress) -> Ended {
    let mut reports = Vec::new();
    let mut is_ok = true;
    for (number, path) in files.iter().enumerate() {
        let report = gv3_protocol::session::verify(path).map_err(words)?;
        let mut problems: Vec<String> =
            report.problems.iter().map(|p| format!("byte {}: {}", p.offset, p.reason)).collect();
        match Replay::open(path) {
            Ok(mut replay) => {
                let groups = replay.reader().groups().len();
                // As if the others were as long.
                progress.set_total((groups * files.len()) as u64);
                let mut checker = Checker::new(replay.header());
                for group in 0..groups {
                    let stored = replay.reader_mut().read_group(group).map_err(words);
                    let checked = stored.and_then(|s| checker.check(&s.geometry, s.texture.as_deref()).map_err(words));
                    if let Err(reason) = checked {
                        problems.push(format!("group {group}: {reason}"));
                    }
                    if !progress.step() {
                        return Ok(None);
                    }
                }
            }
            Err(error) => problems.push(error.to_string()),
        }
        is_ok &= problems.is_empty();
        reports.push(json!({
            "segment": number + 1,
            "bytes": report.bytes,
            "finished": report.finished,
            "groups": report.groups,
            "problems": problems,
        }));
    }
    Ok(Some(Report(json!({ "ok": is_ok, "files": reports }))))
}

fn recover(files: &[PathBuf], progress: &Progress) -> Ended {
    progress.set_total(files.len() as u64);
    let mut reports = Vec::new();
    for (number, path) in files.iter().enumerate() {
        let report = gv3_protocol::session::recover(path, path, true).map_err(words)?;
        reports.push(json!({ "segment": number + 1, "groups": report.groups, "lost_bytes": report.lost_bytes }));
        if !progress.step() {
            return Ok(None);
        }
    }
    Ok(Some(Report(json!({ "files": reports }))))
}

fn run_export(files: &[PathBuf], export: &Export, live: &Live, progress: &Progress, result: &Path) -> Ended {
    let mut player = SessionPlayer::open(files, export.output).map_err(words)?;
    let times = export.times(&player)?;
    progress.set_total(times.len() as u64);
    let format = match export.format {
        Format::Obj => ExportFormat::Obj,
        Format::Ply => ExportFormat::Ply { picture: PictureFormat::Png },
        Format::Gltf => ExportFormat::Gltf,
    };
    let folder = tempfile::tempdir_in(result.parent().unwrap_or(Path::new("."))).map_err(words)?;
    let mut writer = SequenceWriter::create(folder.path(), format, true).map_err(words)?;
    let mut zip = ZipWriter::new(BufWriter::new(File::create(result).map_err(words)?));
    for (number, time_nanos) in &times {
        leave_room(live)?;
        let scan = player.scan_at(*time_nanos).map_err(words)?;
        writer.write(*number, &scan).map_err(words)?;
        pack(folder.path(), &mut zip).map_err(words)?;
        if !progress.step() {
            return Ok(None);
        }
    }
    writer.finish().map_err(words)?;
    pack(folder.path(), &mut zip).map_err(words)?;
    let (_, bytes) = zip.finish().map_err(words)?;
    let report = json!({ "as": player.output(), "scans": times.len(), "files": writer.files(), "bytes": bytes });
    Ok(Some(Report(report)))
}

/// Ends an export before it takes the room that recordings need.
fn leave_room(live: &Live) -> Result<(), String> {
    let DiskStatus { free_bytes, floor_bytes, .. } = live.status().disk;
    match free_bytes > floor_bytes.saturating_add(SPARED_BYTES) || floor_bytes == 0 {
        true => Ok(()),
        false => Err(format!("{free_bytes} bytes are free on the disk, recordings need {floor_bytes} of them")),
    }
}

/// Moves the files of one scan into the archive, in the order of their names.
fn pack(folder: &Path, zip: &mut ZipWriter<BufWriter<File>>) -> std::io::Result<()> {
    let mut paths = std::fs::read_dir(folder)?.map(|e| e.map(|e| e.path())).collect::<Result<Vec<_>, _>>()?;
    paths.sort();
    for path in paths {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        zip.add(&name, &std::fs::read(&path)?)?;
        std::fs::remove_file(&path)?;
    }
    Ok(())
}

fn compare(files: &[PathBuf], with: &[PathBuf], progress: &Progress, result: &Path) -> Ended {
    let usual = |files: &[PathBuf]| SessionPlayer::open(files, None).map_err(words);
    let (mut one, mut other) = (usual(files)?, usual(with)?);
    let times: std::collections::BTreeMap<u64, u64> = other.stamps().iter().map(|s| (s.tick, s.time_nanos)).collect();
    let shared: Vec<(u64, u64, u64)> =
        one.stamps().iter().filter_map(|s| Some((s.tick, s.time_nanos, *times.get(&s.tick)?))).collect();
    if shared.is_empty() {
        return Err("the two sessions have no tick in common".into());
    }
    progress.set_total(shared.len() as u64);
    let mut all = metrics::ErrorHistogram::default();
    let (mut ticks, mut rms_mm, mut p95_mm) = (Vec::new(), Vec::new(), Vec::new());
    for (tick, time, other_time) in shared {
        let (a, b) = (one.scan_at(time).map_err(words)?, other.scan_at(other_time).map_err(words)?);
        let distortion = metrics::compare(&a, &b).distortion;
        let mut both = distortion.scan_to_replay;
        both.merge(&distortion.replay_to_scan);
        let figures = both.summary();
        all.merge(&both);
        ticks.push(tick);
        rms_mm.push(figures.rms);
        p95_mm.push(figures.p95);
        if !progress.step() {
            return Ok(None);
        }
    }
    let total = all.summary();
    let report = json!({
        "ticks": ticks, "rms_mm": rms_mm, "p95_mm": p95_mm, "rms_mm_all": total.rms, "p95_mm_all": total.p95,
    });
    std::fs::write(result, report.to_string()).map_err(words)?;
    Ok(Some(Report(report)))
}
