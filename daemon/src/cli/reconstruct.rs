//! `gv3 reconstruct`: pattern pictures become a scan.

use super::Outcome;
use super::decode::Format;
use super::progress::human_bytes;
use crate::files::picture::read_picture;
use crate::files::processing_config::read_gamma;
use crate::files::{ExportFormat, ExportWriter, RawFolder};
use crate::light::{Calibration, DepthRange, LightError, Limits, RejectedPixels};
use crate::measure::{binary_bytes, obj_bmp_bytes};
use crate::pipeline::record::{session_metadata, write_group};
use crate::pipeline::{Reconstruction, StillReconstructor};
use anyhow::{Context, Result, bail};
use clap::Args;
use gv3_codec::{Encoder, EncoderConfig};
use gv3_codec::{GreyPicture, Scan};
use gv3_protocol::AtomicFile;
use gv3_protocol::raw::RawReader;
use gv3_protocol::session::{MetadataGroup, SessionWriter, key};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Largest calibration read, bytes.
const MAX_CALIBRATION_BYTES: u64 = 1 << 20;
/// Scan period of a session of one scan: that of a scanner of 30 scans a second.
const SCAN_PERIOD_NANOS: u64 = 33_333_333;

/// Make a scan of a folder of pattern pictures: fringes, Gray code, or both, as a small TOML describes them.
///
/// Of a raw recording, which brings its own description, every frame set becomes a scan.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 reconstruct smile-raw -o scans\n  gv3 reconstruct capture --sequence sequence.toml --calibration rig.toml -o scan\n\nsequence.toml:\n  pictures = \"graycode_##.png\"\n  [sequence]\n  width_px = 1024\n  height_px = 768\n  [[sequence.patterns]]\n  kind = \"gray\"        # or sinusoid (period_px, steps), white, black, half\n  bits = 10            # most significant first\n  pairs = true         # each followed by its inverse\n  direction = \"rows\"   # or columns"
)]
pub struct Reconstruct {
    /// Folder of pictures, or of a raw recording.
    folder: PathBuf,
    /// TOML that says what the pictures show; not for a raw recording.
    #[arg(long, requires = "calibration")]
    sequence: Option<PathBuf>,
    /// Calibration: TOML, JSON with Kc, dc, Kp, dp, R, T, or OpenCV's YAML.
    #[arg(long, requires = "sequence")]
    calibration: Option<PathBuf>,
    /// Phase errors of the projector, from gv3 calibrate-gamma; over gamma_file of the sequence.
    #[arg(long, value_name = "FILE")]
    gamma: Option<PathBuf>,
    /// Folder to write the scan to.
    #[arg(short, long)]
    out: PathBuf,
    /// Files to write.
    #[arg(long, value_enum, default_value_t = Format::Obj)]
    format: Format,
    /// Code the scan into a session too.
    #[arg(long, value_name = "FILE")]
    session: Option<PathBuf>,
    /// Replace what exists.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

/// Pattern pictures and what is needed to understand them.
#[derive(Debug, Clone, Args)]
pub struct RawCapture {
    /// Folder of pictures.
    folder: PathBuf,
    /// TOML that says what the pictures show.
    #[arg(long)]
    sequence: PathBuf,
    /// Calibration: TOML, JSON with Kc, dc, Kp, dp, R, T, or OpenCV's YAML.
    #[arg(long)]
    calibration: PathBuf,
}

/// A capture whose description and calibration are read.
pub struct OpenedCapture {
    /// Folder of the pictures.
    pub folder: PathBuf,
    /// What they show.
    pub raw: RawFolder,
    /// Name of the picture of every pattern.
    pub names: Vec<String>,
    /// Geometry of the rig.
    pub calibration: Calibration,
    /// Limits of the description; without them nothing but the geometry bounds the depth.
    pub limits: Limits,
}

impl RawCapture {
    /// Description and calibration together, for messages.
    pub fn name(&self) -> String {
        format!("{} with {}", self.sequence.display(), self.calibration.display())
    }

    /// Reads description and calibration.
    pub fn open(&self) -> Result<OpenedCapture> {
        let raw = RawFolder::read(&self.sequence)?;
        let names = raw.names()?;
        let calibration = self.read_calibration(&raw, &names)?;
        let limits = raw
            .limits
            .unwrap_or_else(|| Limits { depth: DepthRange { near_mm: 1.0, far_mm: 100_000.0 }, ..Limits::default() });
        Ok(OpenedCapture { folder: self.folder.clone(), raw, names, calibration, limits })
    }

    fn read_calibration(&self, raw: &RawFolder, names: &[String]) -> Result<Calibration> {
        let path = &self.calibration;
        let show = || path.display().to_string();
        let bytes = std::fs::metadata(path).with_context(show)?.len();
        if bytes > MAX_CALIBRATION_BYTES {
            bail!("{}: {bytes} bytes is no calibration", show());
        }
        let text = std::fs::read_to_string(path).with_context(show)?;
        // Not every format says the sizes; pictures and patterns do.
        let sizes = || {
            let Some(first) = names.first() else { bail!("{}: no pictures", self.sequence.display()) };
            let first = read_picture(&self.folder.join(first))?;
            Ok([[first.width_px, first.height_px], [raw.sequence.width_px, raw.sequence.height_px]])
        };
        Calibration::from_text(&text, sizes).with_context(show)
    }
}

impl OpenedCapture {
    /// Reads the pictures.
    pub fn pictures(&self) -> Result<Vec<GreyPicture>> {
        let size_px = [self.calibration.camera.width_px, self.calibration.camera.height_px];
        Ok(self.raw.load(&self.folder, size_px)?)
    }
}

#[derive(Debug, Serialize)]
struct ReconstructReport {
    vertices: usize,
    triangles: usize,
    rejected_pixels: RejectedPixels,
    bytes: u64,
    session_bytes: Option<u64>,
}

impl Reconstruct {
    pub(super) fn run(self) -> Result<Outcome> {
        let format = self.format.export();
        match (&self.sequence, &self.calibration) {
            (None, None) if RawReader::is_recording(&self.folder) => {
                if self.session.is_some() {
                    bail!(
                        "a session of a raw recording is made by `gv3 capture OUT.gv3 --from-raw {}`",
                        self.folder.display()
                    );
                }
                super::raw::reconstruct(&self.folder, &self.out, format, self.force, self.json)
            }
            (Some(sequence), Some(calibration)) => {
                let (folder, sequence, calibration) = (self.folder.clone(), sequence.clone(), calibration.clone());
                self.run_pictures(&RawCapture { folder, sequence, calibration }, format)
            }
            _ => bail!("{}: no raw recording, so it needs --sequence and --calibration", self.folder.display()),
        }
    }

    fn run_pictures(&self, capture: &RawCapture, format: ExportFormat) -> Result<Outcome> {
        let opened = capture.open()?;
        let OpenedCapture { folder, raw, names, calibration, limits } = &opened;
        let mut processing = raw.processing.read()?;
        if let Some(path) = &self.gamma {
            processing.gamma = Some(read_gamma(path)?);
        }
        let mut reconstructor = StillReconstructor::with(calibration, &raw.sequence, limits, &processing)
            .with_context(|| capture.name())?;
        let pictures = opened.pictures()?;
        let Reconstruction { scan, rejected } =
            reconstructor.reconstruct(&pictures).map_err(|e| named(e, folder, names))?;
        if scan.mesh.triangles.is_empty() {
            let DepthRange { near_mm, far_mm } = limits.depth;
            bail!(
                "{}: no surface between {near_mm} and {far_mm} mm (near_mm and far_mm of [limits.depth] in {}); rejected pixels: {}",
                folder.display(),
                capture.sequence.display(),
                describe(&rejected)?
            );
        }
        let writer = ExportWriter::create(&self.out, format, self.force)?;
        let mut report = ReconstructReport {
            vertices: scan.mesh.vertex_count(),
            triangles: scan.mesh.triangles.len(),
            rejected_pixels: rejected,
            bytes: writer.write(0, &scan.mesh, scan.texture.as_ref())?,
            session_bytes: None,
        };
        if let Some(path) = &self.session {
            report.session_bytes = Some(write_session(path, self.force, scan, calibration)?);
        }
        let causes = describe(&rejected)?;
        Outcome::of(self.json, &report, || self.describe(&report, &causes))
    }

    fn describe(&self, report: &ReconstructReport, causes: &str) -> String {
        let mut text = format!(
            "{}: {} vertices, {} triangles, {}\n  rejected pixels: {causes}",
            self.out.display(),
            report.vertices,
            report.triangles,
            human_bytes(report.bytes)
        );
        if let (Some(path), Some(bytes)) = (&self.session, report.session_bytes) {
            text.push_str(&format!("\n{}: {}", path.display(), human_bytes(bytes)));
        }
        text
    }
}

/// The error with the picture's file in place of its index.
pub(super) fn named(error: LightError, folder: &Path, names: &[String]) -> anyhow::Error {
    if let LightError::Field { field, reason } = &error
        && let Some(index) = field.strip_prefix("pictures[").and_then(|f| f.strip_suffix(']')?.parse::<usize>().ok())
        && let Some(name) = names.get(index)
    {
        return anyhow::anyhow!("{}: {reason}", folder.join(name).display());
    }
    error.into()
}

/// Causes that rejected pixels, with their numbers.
fn describe(rejected: &RejectedPixels) -> Result<String> {
    let serde_json::Value::Object(causes) = serde_json::to_value(rejected)? else { return Ok(String::new()) };
    let parts: Vec<String> = causes
        .iter()
        .filter(|(_, count)| count.as_u64() != Some(0))
        .map(|(cause, count)| format!("{count} {}", cause.replace('_', " ")))
        .collect();
    Ok(if parts.is_empty() { "none".into() } else { parts.join(", ") })
}

/// A session of one scan; returns its bytes.
fn write_session(path: &Path, force: bool, scan: Scan, calibration: &Calibration) -> Result<u64> {
    let config = EncoderConfig::new(SCAN_PERIOD_NANOS);
    let created = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
    let metadata = session_metadata(&config, created).with_calibration(&calibration.to_toml()?);
    let mut encoder = Encoder::new(config)?;
    let header = encoder.header();
    let mut writer = SessionWriter::create(AtomicFile::create(path, force)?, &metadata)?;
    writer.write_stream(&header.encode())?;
    let mut scans = 0;
    let uncoded = [obj_bmp_bytes(&scan), binary_bytes(&scan)];
    let first = encoder.push(scan).context("the scan cannot be coded")?.group;
    for group in [first, encoder.finish().context("the scan cannot be coded")?].into_iter().flatten() {
        write_group(&mut writer, &group, &[])?;
        scans += group.scans as u64;
    }
    let statistics = MetadataGroup::new()
        .with(key::SCANS, scans)
        .with(key::KEYFRAMES, scans)
        .with(key::RAW_OBJ_BMP_BYTES, uncoded[0])
        .with(key::RAW_BINARY_BYTES, uncoded[1]);
    writer.finish(&statistics)?.commit()?;
    Ok(std::fs::metadata(path)?.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::ScanFolder;
    use crate::replay::Replay;
    use clap::Parser;
    use glam::{DMat3, DVec3, Vec3};
    use gv3_codec::mesh::TriMesh;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        reconstruct: Reconstruct,
    }

    const KAMINO: &str = include_str!("../../../tests/board.toml");

    fn path(p: &Path) -> &str {
        p.to_str().unwrap()
    }

    /// Runs the command on the real capture with `calibration` edited; `None`, with the reason printed, where it is not there.
    fn kamino(work: &Path, sequence: &str, edit: impl Fn(String) -> String, more: &[&str]) -> Option<Result<Outcome>> {
        let data = std::env::var_os("GV3_TEST_DATA")
            .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
        let folder = data.join("kamino");
        let Ok(calibration) = std::fs::read_to_string(folder.join("kamino_calibration.json")) else {
            println!("skipped: no real capture at {}; set GV3_TEST_DATA", folder.display());
            return None;
        };
        let (calibration_path, sequence_path) = (work.join("calibration.json"), work.join("sequence.toml"));
        std::fs::write(&calibration_path, edit(calibration)).unwrap();
        std::fs::write(&sequence_path, sequence).unwrap();
        let (capture, out) = (folder.join("capture_0"), work.join("scan"));
        let fixed =
            ["gv3", path(&capture), "--sequence", path(&sequence_path), "--calibration", path(&calibration_path)];
        let line = fixed.into_iter().chain(["-o", path(&out)]).chain(more.iter().copied());
        Some(Line::try_parse_from(line).unwrap().reconstruct.run())
    }

    /// The plane z = a x + b y + c through points, by least squares about their mean; distances are along its normal.
    fn fit(points: &[DVec3]) -> impl Fn(DVec3) -> f64 + use<> {
        let mean = points.iter().sum::<DVec3>() / points.len() as f64;
        let row = |p: &DVec3| DVec3::new(p.x - mean.x, p.y - mean.y, 1.0);
        let normal = points.iter().map(row).fold(DMat3::ZERO, |s, r| s + DMat3::from_cols(r * r.x, r * r.y, r * r.z));
        let right = points.iter().map(|p| row(p) * (p.z - mean.z)).sum::<DVec3>();
        let plane = normal.inverse() * right;
        let scale = 1.0 / (1.0 + plane.x * plane.x + plane.y * plane.y).sqrt();
        move |p| (p.z - mean.z - plane.x * (p.x - mean.x) - plane.y * (p.y - mean.y) - plane.z) * scale
    }

    /// The largest plane: the best of random triples, then least squares of what lies within `reach_mm`, until it stays.
    fn largest_plane(points: &[DVec3], reach_mm: f64) -> Vec<f64> {
        let mut state = 1u64;
        let mut pick = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            points[(state >> 33) as usize % points.len()]
        };
        let thin: Vec<DVec3> = points.iter().copied().step_by(101).collect();
        let within = |distance: &dyn Fn(DVec3) -> f64, of: &[DVec3]| -> Vec<DVec3> {
            of.iter().copied().filter(|p| distance(*p).abs() < reach_mm).collect()
        };
        let mut best: Vec<DVec3> = Vec::new();
        for _ in 0..500 {
            let found = within(&fit(&[pick(), pick(), pick()]), &thin);
            if found.len() > best.len() {
                best = found;
            }
        }
        for _ in 0..10 {
            best = within(&fit(&best), points);
        }
        let distance = fit(&best);
        best.iter().map(|p| distance(*p)).collect()
    }

    #[test]
    fn a_real_board_decodes_to_a_plane() {
        let work = tempfile::tempdir().unwrap();
        let more = ["--format", "ply", "--json"];
        let Some(outcome) = kamino(work.path(), KAMINO, |c| c, &more) else { return };
        let report = outcome.unwrap().report;
        let scan = ScanFolder::open(&work.path().join("scan")).unwrap().load(0, 1).unwrap().scan;
        // The printed squares; around them are tape and the wall.
        let (picture, uv) = (scan.texture.unwrap(), scan.mesh.uv.unwrap());
        let is_board = |uv: &[f32; 2]| {
            let [x, y] = picture.uv_to_px(*uv);
            (255.0..955.0).contains(&x) && (205.0..760.0).contains(&y)
        };
        let on_board = scan.mesh.positions_mm.iter().zip(&uv).filter(|(_, uv)| is_board(uv));
        let points: Vec<DVec3> = on_board.map(|(p, _)| p.as_dvec3()).collect();
        // Ten times the noise, so that the figure is not what the selection makes it.
        let residuals = largest_plane(&points, 12.0);
        let count = residuals.len();
        let rms_mm = (residuals.iter().map(|r| r * r).sum::<f64>() / count as f64).sqrt();
        println!("board: rms {rms_mm:.3} mm over {count} of {} points", points.len());
        println!("{report}");
        assert!(rms_mm <= 1.5, "{rms_mm} mm");
        assert!(count > 100_000, "{count} points");
    }

    #[test]
    fn the_session_holds_the_scan() {
        let side = 40u32;
        let at = |i: u32| (i % side, i / side);
        let texture = GreyPicture::filled(side, side, 90);
        let cells = (0..side * side).filter(|&i| at(i).0 + 1 < side && at(i).1 + 1 < side);
        let mesh = TriMesh {
            positions_mm: (0..side * side).map(|i| Vec3::new(at(i).0 as f32, -(at(i).1 as f32), -600.0)).collect(),
            triangles: cells.flat_map(|i| [[i, i + side, i + 1], [i + 1, i + side, i + side + 1]]).collect(),
            uv: Some((0..side * side).map(|i| texture.px_to_uv([at(i).0 as f32, at(i).1 as f32])).collect()),
        };
        let work = tempfile::tempdir().unwrap();
        let path = work.path().join("scan.gv3");
        let scan = Scan { tick: 0, time_nanos: 0, mesh, texture: Some(texture) };
        let calibration = crate::device::RigConfig::simulated().calibration.unwrap();
        let bytes = write_session(&path, false, scan, &calibration).unwrap();
        assert_eq!(bytes, path.metadata().unwrap().len());
        assert_eq!(Replay::open(&path).unwrap().stamps().len(), 1);
    }

    #[test]
    fn what_does_not_fit_the_real_capture_is_named() {
        let work = tempfile::tempdir().unwrap();
        let error = |sequence: &str, from: &str, to: &str| {
            let edit = |c: String| c.replace(from, to);
            kamino(work.path(), sequence, edit, &[]).map(|r| r.unwrap_err()).map(|e| format!("{e:#}"))
        };
        let Some(text) = error(KAMINO, "1280", "640") else { return };
        assert!(text.contains("graycode_00.png: 1280 x 1024 pixels, but the calibration is for"), "{text}");
        let text = error(&KAMINO.replace("width_px = 1024", "width_px = 1000"), "", "").unwrap();
        assert!(text.contains("1000 x 768, but the calibration's projector has 1024 x 768"), "{text}");
        let text = error(&KAMINO.replace("graycode_##", "gray_##"), "", "").unwrap();
        assert!(text.contains("gray_00.png"), "{text}");
        let text = error(KAMINO, "3452.347341830953", "-1").unwrap();
        assert!(text.contains("calibration.json: camera.fx_px"), "{text}");
        let swapped =
            KAMINO.replace("\"white\"", "\"x\"").replace("\"black\"", "\"white\"").replace("\"x\"", "\"black\"");
        let text = error(&swapped, "", "").unwrap();
        assert!(text.contains("graycode_41.png: white, but no brighter than black"), "{text}");
    }
}
