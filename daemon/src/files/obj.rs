//! Wavefront OBJ: positions, texture coordinates and polygons in; triangles out.
//!
//! Format: Wavefront, Advanced Visualizer manual, appendix B1. Numbers are read by `tobj`, which by itself numbers
//! vertices by first use, gives a corner without texture coordinate its neighbour's, does not survive a relative index
//! that points before the first element, and names no line. So the face lines are checked and made absolute before it
//! sees them, and a leading polygon over all vertices in order makes its order of first use the order of the file.

use super::assemble::{Assembler, MeshFile, Repairs};
use super::error::{FileError, Result, check_size, read_limited};
use glam::Vec3;
use gv3_codec::mesh::TriMesh;
use std::borrow::Cow;
use std::io::Write;
use std::path::Path;
use tobj::LoadError;

/// Largest OBJ file read, about twenty times a scan.
pub const MAX_OBJ_BYTES: u64 = 256 << 20;
/// Most corners of all faces together: `tobj` takes up to 35 bytes for each.
const MAX_CORNERS: usize = 48 << 20;

/// Reads an OBJ file; see [`parse_obj`].
///
/// # Errors
/// [`FileError`]: not readable, or as [`parse_obj`].
pub fn read_obj(path: &Path) -> Result<MeshFile> {
    parse_obj(&read_limited(path, MAX_OBJ_BYTES)?, path)
}

/// Reads OBJ text into one mesh; objects and groups are merged, normals, lines and materials passed over.
///
/// Vertex `i` of the text is vertex `i` of the mesh. Polygons become fans. `path` only names the text in errors.
///
/// # Errors
/// [`FileError`] naming the line: numbers that are none or not finite, indices out of range, no faces, text longer than
/// [`MAX_OBJ_BYTES`].
pub fn parse_obj(bytes: &[u8], path: &Path) -> Result<MeshFile> {
    check_size(bytes.len() as u64, MAX_OBJ_BYTES, path)?;
    let text = join_continued_lines(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes));
    let total = Counts::of(&text);
    if total.vertices == 0 {
        return Err(FileError::content(path, "no vertices (`v` lines); is this an OBJ file?"));
    }
    let plain = Plain::of(&text, total, path)?;
    let mesh = load_plain(&plain.text, path)?;
    check_finite(&mesh.positions, 3, b"v", &text, path)?;
    // The last texture coordinate is the one added for corners that name none.
    let uv_len = mesh.texcoords.len().saturating_sub(2);
    check_finite(&mesh.texcoords[..uv_len], 2, b"vt", &text, path)?;
    assemble(&mesh, total, &plain, path)
}

/// Numbers of elements seen.
#[derive(Clone, Copy, Default)]
struct Counts {
    vertices: usize,
    uv: usize,
    faces: usize,
}

impl Counts {
    fn of(text: &[u8]) -> Self {
        let mut counts = Self::default();
        for line in lines(text) {
            counts.add(keyword(line).0);
        }
        counts
    }

    fn add(&mut self, keyword: &[u8]) {
        match keyword {
            b"v" => self.vertices += 1,
            b"vt" => self.uv += 1,
            b"f" => self.faces += 1,
            _ => {}
        }
    }
}

fn lines(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    text.split(|&b| b == b'\n')
}

/// Words of a line up to a comment.
fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty()).take_while(|w| w[0] != b'#')
}

/// First word of a line and the rest.
fn keyword(line: &[u8]) -> (&[u8], &[u8]) {
    let line = line.trim_ascii_start();
    line.split_at(line.iter().position(u8::is_ascii_whitespace).unwrap_or(line.len()))
}

/// Joins lines that end in a backslash with the next; empty lines after them keep the count of lines.
fn join_continued_lines(bytes: &[u8]) -> Cow<'_, [u8]> {
    if !bytes.contains(&b'\\') {
        return Cow::Borrowed(bytes);
    }
    let mut joined = Vec::with_capacity(bytes.len() + 1);
    let mut owed_lines = 0;
    for line in lines(bytes) {
        let line = line.strip_suffix(b"\r").unwrap_or(line);
        if let Some(begun) = line.strip_suffix(b"\\") {
            joined.extend_from_slice(begun);
            joined.push(b' ');
            owed_lines += 1;
        } else {
            joined.extend_from_slice(line);
            joined.extend(std::iter::repeat_n(b'\n', owed_lines + 1));
            owed_lines = 0;
        }
    }
    Cow::Owned(joined)
}

/// The text as `tobj` gets it: a leading polygon, then line for line `v`, `vt` and checked absolute `f`, else empty.
struct Plain {
    text: Vec<u8>,
    material_library: Option<String>,
    incomplete_faces: usize,
    /// Number, counted from one, of the texture coordinate that stands for none.
    no_uv: usize,
}

impl Plain {
    fn of(source: &[u8], total: Counts, path: &Path) -> Result<Self> {
        let text = Vec::with_capacity(source.len() + source.len() / 8);
        let mut plain = Self { text, material_library: None, incomplete_faces: 0, no_uv: total.uv + 1 };
        plain.leading_polygon(total);
        let (mut seen, mut corners) = (Counts::default(), 0);
        for (i, line) in lines(source).enumerate() {
            let (keyword, rest) = keyword(line);
            seen.add(keyword);
            match keyword {
                b"v" => plain.vertex(rest),
                b"vt" => plain.text.extend_from_slice(line),
                b"f" => {
                    corners += plain.face(rest, seen, total).map_err(|reason| FileError::line(path, i + 1, reason))?
                }
                b"mtllib" => plain.material_library = Some(String::from_utf8_lossy(rest.trim_ascii()).into_owned()),
                _ => {}
            }
            if corners > MAX_CORNERS {
                let reason = format!("more than {MAX_CORNERS} face corners up to here; split or simplify the mesh");
                return Err(FileError::line(path, i + 1, reason));
            }
            plain.text.push(b'\n');
        }
        plain.text.extend_from_slice(b"vt 0 0\n");
        Ok(plain)
    }

    fn leading_polygon(&mut self, total: Counts) {
        self.text.push(b'f');
        for k in 1..=total.vertices.max(self.no_uv) {
            self.corner(k.min(total.vertices), k.min(self.no_uv));
        }
        self.text.push(b'\n');
    }

    fn corner(&mut self, vertex: usize, uv: usize) {
        self.text.push(b' ');
        push_integer(&mut self.text, vertex as u64);
        self.text.push(b'/');
        push_integer(&mut self.text, uv as u64);
    }

    /// Leaves out vertex colours, which `tobj` accepts only on all vertices; a lone fourth number is the weight.
    fn vertex(&mut self, rest: &[u8]) {
        self.text.push(b'v');
        let kept = if words(rest).count() == 4 { 4 } else { 3 };
        for word in words(rest).take(kept) {
            self.text.push(b' ');
            self.text.extend_from_slice(word);
        }
    }

    /// Writes a face with absolute indices; returns how many corners it has.
    fn face(&mut self, rest: &[u8], seen: Counts, total: Counts) -> std::result::Result<usize, String> {
        let start = self.text.len();
        let mut corners = 0;
        self.text.push(b'f');
        for word in words(rest) {
            let mut parts = word.split(|&b| b == b'/');
            let vertex = index(parts.next().unwrap_or_default(), "vertex", seen.vertices, total.vertices)?;
            let uv = match parts.next().unwrap_or_default() {
                b"" => self.no_uv,
                number => index(number, "texture coordinate", seen.uv, total.uv)?,
            };
            self.corner(vertex, uv);
            corners += 1;
        }
        if corners < 3 {
            self.text.truncate(start);
            self.incomplete_faces += 1;
        }
        Ok(corners)
    }
}

/// The absolute index, counted from one, of an index that may be relative (-1 is the last element seen).
fn index(digits: &[u8], what: &str, seen: usize, total: usize) -> std::result::Result<usize, String> {
    let number = std::str::from_utf8(digits).ok().and_then(|s| s.parse::<i64>().ok());
    match number {
        None => {
            let shown = String::from_utf8_lossy(&digits[..digits.len().min(40)]);
            Err(format!("`{shown}` is not a {what} number; a face is `f v/vt v/vt v/vt`"))
        }
        Some(0) => Err(format!("a face names {what} 0; OBJ counts from 1")),
        Some(n) if n > 0 && n as u64 <= total as u64 => Ok(n as usize),
        Some(n) if n < 0 && n.unsigned_abs() <= seen as u64 => Ok(seen - n.unsigned_abs() as usize + 1),
        Some(n) if n > 0 => Err(format!("a face names {what} {n}, but the file has {total}; is it cut short?")),
        Some(n) => Err(format!("a face names {what} {n}, but only {seen} stand before it")),
    }
}

fn load_plain(text: &[u8], path: &Path) -> Result<tobj::Mesh> {
    let mut reader = text;
    // No `mtllib` line is passed on, so the loader of materials is never asked.
    let loaded = tobj::load_obj_buf(&mut reader, &tobj::LoadOptions::default(), |_| Err(LoadError::OpenFileFailed));
    let mut models = match loaded {
        Ok((models, _)) => models,
        Err(error) => {
            // `tobj` stops behind the line at fault; the leading polygon is one line more than the file has.
            let line = lines(&text[..text.len() - reader.len()]).count().saturating_sub(2);
            return Err(FileError::line(path, line, reason_of(error)));
        }
    };
    Ok(models.pop().map(|model| model.mesh).unwrap_or_default())
}

fn reason_of(error: LoadError) -> String {
    match error {
        LoadError::PositionParseError => "a vertex needs three numbers, `v x y z`".into(),
        LoadError::ScalingByZeroError => "the fourth number of a vertex, its weight, is zero".into(),
        LoadError::TexcoordParseError => "a texture coordinate needs two numbers, `vt u v`".into(),
        LoadError::ReadError => "not text; is this an OBJ file?".into(),
        other => format!("{other}; is this an OBJ file?"),
    }
}

/// Refuses NaN and infinity, naming the element and its line.
fn check_finite(numbers: &[f32], size: usize, word: &[u8], text: &[u8], path: &Path) -> Result<()> {
    let Some(element) = numbers.iter().position(|x| !x.is_finite()).map(|i| i / size) else { return Ok(()) };
    let line = lines(text).enumerate().filter(|(_, line)| keyword(line).0 == word).nth(element).map_or(0, |l| l.0 + 1);
    let what = if size == 3 { "vertex" } else { "texture coordinate" };
    Err(FileError::line(path, line, format!("{what} {} is not finite; remove it and its faces", element + 1)))
}

fn assemble(mesh: &tobj::Mesh, total: Counts, plain: &Plain, path: &Path) -> Result<MeshFile> {
    let positions_mm = mesh.positions.chunks_exact(3).map(Vec3::from_slice).collect();
    let repairs = Repairs { incomplete_faces: plain.incomplete_faces, ..Repairs::default() };
    let mut assembler = Assembler::new(positions_mm, total.faces, repairs);
    let leading = total.vertices.max(plain.no_uv);
    let (corners, uv_corners) = (&mesh.indices[leading..], &mesh.texcoord_indices[leading..]);
    let uv_of = |i: usize| [mesh.texcoords[2 * i], mesh.texcoords[2 * i + 1]];
    let mut start = 0;
    // `tobj` gives no arities when all faces are triangles, the leading polygon among them.
    for arity in mesh.face_arities.iter().skip(1).copied().chain(std::iter::repeat(3)) {
        let end = start + arity as usize;
        let Some(polygon) = corners.get(start..end).filter(|p| !p.is_empty()) else { break };
        assembler.polygon(polygon);
        for (&vertex, &uv) in polygon.iter().zip(&uv_corners[start..end]) {
            if (uv as usize) + 1 != plain.no_uv {
                assembler.corner_uv(vertex, uv_of(uv as usize));
            }
        }
        start = end;
    }
    if total.uv == total.vertices {
        assembler.unused_uv(uv_of);
    }
    assembler.finish(plain.material_library.clone(), path)
}

/// Material library beside an OBJ file and the picture it names.
#[derive(Debug, Clone, Copy)]
pub struct Material<'a> {
    /// File name of the library, as `frame_0001.mtl`.
    pub library: &'a str,
    /// File name of the picture, as `frame_0001.bmp`.
    pub picture: &'a str,
}

impl Material<'_> {
    /// Text of the library: one white material that shows the picture.
    pub fn library_text(&self) -> String {
        format!("newmtl scan\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {}\n", self.picture)
    }
}

/// OBJ text of a mesh: positions with 4 decimals, texture coordinates (if any) with 6.
pub fn obj_bytes(mesh: &TriMesh, material: Option<Material<'_>>) -> Vec<u8> {
    let mut text = Vec::with_capacity(mesh.vertex_count() * 52 + mesh.triangles.len() * 44 + 80);
    if let Some(material) = material {
        text.extend_from_slice(format!("mtllib {}\nusemtl scan\n", material.library).as_bytes());
    }
    for p in &mesh.positions_mm {
        text.push(b'v');
        push_numbers::<4>(&mut text, &p.to_array());
    }
    for uv in mesh.uv.iter().flatten() {
        text.extend_from_slice(b"vt");
        push_numbers::<6>(&mut text, uv);
    }
    for triangle in &mesh.triangles {
        text.push(b'f');
        for &v in triangle {
            text.push(b' ');
            push_integer(&mut text, u64::from(v) + 1);
            if mesh.uv.is_some() {
                text.push(b'/');
                push_integer(&mut text, u64::from(v) + 1);
            }
        }
        text.push(b'\n');
    }
    text
}

/// Length of [`obj_bytes`], counted many times faster than it is written.
pub fn obj_byte_count(mesh: &TriMesh, material: Option<Material<'_>>) -> u64 {
    let head = material.map_or(0, |m| ("mtllib \nusemtl scan\n".len() + m.library.len()) as u64);
    let text = |numbers: &[f32], count: fn(f32) -> u64| numbers.iter().map(|&x| 1 + count(x)).sum::<u64>();
    let positions: u64 = mesh.positions_mm.iter().map(|p| 2 + text(&p.to_array(), fixed_byte_count::<4>)).sum();
    let uv: u64 = mesh.uv.iter().flatten().map(|uv| 3 + text(uv, fixed_byte_count::<6>)).sum();
    let indices = if mesh.uv.is_some() { 2 } else { 1 };
    let corner = |&v: &u32| indices * (1 + integer_byte_count(f64::from(v) + 1.0));
    let faces: u64 = mesh.triangles.iter().map(|t| 2 + t.iter().map(corner).sum::<u64>()).sum();
    head + positions + uv + faces
}

/// Digits of the whole part.
fn integer_byte_count(magnitude: f64) -> u64 {
    const LIMITS: [f64; 9] = [1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9];
    1 + LIMITS.iter().take_while(|limit| magnitude >= **limit).count() as u64
}

/// What [`push_fixed`] appends.
fn fixed_byte_count<const DECIMALS: usize>(x: f32) -> u64 {
    let half = 0.5 / 10_u64.pow(DECIMALS as u32) as f64;
    let magnitude = f64::from(x).abs();
    if magnitude < 1e6 {
        // No float is halfway between two texts of so many decimals, but zero's neighbours are rounded to it.
        let sign = u64::from(f64::from(x) < -half);
        return sign + integer_byte_count(magnitude + half) + 1 + DECIMALS as u64;
    }
    let mut text = Vec::new();
    push_fixed::<DECIMALS>(&mut text, x);
    text.len() as u64
}

fn push_numbers<const DECIMALS: usize>(text: &mut Vec<u8>, numbers: &[f32]) {
    for &x in numbers {
        text.push(b' ');
        push_fixed::<DECIMALS>(text, x);
    }
    text.push(b'\n');
}

/// Appends `x` rounded to `DECIMALS` decimals, as `{:.DECIMALS$}` but several times faster and without negative zero.
fn push_fixed<const DECIMALS: usize>(text: &mut Vec<u8>, x: f32) {
    let unit = 10_u64.pow(DECIMALS as u32);
    // 24 bits of a float times up to 20 of the unit are exact in 53, so the only rounding is the wanted one.
    let scaled = (f64::from(x) * unit as f64).round_ties_even();
    if scaled.abs() >= 9e15 || scaled.is_nan() {
        // Writing to a Vec cannot fail.
        let _ = write!(text, "{x}");
        return;
    }
    if scaled < 0.0 {
        text.push(b'-');
    }
    let magnitude = scaled.abs() as u64;
    push_integer(text, magnitude / unit);
    text.push(b'.');
    let fraction = magnitude % unit;
    text.extend((0..DECIMALS as u32).rev().map(|k| b'0' + (fraction / 10_u64.pow(k) % 10) as u8));
}

fn push_integer(text: &mut Vec<u8>, mut n: u64) {
    let mut digits = [0; 20];
    let mut at = digits.len();
    loop {
        at -= 1;
        digits[at] = b'0' + (n % 10) as u8;
        n /= 10;
        if n == 0 {
            break;
        }
    }
    text.extend_from_slice(&digits[at..]);
}

#[cfg(test)]
#[path = "obj_tests.rs"]
mod tests;
