//! `gv3 encode --landmarks`: given landmarks match what cannot be tracked.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::{Place, moving_face};
use gv3::files::ExportFormat;
use gv3_codec::Scan;

const SCANS: u64 = 21;

/// The face without texture, swinging 12 mm from keyframe to keyframe; vertices keep their numbers.
fn bare_scan(tick: u64) -> Scan {
    let mut scan = moving_face::scan(tick);
    let swing_mm = 6.0 * (std::f32::consts::PI * tick as f32 / 10.0).cos();
    scan.mesh.positions_mm.iter_mut().for_each(|p| p.x += swing_mm);
    (scan.mesh.uv, scan.texture) = (None, None);
    scan
}

fn place_with_scans() -> Place {
    let place = Place::new();
    let format = ExportFormat::Ply { picture: gv3::files::picture::PictureFormat::Png };
    moving_face::write_scans(&place.path("scans"), format, (0..SCANS).map(bare_scan));
    place
}

fn in_between_rms_mm(place: &Place, session: &str) -> f64 {
    let report = place.gv3(&format!("measure {session} --against scans --json")).json();
    report["surface_mm"]["scan_to_replay"]["in_between"]["rms"].as_f64().unwrap()
}

#[test]
fn given_landmarks_match_a_surface_without_texture() {
    let place = place_with_scans();
    let mut text = "scan,name,vertex,x,y,z\n,far off,,0,0,200\n".to_owned();
    let picked: Vec<usize> = (1..=bare_scan(0).mesh.vertex_count()).step_by(29).collect();
    picked.iter().for_each(|v| text.push_str(&format!(",v{v},{v},,,\n")));
    place.write("landmarks.csv", text);
    assert!(place.gv3("encode scans -o bare.gv3 --mode seed --json").json()["landmarks"].is_null());
    let report = place.gv3("encode scans -o given.gv3 --mode seed --landmarks landmarks.csv --json").json();
    let counts = &report["landmarks"];
    let number = |field: &str| counts[field].as_u64().unwrap();
    let count = picked.len() as u64;
    assert_eq!(number("given"), 3 * (count + 1));
    // Where a keyframe's border was trimmed, a landmark may lie beside it.
    assert!((3..3 + count / 4).contains(&number("off_surface")), "{counts}");
    assert!((3 * count / 2..=2 * count).contains(&number("paired")), "{counts}");
    assert!(report["notes"].to_string().contains("mm off the surface"), "{report}");
    let [bare_mm, given_mm] = ["bare.gv3", "given.gv3"].map(|session| in_between_rms_mm(&place, session));
    assert!(given_mm < 0.9 * bare_mm, "{given_mm} mm with landmarks, {bare_mm} mm without");
}

#[test]
fn landmarks_that_cannot_be_used_are_named_and_nothing_is_written() {
    let place = place_with_scans();
    let cases = [
        ("scan,name,vertex,x,y,z\n0,nose,,1,x,3\n", "line 2: y: \"x\""),
        ("scan,name,vertex,x,y,z\n99,nose,,1,2,3\n", "numbered 0 to 20"),
        ("scan,name,vertex,x,y,z\n,nose,99999,,,\n", "landmark \"nose\", vertex: 99999"),
        ("name,x,y,z\nnose,1,2,3\n", "expected the header scan,name,vertex,x,y,z"),
    ];
    for (text, message) in cases {
        place.write("landmarks.csv", text);
        place.gv3("encode scans -o face.gv3 --mode seed --landmarks landmarks.csv").failed(&["landmarks.csv", message]);
        assert!(!place.path("face.gv3").exists());
    }
    place.gv3("encode scans -o face.gv3 --mode seed --landmarks none.csv").failed(&["none.csv", "cannot open"]);
}

#[test]
fn landmarks_belong_to_the_seed_mode_and_the_default_one_says_so() {
    let place = place_with_scans();
    place.write("landmarks.csv", "scan,name,vertex,x,y,z\n,nose,5,,,\n");
    place.gv3("encode scans -o face.gv3 --landmarks landmarks.csv").failed(&["--landmarks", "--mode seed"]);
}
