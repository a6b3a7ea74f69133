//! Mesh-video codec: scans in, group payloads out, and back again at any moment in time.
//!
//! Same input, same bytes. No input or output beyond byte slices, no threads of its own making, no clock.
#![forbid(unsafe_code)]

pub mod bits;
mod checker;
mod encoder;
mod error;
pub mod linalg;
pub mod mesh;
pub mod metrics;
pub mod motion;
pub mod param;
mod picture;
mod player;
mod scan;
pub mod seed;
pub mod shot;
mod stamps;
mod stream_header;
pub mod texture;

pub use checker::Checker;
pub use encoder::{EncodedGroup, Encoder, EncoderConfig, Pushed};
pub use error::{CodecError, Result};
pub use picture::GreyPicture;
pub use player::{Fetch, Output, Payloads, Player};
pub use scan::Scan;
pub use stamps::{Stamp, decode_stamps};
pub use stream_header::{FORMAT_VERSION, Mode, StreamHeader};
