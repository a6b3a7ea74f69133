//! Ratio against distortion: a session compared with the scans that went in.

use crate::files::obj::{Material, obj_bytes};
use crate::files::picture::{PictureFormat, picture_bytes};
use crate::files::{FileError, ScanFolder, ScanSpool};
use crate::replay::{Replay, ReplayError, ReplayStamp};
use gv3_codec::Scan;
use gv3_codec::metrics::{
    Comparisons, Distortion, ErrorHistogram, ScanComparison, SurfaceErrors, TextureError, compare,
};
use gv3_protocol::session::key;
use rayon::prelude::*;
use serde::Serialize;
use std::path::Path;
use std::time::{Duration, Instant};

/// Scans compared side by side; bounds memory.
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
}

/// Scans that a session is measured against.
pub trait Reference {
    /// Number of scans.
    fn count(&self) -> usize;
    /// Tick of scan `i`.
    fn tick(&self, i: usize) -> u64;
    /// Loads scan `i`; what it takes on disk as OBJ and BMP, if its files say so.
    ///
    /// # Errors
    /// [`FileError`] of its files.
    fn load(&mut self, i: usize, period_nanos: u64) -> Result<(Scan, Option<u64>), FileError>;
}

impl Reference for ScanFolder {
    fn count(&self) -> usize {
        self.len()
    }
    fn tick(&self, i: usize) -> u64 {
        ScanFolder::tick(self, i)
    }
    fn load(&mut self, i: usize, period_nanos: u64) -> Result<(Scan, Option<u64>), FileError> {
        Ok((ScanFolder::load(self, i, period_nanos)?.scan, Some(self.scan_bytes(i))))
    }
}

impl Reference for ScanSpool {
    fn count(&self) -> usize {
        self.len()
    }
    fn tick(&self, i: usize) -> u64 {
        ScanSpool::tick(self, i)
    }
    fn load(&mut self, i: usize, _: u64) -> Result<(Scan, Option<u64>), FileError> {
        Ok((ScanSpool::load(self, i)?, None))
    }
}

/// Root mean square, percentiles and maximum of a distance, millimetres.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Errors {
    /// Root mean square.
    pub rms: f64,
    /// 95th percentile.
    pub p95: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Largest.
    pub max: f64,
}

impl From<&ErrorHistogram> for Errors {
    fn from(histogram: &ErrorHistogram) -> Self {
        let SurfaceErrors { rms, p95, p99, max, .. } = histogram.summary();
        Self { rms, p95, p99, max }
    }
}

/// The same for all scans, keyframes, and the scans between.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct ErrorsByKind {
    /// Every scan.
    pub all: Errors,
    /// Keyframes.
    pub keyframes: Errors,
    /// The others.
    pub in_between: Errors,
}

/// Distances both ways, millimetres.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct SurfaceReport {
    /// Every vertex of the scan to the replayed surface.
    pub scan_to_replay: ErrorsByKind,
    /// Area-uniform samples of the replay to the scan.
    pub replay_to_scan: ErrorsByKind,
}

/// Shares of surface, 0 to 1.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Coverage {
    /// Vertices of the scans farther than 2 mm from the replay.
    pub missing: f64,
    /// Replayed area farther than 2 mm from the scan.
    pub invented: f64,
}

/// Bytes of a session by use.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct SessionBytes {
    /// The file.
    pub session: u64,
    /// Group payloads.
    pub geometry: u64,
    /// Texture payloads.
    pub texture: u64,
    /// Everything else.
    pub container: u64,
}

/// A number against each way to store the input raw.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct ByRawForm<T> {
    /// OBJ and BMP files as a scanner stores them.
    pub obj_bmp: T,
    /// float32 vertices, u32 triangles, 8-bit texture.
    pub binary: T,
    /// 8-bit fringe pictures, where the session was captured from them.
    pub fringe: Option<T>,
}

/// What `gv3 measure` reports; names are frozen.
#[derive(Debug, Clone, Serialize)]
pub struct MeasureReport {
    /// Scans measured.
    pub scans: u64,
    /// Keyframes among them.
    pub keyframes: u64,
    /// Size of the session.
    pub bytes: SessionBytes,
    /// Size of the input.
    pub raw_bytes: ByRawForm<u64>,
    /// Size of the session in percent of the input.
    pub percent_of_raw: ByRawForm<f64>,
    /// Distances.
    pub surface_mm: SurfaceReport,
    /// Missing and invented surface.
    pub coverage: Coverage,
    /// Texture in the camera's view inside the common mask, all scans; none without textures.
    pub texture_psnr_db: Option<f64>,
    /// The same for keyframes.
    pub texture_psnr_keyframes_db: Option<f64>,
    /// Coding time a scan, as the session says.
    pub encode_ms_per_scan: Option<f64>,
    /// Decoding time a scan, measured now.
    pub decode_ms_per_scan: f64,
}

/// One scan's figures, for plots.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct ScanFigures {
    /// Tick.
    pub tick: u64,
    /// Sensor time after the first scan, seconds.
    pub time_s: f64,
    /// Whether it is a keyframe.
    pub is_key: bool,
    /// Scan to replay, rms, mm.
    pub scan_to_replay_rms_mm: f64,
    /// Replay to scan, rms, mm.
    pub replay_to_scan_rms_mm: f64,
    /// Scan to replay, 95th percentile, mm.
    pub scan_to_replay_p95_mm: f64,
}

/// A measurement: the report, the curve, and the worst scan for a picture.
#[derive(Debug, Clone)]
pub struct Measurement {
    /// Totals.
    pub report: MeasureReport,
    /// One entry a scan in time order.
    pub curve: Vec<ScanFigures>,
}

/// Measures every scan of `reference` that the session holds, keyframes and in-betweens.
///
/// `inspect` sees each scan with its replay, on any thread; what it returns comes back in time order.
///
/// # Errors
/// [`MeasureError`] when either cannot be read or they share no tick.
pub fn measure<T: Send>(
    replay: &mut Replay,
    reference: &mut dyn Reference,
    inspect: impl Fn(&Scan, &Scan) -> T + Sync,
    mut step: impl FnMut(),
) -> Result<(Measurement, Vec<T>), MeasureError> {
    let period_nanos = replay.header().scan_period_nanos;
    let pairs = shared_scans(replay.stamps(), reference)?;
    let (mut totals, mut inspected) = (Totals::default(), Vec::with_capacity(pairs.len()));
    for batch in pairs.chunks(BATCH) {
        let mut loaded = Vec::with_capacity(batch.len());
        for &(i, stamp) in batch {
            let begin = Instant::now();
            let replayed = replay.scan_at(stamp.time_nanos)?;
            totals.decode_time += begin.elapsed();
            let (scan, file_bytes) = reference.load(i, period_nanos)?;
            loaded.push((stamp, scan, file_bytes, replayed));
        }
        let compared: Vec<_> = loaded
            .par_iter()
            .map(|(stamp, scan, file_bytes, replayed)| {
                let raw = [file_bytes.unwrap_or_else(|| obj_bmp_bytes(scan)), binary_bytes(scan)];
                (*stamp, compare(scan, replayed), raw, inspect(scan, replayed))
            })
            .collect();
        for (stamp, comparison, raw, seen) in compared {
            totals.add(stamp, &comparison, raw);
            inspected.push(seen);
            step();
        }
    }
    Ok((totals.finish(replay), inspected))
}

/// Index in the reference and stamp in the session of the scans that both hold.
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

/// What a scan takes as OBJ and BMP files, by writing them to memory.
pub fn obj_bmp_bytes(scan: &Scan) -> u64 {
    let material = scan.texture.as_ref().map(|_| Material { library: "frame_0000.mtl", picture: "frame_0000.bmp" });
    let picture = scan
        .texture
        .as_ref()
        .map_or(0, |t| picture_bytes(t, PictureFormat::Bmp, Path::new("frame_0000.bmp")).map_or(0, |b| b.len()));
    (obj_bytes(&scan.mesh, material).len() + picture) as u64
}

/// A scan as float32 vertices, u32 triangles and 8-bit texture.
pub fn binary_bytes(scan: &Scan) -> u64 {
    let texture = scan.texture.as_ref().map_or(0, |t| t.pixels.len());
    (12 * scan.mesh.vertex_count() + 12 * scan.mesh.triangles.len() + texture) as u64
}

#[derive(Default)]
struct Totals {
    comparisons: Comparisons,
    obj_bmp: u64,
    binary: u64,
    decode_time: Duration,
    curve: Vec<ScanFigures>,
    first_nanos: Option<u64>,
}

impl Totals {
    fn add(&mut self, stamp: ReplayStamp, comparison: &ScanComparison, [obj_bmp, binary]: [u64; 2]) {
        self.comparisons.add(comparison, stamp.is_key);
        self.obj_bmp += obj_bmp;
        self.binary += binary;
        let first = *self.first_nanos.get_or_insert(stamp.time_nanos);
        let there = comparison.distortion.scan_to_replay.summary();
        self.curve.push(ScanFigures {
            tick: stamp.tick,
            time_s: (stamp.time_nanos - first) as f64 * 1e-9,
            is_key: stamp.is_key,
            scan_to_replay_rms_mm: there.rms,
            replay_to_scan_rms_mm: comparison.distortion.replay_to_scan.summary().rms,
            scan_to_replay_p95_mm: there.p95,
        });
    }

    fn finish(self, replay: &Replay) -> Measurement {
        let totals = replay.reader().totals();
        let statistics = replay.reader().metadata().statistics();
        let fringe = statistics.and_then(|s| s.number(key::RAW_FRINGE_BYTES));
        let raw_bytes = ByRawForm { obj_bmp: self.obj_bmp, binary: self.binary, fringe };
        let percent = |raw: u64| 100.0 * totals.session as f64 / raw.max(1) as f64;
        let Comparisons { all, keyframes, in_between } = &self.comparisons;
        let by_kind = |pick: fn(&Distortion) -> &ErrorHistogram| ErrorsByKind {
            all: pick(all).into(),
            keyframes: pick(keyframes).into(),
            in_between: pick(in_between).into(),
        };
        // JSON has no infinity: a texture without error is reported as none measured would be.
        let psnr = |t: &TextureError| t.psnr_db().filter(|p| p.is_finite());
        let report = MeasureReport {
            scans: all.scans,
            keyframes: keyframes.scans,
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
            surface_mm: SurfaceReport {
                scan_to_replay: by_kind(|d| &d.scan_to_replay),
                replay_to_scan: by_kind(|d| &d.replay_to_scan),
            },
            coverage: Coverage { missing: all.missing.fraction(), invented: all.invented.fraction() },
            texture_psnr_db: psnr(&all.texture),
            texture_psnr_keyframes_db: psnr(&keyframes.texture),
            encode_ms_per_scan: statistics.and_then(|s| s.number(key::ENCODE_MS_PER_SCAN)),
            decode_ms_per_scan: self.decode_time.as_secs_f64() * 1e3 / all.scans.max(1) as f64,
        };
        Measurement { report, curve: self.curve }
    }
}
