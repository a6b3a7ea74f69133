//! Matching, geodesics and (H, lambda) on the expressions of the shared face model, whose vertices correspond: every
//! error is known. The model is in the folder that GV3_TEST_DATA names, `../shared/data` beside the workspace otherwise.
#![allow(clippy::unwrap_used, reason = "tests")]

mod support;

use glam::{DVec2, DVec3, Vec3};
use gv3_codec::mesh::{HalfEdges, TriMesh};
use gv3_codec::motion::spline::ChannelSplines;
use gv3_codec::param::curvature_homotopy::CurvatureHomotopy;
use gv3_codec::param::curvature_map::{CommonDisk, CurvatureForm};
use gv3_codec::param::disk::disk_map;
use gv3_codec::param::geodesic::GeodesicSurface;
use gv3_codec::param::grid_plate::GridPlateOptions;
use gv3_codec::param::locate::{DiskLocator, Place};
use gv3_codec::param::match_energies::{MappedSurface, MatchEnergies};
use gv3_codec::param::matching::{DiskMatch, SourceDisk, WarpKind};
use gv3_codec::param::partition::Partition;
use std::path::Path;

/// A face and the shifts of its expressions, mm.
struct FaceModel {
    neutral: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    names: Vec<String>,
    shifts: Vec<Vec<DVec3>>,
    /// 68 vertices; the first 17 run along the jaw.
    landmarks: Vec<u32>,
}

/// The model; none, with the reason printed, where it is missing.
fn face_model() -> Option<FaceModel> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let folder = std::env::var_os("GV3_TEST_DATA").map_or_else(beside, std::path::PathBuf::from);
    let path = folder.join("ict_sequence/ict_face_basis.npz");
    if !path.is_file() {
        println!("skipped: {} is not there; GV3_TEST_DATA names the folder of shared data", path.display());
        return None;
    }
    let arrays = support::read_npz(&path);
    let centimetres = |v: &[f64]| DVec3::new(v[0], v[1], v[2]) * 10.0;
    let expressions = &arrays["expr"];
    let per_expression = expressions.shape[1] * 3;
    let shifts = (expressions.values.chunks_exact(per_expression).zip(&arrays["expr_scale"].values))
        .map(|(shift, scale)| shift.chunks_exact(3).map(|v| centimetres(v) * *scale).collect())
        .collect();
    Some(FaceModel {
        neutral: arrays["neutral"].values.chunks_exact(3).map(centimetres).collect(),
        triangles: arrays["faces"].values.chunks_exact(3).map(|t| [t[0] as u32, t[1] as u32, t[2] as u32]).collect(),
        names: arrays["expr_names"].names.clone(),
        shifts,
        landmarks: arrays["landmarks68"].values.iter().map(|v| *v as u32).collect(),
    })
}

impl FaceModel {
    /// The face with amounts of the expressions whose names start so.
    fn with(&self, amounts: &[(&str, f64)]) -> TriMesh {
        let mut at = self.neutral.clone();
        for (start, amount) in amounts {
            let mut known = false;
            for (_, shift) in self.names.iter().zip(&self.shifts).filter(|(name, _)| name.starts_with(start)) {
                known = true;
                at.iter_mut().zip(shift).for_each(|(p, s)| *p += *s * *amount);
            }
            assert!(known, "{start} is none of {:?}", self.names);
        }
        TriMesh { positions_mm: at.iter().map(|p| p.as_vec3()).collect(), triangles: self.triangles.clone(), uv: None }
    }

    /// Rounds of averaging with the neighbours, of the face and of its expressions.
    fn smooth(&mut self, rounds: usize) {
        let edges = HalfEdges::build(self.neutral.len(), &self.triangles).unwrap();
        for field in std::iter::once(&mut self.neutral).chain(&mut self.shifts) {
            for _ in 0..rounds {
                let mean = |v: u32| {
                    let (sum, count) =
                        edges.neighbours(v).fold((DVec3::ZERO, 0.0), |(s, n), w| (s + field[w as usize], n + 1.0));
                    if edges.is_boundary_vertex(v) {
                        field[v as usize]
                    } else {
                        field[v as usize].lerp(sum / count, 0.5)
                    }
                };
                *field = (0..field.len() as u32).map(mean).collect();
            }
        }
    }

    fn cases(&self) -> Vec<(&'static str, TriMesh)> {
        // As much jaw as moves its farthest vertex by 18 mm.
        let open = self.with(&[("jawOpen", 1.0)]);
        let farthest = (open.positions_mm.iter().zip(&self.neutral)).map(|(p, q)| p.as_dvec3().distance(*q));
        let jaw = 18.0 / farthest.fold(0.0, f64::max);
        vec![
            ("smile", self.with(&[("mouthSmile", 0.9), ("cheekSquint", 0.45), ("mouthDimple", 0.2)])),
            ("blink", self.with(&[("eyeBlink", 1.0)])),
            ("brow", self.with(&[("browInnerUp", 0.9), ("browOuterUp", 0.9), ("eyeWide", 0.4)])),
            ("pucker", self.with(&[("mouthPucker", 0.9), ("mouthFunnel", 0.3)])),
            ("jaw open 18 mm", self.with(&[("jawOpen", jaw)])),
        ]
    }
}

/// Root mean square distance of where the matching carries the vertices of the neutral face from where they are, mm.
fn rms_mm(matching: &DiskMatch, points: &[DVec2], target: MappedSurface<'_>) -> f64 {
    let truth = &target.mesh.positions_mm;
    let error2 = |(z, p): (&DVec2, &Vec3)| target.at(matching.apply(*z)).unwrap().distance_squared(p.as_dvec3());
    (points.iter().zip(truth).map(error2).sum::<f64>() / points.len() as f64).sqrt()
}

#[test]
fn warps_meet_expressions_without_folds() {
    let Some(model) = face_model() else { return };
    let neutral = model.with(&[]);
    let map = disk_map(&neutral).unwrap();
    let locator = DiskLocator::new(&map.points, &neutral.triangles);
    let inner = &model.landmarks[17..];
    let grid = |side| WarpKind::GridPlate(GridPlateOptions { side, ..Default::default() });
    let kinds = [WarpKind::Mobius, grid(16), grid(32), WarpKind::ClampedPlate, WarpKind::ThinPlate];
    println!("error in mm rms / folds      Möbius  published 16  published 32  clamped plate  thin plate");
    for (name, mesh) in model.cases() {
        let target = disk_map(&mesh).unwrap();
        let target_locator = DiskLocator::new(&target.points, &mesh.triangles);
        let surface = MappedSurface { mesh: &mesh, points: &target.points, locator: &target_locator };
        let own = MappedSurface { mesh: &neutral, points: &map.points, locator: &locator };
        let pick = |points: &[DVec2]| -> Vec<DVec2> { inner.iter().map(|&v| points[v as usize]).collect() };
        let (from, to) = (pick(&map.points), pick(&target.points));
        let source = SourceDisk { points: &map.points, triangles: &neutral.triangles };
        let found: Vec<(f64, DiskMatch)> = (kinds.iter())
            .map(|kind| {
                let matching = DiskMatch::fit(&from, &to, source, kind);
                (rms_mm(&matching, &map.points, surface), matching)
            })
            .collect();
        let cells: Vec<String> = found.iter().map(|(rms, m)| format!("{rms:6.2} / {:<3}", m.folds)).collect();
        let pairs: Vec<(DVec2, DVec2)> = from.iter().copied().zip(to.iter().copied()).collect();
        let energies = [0, 3].map(|k| MatchEnergies::of(|z| found[k].1.apply(z), own, surface, &pairs));
        println!("{name:24} {}", cells.join("  "));
        let [before, after] = energies;
        println!(
            "  E_D {:.2e} -> {:.2e}, E_loc {:.2} -> {:.2} mm², E {:.1} -> {:.1} mm²",
            before.conformal, after.conformal, before.local_mm2, after.local_mm2, before.global_mm2, after.global_mm2
        );
        let (mobius, clamped) = (&found[0], &found[3]);
        assert_eq!(clamped.1.folds, 0, "{name}");
        assert!(clamped.0 < 0.7 * mobius.0 && clamped.0 < found[1].0, "{name}: {cells:?}");
        assert!(after.conformal < 1e-12 && after.local_mm2 < 1e-2, "{name}: {after:?}");
        assert_eq!(found[4].1.folds, 0, "{name}");
    }
}

#[test]
fn geodesics_join_the_landmarks_of_a_partition() {
    let Some(model) = face_model() else { return };
    let neutral = model.with(&[]);
    let map = disk_map(&neutral).unwrap();
    let inner = &model.landmarks[17..];
    let points: Vec<DVec2> = inner.iter().map(|&v| map.points[v as usize]).collect();
    let partition = Partition::new(&points).unwrap();
    let surface = GeodesicSurface::new(&neutral, &map.points).unwrap();
    let edges = HalfEdges::build(neutral.vertex_count(), &neutral.triangles).unwrap();
    let place = |k: u32| {
        let h = edges.outgoing[inner[k as usize] as usize];
        let mut barycentric = [0.0; 3];
        barycentric[(h % 3) as usize] = 1.0;
        Place { triangle: h / 3, barycentric }
    };
    let (mut straight_mm, mut corrected_mm, mut settled, mut count) = (0.0, 0.0, 0, 0);
    for [a, b] in partition.edges().into_iter().filter(|e| e.iter().all(|&v| (v as usize) < inner.len())) {
        let path = surface.between(place(a), place(b), 5).unwrap();
        let chord =
            neutral.positions_mm[inner[a as usize] as usize].distance(neutral.positions_mm[inner[b as usize] as usize]);
        assert!(path.lengths_mm.windows(2).all(|w| w[1] <= w[0]));
        assert!(path.length_mm() >= f64::from(chord) - 1e-3);
        straight_mm += path.lengths_mm[0];
        corrected_mm += path.length_mm();
        settled += usize::from(path.settled);
        count += 1;
    }
    println!("{count} geodesics, {settled} settled in 5 passes, {straight_mm:.1} -> {corrected_mm:.1} mm");
    assert!(count > 100 && settled * 10 > count * 6, "{settled} of {count}");
    assert!(corrected_mm < straight_mm);
}

#[test]
fn the_full_laplacian_brings_a_face_back_and_the_vertex_spline_is_nearer_between() {
    let Some(mut model) = face_model() else { return };
    // The model as it is, lips and lids folded in, is too rough for the iteration to settle.
    model.smooth(20);
    let at = |t: f64| model.with(&[("mouthSmile", 0.9 * (1.2 * t).sin().powi(2)), ("browInnerUp", 0.4 * t)]);
    let points = disk_map(&at(0.0)).unwrap().points;
    let disk = CommonDisk::new(&points, &model.triangles).unwrap();
    let times = [0.0, 0.4, 0.8, 1.2, 1.6];
    let keys: Vec<Vec<Vec3>> = times.iter().map(|&t| at(t).positions_mm).collect();
    let flat: Vec<f32> = keys.iter().flatten().flat_map(|p| p.to_array()).collect();
    let vertex = ChannelSplines::new(&times, flat, 3 * points.len()).unwrap();
    let keys: Vec<&[Vec3]> = keys.iter().map(Vec::as_slice).collect();
    let mut errors = Vec::new();
    for form in [CurvatureForm::FullVector, CurvatureForm::Published] {
        let homotopy = CurvatureHomotopy::new(&disk, &times, &keys, form).unwrap();
        for (what, t) in [("at a key", 0.8), ("between keys", 0.6)] {
            let found = homotopy.surface_at(&disk, t).unwrap();
            let truth = at(t).positions_mm;
            let error = disk.error(&found.positions_mm, &truth).unwrap();
            let mut row = vec![0.0; 3 * points.len()];
            vertex.sample(t, &mut row);
            let by_vertex: Vec<Vec3> = row.chunks_exact(3).map(Vec3::from_slice).collect();
            let spline = disk.error(&by_vertex, &truth).unwrap();
            println!("{form:?} {what}: {error:?} in {} steps; vertex spline rms {:.4} mm", found.steps, spline.rms_mm);
            assert!(spline.rms_mm < error.rms_mm);
            errors.push(error.rms_mm);
        }
    }
    assert!(errors[0] < 0.5 && errors[0] < 0.2 * errors[2], "{errors:?}");
    assert!(errors[1] < 0.5 && errors[1] < 0.2 * errors[3], "{errors:?}");
}
