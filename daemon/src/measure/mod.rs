//! Ratio against distortion: what was decoded, compared with the scans that went in.

mod decoded;
mod reference;
mod report;
mod truth;

pub use decoded::{Decoded, Output, SessionOutput};
pub use reference::{Reference, binary_bytes, obj_bmp_bytes};
pub use report::{
    ByRawForm, Coverage, DistortionReport, DriftErrors, DriftReport, Errors, ErrorsByKind, MeasureReport, ScanFigures,
    SessionBytes, SurfaceReport, TruthReport,
};
pub use truth::{TruthScans, measure_drift};

use crate::files::FileError;
use crate::replay::{Replay, ReplayError, ReplayStamp};
use gv3_codec::Scan;
use gv3_codec::metrics::{Comparisons, compare};
use gv3_protocol::session::key;
use rayon::prelude::*;
use std::time::{Duration, Instant};

/// Scans compared side by side while as many are read ahead; bounds memory.
const BATCH: usize = 4;

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum MeasureError {
    /// The session.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// The input.
    #[error(transparent)]
    File(#[from] FileError),
    /// The two do not belong together.
    #[error("{0}")]
    Mismatch(String),
    /// A coder of a sweep.
    #[error("{coder}: {reason}")]
    Coder {
        /// Its name.
        coder: &'static str,
        /// What it said.
        reason: String,
    },
}

/// Totals and the curve of what was decoded.
#[derive(Debug, Clone, Default)]
pub struct Measurement {
    /// Errors, keyframes and in-between scans apart.
    pub comparisons: Comparisons,
    /// One entry a scan in time order.
    pub curve: Vec<ScanFigures>,
    /// Size of the input as OBJ and BMP.
    pub obj_bmp_bytes: u64,
    /// Size of the input as float32, u32 and 8-bit texture.
    pub binary_bytes: u64,
    /// Time that decoding took.
    pub decode_time: Duration,
}

/// Measures every scan of `reference` that was decoded, keyframes and in-betweens.
///
/// `inspect` sees each scan with its replay and the distance of each of the scan's vertices, on any thread; what it
/// returns comes back in time order.
///
/// # Errors
/// [`MeasureError`] when either cannot be read or they share no tick; the first error of `inspect`.
pub fn measure<T: Send>(
    decoded: &mut dyn Decoded,
    reference: &mut dyn Reference,
    inspect: impl Fn(&Scan, &Scan, &[f32]) -> Result<T, MeasureError> + Sync,
    mut step: impl FnMut(),
) -> Result<(Measurement, Vec<T>), MeasureError> {
    let pairs = shared_scans(decoded.stamps(), reference)?;
    let first_nanos = pairs[0].1.time_nanos;
    let mut loader = Loader { decoded, reference, decode_time: Duration::ZERO };
    let (mut comparisons, mut curve) = (Comparisons::default(), Vec::with_capacity(pairs.len()));
    let (mut raw_bytes, mut inspected) = ([0; 2], Vec::with_capacity(pairs.len()));
    let mut batches = pairs.chunks(BATCH);
    let mut ahead = batches.next().map(|batch| loader.load(batch)).transpose()?;
    while let Some(loaded) = ahead.take() {
        let next = batches.next();
        let compare_one = |l: &Loaded| {
            let comparison = compare(&l.scan, &l.replayed);
            let seen = inspect(&l.scan, &l.replayed, &comparison.vertex_error_mm);
            (l.stamp, comparison, [l.file_bytes.unwrap_or_else(|| obj_bmp_bytes(&l.scan)), binary_bytes(&l.scan)], seen)
        };
        let (compared, read) = rayon::join(
            || loaded.par_iter().map(compare_one).collect::<Vec<_>>(),
            || next.map(|batch| loader.load(batch)).transpose(),
        );
        for (stamp, comparison, bytes, seen) in compared {
            comparisons.add(&comparison, stamp.is_key);
            curve.push(ScanFigures::new(stamp, first_nanos, &comparison));
            raw_bytes = [raw_bytes[0] + bytes[0], raw_bytes[1] + bytes[1]];
            inspected.push(seen?);
            step();
        }
        ahead = read?;
    }
    let [obj_bmp_bytes, binary_bytes] = raw_bytes;
    let decode_time = loader.decode_time;
    Ok((Measurement { comparisons, curve, obj_bmp_bytes, binary_bytes, decode_time }, inspected))
}

/// A scan and what was decoded in its place.
struct Loaded {
    stamp: ReplayStamp,
    scan: Scan,
    file_bytes: Option<u64>,
    replayed: Scan,
}

struct Loader<'a> {
    decoded: &'a mut dyn Decoded,
    reference: &'a mut dyn Reference,
    decode_time: Duration,
}

impl Loader<'_> {
    fn load(&mut self, batch: &[(usize, ReplayStamp)]) -> Result<Vec<Loaded>, MeasureError> {
        let period_nanos = self.decoded.period_nanos();
        let mut loaded = Vec::with_capacity(batch.len());
        for &(i, stamp) in batch {
            let begin = Instant::now();
            let replayed = self.decoded.scan(&stamp)?;
            self.decode_time += begin.elapsed();
            let (scan, file_bytes) = self.reference.load(i, period_nanos)?;
            loaded.push(Loaded { stamp, scan, file_bytes, replayed });
        }
        Ok(loaded)
    }
}

/// Index in the reference and stamp in the session of the scans that both hold, at least one.
fn shared_scans(stamps: &[ReplayStamp], reference: &dyn Reference) -> Result<Vec<(usize, ReplayStamp)>, MeasureError> {
    let pairs: Vec<_> = (0..reference.count())
        .filter_map(|i| {
            let at = stamps.binary_search_by_key(&reference.tick(i), |s| s.tick).ok()?;
            Some((i, stamps[at]))
        })
        .collect();
    if pairs.is_empty() {
        return Err(MeasureError::Mismatch(
            "session and input share no tick; is this the input it was made from?".into(),
        ));
    }
    Ok(pairs)
}

impl Measurement {
    /// The report on a session's output.
    pub fn report(&self, output: Output, replay: &Replay) -> MeasureReport {
        let totals = replay.reader().totals();
        let statistics = replay.reader().metadata().statistics();
        let fringe = statistics.and_then(|s| s.number(key::RAW_FRINGE_BYTES));
        let raw_bytes = ByRawForm { obj_bmp: self.obj_bmp_bytes, binary: self.binary_bytes, fringe };
        let percent = |raw: u64| 100.0 * totals.session as f64 / raw.max(1) as f64;
        MeasureReport {
            output,
            distortion: (&self.comparisons).into(),
            bytes: SessionBytes {
                session: totals.session,
                geometry: totals.geometry,
                texture: totals.texture,
                container: totals.container,
            },
            raw_bytes,
            percent_of_raw: ByRawForm {
                obj_bmp: percent(raw_bytes.obj_bmp),
                binary: percent(raw_bytes.binary),
                fringe: fringe.map(percent),
            },
            encode_ms_per_scan: statistics.and_then(|s| s.number(key::ENCODE_MS_PER_SCAN)),
            decode_ms_per_scan: self.decode_ms_per_scan(),
        }
    }

    /// Decoding time a scan, milliseconds.
    pub fn decode_ms_per_scan(&self) -> f64 {
        self.decode_time.as_secs_f64() * 1e3 / self.comparisons.all.scans.max(1) as f64
    }

    /// The scan of median error, by preference one between keyframes: the typical one, for a picture.
    pub fn typical(&self) -> Option<&ScanFigures> {
        let mut order: Vec<_> = self.curve.iter().filter(|c| !c.is_key).collect();
        if order.is_empty() {
            order = self.curve.iter().collect();
        }
        order.sort_by(|a, b| a.scan_to_replay_rms_mm.total_cmp(&b.scan_to_replay_rms_mm));
        order.get(order.len() / 2).copied()
    }
}

/// Nothing to look at besides the figures.
pub fn nothing(_: &Scan, _: &Scan, _: &[f32]) -> Result<(), MeasureError> {
    Ok(())
}
