//! Files that other programs read and write: OBJ, PLY, BMP and PNG, one by one and as folders of scans; glTF out.
//!
//! Every reader works on a byte slice (`parse_*`) with a path wrapper on top (`read_*`); bad bytes give a
//! [`FileError`] that names the file and the line, element or byte, never a panic, and limits are checked before
//! memory is taken.

mod assemble;
pub mod board_corners;
#[cfg(test)]
mod damage_tests;
mod error;
mod glb;
pub mod gltf;
#[cfg(test)]
mod gltf_tests;
pub mod landmarks_csv;
pub mod obj;
pub mod picture;
pub mod ply;
pub mod processing_config;
pub mod raw_folder;
pub mod scan_export;
pub mod scan_folder;
mod sequence_export;
pub mod sessions_config;
mod spool;

pub use assemble::{MeshFile, Repairs};
pub use error::{FileError, Result};
pub use landmarks_csv::LandmarkTable;
pub use processing_config::ProcessingConfig;
pub use raw_folder::RawFolder;
pub(crate) use scan_export::write_whole;
pub use scan_export::{ExportFormat, ExportWriter};
pub use scan_folder::{LoadedScan, ScanFolder};
pub use sequence_export::SequenceWriter;
pub use sessions_config::SessionsConfig;
pub use spool::ScanSpool;
