//! `gv3 accuracy`: acceptance in the manner of VDI/VDE 2634 part 2.

use super::Outcome;
use super::progress::bar;
use crate::accuracy::fit::Plane;
use crate::accuracy::noise::NoiseCollector;
use crate::accuracy::simulate::{BALL_BAR, PLANE_GATE_MM, simulate};
use crate::accuracy::{AccuracyReport, NoiseMap, Standard};
use crate::device::RigConfig;
use crate::files::ScanFolder;
use crate::view::compare::png_bytes;
use crate::view::maps::{PixelMap, draw_maps};
use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use gv3_codec::Scan;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Measure probing error, sphere-distance error, flatness-measurement error and depth noise, as VDI/VDE 2634 part 2 does.
///
/// Without scans the simulated scanner takes them: a ball bar in seven positions, a plane in six, and repeated scans of the
/// plane for the noise. Of scans of your own (OBJ or PLY, files or folders of them, one position each) give any of --spheres,
/// --plane and --noise. Up to 3 per mille of an object's points are left out, as the guideline allows.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 accuracy --picture accuracy.png\n  gv3 accuracy --config rig.toml --json\n  gv3 accuracy --spheres bar/ --diameter 38.1 --distance 150.02 --plane plane_1.ply --plane plane_2.ply"
)]
pub struct Accuracy {
    /// Simulated rig to accept; the built-in one when none is given.
    #[arg(long, conflicts_with_all = ["spheres", "plane", "noise"])]
    config: Option<PathBuf>,
    /// Scans of a sphere, or with --distance of a ball bar.
    #[arg(long, value_name = "SCANS", requires = "diameter")]
    spheres: Vec<PathBuf>,
    /// Calibrated diameter of the spheres, mm.
    #[arg(long, value_name = "MM", value_parser = length_mm)]
    diameter: Option<f64>,
    /// Calibrated distance of the ball bar's centres, mm.
    #[arg(long, value_name = "MM", requires = "spheres", value_parser = length_mm)]
    distance: Option<f64>,
    /// Scans of a plane.
    #[arg(long, value_name = "SCANS")]
    plane: Vec<PathBuf>,
    /// Folder of repeated scans of something at rest.
    #[arg(long, value_name = "SCANS")]
    noise: Option<PathBuf>,
    /// Points farther than this from the fitted form belong to something else, mm.
    #[arg(long, value_name = "MM", default_value_t = 2.0, value_parser = length_mm)]
    gate: f64,
    /// Simulated scans for the noise.
    #[arg(long, default_value_t = 16, value_parser = clap::value_parser!(u16).range(2..=1000))]
    repeats: u16,
    /// Picture of the noise, and of the plane's deviations, to write (PNG).
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

fn length_mm(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(mm) if mm > 0.0 && mm < 1e5 => Ok(mm),
        _ => Err("a length must be a number of millimetres above 0".into()),
    }
}

/// What the picture shows.
struct Pictured {
    noise: NoiseMap,
    scan: Scan,
}

impl Accuracy {
    pub(super) fn run(self) -> Result<Outcome> {
        let is_simulated = self.spheres.is_empty() && self.plane.is_empty() && self.noise.is_none();
        let (report, pictured) = if is_simulated { self.simulated()? } else { self.captured()? };
        if let Some(path) = &self.picture {
            let Some(pictured) = pictured else { bail!("--picture shows the noise, which needs --noise SCANS") };
            write_picture(path, &pictured, &report)?;
        }
        Outcome::of(self.json, &report, || describe(&report, is_simulated))
    }

    fn simulated(&self) -> Result<(AccuracyReport, Option<Pictured>)> {
        let config = match &self.config {
            Some(path) => RigConfig::read(path)?,
            None => RigConfig::simulated(),
        };
        let bar = bar(13, "accuracy");
        let found = simulate(&config, usize::from(self.repeats), || bar.inc(1))?;
        bar.finish_and_clear();
        Ok((found.report, Some(Pictured { noise: found.noise, scan: found.scan })))
    }

    fn captured(&self) -> Result<(AccuracyReport, Option<Pictured>)> {
        let mut report = AccuracyReport::default();
        for path in &self.spheres {
            let diameter_mm = self.diameter.context("--spheres needs --diameter")?;
            let standard = Standard { diameter_mm, distance_mm: self.distance, gate_mm: self.gate };
            each_scan(path, |name, scan| Ok(report.add_spheres(name, scan, &standard)?))?;
        }
        for path in &self.plane {
            each_scan(path, |name, scan| Ok(report.add_plane(name, scan, self.gate).map(drop)?))?;
        }
        let mut pictured = None;
        if let Some(path) = &self.noise {
            let (mut collector, mut scans, mut last) = (NoiseCollector::default(), 0, None);
            each_scan(path, |name, scan| {
                collector.add(scan).map_err(|reason| anyhow!("{name}: {reason}"))?;
                scans += 1;
                last = Some(scan.clone());
                Ok(())
            })?;
            let noise =
                collector.map().with_context(|| format!("{}: noise needs two scans or more", path.display()))?;
            report.noise = noise.summary(scans, None);
            pictured = last.map(|scan| Pictured { noise, scan });
        }
        Ok((report.summed_up(), pictured))
    }
}

fn each_scan(path: &Path, mut work: impl FnMut(&str, &Scan) -> Result<()>) -> Result<()> {
    let folder = ScanFolder::open(path)?;
    for i in 0..folder.len() {
        work(&folder.name(i), &folder.load(i, 1)?.scan)?;
    }
    Ok(())
}

/// Writes the noise map, and beside it the distances from the plane when there is one.
fn write_picture(path: &Path, pictured: &Pictured, report: &AccuracyReport) -> Result<()> {
    let Pictured { noise, scan } = pictured;
    let mut maps = vec![PixelMap { title: "depth noise, one sigma, mm", values: &noise.sigma_mm }];
    let deviations = deviations(scan, noise.sigma_mm.len());
    if let Some(deviations) = deviations.as_ref().filter(|_| !report.flatness.is_empty()) {
        maps.push(PixelMap { title: "distance from the plane, one scan, mm", values: deviations });
    }
    let caption = report.noise.map_or(String::new(), |n| {
        format!(
            "{} scans, {} pixels: median {:.4} mm, p95 {:.4} mm",
            n.scans, n.pixels, n.median_sigma_mm, n.p95_sigma_mm
        )
    });
    let image = draw_maps(&maps, noise.width_px, &caption);
    std::fs::write(path, png_bytes(&image)).with_context(|| format!("{}: cannot write", path.display()))
}

/// Amount of the distance from the plane through the scan at every camera pixel.
fn deviations(scan: &Scan, pixels: usize) -> Option<Vec<f32>> {
    let mut report = AccuracyReport::default();
    let plane: Plane = report.add_plane("scan", scan, PLANE_GATE_MM).ok()?;
    let (texture, uv) = (scan.texture.as_ref()?, scan.mesh.uv.as_ref()?);
    let mut values = vec![f32::NAN; pixels];
    for (p, uv) in scan.mesh.positions_mm.iter().zip(uv) {
        let [x, y] = texture.uv_to_px(*uv).map(|v| v.round().max(0.0) as usize);
        if let Some(value) = values.get_mut(y * texture.width_px as usize + x) {
            *value = plane.distance_mm(p.as_dvec3()).abs() as f32;
        }
    }
    Some(values)
}

fn describe(report: &AccuracyReport, is_simulated: bool) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "Acceptance in the manner of VDI/VDE 2634 part 2{}",
        if is_simulated { ", simulated" } else { "" }
    );
    if is_simulated {
        let distance_mm = BALL_BAR.distance_mm.unwrap_or_default();
        let _ =
            writeln!(text, "  spheres of {} mm, {distance_mm} mm apart; plane of 220 x 160 mm", BALL_BAR.diameter_mm);
    }
    let line = |text: &mut String, name: &str, worst: Option<f64>, what: &str| {
        if let Some(mm) = worst {
            let _ = writeln!(text, "  {name:<28} {mm:>8.4} mm   {what}");
        }
    };
    let worst = &report.worst;
    line(&mut text, "probing error, form PF", worst.form_mm, "largest range of radial distances");
    line(&mut text, "probing error, size PS", worst.size_mm, "largest error of the diameter");
    line(&mut text, "sphere distance error SD", worst.distance_mm, "largest error of the distance");
    line(&mut text, "flatness error RF", worst.flatness_mm, "largest range of distances from the plane");
    if let Some(noise) = &report.noise {
        line(&mut text, "depth noise, median sigma", Some(noise.median_sigma_mm), "over repeated scans");
        line(&mut text, "depth noise, expected", noise.expected_median_sigma_mm, "from the camera's noise");
    }
    for s in &report.spacing {
        let _ =
            writeln!(text, "  bar    {:<22} SD {:>+8.4}   distance {:.4} mm", s.position, s.error_mm, s.distance_mm);
    }
    for p in &report.probing {
        let _ = writeln!(
            text,
            "  sphere {:<22} PF {:>8.4}   PS {:>+8.4}   sigma {:.4} mm, {} points, {} left out",
            p.position, p.form_mm, p.size_mm, p.sigma_mm, p.points, p.rejected
        );
    }
    for f in &report.flatness {
        let _ = writeln!(
            text,
            "  plane  {:<22} RF {:>8.4}   sigma {:.4} mm, {} points, {} left out",
            f.position, f.range_mm, f.sigma_mm, f.points, f.rejected
        );
    }
    let is_cut = report.flatness.iter().any(|f| f.reaches_gate) || report.probing.iter().any(|p| p.reaches_gate);
    if is_cut {
        let _ =
            writeln!(text, "  deviations reach the gate, which may cut them: give a larger --gate, or trim the scans");
    }
    text
}
