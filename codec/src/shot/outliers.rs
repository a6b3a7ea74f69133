//! Single pixels that must come nearer to the scan than their patch brings them.

use crate::Result;
use crate::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};

/// Largest step and correction.
const MAX_VALUE: u32 = 1 << 25;

/// What the coder has learned of outliers.
#[derive(Debug, Clone)]
pub struct OutlierModels {
    count: [BitModel; 24],
    step: [BitModel; 26],
    gap: [BitModel; 24],
    value: [BitModel; 26],
    sign: BitModel,
}

impl Default for OutlierModels {
    fn default() -> Self {
        let even = BitModel::default();
        Self { count: [even; 24], step: [even; 26], gap: [even; 24], value: [even; 26], sign: even }
    }
}

/// Corrects every pixel of the mask whose `values` lie farther than `bound` across the surface from `wanted`; `across` are
/// the squared cosines that turn depth into distance. `values` become what is decoded.
pub fn encode(
    mask: &[bool],
    wanted: &[i32],
    across: &[f32],
    values: &mut [i32],
    bound: Option<i32>,
    (out, models): (&mut RangeEncoder, &mut OutlierModels),
) {
    let Some(bound) = bound.map(|b| b.max(1)) else { return out.wide(&mut models.count, 0) };
    let far = |i: usize| (f64::from(wanted[i]) - f64::from(values[i])).powi(2) * f64::from(across[i]);
    let limit = f64::from(bound).powi(2);
    let found: Vec<usize> = (0..mask.len()).filter(|&i| mask[i] && far(i) > limit).collect();
    out.wide(&mut models.count, found.len() as u32);
    if found.is_empty() {
        return;
    }
    out.wide(&mut models.step, bound as u32);
    let mut next = 0;
    for i in found {
        let missing = wanted[i].saturating_sub(values[i]).clamp(-(MAX_VALUE as i32), MAX_VALUE as i32);
        let steps = (missing.signum() * ((missing.abs() + bound / 2) / bound)).clamp(-(1 << 24), 1 << 24);
        out.wide(&mut models.gap, (i - next) as u32);
        out.wide(&mut models.value, steps.unsigned_abs());
        out.bit(&mut models.sign, steps < 0);
        values[i] = corrected(values[i], steps, bound);
        next = i + 1;
    }
}

/// Reads corrections onto `values`.
///
/// # Errors
/// [`crate::CodecError::Payload`] for pixels off the mask and numbers out of range.
pub fn decode(
    mask: &[bool],
    values: &mut [i32],
    (reader, models): (&mut RangeDecoder<'_>, &mut OutlierModels),
) -> Result<()> {
    let count = reader.wide(&mut models.count)?;
    if count == 0 {
        return Ok(());
    }
    let bound = reader.wide(&mut models.step)?;
    if bound == 0 || bound > MAX_VALUE {
        return Err(reader.error("a step of outliers out of range"));
    }
    let mut next = 0_usize;
    for _ in 0..count {
        let i = next + reader.wide(&mut models.gap)? as usize;
        if !mask.get(i).copied().unwrap_or(false) {
            return Err(reader.error("an outlier off the mask"));
        }
        let steps = reader.wide(&mut models.value)?.min(1 << 24) as i32;
        let steps = if reader.bit(&mut models.sign) { -steps } else { steps };
        values[i] = corrected(values[i], steps, bound as i32);
        next = i + 1;
    }
    Ok(())
}

fn corrected(value: i32, steps: i32, step: i32) -> i32 {
    let most = i64::from(MAX_VALUE);
    (i64::from(value) + i64::from(steps) * i64::from(step)).clamp(-4 * most, 4 * most) as i32
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_bound_is_kept_and_the_decoder_agrees(seed in 0_u32..1000, bound in 1_i32..500) {
            let hash = |i: usize| (i as u32 ^ seed.wrapping_mul(747_796_405)).wrapping_mul(2_654_435_761) >> 8;
            let mask: Vec<bool> = (0..300).map(|i| hash(i) % 4 != 0).collect();
            let wanted: Vec<i32> = (0..300).map(|i| (hash(i + 7) % 9001) as i32 - 4500).collect();
            let across: Vec<f32> = (0..300).map(|i| 1.0 / (1 + hash(i + 3) % 5) as f32).collect();
            let mut values = vec![5; 300];
            let mut out = RangeEncoder::default();
            encode(&mask, &wanted, &across, &mut values, Some(bound), (&mut out, &mut OutlierModels::default()));
            for i in (0..300).filter(|i| mask[*i]) {
                prop_assert!(((wanted[i] - values[i]) as f32).powi(2) * across[i] <= (bound * bound) as f32 * 1.0001);
            }
            let bytes = out.finish();
            let mut decoded = vec![5; 300];
            let mut reader = RangeDecoder::new(&bytes, "outliers");
            decode(&mask, &mut decoded, (&mut reader, &mut OutlierModels::default())).unwrap();
            reader.finish().unwrap();
            prop_assert_eq!(decoded, values);
        }
    }
}
