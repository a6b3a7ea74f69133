//! The surface of a keyframe as bytes: connectivity, quantized positions, texture coordinates.

use crate::bits::attributes::{self, put_section, take_section};
use crate::bits::bytes::{ByteReader, put_varint};
use crate::bits::connectivity::{self, DecodedConnectivity};
use crate::mesh::{HalfEdges, TriMesh};
use crate::texture::{CameraFit, MAX_SIDE_PX, project};
use crate::{CodecError, GreyPicture, Result};
use glam::Vec3;

/// Most vertices a payload may announce: twice an undecimated scan, and what a decoder still flattens in seconds.
pub const MAX_VERTICES: u64 = 1 << 18;

/// Quantized positions stay below this in magnitude.
const POSITION_LIMIT: i32 = 1 << 30;

/// Coded texture coordinates are in sixteenths of a pixel.
const UV_STEPS_PER_PX: f32 = 16.0;

/// Texture coordinates lie within one picture side of the largest picture, in sixteenths of a pixel.
const UV_RANGE: std::ops::RangeInclusive<i32> = -16 * MAX_SIDE_PX as i32..=32 * MAX_SIDE_PX as i32;

/// A camera may stand for coded texture coordinates when it misses none by more than this.
const MAX_CAMERA_ERROR_PX: f64 = 0.5;

/// A surface as bytes and as the decoder will see it.
pub struct CodedSurface {
    /// Section "surface" of FORMAT.md.
    pub bytes: Vec<u8>,
    /// The decoded surface.
    pub decoded: TriMesh,
}

/// Size of the picture that texture coordinates point into, and the camera that took it if one fits.
#[derive(Debug, Clone, Copy)]
pub struct TextureFrame {
    /// Width and height, px.
    pub size_px: [u32; 2],
    /// Camera of the whole scan.
    pub camera: Option<CameraFit>,
}

/// Codes a disk. With `texture` the mesh must have texture coordinates.
///
/// # Errors
/// [`CodecError::Mesh`] when it is no disk, too large, or out of the quantizer's range.
pub fn encode(mesh: &TriMesh, step_mm: f32, texture: Option<TextureFrame>) -> Result<CodedSurface> {
    if mesh.vertex_count() as u64 > MAX_VERTICES {
        return Err(CodecError::Mesh(format!("{} vertices; {MAX_VERTICES} can be coded", mesh.vertex_count())));
    }
    let coded = connectivity::encode(mesh)?;
    let decoded = connectivity::decode(&coded.letters, coded.border_count, mesh.vertex_count())?;
    let positions = quantize(coded.order.iter().map(|&v| mesh.positions_mm[v as usize]), step_mm)?;
    let mut bytes = Vec::new();
    put_varint(&mut bytes, mesh.vertex_count() as u64);
    put_varint(&mut bytes, coded.border_count as u64);
    put_varint(&mut bytes, mesh.triangles.len() as u64);
    put_section(&mut bytes, &coded.letters)?;
    put_section(&mut bytes, &attributes::encode(&positions, &decoded.parents))?;
    let uv_px = texture.zip(mesh.uv.as_ref()).map(|(frame, uv)| {
        let uv = coded.order.iter().map(|&v| uv[v as usize]);
        (frame, quantize_uv(uv, frame.size_px))
    });
    put_uv(&mut bytes, uv_px, &decoded)?;
    let decoded = decode(&mut ByteReader::new(&bytes, "surface"), step_mm)?;
    Ok(CodedSurface { bytes, decoded })
}

fn quantize(points: impl Iterator<Item = Vec3>, step_mm: f32) -> Result<Vec<[i32; 3]>> {
    let limit = POSITION_LIMIT as f32;
    points
        .map(|p| {
            let q = p / step_mm;
            if q.abs().max_element() < limit {
                Ok(q.to_array().map(|x| x.round() as i32))
            } else {
                Err(CodecError::Mesh(format!("a vertex at {p} mm is out of range for a step of {step_mm} mm")))
            }
        })
        .collect()
}

fn quantize_uv(uv: impl Iterator<Item = [f32; 2]>, [w, h]: [u32; 2]) -> Vec<[i32; 2]> {
    let to = |x: f32| ((x * UV_STEPS_PER_PX).round() as i32).clamp(*UV_RANGE.start(), *UV_RANGE.end());
    uv.map(|t| [to(t[0] * w as f32 - 0.5), to((1.0 - t[1]) * h as f32 - 0.5)]).collect()
}

/// 0: no texture coordinates; 1: projected by a camera; 2: coded.
fn put_uv(out: &mut Vec<u8>, uv_px: Option<(TextureFrame, Vec<[i32; 2]>)>, c: &DecodedConnectivity) -> Result<()> {
    let Some((frame, uv_px)) = uv_px else {
        out.push(0);
        return Ok(());
    };
    // A camera may miss a coordinate by half a pixel, so those within a pixel of the range's ends are coded.
    let within = |x: &i32| (UV_RANGE.start() + 16..=UV_RANGE.end() - 16).contains(x);
    let within = uv_px.as_flattened().iter().all(within);
    let camera = frame.camera.filter(|c| within && c.max_error_px <= MAX_CAMERA_ERROR_PX);
    out.push(if camera.is_some() { 1 } else { 2 });
    for side in frame.size_px {
        out.extend_from_slice(&(side as u16).to_le_bytes());
    }
    match camera {
        Some(camera) => camera.matrix.iter().for_each(|m| out.extend_from_slice(&(*m as f32).to_le_bytes())),
        None => put_section(out, &attributes::encode(&uv_px, &c.parents))?,
    }
    Ok(())
}

/// Reads a surface.
///
/// # Errors
/// [`CodecError::Payload`] at the first byte that does not follow FORMAT.md, "Surface".
pub fn decode(reader: &mut ByteReader<'_>, step_mm: f32) -> Result<TriMesh> {
    let vertices = reader.varint_up_to(MAX_VERTICES, "vertex count")? as usize;
    let border = reader.varint_up_to(vertices as u64, "border count")? as usize;
    let triangles = reader.varint_up_to(2 * vertices as u64, "triangle count")? as usize;
    if border < 3 || triangles + border + 2 != 2 * vertices {
        return Err(reader.error(format!(
            "{vertices} vertices, {border} of them on the border, and {triangles} triangles are no disk"
        )));
    }
    let letters = take_section(reader, triangles, "connectivity")?;
    if letters.len() != triangles {
        return Err(reader.error(format!("{} letters for {triangles} triangles", letters.len())));
    }
    let connectivity = connectivity::decode(&letters, border, vertices)?;
    let planes = take_section(reader, 1 + 12 * vertices, "positions")?;
    let positions = attributes::decode::<3>(&planes, &connectivity.parents, "positions")?;
    if let Some(v) = positions.iter().position(|q| q.iter().any(|x| x.unsigned_abs() >= POSITION_LIMIT as u32)) {
        return Err(reader.error(format!("vertex {v} lies 2^30 steps or more from the origin")));
    }
    let positions_mm: Vec<Vec3> =
        positions.iter().map(|q| Vec3::new(q[0] as f32, q[1] as f32, q[2] as f32) * step_mm).collect();
    let uv = take_uv(reader, &connectivity, &positions_mm)?;
    let mesh = TriMesh { positions_mm, triangles: connectivity.triangles, uv };
    let edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles).map_err(|e| reader.error(e.to_string()))?;
    if !edges.is_disk() {
        return Err(reader.error("the surface is no disk"));
    }
    Ok(mesh)
}

fn take_uv(reader: &mut ByteReader<'_>, c: &DecodedConnectivity, positions: &[Vec3]) -> Result<Option<Vec<[f32; 2]>>> {
    let kind = reader.u8()?;
    if kind == 0 {
        return Ok(None);
    }
    let (w, h) = (u32::from(reader.u16()?), u32::from(reader.u16()?));
    if w == 0 || h == 0 || w > MAX_SIDE_PX || h > MAX_SIDE_PX {
        return Err(reader.error(format!("a texture of {w}x{h} pixels; 1 to {MAX_SIDE_PX} a side are allowed")));
    }
    let frame = GreyPicture { width_px: w, height_px: h, pixels: Vec::new() };
    match kind {
        1 => {
            let mut matrix = [0.0; 12];
            for m in &mut matrix {
                *m = f64::from(reader.f32()?);
            }
            let px: Vec<[f32; 2]> = positions.iter().map(|&p| project(&matrix, p)).collect();
            let [low, high] = [UV_RANGE.start(), UV_RANGE.end()].map(|x| *x as f32 / UV_STEPS_PER_PX);
            if !px.as_flattened().iter().all(|x| (low..=high).contains(x)) {
                return Err(reader.error("the camera sends a vertex out of range"));
            }
            Ok(Some(px.into_iter().map(|p| frame.px_to_uv(p)).collect()))
        }
        2 => {
            let planes = take_section(reader, 1 + 8 * positions.len(), "texture coordinates")?;
            let uv_px = attributes::decode::<2>(&planes, &c.parents, "texture coordinates")?;
            if !uv_px.as_flattened().iter().all(|x| UV_RANGE.contains(x)) {
                return Err(reader.error("a texture coordinate is out of range"));
            }
            Ok(Some(uv_px.iter().map(|q| frame.px_to_uv(q.map(|x| x as f32 / UV_STEPS_PER_PX))).collect()))
        }
        other => Err(reader.error(format!("texture coordinates of kind {other}; 0 to 2 are defined"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bits::connectivity::tests::random_disk;
    use proptest::prelude::*;

    fn textured(choices: &[u16]) -> TriMesh {
        let mut mesh = random_disk(choices);
        mesh.uv = Some(mesh.positions_mm.iter().map(|p| [0.5 + 0.2 * p.x, 0.5 + 0.2 * p.y]).collect());
        mesh
    }

    proptest! {
        #[test]
        fn positions_and_uv_come_back_within_half_a_step(choices in prop::collection::vec(any::<u16>(), 1..80)) {
            let mesh = textured(&choices);
            let frame = TextureFrame { size_px: [640, 480], camera: None };
            let coded = encode(&mesh, 0.01, Some(frame)).unwrap();
            let order = connectivity::encode(&mesh).unwrap().order;
            let uv = coded.decoded.uv.as_ref().unwrap();
            for (new, &old) in order.iter().enumerate() {
                let d = (coded.decoded.positions_mm[new] - mesh.positions_mm[old as usize]).abs().max_element();
                prop_assert!(d <= 0.00501, "{d}");
                let t = mesh.uv.as_ref().unwrap()[old as usize];
                prop_assert!((uv[new][0] - t[0]).abs() * 640.0 <= 0.04 && (uv[new][1] - t[1]).abs() * 480.0 <= 0.04);
            }
        }
    }

    #[test]
    fn prefixes_fail_and_flips_never_panic() {
        let mesh = textured(&(0..40).map(|i: u16| i.wrapping_mul(2311)).collect::<Vec<u16>>());
        let coded = encode(&mesh, 0.01, Some(TextureFrame { size_px: [64, 48], camera: None })).unwrap();
        for n in 0..coded.bytes.len() {
            assert!(decode(&mut ByteReader::new(&coded.bytes[..n], "surface"), 0.01).is_err(), "{n}");
        }
        for i in 0..coded.bytes.len() * 8 {
            let mut bad = coded.bytes.clone();
            bad[i / 8] ^= 1 << (i % 8);
            let _ = decode(&mut ByteReader::new(&bad, "surface"), 0.01);
        }
    }

    #[test]
    fn texture_coordinates_out_of_range_are_coded_at_its_ends() {
        let mut mesh = textured(&(0..40).map(|i: u16| i.wrapping_mul(2311)).collect::<Vec<u16>>());
        let camera = CameraFit { matrix: [0.0; 12], max_error_px: 0.0, rms_error_px: 0.0 };
        mesh.uv.as_mut().unwrap()[0] = [1e6, f32::NEG_INFINITY];
        let frame = TextureFrame { size_px: [64, 48], camera: Some(camera) };
        let coded = encode(&mesh, 0.01, Some(frame)).unwrap();
        let most = coded.decoded.uv.as_ref().unwrap().iter().map(|t| t[0]).fold(f32::MIN, f32::max);
        assert_eq!(most, 16384.5 / 64.0);
        let least = coded.decoded.uv.as_ref().unwrap().iter().map(|t| t[1]).fold(f32::MAX, f32::min);
        assert_eq!(least, 1.0 - 16384.5 / 48.0);
    }

    #[test]
    fn far_vertices_are_refused() {
        let mut mesh = textured(&[1, 2, 3]);
        mesh.positions_mm[1].x = 1e12;
        assert!(encode(&mesh, 0.01, None).err().unwrap().to_string().contains("out of range"));
    }
}
