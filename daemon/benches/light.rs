//! Cost of every stage from a rendered picture to a scan, 640x480, on the simulated scanner: one row a stage.
//!
//! `cargo bench -p gv3 --bench light`; the budget of a stage stands in its row's name.
#![allow(missing_docs, clippy::unwrap_used)]

use criterion::{BenchmarkGroup, Criterion, criterion_group, criterion_main, measurement::WallTime};
use gv3::device::sim::{BoardScene, Finish, Region, SceneConfig, SimWorld};
use gv3::device::{self, PatternIndex, RigConfig};
use gv3::light::gamma::{BINS, BurstErrors};
use gv3::light::{
    Board, GridMesher, MotionCorrector, PhaseExtractor, PixelMask, PointGrid, Triangulator, Unwrapper, WrappedPhase,
    find_chessboard,
};
use gv3::pipeline::{FrameSet, FrameSetAssembler, Reconstructor};
use std::time::Instant;

const PIXELS: usize = 640 * 480;
/// Least number of pixels with a point in what the stages are given.
const LEAST_POINTS: usize = 100_000;

fn frame_set(config: &RigConfig) -> FrameSet {
    let mut rig = device::open(config).unwrap();
    rig.camera.configure(&config.camera_settings()).unwrap();
    rig.projector.load(&rig.sequence).unwrap();
    rig.camera.start().unwrap();
    rig.projector.play(&rig.timing).unwrap();
    let mut assembler = FrameSetAssembler::new(&rig.sequence, &rig.timing);
    loop {
        if let Some(set) = assembler.push(rig.camera.next_frame(Instant::now()).unwrap()) {
            return set;
        }
    }
}

/// Every stage on its own, given what the stages before it made of one frame set of the talking head.
fn stages(c: &mut Criterion) {
    let config = RigConfig::simulated();
    let (calibration, sequence, limits) = (config.calibration().unwrap(), &config.sequence, config.limits);
    let set = frame_set(&config);
    let pictures: Vec<_> = set.frames.iter().map(|f| &f.picture).collect();
    let (low, high) = sequence.low_and_high().unwrap();
    let extractors = [&low, &high].map(|b| PhaseExtractor::new(&sequence.patterns[b.clone()], limits.mask).unwrap());
    let unwrapper = Unwrapper::new(&calibration, sequence, limits.depth).unwrap();
    let triangulator = Triangulator::new(&calibration, limits.depth).unwrap();
    let mut mesher = GridMesher::new(limits.mesh).unwrap();
    let mut reconstructor = Reconstructor::new(&calibration, sequence, &limits).unwrap();

    let mut mask = PixelMask::new(640, 480);
    let (mut low_phase, mut high_phase) = (WrappedPhase::new(PIXELS), WrappedPhase::new(PIXELS));
    let phase = |mask: &mut PixelMask, low_phase: &mut WrappedPhase, high_phase: &mut WrappedPhase| {
        mask.clear();
        extractors[0].extract(&pictures[low.clone()], mask, low_phase);
        extractors[1].extract(&pictures[high.clone()], mask, high_phase);
        mask.erode();
    };
    phase(&mut mask, &mut low_phase, &mut high_phase);
    let mut column_px = vec![0.0; PIXELS];
    unwrapper.unwrap(&low_phase.phase_rad, &high_phase.phase_rad, &mut mask, &mut column_px);
    let unwrapped_mask = mask.clone();
    let mut grid = PointGrid::new(640, 480);
    triangulator.triangulate(&column_px, &mut mask, &mut grid);
    assert!(mesher.mesh(&grid, &mut mask).vertex_count() > LEAST_POINTS);

    let mut group = c.benchmark_group("light");
    group.sample_size(20);
    group.bench_function("phase and mask (5 ms)", |b| b.iter(|| phase(&mut mask, &mut low_phase, &mut high_phase)));
    group.bench_function("unwrap (1 ms)", |b| {
        b.iter(|| unwrapper.unwrap(&low_phase.phase_rad, &high_phase.phase_rad, &mut mask, &mut column_px));
    });
    mask = unwrapped_mask;
    group.bench_function("triangulate (1.5 ms)", |b| {
        b.iter(|| triangulator.triangulate(&column_px, &mut mask, &mut grid));
    });
    group.bench_function("grid mesh (2 ms)", |b| b.iter(|| mesher.mesh(&grid, &mut mask)));
    let mut motion = MotionCorrector::new([640, 480], &sequence.patterns[high.clone()], 6).unwrap();
    let mut tick = 0;
    let mut corrected_px = column_px.clone();
    group.bench_function("motion correction", |b| {
        b.iter(|| {
            tick += 1;
            corrected_px.copy_from_slice(&column_px);
            motion.correct(tick, &mask, &mut corrected_px);
        });
    });

    let pattern = sequence.patterns[high.clone()].iter().filter_map(|p| p.shift_rad()).collect();
    let errors = BurstErrors { period_px: 22.0, shifts_rad: pattern, error_rad: vec![1e-3; BINS] };
    group.bench_function("gamma table", |b| b.iter(|| errors.correct(&mut high_phase.phase_rad)));

    group.bench_function("whole set (10 ms)", |b| b.iter(|| reconstructor.reconstruct(&set).unwrap()));
    group.finish();
}

/// Pictures of the moving head, each at its own time.
fn render(group: &mut BenchmarkGroup<'_, WallTime>, name: &str, config: &RigConfig) {
    let mut world = SimWorld::new(config).unwrap();
    world.load(&config.sequence);
    let period_nanos = config.timing.picture_period_nanos;
    let mut number = 0;
    group.bench_function(name, |b| {
        b.iter(|| {
            number += 1;
            let pattern = PatternIndex((number % 6) as u16);
            world.expose(number * period_nanos, Some(pattern), config.timing.exposure_nanos, number)
        });
    });
}

fn simulator(c: &mut Criterion) {
    let mut group = c.benchmark_group("simulator");
    group.sample_size(20);
    let plain = RigConfig::simulated();
    render(&mut group, "plain (6 ms)", &plain);
    let mut all = plain.clone();
    all.sim.motion_samples = 4;
    all.sim.velocity_mm_s = [60.0, 0.0, 30.0];
    all.sim.projector_gamma = 2.2;
    all.sim.defocus_sigma_px = 2.0;
    all.sim.regions = [(Finish::Dark, 60.0), (Finish::Shiny, -80.0)]
        .map(|(finish, y_mm)| Region { finish, centre_mm: [0.0, y_mm], radius_mm: 10.0 })
        .to_vec();
    render(&mut group, "all effects, four instants an exposure (25 ms)", &all);
    let mut still = plain;
    still.sim.motion = 0.0;
    render(&mut group, "head at rest", &still);
    group.finish();
}

fn board(c: &mut Criterion) {
    let board = Board { columns: 9, rows: 6, square_mm: 12.0 };
    let mut config = RigConfig::simulated();
    config.sim.scene = SceneConfig::Board(BoardScene { turns_deg: [20.0, -15.0, 10.0], ..BoardScene::new(board) });
    config.sim.ambient = 1.0;
    let picture = SimWorld::new(&config).unwrap().expose(0, None, 5_000_000, 0);
    let mut group = c.benchmark_group("calibration");
    group.sample_size(20);
    group.bench_function("find_chessboard", |b| b.iter(|| find_chessboard(&picture, &board).unwrap()));
    group.finish();
}

criterion_group!(benches, stages, simulator, board);
criterion_main!(benches);
