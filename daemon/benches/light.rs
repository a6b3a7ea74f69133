//! Cost of every stage from a rendered picture to a scan, 640x480, on the simulated scanner.
#![allow(missing_docs, clippy::unwrap_used)]

use criterion::{Criterion, criterion_group, criterion_main};
use gv3::device::sim::{BoardScene, SceneConfig, SimWorld};
use gv3::device::{self, PatternIndex, RigConfig};
use gv3::light::{
    Board, GridMesher, PhaseExtractor, PixelMask, PointGrid, Triangulator, Unwrapper, WrappedPhase, find_chessboard,
};
use gv3::pipeline::{FrameSet, FrameSetAssembler, Reconstructor};
use std::time::Instant;

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

fn stages(c: &mut Criterion) {
    let config = RigConfig::simulated();
    let (calibration, sequence, limits) = (config.calibration().unwrap(), &config.sequence, config.limits);
    let set = frame_set(&config);
    let mut group = c.benchmark_group("light");
    group.sample_size(20);

    let mut world = SimWorld::new(&config).unwrap();
    world.load(sequence);
    group.bench_function("render", |b| b.iter(|| world.expose(0, Some(PatternIndex(3)), 5_000_000, 3)));

    let (low, high) = sequence.low_and_high().unwrap();
    let extractor = PhaseExtractor::new(&sequence.patterns[low], limits.mask).unwrap();
    let pictures: Vec<_> = set.frames.iter().map(|f| &f.picture).collect();
    let mut mask = PixelMask::new(640, 480);
    let mut low_phase = WrappedPhase::new(640 * 480);
    let mut high_phase = WrappedPhase::new(640 * 480);
    group.bench_function("phase", |b| {
        b.iter(|| {
            mask.clear();
            extractor.extract(&pictures[..3], &mut mask, &mut low_phase);
            extractor.extract(&pictures[high.clone()], &mut mask, &mut high_phase);
            mask.erode();
        });
    });

    let unwrapper = Unwrapper::new(&calibration, sequence, limits.depth).unwrap();
    let mut column_px = vec![0.0; 640 * 480];
    group.bench_function("unwrap", |b| {
        b.iter(|| unwrapper.unwrap(&low_phase.phase_rad, &high_phase.phase_rad, &mut mask, &mut column_px));
    });

    let triangulator = Triangulator::new(&calibration, limits.depth).unwrap();
    let mut grid = PointGrid::new(640, 480);
    group.bench_function("triangulate", |b| b.iter(|| triangulator.triangulate(&column_px, &mut mask, &mut grid)));

    let mut mesher = GridMesher::new(limits.mesh).unwrap();
    group.bench_function("grid_mesh", |b| b.iter(|| mesher.mesh(&grid, &mut mask)));

    let mut reconstructor = Reconstructor::new(&calibration, sequence, &limits).unwrap();
    group.bench_function("whole_set", |b| b.iter(|| reconstructor.reconstruct(&set).unwrap()));
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

criterion_group!(benches, stages, board);
criterion_main!(benches);
