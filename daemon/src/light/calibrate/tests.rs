//! Simulated boards: what is found must be what was there, within what the noise allows.

use super::bundle::{Bundle, SHARED, View, moved_rig};
use super::*;
use crate::light::calibration::tests::rig;
use faer::linalg::solvers::Solve;
use faer::{Mat, Side};

/// Noise of a simulation, standard deviation along an axis.
pub(super) struct Noise {
    pub camera_px: f64,
    pub projector_px: f64,
    pub seed: u64,
}

/// Uniform numbers by SplitMix64 (Steele, Lea, Flood 2014) and normal ones by Box and Muller's transform.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * self.uniform()
    }

    fn normal_pair(&mut self) -> DVec2 {
        let (u, v) = (1.0 - self.uniform(), self.uniform());
        DVec2::from_angle(std::f64::consts::TAU * v) * (-2.0 * u.ln()).sqrt()
    }
}

/// Where boards are put.
struct Stage {
    rig: Calibration,
    columns: u32,
    rows: u32,
    square_mm: f64,
    /// Centre of the working volume in the camera's frame, and how far boards are from it, mm.
    centre_mm: DVec3,
    reach_mm: DVec3,
    largest_tilt_rad: f64,
}

fn stage() -> Stage {
    Stage {
        rig: rig(),
        columns: 9,
        rows: 6,
        square_mm: 18.0,
        centre_mm: DVec3::new(0.0, 0.0, 600.0),
        reach_mm: DVec3::new(60.0, 50.0, 50.0),
        largest_tilt_rad: 0.6,
    }
}

impl Stage {
    fn poses(&self, count: usize, random: &mut Random) -> Vec<Pose> {
        let (w, h) = (f64::from(self.columns - 1) * self.square_mm, f64::from(self.rows - 1) * self.square_mm);
        let pose = |_| {
            let mut turn = |by: f64| random.between(-by, by);
            let (x, y, z) = (turn(self.largest_tilt_rad), turn(self.largest_tilt_rad), turn(0.5));
            let rotation = DMat3::from_rotation_z(z) * DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x);
            let shift = DVec3::new(turn(1.0), turn(1.0), turn(1.0)) * self.reach_mm;
            Pose { rotation, translation_mm: self.centre_mm + shift - rotation * DVec3::new(0.5 * w, 0.5 * h, 0.0) }
        };
        (0..count).map(pose).collect()
    }

    /// Views by the true rig. A share `carried` of the camera's error goes on to the projector's coordinate, as it does
    /// where the coordinate is read at the corner as found.
    fn views(&self, count: usize, noise: &Noise, carried: f64) -> Vec<BoardView> {
        let mut random = Random(noise.seed);
        let poses = self.poses(count, &mut random);
        let view = |(index, pose): (usize, &Pose)| {
            let mut view =
                BoardView { name: format!("view {index}"), board_mm: vec![], camera_px: vec![], projector_px: vec![] };
            for i in 0..self.columns * self.rows {
                let board = DVec2::new(f64::from(i % self.columns), f64::from(i / self.columns)) * self.square_mm;
                let point = pose.apply(board.extend(0.0));
                let error = random.normal_pair() * noise.camera_px;
                let camera = self.rig.camera.project(point) + error;
                let magnification = self.rig.projector.fx_px / self.rig.camera.fx_px;
                let projector = self.rig.projector_px(point)
                    + random.normal_pair() * noise.projector_px
                    + error * carried * magnification;
                let is_lit = (-0.5..f64::from(self.rig.projector.width_px) - 0.5).contains(&projector.x)
                    && (-0.5..f64::from(self.rig.projector.height_px) - 0.5).contains(&projector.y);
                let is_seen = (-0.5..f64::from(self.rig.camera.width_px) - 0.5).contains(&camera.x)
                    && (-0.5..f64::from(self.rig.camera.height_px) - 0.5).contains(&camera.y);
                if is_seen {
                    view.board_mm.push(board.to_array());
                    view.camera_px.push(camera.to_array());
                    view.projector_px.push(is_lit.then(|| projector.to_array()));
                }
            }
            view
        };
        poses.iter().enumerate().map(view).collect()
    }

    fn calibrate(&self, views: &[BoardView], options: &CalibrateOptions) -> Result<Calibrated, CalibrateError> {
        let size = |lens: &Intrinsics| [lens.width_px, lens.height_px];
        calibrate(views, size(&self.rig.camera), size(&self.rig.projector), options)
    }
}

/// The true rig and poses with noisy corners.
pub(super) fn simulated_bundle(count: usize, noise: &Noise) -> Bundle {
    let stage = stage();
    let views = stage.views(count, noise, 0.0);
    let poses = stage.poses(count, &mut Random(noise.seed));
    let view = |(pose, view): (Pose, &BoardView)| View { pose, corners: corners(view) };
    Bundle {
        rig: stage.rig,
        views: poses.into_iter().zip(&views).map(view).collect(),
        free: (0..SHARED).collect(),
        whitening: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
        huber: f64::INFINITY,
    }
}

fn all_terms() -> CalibrateOptions {
    let mut options = CalibrateOptions::default();
    // The rig of the tests has k3 in the camera only.
    options.camera.k3 = true;
    options
}

/// Step of the estimated parameters from what was found to the truth.
fn step_to_truth(found: &Calibrated, truth: &Calibration, options: &CalibrateOptions) -> Vec<f64> {
    let mut step = [0.0; SHARED];
    for (at, found, truth) in
        [(0, found.calibration.camera, truth.camera), (LENS_PARAMETERS, found.calibration.projector, truth.projector)]
    {
        let (found, truth) = (lens::parameters(&found), lens::parameters(&truth));
        (0..LENS_PARAMETERS).for_each(|i| step[at + i] = truth[i] - found[i]);
    }
    let (rigid, true_rigid) = (found.calibration.projector_from_camera, truth.projector_from_camera);
    let turn = DQuat::from_mat3(&(true_rigid.matrix() * rigid.matrix().transpose())).to_scaled_axis();
    step[2 * LENS_PARAMETERS..][..3].copy_from_slice(&turn.to_array());
    step[2 * LENS_PARAMETERS + 3..].copy_from_slice(&(true_rigid.translation() - rigid.translation()).to_array());
    let back = moved_rig(&found.calibration, &step);
    assert!(back.projector_from_camera.matrix().abs_diff_eq(true_rigid.matrix(), 1e-9));
    let camera = free(options.camera).into_iter();
    let projector = free(options.projector).into_iter().map(|i| LENS_PARAMETERS + i);
    camera.chain(projector).chain(2 * LENS_PARAMETERS..SHARED).map(|i| step[i]).collect()
}

/// Squared distance to the truth in standard errors (Mahalanobis).
fn mahalanobis2(found: &Calibrated, truth: &Calibration, options: &CalibrateOptions) -> f64 {
    let step = step_to_truth(found, truth, options);
    let n = step.len();
    let covariance = Mat::from_fn(n, n, |i, j| found.covariance[i][j]);
    let step = Mat::from_fn(n, 1, |i, _| step[i]);
    let solved = covariance.llt(Side::Lower).unwrap().solve(&step);
    (step.transpose() * solved)[(0, 0)]
}

/// Quantile of the chi-square distribution at 99.9 % (E. Wilson and M. Hilferty, 1931; good to 0.1 here).
fn chi_square_999(degrees: f64) -> f64 {
    let a = 2.0 / (9.0 * degrees);
    degrees * (1.0 - a + 3.090_232 * a.sqrt()).powi(3)
}

#[test]
fn exact_corners_give_the_rig_back() {
    let stage = stage();
    let views = stage.views(8, &Noise { camera_px: 0.0, projector_px: 0.0, seed: 5 }, 0.0);
    let found = stage.calibrate(&views, &all_terms()).unwrap();
    let (c, t) = (found.calibration, stage.rig);
    for (found, truth) in [(c.camera, t.camera), (c.projector, t.projector)] {
        for (i, (a, b)) in lens::parameters(&found).into_iter().zip(lens::parameters(&truth)).enumerate() {
            assert!((a - b).abs() < if i < 4 { 1e-4 } else { 1e-5 }, "{i}: {a} {b}");
        }
    }
    assert!(c.projector_from_camera.matrix().abs_diff_eq(t.projector_from_camera.matrix(), 1e-8));
    assert!(c.projector_from_camera.translation().abs_diff_eq(t.projector_from_camera.translation(), 1e-4));
    assert!(found.report.camera_rms_px < 1e-6 && found.report.projector_rms_px < 1e-6);
}

/// The truth must lie within the ellipsoid of 99.9 % in at least 19 of 20 simulations, and the squared distances must be
/// as large as the number of parameters on average, so that standard errors too small and too large both fail.
fn check_standard_errors(carried: f64) {
    let (stage, options) = (stage(), all_terms());
    let (mut inside, mut sum, mut degrees) = (0, 0.0, 0.0);
    for seed in 0..20 {
        let views = stage.views(20, &Noise { camera_px: 0.1, projector_px: 0.15, seed: 100 + seed }, carried);
        let found = stage.calibrate(&views, &options).unwrap();
        degrees = found.covariance.len() as f64;
        let distance2 = mahalanobis2(&found, &stage.rig, &options);
        inside += usize::from(distance2 <= chi_square_999(degrees));
        sum += distance2;
    }
    let mean = sum / 20.0;
    println!("{inside} of 20 inside, mean {mean:.1} for {degrees} parameters");
    assert!(inside >= 19, "{inside} of 20");
    // Standard deviation of the mean is sqrt(2 n / 20), 1.5 for 23 parameters.
    assert!((mean - degrees).abs() < 6.0, "mean {mean} for {degrees} parameters");
}

#[test]
fn the_truth_lies_within_the_standard_errors() {
    check_standard_errors(0.0);
}

#[test]
fn the_truth_lies_within_the_standard_errors_where_the_projector_inherits_the_cameras_error() {
    check_standard_errors(1.0);
}

#[test]
fn the_noise_is_found_and_outliers_are_not_used() {
    let stage = stage();
    let mut views = stage.views(12, &Noise { camera_px: 0.1, projector_px: 0.2, seed: 7 }, 0.0);
    views[2].camera_px[5][0] += 3.0;
    views[4].camera_px[20][1] -= 8.0;
    let decoded = views[7].projector_px.iter().position(Option::is_some).unwrap();
    views[7].projector_px[decoded].as_mut().unwrap()[1] += 5.0;
    let found = stage.calibrate(&views, &all_terms()).unwrap();
    let noise = found.report.noise;
    assert!((noise.camera_px - 0.1).abs() < 0.01 && (noise.projector_px - 0.2).abs() < 0.02, "{noise:?}");
    assert!(found.residuals[2].camera[5].rejected && found.residuals[4].camera[20].rejected);
    assert!(found.residuals[7].projector.iter().any(|r| r.rejected && r.error_px[1] > 4.0));
    // One corner in 3,000 is beyond the limit by chance.
    assert!((2..=4).contains(&found.report.camera_rejected), "{}", found.report.camera_rejected);
    assert!((1..=3).contains(&found.report.projector_rejected), "{}", found.report.projector_rejected);
    assert!(mahalanobis2(&found, &stage.rig, &all_terms()) < chi_square_999(found.covariance.len() as f64));
    let text = found.report.describe();
    assert!(text.contains("camera.fx_px") && text.contains("view 11"), "{text}");
}

/// The rig of a real capture: 1280x1024 and 1024x768 pixels, a board of 7x9 corners of 75 mm at 3.3 m.
fn kamino() -> Stage {
    let lens = |[width_px, height_px]: [u32; 2], [fx_px, fy_px, cx_px, cy_px]: [f64; 4], [k1, k2, p1, p2]: [f64; 4]| {
        let distortion = Distortion { k1, k2, p1, p2, k3: 0.0 };
        Intrinsics { width_px, height_px, fx_px, fy_px, cx_px, cy_px, distortion }
    };
    let turn = DVec3::new(0.008_912_6, -0.059_574_7, -0.016_132_5);
    Stage {
        rig: Calibration {
            camera: lens([1280, 1024], [3452.35, 3451.26, 586.15, 522.20], [-0.2349, -0.2975, -8.84e-4, -1.736e-3]),
            projector: lens([1024, 768], [1889.18, 1890.61, 484.27, 855.12], [-0.1275, 0.1625, 1.221e-3, -5.595e-3]),
            projector_from_camera: Rigid::new(
                DMat3::from_quat(DQuat::from_scaled_axis(turn)),
                DVec3::new(94.44, -626.15, -246.01),
            ),
        },
        columns: 7,
        rows: 9,
        square_mm: 75.0,
        centre_mm: DVec3::new(30.0, 0.0, 3300.0),
        reach_mm: DVec3::new(250.0, 150.0, 250.0),
        largest_tilt_rad: 0.7,
    }
}

#[test]
fn a_rig_like_the_real_one_is_recovered_within_its_standard_errors() {
    let stage = kamino();
    // The noise of the real one: rms of 0.31 and 0.20 px are 0.22 and 0.14 px an axis.
    let views = stage.views(15, &Noise { camera_px: 0.22, projector_px: 0.14, seed: 11 }, 0.0);
    let options = CalibrateOptions::default();
    let found = stage.calibrate(&views, &options).unwrap();
    println!("{}", found.report.describe());
    let step = step_to_truth(&found, &stage.rig, &options);
    for (parameter, step) in found.report.parameters.iter().zip(&step) {
        assert!(step.abs() < 4.0 * parameter.standard_error, "{}: {step}", parameter.name);
    }
    assert!(mahalanobis2(&found, &stage.rig, &options) < chi_square_999(step.len() as f64));
    assert!((found.report.camera_rms_px - 0.31).abs() < 0.02 && (found.report.projector_rms_px - 0.2).abs() < 0.02);
    assert!(found.report.point_standard_error_largest_mm < 10.0);
}

/// The refusal of views that are changed after they were made.
fn refusal(stage: &Stage, count: usize, noise_px: f64, change: impl Fn(&mut Vec<BoardView>)) -> CalibrateError {
    let mut views = stage.views(count, &Noise { camera_px: noise_px, projector_px: noise_px, seed: 21 }, 0.0);
    change(&mut views);
    stage.calibrate(&views, &CalibrateOptions::default()).unwrap_err()
}

#[test]
fn views_that_determine_nothing_are_refused_with_the_reason() {
    let unchanged = |_: &mut Vec<BoardView>| ();
    let error = refusal(&stage(), 5, 0.1, unchanged);
    assert_eq!(error, CalibrateError::TooFewViews { found: 5, need: 6 });
    assert!(error.to_string().contains("at least 6"));
    let parallel = refusal(&Stage { largest_tilt_rad: 0.0, ..stage() }, 10, 0.1, unchanged);
    assert!(matches!(parallel, CalibrateError::Parallel { device: "camera", .. }), "{parallel}");
    let narrow = Stage { reach_mm: DVec3::new(2.0, 2.0, 50.0), square_mm: 8.0, ..stage() };
    let error = refusal(&narrow, 10, 0.1, unchanged);
    assert!(matches!(error, CalibrateError::Coverage { device: "camera", .. }), "{error}");
    let error = refusal(&stage(), 8, 0.1, |views| views[3].projector_px.iter_mut().for_each(|p| *p = None));
    assert!(error.to_string().starts_with("view 3: the projector's coordinates are known at 0 of"), "{error}");
    let error = refusal(&stage(), 8, 0.1, |views| views[4].camera_px[7][1] = f64::NAN);
    assert!(error.to_string().starts_with("view 4: a corner is not a number"), "{error}");
    let error = refusal(&stage(), 8, 0.1, |views| views[5].projector_px.truncate(20));
    assert!(error.to_string().starts_with("view 5:"), "{error}");
    let line = |views: &mut Vec<BoardView>| views[2].camera_px.iter_mut().for_each(|p| p[1] = p[0]);
    let error = refusal(&stage(), 8, 0.1, line);
    assert!(matches!(&error, CalibrateError::NoPlane { device: "camera", view } if view == "view 2"), "{error}");
}

#[test]
fn results_that_no_one_should_measure_with_are_refused() {
    let error = refusal(&stage(), 10, 2.0, |_| ());
    assert!(matches!(error, CalibrateError::Rms { device: "camera", .. }), "{error}");
    // Almost parallel boards pass for tilted and leave the focal length uncertain.
    let flat = Stage { largest_tilt_rad: 0.08, ..stage() };
    let error = refusal(&flat, 6, 0.5, |_| ());
    let is_uncertain = matches!(
        error,
        CalibrateError::Uncertain { .. } | CalibrateError::PointUncertain { .. } | CalibrateError::Result(_)
    );
    assert!(is_uncertain, "{error}");
    // The corners of one view counted from the other end: its projector coordinates are those of other corners.
    let swapped = |views: &mut Vec<BoardView>| views[4].projector_px.reverse();
    let error = refusal(&stage(), 10, 0.1, swapped);
    assert!(error.to_string().starts_with("view 4: "), "{error}");
    // A capture of another rig among the views.
    let error = refusal(&stage(), 10, 0.1, |views| {
        views[6].camera_px.iter_mut().for_each(|p| p[0] = 320.0 + 0.8 * (p[0] - 320.0));
    });
    assert!(error.to_string().contains("view 6"), "{error}");
}

#[test]
fn terms_that_are_not_estimated_stay_zero() {
    let stage = stage();
    let views = stage.views(10, &Noise { camera_px: 0.1, projector_px: 0.1, seed: 2 }, 0.0);
    let none = DistortionTerms { k1: false, k2: false, tangential: false, k3: false };
    let options = CalibrateOptions {
        camera: DistortionTerms { k2: false, ..DistortionTerms::default() },
        projector: none,
        max_rms_px: 5.0,
        ..CalibrateOptions::default()
    };
    let found = stage.calibrate(&views, &options).unwrap();
    assert!(found.calibration.projector.distortion.is_zero());
    let Distortion { k1, k2, k3, .. } = found.calibration.camera.distortion;
    assert!(k1 < 0.0 && k2 == 0.0 && k3 == 0.0);
    assert_eq!(found.report.parameters.len(), 7 + 4 + 6);
    assert!(found.report.parameters.iter().all(|p| p.name != "camera.k2"));
}
