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
        // Where only some of the session's scans were measured, they get their part of its bytes.
        let part = self.comparisons.all.scans as f64 / replay.stamps().len().max(1) as f64;
        let percent = |raw: u64| 100.0 * part * totals.session as f64 / raw.max(1) as f64;
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
                fringe: fringe.map(|raw| 100.0 * totals.session as f64 / raw.max(1) as f64),
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

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use gv3_codec::mesh::TriMesh;

    /// A grid of n by n quads over the square of 20 mm at a height.
    fn plane(n: u32, height_mm: f32) -> TriMesh {
        let at = |k: u32| 20.0 / n as f32 * k as f32;
        let quads = (0..n).flat_map(|j| (0..n).map(move |i| j * (n + 1) + i));
        TriMesh {
            positions_mm: (0..=n).flat_map(|j| (0..=n).map(move |i| Vec3::new(at(i), at(j), height_mm))).collect(),
            triangles: quads.flat_map(|a| [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]).collect(),
            uv: None,
        }
    }

    /// Planes at the heights of their ticks, as reference and, at other heights and coarser, as decoded.
    struct Planes {
        stamps: Vec<ReplayStamp>,
        quads: u32,
        height_mm: fn(u64) -> f32,
    }

    fn planes(ticks: std::ops::Range<u64>, quads: u32, height_mm: fn(u64) -> f32) -> Planes {
        let stamp = |tick| ReplayStamp { tick, time_nanos: 1000 * tick, is_key: tick % 5 == 0 };
        Planes { stamps: ticks.map(stamp).collect(), quads, height_mm }
    }

    impl Decoded for Planes {
        fn stamps(&self) -> &[ReplayStamp] {
            &self.stamps
        }
        fn period_nanos(&self) -> u64 {
            1000
        }
        fn scan(&mut self, stamp: &ReplayStamp) -> Result<Scan, MeasureError> {
            let mesh = plane(self.quads, (self.height_mm)(stamp.tick));
            Ok(Scan { tick: stamp.tick, time_nanos: stamp.time_nanos, mesh, texture: None })
        }
    }

    impl Reference for Planes {
        fn count(&self) -> usize {
            self.stamps.len()
        }
        fn tick(&self, i: usize) -> u64 {
            self.stamps[i].tick
        }
        fn load(&mut self, i: usize, _: u64) -> Result<(Scan, Option<u64>), FileError> {
            let mesh = plane(self.quads, (self.height_mm)(self.stamps[i].tick));
            Ok((Scan { tick: self.stamps[i].tick, mesh, ..Scan::default() }, Some(100)))
        }
    }

    fn near(a_mm: f64, b_mm: f64) -> bool {
        (a_mm - b_mm).abs() < 1e-5
    }

    #[test]
    fn every_shared_scan_is_measured_in_order_and_keyframes_apart() {
        let (mut decoded, mut reference) = (planes(2..13, 3, |t| 0.125 * (t % 5) as f32), planes(0..11, 8, |_| 0.0));
        let mut steps = 0;
        let seen = |scan: &Scan, replayed: &Scan, error_mm: &[f32]| {
            assert_eq!((scan.tick, error_mm.len()), (replayed.tick, 81));
            Ok(scan.tick)
        };
        let (m, ticks) = measure(&mut decoded, &mut reference, seen, || steps += 1).unwrap();
        assert_eq!(ticks, (2..11).collect::<Vec<u64>>());
        assert_eq!((steps, m.obj_bmp_bytes, m.binary_bytes), (9, 900, 9 * 12 * (81 + 128)));
        for figures in &m.curve {
            let expected_mm = 0.125 * (figures.tick % 5) as f64;
            assert!(
                near(figures.scan_to_replay_rms_mm, expected_mm) && near(figures.max_mm, expected_mm),
                "{figures:?}"
            );
            assert_eq!(figures.is_key, figures.tick % 5 == 0);
        }
        let report = DistortionReport::from(&m.comparisons);
        assert_eq!((report.scans, report.keyframes), (9, 2));
        assert!(near(report.surface_mm.scan_to_replay.keyframes.max, 0.0) && near(report.max_mm(), 0.5));
        assert_eq!(report.coverage.missing, 0.0);
        let typical = m.typical().unwrap();
        assert!(!typical.is_key && near(typical.scan_to_replay_rms_mm, 0.375), "{typical:?}");
    }

    #[test]
    fn what_shares_no_scan_or_fails_to_inspect_is_an_error() {
        let mut reference = planes(20..22, 3, |_| 0.0);
        let none = measure(&mut planes(0..3, 3, |_| 0.0), &mut reference, |_, _, _| Ok(()), || ());
        assert!(none.unwrap_err().to_string().contains("no tick"));
        let refuse = |_: &Scan, _: &Scan, _: &[f32]| Err::<(), _>(MeasureError::Mismatch("seen".into()));
        let refused = measure(&mut planes(20..22, 3, |_| 0.0), &mut reference, refuse, || ());
        assert_eq!(refused.unwrap_err().to_string(), "seen");
    }

    #[test]
    fn truth_is_found_by_the_numbers_of_the_files() {
        let (scans, clean) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let write = |folder: &tempfile::TempDir, number: u64, mesh: &TriMesh| {
            let path = folder.path().join(format!("frame_{number:04}.obj"));
            std::fs::write(path, crate::files::obj::obj_bytes(mesh, None)).unwrap();
        };
        for number in 7..10 {
            write(&scans, number, &plane(6, 0.5));
            write(&clean, number + 1, &plane(9, 0.0));
        }
        let input = crate::files::ScanFolder::open(scans.path()).unwrap();
        let truth = TruthScans::open(clean.path(), &input).unwrap();
        let inspect = |scan: &Scan, replayed: &Scan, _: &[f32]| truth.compare(scan, replayed);
        let (_, compared) = measure(&mut planes(0..3, 4, |_| 0.25), &mut input.clone(), inspect, || ()).unwrap();
        let report = TruthScans::total(compared);
        assert_eq!((report.scans, report.replay_closer), (2, 1.0));
        assert!(near(report.scan_to_truth_mm.rms, 0.5) && near(report.replay_to_truth_mm.rms, 0.25));
        // Ticks 1 and 2 have a truth; the plane that stands still has not drifted.
        let drift = measure_drift(&mut planes(0..4, 4, |_| 0.25), &truth, || ()).unwrap();
        assert_eq!((drift.scans, drift.shots, drift.folded_faces), (2, 1, 0.0));
        assert_eq!(drift.all.points, 100);
        assert!([drift.all.median_mm, drift.all.max_mm].iter().all(|mm| (mm - 0.25).abs() < 1e-5), "{drift:?}");
        write(&clean, 9, &plane(5, 0.0));
        let error = measure_drift(&mut planes(0..4, 4, |_| 0.25), &truth, || ()).unwrap_err();
        assert!(error.to_string().contains("tick 2"), "{error}");
        let elsewhere = tempfile::tempdir().unwrap();
        write(&elsewhere, 100, &plane(2, 0.0));
        write(&elsewhere, 101, &plane(2, 0.0));
        assert!(TruthScans::open(elsewhere.path(), &input).is_err());
    }
}
