//! Triangle meshes: storage, topology, repair, simplification, nearest points.

mod bvh;
pub mod half_edge;
mod hole_fill;
mod polygon;
pub mod repair;
pub mod simplify;
mod tri_mesh;

pub use bvh::{Bvh, Nearest};
pub use half_edge::HalfEdges;
pub use tri_mesh::TriMesh;
