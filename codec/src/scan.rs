//! One scan: a surface at one time, with its texture.

use crate::{GreyPicture, mesh::TriMesh};

/// One triangulated surface at one sensor time.
#[derive(Debug, Clone, Default)]
pub struct Scan {
    /// Sensor time in scan periods; dropped frame sets leave gaps.
    pub tick: u64,
    /// Sensor time of the exposure's middle, nanoseconds since the run began.
    pub time_nanos: u64,
    /// Surface in millimetres.
    pub mesh: TriMesh,
    /// Grey texture that `mesh.uv` points into.
    pub texture: Option<GreyPicture>,
}
