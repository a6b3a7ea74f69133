//! `gv3 bench live`: the engine of the daemon under its full load, measured.

mod report;
mod seek;

use super::Outcome;
use super::capture::seconds;
use super::progress::bar;
use crate::device::{self, Pace, RecordedConfig, RigConfig};
use crate::files::SessionsConfig;
use crate::light::{Direction, PatternSequence, Unwrap};
use crate::live::{Live, LiveConfig, LiveMetrics, RecordingRequest, RecordingStopped};
use crate::pipeline::RawRecorder;
use crate::pipeline::raw::run_rig;
use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use report::{LiveReport, Memory};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::{Duration, Instant};

/// Length of the recording that is made when none is given.
const RECORDING_SECONDS: f64 = 10.0;
/// Time between two looks at memory and status.
const SAMPLE: Duration = Duration::from_millis(250);
/// Longest wait for the first scan.
const PATIENCE: Duration = Duration::from_secs(30);

/// Measure how the daemon's engine keeps up, and how soon a session shows any moment.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  gv3 bench live --seconds 60\n  gv3 bench seek smile.gv3")]
pub struct Bench {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    Live(BenchLive),
    Seek(seek::BenchSeek),
}

/// Record live for a while from a recording played in a loop at the sensor's pace, or from the simulator, and print what it took.
///
/// Without a recording the simulated scanner makes one of 10 seconds first. Processor time includes the source of the pictures.
/// Beside every figure stands what it is to be.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 bench live --seconds 600\n  gv3 bench live smile-raw --json\n  gv3 bench live --sim --patterns 3"
)]
struct BenchLive {
    /// Raw recording to play, as `gv3 capture --raw` makes it.
    recording: Option<PathBuf>,
    /// The simulator renders the pictures as they are needed.
    #[arg(long, conflicts_with = "recording")]
    sim: bool,
    /// Patterns a scan of the simulated scanner: 6 at 180 pictures a second, or 3 at 90.
    #[arg(long, default_value_t = 6, value_parser = patterns, conflicts_with = "recording")]
    patterns: u32,
    /// How long to record.
    #[arg(long, default_value = "60", value_parser = seconds)]
    seconds: f64,
    /// Folder for the recording and the session, which are deleted afterwards; the system's temporary one if none is given.
    #[arg(long, value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Exit code 1 when a figure is not reached.
    #[arg(long)]
    check: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

fn patterns(text: &str) -> Result<u32, String> {
    match text {
        "3" => Ok(3),
        "6" => Ok(6),
        _ => Err("3 or 6".into()),
    }
}

impl Bench {
    pub(super) fn run(self) -> Result<Outcome> {
        match self.what {
            What::Live(live) => live.run(),
            What::Seek(seek) => seek.run(),
        }
    }
}

impl BenchLive {
    fn run(self) -> Result<Outcome> {
        let folder = match &self.folder {
            Some(folder) => tempfile::tempdir_in(folder).with_context(|| folder.display().to_string())?,
            None => tempfile::tempdir()?,
        };
        let (source, rig) = self.source(folder.path())?;
        let sessions = SessionsConfig { directory: folder.path().join("sessions"), ..SessionsConfig::default() };
        let report = measure(LiveConfig { rig, sessions }, source, self.seconds)?;
        let mut outcome = Outcome::of(self.json, &report, || report.text())?;
        outcome.is_fault = self.check && !report.is_met();
        Ok(outcome)
    }

    fn source(&self, folder: &Path) -> Result<(String, RigConfig)> {
        let simulated = if self.patterns == 3 { three_patterns() } else { RigConfig::simulated() };
        if self.sim {
            return Ok((format!("simulator rendering {} patterns", self.patterns), simulated));
        }
        let (name, path) = match &self.recording {
            Some(path) => (format!("recording {}", path.display()), path.clone()),
            None => {
                let path = folder.join("raw");
                make_recording(&simulated, &path)?;
                (format!("recording of the simulated scanner, {} patterns, looped", self.patterns), path)
            }
        };
        Ok((name, RigConfig::recorded(RecordedConfig { path, pace: Pace::Sensor, is_loop: true })?))
    }
}

/// The simulated scanner with one period that is absolute by itself, 30 scans a second.
fn three_patterns() -> RigConfig {
    let mut rig = RigConfig::simulated();
    rig.sequence =
        PatternSequence::n_step([rig.sequence.width_px, rig.sequence.height_px], Direction::Columns, 144.0, 3);
    rig.timing.picture_period_nanos *= 2;
    rig.processing.unwrap = Unwrap::Geometric;
    (rig.limits.depth.near_mm, rig.limits.depth.far_mm) = (555.0, 660.0);
    rig
}

fn make_recording(config: &RigConfig, folder: &Path) -> Result<()> {
    let rig = device::open(config)?;
    let periods = RECORDING_SECONDS * 1e9 / rig.timing.set_period_nanos(rig.sequence.patterns.len()) as f64;
    let bar = bar(0, "make the recording");
    let (rig, recorder) = RawRecorder::attach(rig, config, folder)?;
    run_rig(rig, Some(periods.round() as u64), &AtomicBool::new(false), &AtomicU64::new(0))?;
    let recorded = recorder.finish()?;
    bar.finish_and_clear();
    if !recorded.is_complete() {
        bail!("{}: the recording is incomplete: {}", folder.display(), recorded.error.unwrap_or_default());
    }
    Ok(())
}

/// What was seen while the engine ran.
#[derive(Default)]
struct Samples {
    memory: Vec<u64>,
    degradation: BTreeMap<&'static str, u64>,
}

fn measure(config: LiveConfig, source: String, seconds: f64) -> Result<LiveReport> {
    let patterns = config.rig.sequence.patterns.len();
    let begin = Instant::now();
    let live = Live::open(config)?;
    live.start_scanner()?;
    let ready_ms = begin.elapsed().as_secs_f64() * 1e3;
    while live.metrics().scans == 0 {
        if begin.elapsed() > PATIENCE {
            bail!("no scan came: {}", live.status().error.unwrap_or_default());
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let first_scan_ms = begin.elapsed().as_secs_f64() * 1e3;
    let (from, before, cpu) = (Instant::now(), live.metrics(), process_cpu());
    live.start_recording(RecordingRequest { name: Some("bench".into()), ..RecordingRequest::default() })?;
    let samples = watch(&live, from, seconds)?;
    // Until everything that was begun is done: work that is only put off costs, too.
    let stopped = live.stop_recording()?;
    let (elapsed, after, cpu) = (from.elapsed().as_secs_f64(), live.metrics(), process_cpu() - cpu);
    live.shut_down()?;
    let cpu_cores = cpu.as_secs_f64() / elapsed;
    let times = [elapsed, cpu_cores, ready_ms, first_scan_ms];
    Ok(report((source, patterns), times, [&before, &after], &samples, &stopped).judge())
}

fn watch(live: &Live, from: Instant, seconds: f64) -> Result<Samples> {
    let bar = bar((seconds * 10.0) as u64, "record live");
    let mut samples = Samples::default();
    while from.elapsed().as_secs_f64() < seconds {
        std::thread::sleep(SAMPLE.min(Duration::from_secs_f64(seconds).saturating_sub(from.elapsed())));
        let status = live.status();
        if status.recording.is_none() {
            bail!("the recording ended: {}", status.error.unwrap_or_default());
        }
        *samples.degradation.entry(status.degradation).or_default() += 1;
        samples.memory.extend(resident_bytes());
        bar.set_position((from.elapsed().as_secs_f64() * 10.0) as u64);
    }
    bar.finish_and_clear();
    Ok(samples)
}

fn report(
    (source, patterns): (String, usize),
    [seconds, cpu_cores, ready_ms, first_scan_ms]: [f64; 4],
    [before, after]: [&LiveMetrics; 2],
    samples: &Samples,
    stopped: &RecordingStopped,
) -> LiveReport {
    let rate = |after: u64, before: u64| (after - before) as f64 / seconds;
    // While the recording was being finished, scans were made that are not in it.
    let recorded_seconds = (seconds - stopped.ms * 1e-3).max(f64::MIN_POSITIVE);
    let looks = samples.degradation.values().sum::<u64>().max(1) as f64;
    LiveReport {
        source,
        patterns,
        seconds,
        pictures_per_second: rate(after.pictures, before.pictures),
        scans_per_second: rate(after.scans, before.scans),
        recorded_scans_per_second: stopped.scans as f64 / recorded_seconds,
        drops: after.drops.clone(),
        degradation: samples.degradation.iter().map(|(level, n)| (*level, *n as f64 / looks)).collect(),
        cpu_cores,
        stage_cores: std::array::from_fn(|i| (after.cpu_seconds[i] - before.cpu_seconds[i]) / seconds),
        memory_bytes: Memory::of(&samples.memory),
        picture_to_mesh: after.picture_to_mesh,
        group_on_disk: after.group_on_disk,
        ready_ms,
        first_scan_ms,
        stop_to_verified_ms: stopped.ms,
        session_bytes: stopped.bytes,
        keyframes: stopped.keyframes,
        verified: stopped.verified,
        aims: Vec::new(),
    }
}

/// User and system time of all threads.
fn process_cpu() -> Duration {
    #[cfg(target_os = "linux")]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
    }
    #[cfg(not(target_os = "linux"))]
    Duration::ZERO
}

/// VmRSS of /proc/self/status.
fn resident_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:"))?;
    Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
}
