//! `gv3 sweep`: rate against distortion, our modes beside what one would use instead.

use super::Outcome;
use super::encode::fps;
use super::progress::{bar, human_bytes};
use crate::files::{ScanFolder, write_whole};
use crate::sweep::{
    Coder, Curve, ErrorMapFile, ModeCoder, Page, Point, SweepInput, SweepReport, bd_rates, csv, html, run_point,
};
use crate::view::compare::png_bytes;
use crate::view::plot::Series;
use crate::view::rate_plot::rate_plot;
use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Code scans in several ways at several qualities and compare bytes and errors: CSV, JSON, plots, and one page.
///
/// Surfaces only: textures are left out of all sizes. Ways other than our own need a build with the feature `baselines`
/// (and some of them the commands ffmpeg, cjxl and djxl); those that cannot run here are named with the reason.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 sweep recordings/smile -o smile-report\n  gv3 sweep recordings/smile --codecs gv3,seed,draco,hevc-medium --scans 30 -o smile-report"
)]
pub struct Sweep {
    /// Folder of scans.
    input: PathBuf,
    /// Folder of the report.
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
    /// Coders to run, all when none are named.
    #[arg(long, value_delimiter = ',', value_name = "NAME,NAME...")]
    codecs: Vec<String>,
    /// Tolerances of the default mode, millimetres.
    #[arg(long, value_delimiter = ',', default_value = "0.04,0.06,0.08,0.1,0.14,0.2", value_parser = tolerance, value_name = "MM,MM...")]
    tolerances: Vec<f32>,
    /// Keyframe intervals for the seed mode, scans.
    #[arg(long, value_delimiter = ',', default_value = "2,3,5,10", value_parser = clap::value_parser!(u8).range(1..), value_name = "N,N...")]
    intervals: Vec<u8>,
    /// Code this many scans from the first on; they are held in memory.
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..=2000))]
    scans: u32,
    /// Scans a second of the input.
    #[arg(long, default_value_t = 30.0, value_parser = fps)]
    fps: f64,
    /// Replace a report.
    #[arg(long)]
    force: bool,
    /// Report as JSON on standard output too.
    #[arg(long)]
    json: bool,
}

/// Names of the files of a report.
const PAGE: &str = "report.html";
const JSON: &str = "sweep.json";
const CSV: &str = "sweep.csv";

fn tolerance(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(mm) if (1e-6..=100.0).contains(&mm) => Ok(mm),
        _ => Err("a tolerance must lie between 0.000001 and 100 mm".into()),
    }
}

impl Sweep {
    pub(super) fn run(self) -> Result<Outcome> {
        let period_nanos = (1e9 / self.fps).round() as u64;
        let coders = self.coders(period_nanos)?;
        if self.out.join(PAGE).exists() && !self.force {
            bail!("{}: holds a report; give another folder, or --force to replace it", self.out.display());
        }
        std::fs::create_dir_all(&self.out)
            .with_context(|| format!("{}: cannot create the folder", self.out.display()))?;
        let folder = ScanFolder::open(&self.input)?;
        let count = folder.len().min(self.scans as usize);
        let loading = bar(count as u64, "load");
        let input = SweepInput::load(&folder, count, period_nanos, || loading.inc(1))?;
        loading.finish_and_clear();
        let (mut curves, mut maps) = (Vec::new(), Vec::new());
        for coder in &coders {
            curves.push(run_curve(coder.as_ref(), &input, &mut maps));
        }
        let per_scan = |bytes: u64| bytes as f64 / count as f64;
        let report = SweepReport {
            input: self.input.display().to_string(),
            scans: count as u64,
            vertices_per_scan: per_scan(input.scans.iter().map(|s| s.mesh.vertex_count() as u64).sum()),
            obj_bmp_bytes_per_scan: per_scan(input.obj_bmp_bytes),
            binary_bytes_per_scan: per_scan(input.binary_bytes),
            bd_rates: bd_rates(&curves),
            curves,
        };
        write_report(&self.out, &report, &maps)?;
        Outcome::of(self.json, &report, || describe(&report, &self.out))
    }

    fn coders(&self, period_nanos: u64) -> Result<Vec<Box<dyn Coder>>> {
        let mut all: Vec<Box<dyn Coder>> = vec![
            Box::new(ModeCoder::shots(&self.tolerances, period_nanos)),
            Box::new(ModeCoder::seed(&self.intervals, &[0.025], period_nanos)),
        ];
        #[cfg(feature = "baselines")]
        all.extend(crate::baselines::coders());
        let names: Vec<&str> = all.iter().map(|c| c.name()).collect();
        if let Some(unknown) = self.codecs.iter().find(|n| !names.contains(&n.as_str())) {
            let hint = if cfg!(feature = "baselines") { "" } else { "; others need a build with --features baselines" };
            bail!("no coder {unknown}; there are {}{hint}", names.join(", "));
        }
        all.retain(|c| self.codecs.is_empty() || self.codecs.iter().any(|n| n == c.name()));
        Ok(all)
    }
}

/// All points of a coder; one that fails ends the curve and is said.
fn run_curve(coder: &dyn Coder, input: &SweepInput, maps: &mut Vec<ErrorMapFile>) -> Curve {
    let mut curve = Curve {
        coder: coder.name().into(),
        about: coder.about(),
        unavailable: coder.unavailable(input),
        points: Vec::new(),
    };
    let settings = coder.settings();
    let bar = bar((settings.len() * input.scans.len()) as u64, coder.name());
    for (i, setting) in settings.iter().enumerate() {
        if curve.unavailable.is_some() {
            break;
        }
        match run_point(coder, i, input, || bar.inc(1)) {
            Ok((point, map)) => {
                maps.push((curve.coder.clone(), setting.clone(), png_bytes(&map)));
                curve.points.push(point);
            }
            Err(error) => curve.unavailable = Some(format!("{setting}: {error}")),
        }
    }
    bar.finish_and_clear();
    if let Some(reason) = &curve.unavailable {
        tracing::warn!("{}: {reason}", curve.coder);
    }
    curve
}

/// Name of the file, label of the axis, value of a point.
type Quantity = (&'static str, &'static str, fn(&Point) -> f64);

fn write_report(out: &Path, report: &SweepReport, maps: &[ErrorMapFile]) -> Result<()> {
    let mut plots = Vec::new();
    let quantities: [Quantity; 3] = [
        ("rms", "rms of the worse direction, mm", |p| p.rms_mm),
        ("p99", "99th percentile of the worse direction, mm", |p| {
            let surface = &p.distortion.surface_mm;
            surface.scan_to_replay.all.p99.max(surface.replay_to_scan.all.p99)
        }),
        ("max", "largest error, mm", |p| p.max_mm),
    ];
    for (name, label, value) in quantities {
        let series: Vec<Series> = report
            .curves
            .iter()
            .filter(|c| !c.points.is_empty())
            .map(|c| Series {
                name: c.coder.clone(),
                points: c.points.iter().map(|p| (p.bytes_per_scan, value(p))).collect(),
            })
            .collect();
        let svg = rate_plot(&series, label, "bytes a scan", "mm").map_err(|e| anyhow!(e))?;
        write_whole(&out.join(format!("{name}.svg")), svg.as_bytes())?;
        plots.push(svg);
    }
    for (coder, setting, png) in maps {
        let plain = |c: char| if c.is_ascii_alphanumeric() || c == '.' { c } else { '_' };
        let name: String = format!("{coder} {setting}").chars().map(plain).collect();
        write_whole(&out.join(format!("map_{name}.png")), png)?;
    }
    write_whole(&out.join(CSV), csv(report).as_bytes())?;
    write_whole(&out.join(JSON), serde_json::to_string_pretty(report)?.as_bytes())?;
    let shown = typical_maps(report, maps);
    write_whole(&out.join(PAGE), html(&Page { report, plots: &plots, maps: &shown }).as_bytes())?;
    Ok(())
}

/// The map of each coder's middle setting: all of them would make the page large.
fn typical_maps(report: &SweepReport, maps: &[ErrorMapFile]) -> Vec<ErrorMapFile> {
    let is_shown = |(coder, setting, _): &&ErrorMapFile| {
        let points = report.curves.iter().find(|c| c.coder == *coder).map_or(&[][..], |c| &c.points);
        points.get(points.len() / 2).is_some_and(|p| p.setting == *setting)
    };
    maps.iter().filter(is_shown).cloned().collect()
}

fn describe(report: &SweepReport, out: &Path) -> String {
    let mut text = format!(
        "{} scans, {} as OBJ+BMP and {} as binary a scan\n",
        report.scans,
        human_bytes(report.obj_bmp_bytes_per_scan as u64),
        human_bytes(report.binary_bytes_per_scan as u64)
    );
    // Writing to a String cannot fail.
    let _ = writeln!(text, "  coder           setting             bytes a scan  rms mm   max mm  encode ms  decode ms");
    for c in &report.curves {
        for p in &c.points {
            let _ = writeln!(
                text,
                "  {:<15} {:<19} {:>12.0}  {:<7.4} {:>7.2} {:>10.1} {:>10.1}",
                c.coder, p.setting, p.bytes_per_scan, p.rms_mm, p.max_mm, p.encode_ms_per_scan, p.decode_ms_per_scan
            );
        }
        if let Some(reason) = &c.unavailable {
            let _ = writeln!(text, "  {:<15} not run: {reason}", c.coder);
        }
    }
    for b in report.bd_rates.iter().filter(|b| b.test == report.curves[0].coder) {
        let _ = writeln!(
            text,
            "  {} takes {:+.1} % against {} at the same D1 PSNR",
            b.test, b.difference.percent, b.anchor
        );
    }
    let _ = write!(text, "look at {}", out.join(PAGE).display());
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tolerances_are_positive_lengths() {
        assert_eq!(tolerance("0.05"), Ok(0.05));
        for bad in ["0", "-1", "nan", "101", "x"] {
            assert!(tolerance(bad).is_err(), "{bad}");
        }
    }
}
