//! A mesh known to be one topological disk, with its connectivity: found out once and handed from stage to stage.

use super::{HalfEdges, TriMesh};
use crate::{CodecError, Result};
use std::ops::Deref;

/// A valid mesh that is one topological disk: connected, one border, no hole, no handle, every vertex used.
#[derive(Debug, Clone)]
pub struct DiskMesh {
    mesh: TriMesh,
    half_edges: HalfEdges,
}

impl DiskMesh {
    /// Checks that `mesh` is a disk; [`super::repair::to_disk`] makes one of any scan.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when it is not valid ([`TriMesh::validate`]), no oriented manifold, or no disk.
    pub fn new(mesh: TriMesh) -> Result<Self> {
        mesh.validate()?;
        let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
        check_disk(&half_edges)?;
        Ok(Self { mesh, half_edges })
    }

    /// A mesh that its maker knows to be a disk, with its connectivity.
    pub(super) fn known(mesh: TriMesh, half_edges: HalfEdges) -> Self {
        debug_assert!(mesh.validate().is_ok() && half_edges.is_disk());
        debug_assert_eq!(half_edges.origin, mesh.triangles.as_flattened());
        Self { mesh, half_edges }
    }

    /// Connectivity of the mesh.
    pub fn half_edges(&self) -> &HalfEdges {
        &self.half_edges
    }

    /// The mesh alone.
    pub fn into_mesh(self) -> TriMesh {
        self.mesh
    }
}

impl Deref for DiskMesh {
    type Target = TriMesh;

    fn deref(&self) -> &TriMesh {
        &self.mesh
    }
}

fn check_disk(half_edges: &HalfEdges) -> Result<()> {
    if half_edges.is_disk() {
        return Ok(());
    }
    let loops = half_edges.boundary_loops();
    let at: Vec<String> = loops.iter().take(4).map(|ring| (ring[0] + 1).to_string()).collect();
    let at = if at.is_empty() { "no edge on a border".into() } else { format!("at vertices {}", at.join(", ")) };
    Err(CodecError::Mesh(format!(
        "not a disk: {} boundary loops ({at}), Euler characteristic {}, {} pieces (1 of each wanted)",
        loops.len(),
        half_edges.euler_characteristic(),
        half_edges.triangle_components().1
    )))
}

#[cfg(test)]
mod tests {
    use super::super::test_surfaces::{jittered_plate, sphere};
    use super::*;

    #[test]
    fn a_disk_is_taken_and_everything_else_named() {
        let plate = jittered_plate(9, 1);
        let disk = DiskMesh::new(plate.clone()).unwrap();
        assert!(*disk == plate && disk.half_edges().is_disk() && disk.into_mesh() == plate);
        let refusal = |mesh: TriMesh| DiskMesh::new(mesh).unwrap_err().to_string();
        assert!(refusal(sphere(4, 1.0)).contains("no edge on a border"));
        let mut holed = plate.clone();
        holed.triangles.retain(|t| !t.contains(&40));
        assert!(refusal(holed.submesh(|_| true).0).contains("2 boundary loops (at vertices 1, "));
        let mut bare = plate;
        bare.positions_mm[3].x = f32::NAN;
        assert!(refusal(bare).contains("vertex 4 is not finite"));
    }
}
