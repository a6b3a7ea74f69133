//! Figures of a measurement, as JSON names them.

use gv3_codec::metrics::{
    Comparisons, Distortion, Drift, ErrorHistogram, ScanComparison, SurfaceErrors, TruthComparison,
};
use serde::Serialize;

use super::Output;
use crate::replay::ReplayStamp;

/// Root mean square, percentiles and maximum of a distance, millimetres.
#[derive(Debug, Clone, Copy, Default, Serialize)]
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

/// How decoded scans differ from the scans that came in. A ratio that would be infinite, as without any error, is none.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct DistortionReport {
    /// Scans measured.
    pub scans: u64,
    /// Keyframes among them.
    pub keyframes: u64,
    /// Distances.
    pub surface_mm: SurfaceReport,
    /// Missing and invented surface.
    pub coverage: Coverage,
    /// PSNR of the distances, the worse direction; peak: diagonal of the largest scan's bounding box.
    pub d1_psnr_db: Option<f64>,
    /// The same along the scan's normals.
    pub d2_psnr_db: Option<f64>,
    /// Angle between the normals of scan and replay, root mean square, degrees.
    pub normal_rms_deg: Option<f64>,
    /// Texture in the camera's view inside the common mask, all scans; none without textures.
    pub texture_psnr_db: Option<f64>,
    /// The same for keyframes.
    pub texture_psnr_keyframes_db: Option<f64>,
}

impl From<&Comparisons> for DistortionReport {
    fn from(Comparisons { all, keyframes, in_between }: &Comparisons) -> Self {
        let by_kind = |pick: fn(&Distortion) -> &ErrorHistogram| ErrorsByKind {
            all: pick(all).into(),
            keyframes: pick(keyframes).into(),
            in_between: pick(in_between).into(),
        };
        Self {
            scans: all.scans,
            keyframes: keyframes.scans,
            surface_mm: SurfaceReport {
                scan_to_replay: by_kind(|d| &d.scan_to_replay),
                replay_to_scan: by_kind(|d| &d.replay_to_scan),
            },
            coverage: Coverage { missing: all.missing.fraction(), invented: all.invented.fraction() },
            d1_psnr_db: finite(all.d1_psnr_db()),
            d2_psnr_db: finite(all.d2_psnr_db()),
            normal_rms_deg: all.normals.rms_deg(),
            texture_psnr_db: finite(all.texture.psnr_db()),
            texture_psnr_keyframes_db: finite(keyframes.texture.psnr_db()),
        }
    }
}

impl DistortionReport {
    /// Root mean square of the worse direction over all scans, mm.
    pub fn worse_rms_mm(&self) -> f64 {
        self.surface_mm.scan_to_replay.all.rms.max(self.surface_mm.replay_to_scan.all.rms)
    }

    /// Largest distance in either direction, mm.
    pub fn max_mm(&self) -> f64 {
        self.surface_mm.scan_to_replay.all.max.max(self.surface_mm.replay_to_scan.all.max)
    }
}

/// JSON has no infinity.
fn finite(db: Option<f64>) -> Option<f64> {
    db.filter(|x| x.is_finite())
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
#[derive(Debug, Clone, Copy, Default, Serialize)]
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
    /// Which output of the session was measured.
    pub output: Output,
    /// Errors.
    #[serde(flatten)]
    pub distortion: DistortionReport,
    /// Size of the session.
    pub bytes: SessionBytes,
    /// Size of the input.
    pub raw_bytes: ByRawForm<u64>,
    /// Size of the session in percent of the input; of a part of the session where a part was measured.
    pub percent_of_raw: ByRawForm<f64>,
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
    /// Replay to scan, 95th percentile, mm.
    pub replay_to_scan_p95_mm: f64,
    /// Larger of both maxima, mm.
    pub max_mm: f64,
    /// Share of the scan's vertices farther than 2 mm from the replay.
    pub missing: f64,
    /// Share of the replay's area farther than 2 mm from the scan.
    pub invented: f64,
    /// Angle between normals, root mean square, degrees.
    pub normal_rms_deg: Option<f64>,
    /// Texture in the camera's view inside the common mask.
    pub texture_psnr_db: Option<f64>,
}

impl ScanFigures {
    /// Figures of one scan; `first_nanos` is when the first was taken.
    pub fn new(stamp: ReplayStamp, first_nanos: u64, comparison: &ScanComparison) -> Self {
        let d = &comparison.distortion;
        let (there, back) = (d.scan_to_replay.summary(), d.replay_to_scan.summary());
        Self {
            tick: stamp.tick,
            time_s: (stamp.time_nanos - first_nanos) as f64 * 1e-9,
            is_key: stamp.is_key,
            scan_to_replay_rms_mm: there.rms,
            replay_to_scan_rms_mm: back.rms,
            scan_to_replay_p95_mm: there.p95,
            replay_to_scan_p95_mm: back.p95,
            max_mm: there.max.max(back.max),
            missing: d.missing.fraction(),
            invented: d.invented.fraction(),
            normal_rms_deg: d.normals.rms_deg(),
            texture_psnr_db: finite(d.texture.psnr_db()),
        }
    }
}

/// Against the surface without noise.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct TruthReport {
    /// Scans whose truth was found.
    pub scans: u64,
    /// Points spread evenly over the scans to the truth, mm.
    pub scan_to_truth_mm: Errors,
    /// Points spread evenly over the replay to the truth, mm.
    pub replay_to_truth_mm: Errors,
    /// Share of the truth's vertices seen by the scan to which the replay is nearer than the scan.
    pub replay_closer: f64,
}

impl TruthReport {
    /// Totals over `scans` comparisons.
    pub fn new(scans: u64, total: &TruthComparison) -> Self {
        Self {
            scans,
            scan_to_truth_mm: (&total.scan_to_truth).into(),
            replay_to_truth_mm: (&total.replay_to_truth).into(),
            replay_closer: total.closer.fraction(),
        }
    }
}

/// Median and tail of the error of followed points, mm.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct DriftErrors {
    /// Points measured.
    pub points: u64,
    /// Median.
    pub median_mm: f64,
    /// 95th percentile.
    pub p95_mm: f64,
    /// Largest.
    pub max_mm: f64,
}

impl From<&ErrorHistogram> for DriftErrors {
    fn from(h: &ErrorHistogram) -> Self {
        let summary = h.summary();
        Self { points: summary.count, median_mm: h.percentile_mm(50), p95_mm: summary.p95, max_mm: summary.max }
    }
}

/// Whether the mesh keeps to the same points of the surface, against a truth with fixed connectivity.
#[derive(Debug, Clone, Serialize)]
pub struct DriftReport {
    /// Scans whose truth was found.
    pub scans: u64,
    /// Spans of one connectivity.
    pub shots: u64,
    /// All scans but the first of each span.
    pub all: DriftErrors,
    /// Element n: n scans after a span began.
    pub after_scans: Vec<DriftErrors>,
    /// Share of faces that look away from the truth's face they lay on when the span began.
    pub folded_faces: f64,
}

impl DriftReport {
    /// Totals over `scans` scans.
    pub fn new(scans: u64, drift: &Drift) -> Self {
        Self {
            scans,
            shots: drift.shots,
            all: (&drift.total()).into(),
            after_scans: drift.by_age.iter().map(Into::into).collect(),
            folded_faces: drift.folded.fraction(),
        }
    }
}
