//! Does the calibration fit the rig as it stands?

use super::Check;
use super::test_patterns::{RAMP, TestPictures};
use crate::device::RigConfig;
use crate::light::{AbsoluteDecoder, Calibration, Direction, LightError, PixelMask, epipolar_distance_px};
use glam::DVec2;
use gv3_codec::GreyPicture;
use std::time::{Duration, SystemTime};

pub(super) const NAME: &str = "calibration";

/// A calibration older than this is to be looked after.
const MOST_AGE_DAYS: u64 = 180;
/// Largest median distance from the epipolar line, projector pixels: a good calibration has a few tenths.
const MOST_DISTANCE_PX: f64 = 0.6;
/// Pixels that make a median.
const LEAST_PIXELS: usize = 500;
/// Every how many pixels one is measured.
const STRIDE: usize = 5;
const DAY: Duration = Duration::from_secs(86_400);

/// Looks at the age of the calibration's file, and at the distances from the epipolar lines.
pub(super) fn check(config: &RigConfig, test: &TestPictures) -> Check {
    let age_days = age_days(config);
    let age = age_days.map_or("its age is unknown".into(), |days| format!("{days} days old"));
    let calibration = match config.calibration() {
        Ok(calibration) => calibration,
        Err(error) => {
            return Check::fail(NAME, error.to_string(), "gv3 calibrate, and name its file in calibration_file");
        }
    };
    let median_px = match &test.pictures {
        Ok(pictures) => median_distance_px(&calibration, config, test, &pictures[RAMP..]),
        Err(reason) => Err(reason.clone()),
    };
    let action = "after what fails above, calibrate anew (gv3 calibrate): camera, lens or projector were moved, or the temperature is another";
    match median_px {
        Ok(median_px) => {
            let detail = format!("{age}; pixels are {median_px:.2} px off their epipolar lines (median)");
            match (median_px <= MOST_DISTANCE_PX, age_days.is_some_and(|days| days > MOST_AGE_DAYS)) {
                (true, false) => Check::pass(NAME, detail),
                (true, true) => Check::fail(
                    NAME,
                    detail,
                    "it still fits, but is old: gv3 accuracy on a known plane, or calibrate anew",
                ),
                (false, _) => Check::fail(NAME, detail, action),
            }
        }
        Err(reason) if age_days.is_some_and(|days| days > MOST_AGE_DAYS) => {
            Check::fail(NAME, format!("{age}; its fit is not known: {reason}"), action)
        }
        Err(reason) => Check::skip(NAME, format!("{age}; its fit is not known: {reason}")),
    }
}

/// Days since the calibration's file was written; `None` for one in the rig's own file.
fn age_days(config: &RigConfig) -> Option<u64> {
    let written = std::fs::metadata(config.calibration_file.as_ref()?).and_then(|m| m.modified()).ok()?;
    Some(SystemTime::now().duration_since(written).unwrap_or_default().as_secs() / DAY.as_secs())
}

/// Median distance of the measured projector pixels from their epipolar lines.
fn median_distance_px(
    calibration: &Calibration,
    config: &RigConfig,
    test: &TestPictures,
    fringes: &[GreyPicture],
) -> Result<f64, String> {
    let width = calibration.camera.width_px as usize;
    let mut mask = PixelMask::new(width, calibration.camera.height_px as usize);
    let [columns, rows] = coordinates_px(config, test, fringes, &mut mask).map_err(|error| error.to_string())?;
    let mut distances: Vec<f64> = (0..mask.verdicts.len())
        .step_by(STRIDE)
        .filter(|&i| mask.is_kept(i))
        .filter_map(|i| {
            let camera_px = DVec2::new((i % width) as f64, (i / width) as f64);
            epipolar_distance_px(calibration, camera_px, DVec2::new(columns[i].into(), rows[i].into()))
        })
        .collect();
    if distances.len() < LEAST_PIXELS {
        return Err(format!(
            "only {} pixels were measured; put something bright into the working range",
            distances.len()
        ));
    }
    distances.sort_unstable_by(f64::total_cmp);
    Ok(distances[distances.len() / 2])
}

/// Projector column and row of every kept pixel, without the help of a calibration.
fn coordinates_px(
    config: &RigConfig,
    test: &TestPictures,
    fringes: &[GreyPicture],
    mask: &mut PixelMask,
) -> Result<[Vec<f32>; 2], LightError> {
    let sequence = test.fringes();
    let pictures: Vec<&GreyPicture> = fringes.iter().collect();
    let mut found = [Vec::new(), Vec::new()];
    for (direction, out) in [Direction::Columns, Direction::Rows].into_iter().zip(&mut found) {
        let decoder = AbsoluteDecoder::uncalibrated(&sequence, direction, config.limits.mask)?;
        let Some(decoder) = decoder else { continue };
        let measured = decoder.measure(&pictures, mask);
        *out = decoder.resolve(&pictures, &measured, mask);
    }
    mask.erode();
    Ok(found)
}
