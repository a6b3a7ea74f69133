//! Surfaces of others, where they are at hand: the folder that GV3_TEST_DATA names, `../shared/data` beside the
//! workspace otherwise.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use glam::{DVec2, DVec3};
use gv3::files::RawFolder;
use gv3::files::obj::read_obj;
use gv3::light::{Board, Calibration};
use gv3::pipeline::read_board_view;
use gv3_codec::mesh::TriMesh;
use gv3_codec::mesh::repair::{RepairOptions, to_disk};
use gv3_codec::param::disk::disk_map;
use std::path::{Path, PathBuf};

/// A folder of the shared data; none, with the reason printed, where it is missing.
fn shared(folder: &str) -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let path = std::env::var_os("GV3_TEST_DATA").map_or_else(beside, PathBuf::from).join(folder);
    if !path.is_dir() {
        println!("skipped: {} is not there; GV3_TEST_DATA names the folder of shared data", path.display());
        return None;
    }
    Some(path)
}

/// Mean over all corners of the difference between a corner's angle on the surface and on the disk, degrees.
fn mean_angle_error_deg(mesh: &TriMesh, points: &[DVec2]) -> f64 {
    let (mut sum, mut count) = (0.0, 0u64);
    for t in &mesh.triangles {
        for k in 0..3 {
            let [a, b, c] = [t[k], t[(k + 1) % 3], t[(k + 2) % 3]].map(|v| v as usize);
            let [p, q, r] = [a, b, c].map(|v| mesh.positions_mm[v].as_dvec3());
            let on_surface = (q - p).angle_between(r - p);
            let on_disk = (points[b] - points[a]).angle_to(points[c] - points[a]).abs();
            if on_surface.is_finite() && on_disk.is_finite() {
                sum += (on_surface - on_disk).abs();
                count += 1;
            }
        }
    }
    (sum / count as f64).to_degrees()
}

#[test]
fn disks_map_without_flips_and_nearly_without_angle_error() {
    let Some(folder) = shared("disks") else { return };
    for (name, most_flips, limit_deg) in
        [("human_face.obj", 0, 1.6), ("maxplanck_front.obj", 3, 1.6), ("chinese_lion.obj", 3, 3.0)]
    {
        let read = read_obj(&folder.join(name)).unwrap();
        let (disk, report) = to_disk(&read.mesh, &RepairOptions::default()).unwrap();
        assert!(disk.triangles.len() * 100 > read.mesh.triangles.len() * 97, "{name}: {report}");
        let map = disk_map(&disk).unwrap();
        let error_deg = mean_angle_error_deg(&disk, &map.points);
        println!("{name}: {} flips, mean angle error {error_deg:.3} degrees", map.flips);
        assert!(map.flips <= most_flips, "{name}: {} flips", map.flips);
        assert!(error_deg < limit_deg, "{name}: {error_deg} degrees");
        assert!(map.points.iter().all(|z| z.length() <= 1.0 + 1e-9), "{name}");
    }
}

/// What the pictures of the real board show.
const BOARD_SEQUENCE: &str = include_str!("../board.toml");

/// The point nearest to the rays of a camera pixel and of a projector pixel, camera frame, mm, and the rays' distance there.
fn between_rays(rig: &Calibration, camera_px: DVec2, projector_px: DVec2) -> (DVec3, f64) {
    let pose = rig.projector_from_camera;
    let back = pose.matrix().transpose();
    let a = rig.camera.unproject(camera_px).unwrap().extend(1.0);
    let b = back * rig.projector.unproject(projector_px).unwrap().extend(1.0);
    let centre = -(back * pose.translation());
    let normal = a.cross(b);
    let (s, t) = (centre.cross(b).dot(normal), centre.cross(a).dot(normal));
    let (p, q) = (a * s / normal.length_squared(), centre + b * t / normal.length_squared());
    (0.5 * (p + q), p.distance(q))
}

#[test]
fn corners_of_a_real_board_are_75_mm_apart() {
    let Some(folder) = shared("kamino") else { return };
    let work = tempfile::tempdir().unwrap();
    let path = work.path().join("sequence.toml");
    std::fs::write(&path, BOARD_SEQUENCE).unwrap();
    let raw = RawFolder::read(&path).unwrap();
    let board = Board { columns: 9, rows: 7, square_mm: 75.0 };
    let view = read_board_view(&folder.join("capture_0"), &raw, &board).unwrap();
    let text = std::fs::read_to_string(folder.join("kamino_calibration.json")).unwrap();
    let rig = Calibration::from_json(&text, [1280, 1024], [1024, 768]).unwrap();
    let place = |i: usize| Some(between_rays(&rig, view.camera_px[i].into(), view.projector_px[i]?.into()));
    let points: Vec<Option<(DVec3, f64)>> = (0..board.corner_count()).map(place).collect();
    let gaps: Vec<f64> = points.iter().flatten().map(|p| p.1).collect();
    let apart = |a: usize, b: usize| Some(points[a]?.0.distance(points[b]?.0));
    let along = (0..63).filter(|i| i % 9 > 0).filter_map(|i| apart(i, i - 1));
    let spacings: Vec<f64> = along.chain((9..63).filter_map(|i| apart(i, i - 9))).collect();
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let mean_mm = mean(&spacings);
    let sd_mm = mean(&spacings.iter().map(|s| (s - mean_mm).powi(2)).collect::<Vec<_>>()).sqrt();
    println!(
        "{} of 63 corners, rays {:.2} mm apart, {} spacings: {mean_mm:.3} mm, sd {sd_mm:.3} mm",
        gaps.len(),
        mean(&gaps),
        spacings.len()
    );
    assert!(gaps.len() >= 60, "{} of 63 corners", gaps.len());
    assert!((mean_mm / 75.0 - 1.0).abs() < 0.005, "{mean_mm} mm");
    assert!(sd_mm < 1.5, "{sd_mm} mm");
}
