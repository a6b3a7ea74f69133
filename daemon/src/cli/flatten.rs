//! `gv3 flatten`: a surface laid on the unit disk with its angles kept.

use super::Outcome;
use crate::files::obj::{obj_bytes, read_obj};
use crate::files::ply::read_ply;
use crate::files::write_whole;
use crate::view::checkerboard::{checkerboard, disk_uv};
use crate::view::compare::png_bytes;
use crate::view::render::ViewSide;
use anyhow::{Context, Result, anyhow, bail};
use clap::{Args, ValueEnum};
use glam::{DVec2, DVec3};
use gv3_codec::mesh::repair::{RepairOptions, to_disk};
use gv3_codec::mesh::{DiskMesh, TriMesh};
use gv3_codec::param::disk::{DiskMap, DiskMapper, DiskOptions};
use gv3_codec::param::sphere::{FlowOptions, FlowReport, double_cover_disk_map, sphere_map};
use gv3_codec::param::{AngleErrors, HISTOGRAM_BOUNDS_DEG};
use serde::Serialize;
use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Map a surface conformally to the unit disk; report angle errors, turned triangles and times.
///
/// The surface is repaired to a topological disk first: one piece, one border, holes filled.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  gv3 flatten face.obj --checkerboard face.png -o face_flat.obj")]
pub struct Flatten {
    /// Mesh to map, OBJ or PLY.
    mesh: PathBuf,
    /// How to map.
    #[arg(long, value_enum, default_value_t = Method::Green)]
    method: Method,
    /// Vertex at the centre of the disk, counted from 1 (method green; the innermost by default).
    #[arg(long, value_name = "VERTEX", value_parser = clap::value_parser!(u32).range(1..))]
    centre: Option<u32>,
    /// Refuse a mesh that is no disk instead of repairing it.
    #[arg(long)]
    no_repair: bool,
    /// Cut open a closed surface where it faces away from +z, instead of refusing it.
    #[arg(long, conflicts_with = "no_repair")]
    open_closed: bool,
    /// Only smooth a ragged border, instead of clipping it along a smooth curve a vertex or two inside: more triangles
    /// turn over.
    #[arg(long, conflicts_with = "no_repair")]
    keep_border: bool,
    /// Picture to draw: a checkerboard on the disk, carried back to the surface (PNG).
    #[arg(long, value_name = "PNG")]
    checkerboard: Option<PathBuf>,
    /// Turn of that picture to the surface's left, degrees.
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true, requires = "checkerboard")]
    yaw: f32,
    /// Mesh to write: the surface as mapped, the disk as its texture coordinates; the sphere with method sphere (OBJ).
    #[arg(short, long, value_name = "OBJ")]
    out: Option<PathBuf>,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Method {
    /// Green's function on the border, one harmonic extension: the fast one.
    Green,
    /// Double cover on the sphere by harmonic energy flow: the published reference, off-line.
    Qiem,
    /// A closed surface without handles on the unit sphere, by the same flow.
    Sphere,
}

impl Method {
    fn name(self) -> &'static str {
        match self {
            Self::Green => "green",
            Self::Qiem => "qiem",
            Self::Sphere => "sphere",
        }
    }
}

/// What is mapped.
enum Surface {
    Disk(DiskMesh),
    Closed(TriMesh),
}

impl Surface {
    fn mesh(&self) -> &TriMesh {
        match self {
            Self::Disk(disk) => disk,
            Self::Closed(mesh) => mesh,
        }
    }
}

/// A map and what is known of it.
struct Flattened {
    /// Points of the disk, z = 0, or of the sphere.
    points: Vec<DVec3>,
    border: Vec<u32>,
    flips: usize,
}

impl From<DiskMap> for Flattened {
    fn from(map: DiskMap) -> Self {
        let points = map.points.iter().map(|z| z.extend(0.0)).collect();
        Self { points, border: map.border, flips: map.flips }
    }
}

#[derive(Debug, Serialize)]
struct FlattenReport {
    vertices: usize,
    method: &'static str,
    /// Stages of the mapping and their total; `repair` stands beside it.
    ms: BTreeMap<&'static str, f64>,
    angle_error_deg: AngleFigures,
    flips: usize,
    /// Largest distance of a border vertex from the unit circle.
    boundary_deviation: f64,
    #[serde(skip)]
    histogram: [usize; HISTOGRAM_BOUNDS_DEG.len()],
    #[serde(skip)]
    notes: Vec<String>,
}

#[derive(Debug, Serialize)]
struct AngleFigures {
    mean: f64,
    sd: f64,
    p99: f64,
    max: f64,
}

/// Adds up the time between calls by stage.
struct StageClock {
    at: Instant,
    ms: BTreeMap<&'static str, f64>,
}

impl StageClock {
    fn start() -> Self {
        Self { at: Instant::now(), ms: BTreeMap::new() }
    }

    fn end(&mut self, stage: &'static str) {
        let now = Instant::now();
        *self.ms.entry(stage).or_default() += (now - self.at).as_secs_f64() * 1e3;
        self.at = now;
    }
}

impl Flatten {
    pub(super) fn run(self) -> Result<Outcome> {
        if self.method == Method::Sphere && self.checkerboard.is_some() {
            bail!("the checkerboard is one of the disk; the sphere has none");
        }
        if self.method != Method::Green && self.centre.is_some() {
            bail!("--centre belongs to the method green");
        }
        let read = read_mesh(&self.mesh)?;
        let mut notes = Vec::new();
        let started = Instant::now();
        let surface = self.surface(read, &mut notes)?;
        let repair_ms = started.elapsed().as_secs_f64() * 1e3;
        let mut clock = StageClock::start();
        let map = self
            .map(&surface, &mut clock, &mut notes)
            .with_context(|| format!("{}: cannot be mapped", self.mesh.display()))?;
        let total_ms = clock.ms.values().sum();
        clock.ms.insert("total", total_ms);
        if !self.no_repair {
            clock.ms.insert("repair", repair_ms);
        }
        let mesh = surface.mesh();
        let at = |v: u32| mesh.positions_mm[v as usize].as_dvec3();
        let errors = AngleErrors::between(&mesh.triangles, at, |v| map.points[v as usize]);
        let deviation = |&v: &u32| (map.points[v as usize].length() - 1.0).abs();
        let report = FlattenReport {
            vertices: mesh.vertex_count(),
            method: self.method.name(),
            ms: clock.ms,
            angle_error_deg: AngleFigures {
                mean: errors.mean_deg,
                sd: errors.sd_deg,
                p99: errors.p99_deg,
                max: errors.max_deg,
            },
            flips: map.flips,
            boundary_deviation: map.border.iter().map(deviation).fold(0.0, f64::max),
            histogram: errors.histogram,
            notes,
        };
        self.write(mesh, &map.points)?;
        Outcome::of(self.json, &report, || describe(&report))
    }

    /// The mesh as a topological disk; as it is for the sphere, whose map checks it.
    fn surface(&self, mesh: TriMesh, notes: &mut Vec<String>) -> Result<Surface> {
        let name = self.mesh.display();
        if self.method == Method::Sphere {
            return Ok(Surface::Closed(mesh));
        }
        if self.no_repair {
            let disk =
                DiskMesh::new(mesh).with_context(|| format!("{name}: leave out --no-repair to have it made a disk"))?;
            return Ok(Surface::Disk(disk));
        }
        let options =
            RepairOptions { open_closed: self.open_closed, clip_border: !self.keep_border, ..Default::default() };
        let (disk, report) = to_disk(&mesh, &options).with_context(|| format!("{name}: cannot be repaired"))?;
        notes.push(format!("repair: {report}"));
        Ok(Surface::Disk(disk))
    }

    fn map(&self, surface: &Surface, clock: &mut StageClock, notes: &mut Vec<String>) -> Result<Flattened> {
        match surface {
            Surface::Disk(disk) if self.method == Method::Green => {
                let options = DiskOptions { centre: self.centre.map(|v| v - 1) };
                Ok(DiskMapper::new(options).map(disk, &mut |stage| clock.end(stage))?.into())
            }
            Surface::Disk(disk) => {
                let (map, flow) = double_cover_disk_map(disk, &FlowOptions::default())?;
                clock.end("flow");
                notes.push(describe_flow(&flow));
                Ok(map.into())
            }
            Surface::Closed(mesh) => {
                let map = sphere_map(mesh, &FlowOptions::default())?;
                clock.end("flow");
                notes.push(describe_flow(&map.flow));
                Ok(Flattened { points: map.points, border: Vec::new(), flips: map.flips })
            }
        }
    }

    fn write(&self, mesh: &TriMesh, points: &[DVec3]) -> Result<()> {
        let disk: Vec<DVec2> = points.iter().map(|p| p.truncate()).collect();
        if let Some(path) = &self.checkerboard {
            let side = ViewSide { yaw_rad: self.yaw.to_radians(), ..Default::default() };
            write_whole(path, &png_bytes(&checkerboard(mesh, &disk, side)))?;
        }
        if let Some(path) = &self.out {
            let mapped = match self.method {
                Method::Sphere => {
                    TriMesh { positions_mm: points.iter().map(|p| p.as_vec3()).collect(), ..mesh.clone() }
                }
                _ => TriMesh { uv: Some(disk_uv(&disk)), ..mesh.clone() },
            };
            write_whole(path, &obj_bytes(&mapped, None))?;
        }
        Ok(())
    }
}

/// How a flow went; one that did not end by itself is warned of on standard error too.
fn describe_flow(flow: &FlowReport) -> String {
    let steps = flow.energy.len() - 1;
    let excess = 100.0 * (flow.energy[steps] / (4.0 * PI) - 1.0);
    let end = if flow.converged { "converged" } else { "not converged" };
    let text =
        format!("flow: {end} after {steps} steps of {:.0}, energy {excess:.3} % above that of a sphere", flow.step);
    if !flow.converged {
        tracing::warn!("{text}");
    }
    text
}

/// Reads an OBJ or PLY mesh, by the ending of its name.
fn read_mesh(path: &Path) -> Result<TriMesh> {
    let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    match ending.as_deref() {
        Some("obj") => Ok(read_obj(path)?.mesh),
        Some("ply") => Ok(read_ply(path)?.mesh),
        _ => Err(anyhow!("{}: neither .obj nor .ply; these are the meshes read", path.display())),
    }
}

/// The report in words.
fn describe(r: &FlattenReport) -> String {
    let mut text = String::new();
    let angle = &r.angle_error_deg;
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{} vertices mapped, method {}", r.vertices, r.method);
    let _ = writeln!(
        text,
        "  angle error  mean {:.3}, sd {:.3}, p99 {:.2}, max {:.1} degrees",
        angle.mean, angle.sd, angle.p99, angle.max
    );
    let corners = r.histogram.iter().sum::<usize>().max(1) as f64;
    for (bound, count) in HISTOGRAM_BOUNDS_DEG.iter().zip(r.histogram) {
        let share = 100.0 * count as f64 / corners;
        let _ = writeln!(text, "    up to {bound:>5} {share:>7.3} % {}", "#".repeat((share * 0.4).round() as usize));
    }
    let _ = writeln!(text, "  turned over  {} triangles", r.flips);
    let _ = writeln!(text, "  border       {:.1e} off the unit circle at most", r.boundary_deviation);
    let stages = r.ms.iter().filter(|(stage, _)| !["total", "repair"].contains(*stage));
    let stages: Vec<String> = stages.map(|(stage, ms)| format!("{stage} {ms:.1}")).collect();
    let _ = writeln!(text, "  time         {:.1} ms: {}", r.ms["total"], stages.join(", "));
    if let Some(ms) = r.ms.get("repair") {
        let _ = writeln!(text, "  repair       {ms:.1} ms");
    }
    for note in &r.notes {
        let _ = writeln!(text, "  {note}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use glam::Vec3;

    #[derive(Parser)]
    struct Shell {
        #[command(flatten)]
        flatten: Flatten,
    }

    fn run(arguments: &[&str]) -> Result<Outcome> {
        Shell::try_parse_from(std::iter::once("flatten").chain(arguments.iter().copied()))?.flatten.run()
    }

    /// A dome on a grid of 24 x 24 vertices.
    fn dome() -> TriMesh {
        let at = |i: u32| Vec3::new((i % 24) as f32 - 11.5, (i / 24) as f32 - 11.5, 0.0);
        let place = |p: Vec3| p + Vec3::Z * (400.0 - p.length_squared()).sqrt();
        let quads = (0..23 * 23).map(|i| i / 23 * 24 + i % 23);
        TriMesh {
            positions_mm: (0..24 * 24).map(|i| place(at(i))).collect(),
            triangles: quads.flat_map(|a| [[a, a + 1, a + 25], [a, a + 25, a + 24]]).collect(),
            uv: None,
        }
    }

    #[test]
    fn a_dome_is_mapped_reported_drawn_and_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
        let (mesh, picture, out) = (path("dome.obj"), path("dome.png"), path("flat.obj"));
        std::fs::write(&mesh, obj_bytes(&dome(), None)).unwrap();
        let outcome = run(&[&mesh, "--json", "--checkerboard", &picture, "-o", &out]).unwrap();
        let report: serde_json::Value = serde_json::from_str(&outcome.report).unwrap();
        let keys: Vec<&str> = report.as_object().unwrap().keys().map(String::as_str).collect();
        let expected = ["angle_error_deg", "boundary_deviation", "flips", "method", "ms", "vertices"];
        assert!(keys.len() == 6 && expected.iter().all(|key| keys.contains(key)), "{keys:?}");
        assert!(report["angle_error_deg"]["mean"].as_f64().unwrap() < 4.0);
        assert!(report["flips"] == 0 && report["boundary_deviation"].as_f64().unwrap() < 1e-9);
        assert!(report["ms"]["total"].as_f64().unwrap() > 0.0);
        let flat = read_obj(Path::new(&out)).unwrap().mesh;
        assert_eq!(flat.vertex_count() as u64, report["vertices"].as_u64().unwrap());
        assert!(flat.uv.unwrap().iter().all(|uv| (uv[0] - 0.5).hypot(uv[1] - 0.5) < 0.501));
        assert!(std::fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
    }

    #[test]
    fn the_reference_method_agrees_and_words_say_how_it_went() {
        let folder = tempfile::tempdir().unwrap();
        let mesh = folder.path().join("dome.obj");
        std::fs::write(&mesh, obj_bytes(&dome(), None)).unwrap();
        let text = run(&[mesh.to_str().unwrap(), "--method", "qiem", "--no-repair"]).unwrap().report;
        assert!(text.contains("flow: converged") && text.contains("turned over  0"), "{text}");
    }

    #[test]
    fn what_cannot_be_mapped_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, mesh: &TriMesh| {
            let path = folder.path().join(name);
            std::fs::write(&path, obj_bytes(mesh, None)).unwrap();
            path.to_str().unwrap().to_owned()
        };
        let error = |arguments: &[&str]| format!("{:#}", run(arguments).unwrap_err());
        let mut holed = dome();
        holed.triangles.retain(|t| !t.contains(&300));
        let holed = file("holed.obj", &holed);
        assert!(error(&[&holed, "--no-repair"]).contains("not a disk: 2 boundary loops"));
        assert!(run(&[&holed, "--keep-border"]).unwrap().report.contains("1 holes filled"));
        assert!(run(&[&holed]).unwrap().report.contains("clipped off a ragged border"));
        assert!(error(&[&holed, "--method", "sphere"]).contains("not closed: edge"));
        assert!(error(&[&holed, "--method", "sphere", "--checkerboard", "x.png"]).contains("checkerboard"));
        assert!(error(&[&holed, "--method", "qiem", "--centre", "300"]).contains("belongs to the method green"));
        assert!(error(&[&holed, "--centre", "1000000"]).contains("cannot be the centre"));
        assert!(error(&["scan.stl"]).contains("neither .obj nor .ply"));
    }
}
