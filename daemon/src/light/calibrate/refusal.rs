//! What is refused: views that determine no rig, and results that no one should measure with.

use super::super::LightError;
use super::super::board::BoardView;
use super::bundle::Bundle;
use super::report::Coverage;
use super::zhang::largest_tilt_rad;
use super::{CalibrateOptions, Calibrated};
use glam::{DMat3, DVec2};

/// Fewest corners of a view in either device.
const MIN_CORNERS: usize = 12;
/// Least tilt between two boards, degrees, judged by a lens of a usual field.
const MIN_TILT_DEG: f64 = 5.0;
/// Least share of the camera's picture within the outline of all corners.
const MIN_CAMERA_COVERAGE: f64 = 0.2;
/// The same for the projector, which lights more than the camera sees.
const MIN_PROJECTOR_COVERAGE: f64 = 0.15;
/// Largest share of corners of a view, and of all corners, that may be outliers.
const MAX_REJECTED_OF_VIEW: f64 = 0.5;
const MAX_REJECTED: f64 = 0.2;
/// Largest standard error of a focal length, as a share of it.
const MAX_FOCAL_ERROR: f64 = 0.02;
/// Largest standard error of a point measured at a corner, as a share of its distance; 1.2 mm at 600 mm.
const MAX_POINT_ERROR: f64 = 0.002;

/// Why there is no calibration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// Not enough views.
    #[error("{found} views of the board, at least {need} are needed; capture more, each in another place and tilt")]
    TooFewViews {
        /// Views there are.
        found: usize,
        /// Views needed.
        need: usize,
    },
    /// A view that cannot be used.
    #[error("{view}: {reason}")]
    View {
        /// The view.
        view: String,
        /// What is wrong and what to do.
        reason: String,
    },
    /// The corners of a view are no picture of a plane.
    #[error("{view}: its corners are no picture of a board in the {device}; check it, or leave the view out")]
    NoPlane {
        /// camera or projector.
        device: &'static str,
        /// The view.
        view: String,
    },
    /// All boards parallel.
    #[error(
        "{device}: all boards are parallel within {found_deg:.1} degrees, which leaves the focal length open; tilt the board by 20 to 40 degrees, in another direction in each view"
    )]
    Parallel {
        /// camera or projector.
        device: &'static str,
        /// Largest angle between two boards.
        found_deg: f64,
    },
    /// Too little of the picture seen.
    #[error(
        "{device}: all corners together cover {:.0} % of the picture, at least {:.0} % are needed; bring the board into its corners too, or nearer",
        100.0 * share, 100.0 * need
    )]
    Coverage {
        /// camera or projector.
        device: &'static str,
        /// Share of the picture within the outline of all corners.
        share: f64,
        /// Share needed.
        need: f64,
    },
    /// The closed form gives no lens.
    #[error(
        "{device}: no lens sees the boards like this; check that --board counts inner corners and that all views are of one rig"
    )]
    NoStart {
        /// camera or projector.
        device: &'static str,
    },
    /// The fit does not come to rest.
    #[error("the fit of the {what} does not converge; check the views, or estimate fewer distortion terms")]
    NoMinimum {
        /// camera, projector or rig.
        what: &'static str,
    },
    /// Too many corners that do not fit.
    #[error(
        "{view}: {rejected} of its {corners} corners do not fit the rig that fits the other views; check or leave out that view"
    )]
    ViewOutliers {
        /// The view.
        view: String,
        /// Its outliers.
        rejected: usize,
        /// Its corners.
        corners: usize,
    },
    /// Too many corners that do not fit, over all views.
    #[error("{rejected} of {corners} corners are outliers; something moved, or the board is not flat")]
    Outliers {
        /// Outliers.
        rejected: usize,
        /// Corners.
        corners: usize,
    },
    /// The errors are too large.
    #[error(
        "{device}: rms reprojection error {rms_px:.3} px, at most {limit_px} px are accepted; worst is {view} with {view_rms_px:.3} px: check or leave out that view"
    )]
    Rms {
        /// camera or projector.
        device: &'static str,
        /// Of all views.
        rms_px: f64,
        /// Accepted.
        limit_px: f64,
        /// The worst view.
        view: String,
        /// Its error.
        view_rms_px: f64,
    },
    /// A parameter is not determined.
    #[error(
        "{parameter} is {value:.2} with a standard error of {standard_error:.2}, more than {:.0} %; capture more views with more tilt",
        100.0 * MAX_FOCAL_ERROR
    )]
    Uncertain {
        /// Name as in the report.
        parameter: String,
        /// Value found.
        value: f64,
        /// Its standard error.
        standard_error: f64,
    },
    /// Points would be uncertain.
    #[error(
        "a point measured with this calibration has a standard error of up to {standard_error_mm:.2} mm, more than {:.1} % of its distance; capture more views, or estimate fewer distortion terms",
        100.0 * MAX_POINT_ERROR
    )]
    PointUncertain {
        /// Largest over the corners.
        standard_error_mm: f64,
    },
    /// The normal equations have no inverse.
    #[error("the views leave a combination of parameters open; capture more views with more tilt in all directions")]
    Singular,
    /// The result is no calibration.
    #[error(
        "the result is no usable calibration: {0}; bring the board to the border of the picture, or estimate fewer distortion terms"
    )]
    Result(#[from] LightError),
}

/// Checks number, completeness and spread of the views.
pub(super) fn check_views(
    views: &[BoardView],
    camera_size_px: [u32; 2],
    projector_size_px: [u32; 2],
    options: &CalibrateOptions,
) -> Result<Coverage, CalibrateError> {
    // Three poses determine a lens in the closed form.
    let need = options.min_views.max(3);
    if views.len() < need {
        return Err(CalibrateError::TooFewViews { found: views.len(), need });
    }
    for view in views {
        check_view(view).map_err(|reason| CalibrateError::View { view: view.name.clone(), reason })?;
    }
    let camera: Vec<DVec2> = views.iter().flat_map(|v| &v.camera_px).map(|&p| DVec2::from_array(p)).collect();
    let projector: Vec<DVec2> =
        views.iter().flat_map(|v| v.projector_px.iter().flatten()).map(|&p| DVec2::from_array(p)).collect();
    let share = |points: Vec<DVec2>, [w, h]: [u32; 2]| hull_area(points) / (f64::from(w) * f64::from(h));
    let coverage = Coverage { camera: share(camera, camera_size_px), projector: share(projector, projector_size_px) };
    let limits =
        [("camera", coverage.camera, MIN_CAMERA_COVERAGE), ("projector", coverage.projector, MIN_PROJECTOR_COVERAGE)];
    for (device, share, need) in limits {
        if share < need {
            return Err(CalibrateError::Coverage { device, share, need });
        }
    }
    Ok(coverage)
}

fn check_view(view: &BoardView) -> Result<(), String> {
    let n = view.board_mm.len();
    if view.camera_px.len() != n || view.projector_px.len() != n {
        let (c, p) = (view.camera_px.len(), view.projector_px.len());
        return Err(format!("{n} corners of the board, but {c} of the camera and {p} of the projector"));
    }
    let all = view.board_mm.iter().chain(&view.camera_px).chain(view.projector_px.iter().flatten());
    if !all.flatten().all(|v| v.is_finite() && v.abs() < 1e6) {
        return Err("a corner is not a number, or far outside the picture".into());
    }
    let decoded = view.projector_px.iter().flatten().count();
    if decoded < MIN_CORNERS {
        return Err(format!(
            "the projector's coordinates are known at {decoded} of {n} corners, at least {MIN_CORNERS} are needed; light the whole board, or leave the view out"
        ));
    }
    Ok(())
}

/// Refuses boards that are all parallel: they give every pose the same two equations (Zhang, section 3.1).
pub(super) fn check_tilt(
    device: &'static str,
    homographies: &[DMat3],
    size_px: [u32; 2],
) -> Result<(), CalibrateError> {
    let found_deg = largest_tilt_rad(homographies, size_px).to_degrees();
    if found_deg >= MIN_TILT_DEG { Ok(()) } else { Err(CalibrateError::Parallel { device, found_deg }) }
}

/// Refuses a fit that holds only by leaving much out.
pub(super) fn check_outliers(bundle: &Bundle, names: &[&str]) -> Result<(), CalibrateError> {
    let (mut all_rejected, mut all_corners) = (0, 0);
    for (view, name) in bundle.views.iter().zip(names) {
        let corners = view.corners.len();
        let rejected = view.corners.iter().filter(|c| c.camera_rejected || c.projector_rejected).count();
        if rejected as f64 > MAX_REJECTED_OF_VIEW * corners as f64 {
            return Err(CalibrateError::ViewOutliers { view: (*name).into(), rejected, corners });
        }
        all_rejected += rejected;
        all_corners += corners;
    }
    if all_rejected as f64 > MAX_REJECTED * all_corners as f64 {
        return Err(CalibrateError::Outliers { rejected: all_rejected, corners: all_corners });
    }
    Ok(())
}

/// Refuses a result that is no calibration or too uncertain a one.
pub(super) fn check_result(calibrated: &Calibrated, options: &CalibrateOptions) -> Result<(), CalibrateError> {
    let report = &calibrated.report;
    type RmsOf = fn(&super::ViewReport) -> f64;
    let devices: [(&'static str, f64, RmsOf); 2] = [
        ("camera", report.camera_rms_px, |v| v.camera_rms_px),
        ("projector", report.projector_rms_px, |v| v.projector_rms_px),
    ];
    for (device, rms_px, of_view) in devices {
        // Not a number is refused too.
        let is_good = rms_px <= options.max_rms_px;
        if !is_good {
            let worst = report.views.iter().max_by(|a, b| of_view(a).total_cmp(&of_view(b)));
            let (view, view_rms_px) = worst.map_or((String::new(), rms_px), |v| (v.name.clone(), of_view(v)));
            return Err(CalibrateError::Rms { device, rms_px, limit_px: options.max_rms_px, view, view_rms_px });
        }
    }
    calibrated.calibration.validate()?;
    for parameter in report.parameters.iter().filter(|p| p.name.contains(".f")) {
        let is_good = parameter.standard_error <= MAX_FOCAL_ERROR * parameter.value;
        if !is_good {
            let (value, standard_error) = (parameter.value, parameter.standard_error);
            return Err(CalibrateError::Uncertain { parameter: parameter.name.clone(), value, standard_error });
        }
    }
    let is_good = report.point_standard_error_largest_share <= MAX_POINT_ERROR;
    let standard_error_mm = report.point_standard_error_largest_mm;
    if is_good { Ok(()) } else { Err(CalibrateError::PointUncertain { standard_error_mm }) }
}

/// Area of the convex outline of points (A. Andrew's monotone chain, 1979).
fn hull_area(mut points: Vec<DVec2>) -> f64 {
    points.sort_unstable_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let chain = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut chain: Vec<DVec2> = Vec::new();
        for p in points {
            while let [.., a, b] = chain[..]
                && (b - a).perp_dot(p - a) <= 0.0
            {
                chain.pop();
            }
            chain.push(p);
        }
        chain
    };
    let lower = chain(&mut points.iter().copied());
    let upper = chain(&mut points.iter().rev().copied());
    let outline: Vec<DVec2> = lower.into_iter().chain(upper).collect();
    let next = outline.iter().cycle().skip(1);
    0.5 * outline.iter().zip(next).map(|(a, b)| a.perp_dot(*b)).sum::<f64>()
}
