//! Calibration of camera, projector and the pose between them from views of a chessboard.
//!
//! The projector is an inverse camera: phase or Gray code decoded at the corners of the board says which projector pixel
//! lights each, as if the projector had seen it (S. Zhang and P. Huang, "Novel method for structured light system
//! calibration", Opt. Eng. 45(8), 2006). Both lenses then start from Zhang's closed form, are fitted alone, and at last
//! everything is fitted together: both lenses, the pose between them, and the pose of the board in every view.
//!
//! Pixels and projector codes name pixel centres: (0, 0) is the centre of the first pixel, and a picture of w columns
//! reaches from -0.5 to w - 0.5. OpenCV counts in the same way.
//!
//! What the noise is like is taken from the errors: after outliers are gone, the covariance of the four errors of a
//! corner weights them (generalised least squares), which makes the standard errors those of the noise that is there. A
//! corner found beside its place is decoded beside it too, so the errors of the two devices are not independent.

mod bundle;
mod lens;
mod minimize;
mod noise;
mod refusal;
mod report;
mod zhang;

use super::homography::fit_homography;
use super::{BoardView, Calibration, Distortion, Intrinsics, Rigid};
use bundle::{Bundle, Corner, SHARED, View};
use glam::{DMat3, DQuat, DVec2, DVec3};
use lens::LENS_PARAMETERS;
use minimize::{COARSE, EXACT, minimize};
use zhang::Pose;

pub use refusal::CalibrateError;
pub use report::{CalibrationReport, Coverage, Noise, ParameterReport, ViewReport};

/// Times the noise and the outliers are judged anew.
const MAX_ROUNDS: usize = 12;

/// Coefficients of the distortion to estimate; the others stay zero.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DistortionTerms {
    /// Radial, second order.
    pub k1: bool,
    /// Radial, fourth order.
    pub k2: bool,
    /// Both tangential ones.
    pub tangential: bool,
    /// Radial, sixth order; needs corners far out in the picture.
    pub k3: bool,
}

impl Default for DistortionTerms {
    fn default() -> Self {
        Self { k1: true, k2: true, tangential: true, k3: false }
    }
}

/// How to calibrate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibrateOptions {
    /// Fewest views; three determine a lens, more average its noise.
    pub min_views: usize,
    /// The camera's distortion.
    pub camera: DistortionTerms,
    /// The projector's distortion.
    pub projector: DistortionTerms,
    /// Largest root-mean-square reprojection error of either device, px.
    pub max_rms_px: f64,
}

impl Default for CalibrateOptions {
    fn default() -> Self {
        let terms = DistortionTerms::default();
        Self { min_views: 6, camera: terms, projector: terms, max_rms_px: 1.0 }
    }
}

/// Error of one corner: where it was measured and measured minus projected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// Measured pixel.
    pub at_px: [f64; 2],
    /// Measured minus projected, px.
    pub error_px: [f64; 2],
    /// Not used in the fit.
    pub rejected: bool,
}

/// Errors of one view.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewResiduals {
    /// The view.
    pub name: String,
    /// In the camera's picture.
    pub camera: Vec<Residual>,
    /// In the projector's.
    pub projector: Vec<Residual>,
}

/// A rig as calibrated.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibrated {
    /// The rig.
    pub calibration: Calibration,
    /// How good it is.
    pub report: CalibrationReport,
    /// Covariance of the estimated shared parameters, row-major, in the order of [`CalibrationReport::parameters`].
    pub covariance: Vec<Vec<f64>>,
    /// Every error, for a picture of them.
    pub residuals: Vec<ViewResiduals>,
}

/// Calibrates a rig from views of a board. Sizes are columns and rows of the pictures.
///
/// # Errors
/// [`CalibrateError`] when the views cannot determine the rig, or do so badly; it says which and what to do.
pub fn calibrate(
    views: &[BoardView],
    camera_size_px: [u32; 2],
    projector_size_px: [u32; 2],
    options: &CalibrateOptions,
) -> Result<Calibrated, CalibrateError> {
    let coverage = refusal::check_views(views, camera_size_px, projector_size_px, options)?;
    let camera_corners: Vec<Vec<Corner>> = views.iter().map(corners).collect();
    let projector_corners: Vec<Vec<Corner>> = camera_corners.iter().map(|c| seen_by_projector(c)).collect();
    let (camera, camera_poses) = fit_lens("camera", views, &camera_corners, camera_size_px, options.camera)?;
    let (projector, projector_poses) =
        fit_lens("projector", views, &projector_corners, projector_size_px, options.projector)?;
    let rig = Calibration { camera, projector, projector_from_camera: between(&camera_poses, &projector_poses) };
    let lens_free = |terms: DistortionTerms, at: usize| free(terms).into_iter().map(move |i| at + i);
    let free = lens_free(options.camera, 0)
        .chain(lens_free(options.projector, LENS_PARAMETERS))
        .chain(2 * LENS_PARAMETERS..SHARED)
        .collect();
    let views_of = |(pose, corners): (Pose, Vec<Corner>)| View { pose, corners };
    let bundle_views = camera_poses.into_iter().zip(camera_corners).map(views_of).collect();
    let mut bundle = Bundle { rig, views: bundle_views, free, whitening: [[0.0; 4]; 4], huber: noise::HUBER };
    let names: Vec<&str> = views.iter().map(|v| v.name.as_str()).collect();
    let covariance_px2 = fit_rig(&mut bundle, &names)?;
    let calibrated = report::report(&bundle, &names, coverage, &covariance_px2)?;
    refusal::check_result(&calibrated, options)?;
    Ok(calibrated)
}

fn corners(view: &BoardView) -> Vec<Corner> {
    let pixels = view.camera_px.iter().zip(&view.projector_px);
    view.board_mm
        .iter()
        .zip(pixels)
        .map(|(&board, (&camera, &projector))| Corner {
            board_mm: DVec2::from_array(board),
            camera_px: DVec2::from_array(camera),
            projector_px: projector.map(DVec2::from_array),
            camera_rejected: false,
            projector_rejected: false,
        })
        .collect()
}

/// The corners as the projector's, alone.
fn seen_by_projector(corners: &[Corner]) -> Vec<Corner> {
    let seen = |c: &Corner| c.projector_px.map(|camera_px| Corner { camera_px, projector_px: None, ..*c });
    corners.iter().filter_map(seen).collect()
}

/// Parameters of a lens to estimate.
fn free(terms: DistortionTerms) -> Vec<usize> {
    let DistortionTerms { k1, k2, tangential, k3 } = terms;
    let wanted = [true, true, true, true, k1, k2, tangential, tangential, k3];
    (0..LENS_PARAMETERS).filter(|&i| wanted[i]).collect()
}

/// One lens alone and the pose of the board before it in every view.
fn fit_lens(
    device: &'static str,
    views: &[BoardView],
    corners: &[Vec<Corner>],
    size_px: [u32; 2],
    terms: DistortionTerms,
) -> Result<(Intrinsics, Vec<Pose>), CalibrateError> {
    let mut homographies = Vec::with_capacity(views.len());
    for (view, corners) in views.iter().zip(corners) {
        let (board, px): (Vec<_>, Vec<_>) = corners.iter().map(|c| (c.board_mm, c.camera_px)).unzip();
        let found = fit_homography(&board, &px).filter(|h| h.determinant().abs() > 0.0);
        homographies.push(found.ok_or_else(|| CalibrateError::NoPlane { device, view: view.name.clone() })?);
    }
    refusal::check_tilt(device, &homographies, size_px)?;
    let matrix = zhang::lens_matrix(&homographies, size_px).ok_or(CalibrateError::NoStart { device })?;
    let lens = Intrinsics {
        width_px: size_px[0],
        height_px: size_px[1],
        fx_px: matrix.x_axis.x,
        fy_px: matrix.y_axis.y,
        cx_px: matrix.z_axis.x,
        cy_px: matrix.z_axis.y,
        distortion: Distortion::default(),
    };
    let start = |(h, corners): (&DMat3, &Vec<Corner>)| View { pose: zhang::pose(matrix, *h), corners: corners.clone() };
    // The projector of this rig is not looked at.
    let rig =
        Calibration { camera: lens, projector: lens, projector_from_camera: Rigid::new(DMat3::IDENTITY, DVec3::ZERO) };
    let mut bundle = Bundle {
        rig,
        views: homographies.iter().zip(corners).map(start).collect(),
        free: free(terms),
        whitening: [[0.0; 4]; 4],
        huber: noise::HUBER,
    };
    robust_fit(&mut bundle).ok_or(CalibrateError::NoMinimum { what: device })?;
    Ok((bundle.rig.camera, bundle.views.iter().map(|v| v.pose).collect()))
}

/// The fit that a few wrong corners cannot pull away; `None` when it does not come to rest.
fn robust_fit(bundle: &mut Bundle) -> Option<()> {
    for _ in 0..3 {
        bundle.whitening = noise::robust_whitening(bundle);
        minimize(bundle, COARSE)?;
    }
    Some(())
}

/// projector_from_camera from the board's poses before both, by the median of each component.
fn between(camera: &[Pose], projector: &[Pose]) -> Rigid {
    let relative: Vec<(DQuat, DVec3)> = camera
        .iter()
        .zip(projector)
        .map(|(c, p)| {
            let rotation = p.rotation * c.rotation.transpose();
            (DQuat::from_mat3(&rotation), p.translation_mm - rotation * c.translation_mm)
        })
        .collect();
    let median = |value: &dyn Fn(&(DQuat, DVec3)) -> f64| {
        let mut values: Vec<f64> = relative.iter().map(value).collect();
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    // q and -q are one rotation: all on the side of the first.
    let first = relative.first().map_or(DQuat::IDENTITY, |r| r.0);
    let component = |i: usize| median(&|(q, _)| (*q * q.dot(first).signum()).to_array()[i]);
    let rotation = DQuat::from_xyzw(component(0), component(1), component(2), component(3)).normalize();
    let translation = DVec3::from_array([0, 1, 2].map(|i| median(&|(_, t)| t[i])));
    Rigid::new(DMat3::from_quat(rotation), translation)
}

/// Everything together: first against outliers, then least squares of what is left, weighted by its own covariance,
/// until neither changes. Returns that covariance, px^2.
fn fit_rig(bundle: &mut Bundle, names: &[&str]) -> Result<[[f64; 4]; 4], CalibrateError> {
    let failed = || CalibrateError::NoMinimum { what: "rig" };
    robust_fit(bundle).ok_or_else(failed)?;
    bundle.whitening = noise::robust_whitening(bundle);
    bundle.huber = f64::INFINITY;
    let mut before = [[0.0; 4]; 4];
    for _ in 0..MAX_ROUNDS {
        let changed = noise::mark_outliers(bundle);
        refusal::check_outliers(bundle, names)?;
        minimize(bundle, EXACT).ok_or_else(failed)?;
        let covariance = noise::covariance(bundle).ok_or_else(failed)?;
        bundle.whitening = noise::whitening(&covariance).ok_or_else(failed)?;
        let is_same = (0..4).all(|i| (covariance[i][i] - before[i][i]).abs() <= 1e-3 * covariance[i][i]);
        before = covariance;
        if changed == 0 && is_same {
            break;
        }
    }
    Ok(before)
}

#[cfg(test)]
mod tests;
