//! Surfaces of others, where they are at hand: the folder that GV3_TEST_DATA names, `../shared/data` beside the
//! workspace otherwise.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use glam::DVec2;
use gv3::files::obj::read_obj;
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
