//! The binary message in which viewers get a surface: 16-bit positions, texture coordinates, a scalar, triangles, and a
//! JPEG. Byte table in the description of `/live/mesh` in openapi.json.

use super::decimate::Decimation;
use super::scalars::{ScalarKind, Scalars};
use glam::Vec3;
use gv3_codec::{GreyPicture, Scan};
use jpeg_encoder::{ColorType, Encoder};
use std::sync::Arc;

/// First bytes of a mesh message: "GV3M" read as a little-endian number is 0x4D335647.
pub const MESH_MAGIC: u32 = u32::from_le_bytes(*b"GV3M");
/// Bytes before the positions.
pub const HEADER_BYTES: usize = 72;
/// Largest and smallest number of vertices that a viewer may ask for.
pub const VERTEX_LIMITS: (usize, usize) = (500, 200_000);
/// JPEG quality of textures and camera pictures.
const JPEG_QUALITY: u8 = 85;

const FULL: u8 = 0;
const POSITIONS_ONLY: u8 = 1;
const HAS_TEXTURE: u8 = 1;
const HAS_UV: u8 = 2;
const HAS_SCALARS: u8 = 4;

/// What a viewer has been sent: as long as it holds, only positions are sent.
struct Sent {
    /// Triangles and uv of the whole surface.
    triangles: Vec<[u32; 3]>,
    uv: Option<Vec<[f32; 2]>>,
    decimation: Arc<Decimation>,
}

/// Makes the messages of one viewer.
pub struct MeshMessages {
    max_vertices: usize,
    keeps_topology: bool,
    topology_id: u32,
    sequence: u32,
    sent: Option<Sent>,
    texture: Option<GreyPicture>,
}

impl MeshMessages {
    /// Messages of at most so many vertices. With `keeps_topology` only positions are sent while triangles and texture
    /// coordinates stay the same.
    pub fn new(max_vertices: usize, keeps_topology: bool) -> Self {
        let max_vertices = max_vertices.clamp(VERTEX_LIMITS.0, VERTEX_LIMITS.1);
        Self { max_vertices, keeps_topology, topology_id: 0, sequence: 0, sent: None, texture: None }
    }

    /// Number of the last message.
    pub fn sequence(&self) -> u32 {
        self.sequence
    }

    /// The next message; `scalars` gives one number for each of the vertices shown.
    pub fn encode(
        &mut self,
        scan: &Scan,
        time_seconds: f64,
        scalars: impl FnOnce(&[u32]) -> Option<Scalars>,
    ) -> Vec<u8> {
        let kind = self.follow(scan);
        let texture_is_new = kind == FULL || self.texture != scan.texture;
        let jpeg = match (&scan.texture, texture_is_new) {
            (Some(texture), true) => jpeg_bytes(texture),
            _ => Vec::new(),
        };
        if texture_is_new && self.keeps_topology {
            self.texture.clone_from(&scan.texture);
        }
        self.sequence = self.sequence.wrapping_add(1);
        let Some(sent) = &self.sent else { return Vec::new() };
        let scalars = scalars(&sent.decimation.kept);
        let message = Message { scan, decimation: &sent.decimation, kind, jpeg: &jpeg, scalars: scalars.as_ref() };
        let bytes = message.bytes(self.sequence, self.topology_id, time_seconds);
        if !self.keeps_topology {
            self.sent = None;
        }
        bytes
    }

    /// Takes the surface's topology as the one that holds; returns the kind of message that says so.
    fn follow(&mut self, scan: &Scan) -> u8 {
        let same = |s: &&Sent| s.triangles == scan.mesh.triangles;
        let known = self.sent.as_ref().filter(same).map(|s| (Arc::clone(&s.decimation), s.uv == scan.mesh.uv));
        if let Some((_, true)) = known {
            return POSITIONS_ONLY;
        }
        let decimation = match known {
            Some((decimation, _)) => decimation,
            None if self.keeps_topology => Arc::new(Decimation::new(&scan.mesh, self.max_vertices)),
            None => Arc::new(Decimation::of_scan(&scan.mesh, self.max_vertices)),
        };
        self.topology_id = self.topology_id.wrapping_add(1);
        let (triangles, uv) = match self.keeps_topology {
            true => (scan.mesh.triangles.clone(), scan.mesh.uv.clone()),
            false => (Vec::new(), None),
        };
        self.sent = Some(Sent { triangles, uv, decimation });
        FULL
    }
}

/// The parts of one message.
struct Message<'a> {
    scan: &'a Scan,
    decimation: &'a Decimation,
    kind: u8,
    jpeg: &'a [u8],
    scalars: Option<&'a Scalars>,
}

impl Message<'_> {
    fn bytes(&self, sequence: u32, topology_id: u32, time_seconds: f64) -> Vec<u8> {
        let (mesh, kept) = (&self.scan.mesh, &self.decimation.kept);
        let uv = mesh.uv.as_ref().filter(|_| self.kind == FULL);
        let triangles: &[[u32; 3]] = if self.kind == FULL { &self.decimation.triangles } else { &[] };
        let (low, high) = mesh.bounds_mm();
        let step = ((high - low) / 65_535.0).max(Vec3::splat(f32::MIN_POSITIVE));
        let flags = if self.jpeg.is_empty() { 0 } else { HAS_TEXTURE }
            | if uv.is_some() { HAS_UV } else { 0 }
            | if self.scalars.is_some() { HAS_SCALARS } else { 0 };
        let mut out = Vec::with_capacity(HEADER_BYTES + kept.len() * 11 + 12 * triangles.len() + self.jpeg.len() + 8);
        out.extend(MESH_MAGIC.to_le_bytes());
        let scalar_kind = self.scalars.map_or(ScalarKind::None, |s| s.kind);
        out.extend([1, self.kind, flags, scalar_kind as u8]);
        out.extend(sequence.to_le_bytes());
        out.extend(topology_id.to_le_bytes());
        out.extend(time_seconds.to_le_bytes());
        out.extend((kept.len() as u32).to_le_bytes());
        out.extend((triangles.len() as u32).to_le_bytes());
        for value in [low.x, low.y, low.z, step.x, step.y, step.z] {
            out.extend(value.to_le_bytes());
        }
        out.extend((self.jpeg.len() as u32).to_le_bytes());
        let (scalar_low, scalar_high) = self.scalars.map_or((0.0, 0.0), |s| (s.low, s.high));
        out.extend(scalar_low.to_le_bytes());
        out.extend(scalar_high.to_le_bytes());
        out.resize(HEADER_BYTES, 0);
        self.put_vertices(&mut out, low, step, uv);
        out.extend_from_slice(bytemuck::cast_slice(triangles));
        out.extend_from_slice(self.jpeg);
        out
    }

    fn put_vertices(&self, out: &mut Vec<u8>, low: Vec3, step: Vec3, uv: Option<&Vec<[f32; 2]>>) {
        let scale = step.recip();
        for &v in &self.decimation.kept {
            let p = (self.scan.mesh.positions_mm[v as usize] - low) * scale;
            for value in [p.x, p.y, p.z] {
                out.extend(((value + 0.5) as u16).to_le_bytes());
            }
        }
        pad(out);
        for uv in uv.into_iter().flat_map(|uv| self.decimation.kept.iter().map(|&v| uv[v as usize])) {
            for value in uv {
                out.extend(((value.clamp(0.0, 1.0) * 65_535.0 + 0.5) as u16).to_le_bytes());
            }
        }
        if let Some(scalars) = self.scalars {
            let scale = 255.0 / (scalars.high - scalars.low).max(f32::MIN_POSITIVE);
            out.extend(scalars.values.iter().map(|value| ((value - scalars.low) * scale + 0.5) as u8));
            pad(out);
        }
    }
}

fn pad(out: &mut Vec<u8>) {
    out.resize(out.len().next_multiple_of(4), 0);
}

/// A grey JPEG; empty for a picture without pixels or of more than 65,535 on a side.
pub fn jpeg_bytes(picture: &GreyPicture) -> Vec<u8> {
    let (Ok(width), Ok(height)) = (u16::try_from(picture.width_px), u16::try_from(picture.height_px)) else {
        return Vec::new();
    };
    let mut bytes = Vec::new();
    match Encoder::new(&mut bytes, JPEG_QUALITY).encode(&picture.pixels, width, height, ColorType::Luma) {
        Ok(()) => bytes,
        Err(_) => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gv3_codec::mesh::TriMesh;

    fn scan(lift_mm: f32) -> Scan {
        let positions_mm = vec![
            Vec3::new(-10.0, 0.0, 400.0 + lift_mm),
            Vec3::new(10.0, 0.0, 401.0),
            Vec3::new(10.0, 20.0, 402.0),
            Vec3::new(-10.0, 20.0, 410.0),
            Vec3::new(0.0, 10.0, 405.0),
        ];
        let uv = positions_mm.iter().map(|p| [p.x / 20.0 + 0.5, p.y / 20.0]).collect();
        let mesh = TriMesh { positions_mm, triangles: vec![[0, 1, 4], [1, 2, 4], [2, 3, 4]], uv: Some(uv) };
        Scan { tick: 3, time_nanos: 5, mesh, texture: Some(GreyPicture::filled(16, 8, 90)) }
    }

    fn u32_at(bytes: &[u8], at: usize) -> u32 {
        u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
    }

    fn f32_at(bytes: &[u8], at: usize) -> f32 {
        f32::from_bits(u32_at(bytes, at))
    }

    fn positions(bytes: &[u8], count: usize) -> Vec<Vec3> {
        let [low, step] = [32, 44].map(|at| Vec3::from_array([0, 4, 8].map(|i| f32_at(bytes, at + i))));
        let value = |i: usize| f32::from(u16::from_le_bytes([bytes[72 + 2 * i], bytes[73 + 2 * i]]));
        (0..count).map(|v| low + step * Vec3::new(value(3 * v), value(3 * v + 1), value(3 * v + 2))).collect()
    }

    #[test]
    fn a_full_message_has_the_layout_of_its_table() {
        let scan = scan(0.0);
        let scalars = Scalars { kind: ScalarKind::Motion, values: vec![0.0, 1.0, 2.0, 3.0, 4.0], low: 0.0, high: 4.0 };
        let bytes = MeshMessages::new(1000, false).encode(&scan, 1.5, |_| Some(scalars));
        assert_eq!(&bytes[..8], b"GV3M\x01\x00\x07\x03");
        assert_eq!((u32_at(&bytes, 8), u32_at(&bytes, 12)), (1, 1));
        assert_eq!(f64::from_le_bytes(bytes[16..24].try_into().unwrap()), 1.5);
        assert_eq!((u32_at(&bytes, 24), u32_at(&bytes, 28)), (5, 3));
        for (p, q) in positions(&bytes, 5).iter().zip(&scan.mesh.positions_mm) {
            assert!(p.distance(*q) < 5e-4, "{p} {q}");
        }
        let (uv, scalars, triangles) = (72 + 32, 72 + 32 + 20, 72 + 32 + 20 + 8);
        assert_eq!(bytes[uv..uv + 4], [0, 0, 0, 0]);
        assert_eq!(bytes[scalars..scalars + 5], [0, 64, 128, 191, 255]);
        assert_eq!((u32_at(&bytes, triangles), u32_at(&bytes, triangles + 8)), (0, 4));
        let jpeg = &bytes[triangles + 36..];
        assert_eq!((jpeg.len(), &jpeg[..2]), (u32_at(&bytes, 56) as usize, &[0xff, 0xd8][..]));
    }

    #[test]
    fn positions_alone_follow_while_the_topology_holds() {
        let mut messages = MeshMessages::new(1000, true);
        let first = messages.encode(&scan(0.0), 0.0, |_| None);
        let second = messages.encode(&scan(5.0), 0.1, |_| None);
        assert_eq!((first[5], second[5]), (FULL, POSITIONS_ONLY));
        assert_eq!((second[6], u32_at(&second, 12), u32_at(&second, 28), second.len()), (0, 1, 0, 72 + 32));
        assert!(positions(&second, 5)[0].distance(scan(5.0).mesh.positions_mm[0]) < 5e-4);
        let mut other = scan(5.0);
        other.mesh.triangles.pop();
        let third = messages.encode(&other, 0.2, |_| None);
        assert_eq!((third[5], u32_at(&third, 12)), (FULL, 2));
        other.mesh.uv = None;
        let fourth = messages.encode(&other, 0.3, |_| None);
        assert_eq!((fourth[5], fourth[6] & HAS_UV, u32_at(&fourth, 12)), (FULL, 0, 3));
    }

    #[test]
    fn a_new_texture_comes_with_positions_alone() {
        let mut messages = MeshMessages::new(1000, true);
        let mut scan = scan(0.0);
        messages.encode(&scan, 0.0, |_| None);
        scan.texture = Some(GreyPicture::filled(16, 8, 200));
        let second = messages.encode(&scan, 0.1, |_| None);
        assert_eq!((second[5], second[6]), (POSITIONS_ONLY, HAS_TEXTURE));
        assert!(u32_at(&second, 56) > 0);
    }

    #[test]
    fn nothing_at_all_is_a_message_too() {
        let bytes = MeshMessages::new(1000, false).encode(&Scan::default(), 0.0, |_| None);
        assert_eq!(bytes.len(), HEADER_BYTES);
    }
}
