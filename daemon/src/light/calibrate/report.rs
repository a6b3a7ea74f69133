//! How good a calibration is: errors, standard errors, and what they mean for a measured point.

use super::super::Calibration;
use super::bundle::{Block, Bundle, Corner, POSE, SHARED, View};
use super::lens::{LENS_PARAMETERS, parameters};
use super::minimize::NormalEquations;
use super::{CalibrateError, Calibrated, Residual, ViewResiduals};
use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};
use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::Serialize;
use std::fmt::Write;

/// Names of the parameters of a lens.
const LENS_NAMES: [&str; LENS_PARAMETERS] = ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"];
/// Names of the pose's: rotation vector, translation.
const POSE_NAMES: [&str; POSE] = ["rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"];

/// Share of a picture within the convex outline of all corners.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Coverage {
    /// Of the camera's picture.
    pub camera: f64,
    /// Of the projector's.
    pub projector: f64,
}

/// One view. Root-mean-square values are of the length of the error of a corner, as OpenCV gives them.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewReport {
    /// Name.
    pub name: String,
    /// Corners found in the camera's picture.
    pub corners: usize,
    /// Corners with a projector coordinate.
    pub decoded: usize,
    /// Corners not used in the camera, and therefore in neither device.
    pub camera_rejected: usize,
    /// Corners not used in the projector alone.
    pub projector_rejected: usize,
    /// Error of the used corners in the camera, px.
    pub camera_rms_px: f64,
    /// The same in the projector, px.
    pub projector_rms_px: f64,
    /// Distance of the board from the camera, mm.
    pub distance_mm: f64,
    /// Angle between the board's normal and the camera's axis, degrees.
    pub tilt_deg: f64,
}

/// A parameter shared by all views.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ParameterReport {
    /// As in the TOML file; of the rotation, component of the rotation vector.
    pub name: String,
    /// Value.
    pub value: f64,
    /// Standard error: of the rotation, of a small turn about the projector's axes.
    pub standard_error: f64,
}

/// Standard deviations of the errors along one axis, and how they go together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Noise {
    /// Of the camera's corners, px.
    pub camera_px: f64,
    /// Of the projector's coordinates, px.
    pub projector_px: f64,
    /// Largest correlation of an error of the camera with one of the projector.
    pub correlation: f64,
}

/// How good a calibration is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CalibrationReport {
    /// Root-mean-square length of the error of a used corner in the camera, px.
    pub camera_rms_px: f64,
    /// The same in the projector, px.
    pub projector_rms_px: f64,
    /// Noise found.
    pub noise: Noise,
    /// Corners not used in either device; they are those rejected by four standard deviations.
    pub camera_rejected: usize,
    /// Corners not used in the projector alone.
    pub projector_rejected: usize,
    /// Parts of the pictures seen.
    pub coverage: Coverage,
    /// Median over the corners of the standard error of a point measured there, from the covariance of the parameters and
    /// without what moves all points as one body, mm.
    pub point_standard_error_median_mm: f64,
    /// Largest of them, mm.
    pub point_standard_error_largest_mm: f64,
    /// Largest of them as a share of the distance.
    pub point_standard_error_largest_share: f64,
    /// Condition number of the normal equations of the shared parameters, scaled to a unit diagonal.
    pub condition: f64,
    /// Every estimated shared parameter.
    pub parameters: Vec<ParameterReport>,
    /// Every view.
    pub views: Vec<ViewReport>,
}

/// The report of a fitted bundle.
pub(super) fn report(
    bundle: &Bundle,
    names: &[&str],
    coverage: Coverage,
    noise_px2: &[[f64; 4]; 4],
) -> Result<Calibrated, CalibrateError> {
    let (covariance, condition) = shared_covariance(bundle).ok_or(CalibrateError::Singular)?;
    let views: Vec<ViewReport> = bundle.views.iter().zip(names).map(|(v, name)| view_report(bundle, v, name)).collect();
    let errors = bundle.views.iter().flat_map(|v| v.corners.iter().map(|c| used_errors(bundle, v, c)));
    let (camera, projector): (Vec<_>, Vec<_>) = errors.unzip();
    let point_errors = point_errors(bundle, &covariance);
    let mut point_errors_mm: Vec<f64> = point_errors.iter().map(|e| e.0).collect();
    point_errors_mm.sort_unstable_by(f64::total_cmp);
    let report = CalibrationReport {
        camera_rms_px: rms(&camera),
        projector_rms_px: rms(&projector),
        noise: noise_report(noise_px2),
        camera_rejected: views.iter().map(|v| v.camera_rejected).sum(),
        projector_rejected: views.iter().map(|v| v.projector_rejected).sum(),
        coverage,
        point_standard_error_median_mm: point_errors_mm.get(point_errors_mm.len() / 2).copied().unwrap_or(f64::NAN),
        point_standard_error_largest_mm: point_errors_mm.last().copied().unwrap_or(f64::NAN),
        point_standard_error_largest_share: point_errors.iter().map(|e| e.1).fold(f64::NAN, f64::max),
        condition,
        parameters: parameter_reports(bundle, &covariance),
        views,
    };
    let n = bundle.free.len();
    Ok(Calibrated {
        calibration: bundle.rig,
        report,
        covariance: (0..n).map(|i| (0..n).map(|j| covariance[(i, j)]).collect()).collect(),
        residuals: bundle.views.iter().zip(names).map(|(v, name)| view_residuals(bundle, v, name)).collect(),
    })
}

fn parameter_reports(bundle: &Bundle, covariance: &Mat<f64>) -> Vec<ParameterReport> {
    let values = values(&bundle.rig);
    let report = |(i, &at): (usize, &usize)| ParameterReport {
        name: name(at),
        value: values[at],
        standard_error: covariance[(i, i)].sqrt(),
    };
    bundle.free.iter().enumerate().map(report).collect()
}

/// (J'J)^-1 of the whitened errors, poses marginal, and the condition number of its inverse scaled to a unit diagonal.
fn shared_covariance(bundle: &Bundle) -> Option<(Mat<f64>, f64)> {
    let s = NormalEquations::of(bundle).reduced(0.0)?.s;
    let n = s.nrows();
    let scale: Vec<f64> = (0..n).map(|i| s[(i, i)].sqrt()).collect();
    let scaled = Mat::from_fn(n, n, |i, j| s[(i, j)] / (scale[i] * scale[j]));
    let eigenvalues = scaled.self_adjoint_eigenvalues(Side::Lower).ok()?;
    let (least, most) = (eigenvalues.first()?, eigenvalues.last()?);
    let inverse = scaled.llt(Side::Lower).ok()?.inverse();
    let covariance = Mat::from_fn(n, n, |i, j| inverse[(i, j)] / (scale[i] * scale[j]));
    let is_sound = *least > 0.0 && (0..n).all(|i| covariance[(i, i)].is_finite() && covariance[(i, i)] > 0.0);
    is_sound.then_some((covariance, most / least))
}

/// Values of the shared parameters.
fn values(rig: &Calibration) -> [f64; SHARED] {
    let mut values = [0.0; SHARED];
    values[..LENS_PARAMETERS].copy_from_slice(&parameters(&rig.camera));
    values[LENS_PARAMETERS..2 * LENS_PARAMETERS].copy_from_slice(&parameters(&rig.projector));
    let turn = DQuat::from_mat3(&rig.projector_from_camera.matrix()).to_scaled_axis();
    values[2 * LENS_PARAMETERS..][..3].copy_from_slice(&turn.to_array());
    values[2 * LENS_PARAMETERS + 3..].copy_from_slice(&rig.projector_from_camera.translation_mm);
    values
}

fn name(at: usize) -> String {
    let (lens, i) = (at / LENS_PARAMETERS, at % LENS_PARAMETERS);
    match lens {
        0 => format!("camera.{}", LENS_NAMES[i]),
        1 => format!("projector.{}", LENS_NAMES[i]),
        _ => format!("projector_from_camera.{}", POSE_NAMES[i]),
    }
}

/// Errors of a corner in the devices where it is used.
fn used_errors(bundle: &Bundle, view: &View, corner: &Corner) -> (Option<DVec2>, Option<DVec2>) {
    let (camera, projector) = bundle.errors(view, corner);
    (camera.filter(|_| !corner.camera_rejected), projector.filter(|_| !corner.projector_rejected))
}

fn rms(errors: &[Option<DVec2>]) -> f64 {
    let used = errors.iter().flatten();
    (used.clone().map(|e| e.length_squared()).sum::<f64>() / used.count() as f64).sqrt()
}

fn view_report(bundle: &Bundle, view: &View, name: &str) -> ViewReport {
    let (camera, projector): (Vec<_>, Vec<_>) = view.corners.iter().map(|c| used_errors(bundle, view, c)).unzip();
    let is_decoded = |c: &&Corner| c.projector_px.is_some();
    ViewReport {
        name: name.into(),
        corners: view.corners.len(),
        decoded: view.corners.iter().filter(is_decoded).count(),
        camera_rejected: view.corners.iter().filter(|c| c.camera_rejected).count(),
        projector_rejected: view
            .corners
            .iter()
            .filter(is_decoded)
            .filter(|c| c.projector_rejected && !c.camera_rejected)
            .count(),
        camera_rms_px: rms(&camera),
        projector_rms_px: rms(&projector),
        distance_mm: view.pose.translation_mm.length(),
        tilt_deg: view.pose.rotation.z_axis.z.abs().clamp(0.0, 1.0).acos().to_degrees(),
    }
}

fn view_residuals(bundle: &Bundle, view: &View, name: &str) -> ViewResiduals {
    let residual =
        |at: DVec2, error: DVec2, rejected| Residual { at_px: at.to_array(), error_px: error.to_array(), rejected };
    let mut found = ViewResiduals { name: name.into(), camera: Vec::new(), projector: Vec::new() };
    for corner in &view.corners {
        let (camera, projector) = bundle.errors(view, corner);
        found.camera.extend(camera.map(|e| residual(corner.camera_px, e, corner.camera_rejected)));
        let projector = projector.zip(corner.projector_px);
        found.projector.extend(projector.map(|(e, at)| residual(at, e, corner.projector_rejected)));
    }
    found
}

fn noise_report(c: &[[f64; 4]; 4]) -> Noise {
    let across = [(0, 2), (0, 3), (1, 2), (1, 3)].map(|(i, j)| (c[i][j] / (c[i][i] * c[j][j]).sqrt()).abs());
    Noise {
        camera_px: (0.5 * (c[0][0] + c[1][1])).sqrt(),
        projector_px: (0.5 * (c[2][2] + c[3][3])).sqrt(),
        correlation: across.into_iter().fold(0.0, f64::max),
    }
}

/// Standard error of the point measured at every used corner, mm, and the same by its distance.
///
/// A point is measured from the camera's pixel and the projector's column (row, where the baseline runs along rows): three equations f(X, parameters) = 0, so
/// dX = -(df/dX)^-1 df/dparameters. Both are rows of the corner's block; df/dX is that of the pose's translation. What
/// moves all points as one body changes no shape and is taken out: it is how the camera's axis sits in its housing.
fn point_errors(bundle: &Bundle, covariance: &Mat<f64>) -> Vec<(f64, f64)> {
    let used = bundle.views.iter().flat_map(|view| view.corners.iter().map(move |corner| (view, corner)));
    let blocks = used.map(|(view, c)| (view.pose.apply(c.board_mm.extend(0.0)), bundle.block(view, c)));
    let (points, blocks): (Vec<DVec3>, Vec<Block>) = blocks.filter(|(_, block)| block.rows == 4).unzip();
    let baseline = bundle.rig.projector_from_camera.translation();
    let rows = [0, 1, if baseline.x.abs() >= baseline.y.abs() { 2 } else { 3 }];
    let n = bundle.free.len();
    let mut moves = Mat::<f64>::zeros(3 * points.len(), n);
    for (i, block) in blocks.iter().enumerate() {
        let [a, b, c] = rows.map(|row| DVec3::from_slice(&block.pose[row][3..]));
        let inverse = DMat3::from_cols(a, b, c).transpose().inverse();
        for (k, &at) in bundle.free.iter().enumerate() {
            let moved = inverse * -DVec3::from_array(rows.map(|row| block.shared[row][at]));
            (0..3).for_each(|axis| moves[(3 * i + axis, k)] = moved[axis]);
        }
    }
    let rigid = rigid_motions(&points);
    let shape = &moves - &rigid * (rigid.transpose() * &moves);
    let spread = &shape * covariance;
    let variance = |row: usize| (0..n).map(|k| spread[(row, k)] * shape[(row, k)]).sum::<f64>();
    let error = |(i, point): (usize, &DVec3)| {
        let error_mm = (0..3).map(|axis| variance(3 * i + axis)).sum::<f64>().sqrt();
        (error_mm, error_mm / point.length())
    };
    points.iter().enumerate().map(error).collect()
}

/// Orthonormal basis of the small motions of the points as one body; a column for every turn and shift.
fn rigid_motions(points: &[DVec3]) -> Mat<f64> {
    let mean = points.iter().sum::<DVec3>() / points.len() as f64;
    let motion = |p: DVec3, k: usize| if k < 3 { DVec3::AXES[k].cross(p - mean) } else { DVec3::AXES[k - 3] };
    Mat::from_fn(3 * points.len(), POSE, |row, k| motion(points[row / 3], k)[row % 3]).qr().compute_thin_Q()
}

impl CalibrationReport {
    /// The report in words.
    pub fn describe(&self) -> String {
        let mut text = String::new();
        let corners: usize = self.views.iter().map(|v| v.corners).sum();
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "{} views, {corners} corners; rejected: {} in the camera, {} more in the projector",
            self.views.len(),
            self.camera_rejected,
            self.projector_rejected
        );
        let _ = writeln!(
            text,
            "  rms reprojection error   camera {:.3} px, projector {:.3} px",
            self.camera_rms_px, self.projector_rms_px
        );
        let _ = writeln!(
            text,
            "  shape of what is scanned standard error {:.3} mm (median), {:.3} mm (worst corner)",
            self.point_standard_error_median_mm, self.point_standard_error_largest_mm
        );
        let _ = writeln!(
            text,
            "  outline of the corners   {:.0} % of the camera's picture, {:.0} % of the projector's",
            100.0 * self.coverage.camera,
            100.0 * self.coverage.projector
        );
        let _ = writeln!(text, "  condition                {:.1e}", self.condition);
        let _ = writeln!(text, "\n  {:<32}{:>16}{:>18}", "parameter", "value", "standard error");
        for ParameterReport { name, value, standard_error } in &self.parameters {
            // Two digits of the standard error, and as many decimals of the value.
            let decimals = (1.0 - standard_error.log10().floor()).clamp(0.0, 12.0) as usize;
            let _ = writeln!(text, "  {name:<32}{value:>16.decimals$}{standard_error:>18.decimals$}");
        }
        let head = ["corners", "rejected", "camera px", "projector px", "mm", "tilt"];
        let _ = write!(text, "\n  {:<24}", "view");
        for h in head {
            let _ = write!(text, "{h:>13}");
        }
        for v in &self.views {
            let rejected = v.camera_rejected + v.projector_rejected;
            let _ = write!(
                text,
                "\n  {:<24}{:>13}{rejected:>13}{:>13.3}{:>13.3}{:>13.0}{:>12.0}°",
                v.name, v.corners, v.camera_rms_px, v.projector_rms_px, v.distance_mm, v.tilt_deg
            );
        }
        text
    }
}
