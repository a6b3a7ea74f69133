//! Texture: pictures and the coordinates that tie them to the surface.

mod camera_fit;
pub mod coded;
mod jpeg_frame;
mod key_texture;

pub use camera_fit::{CameraFit, fit_camera, project};
pub use key_texture::{MAX_SIDE_PX, decode as decode_key_texture, encode as encode_key_texture};
