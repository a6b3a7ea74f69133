//! Shared helpers of the end-to-end tests.

pub mod coded_run;
pub mod moving_face;
pub mod virtual_rig;
