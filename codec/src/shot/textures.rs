//! Texture payload of a group: the picture of its keyframe, and what the scans between lack when they are blended.

use super::carry;
use super::model::Model;
use super::seen_scan::SeenScan;
use crate::bits::bytes::{ByteReader, put_varint};
use crate::texture::coded::{Models, Offsets, Options, Planes, Shifts, Source, decode, encode, expected};
use crate::{GreyPicture, Result};
use std::sync::Arc;

/// Longest coded picture.
const MAX_PICTURE: u64 = 1 << 24;
/// Weights of the sources of a picture add up to this.
const WHOLE: u64 = 256;

/// Steps of coded pictures, 1/16 grey level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TextureSteps {
    /// Of a picture that stands alone.
    pub alone: u16,
    /// Of a keyframe that is predicted.
    pub key: u16,
    /// Of a scan between keyframes.
    pub between: u16,
}

impl Default for TextureSteps {
    fn default() -> Self {
        Self { alone: 160, key: 160, between: 720 }
    }
}

/// What later pictures are decoded from: the last key texture and what the coder has learned.
#[derive(Debug, Clone)]
pub struct TextureChain {
    /// The picture, outside its mask continued.
    pub planes: Arc<Planes>,
    /// How far the model had slid along the surface since the keyframe before, as its picture shows.
    shifts: Shifts,
    models: Models,
}

/// A keyframe as its picture is predicted: the scan and its texture.
#[derive(Debug, Clone, Copy)]
pub struct Textured<'a> {
    /// The scan, against the model at hand.
    pub scan: &'a SeenScan,
    /// Its texture.
    pub chain: &'a TextureChain,
    /// Its tick.
    pub tick: u64,
}

/// Codes the picture of a keyframe; `before` is the keyframe before, if decoding need not start here.
pub fn encode_key(
    picture: &GreyPicture,
    scan: &SeenScan,
    model: &Model,
    before: Option<Textured<'_>>,
    steps: TextureSteps,
) -> (Vec<u8>, TextureChain) {
    let offsets = before.map(|b| offsets(scan, model, &[b.scan]));
    let sources = sources(before.as_slice(), offsets.as_deref().unwrap_or(&[]), &[WHOLE as u16]);
    let mut models = before.map(|b| b.chain.models.clone()).unwrap_or_default();
    let step = if before.is_some() { steps.key } else { steps.alone };
    let planes = Planes::from_grey(picture);
    let (bytes, decoded) = encode(&planes, &scan.mask, &sources, &mut models, &Options::with_step(step));
    (bytes, TextureChain { planes: Arc::new(decoded.planes), shifts: decoded.shifts, models })
}

/// Reads the picture of a keyframe.
///
/// # Errors
/// [`crate::CodecError::Payload`] for bytes that do not fit.
pub fn decode_key(bytes: &[u8], scan: &SeenScan, model: &Model, before: Option<Textured<'_>>) -> Result<TextureChain> {
    let offsets = before.map(|b| offsets(scan, model, &[b.scan]));
    let sources = sources(before.as_slice(), offsets.as_deref().unwrap_or(&[]), &[WHOLE as u16]);
    let mut models = before.map(|b| b.chain.models.clone()).unwrap_or_default();
    let size = [scan.placed.window.width, scan.placed.window.height];
    let decoded = decode(bytes, (1, size), &scan.mask, &sources, &mut models)?;
    Ok(TextureChain { planes: Arc::new(decoded.planes), shifts: decoded.shifts, models })
}

/// Codes the picture of a scan between `keys`, the keyframes before and, where it shares the model, after.
pub fn encode_between(
    picture: &GreyPicture,
    (tick, scan): (u64, &SeenScan),
    model: &Model,
    keys: &[Textured<'_>],
    steps: TextureSteps,
) -> Vec<u8> {
    let weights = weights(tick, keys);
    let offsets = offsets_between(scan, model, keys, &weights);
    let sources = sources(keys, &offsets, &weights);
    let mut models = keys.last().map(|k| k.chain.models.clone()).unwrap_or_default();
    let options = Options { refine: false, ..Options::with_step(steps.between) };
    encode(&Planes::from_grey(picture), &scan.mask, &sources, &mut models, &options).0
}

/// Reads the picture of a scan between keyframes: what its keyframes let expect where there are no bytes.
///
/// # Errors
/// [`crate::CodecError::Payload`] for bytes that do not fit.
pub fn decode_between(
    bytes: &[u8],
    (tick, scan): (u64, &SeenScan),
    model: &Model,
    keys: &[Textured<'_>],
) -> Result<GreyPicture> {
    let weights = weights(tick, keys);
    let offsets = offsets_between(scan, model, keys, &weights);
    let sources = sources(keys, &offsets, &weights);
    let mut models = keys.last().map(|k| k.chain.models.clone()).unwrap_or_default();
    let size = [scan.placed.window.width, scan.placed.window.height];
    if bytes.is_empty() {
        return Ok(expected((1, size), &scan.mask, &sources).to_grey());
    }
    Ok(decode(bytes, (1, size), &scan.mask, &sources, &mut models)?.planes.to_grey())
}

fn offsets(scan: &SeenScan, model: &Model, references: &[&SeenScan]) -> Vec<Offsets> {
    let seen: Vec<_> = references.iter().map(|r| &r.drawn.seen[..]).collect();
    carry::offsets(&scan.drawn.picture, &scan.drawn.seen, &model.connectivity, &seen)
}

/// Offsets to the pictures of `keys`, the slide of the model from the one to the other taken as even in time.
fn offsets_between(scan: &SeenScan, model: &Model, keys: &[Textured<'_>], weights: &[u16]) -> Vec<Offsets> {
    let references: Vec<&SeenScan> = keys.iter().map(|k| k.scan).collect();
    let mut offsets = offsets(scan, model, &references);
    if let ([before, after], [_, end]) = (&mut offsets[..], keys) {
        let at = after.clone();
        end.chain.shifts.correct(&at, i32::from(weights[1]), before);
        end.chain.shifts.correct(&at, -i32::from(weights[0]), after);
    }
    offsets
}

/// Nearer keyframes weigh more, linearly in ticks.
fn weights(tick: u64, keys: &[Textured<'_>]) -> Vec<u16> {
    match keys {
        [before, after] => {
            let length = (after.tick - before.tick).max(1);
            let later = ((WHOLE * (tick - before.tick) + length / 2) / length) as u16;
            vec![WHOLE as u16 - later, later]
        }
        _ => vec![WHOLE as u16; keys.len()],
    }
}

fn sources<'a>(keys: &[Textured<'a>], offsets: &'a [Offsets], weights: &[u16]) -> Vec<Source<'a>> {
    let source = |((key, offsets), weight): ((&Textured<'a>, &'a Offsets), &u16)| Source {
        planes: &key.chain.planes,
        offsets,
        weight: *weight,
    };
    keys.iter().zip(offsets).zip(weights).map(source).collect()
}

/// The payload: the keyframe's picture, then those between in time order, empty for what keyframes let expect.
pub fn write(key: &[u8], between: &[Vec<u8>]) -> Vec<u8> {
    let mut out = Vec::new();
    for part in std::iter::once(key).chain(between.iter().map(|b| &b[..])) {
        put_varint(&mut out, part.len() as u64);
        out.extend_from_slice(part);
    }
    out
}

/// Coded pictures of a group.
#[derive(Debug, Clone)]
pub struct Pictures<'a> {
    /// Of the keyframe.
    pub key: &'a [u8],
    /// Of the scans between, in time order; empty for what keyframes let expect.
    pub between: Vec<&'a [u8]>,
}

impl<'a> Pictures<'a> {
    /// Takes the payload of a group with `between` scans between keyframes apart.
    ///
    /// # Errors
    /// [`crate::CodecError::Payload`] at the first byte that does not follow FORMAT.md, "Textures of a group".
    pub fn read(bytes: &'a [u8], between: usize) -> Result<Self> {
        let mut reader = ByteReader::new(bytes, "textures");
        let mut next = || {
            let length = reader.varint_up_to(MAX_PICTURE, "length of a picture")? as usize;
            reader.take(length)
        };
        let key = next()?;
        let between = (0..between).map(|_| next()).collect::<Result<_>>()?;
        reader.finish()?;
        Ok(Self { key, between })
    }
}
