//! Codecs that one would use instead, as coders of a sweep.
//!
//! Libraries are linked, commands are called where they are installed. Every coder really decodes its bytes; what it
//! decodes is judged by the metrics that judge our own sessions.

mod depth;
mod draco;
mod hevc;
mod jpeg_xl;
mod keyframe_spline;
mod mask;
mod meshopt;
mod simplify_draco;

use crate::measure::{Decoded, MeasureError};
use crate::replay::ReplayStamp;
use crate::sweep::{Coded, Coder, SweepInput};
use gv3_codec::Scan;
use gv3_codec::mesh::TriMesh;
use rayon::prelude::*;
use std::process::Command;
use std::time::{Duration, Instant};

/// All baselines, those of single scans first.
pub fn coders() -> Vec<Box<dyn Coder>> {
    vec![
        Box::new(meshopt::coder()),
        Box::new(draco::coder()),
        Box::new(simplify_draco::coder()),
        Box::new(jpeg_xl::JpegXl),
        Box::new(hevc::Hevc::medium()),
        Box::new(hevc::Hevc::ultrafast()),
        Box::new(keyframe_spline::KeyframeSpline),
    ]
}

type Encode = fn(&TriMesh, usize) -> Result<Vec<u8>, String>;
type Decode = fn(&[u8]) -> Result<TriMesh, String>;

/// A codec of single meshes, used on every scan by itself.
struct EachScan {
    name: &'static str,
    about: &'static str,
    settings: Vec<String>,
    /// Of a mesh at a setting.
    encode: Encode,
    decode: Decode,
}

impl Coder for EachScan {
    fn name(&self) -> &'static str {
        self.name
    }
    fn about(&self) -> String {
        self.about.into()
    }
    fn settings(&self) -> Vec<String> {
        self.settings.clone()
    }
    fn code(&self, setting: usize, input: &SweepInput) -> Result<Coded, MeasureError> {
        let encode = |scan: &Scan| (self.encode)(&scan.mesh, setting);
        code_each(self.name, input, encode, Box::new(self.decode))
    }
}

type DecodeScan = Box<dyn Fn(&[u8]) -> Result<TriMesh, String> + Send>;

/// Codes the scans one by one, several at a time; the time is the sum over scans.
fn code_each(
    coder: &'static str,
    input: &SweepInput,
    encode: impl Fn(&Scan) -> Result<Vec<u8>, String> + Sync,
    decode: DecodeScan,
) -> Result<Coded, MeasureError> {
    let timed = |scan: &Scan| {
        let begin = Instant::now();
        encode(scan).map(|bytes| (bytes, begin.elapsed()))
    };
    let coded: Result<Vec<(Vec<u8>, Duration)>, String> = input.scans.par_iter().map(timed).collect();
    let coded = coded.map_err(|reason| MeasureError::Coder { coder, reason })?;
    let encode_time = coded.iter().map(|c| c.1).sum();
    let payloads: Vec<Vec<u8>> = coded.into_iter().map(|c| c.0).collect();
    let bytes = payloads.iter().map(|p| p.len() as u64).sum();
    let decoded = Payloads { coder, stamps: input.stamps(), period_nanos: input.period_nanos, payloads, decode };
    Ok(Coded { bytes, encode_time, decoded: Box::new(decoded) })
}

/// Coded scans that decode one by one.
struct Payloads {
    coder: &'static str,
    stamps: Vec<ReplayStamp>,
    period_nanos: u64,
    payloads: Vec<Vec<u8>>,
    decode: DecodeScan,
}

impl Decoded for Payloads {
    fn stamps(&self) -> &[ReplayStamp] {
        &self.stamps
    }
    fn period_nanos(&self) -> u64 {
        self.period_nanos
    }
    fn scan(&mut self, stamp: &ReplayStamp) -> Result<Scan, MeasureError> {
        let fail = |reason: String| MeasureError::Coder { coder: self.coder, reason };
        let at = self.stamps.iter().position(|s| s == stamp).ok_or_else(|| fail("no such scan".into()))?;
        scan_of((self.decode)(&self.payloads[at]).map_err(fail)?, stamp, self.coder)
    }
}

/// A decoded mesh as a scan, checked: metrics are for valid meshes only.
fn scan_of(mesh: TriMesh, stamp: &ReplayStamp, coder: &'static str) -> Result<Scan, MeasureError> {
    mesh.validate().map_err(|e| MeasureError::Coder { coder, reason: format!("decoded an invalid mesh: {e}") })?;
    Ok(Scan { tick: stamp.tick, time_nanos: stamp.time_nanos, mesh, texture: None })
}

/// Why a command cannot be used, if so.
fn missing_command(name: &str, version_flag: &str, what_to_do: &str) -> Option<String> {
    match Command::new(name).arg(version_flag).output() {
        Ok(output) if output.status.success() => None,
        Ok(output) => Some(format!("the command {name} does not run ({}); {what_to_do}", output.status)),
        Err(error) => Some(format!("the command {name} cannot be run ({error}); {what_to_do}")),
    }
}

/// Runs a command to its end; its words when it fails.
fn run(command: &mut Command) -> Result<(), String> {
    let output = command.output().map_err(|e| format!("{}: {e}", command.get_program().to_string_lossy()))?;
    if output.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    let last = said.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("it said nothing").trim();
    Err(format!("{} ended with {}: {last}", command.get_program().to_string_lossy(), output.status))
}
