//! Every pattern scheme through the live pipeline on the simulated rig, against its truth; gamma and motion.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3::device::sim::{SceneConfig, SimWorld};
use gv3::device::{self, RigConfig};
use gv3::files::picture::{PictureFormat, picture_bytes};
use gv3::files::raw_folder::PictureNames;
use gv3::files::{ProcessingConfig, RawFolder};
use gv3::light::{Direction, GammaTable, MotionCorrection, PatternSequence, Processing};
use gv3::pipeline::{FrameSet, FrameSetAssembler, Reconstruction, Reconstructor, StillReconstructor};
use gv3_codec::{GreyPicture, Scan};
use std::path::Path;
use std::process::Command;
use std::time::Instant;

const SIZE: [u32; 2] = [912, 1140];

/// The first frame sets of a rig.
fn frame_sets(config: &RigConfig, count: usize) -> Vec<FrameSet> {
    let mut rig = device::open(config).unwrap();
    rig.camera.configure(&config.camera_settings()).unwrap();
    rig.projector.load(&rig.sequence).unwrap();
    rig.camera.start().unwrap();
    rig.projector.play(&rig.timing).unwrap();
    let mut assembler = FrameSetAssembler::new(&rig.sequence, &rig.timing);
    let mut next = || rig.camera.next_frame(Instant::now()).unwrap();
    (0..count * config.sequence.patterns.len()).filter_map(|_| assembler.push(next())).collect()
}

fn reconstructor(config: &RigConfig, processing: &Processing) -> Reconstructor {
    Reconstructor::with(&config.calibration().unwrap(), &config.sequence, &config.limits, processing).unwrap()
}

/// The scan of the last frame set, all counted.
fn last_scan(config: &RigConfig, processing: &Processing, sets: &[FrameSet]) -> Scan {
    let mut reconstructor = reconstructor(config, processing);
    // Every set in turn: the correction of one needs the one before.
    let mut scans: Vec<Reconstruction> = sets.iter().map(|set| reconstructor.reconstruct(set).unwrap()).collect();
    let Reconstruction { scan, rejected } = scans.pop().unwrap();
    scan.mesh.validate().unwrap();
    assert_eq!(scan.mesh.vertex_count() as u64 + rejected.total(), 640 * 480, "{rejected:?}");
    scan
}

/// Distances of vertices from the true surface along its normals, mm.
#[derive(Debug, Clone, Copy)]
struct Distances {
    vertices: usize,
    rms_mm: f64,
    mean_mm: f64,
    /// Vertices more than 5 mm off: wrong fringe orders, or beside the outline of the true surface.
    far: usize,
    /// Root mean square of the others.
    near_rms_mm: f64,
}

fn against_truth(scan: &Scan, world: &mut SimWorld) -> Distances {
    let depth_mm = world.truth_depth_mm(scan.time_nanos);
    let (texture, uv) = (scan.texture.as_ref().unwrap(), scan.mesh.uv.as_ref().unwrap());
    let normals = scan.mesh.vertex_normals();
    let (mut sum, mut square, mut near, mut count, mut far) = (0.0, 0.0, 0.0, 0usize, 0);
    for (i, p) in scan.mesh.positions_mm.iter().enumerate() {
        let [x, y] = texture.uv_to_px(uv[i]).map(|v| v.round() as usize);
        let truth_mm = depth_mm[y * 640 + x];
        if truth_mm > 0.0 {
            let distance_mm = f64::from((*p - *p * (truth_mm / -p.z)).dot(normals[i]));
            let is_far = distance_mm.abs() > 5.0;
            far += usize::from(is_far);
            near += if is_far { 0.0 } else { distance_mm * distance_mm };
            sum += distance_mm;
            square += distance_mm * distance_mm;
            count += 1;
        }
    }
    let n = count as f64;
    Distances {
        vertices: count,
        rms_mm: (square / n).sqrt(),
        mean_mm: sum / n,
        far,
        near_rms_mm: (near / (n - far as f64)).sqrt(),
    }
}

fn still(sequence: PatternSequence) -> RigConfig {
    let mut config = RigConfig::simulated();
    config.sim.motion = 0.0;
    config.sequence = sequence;
    config
}

#[test]
fn every_absolute_scheme_works_live() {
    let columns = Direction::Columns;
    let plus_one = |period_px| PatternSequence::two_plus_one(SIZE, columns, period_px).patterns;
    let two_plus_one = PatternSequence {
        patterns: plus_one(264.0).into_iter().chain(plus_one(22.0)).collect(),
        ..PatternSequence::two_frequency(SIZE, 264.0, 22.0, 3)
    };
    let mut both = PatternSequence::hierarchical(SIZE, columns, 30.0, 6.0, 3);
    both.patterns.extend(PatternSequence::gray_phase(SIZE, Direction::Rows, 60.0, 3).patterns);
    let mut world = SimWorld::new(&still(two_plus_one.clone())).unwrap();
    for (name, sequence, bound_mm) in [
        ("2x3", PatternSequence::two_frequency(SIZE, 264.0, 22.0, 3), 0.06),
        ("2x(2+1)", two_plus_one, 0.1),
        ("multi-frequency 3x3", PatternSequence::hierarchical(SIZE, columns, 20.0, 7.2, 3), 0.06),
        ("heterodyne 3x4", PatternSequence::heterodyne(SIZE, columns, 28.0, 4), 0.08),
        ("Gray + 4", PatternSequence::gray_phase(SIZE, columns, 24.0, 4), 0.06),
        ("Gray", PatternSequence::gray_code(SIZE, &[columns]), 0.6),
        ("columns and rows", both, 0.1),
    ] {
        let config = still(sequence);
        let scan = last_scan(&config, &Processing::default(), &frame_sets(&config, 1));
        let found = against_truth(&scan, &mut world);
        println!("{name}, {} pictures: {found:?}", config.sequence.patterns.len());
        assert!(found.vertices > 80_000 && found.rms_mm < bound_mm && found.far == 0, "{name}: {found:?}");
    }
}

#[test]
fn three_pictures_give_an_absolute_scan_of_the_moving_head() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/three-pattern.toml");
    let config = RigConfig::read(&path).unwrap();
    let rig = device::open(&config).unwrap();
    let valid = reconstructor(&config, &rig.processing).valid_depth().unwrap();
    let range = config.limits.depth;
    println!("period {:?}, valid {valid:?} around {range:?}", config.sequence.patterns[0].period_px());
    assert!(valid.near_mm < range.near_mm && valid.far_mm > range.far_mm);
    let mut world = SimWorld::new(&config).unwrap();
    let depth_mm = world.truth_depth_mm(0);
    let ends = depth_mm.iter().filter(|z| **z > 0.0).fold((1e9f32, 0.0f32), |(a, b), z| (a.min(*z), b.max(*z)));
    println!("head from {} to {} mm", ends.0, ends.1);
    let sets = frame_sets(&config, 4);
    for correction in [MotionCorrection::None, MotionCorrection::PhaseRate] {
        let processing = Processing { motion: correction, ..rig.processing.clone() };
        let found = against_truth(&last_scan(&config, &processing, &sets), &mut world);
        println!("three pictures, {correction:?}: {found:?}");
        assert!(found.vertices > 80_000 && found.rms_mm < 0.6 && found.far == 0, "{found:?}");
    }
}

/// Pictures of the first frame set.
fn pictures(config: &RigConfig) -> Vec<GreyPicture> {
    frame_sets(config, 1).remove(0).frames.into_iter().map(|f| f.picture).collect()
}

#[test]
fn a_gamma_table_of_a_board_flattens_planes_and_heads() {
    let mut config = still(PatternSequence::two_frequency(SIZE, 264.0, 22.0, 3));
    config.sim.scene = SceneConfig::Plane;
    config.sim.projector_gamma = 2.2;
    config.sim.read_noise_levels = 0.05;
    config.sim.electrons_per_level = 1e6;
    let still_reconstructor =
        StillReconstructor::new(&config.calibration().unwrap(), &config.sequence, &config.limits).unwrap();
    let (table, figures) = still_reconstructor.measure_gamma(&pictures(&config)).unwrap();
    println!("board: {figures:?}");
    let with_table = Processing { gamma: Some(table.clone()), ..Processing::default() };
    let rms_mm = |config: &RigConfig, processing: &Processing| {
        let found =
            against_truth(&last_scan(config, processing, &frame_sets(config, 1)), &mut SimWorld::new(config).unwrap());
        println!("gamma {}, table {}: {found:?}", config.sim.projector_gamma, processing.gamma.is_some());
        found.rms_mm
    };
    let (before, after) = (rms_mm(&config, &Processing::default()), rms_mm(&config, &with_table));
    assert!(before > 13.0 * after, "plane: {before} mm without, {after} mm with the table");
    let mut double = config.clone();
    double.sequence.patterns.truncate(3);
    double.sequence.patterns.extend(PatternSequence::double_three_step(SIZE, Direction::Columns, 22.0).patterns);
    // Its coarse fringes still err: the table of the same three mends them.
    let fine = PatternSequence::double_three_step(SIZE, Direction::Columns, 22.0);
    let none = gv3::light::gamma::BurstErrors {
        period_px: 22.0,
        shifts_rad: fine.patterns.iter().filter_map(|p| p.shift_rad()).collect(),
        error_rad: vec![0.0; gv3::light::gamma::BINS],
    };
    let coarse_only = GammaTable { bursts: vec![table.bursts[0].clone(), none] };
    let double_mm = rms_mm(&double, &Processing { gamma: Some(coarse_only), ..Processing::default() });
    assert!(before > 5.0 * double_mm, "double three-step: {double_mm} mm");
    // Another scene with other albedo, and the noise of the camera.
    config.sim.scene = SceneConfig::Head;
    (config.sim.read_noise_levels, config.sim.electrons_per_level) = (0.7, 58.0);
    let (before, after) = (rms_mm(&config, &Processing::default()), rms_mm(&config, &with_table));
    assert!(before > 2.0 * after, "head: {before} mm without, {after} mm with the table");
}

#[test]
fn the_commands_make_and_use_a_gamma_table() {
    let mut config = still(PatternSequence::two_frequency(SIZE, 264.0, 22.0, 3));
    config.sim.scene = SceneConfig::Plane;
    config.sim.projector_gamma = 2.2;
    let place = tempfile::tempdir().unwrap();
    let raw = RawFolder {
        pictures: PictureNames::Numbered("board_#.png".into()),
        first: 0,
        sequence: config.sequence.clone(),
        limits: Some(config.limits),
        processing: ProcessingConfig::default(),
    };
    for (name, picture) in raw.names().unwrap().iter().zip(pictures(&config)) {
        let path = place.path().join(name);
        std::fs::write(&path, picture_bytes(&picture, PictureFormat::Png, &path).unwrap()).unwrap();
    }
    std::fs::write(place.path().join("sequence.toml"), raw.to_toml().unwrap()).unwrap();
    std::fs::write(place.path().join("rig.toml"), config.calibration().unwrap().to_toml().unwrap()).unwrap();
    let gv3 = |arguments: &str| -> serde_json::Value {
        let mut command = Command::new(env!("CARGO_BIN_EXE_gv3"));
        let given = "--sequence sequence.toml --calibration rig.toml --json";
        command.args(arguments.split(' ').chain(given.split(' '))).current_dir(place.path());
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let made = gv3("calibrate-gamma . -o gamma.toml");
    let [before, after] = ["before_rad", "after_rad"].map(|key| made[key].as_f64().unwrap());
    assert!(made["bursts"] == 2 && before > 5.0 * after, "{made}");
    let without = gv3("reconstruct . -o without");
    let with = gv3("reconstruct . -o with --gamma gamma.toml");
    let misordered = |report: &serde_json::Value| report["rejected_pixels"]["fringe_order"].as_u64().unwrap();
    assert!(misordered(&without) > 10_000 && misordered(&with) < 100, "{without} {with}");
}

/// Rigs of 3 and 6 pictures a set whose whole scene moves at a velocity.
fn moving(pictures: usize, velocity_mm_s: [f32; 3]) -> RigConfig {
    let mut config = match pictures {
        3 => RigConfig::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/three-pattern.toml")).unwrap(),
        _ => RigConfig::simulated(),
    };
    config.processing = Default::default();
    config.sim.motion = 0.0;
    config.sim.velocity_mm_s = velocity_mm_s;
    config
}

/// Distances without and with the correction, third frame set.
fn uncorrected_and_corrected(config: &RigConfig) -> [Distances; 2] {
    let sets = frame_sets(config, 3);
    let mut world = SimWorld::new(config).unwrap();
    [MotionCorrection::None, MotionCorrection::PhaseRate].map(|motion| {
        let processing = Processing { motion, ..Processing::default() };
        against_truth(&last_scan(config, &processing, &sets), &mut world)
    })
}

#[test]
fn motion_correction_takes_most_of_the_ripple_and_adds_little_noise() {
    let mut fast = moving(6, [0.0, 0.0, 100.0]);
    fast.sim.scene = SceneConfig::Plane;
    let [raw, corrected] = uncorrected_and_corrected(&fast);
    println!("plane at 100 mm/s: {raw:?}, corrected {corrected:?}");
    assert!(raw.rms_mm > 3.0 * corrected.rms_mm, "{raw:?}, corrected {corrected:?}");
    fast.sim.velocity_mm_s = [0.0; 3];
    let [raw, corrected] = uncorrected_and_corrected(&fast);
    println!("plane at rest: {raw:?}, corrected {corrected:?}");
    assert!(corrected.rms_mm < 1.05 * raw.rms_mm, "{raw:?}, corrected {corrected:?}");
}

/// cargo test -p gv3 --release --test live_schemes -- --ignored --nocapture motion_table
#[test]
#[ignore = "prints a table"]
fn motion_table() {
    println!("mm of the vertices within 5 mm of the truth, and how many are beyond: raw | corrected");
    for pictures in [3, 6] {
        for (name, axis) in [("depth", [0.0, 0.0, 1.0f32]), ("sideways", [1.0, 0.0, 0.0])] {
            for speed in [0.0, 25.0, 50.0, 100.0, 200.0] {
                let config = moving(pictures, axis.map(|a| a * speed));
                let [raw, corrected] = uncorrected_and_corrected(&config);
                let figures = |d: Distances| {
                    format!("rms {:.3} (all {:.3}) mean {:6.3} beyond {:4}", d.near_rms_mm, d.rms_mm, d.mean_mm, d.far)
                };
                println!("{pictures} {name:8} {speed:4} mm/s: {} | {}", figures(raw), figures(corrected));
            }
        }
    }
}
