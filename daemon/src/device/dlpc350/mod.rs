//! The TI LightCrafter 4500 (DLPC350) as a projector.

pub mod emulator;
mod link;

pub use link::{HidLink, HidOpener, LinkError};
