//! `gv3 info`: what a session holds.

use super::Outcome;
use super::progress::human_bytes;
use crate::replay::{Replay, describe};
use anyhow::Result;
use clap::Args;
use gv3_protocol::raw::RawReader;
use gv3_protocol::session::{ByteTotals, Event, SessionState};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::PathBuf;

/// Show what a session or a raw recording holds: length, scans, keyframes, sizes, events, how it was made.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  gv3 info smile.gv3")]
pub struct Info {
    /// Session, or folder of a raw recording, to read.
    session: PathBuf,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct InfoReport {
    state: SessionState,
    mode: String,
    producer: String,
    scans: usize,
    keyframes: usize,
    first_tick: u64,
    last_tick: u64,
    seconds: f64,
    scan_period_nanos: u64,
    keyframe_interval: u8,
    bytes: ByteTotals,
    events: Vec<Event>,
    statistics: BTreeMap<String, String>,
    has_calibration: bool,
}

impl Info {
    pub(super) fn run(self) -> Result<Outcome> {
        if RawReader::is_recording(&self.session) {
            return super::raw::info(&self.session, self.json);
        }
        let mut replay = Replay::open(&self.session)?;
        let events = replay.reader_mut().events()?;
        let reader = replay.reader();
        let metadata = reader.metadata();
        let stamps = replay.stamps();
        let (first, last) = (stamps[0], stamps[stamps.len() - 1]);
        let report = InfoReport {
            state: reader.state().clone(),
            mode: replay.header().mode.name().into(),
            producer: metadata.get("gv3.session", "producer").unwrap_or("unknown").into(),
            scans: stamps.len(),
            keyframes: stamps.iter().filter(|s| s.is_key).count(),
            first_tick: first.tick,
            last_tick: last.tick,
            seconds: (last.time_nanos - first.time_nanos) as f64 * 1e-9,
            scan_period_nanos: replay.header().scan_period_nanos,
            keyframe_interval: replay.header().keyframe_interval,
            bytes: reader.totals(),
            events,
            statistics: metadata
                .statistics()
                .map_or_else(BTreeMap::new, |s| s.iter().map(|(k, v)| (k.clone(), v.clone())).collect()),
            has_calibration: metadata.calibration().is_some(),
        };
        Outcome::of(self.json, &report, || self.describe(&report))
    }

    fn describe(&self, r: &InfoReport) -> String {
        let mut text = String::new();
        let bytes = &r.bytes;
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{}: {}", self.session.display(), describe(&r.state));
        let _ = writeln!(text, "  made by      {} (mode {})", r.producer, r.mode);
        let _ = writeln!(
            text,
            "  scans        {} ({} keyframes), ticks {} to {}",
            r.scans, r.keyframes, r.first_tick, r.last_tick
        );
        let _ =
            writeln!(text, "  length       {:.3} s at {:.3} ms a scan", r.seconds, r.scan_period_nanos as f64 * 1e-6);
        let _ = writeln!(
            text,
            "  size         {}: geometry {}, textures {}, container {}; {} a scan",
            human_bytes(bytes.session),
            human_bytes(bytes.geometry),
            human_bytes(bytes.texture),
            human_bytes(bytes.container),
            human_bytes(bytes.session / r.scans.max(1) as u64)
        );
        let _ = writeln!(text, "  calibration  {}", if r.has_calibration { "stored" } else { "none" });
        for event in &r.events {
            let _ = writeln!(
                text,
                "  event        tick {} at {:.3} s: {:?}",
                event.tick,
                event.time_nanos as f64 * 1e-9,
                event.kind
            );
        }
        text
    }
}
