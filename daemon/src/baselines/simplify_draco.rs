//! A sixth of the triangles by quadric error (meshoptimizer), then Draco.

use super::{EachScan, draco};
use gv3_codec::mesh::TriMesh;
use meshopt::{SimplifyOptions, VertexDataAdapter};

/// Triangles kept: one in this many.
const RATIO: usize = 6;
const QP: [i32; 4] = [12, 11, 10, 9];

pub(super) fn coder() -> EachScan {
    EachScan {
        name: "simplify-draco",
        about: "a sixth of the triangles (meshoptimizer), then Draco at compression level 7, every scan by itself",
        settings: QP.map(|qp| format!("1/{RATIO}, qp {qp}")).to_vec(),
        encode: |mesh, setting| draco::encode(&simplified(mesh)?, QP[setting]),
        decode: draco::decode,
    }
}

fn simplified(mesh: &TriMesh) -> Result<TriMesh, String> {
    let indices: &[u32] = bytemuck::cast_slice(&mesh.triangles);
    let bytes = bytemuck::cast_slice(&mesh.positions_mm);
    let vertices = VertexDataAdapter::new(bytes, 12, 0).map_err(|e| e.to_string())?;
    let target = mesh.triangles.len() / RATIO * 3;
    let mut kept = meshopt::simplify(indices, &vertices, target, 1.0, SimplifyOptions::None, None);
    let positions: Vec<[f32; 3]> = mesh.positions_mm.iter().map(|p| p.to_array()).collect();
    let positions = meshopt::optimize_vertex_fetch(&mut kept, &positions);
    Ok(TriMesh {
        positions_mm: positions.into_iter().map(Into::into).collect(),
        triangles: bytemuck::cast_slice(&kept).to_vec(),
        uv: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sweep::test_scans::hill;
    use gv3_codec::Scan;
    use gv3_codec::metrics::compare;

    #[test]
    fn a_sixth_remains_near_the_surface() {
        let scan = hill(90, 0.0);
        let mesh = simplified(&scan.mesh).unwrap();
        mesh.validate().unwrap();
        let share = mesh.triangles.len() as f64 / scan.mesh.triangles.len() as f64;
        assert!((share - 1.0 / 6.0).abs() < 0.02, "{share}");
        let error = compare(&scan, &Scan { mesh, ..Scan::default() }).distortion.scan_to_replay.summary();
        assert!(error.rms < 0.2, "{error:?}");
    }
}
