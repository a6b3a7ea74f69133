//! Triangle meshes: storage, topology, repair, simplification, nearest points.

pub mod half_edge;
mod tri_mesh;

pub use half_edge::HalfEdges;
pub use tri_mesh::TriMesh;
