//! Coding of one scan of a shot: how the model moved, which pixels the scan has, and how they differ from the model.

use super::mask::{self, MaskModels};
use super::model::{Drawn, Model, Window};
use super::motion::Motion;
use super::motion_code::{Correction, MotionModels};
use super::order::Placed;
use super::outliers::{self, OutlierModels};
use super::patches::{self, Field, PatchModels, PatchOptions};
use super::scan_image::ScanImage;
use super::seen_scan::{Expected, SeenScan};
use super::steps::Steps;
use crate::Result;
use crate::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};

/// Most columns or rows of a scan.
pub const MAX_SIDE: u32 = 4096;
/// Most pixels of a scan.
pub const MAX_PIXELS: usize = 1 << 22;
/// Farthest offset of a window, 1/256 px.
const MAX_OFFSET: i32 = 1 << 20;

/// What the coder has learned of scans.
#[derive(Debug, Clone, Default)]
pub struct ScanModels {
    window: WindowModels,
    motion: MotionModels,
    mask: MaskModels,
    patches: PatchModels,
    outliers: OutlierModels,
}

impl ScanModels {
    /// Of motions.
    pub fn motion(&mut self) -> &mut MotionModels {
        &mut self.motion
    }
}

/// What holds for the scans of a shot.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a> {
    /// Its surface.
    pub model: &'a Model,
    /// Steps of the run.
    pub steps: &'a Steps,
}

/// What the encoder weighs.
#[derive(Debug, Clone, Copy)]
pub struct Fidelity {
    /// Squared error of a pixel across the surface that a bit may cost at most, square units.
    pub patch_lambda: f32,
    /// Farthest that a pixel may lie off the scan across the surface, units.
    pub bound: Option<i32>,
}

/// Bytes are not known inside a range-coded section; these are its parts in 1/256 bit, by the encoder's count.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Spent {
    /// Window and motion.
    pub motion: u64,
    /// Mask.
    pub mask: u64,
    /// Patches.
    pub patches: u64,
    /// Outliers.
    pub outliers: u64,
}

impl std::ops::Add for Spent {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            motion: self.motion + other.motion,
            mask: self.mask + other.mask,
            patches: self.patches + other.patches,
            outliers: self.outliers + other.outliers,
        }
    }
}

/// Codes where a scan is: its window, predicted from the nearest one's, and how its model moved from where it is predicted.
/// Returns it as decoded, and what it cost in 1/256 bit.
pub fn encode_place(
    context: Context<'_>,
    (window, nearest): (Window, Option<Window>),
    (correction, predicted): (&Correction, &Motion),
    (out, models): (&mut RangeEncoder, &mut ScanModels),
) -> (Placed, u64) {
    let start = out.position();
    models.window.encode(window, nearest, out);
    correction.encode(out, &mut models.motion);
    let motion = correction.apply(predicted, &context.model.frames, &context.steps.motion);
    (Placed { window, motion }, out.position() - start)
}

/// Reads where a scan is.
///
/// # Errors
/// [`crate::CodecError::Payload`] for anything out of range.
pub fn decode_place(
    context: Context<'_>,
    nearest: Option<Window>,
    predicted: &Motion,
    (reader, models): (&mut RangeDecoder<'_>, &mut ScanModels),
) -> Result<Placed> {
    let window = models.window.decode(nearest, reader)?;
    let correction = Correction::decode(reader, &mut models.motion)?;
    let motion = correction.apply(predicted, &context.model.frames, &context.steps.motion);
    if !motion.in_range() {
        return Err(reader.error("a motion beyond 16 m or a pose out of range"));
    }
    Ok(Placed { window, motion })
}

/// Codes what a scan shows where it is; `references` are decoded scans nearby, the nearest one first, none for a scan that
/// stands alone. Returns the scan as decoded, and what its parts cost.
pub fn encode(
    context: Context<'_>,
    placed: Placed,
    references: &[&SeenScan],
    (image, fidelity): (&ScanImage, Fidelity),
    (out, models): (&mut RangeEncoder, &mut ScanModels),
) -> (SeenScan, Spent) {
    let mut clock = out.position();
    let mut lap = |out: &RangeEncoder| {
        let now = out.position();
        let spent = now - clock;
        clock = now;
        spent
    };
    let drawn = Drawn::new(context.model, &placed.motion, &placed.window);
    let Expected { model_depth, mask: expected, mut residual } = Expected::new(context.model, &drawn, references);
    let mask = image.mask();
    mask::encode(&mask, &expected, out, &mut models.mask);
    let mut spent = Spent { mask: lap(out), ..Spent::default() };
    let field = Field { width: placed.window.width, height: placed.window.height, mask: &mask };
    let wanted: Vec<i32> =
        image.depth.iter().zip(&model_depth).zip(&mask).map(|((d, m), on)| if *on { d - m } else { 0 }).collect();
    let weights = image.across();
    let options = PatchOptions { step: context.steps.patch, lambda: fidelity.patch_lambda };
    patches::encode(&field, &wanted, &weights, &mut residual, options, (out, &mut models.patches));
    spent.patches = lap(out);
    outliers::encode(&mask, &wanted, &weights, &mut residual, fidelity.bound, (out, &mut models.outliers));
    spent.outliers = lap(out);
    (SeenScan { placed, drawn, model_depth, mask, residual }, spent)
}

/// Reads a scan whose place is known.
///
/// # Errors
/// [`crate::CodecError::Payload`] for anything out of range.
pub fn decode(
    context: Context<'_>,
    placed: Placed,
    references: &[&SeenScan],
    (reader, models): (&mut RangeDecoder<'_>, &mut ScanModels),
) -> Result<SeenScan> {
    let drawn = Drawn::new(context.model, &placed.motion, &placed.window);
    let Expected { model_depth, mask: expected, mut residual } = Expected::new(context.model, &drawn, references);
    let mask = mask::decode(&expected, reader, &mut models.mask);
    let field = Field { width: placed.window.width, height: placed.window.height, mask: &mask };
    patches::decode(&field, &mut residual, context.steps.patch, (reader, &mut models.patches))?;
    outliers::decode(&mask, &mut residual, (reader, &mut models.outliers))?;
    Ok(SeenScan { placed, drawn, model_depth, mask, residual })
}

#[derive(Debug, Clone)]
struct WindowModels {
    resized: BitModel,
    size: [BitModel; 12],
    offset: [BitModel; 24],
    sign: BitModel,
}

impl Default for WindowModels {
    fn default() -> Self {
        let even = BitModel::default();
        Self { resized: even, size: [even; 12], offset: [even; 24], sign: even }
    }
}

impl WindowModels {
    /// Size if it is not that of the window before, then the offset from there.
    fn encode(&mut self, window: Window, before: Option<Window>, out: &mut RangeEncoder) {
        let from = before.unwrap_or_default();
        let resized = (window.width, window.height) != (from.width, from.height);
        out.bit(&mut self.resized, resized);
        if resized {
            out.wide(&mut self.size, window.width as u32);
            out.wide(&mut self.size, window.height as u32);
        }
        for (v, from) in window.offset.iter().zip(&from.offset) {
            let step = v - from;
            out.wide(&mut self.offset, step.unsigned_abs());
            if step != 0 {
                out.bit(&mut self.sign, step < 0);
            }
        }
    }

    fn decode(&mut self, before: Option<Window>, reader: &mut RangeDecoder<'_>) -> Result<Window> {
        let mut window = before.unwrap_or_default();
        if reader.bit(&mut self.resized) {
            (window.width, window.height) =
                (reader.wide(&mut self.size)? as usize, reader.wide(&mut self.size)? as usize);
        }
        let side = 1..=MAX_SIDE as usize;
        if !side.contains(&window.width) || !side.contains(&window.height) || window.width * window.height > MAX_PIXELS
        {
            let reason = format!("a scan of {}x{} pixels; 1 to {MAX_SIDE} a side", window.width, window.height);
            return Err(reader.error(reason));
        }
        for v in &mut window.offset {
            let step = reader.wide(&mut self.offset)?.min(1 << 24) as i32;
            *v += if step != 0 && reader.bit(&mut self.sign) { -step } else { step };
            if v.abs() > MAX_OFFSET {
                return Err(reader.error("a window too far from the camera's pixels"));
            }
        }
        Ok(window)
    }
}
