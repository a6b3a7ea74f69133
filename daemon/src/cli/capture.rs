//! `gv3 capture`: records in the foreground.

use super::Outcome;
use super::progress::{bar, human_bytes};
use crate::device::{self, Pace, RecordedConfig, Rig, RigConfig};
use crate::pipeline::raw::run_rig;
use crate::pipeline::record::{ScanObserver, session_metadata};
use crate::pipeline::{DropCounts, RawRecorded, RawRecorder, Reconstructor, RecordSettings, Recorded, record};
use anyhow::{Context, Result, anyhow};
use clap::{ArgGroup, Args};
use gv3_codec::EncoderConfig;
use gv3_protocol::session::{SessionFile, SessionReader, SessionWriter};
use serde::Serialize;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Record a session, the camera's raw pictures, or both, in the foreground, until --seconds have passed or Ctrl-C.
///
/// Every complete group is on disk before the next one begins; after a crash `gv3 recover` makes the file whole. Raw pictures
/// are kept without loss, so that a session can be made of them again with other settings (--from-raw).
#[derive(Debug, Args)]
#[command(
    group(ArgGroup::new("source").required(true).args(["config", "sim", "from_raw"])),
    after_help = "Examples:\n  gv3 capture smile.gv3 --config rig.toml --seconds 10\n  gv3 capture test.gv3 --sim --seconds 2 --raw test-raw\n  gv3 capture --raw smile-raw --config rig.toml\n  gv3 capture again.gv3 --from-raw smile-raw"
)]
pub struct Capture {
    /// Session to write.
    #[arg(required_unless_present = "raw")]
    out: Option<PathBuf>,
    /// Rig file: camera, projector, patterns, calibration.
    #[arg(long)]
    config: Option<PathBuf>,
    /// The built-in simulated scanner instead of hardware.
    #[arg(long)]
    sim: bool,
    /// A raw recording instead of hardware.
    #[arg(long, value_name = "DIR")]
    from_raw: Option<PathBuf>,
    /// When the recording's pictures come.
    #[arg(long, value_enum, default_value_t = Pace::Fast, requires = "from_raw")]
    pace: Pace,
    /// Folder to keep the camera's pictures in, lossless; new or empty.
    #[arg(long, value_name = "DIR")]
    raw: Option<PathBuf>,
    /// Sensor time to record.
    #[arg(long, value_parser = seconds)]
    seconds: Option<f64>,
    /// Replace an existing session.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct CaptureReport {
    #[serde(flatten)]
    session: Option<Recorded>,
    /// Frame sets without a session.
    #[serde(skip_serializing_if = "Option::is_none")]
    sets: Option<SetCounts>,
    #[serde(skip_serializing_if = "Option::is_none")]
    raw: Option<RawRecorded>,
}

/// What the camera gave when no session was made of it.
#[derive(Debug, Serialize)]
struct SetCounts {
    frame_sets: u64,
    drops: DropCounts,
}

/// A length of time above zero and below a year.
pub fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s < 3.2e7 => Ok(s),
        _ => Err("seconds must be a number above 0".into()),
    }
}

impl Capture {
    pub(super) fn run(self) -> Result<Outcome> {
        let config = self.rig_config()?;
        let mut rig = device::open(&config)?;
        let mut recorder = None;
        if let Some(folder) = &self.raw {
            let (teed, begun) = RawRecorder::attach(rig, &config, folder)?;
            (rig, recorder) = (teed, Some(begun));
        }
        let mut report = CaptureReport { session: None, sets: None, raw: None };
        let captured = match &self.out {
            Some(out) => record_rig(rig, &config, out, self.force, self.seconds, Box::new(|_| Ok(())))
                .map(|recorded| report.session = Some(recorded)),
            None => capture_raw(rig, self.seconds).map(|sets| report.sets = Some(sets)),
        };
        // Also after a failure: what came before it is on its way to the disk.
        report.raw = recorder.map(RawRecorder::finish).transpose()?;
        captured?;
        let text = self.describe(&report)?;
        let mut outcome = Outcome::of(self.json, &report, || text)?;
        outcome.is_fault = report.raw.is_some_and(|raw| !raw.is_complete());
        Ok(outcome)
    }

    fn rig_config(&self) -> Result<RigConfig> {
        Ok(match (&self.config, &self.from_raw) {
            (Some(path), _) => RigConfig::read(path)?,
            (None, Some(path)) => {
                RigConfig::recorded(RecordedConfig { path: path.clone(), pace: self.pace, is_loop: false })?
            }
            (None, None) => RigConfig::simulated(),
        })
    }

    fn describe(&self, report: &CaptureReport) -> Result<String> {
        let mut lines = Vec::new();
        if let (Some(out), Some(recorded)) = (&self.out, &report.session) {
            let bytes = std::fs::metadata(out).with_context(|| out.display().to_string())?.len();
            lines.push(format!(
                "{}: {} scans, {} keyframes, {}; {} frame sets dropped",
                out.display(),
                recorded.scans,
                recorded.keyframes,
                human_bytes(bytes),
                recorded.drops.sets()
            ));
        }
        if let (Some(folder), Some(raw)) = (&self.raw, &report.raw) {
            lines.push(format!("{}: {}", folder.display(), describe_raw(raw)));
        }
        if let Some(sets) = &report.sets {
            lines.push(format!("  {} complete frame sets, {} dropped", sets.frame_sets, sets.drops.sets()));
        }
        Ok(lines.join("\n"))
    }
}

fn describe_raw(raw: &RawRecorded) -> String {
    let mut text = format!(
        "{} pictures, {} (1 : {:.2}), {:.2} ms a picture",
        raw.pictures,
        human_bytes(raw.bytes),
        raw.pixel_bytes as f64 / raw.bytes.max(1) as f64,
        raw.ms_per_picture
    );
    let causes = [
        (raw.dropped_by_queue, "left out: the disk was too slow"),
        (raw.dropped_by_disk, "left out after the disk failed"),
    ];
    for (count, cause) in causes.into_iter().filter(|c| c.0 > 0) {
        text.push_str(&format!("\n  {count} pictures {cause}"));
    }
    if let Some(error) = &raw.error {
        text.push_str(&format!("\n  {error}"));
    }
    text
}

/// Opens the rig and records as [`record_rig`] does.
pub fn record_session(
    config: &RigConfig,
    out: &Path,
    overwrite: bool,
    seconds: Option<f64>,
    observer: ScanObserver,
) -> Result<Recorded> {
    record_rig(device::open(config)?, config, out, overwrite, seconds, observer)
}

fn scan_periods(seconds: Option<f64>, period_nanos: u64) -> Option<u64> {
    seconds.map(|s| (s * 1e9 / period_nanos as f64).round().max(1.0) as u64)
}

/// Records a rig into a file with a progress bar, and stops at Ctrl-C or SIGTERM.
fn record_rig(
    rig: Rig,
    config: &RigConfig,
    out: &Path,
    overwrite: bool,
    seconds: Option<f64>,
    observer: ScanObserver,
) -> Result<Recorded> {
    // Before the file: what cannot work leaves no session behind.
    Reconstructor::of(&rig)?;
    let period_nanos = rig.timing.set_period_nanos(rig.sequence.patterns.len());
    let scan_periods = scan_periods(seconds, period_nanos);
    let created = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
    let encoder = EncoderConfig::new(period_nanos);
    let metadata = session_metadata(&encoder, created)
        .with_calibration(&rig.calibration.to_toml()?)
        .with_configuration(&toml::to_string(config)?);
    let writer = SessionWriter::create(SessionFile::create(out, overwrite)?, &metadata)?;
    let (stop, progress) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let settings =
        RecordSettings { scan_periods, encoder, observer, stop: Arc::clone(&stop), progress: Arc::clone(&progress) };
    let recorded = until_stopped(scan_periods, &stop, &progress, record(rig, settings, writer))?;
    recorded.or_else(|error| {
        // A file with nothing in it but its header is of no use to anyone and stands in the way of the next recording.
        let is_empty = SessionReader::open(out).map_or(true, |reader| reader.groups().is_empty());
        let rest = match is_empty && std::fs::remove_file(out).is_ok() {
            true => "recording ended before its first group was complete; no file is left",
            false => "recording ended early; complete groups are kept",
        };
        Err(error).with_context(|| format!("{}: {rest}", out.display()))
    })
}

/// Runs a rig without making a session; its pictures go to the raw recording.
fn capture_raw(rig: Rig, seconds: Option<f64>) -> Result<SetCounts> {
    let periods = scan_periods(seconds, rig.timing.set_period_nanos(rig.sequence.patterns.len()));
    let (stop, progress) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let (done, result) = tokio::sync::oneshot::channel();
    let (asked, count) = (Arc::clone(&stop), Arc::clone(&progress));
    let thread = std::thread::Builder::new().name("gv3-run".into()).spawn(move || {
        // The receiver waits for as long as this thread runs.
        let _ = done.send(run_rig(rig, periods, &asked, &count));
    })?;
    let ran =
        until_stopped(periods, &stop, &progress, async { result.await.context("the capture ended unexpectedly") })?;
    let joined = thread.join();
    let (frame_sets, drops) = ran??;
    joined.map_err(|_| anyhow!("the capture ended unexpectedly"))?;
    Ok(SetCounts { frame_sets, drops })
}

/// Drives `work` with a progress bar; Ctrl-C or SIGTERM sets `stop`, and the work ends by itself.
fn until_stopped<T>(
    scan_periods: Option<u64>,
    stop: &AtomicBool,
    progress: &AtomicU64,
    work: impl Future<Output = T>,
) -> Result<T> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let bar = bar(scan_periods.unwrap_or(0), "capture");
        tokio::pin!(work);
        let mut tick = tokio::time::interval(Duration::from_millis(100));
        let mut asked = Box::pin(asked_to_stop()?);
        loop {
            tokio::select! {
                result = &mut work => break Ok(result),
                _ = tick.tick() => bar.set_position(progress.load(Ordering::Relaxed)),
                () = &mut asked, if !stop.load(Ordering::Relaxed) => stop.store(true, Ordering::Relaxed),
            }
        }
    })
}

/// Returns at Ctrl-C or SIGTERM, which are caught from now on.
///
/// # Errors
/// When the system lets them not be caught.
pub(super) fn asked_to_stop() -> std::io::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    })
}

/// A flag that Ctrl-C or SIGTERM sets, for commands that end by themselves between two steps.
pub(super) fn stop_flag() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let asked = {
        let _entered = runtime.enter();
        asked_to_stop()?
    };
    std::thread::Builder::new().name("gv3-signals".into()).spawn(move || {
        runtime.block_on(asked);
        flag.store(true, Ordering::Relaxed);
    })?;
    Ok(stop)
}
