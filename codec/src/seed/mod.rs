//! `--mode seed`, the published scheme: decimated keyframes, conformal matching of neighbours, natural cubic spline.
//!
//! Scan -> [`Encoder`] -> [`EncodedGroup`](crate::EncodedGroup); bytes -> [`Group`] -> [`Player`] -> scan at any time.

mod encoder;
mod flattened;
mod group;
mod interval;
mod landmarks;
mod player;
mod surface;

pub use encoder::{Encoder, EncoderConfig};
pub use flattened::Flattened;
pub use group::{Group, LandmarkPair, decode as decode_group};
pub use interval::Interval;
pub use landmarks::{GivenCounts, GivenLandmark, MAX_GIVEN_OFFSET_MM};
pub use player::{KNOT_REACH, Player};
