//! Binary glTF: a surface with its picture, and its movement as morph targets that an animation plays.
//!
//! Format: Khronos, glTF 2.0 (ISO/IEC 12113:2022), GLB in section 4.4. Positions take 16 bits a coordinate
//! (KHR_mesh_quantization, 2020), which Blender and three.js read. glTF counts in metres, x right, y up, z towards who
//! looks at the front, as scans do in millimetres; its pictures begin at the top, so v is turned round.

use super::error::{FileError, Result};
use super::glb::{Glb, Kind};
use super::picture::{PictureFormat, picture_bytes};
use bytemuck::cast_slice;
use glam::Vec3;
use gv3_codec::{GreyPicture, mesh::TriMesh};
use serde_json::json;
use std::path::Path;

/// Most scans of one clip: each is a shape key where it is opened, and the animation has a number for each pair of them.
pub const MAX_CLIP_SCANS: usize = 600;
/// Most bytes of the positions that a clip holds.
pub const MAX_CLIP_BYTES: usize = 128 << 20;

const LINEAR_FILTER: u32 = 9729;
const CLAMP_TO_EDGE: u32 = 33_071;
const METRES_PER_MM: f32 = 1e-3;

/// Scans of one connectivity, each later than the one before.
#[derive(Debug)]
pub struct GltfClip {
    first: TriMesh,
    texture: Option<GreyPicture>,
    /// Number in file names and sensor time of each scan.
    stamps: Vec<(u64, u64)>,
    /// Positions of the scans after the first, one after the other.
    moved_mm: Vec<Vec3>,
}

impl GltfClip {
    /// A clip that begins with a scan of a valid mesh. The picture is this scan's throughout: glTF has none that moves.
    pub fn new(number: u64, time_nanos: u64, mesh: &TriMesh, texture: Option<&GreyPicture>) -> Self {
        let (first, texture) = (mesh.clone(), texture.cloned());
        Self { first, texture, stamps: vec![(number, time_nanos)], moved_mm: Vec::new() }
    }

    /// Number of its first scan.
    pub fn number(&self) -> u64 {
        self.stamps[0].0
    }

    /// Whether a scan goes on with it: of the same connectivity, and later.
    pub fn takes(&self, mesh: &TriMesh, time_nanos: u64) -> bool {
        let (_, last_nanos) = self.stamps[self.stamps.len() - 1];
        let is_same = mesh.vertex_count() == self.first.vertex_count() && mesh.triangles == self.first.triangles;
        is_same && time_nanos > last_nanos
    }

    /// Appends a scan that it takes. `path` only names the clip in errors.
    ///
    /// # Errors
    /// [`FileError`] naming the limit: more than [`MAX_CLIP_SCANS`] scans or [`MAX_CLIP_BYTES`] of positions.
    pub fn add(&mut self, number: u64, time_nanos: u64, mesh: &TriMesh, path: &Path) -> Result<()> {
        let most = (MAX_CLIP_BYTES / (12 * self.first.vertex_count().max(1))).clamp(1, MAX_CLIP_SCANS);
        if self.stamps.len() >= most {
            let reason = format!(
                "more than {most} scans of {} vertices in one connectivity, the most that an animation holds; export a \
                 shorter range of ticks, or fewer scans a second",
                self.first.vertex_count()
            );
            return Err(FileError::content(path, reason));
        }
        self.stamps.push((number, time_nanos));
        self.moved_mm.extend_from_slice(&mesh.positions_mm);
        Ok(())
    }

    /// The clip as a GLB file; `path` only names it in errors. A surface without triangles is an empty scene.
    ///
    /// # Errors
    /// [`FileError`]: the picture is too large for PNG, or the file would be larger than the format's 4 GiB.
    pub fn bytes(&self, path: &Path) -> Result<Vec<u8>> {
        let mut glb = Glb::default();
        let mut node = json!({ "name": self.name() });
        if !self.first.triangles.is_empty() {
            let grid = Grid::of(&self.first.positions_mm, &self.moved_mm);
            node["mesh"] = 0.into();
            node["translation"] = json!((grid.origin_mm * METRES_PER_MM).to_array());
            node["scale"] = json!(Vec3::splat(grid.size_mm * METRES_PER_MM).to_array());
            glb.root["extensionsUsed"] = json!(["KHR_mesh_quantization"]);
            glb.root["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
            self.put_mesh(&mut glb, &grid);
            self.put_material(&mut glb, path)?;
            if self.stamps.len() > 1 {
                self.put_targets(&mut glb, &grid);
                self.put_animation(&mut glb);
            }
        }
        glb.root["nodes"] = json!([node]);
        glb.bytes().ok_or_else(|| FileError::content(path, "larger than the 4 GiB of a GLB file; export fewer scans"))
    }

    fn name(&self) -> String {
        match (self.number(), self.stamps[self.stamps.len() - 1].0) {
            (first, last) if first == last => format!("scan {first}"),
            (first, last) => format!("scans {first} to {last}"),
        }
    }

    fn put_mesh(&self, glb: &mut Glb, grid: &Grid) {
        let mesh = &self.first;
        let moved = 8 * (mesh.vertex_count() + self.moved_mm.len());
        glb.reserve(moved + 12 * (mesh.vertex_count() + mesh.triangles.len()));
        let positions: Vec<[u16; 4]> = mesh.positions_mm.iter().map(|p| grid.place(*p)).collect();
        let normals: Vec<[i8; 4]> = mesh.vertex_normals().into_iter().map(normal_bytes).collect();
        let primitive = json!({
            "attributes": {
                "POSITION": glb.array(&positions, Kind::Positions),
                "NORMAL": glb.array(&normals, Kind::Normals),
            },
            "indices": glb.array::<u32, 1>(cast_slice(&mesh.triangles), Kind::Corners),
            "material": 0,
        });
        glb.root["meshes"] = json!([{ "name": self.name(), "primitives": [primitive] }]);
    }

    /// Matt, seen from both sides; with the picture where there is one.
    fn put_material(&self, glb: &mut Glb, path: &Path) -> Result<()> {
        glb.root["materials"] =
            json!([{ "doubleSided": true, "pbrMetallicRoughness": { "metallicFactor": 0, "roughnessFactor": 1 } }]);
        let (Some(uv), Some(texture)) = (&self.first.uv, &self.texture) else { return Ok(()) };
        let picture = glb.view(&picture_bytes(texture, PictureFormat::Png, path)?);
        let places: Vec<[f32; 2]> = uv.iter().map(|[u, v]| [*u, 1.0 - v]).collect();
        let places = glb.array(&places, Kind::TexturePlaces);
        glb.root["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = places.into();
        glb.root["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": 0 });
        glb.root["textures"] = json!([{ "source": 0, "sampler": 0 }]);
        glb.root["images"] = json!([{ "bufferView": picture, "mimeType": "image/png" }]);
        let [filter, wrap] = [LINEAR_FILTER, CLAMP_TO_EDGE];
        glb.root["samplers"] = json!([{ "magFilter": filter, "minFilter": filter, "wrapS": wrap, "wrapT": wrap }]);
        Ok(())
    }

    /// Where the vertices of every later scan are, from the first one's.
    fn put_targets(&self, glb: &mut Glb, grid: &Grid) {
        let first = &self.first.positions_mm;
        let mut targets = Vec::with_capacity(self.stamps.len() - 1);
        for moved in self.moved_mm.chunks_exact(first.len()) {
            let moves: Vec<[i16; 4]> = moved.iter().zip(first).map(|(p, from)| grid.step(*p, *from)).collect();
            targets.push(json!({ "POSITION": glb.array(&moves, Kind::Moves) }));
        }
        let names: Vec<String> = self.stamps[1..].iter().map(|(number, _)| format!("scan {number}")).collect();
        let mesh = &mut glb.root["meshes"][0];
        mesh["weights"] = json!(vec![0; names.len()]);
        mesh["extras"] = json!({ "targetNames": names });
        mesh["primitives"][0]["targets"] = json!(targets);
    }

    /// At the time of each scan its own target has the weight 1 and the others 0; between two scans positions run
    /// straight.
    fn put_animation(&self, glb: &mut Glb) {
        let start_nanos = self.stamps[0].1;
        let times: Vec<f32> = self.stamps.iter().map(|s| ((s.1 - start_nanos) as f64 * 1e-9) as f32).collect();
        let targets = times.len() - 1;
        let mut weights = vec![0f32; times.len() * targets];
        for target in 0..targets {
            weights[(target + 1) * targets + target] = 1.0;
        }
        let (input, output) = (
            glb.array::<f32, 1>(cast_slice(&times), Kind::Times),
            glb.array::<f32, 1>(cast_slice(&weights), Kind::Weights),
        );
        glb.root["animations"] = json!([{
            "name": self.name(),
            "samplers": [{ "input": input, "output": output, "interpolation": "LINEAR" }],
            "channels": [{ "sampler": 0, "target": { "node": 0, "path": "weights" } }],
        }]);
    }
}

/// A cube whose coordinates run from 0 to 1, in 16 bits: positions lie in it, and moves are at most as long as it.
struct Grid {
    origin_mm: Vec3,
    size_mm: f32,
}

impl Grid {
    /// Of the positions of a surface, at least one, and those that it moves to, one surface after the other.
    fn of(first: &[Vec3], moved: &[Vec3]) -> Self {
        let (low, high) = first.iter().fold((first[0], first[0]), |(low, high), p| (low.min(*p), high.max(*p)));
        let moves = moved.chunks_exact(first.len()).flat_map(|m| m.iter().zip(first));
        let longest = moves.fold(Vec3::ZERO, |longest, (to, from)| longest.max((to - from).abs()));
        Self { origin_mm: low, size_mm: (high - low).max(longest).max_element().max(1e-3) }
    }

    /// A position, and padding.
    fn place(&self, p: Vec3) -> [u16; 4] {
        let [x, y, z] = ((p - self.origin_mm) / self.size_mm).to_array().map(|c| (c * 65_535.0 + 0.5) as u16);
        [x, y, z, 0]
    }

    /// The way to `p` from where the file has `from`, and padding.
    fn step(&self, p: Vec3, from: Vec3) -> [i16; 4] {
        let [x, y, z, _] = self.place(from).map(|c| f32::from(c) / 65_535.0);
        let step = (p - self.origin_mm) / self.size_mm - Vec3::new(x, y, z);
        let [x, y, z] = step.to_array().map(|c| (c * 32_767.0).round() as i16);
        [x, y, z, 0]
    }
}

/// A unit vector, and padding; whatever for a vertex that no triangle has.
fn normal_bytes(normal: Vec3) -> [i8; 4] {
    let [x, y, z] = normal.normalize_or(Vec3::Z).to_array().map(|c| (c * 127.0).round() as i8);
    [x, y, z, 0]
}
