//! Motion between scans: pictures made comparable, landmarks followed through them, lifted to the surface, and checked.
//!
//! [`remove_fringes`] where the phase is known -> [`normalize`](normalize()) -> [`Pyramid`] -> [`follow`] -> [`Tracker`] works in pixels; [`PixelMap`] takes a pixel to a
//! point of the surface; [`consistent`] drops matches that their neighbours contradict. Scans without texture are
//! tracked in the picture of their relief ([`FeatureFrame`]).

mod affine_flow;
mod consistency;
mod corners;
mod feature;
mod float_picture;
mod fringe;
mod lift;
mod mask;
mod normalize;
mod optical_flow;
mod pyramid;
pub mod spline;
#[cfg(test)]
mod test_texture;
pub mod tick_weights;
mod track;

pub use consistency::consistent;
pub use corners::{CornerOptions, find_corners};
pub use feature::{FeatureFrame, FeatureView};
pub use float_picture::FloatPicture;
pub use fringe::remove_fringes;
pub use lift::PixelMap;
pub use mask::Mask;
pub use normalize::{GREY_SIGMA_PX, GREY_VARIANCE_FLOOR, high_pass, normalize};
pub use optical_flow::{FlowOptions, follow, zncc};
pub use pyramid::{Level, Pyramid};
pub use track::{Track, Tracker, TrackerOptions};
