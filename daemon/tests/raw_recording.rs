//! Raw recordings by the commands: capture, info, verify, replay, scans, pictures.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::Place;

/// Live unwrapping and that of single sets round differently: the last digits of an OBJ, and pixels at a limit.
fn assert_same_surface(a: &[u8], b: &[u8]) {
    let bounds = |obj: &[u8]| {
        let text = String::from_utf8(obj.to_vec()).unwrap();
        let rows: Vec<Vec<f64>> = text
            .lines()
            .filter_map(|line| line.strip_prefix("v "))
            .map(|line| line.split(' ').map(|x| x.parse().unwrap()).collect())
            .collect();
        let mean = |axis: usize| rows.iter().map(|r| r[axis]).sum::<f64>() / rows.len() as f64;
        (rows.len() as f64, [0, 1, 2].map(mean))
    };
    let ((count, mean_mm), (other_count, other_mean_mm)) = (bounds(a), bounds(b));
    assert!(count > 100_000.0 && (count - other_count).abs() < 20.0, "{count} and {other_count} vertices");
    for (x, y) in mean_mm.iter().zip(&other_mean_mm) {
        assert!((x - y).abs() < 0.02, "{mean_mm:?} and {other_mean_mm:?}");
    }
}

#[test]
fn a_recording_goes_through_every_command() {
    let place = Place::new();
    let report = place.gv3("capture --sim --seconds 0.1 --raw raw --json").json();
    assert_eq!((report["raw"]["pictures"].as_u64(), report["sets"]["frame_sets"].as_u64()), (Some(18), Some(3)));
    let info = place.gv3("info raw --json").json();
    assert_eq!((info["pictures"].as_u64(), info["missing_pictures"].as_u64()), (Some(18), Some(0)));
    assert!(place.gv3("verify raw").done().starts_with("raw: intact; 18 pictures"));
    place.gv3("capture --sim --raw raw --seconds 0.1").failed(&["raw: not empty"]);
    // Scans of the recording are those of its exported pictures.
    assert!(place.gv3("reconstruct raw -o scans").done().starts_with("scans: 3 scans"));
    let pictures = place.gv3("export-raw raw -o pictures --sets 1..1 --json").json();
    assert_eq!((pictures["sets"].as_u64(), pictures["pictures"].as_u64()), (Some(1), Some(6)));
    place
        .gv3("reconstruct pictures/set_0001 --sequence pictures/sequence.toml --calibration pictures/calibration.toml -o one")
        .done();
    assert_same_surface(&place.read("one/frame_0000.obj"), &place.read("scans/frame_0001.obj"));
    place.gv3("export-raw raw -o none --sets 7..9").failed(&["raw: no complete frame set in that range"]);
    place.gv3("reconstruct scans -o again").failed(&["scans: no raw recording", "--sequence and --calibration"]);
    // Cut off: said so, and played to its last whole picture.
    let bytes = place.read("raw/pictures_000000.gv3raw");
    std::fs::write(place.path("raw/pictures_000000.gv3raw"), &bytes[..bytes.len() * 9 / 10]).unwrap();
    let verified = place.gv3("verify raw");
    assert!(verified.code == Some(1) && verified.stdout.starts_with("raw: damaged"), "{verified:?}");
    assert!(place.gv3("capture cut.gv3 --from-raw raw").done().starts_with("cut.gv3: 2 scans"));
    std::fs::write(place.path("raw/pictures_000000.gv3raw"), &bytes[..bytes.len() - 72]).unwrap();
    assert!(place.gv3("verify raw").stdout.starts_with("raw: cut off"));
    place.gv3("capture x.gv3 --from-raw nowhere").failed(&["nowhere: cannot open the folder"]);
}

#[test]
fn accuracy_reports_and_names_what_it_cannot_find() {
    let place = Place::new();
    place.gv3("capture --sim --seconds 0.07 --raw raw").done();
    place.gv3("reconstruct raw -o scans").done();
    let report = place.gv3("accuracy --noise scans --picture noise.png --json").json();
    assert_eq!(report["noise"]["scans"].as_u64(), Some(2));
    assert!(place.read("noise.png").starts_with(b"\x89PNG"));
    place.gv3("accuracy --spheres scans --diameter 80").failed(&["frame_0000.obj: a sphere of 80 mm not found"]);
    place.gv3("accuracy --plane nowhere").failed(&["nowhere"]);
    assert_eq!(place.gv3("accuracy --spheres scans").code, Some(2));
    assert_eq!(place.gv3("accuracy --plane scans --gate -1").code, Some(2));
}
