//! The conformance vectors of FORMAT.md. `GV3_WRITE_VECTORS=1 cargo test -p gv3-codec --test vectors` writes them anew.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod bumpy_disk;
mod payloads;
mod shot_run;

use gv3_codec::bits::range_coder::{BitModel, RangeDecoder};
use gv3_codec::seed::decode_group;
use gv3_codec::shot::link::Link;
use gv3_codec::texture::decode_key_texture;
use gv3_codec::{CodecError, Mode, StreamHeader};
use jpeg_encoder::ColorType;
use payloads::shots::{Shots, Textures, invalid_group_textures, invalid_shots};
use payloads::*;
use shot_run::RUN;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// Groups are read under the header of `stream_header-example`.
const HEADER: StreamHeader = StreamHeader {
    mode: Mode::Seed { position_step_mm: 0.0625 },
    keyframe_interval: 10,
    scan_period_nanos: 33_333_333,
};

const CAMERA: [f32; 12] = [8.0, 0.0, 0.0, 320.0, 0.0, -8.0, 0.0, 240.0, 0.0, 0.0, 0.0, 1.0];

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// Kind of a vector: the part of its name before the first hyphen.
fn kind_of(name: &str) -> &str {
    name.split('-').next().unwrap_or(name)
}

/// Number of the group of shots in whose place a vector stands.
fn group_number(name: &str) -> usize {
    name.split('-').nth(1).and_then(|n| n.parse().ok()).unwrap_or_else(|| panic!("{name} has no number"))
}

/// States after the vectors of groups of shots and their textures.
static LINKS: LazyLock<Vec<Link>> = LazyLock::new(|| {
    let mut links: Vec<Link> = Vec::new();
    for (i, (group, textures)) in SHOTS.iter().zip(TEXTURES).enumerate() {
        let [group, textures] = [*group, textures].map(|n| read_hex(&folder("vectors/valid").join(format!("{n}.hex"))));
        let (_, after) = shot_run::describe_textures(&RUN.header, (i, &group), &textures, links.last()).unwrap();
        links.push(after);
    }
    links
});

/// Vectors of the textures of these groups.
const TEXTURES: [&str; 4] = ["textures-0-alone", "textures-1-predicted", "textures-2-alone", "textures-3-alone"];

/// Vectors of groups of shots, each decoded after the one before.
const SHOTS: [&str; 4] = ["shots-0-begins", "shots-1-continues", "shots-2-refreshes", "shots-3-begins"];

/// Decodes a payload and writes what it holds as text.
fn describe(name: &str, bytes: &[u8]) -> Result<String, CodecError> {
    let mut out = String::new();
    match kind_of(name) {
        "shots" => {
            let before = group_number(name).checked_sub(1).map(|b| &LINKS[b].chain);
            return shot_run::describe(&RUN.header, bytes, before).map(|(text, _)| text);
        }
        "textures" => {
            let at = group_number(name);
            let group = read_hex(&folder("vectors/valid").join(format!("{}.hex", SHOTS[at])));
            let before = at.checked_sub(1).map(|b| &LINKS[b]);
            return shot_run::describe_textures(&RUN.header, (at, &group), bytes, before).map(|(text, _)| text);
        }
        "stream_header" => {
            let h = StreamHeader::decode(bytes)?;
            writeln!(out, "mode {}\nkeyframe_interval {}", h.mode.name(), h.keyframe_interval).unwrap();
            writeln!(out, "scan_period_nanos {}", h.scan_period_nanos).unwrap();
            match h.mode {
                Mode::Seed { position_step_mm } => writeln!(out, "position_step_mm {position_step_mm}").unwrap(),
                Mode::Shots(s) => {
                    let m = s.motion;
                    writeln!(out, "turn {} shift {} lattice {:?}", m.turn, m.shift, m.lattice).unwrap();
                    writeln!(out, "patch {} control {}", s.patch, s.control).unwrap();
                    writeln!(out, "displacement {} flat {}", s.displacement, s.flat).unwrap();
                }
            }
        }
        "group" => {
            let g = decode_group(&HEADER, bytes)?;
            for s in &g.stamps {
                writeln!(out, "scan tick {} time_nanos {}", s.tick, s.time_nanos).unwrap();
            }
            writeln!(out, "before_tick {}", g.before_tick.map_or("none".into(), |t| t.to_string())).unwrap();
            for p in &g.mesh.positions_mm {
                writeln!(out, "position_mm {} {} {}", p.x, p.y, p.z).unwrap();
            }
            for [a, b, c] in &g.mesh.triangles {
                writeln!(out, "triangle {a} {b} {c}").unwrap();
            }
            for [u, v] in g.mesh.uv.iter().flatten() {
                writeln!(out, "uv {u} {v}").unwrap();
            }
            for pair in &g.landmarks {
                let weights = |p: gv3_codec::param::locate::Place| p.barycentric.map(|w| (w * 255.0).round());
                let (before, here) = (weights(pair.before), weights(pair.here));
                writeln!(out, "before triangle {} weights_255 {before:?}", pair.before.triangle).unwrap();
                writeln!(out, "here triangle {} weights_255 {here:?}", pair.here.triangle).unwrap();
            }
        }
        "texture" => {
            let p = decode_key_texture(bytes)?;
            writeln!(out, "size_px {} {}", p.width_px, p.height_px).unwrap();
            for row in p.pixels.chunks_exact(p.width_px as usize) {
                let row: Vec<String> = row.iter().map(u8::to_string).collect();
                writeln!(out, "grey {}", row.join(" ")).unwrap();
            }
        }
        other => panic!("vectors of kind {other} are not known"),
    }
    Ok(out)
}

fn valid() -> Vec<(&'static str, Payload)> {
    let group = Group::default();
    let first = Group { before: 0, landmarks: Section::Of(vec![0]), ..group.clone() };
    let triangle = Group {
        counts: [3, 3, 1],
        letters: Section::Of(vec![2]),
        positions: Section::Of(vec![1, 20, 4, 5, 0, 0, 0, 9, 9, 9]),
        uv: Uv::None,
        ..first.clone()
    };
    let shots = SHOTS.iter().enumerate().map(|(i, name)| (*name, Shots::of_run(i).payload()));
    let others = vec![
        ("stream_header-example", Header::default().payload()),
        (
            "stream_header-least",
            Header { interval: 1, period: vec![1], step_mm: 2f32.powi(-20), ..Header::default() }.payload(),
        ),
        (
            "stream_header-most",
            Header { interval: 255, period: varint(1_000_000_000_000), step_mm: 1024.0, ..Header::default() }.payload(),
        ),
        ("stream_header-shots", shots_header([2, 4, 38, 77, 100, 64, 38, 10])),
        ("stream_header-shots-most", shots_header([4096; 8])),
        ("group-coded-uv", group.payload()),
        ("group-camera-uv", Group { uv: Uv::Camera(CAMERA), ..group.clone() }.payload()),
        ("group-without-uv", Group { uv: Uv::None, ..first.clone() }.payload()),
        ("group-one-triangle", triangle.payload()),
        ("texture-whole", texture([16, 16, 0, 0], jpeg(16, 16, ColorType::Luma, false))),
        ("texture-crop", texture([16, 16, 5, 7], jpeg(9, 8, ColorType::Luma, false))),
    ];
    let textures = TEXTURES.iter().enumerate().map(|(i, name)| (*name, Textures::of_run(i).payload()));
    others.into_iter().chain(shots).chain(textures).collect()
}

/// Name, payload, what the error must say.
type Invalid = (&'static str, Payload, &'static str);

fn invalid_headers() -> Vec<Invalid> {
    let h = Header::default;
    let mut long = h().payload();
    long.push(("one byte more", vec![0]));
    vec![
        ("stream_header-version-0", Header { version: 0, ..h() }.payload(), "stream header, byte 2: format version 0"),
        ("stream_header-version-3", Header { version: 3, ..h() }.payload(), "version 3 is newer than 2"),
        ("stream_header-mode-1", Header { mode: 1, ..h() }.payload(), "stream header, byte 2: mode 1 in version 1"),
        ("stream_header-seed-2", Header { version: 2, ..h() }.payload(), "mode 0 in version 2"),
        ("stream_header-shots-0", shots_header([2, 4, 38, 77, 0, 64, 38, 10]), "patch step is 0"),
        ("stream_header-shots-above", shots_header([2, 4, 38, 77, 100, 64, 38, 4097]), "flatness is 4097"),
        ("stream_header-interval-0", Header { interval: 0, ..h() }.payload(), "keyframe interval is 0"),
        ("stream_header-period-0", Header { period: vec![0], ..h() }.payload(), "scan period is 0 ns"),
        ("stream_header-period-above", Header { period: varint(1_000_000_000_001), ..h() }.payload(), "scan period is"),
        ("stream_header-period-padded", Header { period: vec![0x80, 0], ..h() }.payload(), "longer than it need be"),
        (
            "stream_header-period-65-bits",
            Header { period: [vec![0xff; 9], vec![2]].concat(), ..h() }.payload(),
            "more than 64 bits",
        ),
        ("stream_header-step-0", Header { step_mm: 0.0, ..h() }.payload(), "position step is 0 mm"),
        ("stream_header-step-negative", Header { step_mm: -1.0, ..h() }.payload(), "position step is -1 mm"),
        ("stream_header-step-above", Header { step_mm: 1025.0, ..h() }.payload(), "position step is 1025 mm"),
        ("stream_header-step-nan", Header { step_mm: f32::NAN, ..h() }.payload(), "not finite"),
        ("stream_header-long", long, "1 bytes too many"),
    ]
}

fn invalid_stamps() -> Vec<Invalid> {
    let g = Group::default;
    let late = (1u64 << 40) + 1;
    vec![
        ("group-scans-0", Group { scan_count: 0, scans: vec![], ..g() }.payload(), "a group without scans"),
        ("group-scans-above", Group { scan_count: 65_537, ..g() }.payload(), "scan count is 65537"),
        ("group-tick-again", Group { scans: vec![(3, 0), (0, 5)], ..g() }.payload(), "tick 3 does not follow"),
        ("group-tick-above", Group { scans: vec![(3, 0), (late - 1, 0)], ..g() }.payload(), "does not follow"),
        ("group-tick-step-above", Group { scans: vec![(late, 0), (7, 0)], ..g() }.payload(), "tick step is"),
        (
            "group-time-again",
            Group { scans: vec![(3, 0), (1, -33_333_333)], ..g() }.payload(),
            "time 99999999 ns does not follow",
        ),
        (
            "group-time-negative",
            Group { scans: vec![(0, -1), (7, 0)], before: 0, ..g() }.payload(),
            "a time out of range",
        ),
        ("group-time-above", Group { scans: vec![(3, i64::MAX), (7, 0)], ..g() }.payload(), "a time out of range"),
        ("group-before-not-before", Group { before: 4, ..g() }.payload(), "does not lie before"),
        ("group-before-above", Group { before: late + 1, ..g() }.payload(), "tick of the keyframe before is"),
    ]
}

fn invalid_connectivity() -> Vec<Invalid> {
    let g = Group::default;
    let of = |counts: [u64; 3], letters: &[u8]| Group { counts, letters: Section::Of(letters.into()), ..g() }.payload();
    let thrice = Group {
        counts: [5, 4, 4],
        letters: Section::Of(vec![0, 1, 3, 2]),
        positions: Section::Of([vec![1], vec![0; 15]].concat()),
        uv: Uv::None,
        ..g()
    };
    let thrice = thrice.payload();
    vec![
        ("group-vertices-above", of([(1 << 18) + 1, 6, 6], &LETTERS), "vertex count is 262145"),
        ("group-border-above", of([7, 8, 4], &LETTERS), "border count is 8"),
        ("group-border-2", of([4, 2, 4], &[2; 4]), "are no disk"),
        ("group-triangles", of([7, 6, 7], &LETTERS), "are no disk"),
        ("group-letters-few", of([7, 6, 6], &LETTERS[..5]), "5 letters for 6 triangles"),
        (
            "group-letters-many",
            of([7, 6, 6], &[LETTERS[..].to_vec(), vec![2]].concat()),
            "connectivity is 7, at most 6",
        ),
        ("group-letter-5", of([7, 6, 6], &[0, 4, 1, 5, 3, 2]), "connectivity, byte 3: letter 5"),
        ("group-letters-open", of([7, 6, 6], &[0, 4, 1, 2, 3, 3]), "letters go on after"),
        ("group-letters-two-borders", of([7, 6, 6], &[0, 3, 1, 2, 3, 2]), "do not close a border of 6"),
        ("group-split-alone", of([7, 6, 6], &[0, 3, 1, 3, 4, 2]), "byte 4: a split whose loops are not closed"),
        ("group-loop-of-two", of([7, 6, 6], &[4, 0, 2, 3, 3, 2]), "byte 1: a loop of fewer than three edges"),
        ("group-border-other", of([7, 4, 8], &[0, 0, 3, 3, 3, 3, 3, 2]), "do not close a border of 4"),
        ("group-edge-of-three", thrice, "has 3 triangles"),
    ]
}

fn invalid_attributes() -> Vec<Invalid> {
    let g = Group::default;
    let positions = |bytes: Vec<u8>| Group { positions: Section::Of(bytes), ..g() }.payload();
    let mut far = POSITIONS;
    far[3][1] = 1 << 30;
    let mut uv_far = UV;
    uv_far[2][0] = 262_145;
    let padded: Vec<u8> = {
        let two = planes(&POSITIONS);
        let channels = two[1..].chunks(14).flat_map(|c| [c.to_vec(), vec![0; 7]].concat());
        std::iter::once(3).chain(channels).collect()
    };
    let frame = zstd::bulk::compress(&LETTERS, 1).unwrap();
    let raw = |length: u8, coded: &[u8]| {
        let bytes = [&[length, coded.len() as u8], coded].concat();
        Group { letters: Section::Raw(bytes), ..g() }.payload()
    };
    let mut nan = CAMERA;
    nan[5] = f32::NAN;
    let mut flat = CAMERA;
    flat[11] = 0.0;
    let camera = |m| Group { uv: Uv::Camera(m), ..g() }.payload();
    vec![
        ("group-planes-0", positions([vec![0], vec![0; 42]].concat()), "positions, byte 1: 0 byte planes"),
        ("group-planes-5", positions([vec![5], vec![0; 42]].concat()), "positions, byte 1: 5 byte planes"),
        (
            "group-planes-short",
            positions(planes(&POSITIONS)[..42].into()),
            "positions, byte 1: 42 bytes wanted, 41 left",
        ),
        (
            "group-planes-long",
            positions([planes(&POSITIONS), vec![0]].concat()),
            "positions, byte 43: 1 bytes too many",
        ),
        ("group-planes-padded", positions(padded), "3 byte planes where fewer hold"),
        ("group-positions-long", positions(vec![1; 86]), "positions is 86, at most 85"),
        ("group-position-far", positions(planes(&far)), "vertex 3 lies 2^30 steps or more"),
        ("group-frame-none", raw(6, &LETTERS), "connectivity: no zstd frame of 6 bytes"),
        ("group-frame-other-length", raw(5, &frame), "connectivity: no zstd frame of 5 bytes"),
        ("group-frame-two", raw(6, &[&frame[..], &frame].concat()), "not one whole zstd frame"),
        ("group-frame-cut", raw(6, &frame[..frame.len() - 1]), "not one whole zstd frame"),
        ("group-uv-kind-3", Group { uv: Uv::Kind(3), ..g() }.payload(), "texture coordinates of kind 3"),
        ("group-uv-width-0", Group { size_px: [0, 480], ..g() }.payload(), "a texture of 0x480 pixels"),
        ("group-uv-height-above", Group { size_px: [640, 8193], ..g() }.payload(), "a texture of 640x8193 pixels"),
        (
            "group-uv-far",
            Group { uv: Uv::Coded(uv_far.into()), ..g() }.payload(),
            "a texture coordinate is out of range",
        ),
        (
            "group-uv-short",
            Group { uv_section: Some(Section::Of(planes(&UV)[..28].into())), ..g() }.payload(),
            "texture coordinates, byte 1: 28 bytes wanted, 27 left",
        ),
        ("group-camera-nan", camera(nan), "not finite"),
        ("group-camera-infinite", camera(flat), "the camera sends a vertex out of range"),
        ("group-camera-far", camera(CAMERA.map(|m| m * if m == 8.0 { 3000.0 } else { 1.0 })), "a vertex out of range"),
    ]
}

fn invalid_landmarks() -> Vec<Invalid> {
    let g = Group::default;
    let marks = |bytes: &[u8]| Group { landmarks: Section::Of(bytes.into()), ..g() }.payload();
    let mut long = g().payload();
    long.push(("one byte more", vec![0]));
    vec![
        ("group-landmarks-above", marks(&[0x81, 0x08]), "landmark count is 1025"),
        ("group-landmarks-long", marks(&vec![0; 12_291]), "landmarks is 12291, at most 12290"),
        ("group-landmark-here", marks(&[1, 0, 255, 0, 6, 255, 0]), "landmarks, byte 4: triangle is 6, at most 5"),
        (
            "group-landmark-before",
            marks(&[1, 0x80, 0x80, 0x80, 0x04, 255, 0, 0, 255, 0]),
            "landmarks, byte 1: triangle is 8388608",
        ),
        ("group-landmark-weights", marks(&[1, 0, 255, 1, 0, 255, 0]), "add up to more than one"),
        ("group-landmark-cut", marks(&LANDMARKS[..7]), "landmarks, byte 7: 1 bytes wanted, 0 left"),
        ("group-landmark-more", marks(&[&LANDMARKS[..], &[0]].concat()), "landmarks, byte 8: 1 bytes too many"),
        ("group-landmarks-alone", Group { before: 0, ..g() }.payload(), "landmarks without a keyframe before"),
        ("group-long", long, "1 bytes too many"),
    ]
}

fn invalid_textures() -> Vec<Invalid> {
    let grey = jpeg(8, 8, ColorType::Luma, false);
    let patched = |from: [u8; 2], to: [u8; 2]| {
        let mut bytes = grey.clone();
        let at = bytes.windows(2).position(|w| w == from).unwrap();
        bytes[at..at + 2].copy_from_slice(&to);
        texture([16, 16, 0, 0], bytes)
    };
    let end = grey.len();
    vec![
        ("texture-width-0", texture([0, 16, 0, 0], grey.clone()), "0x16 pixels"),
        ("texture-height-above", texture([16, 8193, 0, 0], grey.clone()), "16x8193 pixels"),
        ("texture-crop-right", texture([16, 16, 9, 0], grey.clone()), "a crop of 8x8 at 9,0 does not fit"),
        ("texture-crop-below", texture([16, 16, 0, 65_535], grey.clone()), "a crop of 8x8 at 0,65535 does not fit"),
        ("texture-colour", texture([16, 16, 0, 0], jpeg(8, 8, ColorType::Rgb, false)), "not one grey component"),
        ("texture-progressive", texture([16, 16, 0, 0], jpeg(8, 8, ColorType::Luma, true)), "JPEG: marker 0xc2"),
        ("texture-no-start", patched([0xff, 0xd8], [0xff, 0xd9]), "no start of image"),
        ("texture-no-marker", patched([0xff, 0xdb], [0xfe, 0xdb]), "where a marker belongs"),
        ("texture-comment", patched([0xff, 0xe0], [0xff, 0xfe]), "JPEG: marker 0xfe"),
        ("texture-no-frame", patched([0xff, 0xc0], [0xff, 0xe0]), "a scan without a frame"),
        ("texture-no-end", texture([16, 16, 0, 0], grey[..end - 2].to_vec()), "1 bytes wanted, 0 left"),
        ("texture-long", texture([16, 16, 0, 0], [&grey[..], &[0]].concat()), "1 bytes too many"),
        ("texture-two", texture([16, 16, 0, 0], [&grey[..], &grey].concat()), "bytes too many"),
    ]
}

fn invalid() -> Vec<Invalid> {
    let groups = [invalid_stamps(), invalid_connectivity(), invalid_attributes(), invalid_landmarks()].concat();
    [invalid_headers(), groups, invalid_textures(), invalid_shots(&LINKS[0].chain), invalid_group_textures()].concat()
}

fn write_hex(path: &Path, payload: &Payload) {
    let mut text = String::new();
    for (label, bytes) in payload {
        for (line, part) in bytes.chunks(32).enumerate() {
            let hex: String = part.iter().map(|b| format!("{b:02x}")).collect();
            writeln!(text, "{hex}{}", if line == 0 { format!("  # {label}") } else { String::new() }).unwrap();
        }
    }
    std::fs::write(path, text).unwrap();
}

/// Hex digits in pairs; `#` begins a comment.
fn read_hex(path: &Path) -> Vec<u8> {
    let text = std::fs::read_to_string(path).unwrap();
    let digits: String = text.lines().flat_map(|l| l.split('#').next().unwrap_or("").split_whitespace()).collect();
    (0..digits.len()).step_by(2).map(|i| u8::from_str_radix(&digits[i..i + 2], 16).unwrap()).collect()
}

fn write_all() {
    // Groups of shots are described after those before them.
    for (name, payload) in valid() {
        write_hex(&folder("vectors/valid").join(format!("{name}.hex")), &payload);
    }
    for (name, payload) in valid() {
        let text = describe(name, &bytes_of(&payload)).unwrap_or_else(|e| panic!("{name}: {e}"));
        std::fs::write(folder("vectors/valid").join(format!("{name}.txt")), text).unwrap();
        write_seed(name, &payload);
    }
    for (name, payload, error) in invalid() {
        write_hex(&folder("vectors/invalid").join(format!("{name}.hex")), &payload);
        std::fs::write(folder("vectors/invalid").join(format!("{name}.err")), format!("{error}\n")).unwrap();
        write_seed(name, &payload);
    }
}

/// The vector as a seed of the fuzz target of its kind.
fn write_seed(name: &str, payload: &Payload) {
    let path = folder("fuzz/corpus").join(kind_of(name)).join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    // Those of runs begin with the number of the group in whose place they stand.
    let number = ["shots", "textures"].contains(&kind_of(name)).then(|| group_number(name) as u8);
    std::fs::write(path, number.into_iter().chain(bytes_of(payload)).collect::<Vec<u8>>()).unwrap();
    // A keyframe's picture alone, as a grey one without sources, with one and with two.
    if let Some((_, picture)) = payload.get(1).filter(|_| kind_of(name) == "textures") {
        let path = folder("fuzz/corpus/coded_texture").join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let kind = (group_number(name) as u8 % 3) << 1;
        std::fs::write(path, [&[kind], &picture[..]].concat()).unwrap();
    }
}

/// Name, bytes and companion text of every vector in a folder, in the order of names.
fn read_all(name: &str, companion: &str) -> Vec<(String, Vec<u8>, String)> {
    static WRITTEN: std::sync::Once = std::sync::Once::new();
    WRITTEN.call_once(|| {
        if std::env::var_os("GV3_WRITE_VECTORS").is_some() {
            write_all();
        }
    });
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder(name)).unwrap().map(|e| e.unwrap().path()).collect();
    paths.retain(|p| p.extension().is_some_and(|e| e == "hex"));
    paths.sort();
    paths
        .iter()
        .map(|p| {
            let stem = p.file_stem().unwrap().to_str().unwrap().to_owned();
            (stem, read_hex(p), std::fs::read_to_string(p.with_extension(companion)).unwrap())
        })
        .collect()
}

/// Equal texts; grey levels may differ by 2, as T.81 leaves the inverse transform's rounding open.
fn agree(found: &str, wanted: &str) -> bool {
    let close = |(a, b): (&str, &str)| match (a.parse::<i32>(), b.parse::<i32>()) {
        (Ok(a), Ok(b)) => a.abs_diff(b) <= 2,
        _ => a == b,
    };
    let same = |(a, b): (&str, &str)| a == b || a.starts_with("grey ") && a.split(' ').zip(b.split(' ')).all(close);
    found.lines().count() == wanted.lines().count() && found.lines().zip(wanted.lines()).all(same)
}

#[test]
fn vectors_hold() {
    let vectors = read_all("vectors/valid", "txt");
    assert_eq!(vectors.len(), valid().len(), "vectors were added or dropped: write them anew");
    for (name, bytes, wanted) in &vectors {
        let found = describe(name, bytes).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert!(agree(&found, wanted), "{name}:\n{found}\nbut the vector says\n{wanted}");
    }
    let vectors = read_all("vectors/invalid", "err");
    assert_eq!(vectors.len(), invalid().len(), "vectors were added or dropped: write them anew");
    let wrong: Vec<String> = (vectors.iter())
        .filter_map(|(name, bytes, wanted)| match describe(name, bytes) {
            Err(error) if error.to_string().contains(wanted.trim()) => None,
            other => Some(format!("{name}: {other:?}\nbut should say {wanted}")),
        })
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// About as many bits of each vector of shots are flipped.
const FLIPS_OF_SHOTS: usize = 30;

/// The encoder works in floating point, but in a fixed order and without functions that differ from machine to machine.
#[test]
fn the_encoder_makes_the_vectors_of_shots_in_every_build() {
    let vectors = read_all("vectors/valid", "txt");
    let of = |kind| vectors.iter().filter(move |(name, ..)| kind_of(name) == kind);
    for (((name, group, _), (_, textures, _)), made) in of("shots").zip(of("textures")).zip(&RUN.groups) {
        let same = made.geometry == *group && made.texture.as_ref() == Some(textures);
        assert!(same, "{name}: other bytes; if they are meant to be, write the vectors anew");
    }
}

#[test]
fn every_prefix_and_one_byte_more_fail_and_no_flip_panics() {
    for (name, bytes, _) in read_all("vectors/valid", "txt") {
        for n in 0..bytes.len() {
            assert!(describe(&name, &bytes[..n]).is_err(), "{name}: {n} of {} bytes decode", bytes.len());
        }
        for more in [0, 0x55, 0xff] {
            assert!(describe(&name, &[&bytes[..], &[more]].concat()).is_err(), "{name} with {more:#04x} after it");
        }
    }
    for (name, bytes, _) in read_all("vectors/valid", "txt").into_iter().chain(read_all("vectors/invalid", "err")) {
        // A group of shots takes long to decode: some of its bits, at odd distances.
        let bits = 8 * bytes.len().min(4096);
        let stride = if ["shots", "textures"].contains(&kind_of(&name)) { (bits / FLIPS_OF_SHOTS) | 1 } else { 1 };
        for i in (0..bits).step_by(stride) {
            let mut flipped = bytes.clone();
            flipped[i / 8] ^= 1 << (i % 8);
            let _ = describe(&name, &flipped);
        }
    }
}

#[test]
fn the_page_shows_the_vectors() {
    let page = std::fs::read_to_string(folder("FORMAT.md")).unwrap();
    let shots = std::fs::read_to_string(folder("FORMAT-shots.md")).unwrap();
    for name in ["stream_header-shots", "shots-1-continues"] {
        let vector = std::fs::read_to_string(folder("vectors/valid").join(format!("{name}.hex"))).unwrap();
        assert!(shots.contains(&vector), "{name} is not on the page as it is");
    }
    let (mut reader, mut context) = (RangeDecoder::new(&[0x94], "example"), BitModel::default());
    assert_eq!([0; 3].map(|_: u8| reader.bit(&mut context)), [true, false, false]);
    assert_eq!(reader.raw(8), 0xa5);
    reader.finish().unwrap();
    for name in ["stream_header-example", "group-coded-uv"] {
        let vector = std::fs::read_to_string(folder("vectors/valid").join(format!("{name}.hex"))).unwrap();
        assert!(page.contains(&vector), "{name} is not on the page as it is");
    }
    let at = page.find("02\n409f3f").expect("the byte planes of the positions");
    let example = page[at..].split("```").next().unwrap();
    let digits: String = example.lines().flat_map(|l| l.split('#').next().unwrap_or("").split_whitespace()).collect();
    let shown: String = planes(&POSITIONS).iter().map(|b| format!("{b:02x}")).collect();
    assert_eq!(digits, shown);
}
