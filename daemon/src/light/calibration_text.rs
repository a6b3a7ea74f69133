//! Which of the formats of calibrations a text is in.

use super::{Calibration, LightError};

/// A format of calibrations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CalibrationFormat {
    /// Our own: see [`Calibration::from_toml`].
    Toml,
    /// See [`Calibration::from_json`].
    Json,
    /// OpenCV's YAML: see [`Calibration::from_opencv`].
    Opencv,
}

impl CalibrationFormat {
    /// The format of a text, by its beginning.
    pub fn of(text: &str) -> Self {
        let text = text.trim_start_matches('\u{feff}').trim_start();
        if text.starts_with('{') {
            Self::Json
        } else if text.starts_with("%YAML") || text.starts_with("---") || text.contains("!!opencv-matrix") {
            Self::Opencv
        } else {
            Self::Toml
        }
    }
}

impl Calibration {
    /// Reads and checks a calibration in any format. `sizes` gives columns and rows of camera and projector; it is asked
    /// where the format need not say them.
    ///
    /// # Errors
    /// Those of the format, or what `sizes` gives.
    pub fn from_text<E: From<LightError>>(
        text: &str,
        sizes: impl FnOnce() -> Result<[[u32; 2]; 2], E>,
    ) -> Result<Self, E> {
        let text = text.trim_start_matches('\u{feff}');
        match CalibrationFormat::of(text) {
            CalibrationFormat::Toml => Ok(Self::from_toml(text)?),
            CalibrationFormat::Opencv => Self::from_opencv(text, sizes),
            CalibrationFormat::Json => {
                let [camera_px, projector_px] = sizes()?;
                Ok(Self::from_json(text, camera_px, projector_px)?)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;

    #[test]
    fn the_content_decides() {
        let sizes = || Ok::<_, LightError>([[640, 480], [912, 1140]]);
        for text in [rig().to_toml().unwrap(), rig().to_opencv(), format!("\u{feff}{}", rig().to_opencv())] {
            assert_eq!(Calibration::from_text(&text, sizes).unwrap(), rig());
        }
        assert_eq!(CalibrationFormat::of("\n  {\"Kc\": 1}"), CalibrationFormat::Json);
        assert!(Calibration::from_text("{\"Kc\": 1}", sizes).unwrap_err().to_string().starts_with("JSON"));
        assert_eq!(CalibrationFormat::of(""), CalibrationFormat::Toml);
    }
}
