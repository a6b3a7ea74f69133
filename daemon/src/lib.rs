//! Capture daemon, structured light and command line of gv3.
//!
//! The data's way, each arrow a file:
//! ```text
//! device::Camera --Frame--> pipeline::frame_set --FrameSet--> light::phase --WrappedPhase--> light::unwrap --column_px-->
//! light::triangulate --PointGrid--> light::grid_mesh --TriMesh--> codec
//! ```
#![deny(unsafe_code)]

pub mod device;
pub mod light;
pub mod pipeline;
