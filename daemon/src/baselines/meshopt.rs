//! meshoptimizer's vertex and index codecs in strip order, then zstd at level 19.

use super::EachScan;
use glam::Vec3;
use gv3_codec::mesh::TriMesh;

/// Bits of a coordinate.
const BITS: [u32; 3] = [13, 12, 11];
const ZSTD_LEVEL: i32 = 19;
/// Vertices, triangles, bytes of the vertices, origin and step.
const HEAD_BYTES: usize = 12 + 16;

pub(super) fn coder() -> EachScan {
    EachScan {
        name: "meshopt",
        about: "meshoptimizer's codecs in strip order, then zstd at level 19, every scan by itself",
        settings: BITS.map(|bits| format!("{bits} bits")).to_vec(),
        encode: |mesh, setting| encode(mesh, BITS[setting]),
        decode,
    }
}

fn encode(mesh: &TriMesh, bits: u32) -> Result<Vec<u8>, String> {
    let (low, high) = mesh.bounds_mm();
    let step = ((high - low).max_element() / ((1u32 << bits) - 1) as f32).max(f32::MIN_POSITIVE);
    let rounded = |p: &Vec3| {
        let q = ((*p - low) / step).round();
        [q.x as u16, q.y as u16, q.z as u16, 0]
    };
    let vertices: Vec<[u16; 4]> = mesh.positions_mm.iter().map(rounded).collect();
    let indices: &[u32] = bytemuck::cast_slice(&mesh.triangles);
    let mut indices = meshopt::optimize_vertex_cache_strip(indices, vertices.len());
    let vertices = meshopt::optimize_vertex_fetch(&mut indices, &vertices);
    let vertex_bytes = meshopt::encode_vertex_buffer(&vertices).map_err(|e| e.to_string())?;
    let index_bytes = meshopt::encode_index_buffer(&indices, vertices.len()).map_err(|e| e.to_string())?;
    let mut plain = Vec::with_capacity(HEAD_BYTES + vertex_bytes.len() + index_bytes.len());
    for count in [vertices.len(), indices.len(), vertex_bytes.len()] {
        plain.extend((count as u32).to_le_bytes());
    }
    for number in [low.x, low.y, low.z, step] {
        plain.extend(number.to_le_bytes());
    }
    plain.extend(vertex_bytes);
    plain.extend(index_bytes);
    zstd::bulk::compress(&plain, ZSTD_LEVEL).map_err(|e| e.to_string())
}

fn decode(bytes: &[u8]) -> Result<TriMesh, String> {
    let plain = zstd::stream::decode_all(bytes).map_err(|e| e.to_string())?;
    let (head, rest) = plain.split_at_checked(HEAD_BYTES).ok_or("too short")?;
    let word = |i: usize| [head[4 * i], head[4 * i + 1], head[4 * i + 2], head[4 * i + 3]];
    let [vertex_count, index_count, split] = [0, 1, 2].map(|i| u32::from_le_bytes(word(i)) as usize);
    let [x, y, z, step] = [3, 4, 5, 6].map(|i| f32::from_le_bytes(word(i)));
    let (vertex_bytes, index_bytes) = rest.split_at_checked(split).ok_or("too short for its vertices")?;
    let vertices: Vec<[u16; 4]> =
        meshopt::decode_vertex_buffer(vertex_bytes, vertex_count).map_err(|e| e.to_string())?;
    let indices: Vec<u32> = meshopt::decode_index_buffer(index_bytes, index_count).map_err(|e| e.to_string())?;
    let placed = |v: &[u16; 4]| Vec3::new(x, y, z) + step * Vec3::new(v[0].into(), v[1].into(), v[2].into());
    Ok(TriMesh {
        positions_mm: vertices.iter().map(placed).collect(),
        triangles: indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect(),
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
    fn errors_are_those_of_the_rounding() {
        let scan = hill(60, 0.0);
        let extent_mm = f64::from((scan.mesh.bounds_mm().1 - scan.mesh.bounds_mm().0).max_element());
        for bits in BITS {
            let mesh = decode(&encode(&scan.mesh, bits).unwrap()).unwrap();
            mesh.validate().unwrap();
            assert_eq!(mesh.triangles.len(), scan.mesh.triangles.len());
            let error = compare(&scan, &Scan { mesh, ..Scan::default() }).distortion.scan_to_replay.summary();
            let step_mm = extent_mm / f64::from((1 << bits) - 1);
            assert!(error.max <= 0.87 * step_mm + 1e-5 && error.rms > 0.05 * step_mm, "{error:?}");
        }
    }

    #[test]
    fn damaged_bytes_are_an_error() {
        let bytes = encode(&hill(20, 0.0).mesh, 12).unwrap();
        assert!(decode(&bytes[..bytes.len() / 2]).is_err());
        assert!(decode(&[]).is_err());
    }
}
