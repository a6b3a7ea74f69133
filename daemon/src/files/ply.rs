//! PLY, the Stanford polygon format: ASCII and binary in, binary little-endian out.
//!
//! Format: G. Turk, The PLY Polygon File Format, 1994; texture as MeshLab writes it (`comment TextureFile NAME`, `s t`
//! at vertices or a list `texcoord` at faces). `ply-rs-bw` reads; it trusts the header's element counts, so these are
//! held against the bytes that follow first.

use super::assemble::{Assembler, MeshFile, Repairs};
use super::error::{FileError, Result, check_size, read_limited};
use glam::Vec3;
use gv3_codec::mesh::TriMesh;
use ply_rs_bw::parser::{ParseError, Parser, Reader};
use ply_rs_bw::ply::{ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyType};
use std::path::Path;

/// Largest PLY file read, some fifty times a scan.
pub const MAX_PLY_BYTES: u64 = 256 << 20;
/// Most elements of one kind.
const MAX_ELEMENTS: usize = 16 << 20;

/// Reads a PLY file; see [`parse_ply`].
///
/// # Errors
/// [`FileError`]: not readable, or as [`parse_ply`].
pub fn read_ply(path: &Path) -> Result<MeshFile> {
    parse_ply(&read_limited(path, MAX_PLY_BYTES)?, path)
}

/// Reads a PLY mesh; elements and properties other than positions, texture coordinates and faces are passed over.
///
/// Vertex `i` of the file is vertex `i` of the mesh. Polygons become fans. `path` only names the bytes in errors.
///
/// # Errors
/// [`FileError`] naming line or byte and element: a broken or too large header, bytes cut short, numbers that are not
/// finite, indices out of range, no faces.
pub fn parse_ply(bytes: &[u8], path: &Path) -> Result<MeshFile> {
    check_size(bytes.len() as u64, MAX_PLY_BYTES, path)?;
    if !bytes.starts_with(b"ply") {
        return Err(FileError::byte(path, 0, "does not begin with `ply`; is this a PLY file?"));
    }
    let mut file = Source { reader: Reader::new(bytes), size: bytes.len(), path };
    let header = file.header()?;
    file.check_header(&header)?;
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    for (name, element) in &header.elements {
        match name.as_str() {
            "vertex" => vertices = file.elements::<Vertex>(&header, element)?,
            "face" => faces = file.elements::<Face>(&header, element)?,
            _ => drop(file.elements::<Skipped>(&header, element)?),
        }
    }
    let texture = header.comments.iter().find_map(|c| c.strip_prefix("TextureFile")).map(|name| name.trim().to_owned());
    assemble(&vertices, &faces, texture, path)
}

/// Bytes with the place up to which they are read.
struct Source<'a> {
    reader: Reader<&'a [u8]>,
    size: usize,
    path: &'a Path,
}

impl Source<'_> {
    fn header(&mut self) -> Result<Header> {
        Parser::<Skipped>::new().read_header(&mut self.reader).map_err(|e| {
            let reason = format!("broken header: {}; is this a PLY file?", on_one_line(&e));
            FileError::line(self.path, e.line().unwrap_or(1), reason)
        })
    }

    /// Every element takes at least its scalars and list lengths, so a count says how many bytes must follow.
    fn check_header(&self, header: &Header) -> Result<()> {
        let left = self.reader.get_ref().len();
        for (name, element) in &header.elements {
            let count = element.count;
            let size = least_size(element, header.encoding);
            let reason = if size == 0 && count > 0 {
                format!("element {name} has no properties; remove it")
            } else if count > MAX_ELEMENTS {
                format!("{count} elements {name}, more than the limit of {MAX_ELEMENTS}; split or simplify the mesh")
            } else if count.saturating_mul(size) > left {
                format!("{count} elements {name} announced, but only {left} bytes follow; the file is cut short")
            } else {
                continue;
            };
            return Err(FileError::byte(self.path, self.size - left, reason));
        }
        let axes = |e: &ElementDef| ["x", "y", "z"].iter().all(|&axis| e.properties.contains_key(axis));
        if !header.elements.get("vertex").is_some_and(axes) {
            return Err(FileError::content(self.path, "no element vertex with properties x, y, z; is this a mesh?"));
        }
        Ok(())
    }

    fn elements<E: PropertyAccess>(&mut self, header: &Header, element: &ElementDef) -> Result<Vec<E>> {
        Parser::<E>::new().read_payload_for_element(&mut self.reader, element, header).map_err(|e| {
            let reason = format!("{}; is the file cut short or damaged?", on_one_line(&e));
            match header.encoding {
                Encoding::Ascii => FileError::line(self.path, e.line().unwrap_or(1), reason),
                _ => FileError::byte(self.path, self.size - self.reader.get_ref().len(), reason),
            }
        })
    }
}

/// Fewest bytes of one element: a digit and a separator a property in ASCII, whose very last separator may be missing.
fn least_size(element: &ElementDef, encoding: Encoding) -> usize {
    use ply_rs_bw::ply::ScalarType::{Char, Double, Float, Int, Short, UChar, UInt, UShort};
    let sizes = element.properties.values().map(|property| match &property.data_type {
        PropertyType::Scalar(scalar) | PropertyType::List(scalar, _) => match scalar {
            Char | UChar => 1,
            Short | UShort => 2,
            Int | UInt | Float => 4,
            Double => 8,
        },
    });
    match encoding {
        Encoding::Ascii => element.properties.len(),
        _ => sizes.sum(),
    }
}

/// The parser's message, which quotes the line at fault whatever its length, on one line of bounded length.
fn on_one_line(error: &ParseError) -> String {
    let text = error.to_string();
    let text = text.strip_prefix(&format!("Line {}: ", error.line().unwrap_or(0))).unwrap_or(&text);
    let parts: Vec<_> = text.lines().map(str::trim).filter(|part| !part.is_empty()).collect();
    let joined = parts.join(", ");
    let mut short: String = joined.trim_end_matches([',', '.', ' ']).chars().take(200).collect();
    if short.len() < joined.len() && joined.chars().nth(200).is_some() {
        short.push_str("...");
    }
    short
}

#[derive(Clone, Copy)]
struct Vertex {
    position_mm: Vec3,
    /// NaN where the file has none.
    uv: [f32; 2],
}

impl Vertex {
    fn finite_uv(&self) -> Option<[f32; 2]> {
        self.uv.iter().all(|x| x.is_finite()).then_some(self.uv)
    }
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { position_mm: Vec3::ZERO, uv: [f32::NAN; 2] }
    }

    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        match value.to_f32_lossy() {
            Some(number) => self.set_float(name, number),
            None => PropertyAccessResult::Ignored,
        }
    }

    fn set_float(&mut self, name: &str, value: f32) -> PropertyAccessResult {
        let place = match name {
            "x" => &mut self.position_mm.x,
            "y" => &mut self.position_mm.y,
            "z" => &mut self.position_mm.z,
            "s" | "u" | "texture_u" => &mut self.uv[0],
            "t" | "v" | "texture_v" => &mut self.uv[1],
            _ => return PropertyAccessResult::Ignored,
        };
        *place = value;
        PropertyAccessResult::Set
    }
}

/// A polygon; indices are kept as they stand, range unchecked.
#[derive(Default)]
struct Face {
    vertices: Vec<i64>,
    /// Two numbers a corner, where the file has them.
    uv: Vec<f32>,
}

impl PropertyAccess for Face {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        match name {
            "vertex_indices" | "vertex_index" => {
                self.vertices = match value {
                    Property::ListChar(list) => list.into_iter().map(i64::from).collect(),
                    Property::ListUChar(list) => list.into_iter().map(i64::from).collect(),
                    Property::ListShort(list) => list.into_iter().map(i64::from).collect(),
                    Property::ListUShort(list) => list.into_iter().map(i64::from).collect(),
                    Property::ListInt(list) => list.into_iter().map(i64::from).collect(),
                    Property::ListUInt(list) => list.into_iter().map(i64::from).collect(),
                    _ => return PropertyAccessResult::UnsupportedType,
                }
            }
            "texcoord" => {
                self.uv = match value {
                    Property::ListFloat(list) => list,
                    Property::ListDouble(list) => list.into_iter().map(|x| x as f32).collect(),
                    _ => return PropertyAccessResult::UnsupportedType,
                }
            }
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

/// An element that is read over.
struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Self
    }
}

fn assemble(vertices: &[Vertex], faces: &[Face], texture: Option<String>, path: &Path) -> Result<MeshFile> {
    if let Some(i) = vertices.iter().position(|v| !v.position_mm.is_finite()) {
        let reason = format!("vertex {} is not finite; remove it and its faces", i + 1);
        return Err(FileError::content(path, reason));
    }
    let positions_mm = vertices.iter().map(|v| v.position_mm).collect();
    let mut assembler = Assembler::new(positions_mm, faces.len(), Repairs::default());
    let mut polygon = Vec::new();
    for (i, face) in faces.iter().enumerate() {
        polygon.clear();
        for &v in &face.vertices {
            let in_range = u32::try_from(v).ok().filter(|&v| (v as usize) < vertices.len());
            polygon.push(in_range.ok_or_else(|| {
                let count = vertices.len();
                FileError::content(path, format!("face {} names vertex {v}, of 0 to {}", i + 1, count as i64 - 1))
            })?);
        }
        assembler.polygon(&polygon);
        for (&v, uv) in polygon.iter().zip(face.uv.chunks_exact(2)).filter(|(_, uv)| uv.iter().all(|x| x.is_finite())) {
            assembler.corner_uv(v, [uv[0], uv[1]]);
        }
        // Where a file has both, viewers show the faces' own.
        for &v in polygon.iter().filter(|_| face.uv.is_empty()) {
            if let Some(uv) = vertices[v as usize].finite_uv() {
                assembler.corner_uv(v, uv);
            }
        }
    }
    assembler.unused_uv(|v| vertices[v].finite_uv().unwrap_or_default());
    assembler.finish(texture, path)
}

/// Binary little-endian PLY of a mesh, with `s t` where it has texture coordinates and the picture's file name.
pub fn ply_bytes(mesh: &TriMesh, picture: Option<&str>) -> Vec<u8> {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    if let Some(picture) = picture {
        header += &format!("comment TextureFile {picture}\n");
    }
    header += &format!("element vertex {}\n", mesh.vertex_count());
    let names: &[_] = if mesh.uv.is_some() { &["x", "y", "z", "s", "t"] } else { &["x", "y", "z"] };
    for name in names {
        header += &format!("property float {name}\n");
    }
    header += &format!("element face {}\nproperty list uchar int vertex_indices\nend_header\n", mesh.triangles.len());
    let mut bytes = header.into_bytes();
    bytes.reserve(mesh.vertex_count() * 4 * names.len() + mesh.triangles.len() * 13);
    for (i, p) in mesh.positions_mm.iter().enumerate() {
        let uv = mesh.uv.as_ref().map(|uv| uv[i]);
        for x in p.to_array().into_iter().chain(uv.into_iter().flatten()) {
            bytes.extend_from_slice(&x.to_le_bytes());
        }
    }
    for triangle in &mesh.triangles {
        bytes.push(3);
        for v in triangle {
            bytes.extend_from_slice(&v.to_le_bytes());
        }
    }
    bytes
}

#[cfg(test)]
#[path = "ply_tests.rs"]
mod tests;
