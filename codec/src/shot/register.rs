//! Where a shot's model is in a scan: a rigid pose, then the lattice, on the scan's own pixels.
//!
//! Distances along the scan's normals at the pixels where model points are seen (projective data association: Blais, Levine,
//! Registering multiview range data to create 3D computer objects, PAMI 1995), robustly weighted (Cauchy), and quantized
//! where that costs least for what it gains.

use super::UNITS_PER_MM;
use super::anchors::{Anchors, TrackedPixel};
use super::base::DIRECTION_BITS;
use super::descent::descend;
use super::fit::{Equation, LevelSystem, displacement_at_mm, restrict, right_side, systems};
use super::frames::to_space;
use super::lattice::{Across, FINE_SIDE, GRID_CELLS, GRID_SIDE, LEVEL_SIDES, Nodes, refine};
use super::model::Model;
use super::motion::{Motion, NODE_BITS};
use super::motion_code::{Correction, MotionSteps};
use super::scan_image::ScanImage;
use glam::{DMat3, DQuat, DVec3};

/// Points farther than this from the scan are not of it, mm.
const GATE_MM: f64 = 4.0;
/// Depth steps beyond this are cut, units.
const STEP_LIMIT: i32 = 3 * UNITS_PER_MM;
/// Least cosine between the normals of model and scan.
const MIN_NORMAL_COSINE: f64 = 0.6;
/// Least cosine between the scan's normal and the viewing direction.
const MIN_FACING: f64 = 0.25;
/// Model points beyond this share of the grid's half side are not matched.
const MATCHED_RADIUS: f64 = 117.0 / 128.0;
/// Scale of a quaternion whose scalar part is one.
const TURN_UNIT: f64 = (1 << 14) as f64;

/// Weight of a tracked point that leads the way, beside one matched along its normal.
const LEADING: f64 = 3.0;
/// Weight of one that only keeps the surface from sliding: more would pay for tangential noise.
const ANCHORING: f64 = 0.1;
/// Fewer tracked points than this say nothing by themselves.
const MIN_TRACKED: usize = 30;
/// How much stiffer the lattice is while tracked points alone move it.
const SMOOTHER: f32 = 20.0;

/// How to register.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegisterOptions {
    /// Every this many grid nodes are matched; every second of them for the pose.
    pub stride: usize,
    /// Tracked points move the lattice first: what has moved far is not met by its own pixels.
    pub is_far: bool,
    /// Square millimetres that a bit of the lattice may cost.
    pub lambda: f64,
    /// Pull of each node towards its prediction.
    pub pull: f32,
    /// Weight of the lattice's second differences.
    pub bending: f32,
    /// Rounds of the lattice.
    pub rounds: usize,
}

impl Default for RegisterOptions {
    fn default() -> Self {
        Self { stride: 3, is_far: true, lambda: 0.006, pull: 0.001, bending: 0.001, rounds: 2 }
    }
}

/// A point of the model and how far along a direction the scan's surface lies from it.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Grid position.
    pub grid: [f64; 2],
    /// Where the point is, mm.
    pub at_mm: DVec3,
    /// Direction, the scan's normal for points that are matched by their pixel.
    pub normal: DVec3,
    /// Distance along it, mm.
    pub distance_mm: f64,
    /// Weight.
    pub weight: f64,
}

/// A model found in a scan.
#[derive(Debug, Clone)]
pub struct Registered {
    /// From where it was predicted.
    pub correction: Correction,
    /// Share of the model's points that lie on the scan.
    pub matched: f64,
}

/// The correction that takes the model from where it is predicted to the scan.
pub fn register(
    model: &Model,
    predicted: &Motion,
    image: &ScanImage,
    (anchors, tracked): (&Anchors, &[TrackedPixel]),
    steps: &MotionSteps,
    options: &RegisterOptions,
) -> Registered {
    let mut correction = Correction::default();
    let mut now = predicted.clone();
    let mut matched = 0.0;
    let along = |now: &Motion, weight: f64| anchors.hits(tracked, model, now, (image, weight));
    for _ in 0..2 {
        let mut hits = hits(model, &now, image, 2 * options.stride, 0.5);
        hits.extend(along(&now, LEADING));
        correction.pose = pose_steps(&hits, &now, predicted, steps);
        now = correction.apply(predicted, &model.frames, steps);
    }
    let first = if options.is_far { along(&now, LEADING) } else { Vec::new() };
    if first.len() >= 3 * MIN_TRACKED {
        let equations = equations(&first, &now, predicted);
        let smooth = RegisterOptions { bending: options.bending * SMOOTHER, ..*options };
        correction.levels = quantize(model, &equations, steps, options.lambda * 0.3, &smooth);
        now = correction.apply(predicted, &model.frames, steps);
    }
    for round in 0..options.rounds {
        let is_last = round + 1 == options.rounds;
        let mut hits = hits(model, &now, image, options.stride, if round == 0 { 1.0 } else { 0.3 });
        matched = share(&hits, options.stride);
        hits.extend(along(&now, ANCHORING));
        let equations = equations(&hits, &now, predicted);
        let lambda = if is_last { options.lambda } else { options.lambda * 0.3 };
        correction.levels = quantize(model, &equations, steps, lambda, options);
        now = correction.apply(predicted, &model.frames, steps);
    }
    Registered { correction, matched }
}

/// Share of the grid's disk that was matched.
fn share(hits: &[Hit], stride: usize) -> f64 {
    let radius = MATCHED_RADIUS * GRID_CELLS as f64 / (2 * stride) as f64;
    hits.len() as f64 / (std::f64::consts::PI * radius * radius)
}

fn hits(model: &Model, motion: &Motion, image: &ScanImage, stride: usize, scale_mm: f64) -> Vec<Hit> {
    let shift = Across::new(&motion.nodes);
    let pose = motion.pose.matrix();
    let rotation = DMat3::from_cols_array_2d(&pose.rotation()).transpose();
    let view = model.view.moved(image.window.offset);
    let toward = -DVec3::from_array(view.axis.map(|a| a as f64)).normalize_or_zero();
    let half = GRID_CELLS as f64 / 2.0;
    let radius2 = (MATCHED_RADIUS * half).powi(2);
    let nodes = (0..GRID_SIDE).step_by(stride).flat_map(|y| (0..GRID_SIDE).step_by(stride).map(move |x| [x, y]));
    let on_disk = |n: &[usize; 2]| n.map(|v| (v as f64 - half).powi(2)).iter().sum::<f64>() <= radius2;
    nodes
        .filter(on_disk)
        .filter_map(|node| {
            let i = node[1] * GRID_SIDE + node[0];
            let rounding = 1 << (NODE_BITS - 1);
            let (p, d) = (model.base.positions[i], shift.at(node[0], node[1]));
            let at = pose.apply([0, 1, 2].map(|c| p[c] + ((d[c] + rounding) >> NODE_BITS)));
            let seen = view.project(at)?;
            let sample = image.sample(seen.x, seen.y, STEP_LIMIT)?;
            let normal = rotation * DVec3::from_array(model.base.normals[i].map(f64::from));
            let at_mm = DVec3::from_array(at.map(f64::from)) / f64::from(UNITS_PER_MM);
            let distance_mm = (sample.point_mm - at_mm).dot(sample.normal);
            let is_match = normal.dot(sample.normal) >= MIN_NORMAL_COSINE * f64::from(1 << DIRECTION_BITS)
                && sample.normal.dot(toward) >= MIN_FACING
                && distance_mm.abs() <= GATE_MM;
            let weight = 1.0 / (1.0 + (distance_mm / scale_mm).powi(2));
            let grid = node.map(|v| v as f64);
            is_match.then_some(Hit { grid, at_mm, normal: sample.normal, distance_mm, weight })
        })
        .collect()
}

/// Point-to-plane pose (Low: Linear least-squares optimization for point-to-plane ICP surface registration, 2004), in steps
/// from the prediction.
fn pose_steps(hits: &[Hit], now: &Motion, predicted: &Motion, steps: &MotionSteps) -> [i32; 6] {
    let mut system = [[0.0; 7]; 6];
    for hit in hits {
        let turn = hit.at_mm.cross(hit.normal);
        let row = [turn.x, turn.y, turn.z, hit.normal.x, hit.normal.y, hit.normal.z];
        for (line, a) in system.iter_mut().zip(row) {
            for (v, b) in line.iter_mut().zip(row) {
                *v += hit.weight * a * b;
            }
            line[6] += hit.weight * a * hit.distance_mm;
        }
    }
    let step = solve(system);
    let units = f64::from(UNITS_PER_MM);
    let turn = now.pose.turn.map(|v| f64::from(v) / TURN_UNIT);
    let by = DQuat::from_scaled_axis(DVec3::new(step[0], step[1], step[2]));
    let turned = (by * DQuat::from_xyzw(turn[0], turn[1], turn[2], 1.0)).to_array();
    let shifted =
        by * (DVec3::from_array(now.pose.shift.map(f64::from)) / units) + DVec3::new(step[3], step[4], step[5]);
    std::array::from_fn(|i| {
        let (wanted, before, step) = if i < 3 {
            (turned[i] / turned[3] * TURN_UNIT, predicted.pose.turn[i], steps.turn)
        } else {
            (shifted[i - 3] * units, predicted.pose.shift[i - 3], steps.shift)
        };
        ((wanted - f64::from(before)) / f64::from(step)).round().clamp(-1e4, 1e4) as i32
    })
}

/// Gauss-Jordan elimination of a positive definite system; what cannot be seen stays.
fn solve(mut system: [[f64; 7]; 6]) -> [f64; 6] {
    for (i, line) in system.iter_mut().enumerate() {
        line[i] = line[i] * (1.0 + 1e-6) + 1e-9;
    }
    for i in 0..6 {
        let line = system[i].map(|v| v / system[i][i]);
        for other in &mut system {
            let factor = other[i];
            other.iter_mut().zip(line).for_each(|(v, l)| *v -= factor * l);
        }
        system[i] = line;
    }
    system.map(|line| line[6])
}

/// What the hits ask of the lattice, in the order of grid rows.
fn equations(hits: &[Hit], now: &Motion, predicted: &Motion) -> Vec<Equation> {
    // Rows as columns: the inverse rotation.
    let back = DMat3::from_cols_array_2d(&now.pose.matrix().rotation());
    let moved: Nodes =
        now.nodes.iter().zip(&predicted.nodes).map(|(n, p)| [n[0] - p[0], n[1] - p[1], n[2] - p[2]]).collect();
    let mut equations: Vec<Equation> = hits
        .iter()
        .map(|hit| {
            let direction = back * hit.normal;
            let already = displacement_at_mm(&moved, hit.grid);
            Equation {
                grid: hit.grid,
                direction,
                distance_mm: hit.distance_mm + direction.dot(already),
                weight: hit.weight,
            }
        })
        .collect();
    equations.sort_by(|a, b| a.grid[1].total_cmp(&b.grid[1]).then(a.grid[0].total_cmp(&b.grid[0])));
    equations
}

/// Coarse to fine: each level takes what the finer ones need not.
fn quantize(
    model: &Model,
    equations: &[Equation],
    steps: &MotionSteps,
    lambda: f64,
    options: &RegisterOptions,
) -> [Vec<[i32; 3]>; 3] {
    let systems = systems(equations, options.bending, options.pull);
    let mut gradient = right_side(equations);
    let steps_mm = steps.lattice.map(|v| f64::from(v) / f64::from(UNITS_PER_MM));
    let mut levels = [const { Vec::new() }; 3];
    for (level, side) in LEVEL_SIDES.into_iter().enumerate() {
        let mut own = gradient.clone();
        let mut from = FINE_SIDE;
        while from > side {
            own = restrict(&own, from);
            from = from.div_ceil(2) + 1;
        }
        let q = descend(&systems[level], &mut own, &model.frames[level], steps_mm, lambda);
        if side < FINE_SIDE {
            let nodes = q.iter().zip(&model.frames[level]).map(|(q, f)| to_space(f, steps.lattice, *q)).collect();
            subtract(&systems[2], nodes, side, &mut gradient);
        }
        levels[level] = q;
    }
    levels
}

/// Takes a coarse level's displacement off the finest gradient.
fn subtract(finest: &LevelSystem, mut nodes: Nodes, mut side: usize, gradient: &mut [DVec3]) {
    while side < FINE_SIDE {
        nodes = refine(&nodes, side);
        side = 2 * side - 3;
    }
    let per_mm = f64::from(UNITS_PER_MM << NODE_BITS);
    for (i, n) in nodes.iter().enumerate().filter(|(_, n)| **n != [0; 3]) {
        finest.subtract(i, DVec3::from_array(n.map(f64::from)) / per_mm, gradient);
    }
}
