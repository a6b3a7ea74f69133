//! The container of binary glTF: JSON and the arrays that it points into (glTF 2.0, sections 3.6 and 4.4).

use bytemuck::{NoUninit, cast_slice};
use serde_json::{Value, json};

const MAGIC: u32 = u32::from_le_bytes(*b"glTF");
const VERSION: u32 = 2;
const JSON_CHUNK: u32 = u32::from_le_bytes(*b"JSON");
const BINARY_CHUNK: u32 = u32::from_le_bytes(*b"BIN\0");

/// What the numbers of an array are: their types, and what they are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Three u16 for 0 to 1, and padding.
    Positions,
    /// Three i16 for -1 to 1, and padding.
    Moves,
    /// Three i8 for -1 to 1, and padding.
    Normals,
    /// Two f32.
    TexturePlaces,
    /// u32.
    Corners,
    /// f32.
    Times,
    /// f32.
    Weights,
}

impl Kind {
    fn component_type(self) -> u32 {
        match self {
            Self::Normals => 5120,
            Self::Moves => 5122,
            Self::Positions => 5123,
            Self::Corners => 5125,
            Self::TexturePlaces | Self::Times | Self::Weights => 5126,
        }
    }

    /// Numbers of an element, padding left out.
    fn components(self) -> usize {
        match self {
            Self::Positions | Self::Moves | Self::Normals => 3,
            Self::TexturePlaces => 2,
            Self::Corners | Self::Times | Self::Weights => 1,
        }
    }

    fn shape(self) -> &'static str {
        ["SCALAR", "VEC2", "VEC3"][self.components() - 1]
    }

    /// Where the card is to keep it: by vertex, by corner, or not at all.
    fn target(self) -> Option<u32> {
        match self {
            Self::Positions | Self::Moves | Self::Normals | Self::TexturePlaces => Some(34_962),
            Self::Corners => Some(34_963),
            Self::Times | Self::Weights => None,
        }
    }

    /// Whether the format asks for the smallest and largest numbers.
    fn has_bounds(self) -> bool {
        matches!(self, Self::Positions | Self::Moves | Self::Times)
    }

    fn is_normalized(self) -> bool {
        matches!(self, Self::Positions | Self::Moves | Self::Normals)
    }
}

/// A GLB file being put together.
#[derive(Debug)]
pub struct Glb {
    /// The JSON, but for what follows from the arrays.
    pub root: Value,
    binary: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Default for Glb {
    /// One scene with node 0, which has yet to be described.
    fn default() -> Self {
        let root = json!({
            "asset": { "version": "2.0", "generator": concat!("gv3 ", env!("CARGO_PKG_VERSION")) },
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
        });
        Self { root, binary: Vec::new(), views: Vec::new(), accessors: Vec::new() }
    }
}

impl Glb {
    /// Makes room for so many bytes more.
    pub fn reserve(&mut self, bytes: usize) {
        self.binary.reserve(bytes);
    }

    /// Adds bytes as they are; returns the number of their view.
    pub fn view(&mut self, bytes: &[u8]) -> usize {
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        self.views.push(json!({ "buffer": 0, "byteOffset": self.binary.len(), "byteLength": bytes.len() }));
        self.binary.extend_from_slice(bytes);
        self.views.len() - 1
    }

    /// Adds an array of at least one element; returns the number of its accessor.
    pub fn array<T: NoUninit + Into<f64>, const N: usize>(&mut self, elements: &[[T; N]], kind: Kind) -> usize {
        let number = self.view(cast_slice(elements.as_flattened()));
        let view = &mut self.views[number];
        if let Some(target) = kind.target() {
            view["target"] = target.into();
        }
        let mut accessor = json!({
            "bufferView": number, "componentType": kind.component_type(), "count": elements.len(), "type": kind.shape(),
        });
        if kind.is_normalized() {
            // Padded to steps of four bytes, which the file says.
            view["byteStride"] = size_of::<[T; N]>().into();
            accessor["normalized"] = true.into();
        }
        if kind.has_bounds() {
            let (low, high) = bounds(elements);
            accessor["min"] = json!(low[..kind.components()]);
            accessor["max"] = json!(high[..kind.components()]);
        }
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    /// The file; `None` when it would be larger than the format's 4 GiB.
    pub fn bytes(mut self) -> Option<Vec<u8>> {
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        if !self.binary.is_empty() {
            self.root["buffers"] = json!([{ "byteLength": self.binary.len() }]);
            self.root["bufferViews"] = self.views.into();
            self.root["accessors"] = self.accessors.into();
        }
        let mut text = self.root.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let chunk = |bytes: &[u8]| if bytes.is_empty() { 0 } else { 8 + bytes.len() };
        let total = u32::try_from(12 + chunk(&text) + chunk(&self.binary)).ok()?;
        let mut out = Vec::with_capacity(total as usize);
        out.extend([MAGIC, VERSION, total].map(u32::to_le_bytes).concat());
        for (kind, bytes) in [(JSON_CHUNK, text), (BINARY_CHUNK, self.binary)] {
            if !bytes.is_empty() {
                out.extend([bytes.len() as u32, kind].map(u32::to_le_bytes).concat());
                out.extend(bytes);
            }
        }
        Some(out)
    }
}

/// Smallest and largest of each number of the elements.
fn bounds<T: NoUninit + Into<f64>, const N: usize>(elements: &[[T; N]]) -> ([f64; N], [f64; N]) {
    let start = ([f64::INFINITY; N], [f64::NEG_INFINITY; N]);
    elements.iter().fold(start, |(mut low, mut high), element| {
        for (k, number) in element.map(Into::into).into_iter().enumerate() {
            (low[k], high[k]) = (low[k].min(number), high[k].max(number));
        }
        (low, high)
    })
}
