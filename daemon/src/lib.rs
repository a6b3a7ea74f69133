//! Capture daemon, structured light and command line of gv3.
#![deny(unsafe_code)]

pub mod files;
pub mod view;
