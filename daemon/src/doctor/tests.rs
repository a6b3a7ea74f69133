use super::*;
use crate::device::sim::{Fault, FaultKind, SceneConfig};
use crate::device::{Backend, V4lConfig};

fn plane() -> RigConfig {
    let mut config = RigConfig::simulated();
    config.sim.scene = SceneConfig::Plane;
    config
}

fn of(config: &RigConfig) -> Report {
    let folder = tempfile::tempdir().unwrap();
    let mut seen = Vec::new();
    let report = run_in(config, folder.path(), |check| seen.push(check.clone()));
    assert_eq!((seen.len(), &seen), (CHECK_COUNT, &report.checks));
    assert!(report.checks.iter().all(|c| (c.outcome == Outcome::Fail) != c.action.is_empty()), "{report:?}");
    report
}

fn check<'a>(report: &'a Report, name: &str) -> &'a Check {
    report.checks.iter().find(|check| check.name == name).unwrap()
}

/// That the check fails, and no other one but those named.
fn fails(config: &RigConfig, name: &str, with_it: &[&str], detail: &str) {
    let report = of(config);
    let failed: Vec<_> = report.checks.iter().filter(|c| c.outcome == Outcome::Fail).map(|c| c.name).collect();
    assert!(failed.contains(&name) && failed.iter().all(|f| *f == name || with_it.contains(f)), "{report:#?}");
    assert!(check(&report, name).detail.contains(detail), "{:?}", check(&report, name));
}

#[test]
fn the_simulated_scanner_is_well() {
    for config in [RigConfig::simulated(), plane()] {
        let report = of(&config);
        assert!(report.is_well(), "{report:#?}");
        let skipped: Vec<_> = report.checks.iter().filter(|c| c.outcome == Outcome::Skip).map(|c| c.name).collect();
        assert_eq!(skipped, ["rights", "usb_speed"]);
    }
}

#[test]
fn lost_pictures_fail_the_order_and_many_the_trigger() {
    let mut config = plane();
    config.sim.faults = vec![Fault { kind: FaultKind::Lost, set: 3, picture: 2 }];
    fails(&config, "order", &[], "lost 1");
    let all = |set| (0..6).map(move |picture| Fault { kind: FaultKind::Lost, set, picture });
    config.sim.faults = (2..12).flat_map(all).collect();
    fails(&config, "trigger", &["order"], "60 are missing");
}

#[test]
fn a_camera_that_goes_away_is_named() {
    let mut config = plane();
    config.sim.faults = vec![Fault { kind: FaultKind::Unplugged, set: 3, picture: 2 }];
    fails(&config, "devices", &["order", "trigger"], "disconnected");
}

#[test]
fn devices_that_are_not_there_leave_the_rest_unchecked() {
    let mut config = plane();
    config.camera.backend = Backend::V4l;
    config.camera.v4l = Some(V4lConfig { name: Some("no such camera".into()), ..V4lConfig::default() });
    let report = of(&config);
    assert_eq!(check(&report, "devices").outcome, Outcome::Fail);
    assert_eq!(check(&report, "order").outcome, Outcome::Skip);
}

#[test]
fn a_camera_that_follows_no_schedule_fails_the_clock() {
    let mut config = plane();
    config.sim.clock_drift_ppm = 50.0;
    assert!(of(&config).is_well());
    config.sim.clock_drift_ppm = 900.0;
    fails(&config, "clock", &[], "+900");
}

#[test]
fn too_little_light_and_too_much_are_told_apart() {
    let mut config = plane();
    config.timing.exposure_nanos = 1_200_000;
    fails(&config, "exposure", &["calibration"], "at 1.200 ms");
    config.timing.exposure_nanos = 100_000;
    fails(&config, "exposure", &["calibration"], "0.0 %");
    let mut config = plane();
    config.timing.picture_period_nanos = 12_000_000;
    config.timing.exposure_nanos = 12_000_000;
    fails(&config, "saturation", &["calibration"], "reach level 252");
}

#[test]
fn gamma_fails_the_linearity() {
    let mut config = plane();
    config.sim.projector_gamma = 2.2;
    // Its ripple takes rows off their epipolar lines, too.
    fails(&config, "linearity", &["calibration"], "gamma about 2.2");
    config.processing.gamma_file = Some("gamma.toml".into());
    let test = TestPictures::take(&RigConfig { processing: RigConfig::simulated().processing, ..config.clone() });
    let found = linearity::check(&config, &test);
    assert!(found.outcome == Outcome::Pass && found.detail.contains("gamma.toml corrects it"), "{found:?}");
}

#[test]
fn a_calibration_of_another_rig_does_not_fit() {
    let config = plane();
    let test = TestPictures::take(&config);
    assert_eq!(calibration::check(&config, &test).outcome, Outcome::Pass);
    let mut other = config.clone();
    // The projector was moved by two millimetres across the baseline: the epipolar lines are nine pixels off.
    if let Some(calibration) = &mut other.calibration {
        let pose = calibration.projector_from_camera;
        let moved = pose.translation() + glam::DVec3::new(0.0, 2.0, 0.0);
        calibration.projector_from_camera = crate::light::Rigid::new(pose.matrix(), moved);
    }
    let found = calibration::check(&other, &test);
    assert_eq!(found.outcome, Outcome::Fail);
    assert!(found.action.contains("calibrate"), "{found:?}");
}

#[test]
fn an_old_calibration_is_to_be_looked_after() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = plane();
    let path = folder.path().join("calibration.toml");
    std::fs::write(&path, config.calibration.take().unwrap().to_toml().unwrap()).unwrap();
    config.calibration_file = Some(path.clone());
    let test = TestPictures::take(&config);
    assert_eq!(calibration::check(&config, &test).outcome, Outcome::Pass);
    let year = std::time::Duration::from_secs(370 * 86_400);
    let file = std::fs::File::options().write(true).open(&path).unwrap();
    file.set_modified(std::time::SystemTime::now() - year).unwrap();
    let found = calibration::check(&config, &test);
    assert!(found.outcome == Outcome::Fail && found.detail.starts_with("370 days"), "{found:?}");
}
