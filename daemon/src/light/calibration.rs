//! Geometry of the rig: two lenses and the pose between them.
//!
//! Camera and projector share one model: pinhole with Brown's distortion as in Zhang, "A flexible new technique for camera
//! calibration", PAMI 22(11), 2000, coefficients in OpenCV's order (k1 k2 p1 p2 k3). Frames: x right, y down, z forward; millimetres.
//! Whole numbers are pixel centres, as in OpenCV: (0, 0) is the centre of the first pixel and a picture of w columns reaches
//! from -0.5 to w - 0.5. The projector is an inverse camera; code c names the centre of its column c.

use super::LightError;
use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Distortion of normalized image coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Distortion {
    /// Radial, second order.
    pub k1: f64,
    /// Radial, fourth order.
    pub k2: f64,
    /// Tangential.
    pub p1: f64,
    /// Tangential.
    pub p2: f64,
    /// Radial, sixth order.
    pub k3: f64,
}

impl Distortion {
    /// From coefficients in OpenCV's order; the fifth, k3, may be left out. The reason where they are of a larger model.
    pub(super) fn from_opencv(coefficients: &[f64]) -> Result<Self, String> {
        let [k1, k2, p1, p2, rest @ ..] = coefficients else {
            return Err(format!("{} coefficients, expected k1 k2 p1 p2 and k3", coefficients.len()));
        };
        if rest.iter().skip(1).any(|&more| more != 0.0) {
            return Err("coefficients beyond k3 are not supported; calibrate with five".into());
        }
        Ok(Self { k1: *k1, k2: *k2, p1: *p1, p2: *p2, k3: rest.first().copied().unwrap_or(0.0) })
    }

    /// No distortion at all.
    pub fn is_zero(&self) -> bool {
        *self == Self::default()
    }

    /// Distorted normalized coordinates of ideal ones.
    pub fn distort(&self, ideal: DVec2) -> DVec2 {
        let DVec2 { x, y } = ideal;
        let r2 = ideal.length_squared();
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        DVec2::new(
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )
    }

    /// Inverse of [`Self::distort`] by fixed-point iteration; `None` where it does not converge (the lens folds there).
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        let mut ideal = distorted;
        for _ in 0..60 {
            let step = distorted - self.distort(ideal);
            ideal += step;
            if step.length_squared() < 1e-26 {
                return Some(ideal);
            }
        }
        None
    }
}

/// One lens and its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Focal length along columns, pixels.
    pub fx_px: f64,
    /// Focal length along rows, pixels.
    pub fy_px: f64,
    /// Principal point, column.
    pub cx_px: f64,
    /// Principal point, row.
    pub cy_px: f64,
    /// Lens distortion.
    #[serde(default)]
    pub distortion: Distortion,
}

impl Intrinsics {
    /// Pixel of a point in this lens's frame, mm.
    pub fn project(&self, point_mm: DVec3) -> DVec2 {
        self.px_of_normalized(point_mm.truncate() / point_mm.z)
    }

    /// Pixel of ideal normalized coordinates.
    pub fn px_of_normalized(&self, ideal: DVec2) -> DVec2 {
        let d = self.distortion.distort(ideal);
        DVec2::new(self.fx_px * d.x + self.cx_px, self.fy_px * d.y + self.cy_px)
    }

    /// Ideal normalized coordinates (x/z, y/z) seen by a pixel; `None` where the lens model folds.
    pub fn unproject(&self, px: DVec2) -> Option<DVec2> {
        let distorted = DVec2::new((px.x - self.cx_px) / self.fx_px, (px.y - self.cy_px) / self.fy_px);
        self.distortion.undistort(distorted)
    }

    /// Ideal normalized coordinates of every pixel, row-major.
    ///
    /// # Errors
    /// [`LightError::Field`] when the distortion folds inside the picture.
    pub fn ray_table(&self, name: &str) -> Result<Vec<DVec2>, LightError> {
        let mut rays = Vec::with_capacity(self.width_px as usize * self.height_px as usize);
        for y in 0..self.height_px {
            for x in 0..self.width_px {
                let ray = self.unproject(DVec2::new(f64::from(x), f64::from(y))).ok_or_else(|| {
                    LightError::field(format!("{name}.distortion"), format!("cannot be undone at pixel {x}, {y}"))
                })?;
                rays.push(ray);
            }
        }
        Ok(rays)
    }

    fn validate(&self, name: &str) -> Result<(), LightError> {
        if !(1..=16_384).contains(&self.width_px) || !(1..=16_384).contains(&self.height_px) {
            let found = format!("{} x {} pixels, expected 1..=16384 each", self.width_px, self.height_px);
            return Err(LightError::field(format!("{name}.width_px"), found));
        }
        for (field, value) in [("fx_px", self.fx_px), ("fy_px", self.fy_px)] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(LightError::field(format!("{name}.{field}"), format!("{value} is no focal length")));
            }
        }
        let (w, h) = (f64::from(self.width_px), f64::from(self.height_px));
        for (field, value, size) in [("cx_px", self.cx_px, w), ("cy_px", self.cy_px, h)] {
            // A shifted projector lens puts its principal point up to one picture outside.
            if !(-size..=2.0 * size).contains(&value) {
                return Err(LightError::field(format!("{name}.{field}"), format!("{value} is far from the picture")));
            }
        }
        let Distortion { k1, k2, p1, p2, k3 } = self.distortion;
        if ![k1, k2, p1, p2, k3].iter().all(|k| k.is_finite()) {
            return Err(LightError::field(format!("{name}.distortion"), "a coefficient is not a number"));
        }
        for corner in [DVec2::ZERO, DVec2::new(w, 0.0), DVec2::new(0.0, h), DVec2::new(w, h)] {
            if self.unproject(corner).is_none() {
                let reason = format!("cannot be undone at pixel {}, {}", corner.x, corner.y);
                return Err(LightError::field(format!("{name}.distortion"), reason));
            }
        }
        Ok(())
    }
}

/// Rotation and translation: p' = rotation p + translation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rigid {
    /// Rotation matrix, by rows.
    pub rotation: [[f64; 3]; 3],
    /// Translation, mm.
    pub translation_mm: [f64; 3],
}

impl Rigid {
    /// From a matrix and a vector.
    pub fn new(rotation: DMat3, translation_mm: DVec3) -> Self {
        Self { rotation: rotation.transpose().to_cols_array_2d(), translation_mm: translation_mm.to_array() }
    }

    /// The rotation as a matrix.
    pub fn matrix(&self) -> DMat3 {
        DMat3::from_cols_array_2d(&self.rotation).transpose()
    }

    /// The translation as a vector, mm.
    pub fn translation(&self) -> DVec3 {
        DVec3::from_array(self.translation_mm)
    }

    /// The moved point.
    pub fn apply(&self, point_mm: DVec3) -> DVec3 {
        self.matrix() * point_mm + self.translation()
    }
}

/// Everything that turns a camera pixel and a projector column into a point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// The camera's lens.
    pub camera: Intrinsics,
    /// The projector's lens.
    pub projector: Intrinsics,
    /// Pose: a point in the projector's frame from the same in the camera's.
    pub projector_from_camera: Rigid,
}

impl Calibration {
    /// Reads and checks a calibration in TOML.
    ///
    /// # Errors
    /// [`LightError::Toml`] with line and column, or [`LightError::Field`].
    pub fn from_toml(text: &str) -> Result<Self, LightError> {
        let calibration: Self = toml::from_str(text).map_err(|e| LightError::Toml(e.to_string()))?;
        calibration.validate()?;
        Ok(calibration)
    }

    /// The calibration as TOML; [`Self::from_toml`] gives back the same numbers.
    ///
    /// # Errors
    /// [`LightError::Toml`] when a number has no TOML form.
    pub fn to_toml(&self) -> Result<String, LightError> {
        toml::to_string(self).map_err(|e| LightError::Toml(e.to_string()))
    }

    /// Checks both lenses, that the rotation is one, and that there is a baseline across the columns.
    ///
    /// # Errors
    /// [`LightError::Field`] naming what cannot work.
    pub fn validate(&self) -> Result<(), LightError> {
        self.camera.validate("camera")?;
        self.projector.validate("projector")?;
        let rotation = self.projector_from_camera.matrix();
        let excess = rotation * rotation.transpose() - DMat3::IDENTITY;
        let is_rotation = excess.to_cols_array().iter().all(|v| v.abs() < 1e-6) && rotation.determinant() > 0.0;
        if !is_rotation {
            return Err(LightError::field("projector_from_camera.rotation", "rows are not those of a rotation"));
        }
        let translation = self.projector_from_camera.translation();
        if !translation.is_finite() || translation.truncate().length() < 1.0 {
            let reason = "the projector needs a baseline of a millimetre or more beside the camera";
            return Err(LightError::field("projector_from_camera.translation_mm", reason));
        }
        Ok(())
    }

    /// Projector pixel that lights a point given in the camera's frame, mm.
    pub fn projector_px(&self, point_mm: DVec3) -> DVec2 {
        self.projector.project(self.projector_from_camera.apply(point_mm))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A rig with distortion in both lenses.
    pub(crate) fn rig() -> Calibration {
        let camera = Intrinsics {
            width_px: 640,
            height_px: 480,
            fx_px: 1150.0,
            fy_px: 1148.0,
            cx_px: 321.5,
            cy_px: 238.0,
            distortion: Distortion { k1: -0.12, k2: 0.08, p1: 4e-4, p2: -3e-4, k3: 0.01 },
        };
        let projector = Intrinsics {
            width_px: 912,
            height_px: 1140,
            fx_px: 2600.0,
            fy_px: 2603.0,
            cx_px: 455.0,
            cy_px: 571.0,
            distortion: Distortion { k1: -0.05, k2: 0.02, p1: -2e-4, p2: 2e-4, k3: 0.0 },
        };
        let angle = (160.0f64 / 600.0).atan();
        let rotation = DMat3::from_rotation_y(angle) * DMat3::from_rotation_x(0.004);
        let centre = DVec3::new(160.0, -2.0, 5.0);
        Calibration { camera, projector, projector_from_camera: Rigid::new(rotation, -(rotation * centre)) }
    }

    proptest! {
        #[test]
        fn project_and_unproject_are_inverse(x in 0.0f64..640.0, y in 0.0f64..480.0, z in 300.0f64..900.0) {
            let camera = rig().camera;
            let ray = camera.unproject(DVec2::new(x, y)).unwrap();
            let back = camera.project((ray * z).extend(z));
            prop_assert!((back - DVec2::new(x, y)).length() < 1e-8);
        }
    }

    #[test]
    fn toml_round_trip_keeps_every_bit() {
        let c = rig();
        assert_eq!(Calibration::from_toml(&c.to_toml().unwrap()).unwrap(), c);
    }

    #[test]
    fn errors_name_the_field() {
        let error = |change: fn(&mut Calibration)| {
            let mut c = rig();
            change(&mut c);
            c.validate().unwrap_err().to_string()
        };
        assert!(error(|c| c.camera.fx_px = 0.0).starts_with("camera.fx_px"));
        assert!(error(|c| c.projector.cx_px = 1e9).starts_with("projector.cx_px"));
        assert!(error(|c| c.camera.distortion.k1 = -40.0).starts_with("camera.distortion"));
        assert!(error(|c| c.projector_from_camera.rotation[0][0] = 2.0).contains("rotation"));
        assert!(error(|c| c.projector_from_camera.translation_mm = [0.0, 0.0, 3.0]).contains("translation_mm"));
        let text = rig().to_toml().unwrap().replace("fx_px = 1150.0", "fx_px = \"wide\"");
        assert!(Calibration::from_toml(&text).unwrap_err().to_string().contains("fx_px"));
    }
}
