//! A rig that is little work, for tests that run live, those of `daemon/tests` among them.

use gv3::device::RigConfig;

/// The simulated scanner with a camera of 160x120 at 30 scans a second.
pub fn small_rig() -> RigConfig {
    let mut rig = RigConfig::simulated();
    let mut calibration = rig.calibration.unwrap();
    let camera = &mut calibration.camera;
    (camera.width_px, camera.height_px) = (160, 120);
    for px in [&mut camera.fx_px, &mut camera.fy_px, &mut camera.cx_px, &mut camera.cy_px] {
        *px /= 4.0;
    }
    rig.calibration = Some(calibration);
    (rig.camera.width_px, rig.camera.height_px) = (160, 120);
    rig.limits.mesh.min_piece_px = 50;
    rig
}
