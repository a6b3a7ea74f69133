//! Absolute phase by two-frequency temporal unwrapping.
//!
//! The low frequency's own ambiguity is resolved by the working range, after An, Hyun, Zhang, "Pixel-wise absolute phase
//! unwrapping using geometric constraints of structured light system", Optics Express 24(16), 2016: a pixel sees only the
//! columns between those at the nearest and the farthest depth. Instead of their minimum phase map this takes the phase
//! nearest to the middle of that interval, which leaves the spare part of the period on both sides.

use super::mask::{PixelMask, Rejection};
use super::{Calibration, DepthRange, LightError, PatternSequence};
use std::f32::consts::TAU;

/// Largest disagreement of the frequencies, in high-frequency periods; half a period is a wrong fringe order.
pub const MAX_DISAGREEMENT: f32 = 0.4;

/// Adding and taking away 1.5 * 2^23 rounds to the nearest whole number, for |x| < 2^22; `f32::round` would be a call a pixel.
const ROUNDER: f32 = 12_582_912.0;

#[inline]
pub(super) fn round(x: f32) -> f32 {
    (x + ROUNDER) - ROUNDER
}

/// Unwraps the high-frequency phase to projector columns.
#[derive(Debug, Clone)]
pub struct Unwrapper {
    high_period_px: f32,
    ratio: f32,
    /// Middle of the columns in the working range, in low-frequency periods, a pixel.
    middle_periods: Vec<f32>,
}

impl Unwrapper {
    /// Tables for a rig, a two-frequency sequence and a working range.
    ///
    /// # Errors
    /// [`LightError::Field`] when the sequence is of another kind or the low period is shorter than the working range needs.
    pub fn new(calibration: &Calibration, sequence: &PatternSequence, depth: DepthRange) -> Result<Self, LightError> {
        calibration.validate()?;
        depth.validate()?;
        let (low, high) = sequence.low_and_high()?;
        let low_period_px = sequence.burst_period_px(&low);
        let high_period_px = sequence.burst_period_px(&high);
        let mut widest_px = 0.0f64;
        let mut middle_periods = Vec::new();
        for ray in calibration.camera.ray_table("camera")? {
            let column = |z_mm: f64| calibration.projector_px((ray * z_mm).extend(z_mm)).x;
            let (a, b) = (column(depth.near_mm), column(depth.far_mm));
            widest_px = widest_px.max((a - b).abs());
            middle_periods.push((0.5 * (a + b) / low_period_px) as f32);
        }
        // A tenth of a period spare, so that noise at either end of the range cannot wrap.
        if widest_px > 0.9 * low_period_px {
            let reason = format!(
                "{low_period_px} px leaves the working range {}..{} mm ambiguous, which spans {widest_px:.0} px; take a period of \
                 {:.0} px or more, or a shorter range",
                depth.near_mm,
                depth.far_mm,
                (widest_px / 0.9).ceil()
            );
            return Err(LightError::field(format!("sequence.patterns[{}].period_px", low.start), reason));
        }
        let ratio = (low_period_px / high_period_px) as f32;
        Ok(Self { high_period_px: high_period_px as f32, ratio, middle_periods })
    }

    /// Projector column of every pixel, px, from the wrapped phases of both frequencies; rejects, in `mask`, pixels whose
    /// frequencies disagree.
    ///
    /// # Panics
    /// When a slice is not of the camera's size.
    pub fn unwrap(&self, low_rad: &[f32], high_rad: &[f32], mask: &mut PixelMask, column_px: &mut [f32]) {
        let n = self.middle_periods.len();
        assert!(low_rad.len() == n && high_rad.len() == n && column_px.len() == n && mask.verdicts.len() == n);
        let inputs = low_rad.iter().zip(high_rad).zip(&self.middle_periods);
        for (((&low_rad, &high_rad), &middle), (column, verdict)) in
            inputs.zip(column_px.iter_mut().zip(mask.verdicts.iter_mut()))
        {
            let low = low_rad * (1.0 / TAU);
            let high = high_rad * (1.0 / TAU);
            let expected = (low + round(middle - low)) * self.ratio;
            let order = round(expected - high);
            let disagreement = (expected - high - order).abs();
            *column = (order + high) * self.high_period_px;
            let wrong = disagreement > MAX_DISAGREEMENT && *verdict == Rejection::Kept;
            *verdict = if wrong { Rejection::FringeOrder } else { *verdict };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;
    use glam::DVec2;
    use proptest::prelude::*;

    fn wrapped(column_px: f64, period_px: f64) -> f32 {
        let turns = column_px / period_px;
        ((turns - turns.round()) * std::f64::consts::TAU) as f32
    }

    fn small_rig() -> Calibration {
        let mut c = rig();
        // The whole field of view in a picture of few pixels.
        c.camera.width_px = 64;
        c.camera.height_px = 48;
        c.camera.fx_px /= 10.0;
        c.camera.fy_px /= 10.0;
        c.camera.cx_px /= 10.0;
        c.camera.cy_px /= 10.0;
        c
    }

    proptest! {
        #[test]
        fn every_depth_of_the_range_gets_its_fringe_order(z in 510.0f64..690.0, seed in 0u64..1_000_000) {
            let c = small_rig();
            let sequence = PatternSequence::two_frequency([912, 1140], 264.0, 22.0, 3);
            let unwrapper = Unwrapper::new(&c, &sequence, DepthRange::default()).unwrap();
            let n = 64 * 48;
            let (mut low, mut high, mut truth) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
            for i in 0..n {
                let ray = c.camera.unproject(DVec2::new((i % 64) as f64, (i / 64) as f64)).unwrap();
                truth[i] = c.projector_px((ray * z).extend(z)).x;
                // Five sigma of the low phase at the least modulation of the mask, for the noise of a picture that dark.
                let sign = if (seed >> (i % 20)) & 1 == 0 { 1.0 } else { -1.0 };
                low[i] = wrapped(truth[i], 264.0) + sign * 5.0 * (2.0f32 / 3.0).sqrt() * 0.955 / 15.0;
                high[i] = wrapped(truth[i], 22.0);
            }
            let mut mask = PixelMask::new(64, 48);
            let mut column = vec![0.0; n];
            unwrapper.unwrap(&low, &high, &mut mask, &mut column);
            for i in 0..n {
                prop_assert!((f64::from(column[i]) - truth[i]).abs() < 1e-3, "pixel {i}");
            }
        }
    }

    #[test]
    fn frequencies_that_disagree_are_rejected() {
        let c = small_rig();
        let sequence = PatternSequence::two_frequency([912, 1140], 264.0, 22.0, 3);
        let unwrapper = Unwrapper::new(&c, &sequence, DepthRange::default()).unwrap();
        let ray = c.camera.unproject(DVec2::new(30.0, 20.0)).unwrap();
        let column = c.projector_px((ray * 600.0).extend(600.0)).x;
        let n = 64 * 48;
        let low = vec![wrapped(column + 10.5, 264.0); n];
        let high = vec![wrapped(column, 22.0); n];
        let mut mask = PixelMask::new(64, 48);
        unwrapper.unwrap(&low, &high, &mut mask, &mut vec![0.0; n]);
        assert_eq!(mask.verdicts[20 * 64 + 30], Rejection::FringeOrder);
    }

    #[test]
    fn a_low_period_too_short_for_the_range_is_refused_with_the_one_needed() {
        let sequence = PatternSequence::two_frequency([912, 1140], 100.0, 20.0, 3);
        let error = Unwrapper::new(&small_rig(), &sequence, DepthRange::default()).unwrap_err().to_string();
        assert!(error.contains("patterns[0].period_px") && error.contains("or more"), "{error}");
    }
}
