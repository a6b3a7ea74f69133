//! `gv3 capture`: records in the foreground.

use super::Outcome;
use super::progress::{bar, human_bytes};
use crate::device::{self, RigConfig};
use crate::pipeline::record::ScanObserver;
use crate::pipeline::{Reconstructor, RecordSettings, Recorded, record};
use anyhow::{Context, Result};
use clap::Args;
use gv3_codec::seed::EncoderConfig;
use gv3_protocol::session::{SessionFile, SessionMetadata, SessionWriter};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Record a session in the foreground, until --seconds have passed or Ctrl-C.
///
/// Every complete group is on disk before the next one begins; after a crash `gv3 recover` makes the file whole.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 capture smile.gv3 --config rig.toml --seconds 10\n  gv3 capture test.gv3 --sim --seconds 2"
)]
pub struct Capture {
    /// Session to write.
    out: PathBuf,
    /// Rig file: camera, projector, patterns, calibration.
    #[arg(long, required_unless_present = "sim", conflicts_with = "sim")]
    config: Option<PathBuf>,
    /// The built-in simulated scanner instead of hardware.
    #[arg(long)]
    sim: bool,
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

/// A length of time above zero and below a year.
pub fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s < 3.2e7 => Ok(s),
        _ => Err("seconds must be a number above 0".into()),
    }
}

impl Capture {
    pub(super) fn run(self) -> Result<Outcome> {
        let config = match &self.config {
            Some(path) => RigConfig::read(path)?,
            None => RigConfig::simulated(),
        };
        let recorded = record_session(&config, &self.out, self.force, self.seconds, Box::new(|_| Ok(())))?;
        let bytes = std::fs::metadata(&self.out).with_context(|| self.out.display().to_string())?.len();
        Outcome::of(self.json, &recorded, || {
            format!(
                "{}: {} scans, {} keyframes, {}; {} frame sets dropped",
                self.out.display(),
                recorded.scans,
                recorded.keyframes,
                human_bytes(bytes),
                recorded.drops.sets()
            )
        })
    }
}

/// Opens the rig and the file, records with a progress bar, and stops at Ctrl-C or SIGTERM.
pub fn record_session(
    config: &RigConfig,
    out: &Path,
    overwrite: bool,
    seconds: Option<f64>,
    observer: ScanObserver,
) -> Result<Recorded> {
    let rig = device::open(config)?;
    // Before the file: what cannot work leaves no session behind.
    Reconstructor::with(&rig.calibration, &rig.sequence, &rig.limits, &rig.processing)?;
    let period_nanos = rig.timing.set_period_nanos(rig.sequence.patterns.len());
    let scan_periods = seconds.map(|s| (s * 1e9 / period_nanos as f64).round().max(1.0) as u64);
    let created = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
    let encoder = EncoderConfig::new(period_nanos);
    let metadata =
        SessionMetadata::new(encoder.header.mode.name(), concat!("gv3 ", env!("CARGO_PKG_VERSION")), created)
            .with_calibration(&rig.calibration.to_toml()?)
            .with_configuration(&toml::to_string(config)?);
    let writer = SessionWriter::create(SessionFile::create(out, overwrite)?, &metadata)?;
    let (stop, progress) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let settings =
        RecordSettings { scan_periods, encoder, observer, stop: Arc::clone(&stop), progress: Arc::clone(&progress) };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let recorded = runtime.block_on(async {
        let bar = bar(scan_periods.unwrap_or(0), "capture");
        let recording = record(rig, settings, writer);
        tokio::pin!(recording);
        let mut tick = tokio::time::interval(Duration::from_millis(100));
        let mut asked = Box::pin(asked_to_stop());
        loop {
            tokio::select! {
                result = &mut recording => break result,
                _ = tick.tick() => bar.set_position(progress.load(Ordering::Relaxed)),
                () = &mut asked, if !stop.load(Ordering::Relaxed) => stop.store(true, Ordering::Relaxed),
            }
        }
    });
    recorded.with_context(|| format!("{}: recording ended early; complete groups are kept", out.display()))
}

/// Returns at Ctrl-C or SIGTERM.
async fn asked_to_stop() {
    use tokio::signal::unix::{SignalKind, signal};
    let terminate = async {
        match signal(SignalKind::terminate()) {
            Ok(mut s) => {
                s.recv().await;
            }
            Err(_) => std::future::pending().await,
        }
    };
    tokio::select! {
        result = tokio::signal::ctrl_c() => if result.is_err() { std::future::pending::<()>().await },
        () = terminate => {}
    }
}
