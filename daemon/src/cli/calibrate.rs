//! `gv3 calibrate`: pictures of a board become the calibration of a rig.

use super::Outcome;
use super::progress::bar;
use crate::device::RigConfig;
use crate::files::RawFolder;
use crate::files::board_corners::read_board_corners;
use crate::files::picture::read_picture;
use crate::light::calibrate::{
    CalibrateError, CalibrateOptions, Calibrated, CalibrationReport, DistortionTerms, calibrate,
};
use crate::light::{Board, BoardView};
use crate::pipeline::board_views::{decode_board_view, read_board_view, simulate_board_views};
use crate::view::residuals::residual_picture;
use anyhow::{Context, Result, anyhow, bail};
use clap::{Args, ValueEnum};
use gv3_protocol::AtomicFile;
use serde::Serialize;
use std::io::Write;
use std::path::{Path, PathBuf};

/// File that says what the pictures show.
const SEQUENCE: &str = "sequence.toml";
/// Most views of a folder.
const MAX_VIEWS: usize = 1000;

/// Calibrate camera, projector and the pose between them from pictures of a chessboard, lit by patterns that code columns
/// and rows.
///
/// The folder has a folder for every view of the board: another place, another tilt of 20 to 40 degrees, so that all
/// together reach into the corners of the picture. What the pictures show stands in a sequence.toml beside or in them, as
/// `gv3 patterns` writes it. A result that no one should measure with is refused, with the reason, and nothing is saved.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 calibrate boards --board 9x6 --square-mm 20 -o rig.toml --residuals rig.svg\n  gv3 calibrate boards --board 9x6 --square-mm 14 -o rig.toml --simulate 15   # no hardware: simulated pictures, in boards"
)]
pub struct Calibrate {
    /// Folder with a folder of pictures for every view.
    folder: PathBuf,
    /// Inner corners of the chessboard, columns x rows.
    #[arg(long, value_parser = board_size, value_name = "CxR")]
    board: [u32; 2],
    /// Side of a square, mm.
    #[arg(long)]
    square_mm: f64,
    /// Calibration to write.
    #[arg(short, long, required_unless_present = "simulate")]
    out: Option<PathBuf>,
    /// Format to write.
    #[arg(long, value_enum, default_value_t = Format::Toml)]
    format: Format,
    /// TOML that says what the pictures of all views show; without it the sequence.toml of the view or of the folder.
    #[arg(long)]
    sequence: Option<PathBuf>,
    /// Corners found elsewhere, as CSV view,corner,x_px,y_px; views are the names of the folders.
    #[arg(long, value_name = "CSV")]
    corners: Option<PathBuf>,
    /// Picture of the reprojection errors to write (SVG).
    #[arg(long, value_name = "SVG")]
    residuals: Option<PathBuf>,
    /// Fewest views that are accepted, three at least.
    #[arg(long, default_value_t = CalibrateOptions::default().min_views, value_name = "N")]
    min_views: usize,
    /// Largest rms reprojection error accepted, pixels.
    #[arg(long, default_value_t = CalibrateOptions::default().max_rms_px, value_name = "PX")]
    max_rms_px: f64,
    /// Distortion of the camera to estimate.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Term::DEFAULT, value_name = "TERMS")]
    distortion: Vec<Term>,
    /// Distortion of the projector to estimate.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Term::DEFAULT, value_name = "TERMS")]
    projector_distortion: Vec<Term>,
    /// Capture this many views with the simulated scanner first, into the folder, and its true calibration as truth.toml.
    #[arg(long, value_name = "N")]
    simulate: Option<usize>,
    /// Seed of the simulated poses.
    #[arg(long, default_value_t = 1, requires = "simulate")]
    seed: u64,
    /// Replace what exists.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// gv3's own.
    Toml,
    /// OpenCV's YAML: cameraMatrix1, distCoeffs1, cameraMatrix2, distCoeffs2, R, T.
    Opencv,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Term {
    /// None at all; alone.
    None,
    /// Radial, second order.
    K1,
    /// Radial, fourth order.
    K2,
    /// Tangential, p1 and p2.
    P,
    /// Radial, sixth order.
    K3,
}

impl Term {
    const DEFAULT: [Self; 3] = [Self::K1, Self::K2, Self::P];
}

fn terms(terms: &[Term]) -> DistortionTerms {
    let has = |term| terms.contains(&term) && !terms.contains(&Term::None);
    DistortionTerms { k1: has(Term::K1), k2: has(Term::K2), tangential: has(Term::P), k3: has(Term::K3) }
}

fn board_size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    sides.ok_or_else(|| "give inner corners, columns x rows, like 9x6".into())
}

#[derive(Debug, Serialize)]
struct CalibrateReport {
    #[serde(flatten)]
    report: CalibrationReport,
    /// Views that could not be read, with the reason.
    left_out: Vec<LeftOut>,
}

#[derive(Debug, Serialize)]
struct LeftOut {
    view: String,
    reason: String,
}

/// What was read of all views.
struct Views {
    views: Vec<BoardView>,
    left_out: Vec<LeftOut>,
    camera_size_px: [u32; 2],
    projector_size_px: [u32; 2],
}

impl Calibrate {
    pub(super) fn run(self) -> Result<Outcome> {
        let [columns, rows] = self.board;
        let board = Board { columns, rows, square_mm: self.square_mm };
        board.validate()?;
        if let Some(count) = self.simulate {
            self.simulate(&board, count)?;
        }
        let Some(out) = &self.out else {
            return Ok(Outcome::done(format!("{}: simulated views and truth.toml", self.folder.display())));
        };
        if !self.force && out.exists() {
            bail!("{}: exists; --force replaces it", out.display());
        }
        let Views { views, left_out, camera_size_px, projector_size_px } = self.read(&board)?;
        let options = CalibrateOptions {
            min_views: self.min_views,
            camera: terms(&self.distortion),
            projector: terms(&self.projector_distortion),
            max_rms_px: self.max_rms_px,
        };
        let calibrated =
            calibrate(&views, camera_size_px, projector_size_px, &options).map_err(|e| refused(e, &left_out))?;
        if let Some(path) = &self.residuals {
            let svg = residual_picture(&calibrated.residuals, camera_size_px, projector_size_px);
            self.write(path, &svg.map_err(|e| anyhow!(e))?)?;
        }
        let text = match self.format {
            Format::Toml => calibrated.calibration.to_toml()?,
            Format::Opencv => calibrated.calibration.to_opencv(),
        };
        self.write(out, &text)?;
        let Calibrated { report, .. } = calibrated;
        let report = CalibrateReport { report, left_out };
        Outcome::of(self.json, &report, || {
            let mut text = format!("{}: {}", out.display(), report.report.describe());
            report.left_out.iter().for_each(|l| text.push_str(&format!("\n  left out: {}: {}", l.view, l.reason)));
            text
        })
    }

    fn simulate(&self, board: &Board, count: usize) -> Result<()> {
        let rig = RigConfig::simulated();
        simulate_board_views(&rig, board, self.seed, count, &self.folder)?;
        self.write(&self.folder.join("truth.toml"), &rig.calibration()?.to_toml()?)
    }

    fn write(&self, path: &Path, text: &str) -> Result<()> {
        let mut file = AtomicFile::create(path, self.force)?;
        file.write_all(text.as_bytes()).with_context(|| format!("{}: cannot write", path.display()))?;
        Ok(file.commit()?)
    }

    fn read(&self, board: &Board) -> Result<Views> {
        let folders = self.view_folders()?;
        let mut known = match &self.corners {
            Some(path) => Some(read_board_corners(path, board)?),
            None => None,
        };
        if let (Some(views), Some(path)) = (&known, &self.corners)
            && let Some(lost) = views.iter().find(|v| !folders.iter().any(|f| name(f) == v.name))
        {
            bail!("{}: view {:?} has no folder in {}", path.display(), lost.name, self.folder.display());
        }
        let mut found: Option<Views> = None;
        let bar = bar(folders.len() as u64, "read views");
        for folder in &folders {
            bar.inc(1);
            let given = match &mut known {
                // Folders that the file of corners does not name are no views.
                Some(views) => match views.iter().position(|v| v.name == name(folder)) {
                    Some(at) => Some(views.swap_remove(at)),
                    None => continue,
                },
                None => None,
            };
            let raw = RawFolder::read(&self.sequence_of(folder))?;
            let all = Views::with_sizes(&mut found, folder, &raw)?;
            let view = match given {
                Some(view) => decode_board_view(folder, &raw, view),
                None => read_board_view(folder, &raw, board),
            };
            match view {
                Ok(view) => all.views.push(view),
                Err(e) => all.left_out.push(LeftOut { view: name(folder), reason: e.to_string() }),
            }
        }
        bar.finish_and_clear();
        found.with_context(|| format!("{}: no views; it needs a folder of pictures for each", self.folder.display()))
    }

    fn view_folders(&self) -> Result<Vec<PathBuf>> {
        let show = || format!("{}: cannot open", self.folder.display());
        let entries = std::fs::read_dir(&self.folder).with_context(show)?;
        let mut folders: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| p.is_dir()).collect();
        folders.sort();
        if folders.len() > MAX_VIEWS {
            bail!("{}: {} folders, at most {MAX_VIEWS} views are read", self.folder.display(), folders.len());
        }
        Ok(folders)
    }

    fn sequence_of(&self, folder: &Path) -> PathBuf {
        let own = folder.join(SEQUENCE);
        match &self.sequence {
            Some(path) => path.clone(),
            None if own.is_file() => own,
            None => self.folder.join(SEQUENCE),
        }
    }
}

fn name(folder: &Path) -> String {
    folder.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned())
}

impl Views {
    /// The views so far, after a check that the pictures and patterns of one more are as large as those before.
    fn with_sizes<'a>(found: &'a mut Option<Self>, folder: &Path, raw: &RawFolder) -> Result<&'a mut Self> {
        let names = raw.names()?;
        let first = names.first().with_context(|| format!("{}: the sequence has no patterns", folder.display()))?;
        let picture = read_picture(&folder.join(first))?;
        let camera_size_px = [picture.width_px, picture.height_px];
        let projector_size_px = [raw.sequence.width_px, raw.sequence.height_px];
        let new = Self { views: Vec::new(), left_out: Vec::new(), camera_size_px, projector_size_px };
        let all = found.get_or_insert(new);
        if [all.camera_size_px, all.projector_size_px] != [camera_size_px, projector_size_px] {
            let ([w, h], [u, v]) = (camera_size_px, projector_size_px);
            let ([cw, ch], [pu, pv]) = (all.camera_size_px, all.projector_size_px);
            let place = folder.display();
            bail!("{place}: pictures {w} x {h} and patterns {u} x {v}, but before {cw} x {ch} and {pu} x {pv}");
        }
        Ok(all)
    }
}

/// The refusal, with the views that could not be read.
fn refused(error: CalibrateError, left_out: &[LeftOut]) -> anyhow::Error {
    let mut text = format!("nothing is saved: {error}");
    for LeftOut { view, reason } in left_out {
        text.push_str(&format!("\n  left out: {view}: {reason}"));
    }
    anyhow!(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::triangulate::scan_from_camera;
    use crate::light::{Calibration, DepthRange, LightError, PixelMask, PointGrid, Triangulator};
    use clap::Parser;
    use glam::{DVec3, Vec3};

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        calibrate: Calibrate,
    }

    fn run(folder: &Path, more: &[&str]) -> Result<Outcome> {
        let fixed = ["gv3", folder.to_str().unwrap(), "--board", "9x6", "--square-mm", "14"];
        Line::try_parse_from(fixed.into_iter().chain(more.iter().copied())).unwrap().calibrate.run()
    }

    /// What a rig makes of the true columns of a tilted plane through the middle of the working range: the points, beside
    /// the true ones, mm.
    fn scanned_plane(rig: &Calibration, truth: &Calibration) -> Vec<(DVec3, DVec3)> {
        let normal = DVec3::new(0.2, -0.1, 1.0).normalize();
        let rays = truth.camera.ray_table("camera").unwrap();
        let points: Vec<DVec3> =
            rays.iter().map(|ray| ray.extend(1.0) * (600.0 * normal.z / normal.dot(ray.extend(1.0)))).collect();
        let columns: Vec<f32> = points.iter().map(|&p| truth.projector_px(p).x as f32).collect();
        let [w, h] = [truth.camera.width_px, truth.camera.height_px].map(|n| n as usize);
        let (mut mask, mut grid) = (PixelMask::new(w, h), PointGrid::new(w, h));
        mask.verdicts.fill(crate::light::Rejection::Kept);
        let triangulator = Triangulator::new(rig, DepthRange::default()).unwrap();
        triangulator.triangulate(&columns, &mut mask, &mut grid);
        let found = grid.points_mm.iter().map(|&p: &Vec3| scan_from_camera(p).as_dvec3());
        found.zip(points).step_by(97).collect()
    }

    /// Root-mean-square distance of points from their plane z = a x + b y + c.
    fn plane_rms_mm(points: &[DVec3]) -> f64 {
        let mean = points.iter().sum::<DVec3>() / points.len() as f64;
        let row = |p: &DVec3| DVec3::new(p.x - mean.x, p.y - mean.y, 1.0);
        let outer = |r: DVec3| glam::DMat3::from_cols(r * r.x, r * r.y, r * r.z);
        let normal = points.iter().map(row).fold(glam::DMat3::ZERO, |sum, r| sum + outer(r));
        let plane = normal.inverse() * points.iter().map(|p| row(p) * (p.z - mean.z)).sum::<DVec3>();
        let distance =
            |p: &DVec3| (p.z - mean.z - plane.dot(row(p))) / (1.0 + plane.x.powi(2) + plane.y.powi(2)).sqrt();
        (points.iter().map(|p| distance(p).powi(2)).sum::<f64>() / points.len() as f64).sqrt()
    }

    #[test]
    fn simulated_pictures_give_the_simulators_rig() {
        let work = tempfile::tempdir().unwrap();
        let (folder, out) = (work.path().join("boards"), work.path().join("rig.yml"));
        let picture = work.path().join("rig.svg");
        let more = ["--simulate", "10", "--seed", "3", "--format", "opencv", "--json", "-o", out.to_str().unwrap()];
        let report = run(&folder, &[&more[..], &["--residuals", picture.to_str().unwrap()]].concat()).unwrap().report;
        let report: serde_json::Value = serde_json::from_str(&report).unwrap();
        let read = |path: &Path| {
            let text = std::fs::read_to_string(path).unwrap();
            Calibration::from_text::<LightError>(&text, || panic!("sizes are in the file")).unwrap()
        };
        let (rig, truth) = (read(&out), read(&folder.join("truth.toml")));
        assert!(std::fs::read_to_string(&picture).unwrap().contains("view_09"));
        assert_eq!(report["views"].as_array().unwrap().len(), 10);
        let truths = [
            ("camera.fx_px", truth.camera.fx_px),
            ("camera.cx_px", truth.camera.cx_px),
            ("camera.k1", truth.camera.distortion.k1),
            ("projector.fy_px", truth.projector.fy_px),
            ("projector.cy_px", truth.projector.cy_px),
            ("projector_from_camera.tx_mm", truth.projector_from_camera.translation_mm[0]),
        ];
        for (name, truth) in truths {
            let parameters = report["parameters"].as_array().unwrap();
            let found = parameters.iter().find(|p| p["name"] == name).unwrap();
            let (value, error) = (found["value"].as_f64().unwrap(), found["standard_error"].as_f64().unwrap());
            println!("{name}: {:+.2} standard errors", (value - truth) / error);
            // Errors of detection are not quite normal.
            assert!((value - truth).abs() < 5.0 * error, "{name}: {value} with {error}, but {truth}");
        }
        let plane = scanned_plane(&rig, &truth);
        let (found, exact): (Vec<DVec3>, Vec<DVec3>) = plane.into_iter().unzip();
        let (first, last) = (0, found.len() - 1);
        let scale = found[first].distance(found[last]) / exact[first].distance(exact[last]);
        let flatness_mm = plane_rms_mm(&found);
        println!("a plane is flat to {flatness_mm:.4} mm rms, its diagonal {:+.1e} too long", scale - 1.0);
        assert!(flatness_mm < 0.03 && (scale - 1.0).abs() < 5e-4, "{flatness_mm} mm, {scale}");
    }

    #[test]
    fn nothing_is_saved_of_what_cannot_be_used() {
        let work = tempfile::tempdir().unwrap();
        let (folder, out) = (work.path().join("boards"), work.path().join("rig.toml"));
        let more = ["-o", out.to_str().unwrap()];
        let missing = run(&folder, &more).unwrap_err().to_string();
        assert!(missing.contains("boards: cannot open"), "{missing}");
        let done = run(&folder, &["--simulate", "2"]).unwrap().report;
        assert!(done.contains("truth.toml"), "{done}");
        let few = run(&folder, &more).unwrap_err().to_string();
        assert!(few.contains("nothing is saved: 2 views of the board, at least 6"), "{few}");
        std::fs::remove_file(folder.join("view_01/pattern_03.png")).unwrap();
        let few = run(&folder, &more).unwrap_err().to_string();
        assert!(few.contains("1 views of the board") && few.contains("left out: view_01"), "{few}");
        let csv = work.path().join("corners.csv");
        std::fs::write(&csv, "view,corner,x_px,y_px\nview_07,0,10,10\n").unwrap();
        let lost = run(&folder, &[&more[..], &["--corners", csv.to_str().unwrap()]].concat()).unwrap_err().to_string();
        assert!(lost.contains("view \"view_07\" has no folder"), "{lost}");
        assert!(!out.exists());
        std::fs::write(&out, "mine").unwrap();
        assert!(run(&folder, &more).unwrap_err().to_string().contains("--force"));
        assert_eq!(std::fs::read_to_string(&out).unwrap(), "mine");
    }
}
