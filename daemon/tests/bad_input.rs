//! What people and disks do to files: each case ends in a clear error or a repair that is said, never in half a file.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod common;

use common::moving_face::{closed, scan, write_scans};
use common::{Place, Run};
use gv3::files::ExportFormat;
use gv3::files::picture::PictureFormat;
use gv3_codec::Scan;
use gv3_codec::mesh::TriMesh;
use gv3_protocol::session::{GroupRecord, MetadataGroup, SessionFile, SessionReader, SessionWriter, key};

/// A place with the first scans of the moving face in `scans/`.
fn scans(count: u64) -> Place {
    let place = Place::new();
    write_scans(&place.path("scans"), ExportFormat::Obj, (0..count).map(scan));
    place
}

/// A place with a session `face.gv3` of 12 scans and three keyframes.
fn session() -> Place {
    let place = scans(12);
    place.gv3("encode scans -o face.gv3").done();
    place
}

/// Replaces the mesh of a scan by the text of an OBJ file.
fn put_obj(place: &Place, tick: u64, text: &str) {
    place.write(&format!("scans/frame_{tick:04}.obj"), text);
}

/// Text of a scan's OBJ file.
fn obj(place: &Place, tick: u64) -> String {
    String::from_utf8(place.read(&format!("scans/frame_{tick:04}.obj"))).unwrap()
}

/// Runs a command that must fail with `parts` in its message and leave the folder as it was.
#[track_caller]
fn fails(place: &Place, arguments: &str, parts: &[&str]) {
    let before = place.names();
    place.gv3(arguments).failed(parts);
    assert_eq!(place.names(), before, "left behind by {arguments}");
}

fn notes(report: &serde_json::Value) -> Vec<&str> {
    report["notes"].as_array().unwrap().iter().map(|n| n.as_str().unwrap()).collect()
}

const ENCODE: &str = "encode scans -o out.gv3";
const ENCODE_JSON: &str = "encode scans -o out.gv3 --json";

#[test]
fn a_missing_picture_is_named() {
    let place = scans(3);
    std::fs::remove_file(place.path("scans/frame_0001.bmp")).unwrap();
    fails(&place, ENCODE, &["scans", "frame_0001.bmp is missing", "add the missing ones"]);
}

#[test]
fn a_damaged_picture_is_named() {
    let place = scans(3);
    let bytes = place.read("scans/frame_0001.bmp");
    place.write("scans/frame_0001.bmp", &bytes[..bytes.len() / 2]);
    fails(&place, ENCODE, &["scans/frame_0001.bmp"]);
}

#[test]
fn an_obj_without_faces_is_named() {
    let place = scans(3);
    put_obj(&place, 1, "v 0 0 0\nv 1 0 0\nv 0 1 0\n");
    fails(&place, ENCODE, &["scans/frame_0001.obj", "no triangles", "export the scan as a mesh"]);
    put_obj(&place, 1, "");
    fails(&place, ENCODE, &["scans/frame_0001.obj"]);
}

#[test]
fn coordinates_that_are_no_numbers_are_named_by_line() {
    for (word, reason) in [("nan", "not finite"), ("inf", "not finite"), ("1e99", "not finite"), ("x", "number")] {
        let place = scans(3);
        let text = obj(&place, 1);
        let line = text.lines().position(|l| l.starts_with("v ")).unwrap() + 5;
        let spoiled: Vec<String> = (text.lines().enumerate())
            .map(|(i, l)| if i == line { format!("v 1.0 {word} 2.0") } else { l.into() })
            .collect();
        put_obj(&place, 1, &spoiled.join("\n"));
        fails(&place, ENCODE, &["scans/frame_0001.obj", &format!("line {}", line + 1), reason]);
    }
}

#[test]
fn a_face_that_names_no_vertex_is_named_by_line() {
    let place = scans(2);
    let text = obj(&place, 1) + "f 1/1 2/2 99999/1\n";
    put_obj(&place, 1, &text);
    fails(&place, ENCODE, &["scans/frame_0001.obj", &format!("line {}", text.lines().count()), "99999"]);
}

/// Corner of an OBJ face as its vertex and all numbers in it, `1/1` as (1, "1/1").
fn corners(line: &str) -> Option<Vec<&str>> {
    Some(line.strip_prefix("f ")?.split_whitespace().collect())
}

#[test]
fn polygons_are_split() {
    let place = scans(1);
    let plain = place.gv3(ENCODE_JSON).json();
    // Two triangles (a b c), (a c d) in a row become the polygon a b c d.
    let (mut text, mut held, mut joined) = (String::new(), None::<Vec<String>>, 0);
    for line in obj(&place, 0).lines() {
        let own = corners(line).map(|c| c.iter().map(|s| s.to_string()).collect::<Vec<_>>());
        match (held.take(), own) {
            (Some(a), Some(b)) if a[0] == b[0] && a[2] == b[1] => {
                text += &format!("f {} {} {} {}\n", a[0], a[1], a[2], b[2]);
                joined += 1;
            }
            (a, b) => {
                text += &a.map_or(String::new(), |a| format!("f {}\n", a.join(" ")));
                text += &if b.is_none() { format!("{line}\n") } else { String::new() };
                held = b;
            }
        }
    }
    text += &held.map_or(String::new(), |a| format!("f {}\n", a.join(" ")));
    assert!(joined > 1000, "{joined} polygons");
    put_obj(&place, 0, &text);
    let split = place.gv3("encode scans -o polygons.gv3 --json").json();
    assert_eq!(split["notes"], plain["notes"]);
    place.gv3("verify polygons.gv3").done();
    assert_eq!(geometry(&place, "polygons.gv3"), geometry(&place, "out.gv3"));
}

#[test]
fn negative_indices_count_from_the_end() {
    let place = scans(1);
    place.gv3(ENCODE).done();
    let text = obj(&place, 0);
    let count = text.lines().filter(|l| l.starts_with("v ")).count() as i64;
    let from_the_end = |corner: &str| {
        let turned: Vec<_> = corner.split('/').map(|n| (n.parse::<i64>().unwrap() - count - 1).to_string()).collect();
        turned.join("/")
    };
    let turned: Vec<String> = text
        .lines()
        .map(|line| match corners(line) {
            Some(c) => format!("f {}", c.into_iter().map(from_the_end).collect::<Vec<_>>().join(" ")),
            None => line.into(),
        })
        .collect();
    put_obj(&place, 0, &turned.join("\n"));
    place.gv3("encode scans -o negative.gv3").done();
    assert_eq!(geometry(&place, "negative.gv3"), geometry(&place, "out.gv3"));
}

/// Group payloads of a session.
fn geometry(place: &Place, name: &str) -> Vec<Vec<u8>> {
    let mut reader = SessionReader::open(place.path(name)).unwrap();
    (0..reader.groups().len()).map(|i| reader.read_group(i).unwrap().geometry).collect()
}

#[test]
fn folders_without_scans_or_of_two_kinds_are_refused() {
    let place = Place::new();
    std::fs::create_dir(place.path("scans")).unwrap();
    fails(&place, ENCODE, &["scans", "no scans here", "frame_0001.obj"]);
    fails(&place, "encode nowhere -o out.gv3", &["nowhere", "No such file"]);
    let place = scans(2);
    write_scans(&place.path("ply"), ExportFormat::Ply { picture: PictureFormat::Png }, [scan(2)]);
    std::fs::rename(place.path("ply/frame_0002.ply"), place.path("scans/frame_0002.ply")).unwrap();
    fails(&place, ENCODE, &["scans", "both OBJ", "PLY", "keep one kind"]);
}

#[test]
fn one_scan_and_two_scans_are_sessions() {
    for count in [1, 2] {
        let place = scans(count);
        let report = place.gv3(ENCODE_JSON).json();
        assert_eq!((report["scans"].as_u64(), report["keyframes"].as_u64()), (Some(count), Some(count)));
        place.gv3("verify out.gv3").done();
        place.gv3("decode out.gv3 -o back").done();
        place.gv3("measure out.gv3 --against scans").done();
        assert_eq!(
            place.names().iter().filter(|n| n.starts_with("back/") && n.ends_with(".obj")).count() as u64,
            count
        );
    }
}

#[test]
fn a_closed_surface_is_refused_or_opened_on_demand() {
    let place = Place::new();
    let sphere = |tick| Scan { mesh: closed(4), ..scan(tick) };
    write_scans(&place.path("scans"), ExportFormat::Obj, (0..3).map(sphere));
    fails(&place, ENCODE, &["frame_0000.obj", "closed", "open-closed"]);
    let report = place.gv3("encode scans -o out.gv3 --open-closed --json").json();
    assert!(notes(&report).iter().any(|n| n.contains("frame_0000.obj") && n.contains("facing away")), "{report}");
    place.gv3("verify out.gv3").done();
}

/// The face with a small square beside it.
fn in_pieces(tick: u64) -> Scan {
    let mut scan = scan(tick);
    let mesh = &mut scan.mesh;
    let square = TriMesh { triangles: vec![[0, 1, 2], [0, 2, 3]], ..TriMesh::default() };
    let first = mesh.vertex_count() as u32;
    mesh.positions_mm
        .extend([[90.0, 0.0], [95.0, 0.0], [95.0, 5.0], [90.0, 5.0]].map(|[x, y]| glam::Vec3::new(x, y, 0.0)));
    mesh.uv.as_mut().unwrap().extend([[0.9, 0.5]; 4]);
    mesh.triangles.extend(square.triangles.iter().map(|t| t.map(|v| v + first)));
    scan
}

#[test]
fn the_largest_of_several_pieces_is_kept_and_the_note_says_so() {
    let place = Place::new();
    write_scans(&place.path("scans"), ExportFormat::Obj, (0..3).map(in_pieces));
    let report = place.gv3(ENCODE_JSON).json();
    assert!(
        notes(&report).iter().any(|n| n.contains("frame_0000.obj: 2 triangles of other pieces dropped")),
        "{report}"
    );
    place.gv3("verify out.gv3").done();
}

#[test]
fn a_scan_that_cannot_be_used_later_on_is_left_out_and_the_note_says_so() {
    let place = Place::new();
    let spoiled = |tick| if tick == 10 { Scan { mesh: closed(4), ..scan(tick) } } else { scan(tick) };
    write_scans(&place.path("scans"), ExportFormat::Obj, (0..13).map(spoiled));
    let report = place.gv3(ENCODE_JSON).json();
    assert!(notes(&report).iter().any(|n| n.contains("frame_0010.obj: left out")), "{report}");
    let info = place.gv3("info out.gv3 --json").json();
    assert_eq!(info["keyframes"], 3);
    assert!(info["events"][0]["message"].as_str().unwrap().contains("frame_0010.obj"), "{info}");
}

#[test]
fn places_that_cannot_be_written_are_named() {
    let place = session();
    place.write("file", "text");
    for out in ["/proc/out.gv3", "nowhere/out.gv3", "file/out.gv3"] {
        fails(&place, &format!("encode scans -o {out}"), &[out]);
        fails(&place, &format!("capture {out} --sim --seconds 0.1"), &[out]);
        fails(&place, &format!("recover face.gv3 -o {out}"), &[out]);
    }
    for out in ["/proc/out", "file", "file/out"] {
        fails(&place, &format!("decode face.gv3 -o {out}"), &[out]);
    }
    fails(&place, "encode scans -o scans --force", &["scans", "not a regular file"]);
    fails(&place, "capture scans --sim --seconds 0.1 --force", &["scans", "directory"]);
    fails(&place, "measure face.gv3 --against scans --plot nowhere/plot.svg", &["nowhere/plot.svg"]);
}

#[test]
fn a_folder_without_write_permission_is_named() {
    use std::os::unix::fs::PermissionsExt;
    let place = session();
    let closed = place.path("closed");
    std::fs::create_dir(&closed).unwrap();
    std::fs::set_permissions(&closed, std::fs::Permissions::from_mode(0o555)).unwrap();
    if std::fs::write(closed.join("probe"), "").is_ok() {
        println!("skipped: this user may write everywhere (root)");
        return;
    }
    fails(&place, "encode scans -o closed/out.gv3", &["closed/out.gv3", "Permission denied"]);
    fails(&place, "capture closed/out.gv3 --sim --seconds 0.1", &["closed/out.gv3", "Permission denied"]);
    fails(&place, "decode face.gv3 -o closed/out", &["closed/out", "Permission denied"]);
}

#[test]
fn a_full_device_is_named() {
    let place = scans(1);
    fails(&place, "capture /dev/full --sim --seconds 0.1 --force", &["/dev/full", "No space left"]);
    fails(&place, "encode scans -o /dev/full --force", &["/dev/full", "not a regular file"]);
}

/// Runs `gv3` where `small` is a file system of its own of `size_kb` that goes with the process; none where the system
/// does not let this user have one.
fn on_a_small_disk(place: &Place, size_kb: u32, arguments: &str) -> Option<(Run, String)> {
    let script = format!(
        "mount -t tmpfs -o size={size_kb}k none small || exit 99; {} {arguments}; code=$?; ls -A small >listing; exit $code",
        env!("CARGO_BIN_EXE_gv3")
    );
    let mut command = std::process::Command::new("unshare");
    command.args(["--mount", "--map-root-user", "sh", "-c", &script]).current_dir(place.path("."));
    let output = command.output().ok().filter(|o| o.status.code() != Some(99))?;
    let listing = std::fs::read_to_string(place.path("listing")).ok()?;
    Some((Run::of(output), listing))
}

#[test]
fn a_full_disk_is_named_and_nothing_half_written_stays() {
    let place = scans(60);
    place.gv3("encode scans -o face.gv3 --mode seed --keyframe-interval 1").done();
    assert!(place.read("face.gv3").len() > 200_000);
    std::fs::create_dir(place.path("small")).unwrap();
    let Some((run, listing)) =
        on_a_small_disk(&place, 128, "encode scans -o small/out.gv3 --mode seed --keyframe-interval 1")
    else {
        println!("skipped: no file system of our own here (unshare and mount)");
        return;
    };
    run.failed(&["small/out.gv3", "No space left"]);
    assert_eq!(listing, "");
    let (run, listing) = on_a_small_disk(&place, 128, "recover face.gv3 -o small/out.gv3").unwrap();
    run.failed(&["small/out.gv3", "No space left"]);
    assert_eq!(listing, "");
    let (run, listing) = on_a_small_disk(&place, 128, "decode face.gv3 -o small/out").unwrap();
    run.failed(&["small/out/frame_000", "No space left"]);
    assert_eq!(listing, "out\n");
}

#[test]
fn a_recording_on_a_full_disk_keeps_its_complete_groups() {
    let place = Place::new();
    std::fs::create_dir(place.path("small")).unwrap();
    let arguments = "capture small/out.gv3 --sim --seconds 0.4; code=$?; cp small/out.gv3 kept.gv3; (exit $code)";
    let Some((run, listing)) = on_a_small_disk(&place, 16, arguments) else {
        println!("skipped: no file system of our own here (unshare and mount)");
        return;
    };
    run.failed(&["small/out.gv3", "No space left", "complete groups are kept"]);
    assert_eq!(listing, "out.gv3\n");
    let info = place.gv3("info kept.gv3 --json").json();
    assert!(info["state"].to_string().contains("unfinished"), "{info}");
    assert!(info["keyframes"].as_u64().unwrap() >= 1);
    place.gv3("recover kept.gv3").done();
    place.gv3("verify kept.gv3").done();
}

#[test]
fn what_exists_is_replaced_only_with_force() {
    let place = session();
    let old = place.read("face.gv3");
    for command in ["encode scans -o face.gv3", "capture face.gv3 --sim --seconds 0.1", "recover face.gv3 -o face.gv3"]
    {
        fails(&place, command, &["face.gv3", "exists already", "--force"]);
        assert_eq!(place.read("face.gv3"), old, "{command}");
    }
    fails(&place, "decode face.gv3 -o scans", &["scans", "not empty", "--force"]);
    place.gv3("encode scans -o face.gv3 --force").done();
    place.gv3("recover face.gv3 -o face.gv3 --force").done();
    place.gv3("decode face.gv3 -o scans --force").done();
    place.gv3("verify face.gv3").done();
    assert!(place.names().iter().all(|n| !n.ends_with(".part")));
}

#[test]
fn a_failed_encode_leaves_the_session_that_was_there() {
    let place = session();
    let old = place.read("face.gv3");
    put_obj(&place, 7, "v 0 0 0\n");
    fails(&place, "encode scans -o face.gv3 --force", &["frame_0007.obj"]);
    assert_eq!(place.read("face.gv3"), old);
}

#[test]
fn a_truncated_session_replays_what_is_complete() {
    let place = session();
    let whole = place.read("face.gv3");
    for share in [95, 60] {
        place.write("cut.gv3", &whole[..whole.len() * share / 100]);
        let info = place.gv3("info cut.gv3").done();
        assert!(info.contains("unfinished") && info.contains("complete groups"), "{info}");
        let run = place.gv3("verify cut.gv3");
        assert_eq!(run.code, Some(1));
        assert!(
            run.stdout.contains("cut.gv3: damaged") && run.stdout.contains("gv3 recover cut.gv3"),
            "{}",
            run.stdout
        );
        place.gv3("decode cut.gv3 -o back --force").done();
    }
    place.write("cut.gv3", &whole[..400]);
    fails(&place, "info cut.gv3", &["cut.gv3", "no complete group"]);
    fails(&place, "decode cut.gv3 -o none", &["cut.gv3", "no complete group"]);
    fails(&place, "recover cut.gv3 -o none.gv3", &["cut.gv3", "nothing to recover"]);
    fails(&place, "recover cut.gv3", &["cut.gv3", "nothing to recover"]);
    assert_eq!(place.gv3("verify cut.gv3").code, Some(1));
}

#[test]
fn flipped_bits_are_found_and_never_give_wrong_scans() {
    let place = session();
    let whole = place.read("face.gv3");
    place.gv3("decode face.gv3 -o right").done();
    for at in (40..whole.len()).step_by(whole.len() / 16) {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x10;
        place.write("bad.gv3", &bytes);
        let run = place.gv3("verify bad.gv3");
        assert_eq!(run.code, Some(1), "flip at byte {at}: {run:?}");
        assert!(run.stdout.contains("bad.gv3") || run.stderr.contains("bad.gv3"), "{run:?}");
        let run = place.gv3("decode bad.gv3 -o back");
        if run.code == Some(1) {
            run.failed(&["bad.gv3"]);
        } else {
            // The flip hit bytes that replay does not need: every scan is as it was.
            let names = place.names();
            for name in names.iter().filter_map(|n| n.strip_prefix("back/")) {
                assert_eq!(place.read(&format!("back/{name}")), place.read(&format!("right/{name}")), "flip at {at}");
            }
        }
        let _ = std::fs::remove_dir_all(place.path("back"));
    }
}

/// CRC-32 (ISO-HDLC), bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg()))
    })
}

/// Checksum of the metadata group `gv3.session` of a session, with some other version in it.
fn session_checksum(reader: &SessionReader<std::fs::File>, version: &str) -> String {
    let group = reader.metadata().group(key::SESSION).unwrap();
    let mut bytes = Vec::new();
    let mut put = |text: &str| {
        bytes.extend_from_slice(&(text.len() as u32).to_le_bytes());
        bytes.extend_from_slice(text.as_bytes());
    };
    put(key::SESSION);
    for (name, value) in group.iter() {
        put(name);
        put(if name == key::FORMAT_VERSION { version } else { value });
    }
    format!("{:08x}", crc32(&bytes))
}

fn position(bytes: &[u8], what: &str) -> usize {
    bytes.windows(what.len()).position(|w| w == what.as_bytes()).unwrap()
}

#[test]
fn a_session_of_a_newer_version_asks_for_an_update() {
    let place = session();
    let mut bytes = place.read("face.gv3");
    let reader = SessionReader::open(place.path("face.gv3")).unwrap();
    let checksum = position(&bytes, &session_checksum(&reader, "1"));
    bytes[checksum..checksum + 8].copy_from_slice(session_checksum(&reader, "9").as_bytes());
    let version = position(&bytes, key::FORMAT_VERSION) + key::FORMAT_VERSION.len() + 4;
    bytes[version] = b'9';
    place.write("newer.gv3", &bytes);
    for command in ["info", "verify", "decode -o back", "recover -o back.gv3", "measure --against scans"] {
        let (verb, rest) = command.split_once(' ').unwrap_or((command, ""));
        fails(&place, &format!("{verb} newer.gv3 {rest}"), &["newer.gv3", "newer version", "format 9", "update gv3"]);
    }
}

#[test]
fn a_stream_of_a_newer_version_asks_for_an_update() {
    let place = session();
    let mut reader = SessionReader::open(place.path("face.gv3")).unwrap();
    let mut stream = reader.read_stream(0).unwrap();
    stream[0] += 1;
    let file = SessionFile::create(place.path("newer.gv3"), false).unwrap();
    let metadata = gv3_protocol::session::SessionMetadata::new("seed", "a later gv3", 0);
    let mut writer = SessionWriter::create(file, &metadata).unwrap();
    writer.write_stream(&stream).unwrap();
    let group = reader.read_group(0).unwrap();
    let record = GroupRecord {
        first_tick: 0,
        key_tick: 0,
        time_nanos: 0,
        geometry: &group.geometry,
        texture: group.texture.as_deref(),
        events: &[],
    };
    writer.write_group(record).unwrap();
    writer.finish(&MetadataGroup::new()).unwrap();
    for command in ["info newer.gv3", "decode newer.gv3 -o back", "measure newer.gv3 --against scans"] {
        fails(&place, command, &["newer.gv3", "newer than 2", "update gv3"]);
    }
    let run = place.gv3("verify newer.gv3");
    assert_eq!(run.code, Some(1));
    assert!(run.stdout.contains("update gv3") && !run.stdout.contains("recover"), "{}", run.stdout);
}

#[test]
fn what_is_no_session_is_refused() {
    let place = scans(1);
    place.write("empty.gv3", "");
    place.write("text.gv3", "v 0 0 0\nf 1 2 3\n".repeat(100));
    std::fs::rename(place.path("scans/frame_0000.bmp"), place.path("picture.gv3")).unwrap();
    for name in ["empty.gv3", "text.gv3", "picture.gv3", "scans", "/dev/null"] {
        for command in ["info", "verify", "recover", "decode -o back", "recover -o back.gv3", "measure --against scans"]
        {
            let (verb, rest) = command.split_once(' ').unwrap_or((command, ""));
            fails(&place, &format!("{verb} {name} {rest}"), &[name, "not a gv3 session"]);
        }
    }
}

#[test]
fn a_missing_session_is_named() {
    let place = scans(1);
    for command in ["info", "verify", "recover", "decode -o back", "recover -o back.gv3", "measure --against scans"] {
        let (verb, rest) = command.split_once(' ').unwrap_or((command, ""));
        fails(&place, &format!("{verb} nowhere.gv3 {rest}"), &["nowhere.gv3", "No such file"]);
    }
}

#[test]
fn what_lies_outside_the_session_is_named() {
    let place = session();
    fails(&place, "decode face.gv3 -o back --times 0,9", &["--times", "9 s is outside", "0.367 s"]);
    fails(&place, "decode face.gv3 -o back --scans 50..60", &["--scans", "0 to 11"]);
    write_scans(&place.path("other"), ExportFormat::Obj, [scan(0)]);
    std::fs::create_dir(place.path("none")).unwrap();
    fails(&place, "measure face.gv3 --against none", &["none", "no scans here"]);
}

const BOARD_RIG: &str = "[camera]
width_px = 96
height_px = 72
fx_px = 150.0
fy_px = 150.0
cx_px = 48.0
cy_px = 36.0
[projector]
width_px = 96
height_px = 72
fx_px = 150.5
fy_px = 150.5
cx_px = 48.0
cy_px = 36.0
[projector_from_camera]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
translation_mm = [-100.0, 0.0, 0.0]
";

/// A place with pattern pictures as a capture in `board/`, its sequence, and a calibration for their size in `rig.toml`.
fn board() -> Place {
    let place = Place::new();
    place.gv3("patterns multi-frequency --size 96x72 --period 12 --ratio 4 --steps 4 -o board").done();
    place.gv3("patterns white-black --size 96x72 -o flat").done();
    place.write("rig.toml", BOARD_RIG);
    place
}

const RECONSTRUCT: &str = "reconstruct board --sequence board/sequence.toml --calibration rig.toml -o scan";

#[test]
fn a_pattern_picture_that_cannot_be_is_named() {
    let place = board();
    // Every camera pixel sees the projector's pixel of its own number: nothing is within reach, but every step is done.
    fails(&place, RECONSTRUCT, &["board: no surface", "rejected pixels", "saturated"]);
    let (white, black) = (place.read("flat/pattern_000.png"), place.read("flat/pattern_001.png"));
    for (name, bytes, parts) in [
        ("pattern_002.png", &black, ["board/pattern_002.png", "all black"]),
        ("pattern_003.png", &white, ["board/pattern_003.png", "all saturated"]),
        ("pattern_009.png", &white[..40].to_vec(), ["board/pattern_009.png", "png"]),
    ] {
        let good = place.read(&format!("board/{name}"));
        place.write(&format!("board/{name}"), bytes);
        fails(&place, RECONSTRUCT, &parts);
        fails(&place, &RECONSTRUCT.replacen("reconstruct", "calibrate-gamma", 1), &parts);
        place.write(&format!("board/{name}"), good);
    }
    place.gv3("patterns n-step --size 48x36 -o small").done();
    place.write("board/pattern_004.png", place.read("small/pattern_000.png"));
    fails(&place, RECONSTRUCT, &["board/pattern_004.png", "48 x 36 pixels, but the pictures before it have 96 x 72"]);
    std::fs::remove_file(place.path("board/pattern_004.png")).unwrap();
    fails(&place, RECONSTRUCT, &["board/pattern_004.png", "missing", "picture 5 of"]);
}

#[test]
fn a_rig_that_does_not_fit_the_pictures_is_named() {
    let place = board();
    for (from, to, parts) in [
        ("width_px = 96\nheight_px = 72\nfx_px = 150.0", "width_px = 640\nheight_px = 480\nfx_px = 150.0", "640 x 480"),
        (
            "width_px = 96\nheight_px = 72\nfx_px = 150.5",
            "width_px = 100\nheight_px = 72\nfx_px = 150.5",
            "has 100 x 72",
        ),
        ("fx_px = 150.0", "fx_px = nan", "camera.fx_px"),
        ("fx_px = 150.5", "fx_px = -1.0", "projector.fx_px"),
        ("-100.0, 0.0", "inf, 0.0", "projector_from_camera"),
    ] {
        place.write("rig.toml", BOARD_RIG.replace(from, to));
        fails(&place, RECONSTRUCT, &[parts]);
    }
}

#[test]
fn processing_that_the_sequence_does_not_allow_is_named() {
    let place = board();
    let sequence = String::from_utf8(place.read("board/sequence.toml")).unwrap();
    for (choice, parts) in [
        ("unwrap = \"geometric\"", ["processing.unwrap", "one burst"]),
        ("motion = \"phase_rate\"", ["processing.motion", "single scan"]),
        ("gamma_file = \"nowhere.toml\"", ["board/nowhere.toml", "No such file"]),
        ("gamma_file = \"../rig.toml\"", ["rig.toml", "unknown field"]),
    ] {
        place.write("board/sequence.toml", format!("{sequence}\n[processing]\n{choice}\n"));
        fails(&place, RECONSTRUCT, &parts);
    }
    place.write("board/sequence.toml", &sequence);
    place.write("gamma.toml", "bursts = []");
    fails(&place, &format!("{RECONSTRUCT} --gamma gamma.toml"), &["no burst of period 192 px", "calibrate-gamma"]);
    place.write("gamma.toml", "[[bursts]]\nperiod_px = 16.0\nshifts_rad = [0.0]\nerror_rad = [nan]\n");
    fails(&place, &format!("{RECONSTRUCT} --gamma gamma.toml"), &["gamma.toml", "1 entries, expected 256"]);
}

#[test]
fn a_rig_that_cannot_scan_leaves_no_session() {
    let place = Place::new();
    let three = include_str!("../../config/three-pattern.toml");
    for (from, to, parts) in [
        ("period_px = 144.0", "period_px = 100.0", ["100.0 px, covers neither", "far_mm = "]),
        ("far_mm = 660.0", "far_mm = 900.0", ["555..900 mm", "take a period of"]),
        ("far_mm = 660.0", "far_mm = nan", ["depth.far_mm", "NaN"]),
        ("steps = 3", "steps = 3\ndirection = \"rows\"", ["sequence.patterns", "code Columns"]),
        ("width_px = 912", "width_px = 800", ["sequence.width_px", "912"]),
        (
            "steps = 3",
            "steps = 3\n[[sequence.patterns]]\nperiod_px = 20.0\nsteps = 3",
            ["processing.unwrap", "one burst"],
        ),
        ("unwrap = \"geometric\"", "gamma_file = \"nowhere.toml\"", ["processing.gamma_file", "nowhere.toml"]),
        ("fx_px = 1180.0", "fx_px = nan", ["camera.fx_px", "NaN"]),
    ] {
        assert!(three.contains(from), "{from}");
        place.write("rig.toml", three.replacen(from, to, 1));
        fails(&place, "capture out.gv3 --config rig.toml --seconds 0.1", &parts);
    }
}

#[test]
fn wrong_usage_gives_two_and_says_what_is_right() {
    let place = session();
    let before = place.names();
    for (arguments, part) in [
        ("", "Usage"),
        ("sing", "unrecognized subcommand"),
        ("encode scans", "--out"),
        ("encode -o out.gv3", "<INPUT>"),
        ("encode scans -o out.gv3 --fps 0", "0.001"),
        ("encode scans -o out.gv3 --fps nan", "0.001"),
        ("encode scans -o out.gv3 --keyframe-interval 0", "1..=255"),
        ("encode scans -o out.gv3 --vertex-ratio 1", "2..1000"),
        ("encode scans -o out.gv3 --texture-quality 101", "1..=100"),
        ("encode scans -o out.gv3 --mode best", "seed"),
        ("capture out.gv3", "--config"),
        ("capture out.gv3 --sim --seconds=-1", "above 0"),
        ("capture out.gv3 --sim --seconds 0", "above 0"),
        ("decode face.gv3", "--out"),
        ("decode face.gv3 -o back --fps 30 --times 0", "cannot be used with"),
        ("decode face.gv3 -o back --scans 5..2", "A..B"),
        ("measure face.gv3", "--against"),
    ] {
        let run = place.gv3(arguments);
        assert_eq!(run.code, Some(2), "{arguments}: {run:?}");
        assert!(run.stdout.is_empty() && run.stderr.contains(part), "{arguments}: {}", run.stderr);
    }
    assert_eq!(place.names(), before);
}
