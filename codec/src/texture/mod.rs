//! Texture: pictures and the coordinates that tie them to the surface.

mod camera_fit;

pub use camera_fit::{CameraFit, fit_camera, project};
