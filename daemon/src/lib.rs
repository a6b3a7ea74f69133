//! Capture daemon, structured light and command line of gv3.
//!
//! The data's way, each arrow a file:
//! ```text
//! device::Camera --Frame--> pipeline::frame_set --FrameSet--> light::phase --WrappedPhase--> light::unwrap --column_px-->
//! light::triangulate --PointGrid--> light::grid_mesh --TriMesh--> codec::Encoder --EncodedGroup-->
//! protocol::session writer --bytes--> file
//! live: the stages of pipeline::stages all the time, recordings beginning and ending among them (live::Live)
//! raw: Frame --pipeline::raw--> protocol::raw writer --bytes--> folder --device::recorded--> Frame
//! virtual scanner: sim::SimWorld --GreyPicture--> virtual_scanner --transfers--> usb_device --bytes--> USB/IP or usbredir
//! replay: file --StoredGroup--> codec::Player --Scan at time t--> files, view, measure
//! ```
#![deny(unsafe_code)]

// What unit and integration tests share calls the crate by its name.
#[cfg(test)]
extern crate self as gv3;

pub mod accuracy;
#[cfg(feature = "baselines")]
pub mod baselines;
pub mod cli;
pub mod device;
pub mod doctor;
pub mod files;
pub mod light;
pub mod live;
pub mod measure;
pub mod pipeline;
pub mod replay;
pub mod server;
pub mod store;
pub mod sweep;
pub mod usb_device;
pub mod view;
pub mod virtual_scanner;
