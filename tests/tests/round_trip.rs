//! Scans -> encoder -> payloads -> player -> scans, on a small moving face.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3::files::picture::PictureFormat;
use gv3::files::{ExportFormat, ScanFolder};
use gv3::measure::{SessionOutput, measure};
use gv3::replay::Replay;
use gv3_codec::Scan;
use gv3_codec::metrics::compare;
use gv3_codec::seed::{self, decode_group};
use gv3_codec::{EncoderConfig, decode_stamps};
use gv3_tests::coded_run::CodedRun;
use gv3_tests::moving_face::{PERIOD_NANOS, closed, scan, write_scans};

/// Root mean square distance of a keyframe from its scan: decimation, and a border that was trimmed.
const KEY_LIMIT_MM: f64 = 0.3;

fn run(scans: impl IntoIterator<Item = Scan>) -> CodedRun {
    CodedRun::new(EncoderConfig::Seed(seed::EncoderConfig::new(PERIOD_NANOS)), scans).unwrap()
}

/// Root mean square distance of two surfaces, the larger of both ways, mm.
fn apart_mm(a: &Scan, b: &Scan) -> f64 {
    let d = compare(a, b).distortion;
    d.scan_to_replay.summary().rms.max(d.replay_to_scan.summary().rms)
}

/// Payloads of a run's groups; stamps are in the geometry's.
fn stored(run: &CodedRun) -> Vec<[Option<&[u8]>; 2]> {
    run.groups.iter().map(|g| [Some(&g.geometry[..]), g.texture.as_deref()]).collect()
}

#[test]
fn same_scans_same_bytes() {
    let (a, b) = (run((0..15).map(scan)), run((0..15).map(scan)));
    assert_eq!(a.key_ticks(), [0, 10, 14]);
    assert_eq!(stored(&a), stored(&b));
}

#[test]
fn replay_at_a_keyframe_is_the_decoded_keyframe() {
    let run = run((0..35).map(scan));
    assert_eq!(run.key_ticks(), [0, 10, 20, 30, 34]);
    let mut player = run.player().unwrap();
    for group in &run.groups {
        let key = decode_group(&run.header, &group.geometry).unwrap();
        let shown = run.play(&mut player, group.key.time_nanos).unwrap();
        assert_eq!(shown.tick, group.key.tick);
        assert_eq!(shown.mesh.triangles, key.mesh.triangles);
        for (p, q) in shown.mesh.positions_mm.iter().zip(&key.mesh.positions_mm) {
            assert!(p.distance(*q) < 1e-4, "{p} {q}");
        }
        assert!(apart_mm(&scan(group.key.tick), &shown) < KEY_LIMIT_MM, "tick {}", group.key.tick);
    }
}

#[test]
fn replay_is_continuous_inside_an_interval_and_across_a_keyframe() {
    const STEP_NANOS: u64 = 1_000_000;
    let run = run((0..31).map(scan));
    let mut player = run.player().unwrap();
    let mut apart = |nanos: u64| {
        let [a, b] = [nanos, nanos + STEP_NANOS].map(|t| run.play(&mut player, t).unwrap());
        (apart_mm(&a, &b), a.mesh.triangles == b.mesh.triangles)
    };
    // The face moves at no more than 20 mm/s; a step of a millisecond inside an interval shows that and nothing else.
    for tick in [3, 8, 12, 17, 25] {
        let (step_mm, is_same_mesh) = apart(tick * PERIOD_NANOS);
        assert!(is_same_mesh && step_mm < 0.02, "tick {tick}: {step_mm} mm");
    }
    // At a keyframe the mesh changes to one of other vertices, each a decimation of nearly the same surface.
    for tick in [10, 20] {
        let (step_mm, is_same_mesh) = apart(tick * PERIOD_NANOS - STEP_NANOS / 2);
        assert!(!is_same_mesh && step_mm < 0.15, "tick {tick}: {step_mm} mm");
    }
}

#[test]
fn a_measured_session_stays_within_bounds() {
    let folder = tempfile::tempdir().unwrap();
    let (scans, session) = (folder.path().join("scans"), folder.path().join("face.gv3"));
    write_scans(&scans, ExportFormat::Obj, (0..31).map(scan));
    run((0..31).map(scan)).write(&session).unwrap();
    let mut replay = Replay::open(&session).unwrap();
    let mut input = ScanFolder::open(&scans).unwrap();
    let mut output = SessionOutput::new(&mut replay, None).unwrap();
    let (measured, _) = measure(&mut output, &mut input, |_, _, _| Ok(()), || ()).unwrap();
    let report = measured.report(output.output(), output.replay());
    let r = &report.distortion;
    assert_eq!((r.scans, r.keyframes, measured.curve.len()), (31, 4, 31));
    assert_eq!(report.bytes.session, std::fs::metadata(&session).unwrap().len());
    assert_eq!(report.raw_bytes.obj_bmp, input.raw_bytes());
    assert!(report.percent_of_raw.obj_bmp < 0.6, "{} %", report.percent_of_raw.obj_bmp);
    let [there, back] = [&r.surface_mm.scan_to_replay, &r.surface_mm.replay_to_scan];
    assert!(there.keyframes.rms < KEY_LIMIT_MM && back.keyframes.rms < 0.1, "{there:?} {back:?}");
    // The mouth moves 3 mm up and down; a spline through keyframes a third of a second apart follows most of it.
    assert!(there.in_between.rms < 0.45 && back.in_between.rms < 0.3, "{there:?} {back:?}");
    assert!(r.coverage.missing < 0.01 && r.coverage.invented < 0.01, "{:?}", r.coverage);
    assert!(r.texture_psnr_keyframes_db.unwrap() > 28.0, "{:?}", r.texture_psnr_keyframes_db);
}

#[test]
fn the_first_good_scan_at_or_after_every_tenth_tick_is_a_keyframe() {
    let dropped = [10, 20, 21, 22, 37, 38, 39, 40, 41, 42, 43, 44, 45, 46, 47, 48, 49, 50];
    let run = run((0..54).filter(|t| !dropped.contains(t)).map(scan));
    assert_eq!(run.key_ticks(), [0, 11, 23, 30, 51, 53]);
    assert!(run.not_key.is_empty());
    let ticks: Vec<u64> = (run.groups.iter())
        .flat_map(|g| decode_stamps(&run.header, &g.geometry).unwrap())
        .map(|s| {
            assert_eq!(s.time_nanos, s.tick * PERIOD_NANOS);
            s.tick
        })
        .collect();
    assert_eq!(ticks, (0..54).filter(|t| !dropped.contains(t)).collect::<Vec<_>>());
}

#[test]
fn a_scan_that_cannot_be_a_keyframe_gives_way_to_the_next() {
    let spoiled = |tick| match tick {
        10 | 11 => Scan { mesh: closed(3), ..scan(tick) },
        _ => scan(tick),
    };
    let run = run((0..21).map(spoiled));
    assert_eq!(run.not_key, [10, 11]);
    assert_eq!(run.key_ticks(), [0, 12, 20]);
    let mut player = run.player().unwrap();
    let shown = run.play(&mut player, 12 * PERIOD_NANOS).unwrap();
    assert!(apart_mm(&scan(12), &shown) < KEY_LIMIT_MM);
}

#[test]
fn a_run_needs_a_surface_to_begin_with() {
    let sphere = Scan { mesh: closed(3), ..scan(0) };
    let error =
        CodedRun::new(EncoderConfig::Seed(seed::EncoderConfig::new(PERIOD_NANOS)), [sphere]).unwrap_err().to_string();
    assert!(error.contains("closed"), "{error}");
}

#[test]
fn scans_without_texture_and_without_uv_are_coded() {
    let without_texture = |tick| Scan { texture: None, ..scan(tick) };
    let without_uv = |tick| {
        let mut bare = without_texture(tick);
        bare.mesh.uv = None;
        bare
    };
    for run in [run((0..12).map(without_texture)), run((0..12).map(without_uv))] {
        assert!(run.groups.iter().all(|g| g.texture.is_none()));
        let mut player = run.player().unwrap();
        for tick in [0, 5, 10, 11] {
            let shown = run.play(&mut player, tick * PERIOD_NANOS).unwrap();
            assert!(shown.texture.is_none());
            let limit_mm = if tick == 5 { 0.6 } else { KEY_LIMIT_MM };
            let apart = apart_mm(&scan(tick), &shown);
            assert!(apart < limit_mm, "tick {tick}: {apart} mm");
        }
    }
}

/// The scan with numbers that four decimals hold.
fn rounded(tick: u64) -> Scan {
    let to_four = |x: f32| ((f64::from(x) * 1e4).round() / 1e4) as f32;
    let mut scan = scan(tick);
    scan.mesh.positions_mm.iter_mut().for_each(|p| *p = p.to_array().map(to_four).into());
    scan.mesh.uv.iter_mut().flatten().for_each(|t| *t = t.map(to_four));
    scan
}

#[test]
fn ply_and_obj_of_the_same_numbers_give_the_same_payloads() {
    let folder = tempfile::tempdir().unwrap();
    let formats = [ExportFormat::Obj, ExportFormat::Ply { picture: PictureFormat::Png }];
    let [obj, ply] = formats.map(|format| {
        let path = folder.path().join(if format == ExportFormat::Obj { "obj" } else { "ply" });
        write_scans(&path, format, (0..12).map(rounded));
        let scans = ScanFolder::open(&path).unwrap();
        run((0..scans.len()).map(|i| scans.load(i, PERIOD_NANOS).unwrap().scan))
    });
    assert_eq!(obj.key_ticks(), [0, 10, 11]);
    assert_eq!(stored(&obj), stored(&ply));
}
