//! Points, curves and their comparison, as JSON and CSV name them.

use super::bd_rate::{RateDifference, RatePoint, bd_rate};
use crate::measure::{DistortionReport, Measurement};
use serde::Serialize;
use std::fmt::Write;
use std::time::Duration;

/// One way to code at one quality.
#[derive(Debug, Clone, Serialize)]
pub struct Point {
    /// Quality as the coder names it.
    pub setting: String,
    /// Bytes of all scans' surfaces.
    pub bytes: u64,
    /// The same a scan.
    pub bytes_per_scan: f64,
    /// Root mean square of the distances, the worse direction, mm.
    pub rms_mm: f64,
    /// Largest distance, mm.
    pub max_mm: f64,
    /// Coding time a scan, wall clock.
    pub encode_ms_per_scan: f64,
    /// Decoding time a scan, wall clock.
    pub decode_ms_per_scan: f64,
    /// All errors.
    pub distortion: DistortionReport,
}

impl Point {
    /// A point from what was coded and measured.
    pub fn new(setting: String, bytes: u64, encode_time: Duration, measurement: &Measurement) -> Self {
        let distortion = DistortionReport::from(&measurement.comparisons);
        let scans = distortion.scans.max(1) as f64;
        Self {
            setting,
            bytes,
            bytes_per_scan: bytes as f64 / scans,
            rms_mm: distortion.worse_rms_mm(),
            max_mm: distortion.max_mm(),
            encode_ms_per_scan: encode_time.as_secs_f64() * 1e3 / scans,
            decode_ms_per_scan: measurement.decode_ms_per_scan(),
            distortion,
        }
    }
}

/// All qualities of one way to code.
#[derive(Debug, Clone, Serialize)]
pub struct Curve {
    /// Name of the coder.
    pub coder: String,
    /// What it does.
    pub about: String,
    /// Why it has no points, if so.
    pub unavailable: Option<String>,
    /// Measured points.
    pub points: Vec<Point>,
}

impl Curve {
    /// The curve for the difference of rates: quality is D1 PSNR.
    fn rate_points(&self) -> Vec<RatePoint> {
        let point = |p: &Point| Some(RatePoint { rate: p.bytes_per_scan, quality_db: p.distortion.d1_psnr_db? });
        self.points.iter().filter_map(point).collect()
    }
}

/// How much more one coder takes than another at the same D1 PSNR.
#[derive(Debug, Clone, Serialize)]
pub struct BdRate {
    /// What is compared.
    pub test: String,
    /// With what.
    pub anchor: String,
    /// By how much, over which quality.
    #[serde(flatten)]
    pub difference: RateDifference,
}

/// What `gv3 sweep` reports; names are frozen.
#[derive(Debug, Clone, Serialize)]
pub struct SweepReport {
    /// Folder of scans.
    pub input: String,
    /// Scans coded.
    pub scans: u64,
    /// Mean vertices of a scan.
    pub vertices_per_scan: f64,
    /// Input as OBJ and BMP, bytes a scan.
    pub obj_bmp_bytes_per_scan: f64,
    /// Input as float32, u32 and 8-bit texture, bytes a scan.
    pub binary_bytes_per_scan: f64,
    /// A curve a coder.
    pub curves: Vec<Curve>,
    /// Bjontegaard differences of every pair whose qualities meet.
    pub bd_rates: Vec<BdRate>,
}

/// Differences of every ordered pair of curves whose ranges of quality meet.
pub fn bd_rates(curves: &[Curve]) -> Vec<BdRate> {
    let mut rates = Vec::new();
    for test in curves {
        for anchor in curves.iter().filter(|a| a.coder != test.coder) {
            if let Some(difference) = bd_rate(&anchor.rate_points(), &test.rate_points()) {
                rates.push(BdRate { test: test.coder.clone(), anchor: anchor.coder.clone(), difference });
            }
        }
    }
    rates
}

/// Column names of [`csv`].
pub const CSV_HEADER: &str = "coder,setting,bytes_per_scan,percent_of_obj_bmp,percent_of_binary,rms_mm,max_mm,\
scan_to_replay_rms_mm,scan_to_replay_p95_mm,scan_to_replay_p99_mm,scan_to_replay_max_mm,replay_to_scan_rms_mm,\
replay_to_scan_p95_mm,replay_to_scan_p99_mm,replay_to_scan_max_mm,d1_psnr_db,d2_psnr_db,normal_rms_deg,missing,invented,\
encode_ms_per_scan,decode_ms_per_scan";

/// A line a point under `CSV_HEADER`.
pub fn csv(report: &SweepReport) -> String {
    let mut text = format!("{CSV_HEADER}\n");
    let optional = |x: Option<f64>| x.map_or(String::new(), |x| format!("{x:.3}"));
    for (curve, p) in report.curves.iter().flat_map(|c| c.points.iter().map(move |p| (c, p))) {
        let d = &p.distortion;
        let percent = |whole: f64| 100.0 * p.bytes_per_scan / whole.max(1.0);
        // Writing to a String cannot fail.
        let _ = write!(
            text,
            "{},{},{:.1},{:.5},{:.5},{:.5},{:.4}",
            curve.coder,
            p.setting.replace(',', ";"),
            p.bytes_per_scan,
            percent(report.obj_bmp_bytes_per_scan),
            percent(report.binary_bytes_per_scan),
            p.rms_mm,
            p.max_mm
        );
        for e in [d.surface_mm.scan_to_replay.all, d.surface_mm.replay_to_scan.all] {
            let _ = write!(text, ",{:.5},{:.4},{:.4},{:.4}", e.rms, e.p95, e.p99, e.max);
        }
        let decibels = [d.d1_psnr_db, d.d2_psnr_db, d.normal_rms_deg].map(optional).join(",");
        let _ = writeln!(
            text,
            ",{decibels},{:.6},{:.6},{:.2},{:.2}",
            d.coverage.missing, d.coverage.invented, p.encode_ms_per_scan, p.decode_ms_per_scan
        );
    }
    text
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A report of two made-up curves, the second at half the rate, and one that could not run.
    pub fn made_up() -> SweepReport {
        let point = |rate: f64, mm: f64| {
            let mut measurement = Measurement::default();
            let d = &mut measurement.comparisons.all;
            (d.scans, d.diagonal_mm) = (2, 300.0);
            d.scan_to_replay.add(mm);
            d.replay_to_scan.add(mm / 2.0);
            Point::new(format!("q{mm}"), (2.0 * rate) as u64, Duration::from_millis(10), &measurement)
        };
        let curve = |coder: &str, factor: f64| Curve {
            coder: coder.into(),
            about: format!("{coder} < made up"),
            unavailable: None,
            points: [(8000.0, 0.05), (4000.0, 0.1), (2000.0, 0.2)].map(|(rate, mm)| point(rate * factor, mm)).to_vec(),
        };
        let absent = Curve { unavailable: Some("tool missing".into()), points: vec![], ..curve("absent", 1.0) };
        let curves = vec![curve("one", 1.0), curve("two", 0.5), absent];
        SweepReport {
            input: "scans".into(),
            scans: 2,
            vertices_per_scan: 1000.0,
            obj_bmp_bytes_per_scan: 1e6,
            binary_bytes_per_scan: 3e5,
            bd_rates: bd_rates(&curves),
            curves,
        }
    }

    #[test]
    fn csv_has_a_field_a_column_and_a_line_a_point() {
        let report = made_up();
        let text = csv(&report);
        let columns = CSV_HEADER.split(',').count();
        assert_eq!(text.lines().count(), 1 + 6);
        assert!(text.lines().all(|l| l.split(',').count() == columns), "{text}");
        let second: Vec<&str> = text.lines().nth(2).unwrap().split(',').collect();
        assert_eq!(&second[..7], ["one", "q0.1", "4000.0", "0.40000", "1.33333", "0.10000", "0.1000"]);
    }

    #[test]
    fn half_the_rate_is_half_the_rate() {
        let rates = made_up().bd_rates;
        assert_eq!(rates.len(), 2);
        let of = |test: &str| rates.iter().find(|r| r.test == test).unwrap().difference.percent;
        assert!((of("two") + 50.0).abs() < 1e-9 && (of("one") - 100.0).abs() < 1e-9);
    }

    #[test]
    fn json_names_are_frozen() {
        let json = serde_json::to_value(made_up()).unwrap();
        for path in [
            "/curves/0/coder",
            "/curves/0/points/0/bytes_per_scan",
            "/curves/0/points/0/rms_mm",
            "/curves/0/points/0/encode_ms_per_scan",
            "/curves/0/points/0/distortion/surface_mm/scan_to_replay/all/p99",
            "/curves/0/points/0/distortion/coverage/invented",
            "/curves/0/points/0/distortion/d1_psnr_db",
            "/bd_rates/0/percent",
            "/bd_rates/0/anchor",
            "/obj_bmp_bytes_per_scan",
        ] {
            assert!(json.pointer(path).is_some_and(|v| !v.is_null()), "{path}");
        }
        assert_eq!(json.pointer("/curves/2/unavailable").unwrap(), "tool missing");
    }
}
