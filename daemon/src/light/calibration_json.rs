//! Calibrations in JSON: matrices `Kc` and `Kp`, distortions `dc` and `dp` in OpenCV's order, `R` and `T` of
//! x_projector = R x_camera + T, mm; whole-numbered projector coordinates are pixel centres.

use super::{Calibration, Distortion, Intrinsics, LightError, Rigid};
use glam::{DMat3, DVec3};
use serde::Deserialize;

/// The keys that are read; others are notes of the program that wrote them.
#[derive(Debug, Deserialize)]
struct Text {
    #[serde(rename = "Kc")]
    camera_matrix: [[f64; 3]; 3],
    #[serde(rename = "dc")]
    camera_distortion: Vec<f64>,
    #[serde(rename = "Kp")]
    projector_matrix: [[f64; 3]; 3],
    #[serde(rename = "dp")]
    projector_distortion: Vec<f64>,
    #[serde(rename = "R")]
    rotation: [[f64; 3]; 3],
    #[serde(rename = "T")]
    translation_mm: [f64; 3],
    camera_size: Option<[u32; 2]>,
    projector_size: Option<[u32; 2]>,
}

impl Calibration {
    /// Reads and checks a calibration in JSON. The sizes, columns and rows, count where the text has no `camera_size` or
    /// `projector_size`.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the value, or line and column of text that is no such JSON.
    pub fn from_json(text: &str, camera_px: [u32; 2], projector_px: [u32; 2]) -> Result<Self, LightError> {
        let text: Text = serde_json::from_str(text).map_err(|e| LightError::field("JSON", e.to_string()))?;
        let camera_px = text.camera_size.unwrap_or(camera_px);
        let projector_px = text.projector_size.unwrap_or(projector_px);
        let rotation = DMat3::from_cols_array_2d(&text.rotation).transpose();
        let calibration = Self {
            camera: intrinsics(["Kc", "dc"], camera_px, text.camera_matrix, &text.camera_distortion)?,
            projector: intrinsics(["Kp", "dp"], projector_px, text.projector_matrix, &text.projector_distortion)?,
            projector_from_camera: Rigid::new(rotation, DVec3::from_array(text.translation_mm)),
        };
        calibration.validate()?;
        Ok(calibration)
    }
}

fn intrinsics(keys: [&str; 2], px: [u32; 2], k: [[f64; 3]; 3], d: &[f64]) -> Result<Intrinsics, LightError> {
    if k[0][1] != 0.0 || k[1][0] != 0.0 || k[2] != [0.0, 0.0, 1.0] {
        return Err(LightError::field(keys[0], "expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"));
    }
    let distortion = Distortion::from_opencv(d).map_err(|reason| LightError::field(keys[1], reason))?;
    let [width_px, height_px] = px;
    Ok(Intrinsics { width_px, height_px, fx_px: k[0][0], fy_px: k[1][1], cx_px: k[0][2], cy_px: k[1][2], distortion })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;

    fn text() -> String {
        let c = rig();
        let k = |i: Intrinsics| [[i.fx_px, 0.0, i.cx_px], [0.0, i.fy_px, i.cy_px], [0.0, 0.0, 1.0]];
        let d = |i: Intrinsics| [i.distortion.k1, i.distortion.k2, i.distortion.p1, i.distortion.p2, i.distortion.k3];
        serde_json::json!({
            "note": "ours", "Kc": k(c.camera), "dc": d(c.camera), "Kp": k(c.projector), "dp": d(c.projector),
            "R": c.projector_from_camera.rotation, "T": c.projector_from_camera.translation_mm,
        })
        .to_string()
    }

    #[test]
    fn the_rig_comes_back_and_errors_name_the_key() {
        let found = Calibration::from_json(&text(), [640, 480], [912, 1140]).unwrap();
        assert_eq!((found.camera, found.projector), (rig().camera, rig().projector));
        let (pose, expected) = (found.projector_from_camera, rig().projector_from_camera);
        assert!(pose.matrix().abs_diff_eq(expected.matrix(), 1e-14));
        assert!(pose.translation().abs_diff_eq(expected.translation(), 1e-10));
        let error = |from: &str, to: &str| {
            let changed = text().replace(from, to);
            assert_ne!(changed, text());
            Calibration::from_json(&changed, [640, 480], [912, 1140]).unwrap_err().to_string()
        };
        assert!(error("\"dp\"", "\"xx\"").contains("dp"));
        assert!(error("[0.0,0.0,1.0]", "[0.0,0.0,2.0]").starts_with("K"));
        assert!(error("1150.0", "1e999").contains("line 1"));
        assert!(error("1150.0", "-3.0").starts_with("camera.fx_px"));
    }
}
