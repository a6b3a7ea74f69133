//! A run of the default mode through encoder and player: a shot, a refresh, and a jump to another surface.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3_codec::metrics::compare;
use gv3_codec::shot::as_scan::as_scan;
use gv3_codec::shot::encoder::ShotConfig;
use gv3_codec::shot::group::{Parts, Start, Wanted};
use gv3_codec::shot::link::Link;
use gv3_codec::shot::scan_image::ScanImage;
use gv3_codec::shot::seen_scan::SeenScan;
use gv3_codec::shot::tracked::Shown;
use gv3_codec::{EncoderConfig, Output, Player, Scan};
use gv3_tests::coded_run::CodedRun;
use gv3_tests::moving_face::{PERIOD_NANOS, scan};
use std::sync::LazyLock;

/// Tick at which another surface takes the face's place.
const JUMP: u64 = 40;
const LAST: u64 = 43;
const BOUND_MM: f64 = 0.5;

/// The face, then a hollow far behind it.
fn seen(tick: u64) -> Scan {
    let mut scan = scan(tick);
    if tick >= JUMP {
        scan.mesh.positions_mm.iter_mut().for_each(|p| p.z = -1.5 * p.z - 120.0);
    }
    scan
}

static RUN: LazyLock<CodedRun> = LazyLock::new(|| {
    let mut config = ShotConfig::new(PERIOD_NANOS);
    config.refresh_groups = 2;
    config.max_error_mm = Some(BOUND_MM);
    CodedRun::new(EncoderConfig::Shots(config), (0..=LAST).map(seen)).unwrap()
});

/// All scans as they are decoded one group after another.
static DECODED: LazyLock<Vec<Shown>> = LazyLock::new(|| {
    let steps = RUN.header.steps().unwrap();
    let (mut before, mut scans) = (None, Vec::new());
    for (i, group) in RUN.groups.iter().enumerate() {
        let parts = Parts::read(&RUN.header, &group.geometry).unwrap();
        let after = Link::after(&parts, None, before.as_ref(), i, &steps).unwrap();
        scans.extend(after.show(&parts, None, before.as_ref(), &steps, Wanted::All).unwrap());
        before = Some(after);
    }
    scans
});

fn scan_of(shown: &Shown) -> &SeenScan {
    shown.scan.as_deref().expect("scans were decoded")
}

#[test]
fn places_alone_are_those_of_the_scans() {
    let steps = RUN.header.steps().unwrap();
    let (mut before, mut placed) = (None, Vec::new());
    for (i, group) in RUN.groups.iter().enumerate() {
        let parts = Parts::read(&RUN.header, &group.geometry).unwrap();
        let after = Link::after(&parts, None, before.as_ref(), i, &steps).unwrap();
        placed.extend(after.show(&parts, None, before.as_ref(), &steps, Wanted::Places).unwrap());
        before = Some(after);
    }
    assert_eq!(placed.len(), DECODED.len());
    for (a, b) in placed.iter().zip(DECODED.iter()) {
        assert_eq!((a.stamp, a.shot, &a.placed), (b.stamp, b.shot, &b.placed));
    }
}

fn starts() -> Vec<Start> {
    RUN.groups.iter().map(|g| Parts::read(&RUN.header, &g.geometry).unwrap().start).collect()
}

fn mesh_at(player: &mut Player, nanos: u64) -> Scan {
    RUN.play(player, nanos).unwrap()
}

/// Farthest that a vertex moved between two moments of one shot, mm.
fn farthest_mm(a: &Scan, b: &Scan) -> f32 {
    assert_eq!(a.mesh.triangles, b.mesh.triangles);
    let pairs = a.mesh.positions_mm.iter().zip(&b.mesh.positions_mm);
    pairs.map(|(p, q)| p.distance(*q)).fold(0.0, f32::max)
}

#[test]
fn groups_continue_refresh_and_begin_where_they_should() {
    assert_eq!(RUN.key_ticks(), [0, 10, 20, 30, JUMP, LAST]);
    use Start::{Begins, Continues, Refreshes};
    assert_eq!(starts(), [Begins, Continues, Refreshes, Continues, Begins, Continues]);
    assert_eq!(DECODED.iter().map(|s| s.stamp.tick).collect::<Vec<_>>(), (0..=LAST).collect::<Vec<_>>());
}

#[test]
fn what_is_played_is_what_is_decoded() {
    let mut player = RUN.player_of(Output::Scan).unwrap();
    for shown in DECODED.iter() {
        let played = mesh_at(&mut player, shown.stamp.time_nanos);
        assert_eq!(played.tick, shown.stamp.tick);
        assert!(played.mesh == as_scan(&shown.model, scan_of(shown)), "tick {}", played.tick);
    }
}

#[test]
fn every_pixel_keeps_the_bound_and_none_is_missing_or_invented() {
    for shown in DECODED.iter() {
        let scan = scan_of(shown);
        let image = ScanImage::new(&seen(shown.stamp.tick), &shown.model.view, scan.placed.window);
        assert_eq!(image.mask(), scan.mask, "tick {}", shown.stamp.tick);
        for (i, across) in image.across().into_iter().enumerate().filter(|(i, _)| scan.mask[*i]) {
            let depth_mm = f64::from(scan.depth(i) - image.depth[i]) / 256.0;
            let off_mm = depth_mm.abs() * f64::from(across).sqrt();
            assert!(off_mm <= BOUND_MM + 1e-6, "tick {}, pixel {i}: {off_mm} mm", shown.stamp.tick);
        }
    }
}

#[test]
fn the_mesh_has_one_connectivity_a_shot_and_moves_without_jumps() {
    const STEP_NANOS: u64 = 1_000_000;
    let mut player = RUN.player_of(Output::Mesh).unwrap();
    let first = mesh_at(&mut player, 0);
    // The face moves at no more than 30 mm/s; lattices are quantized, and Hermite tangents overshoot a little.
    for tick in 1..JUMP - 1 {
        let at = tick * PERIOD_NANOS;
        let [before, after] = [at - STEP_NANOS / 2, at + STEP_NANOS / 2].map(|t| mesh_at(&mut player, t));
        assert_eq!(before.mesh.triangles, first.mesh.triangles);
        let step_mm = farthest_mm(&before, &after);
        assert!(step_mm < 0.2, "tick {tick}: {step_mm} mm");
    }
    let (from, to) = ((JUMP - 1) * PERIOD_NANOS, JUMP * PERIOD_NANOS);
    let later = mesh_at(&mut player, to);
    assert_ne!(later.mesh.triangles, first.mesh.triangles);
    for t in [to + STEP_NANOS, to + PERIOD_NANOS, LAST * PERIOD_NANOS] {
        assert_eq!(mesh_at(&mut player, t).mesh.triangles, later.mesh.triangles);
    }
    // The change moves the later surface's points from the earlier surface, along straight lines at an even speed.
    let change = [1, 2, 3].map(|k| mesh_at(&mut player, from + k * PERIOD_NANOS / 4));
    let (early, late) = (farthest_mm(&change[0], &change[1]), farthest_mm(&change[1], &change[2]));
    assert!((early - late).abs() < 1e-2 * early, "{early} {late}");
    assert!(farthest_mm(&mesh_at(&mut player, to - 10), &later) < 0.01);
    let begun = Scan { texture: None, ..mesh_at(&mut player, from + 10) };
    let apart = compare(&mesh_at(&mut player, from), &begun).distortion.replay_to_scan.summary();
    assert!(apart.rms < 1.0, "the change begins {} mm off the earlier surface", apart.rms);
}

#[test]
fn any_moment_decodes_alike_forwards_backwards_and_from_cold() {
    let end = LAST * PERIOD_NANOS;
    let times: Vec<u64> = (0..=30).map(|k| k * end / 30).chain([end + 1, 3 * end]).collect();
    for output in [Output::Scan, Output::Mesh] {
        let play = |times: &mut dyn Iterator<Item = &u64>| -> Vec<Scan> {
            let mut player = RUN.player_of(output).unwrap();
            times.map(|t| mesh_at(&mut player, *t)).collect()
        };
        let forwards = play(&mut times.iter());
        assert!(forwards.iter().all(|s| s.mesh.validate().is_ok() && !s.mesh.triangles.is_empty()));
        let mut backwards = play(&mut times.iter().rev());
        backwards.reverse();
        let same = |a: &Scan, b: &Scan| a.mesh == b.mesh && a.texture == b.texture;
        for (k, t) in times.iter().enumerate() {
            assert!(same(&forwards[k], &backwards[k]), "{output:?} at {t} ns, backwards");
            if k % 3 == 1 {
                let cold = mesh_at(&mut RUN.player_of(output).unwrap(), *t);
                assert!(same(&forwards[k], &cold), "{output:?} at {t} ns, from cold");
            }
        }
    }
}

#[test]
fn every_group_can_be_the_first_that_is_asked_for() {
    let starts = starts();
    for (i, group) in RUN.groups.iter().enumerate() {
        let mut asked = Vec::new();
        let mut player = RUN.player_of(Output::Scan).unwrap();
        let shown = player.scan_at::<gv3_codec::CodecError>(group.key.time_nanos, &mut |k| {
            asked.push(k);
            Ok((RUN.groups[k].geometry.clone(), RUN.groups[k].texture.clone()))
        });
        let known = DECODED.iter().find(|s| s.stamp == group.key).unwrap();
        assert!(shown.unwrap().mesh == as_scan(&known.model, scan_of(known)), "group {i}");
        // The scans between move the base of the group before.
        let base = (0..i.max(1)).rev().find(|k| starts[*k] != Start::Continues).unwrap();
        assert!(asked.iter().all(|k| (base..=i).contains(k)), "group {i}: {asked:?}");
    }
}
