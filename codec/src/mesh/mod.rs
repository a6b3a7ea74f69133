//! Triangle meshes: storage, topology, repair, simplification, nearest points.

mod tri_mesh;

pub use tri_mesh::TriMesh;
