//! What `gv3 decode` writes: which scans, how many, and under which names.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::Place;
use common::moving_face::{scan, write_scans};
use gv3::files::{ExportFormat, ScanFolder};

/// A place with a session `face.gv3` of ticks 0 to 20 but 5 and 6.
fn session() -> Place {
    let place = Place::new();
    let scans = (0..=20).filter(|t| ![5, 6].contains(t)).map(scan);
    write_scans(&place.path("scans"), ExportFormat::Obj, scans);
    place.gv3("encode scans -o face.gv3").done();
    place
}

fn written(place: &Place, arguments: &str) -> ScanFolder {
    let _ = std::fs::remove_dir_all(place.path("back"));
    let report = place.gv3(&format!("decode face.gv3 -o back --json {arguments}")).json();
    let folder = ScanFolder::open(&place.path("back")).unwrap();
    assert_eq!(report["files"], folder.len());
    folder
}

#[test]
fn original_times_keep_their_ticks_as_numbers() {
    let place = session();
    let scans = written(&place, "");
    let ticks: Vec<u64> = (0..scans.len()).map(|i| scans.tick(i)).collect();
    assert_eq!(ticks, (0..=20).filter(|t| ![5, 6].contains(t)).collect::<Vec<_>>());
    assert!(scans.has_pictures());
    assert_eq!(scans.name(5), "frame_0007.obj");
    assert_eq!(written(&place, "--scans 4..8").len(), 3);
}

#[test]
fn the_number_of_scans_grows_with_the_rate() {
    let place = session();
    let length_s = 20.0 / 30.0;
    let mut before = 0;
    for fps in [0.5, 1.4, 10.0, 29.0, 30.0, 45.0, 60.0, 120.0] {
        let count = written(&place, &format!("--fps {fps}")).len();
        assert_eq!(count, (length_s * fps + 1e-6) as usize + 1, "{fps} scans a second");
        assert!(count >= before);
        before = count;
    }
}

#[test]
fn the_same_time_gives_the_same_files_however_it_is_asked_for() {
    let place = session();
    let at_rate = written(&place, "--fps 15 --format ply");
    let mesh = place.read(&format!("back/{}", at_rate.name(5)));
    let picture = place.read("back/frame_0005.png");
    let asked = written(&place, "--times 0.333333333 --format ply");
    assert_eq!(asked.name(0), "frame_0000.ply");
    assert_eq!(without_texture_name(&place.read("back/frame_0000.ply")), without_texture_name(&mesh));
    assert_eq!(place.read("back/frame_0000.png"), picture);
}

#[test]
fn the_tracked_mesh_of_a_shot_is_one_gltf_file_that_moves_and_a_scan_is_a_still() {
    let place = session();
    let report = place.gv3("decode face.gv3 -o clips --as mesh --format gltf --json").json();
    assert_eq!((report["scans"].as_u64(), report["files"].as_u64()), (Some(19), Some(1)), "{report}");
    let bytes = place.read("clips/frame_0000.glb");
    assert_eq!(report["bytes"], bytes.len());
    let clip = gltf::Gltf::from_slice_without_validation(&bytes).unwrap();
    let primitive = clip.meshes().next().unwrap().primitives().next().unwrap();
    assert_eq!(primitive.morph_targets().count(), 18);
    let times = clip.animations().next().unwrap().channels().next().unwrap().sampler().input();
    let last = times.max().unwrap()[0].as_f64().unwrap();
    assert!((last - 20.0 / 30.0).abs() < 1e-3, "{last} s, with the gap");
    assert_eq!(clip.images().count(), 1);
    let report = place.gv3("decode face.gv3 -o stills --as scan --format glb --scans 0..2 --json").json();
    assert_eq!(report["files"], 3);
    let still = gltf::Gltf::from_slice_without_validation(&place.read("stills/frame_0002.glb")).unwrap();
    assert_eq!((still.animations().count(), still.images().count()), (0, 1));
    place
        .gv3("decode face.gv3 -o many --as mesh --format gltf --fps 1000")
        .failed(&["the most that an animation holds"]);
    assert!(!place.path("many/frame_0000.glb").exists());
}

/// A PLY file from its first element on.
fn without_texture_name(ply: &[u8]) -> &[u8] {
    let at = ply.windows(8).position(|w| w == b"element ").unwrap();
    &ply[at..]
}
