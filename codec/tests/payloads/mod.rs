//! A second writer of payloads, straight from FORMAT.md: every field can be given a value that the codec's own writer
//! would refuse. Payloads are lists of labelled bytes, which become the comments of the vector files.

pub mod shots;

use gv3_codec::bits::attributes;
use gv3_codec::bits::bytes::{put_varint, zigzag64};
use gv3_codec::bits::connectivity;
use jpeg_encoder::{ColorType, Encoder};

/// A payload as labelled pieces.
pub type Payload = Vec<(&'static str, Vec<u8>)>;

/// All bytes of a payload.
pub fn bytes_of(payload: &Payload) -> Vec<u8> {
    payload.iter().flat_map(|(_, bytes)| bytes.iter().copied()).collect()
}

/// LEB128.
pub fn varint(v: u64) -> Vec<u8> {
    let mut out = Vec::new();
    put_varint(&mut out, v);
    out
}

/// Fields of a stream header.
#[derive(Clone)]
pub struct Header {
    pub version: u16,
    pub mode: u8,
    pub interval: u8,
    pub period: Vec<u8>,
    pub step_mm: f32,
}

impl Default for Header {
    fn default() -> Self {
        Self { version: 1, mode: 0, interval: 10, period: varint(33_333_333), step_mm: 0.0625 }
    }
}

impl Header {
    pub fn payload(&self) -> Payload {
        vec![
            ("version", self.version.to_le_bytes().into()),
            ("mode", vec![self.mode]),
            ("keyframe interval", vec![self.interval]),
            ("scan period, ns", self.period.clone()),
            ("position step, mm", self.step_mm.to_le_bytes().into()),
        ]
    }
}

/// A stream header of shots with its eight steps.
pub fn shots_header(steps: [u64; 8]) -> Payload {
    let mut payload = Header { version: 2, mode: 1, ..Header::default() }.payload();
    payload.pop();
    payload.push(("steps", steps.iter().flat_map(|s| varint(*s)).collect()));
    payload
}

/// Texture coordinates of a group.
#[derive(Clone)]
pub enum Uv {
    None,
    Camera([f32; 12]),
    Coded(Vec<[i32; 2]>),
    Kind(u8),
}

/// A section before it is packed, or as raw bytes.
#[derive(Clone)]
pub enum Section {
    Of(Vec<u8>),
    Raw(Vec<u8>),
}

impl Section {
    fn bytes(&self) -> Vec<u8> {
        match self {
            Section::Raw(bytes) => bytes.clone(),
            Section::Of(bytes) => {
                let mut out = Vec::new();
                attributes::put_section(&mut out, bytes).unwrap();
                out
            }
        }
    }
}

/// Fields of a group: a hexagon round one vertex, its letters C S L E R E.
#[derive(Clone)]
pub struct Group {
    pub scan_count: u64,
    /// Tick step and time offset of each scan.
    pub scans: Vec<(u64, i64)>,
    pub before: u64,
    pub counts: [u64; 3],
    pub letters: Section,
    pub positions: Section,
    pub uv: Uv,
    pub size_px: [u16; 2],
    /// Replaces the packed texture coordinates.
    pub uv_section: Option<Section>,
    pub landmarks: Section,
}

pub const LETTERS: [u8; 6] = [0, 4, 1, 2, 3, 2];

pub const POSITIONS: [[i32; 3]; 7] =
    [[160, 0, 0], [80, 139, 8], [-80, 139, 0], [-160, 0, 8], [-80, -139, 0], [80, -139, 8], [10, 5, 40]];

pub const UV: [[i32; 2]; 7] =
    [[6400, 3840], [5760, 2730], [4480, 2730], [3840, 3840], [4480, 4950], [5760, 4950], [5200, 3801]];

/// One pair: triangle 300 with weights 255, 0 before; triangle 5 with weights 51, 102 here.
pub const LANDMARKS: [u8; 8] = [1, 0xac, 0x02, 255, 0, 5, 51, 102];

/// Byte planes of the example's connectivity.
pub fn planes<const N: usize>(values: &[[i32; N]]) -> Vec<u8> {
    let decoded = connectivity::decode(&LETTERS, 6, 7).unwrap();
    attributes::encode(values, &decoded.parents)
}

impl Default for Group {
    fn default() -> Self {
        Self {
            scan_count: 2,
            scans: vec![(3, 124), (7, -7)],
            before: 3,
            counts: [7, 6, 6],
            letters: Section::Of(LETTERS.into()),
            positions: Section::Of(planes(&POSITIONS)),
            uv: Uv::Coded(UV.into()),
            size_px: [640, 480],
            uv_section: None,
            landmarks: Section::Of(LANDMARKS.into()),
        }
    }
}

impl Group {
    pub fn payload(&self) -> Payload {
        let mut out = vec![("scan count", varint(self.scan_count))];
        for &(step, offset) in &self.scans {
            out.push(("scan: tick step, time offset", [varint(step), varint(zigzag64(offset))].concat()));
        }
        out.push(("tick of the keyframe before, plus one", varint(self.before)));
        out.push(("vertices", varint(self.counts[0])));
        out.push(("border vertices", varint(self.counts[1])));
        out.push(("triangles", varint(self.counts[2])));
        out.push(("section: letters", self.letters.bytes()));
        out.push(("section: positions", self.positions.bytes()));
        let kind = match self.uv {
            Uv::None => 0,
            Uv::Camera(_) => 1,
            Uv::Coded(_) => 2,
            Uv::Kind(kind) => kind,
        };
        out.push(("texture coordinates: kind", vec![kind]));
        if kind > 0 {
            out.push(("texture width, height", self.size_px.iter().flat_map(|s| s.to_le_bytes()).collect()));
        }
        match &self.uv {
            Uv::Camera(matrix) => out.push(("camera", matrix.iter().flat_map(|m| m.to_le_bytes()).collect())),
            Uv::Coded(uv) => {
                let section = self.uv_section.clone().unwrap_or_else(|| Section::Of(planes(uv)));
                out.push(("section: texture coordinates", section.bytes()));
            }
            _ => {}
        }
        out.push(("section: landmarks", self.landmarks.bytes()));
        out
    }
}

/// A texture of `head` = width, height, crop x, crop y around a JPEG.
pub fn texture(head: [u16; 4], jpeg: Vec<u8>) -> Payload {
    vec![
        ("width, height", head[..2].iter().flat_map(|v| v.to_le_bytes()).collect()),
        ("crop origin x, y", head[2..].iter().flat_map(|v| v.to_le_bytes()).collect()),
        ("JPEG", jpeg),
    ]
}

/// A ramp as a JPEG of some size.
pub fn jpeg(width: u16, height: u16, color: ColorType, progressive: bool) -> Vec<u8> {
    let channels = if color == ColorType::Luma { 1 } else { 3 };
    let pixels: Vec<u8> =
        (0..usize::from(width) * usize::from(height) * channels).map(|i| (40 + i / channels * 3 % 180) as u8).collect();
    let mut out = Vec::new();
    let mut encoder = Encoder::new(&mut out, 60);
    encoder.set_optimized_huffman_tables(true);
    encoder.set_progressive(progressive);
    encoder.encode(&pixels, width, height, color).unwrap();
    out
}
