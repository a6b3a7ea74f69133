//! Calibrations as OpenCV's stereo calibration stores them, the camera being its first and the projector its second.
//!
//! | | read, the first that is there | written |
//! |---|---|---|
//! | matrix | `cameraMatrix1` `M1` `K1` `cam_K` `cam_int`; `cameraMatrix2` `M2` `K2` `proj_K` `proj_int` | `cameraMatrix1`, `cameraMatrix2` |
//! | distortion, k1 k2 p1 p2 and k3 | `distCoeffs1` `D1` `cam_kc` `cam_dist`; `distCoeffs2` `D2` `proj_kc` `proj_dist` | `distCoeffs1`, `distCoeffs2` |
//! | x_2 = R x_1 + T, mm | `R` `rotation`; `T` `translation` | `R`, `T` |
//! | columns and rows | `imageSize1` `imageSize` `image_size` `camera_size`; `imageSize2` `projector_size` | `imageSize1`, `imageSize2` |
//!
//! `M1`... are those of OpenCV's stereo_calib sample (both of its files in one), `cam_K`... those of Moreno and Taubin's
//! projector-camera calibration, `cam_int`... those of procam-calibration. OpenCV leaves the unit of T to its user: it must
//! be millimetres. Whole-numbered pixels are pixel centres in OpenCV as here.

use super::opencv_yaml::{Numbers, OpencvYaml};
use super::{Calibration, Distortion, Intrinsics, LightError, Rigid};
use std::fmt::Write;

const CAMERA: LensKeys = LensKeys {
    matrix: &["cameraMatrix1", "M1", "K1", "cam_K", "cam_int"],
    distortion: &["distCoeffs1", "D1", "cam_kc", "cam_dist"],
    size: &["imageSize1", "imageSize", "image_size", "camera_size"],
};
const PROJECTOR: LensKeys = LensKeys {
    matrix: &["cameraMatrix2", "M2", "K2", "proj_K", "proj_int"],
    distortion: &["distCoeffs2", "D2", "proj_kc", "proj_dist"],
    size: &["imageSize2", "projector_size"],
};
const ROTATION: [&str; 2] = ["R", "rotation"];
const TRANSLATION: [&str; 2] = ["T", "translation"];

struct LensKeys {
    matrix: &'static [&'static str],
    distortion: &'static [&'static str],
    size: &'static [&'static str],
}

/// What is read of a lens, its size perhaps not.
struct Lens {
    matrix: [[f64; 3]; 3],
    distortion: Distortion,
    size_px: Option<[u32; 2]>,
}

impl Calibration {
    /// Reads and checks a calibration in OpenCV's YAML. `sizes` gives columns and rows of camera and projector; it is asked
    /// where the text does not say them.
    ///
    /// # Errors
    /// [`LightError::Field`] naming line and key, or what `sizes` gives.
    pub fn from_opencv<E: From<LightError>>(
        text: &str,
        sizes: impl FnOnce() -> Result<[[u32; 2]; 2], E>,
    ) -> Result<Self, E> {
        let yaml = OpencvYaml::parse(text)?;
        let (camera, projector) = (lens(&yaml, &CAMERA)?, lens(&yaml, &PROJECTOR)?);
        let rotation = matrix(required(&yaml, &ROTATION)?)?;
        let (place, Numbers { values, .. }) = required(&yaml, &TRANSLATION)?;
        let &[x, y, z] = &values[..] else {
            return Err(LightError::field(place, format!("{} numbers, expected three", values.len())).into());
        };
        let [camera_px, projector_px] = match (camera.size_px, projector.size_px) {
            (Some(camera), Some(projector)) => [camera, projector],
            (camera, projector) => {
                let [camera_px, projector_px] = sizes()?;
                [camera.unwrap_or(camera_px), projector.unwrap_or(projector_px)]
            }
        };
        let calibration = Self {
            camera: camera.intrinsics(camera_px),
            projector: projector.intrinsics(projector_px),
            projector_from_camera: Rigid { rotation, translation_mm: [x, y, z] },
        };
        calibration.validate()?;
        Ok(calibration)
    }

    /// The calibration in OpenCV's YAML; [`Self::from_opencv`] gives back the same numbers.
    pub fn to_opencv(&self) -> String {
        let mut text = String::from("%YAML:1.0\n---\n");
        for (number, lens) in [(1, &self.camera), (2, &self.projector)] {
            let Distortion { k1, k2, p1, p2, k3 } = lens.distortion;
            let matrix = [lens.fx_px, 0.0, lens.cx_px, 0.0, lens.fy_px, lens.cy_px, 0.0, 0.0, 1.0];
            write_matrix(&mut text, &format!("cameraMatrix{number}"), [3, 3], &matrix);
            write_matrix(&mut text, &format!("distCoeffs{number}"), [1, 5], &[k1, k2, p1, p2, k3]);
            // Writing to a String cannot fail.
            let _ = writeln!(text, "imageSize{number}: [ {}, {} ]", lens.width_px, lens.height_px);
        }
        write_matrix(&mut text, "R", [3, 3], self.projector_from_camera.rotation.as_flattened());
        write_matrix(&mut text, "T", [3, 1], &self.projector_from_camera.translation_mm);
        text
    }
}

impl Lens {
    fn intrinsics(&self, [width_px, height_px]: [u32; 2]) -> Intrinsics {
        let [[fx_px, _, cx_px], [_, fy_px, cy_px], _] = self.matrix;
        Intrinsics { width_px, height_px, fx_px, fy_px, cx_px, cy_px, distortion: self.distortion }
    }
}

fn required(yaml: &OpencvYaml, keys: &[&str]) -> Result<(String, Numbers), LightError> {
    yaml.numbers(keys)?.ok_or_else(|| LightError::field(keys[0], format!("missing; names read: {}", keys.join(", "))))
}

fn matrix((place, numbers): (String, Numbers)) -> Result<[[f64; 3]; 3], LightError> {
    let Numbers { rows, columns, values } = numbers;
    match values[..] {
        [a, b, c, d, e, f, g, h, i] if rows == 3 && columns == 3 => Ok([[a, b, c], [d, e, f], [g, h, i]]),
        _ => Err(LightError::field(place, format!("{rows} x {columns} numbers, expected 3 x 3"))),
    }
}

fn lens(yaml: &OpencvYaml, keys: &LensKeys) -> Result<Lens, LightError> {
    let (place, numbers) = required(yaml, keys.matrix)?;
    let matrix = matrix((place.clone(), numbers))?;
    if matrix[0][1] != 0.0 || matrix[1][0] != 0.0 || matrix[2] != [0.0, 0.0, 1.0] {
        return Err(LightError::field(place, "expected fx 0 cx, 0 fy cy, 0 0 1"));
    }
    let (place, Numbers { values, .. }) = required(yaml, keys.distortion)?;
    let distortion = Distortion::from_opencv(&values).map_err(|reason| LightError::field(place, reason))?;
    let size_px = yaml.numbers(keys.size)?.map(|(place, Numbers { values, .. })| {
        let side = |v: f64| (v.fract() == 0.0 && (1.0..=16_384.0).contains(&v)).then_some(v as u32);
        let sides = if let &[w, h] = &values[..] { side(w).zip(side(h)) } else { None };
        sides.map(|(w, h)| [w, h]).ok_or_else(|| LightError::field(place, "expected columns and rows, 1..=16384 each"))
    });
    Ok(Lens { matrix, distortion, size_px: size_px.transpose()? })
}

fn write_matrix(text: &mut String, key: &str, [rows, columns]: [usize; 2], values: &[f64]) {
    // The shortest decimals that give the same number back.
    let values: Vec<String> = values.iter().map(|v| format!("{v:?}")).collect();
    let _ = writeln!(text, "{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d");
    let lines: Vec<String> = values.chunks(3).map(|line| line.join(", ")).collect();
    let _ = writeln!(text, "   data: [ {} ]", lines.join(",\n       "));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;

    fn read(text: &str) -> Result<Calibration, LightError> {
        Calibration::from_opencv(text, || Ok([[640, 480], [912, 1140]]))
    }

    #[test]
    fn what_is_written_reads_back_to_the_bit() {
        assert_eq!(read(&rig().to_opencv()).unwrap(), rig());
    }

    #[test]
    fn other_programs_names_are_read_and_sizes_asked_for() {
        let mut text = rig().to_opencv();
        for names in [
            ["cameraMatrix1", "cam_K"],
            ["distCoeffs1", "cam_kc"],
            ["cameraMatrix2", "proj_K"],
            ["distCoeffs2", "proj_kc"],
        ] {
            text = text.replace(names[0], names[1]);
        }
        let without: String = text.lines().filter(|l| !l.starts_with("imageSize")).map(|l| format!("{l}\n")).collect();
        assert_eq!(read(&without).unwrap(), rig());
        let refused = Calibration::from_opencv(&without, || Err(LightError::field("pictures", "none")));
        assert_eq!(refused.unwrap_err().to_string(), "pictures: none");
        assert_eq!(read(&text.replace("imageSize1", "imageSize")).unwrap(), rig());
    }

    #[test]
    fn errors_name_line_and_key() {
        let text = rig().to_opencv();
        let error = |from: &str, to: &str| {
            assert!(text.contains(from), "{from}");
            read(&text.replace(from, to)).unwrap_err().to_string()
        };
        assert!(error("distCoeffs2", "x").starts_with("distCoeffs2: missing; names read: distCoeffs2, D2"));
        assert!(error("1150.0, 0.0", "1150.0, 0.5").starts_with("line 3, cameraMatrix1: expected fx 0 cx"));
        assert!(error("1150.0, 0.0", "-1150.0, 0.0").starts_with("camera.fx_px"));
        assert!(error("[ 640, 480 ]", "[ 640.5, 480 ]").contains("imageSize1: expected columns and rows"));
        assert!(error("cols: 5", "cols: 4").contains("distCoeffs1: 5 numbers for 1 x 4"));
        assert!(error("rows: 3\n   cols: 1", "rows: 1\n   cols: 1").contains("T: 3 numbers for 1 x 1"));
    }
}
