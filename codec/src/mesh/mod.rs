//! Triangle meshes: storage, topology, repair, simplification, nearest points, discrete differential geometry.

mod bvh;
mod curvature;
mod disk_mesh;
pub mod half_edge;
mod hole_fill;
pub mod intrinsic;
mod laplacian;
mod normals;
mod place;
mod polygon;
pub mod repair;
pub mod simplify;
#[cfg(test)]
pub(crate) mod test_surfaces;
mod tri_mesh;
mod vertex_area;

pub use bvh::{Bvh, Nearest, RayHit};
pub use curvature::{angle_defects, gaussian_curvature, mean_curvature};
pub use disk_mesh::DiskMesh;
pub use half_edge::HalfEdges;
pub(crate) use laplacian::cotangents;
pub use laplacian::{cotangent_laplacian, intrinsic_laplacian};
pub use normals::sphere_normals;
pub use place::Place;
pub use tri_mesh::TriMesh;
pub(crate) use tri_mesh::quality;
pub use vertex_area::{barycentric_areas_mm2, mixed_areas_mm2};
