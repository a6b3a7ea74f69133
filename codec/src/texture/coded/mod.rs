//! Textures in closed loop: what decoded pictures let expect along the motion, corrected in blocks.
//!
//! A picture is predicted from none, one or two decoded pictures through offsets of blocks ([`Source`]), those of a single
//! one refined by a coarse grid of shifts, and corrected by cosine transforms of 8x8, 16x16 and 32x32 px with adaptive
//! contexts. Only pixels of a mask count. Everything that a decoder computes is an integer.

mod blocks;
mod canvas;
mod carried;
mod choice;
mod levels;
mod mixing;
mod offsets;
mod planes;
mod shift_search;
mod shifts;
mod transform;

pub use carried::Source;
pub use offsets::{BLOCK, NOWHERE, Offsets};
pub use planes::{LEVEL_BITS, Planes, continue_unknown};
pub use shifts::Shifts;

use crate::Result;
use crate::bits::bytes::ByteReader;
use crate::bits::range_coder::{RangeDecoder, RangeEncoder};
use blocks::BlockModels;
use canvas::{Canvas, squares};
use mixing::Coder;
use shifts::ShiftModels;

/// Name of the section in errors.
const SECTION: &str = "coded texture";
/// Bytes of a step.
const STEP_BYTES: usize = 2;
/// Largest step, 1/16 grey level.
pub const MAX_STEP: u16 = 1 << 12;
/// Ends the range-coded bits, so that missing bytes are noticed.
const END: u32 = 0xa5;

/// What both sides have learned of the pictures coded so far; one for keyframes and one for the scans between, both new
/// where decoding may start.
#[derive(Debug, Clone, Default)]
pub struct Models {
    first: BlockModels,
    others: BlockModels,
    shifts: ShiftModels,
}

/// How a picture is coded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Step of the coefficients of the first plane, 1/16 grey level: 1 to [`MAX_STEP`].
    pub step: u16,
    /// The same of the other planes.
    pub chroma_step: u16,
    /// Squared error that a bit is worth, in squared steps.
    pub lambda: f32,
    /// Look for shifts of a single source.
    pub refine: bool,
}

impl Options {
    /// Usual weights for a step.
    pub fn with_step(step: u16) -> Self {
        Self { step, chroma_step: (step + step / 2).min(MAX_STEP), lambda: 0.16, refine: true }
    }
}

/// A picture as every decoder has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Decoded {
    /// The picture, outside the mask continued.
    pub planes: Planes,
    /// How the map of a single source was off; none with another number of sources.
    pub shifts: Shifts,
}

/// Codes the pixels of `wanted` where `mask` (row-major, one a pixel) holds. `sources` are none, one or two decoded pictures;
/// `models` go on with what is learned. Returns the bytes and what [`decode`] makes of them.
///
/// # Panics
/// When mask, sources and picture do not fit each other, the picture is empty, or a step is out of range.
pub fn encode(
    wanted: &Planes,
    mask: &[bool],
    sources: &[Source<'_>],
    models: &mut Models,
    options: &Options,
) -> (Vec<u8>, Decoded) {
    let (width, height) = (wanted.width, wanted.height);
    assert!(mask.len() == width * height && width > 0 && height > 0, "one flag a pixel");
    let steps = steps_of(wanted.levels.len(), options);
    assert!(steps.iter().all(|s| (1..=MAX_STEP).contains(s)), "steps are 1 to {MAX_STEP}");
    let mut shifts = match sources {
        [source] if options.refine => shift_search::search(wanted, mask, source),
        _ => Shifts::none(width, height),
    };
    let mut bytes: Vec<u8> = steps.iter().flat_map(|s| s.to_le_bytes()).collect();
    let mut out = RangeEncoder::default();
    if sources.len() == 1 {
        let coded = models.shifts.code(&mut out, &mut shifts);
        debug_assert!(coded.is_some());
    }
    let expected = carried::expect(sources, &shifts, wanted.shape(), mask);
    let mut levels = Vec::with_capacity(steps.len());
    for (p, step) in steps.iter().enumerate() {
        let mut canvas = Canvas::new(width, mask, expected.as_ref().map(|e| &e.levels[p][..]), i32::from(*step));
        let models = if p == 0 { &mut models.first } else { &mut models.others };
        let lambda = options.lambda * f32::from(*step).powi(2);
        for square in squares(width, height) {
            let (block, _) = choice::choose(&mut canvas, models, &wanted.levels[p], square, lambda);
            let coded = models.code(&mut out, &mut canvas, square, Some(&block));
            debug_assert!(coded.is_some());
        }
        levels.push(canvas.pixels);
    }
    out.raw(END, 8);
    bytes.extend(out.finish());
    (bytes, Decoded { planes: Planes::continued(width, levels), shifts })
}

/// A picture of `planes` (1 or 3) planes and the width and height `size` as its sources alone show it; middle grey without.
///
/// # Panics
/// When mask, sources and size do not fit each other, or the size is empty.
pub fn expected((planes, size): (usize, [usize; 2]), mask: &[bool], sources: &[Source<'_>]) -> Planes {
    let [width, height] = size;
    assert!(mask.len() == width * height && width > 0 && height > 0, "one flag a pixel");
    let nothing = || Planes::continued(width, vec![vec![canvas::NOT_YET; mask.len()]; planes]);
    carried::expect(sources, &Shifts::none(width, height), (planes, size), mask).unwrap_or_else(nothing)
}

fn steps_of(planes: usize, options: &Options) -> Vec<u16> {
    (0..planes).map(|p| if p == 0 { options.step } else { options.chroma_step }).collect()
}

/// Reads a picture of `planes` (1 or 3) planes and the width and height `size`, with the same mask, sources and models as
/// it was coded with.
///
/// # Errors
/// [`crate::CodecError::Payload`] at the first byte that does not follow FORMAT.md, "Coded texture".
///
/// # Panics
/// When mask, sources and size do not fit each other, or the size is empty.
pub fn decode(
    bytes: &[u8],
    (planes, [width, height]): (usize, [usize; 2]),
    mask: &[bool],
    sources: &[Source<'_>],
    models: &mut Models,
) -> Result<Decoded> {
    assert!(mask.len() == width * height && width > 0 && height > 0, "one flag a pixel");
    let mut header = ByteReader::new(bytes, SECTION);
    let mut steps = Vec::with_capacity(planes);
    for _ in 0..planes {
        let step = header.u16()?;
        if !(1..=MAX_STEP).contains(&step) {
            return Err(header.error(format!("a step of {step}; 1 to {MAX_STEP} are allowed")));
        }
        steps.push(step);
    }
    let mut reader = RangeDecoder::new(&bytes[planes * STEP_BYTES..], SECTION);
    let mut shifts = Shifts::none(width, height);
    if sources.len() == 1 {
        models.shifts.code(&mut reader, &mut shifts).ok_or_else(|| reader.error("a shift out of range"))?;
    }
    let expected = carried::expect(sources, &shifts, (planes, [width, height]), mask);
    let mut levels = Vec::with_capacity(planes);
    for (p, step) in steps.into_iter().enumerate() {
        let mut canvas = Canvas::new(width, mask, expected.as_ref().map(|e| &e.levels[p][..]), i32::from(step));
        let models = if p == 0 { &mut models.first } else { &mut models.others };
        for square in squares(width, height) {
            let coded = models.code(&mut reader, &mut canvas, square, None);
            coded.ok_or_else(|| reader.error("a block out of range"))?;
            if reader.overran() {
                return Err(reader.error("the picture ends too early"));
            }
        }
        levels.push(canvas.pixels);
    }
    if Coder::raw(&mut reader, 0, 8) != END {
        return Err(reader.error("the picture does not end in its mark"));
    }
    reader.finish()?;
    Ok(Decoded { planes: Planes::continued(width, levels), shifts })
}

#[cfg(test)]
mod tests;
