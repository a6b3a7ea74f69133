//! Whatever the text, the calibration readers (TOML, JSON, OpenCV's YAML) give an error or a rig that works.
#![no_main]

libfuzzer_sys::fuzz_target!(|text: &str| {
    use gv3::light::{Calibration, LightError};
    let sizes = || Ok::<_, LightError>([[640, 480], [912, 1140]]);
    if let Ok(calibration) = Calibration::from_text(text, sizes) {
        calibration.validate().expect("a calibration that was read is valid");
    }
});
