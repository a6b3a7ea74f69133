//! Draco on every scan by itself (crate draco-core, which writes the bytes of the C++ library), at compression level 7.

use super::EachScan;
use draco_core::{
    DataType, DecoderBuffer, EncoderBuffer, EncoderOptions, FaceIndex, GeometryAttributeType, Mesh, MeshDecoder,
    MeshEncoder, PointAttribute,
};
use glam::Vec3;
use gv3_codec::mesh::TriMesh;

/// Speed is ten less the compression level.
const SPEED: i32 = 3;
/// Bits of a coordinate.
const QP: [i32; 4] = [12, 11, 10, 9];

pub(super) fn coder() -> EachScan {
    EachScan {
        name: "draco",
        about: "Draco, compression level 7, every scan by itself",
        settings: QP.map(|qp| format!("qp {qp}")).to_vec(),
        encode: |mesh, setting| encode(mesh, QP[setting]),
        decode,
    }
}

/// Positions and triangles with `qp` bits a coordinate.
pub(super) fn encode(mesh: &TriMesh, qp: i32) -> Result<Vec<u8>, String> {
    let mut positions = PointAttribute::new();
    positions.init(GeometryAttributeType::Position, 3, DataType::Float32, false, mesh.vertex_count());
    positions.buffer_mut().write(0, bytemuck::cast_slice(&mesh.positions_mm));
    let mut draco = Mesh::new();
    draco.add_attribute(positions);
    draco.set_num_faces(mesh.triangles.len());
    for (f, triangle) in (0..).zip(&mesh.triangles) {
        draco.set_face(FaceIndex(f), triangle.map(Into::into));
    }
    let mut options = EncoderOptions::new();
    options.set_global_int("encoding_speed", SPEED);
    options.set_global_int("decoding_speed", SPEED);
    options.set_attribute_int(0, "quantization_bits", qp);
    let mut encoder = MeshEncoder::new();
    encoder.set_mesh(draco);
    let mut buffer = EncoderBuffer::new();
    encoder.encode(&options, &mut buffer).map_err(|e| format!("cannot encode: {e}"))?;
    Ok(buffer.data().to_vec())
}

/// The mesh in the order of vertices that Draco chose.
pub(super) fn decode(bytes: &[u8]) -> Result<TriMesh, String> {
    let mut draco = Mesh::new();
    MeshDecoder::new().decode(&mut DecoderBuffer::new(bytes), &mut draco).map_err(|e| format!("cannot decode: {e}"))?;
    let positions = draco.named_attribute(GeometryAttributeType::Position).ok_or("no positions decoded")?;
    let coordinates = positions.read_f32s(draco.num_points(), 3);
    Ok(TriMesh {
        positions_mm: coordinates.chunks_exact(3).map(|c| Vec3::new(c[0], c[1], c[2])).collect(),
        triangles: draco.faces().iter().map(|f| f.map(|p| p.0)).collect(),
        uv: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::ply::ply_bytes;
    use crate::sweep::test_scans::hill;
    use gv3_codec::Scan;
    use gv3_codec::metrics::compare;
    use std::process::Command;

    #[test]
    fn errors_are_those_of_the_rounding() {
        let scan = hill(60, 0.0);
        let extent_mm = f64::from((scan.mesh.bounds_mm().1 - scan.mesh.bounds_mm().0).max_element());
        let mut sizes = Vec::new();
        for qp in QP {
            let bytes = encode(&scan.mesh, qp).unwrap();
            let back = Scan { mesh: decode(&bytes).unwrap(), ..Scan::default() };
            assert_eq!(back.mesh.triangles.len(), scan.mesh.triangles.len());
            let step_mm = extent_mm / f64::from((1 << qp) - 1);
            let summary = compare(&scan, &back).distortion.scan_to_replay.summary();
            assert!(summary.max <= 0.87 * step_mm + 1e-5 && summary.rms > 0.05 * step_mm, "{summary:?} {step_mm}");
            sizes.push(bytes.len());
        }
        assert!(sizes.is_sorted_by(|a, b| a > b), "{sizes:?}");
    }

    #[test]
    fn sizes_are_those_of_the_cpp_encoder() {
        let folder = tempfile::tempdir().unwrap();
        let (ply, drc) = (folder.path().join("a.ply"), folder.path().join("a.drc"));
        let mesh = TriMesh { uv: None, ..hill(80, 0.0).mesh };
        std::fs::write(&ply, ply_bytes(&mesh, None)).unwrap();
        let done = Command::new("draco_encoder")
            .arg("-i")
            .arg(&ply)
            .arg("-o")
            .arg(&drc)
            .args(["-qp", "11", "-cl", "7"])
            .output();
        if !done.is_ok_and(|d| d.status.success()) {
            println!("skipped: the command draco_encoder is not installed");
            return;
        }
        let (ours, theirs) = (encode(&mesh, 11).unwrap().len() as f64, std::fs::metadata(&drc).unwrap().len() as f64);
        assert!((ours / theirs - 1.0).abs() < 0.02, "{ours} against {theirs} bytes");
    }

    #[test]
    fn damaged_bytes_are_an_error() {
        let bytes = encode(&hill(20, 0.0).mesh, 10).unwrap();
        assert!(decode(&bytes[..bytes.len() / 2]).is_err());
        assert!(decode(b"DRACO").is_err());
    }
}
