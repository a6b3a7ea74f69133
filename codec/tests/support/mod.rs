//! Reads arrays of a NumPy archive (.npz: a zip of .npy files), enough for the shared face model.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use flate2::read::DeflateDecoder;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

/// One array, row-major, as numbers.
pub struct Array {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
    /// Elements of text arrays.
    pub names: Vec<String>,
}

/// Arrays by name, without `.npy`.
pub fn read_npz(path: &Path) -> BTreeMap<String, Array> {
    let bytes = std::fs::read(path).unwrap();
    let u16_at = |i: usize| usize::from(u16::from_le_bytes([bytes[i], bytes[i + 1]]));
    let u32_at = |i: usize| u32::from_le_bytes(bytes[i..i + 4].try_into().unwrap()) as usize;
    let end = (0..bytes.len() - 3).rev().find(|&i| bytes[i..].starts_with(b"PK\x05\x06")).unwrap();
    let (count, mut at) = (u16_at(end + 10), u32_at(end + 16));
    let mut arrays = BTreeMap::new();
    for _ in 0..count {
        let (method, packed, local) = (u16_at(at + 10), u32_at(at + 20), u32_at(at + 42));
        let name = String::from_utf8(bytes[at + 46..at + 46 + u16_at(at + 28)].to_vec()).unwrap();
        let data = local + 30 + u16_at(local + 26) + u16_at(local + 28);
        let packed = &bytes[data..data + packed];
        let mut npy = Vec::new();
        match method {
            0 => npy.extend_from_slice(packed),
            _ => drop(DeflateDecoder::new(packed).read_to_end(&mut npy).unwrap()),
        }
        arrays.insert(name.trim_end_matches(".npy").to_owned(), read_npy(&npy));
        at += 46 + u16_at(at + 28) + u16_at(at + 30) + u16_at(at + 32);
    }
    arrays
}

fn read_npy(npy: &[u8]) -> Array {
    let length = usize::from(u16::from_le_bytes([npy[8], npy[9]]));
    let header = std::str::from_utf8(&npy[10..10 + length]).unwrap();
    let between = |from: &str, to: &str| header.split(from).nth(1).unwrap().split(to).next().unwrap();
    let kind = between("'descr': '<", "'");
    let shape: Vec<usize> = between("'shape': (", ")").split(',').filter_map(|n| n.trim().parse().ok()).collect();
    let data = &npy[10 + length..];
    let mut array = Array { shape, values: Vec::new(), names: Vec::new() };
    let number = |b: &[u8]| match kind {
        "f8" => f64::from_le_bytes(b.try_into().unwrap()),
        "f4" => f64::from(f32::from_le_bytes(b.try_into().unwrap())),
        "i4" => f64::from(i32::from_le_bytes(b.try_into().unwrap())),
        "i2" => f64::from(i16::from_le_bytes(b.try_into().unwrap())),
        "u2" => f64::from(u16::from_le_bytes(b.try_into().unwrap())),
        other => panic!("numbers of kind {other}"),
    };
    if let Some(length) = kind.strip_prefix('U') {
        let letter = |b: &[u8]| char::from_u32(u32::from_le_bytes(b.try_into().unwrap())).filter(|c| *c != '\0');
        let texts = data.chunks_exact(4 * length.parse::<usize>().unwrap());
        array.names = texts.map(|text| text.chunks_exact(4).filter_map(letter).collect()).collect();
    } else {
        let size = kind[1..].parse().unwrap();
        array.values = data.chunks_exact(size).map(number).collect();
    }
    array
}
