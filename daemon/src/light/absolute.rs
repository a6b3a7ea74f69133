//! Absolute projector coordinates from any pattern sequence, for single scans; the live scanner's two frequencies have their
//! own kernel in [`super::unwrap`].
//!
//! A chain from coarse to fine: what comes first is absolute, and every finer phase takes the fringe order nearest to the
//! coordinate before it. First comes a Gray code, or a fringe or beat of fringes that covers the projector, or the coarsest of
//! them in the working range (An, Hyun, Zhang 2016, see [`super::unwrap`]). A beat is a whole-number combination of phases
//! with the same combination of frequencies (heterodyne; C. Reich, R. Ritter, J. Thesing, "White light heterodyne principle
//! for 3D-measurement", Proc. SPIE 3100, 1997).

use super::mask::{PixelMask, Rejection};
use super::unwrap::MAX_DISAGREEMENT;
use super::{
    Calibration, DepthRange, Direction, GrayDecoder, LightError, MaskLimits, PatternSequence, PhaseExtractor,
    WrappedPhase,
};
use gv3_codec::GreyPicture;
use std::f32::consts::TAU;
use std::ops::Range;

/// A fringe, or a beat of fringes.
#[derive(Debug, Clone, PartialEq)]
struct Signal {
    period_px: f64,
    /// Whole-number factor of every fringe.
    factors: Vec<i32>,
}

/// One burst of sinusoids.
#[derive(Debug, Clone)]
struct Fringe {
    pictures: Range<usize>,
    extractor: PhaseExtractor,
}

/// Decodes the coordinate along one direction.
#[derive(Debug, Clone)]
pub struct AbsoluteDecoder {
    gray: Option<GrayDecoder>,
    limits: MaskLimits,
    fringes: Vec<Fringe>,
    /// Coarse to fine.
    chain: Vec<Signal>,
    /// Coordinate the first signal of the chain is nearest to, a pixel or one for all, px; empty after a Gray code.
    middle_px: Vec<f32>,
}

/// What one direction gave.
#[derive(Debug, Clone)]
pub struct AbsoluteCoordinates {
    /// Projector coordinate of every camera pixel, px.
    pub coordinate_px: Vec<f32>,
    /// Background A of the finest fringe, grey levels; empty without fringes.
    pub background: Vec<f32>,
}

/// Pixels judged and phases measured, before the pixels next to rejected ones are eroded.
#[derive(Debug, Clone)]
pub struct MeasuredPhases(Vec<WrappedPhase>);

impl AbsoluteDecoder {
    /// The decoder of a sequence's patterns along `direction`; `None` when it has none.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the pattern that cannot work, or the period that the working range needs.
    pub fn new(
        calibration: &Calibration,
        sequence: &PatternSequence,
        direction: Direction,
        limits: MaskLimits,
        depth: DepthRange,
    ) -> Result<Option<Self>, LightError> {
        Self::build(sequence, direction, limits, Some((calibration, depth)))
    }

    /// The decoder for a rig that is not calibrated yet: the patterns alone, a Gray code or a fringe or beat that covers the
    /// projector, must tell every coordinate.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the pattern that cannot work, or that the patterns cover too little.
    pub fn uncalibrated(
        sequence: &PatternSequence,
        direction: Direction,
        limits: MaskLimits,
    ) -> Result<Option<Self>, LightError> {
        Self::build(sequence, direction, limits, None)
    }

    fn build(
        sequence: &PatternSequence,
        direction: Direction,
        limits: MaskLimits,
        range: Option<(&Calibration, DepthRange)>,
    ) -> Result<Option<Self>, LightError> {
        sequence.validate()?;
        let gray = GrayDecoder::new(sequence, direction)?;
        let mut bursts = sequence.bursts();
        bursts.retain(|burst| sequence.patterns[burst.start].direction == direction);
        // Coarse to fine, so that the last is the finest.
        bursts.sort_by(|a, b| sequence.burst_period_px(b).total_cmp(&sequence.burst_period_px(a)));
        if gray.is_none() && bursts.is_empty() {
            return Ok(None);
        }
        let periods_px: Vec<f64> = bursts.iter().map(|b| sequence.burst_period_px(b)).collect();
        let length_px = sequence.side_px(direction);
        let mut decoder =
            Self { gray, limits, fringes: Vec::new(), chain: fringe_signals(&periods_px), middle_px: vec![] };
        for pictures in bursts {
            let extractor = PhaseExtractor::new(&sequence.patterns[pictures.clone()], limits)?;
            decoder.fringes.push(Fringe { pictures, extractor });
        }
        match &decoder.gray {
            Some(gray) => {
                let cell_px = f64::from(gray.cell_px());
                decoder.chain.retain(|s| s.factors.iter().map(|k| k.abs()).sum::<i32>() == 1);
                if let Some(first) = decoder.chain.first().filter(|s| 0.75 * s.period_px < cell_px) {
                    let reason = format!("a Gray code of {cell_px} px cannot order fringes of {} px", first.period_px);
                    return Err(LightError::field("sequence.patterns", reason));
                }
            }
            None => decoder.begin(range, direction, length_px)?,
        }
        Ok(Some(decoder))
    }

    /// Finds what the chain begins with when there is no Gray code.
    fn begin(
        &mut self,
        range: Option<(&Calibration, DepthRange)>,
        direction: Direction,
        length_px: u32,
    ) -> Result<(), LightError> {
        let length = f64::from(length_px);
        if let Some(first) = self.chain.iter().rposition(|s| s.period_px >= length) {
            self.chain.drain(..first);
            self.middle_px = vec![0.5 * (length_px as f32 - 1.0)];
            return Ok(());
        }
        let period_px = self.chain.first().map_or(0.0, |s| s.period_px);
        let Some((calibration, depth)) = range else {
            let reason = format!(
                "the longest period or beat, {period_px:.1} px, does not cover the projector's {length_px} px, and without \
                 calibration nothing else orders fringes; add a coarser pattern or a Gray code"
            );
            return Err(LightError::field("sequence.patterns", reason));
        };
        let along = |ray: glam::DVec2, z_mm: f64| {
            let px = calibration.projector_px((ray * z_mm).extend(z_mm));
            if direction == Direction::Columns { px.x } else { px.y }
        };
        let mut widest_px = 0.0f64;
        for ray in calibration.camera.ray_table("camera")? {
            let (a, b) = (along(ray, depth.near_mm), along(ray, depth.far_mm));
            widest_px = widest_px.max((a - b).abs());
            self.middle_px.push((0.5 * (a + b)) as f32);
        }
        // As the live unwrapping: a tenth of a period spare. A range given wrong can also make the width no number.
        if widest_px.is_nan() || widest_px > 0.9 * period_px {
            let reason = format!(
                "the longest period or beat, {period_px:.1} px, covers neither the projector's {length_px} px nor the working \
                 range {}..{} mm, which spans {widest_px:.0} px; add a coarser pattern or narrow limits.depth",
                depth.near_mm, depth.far_mm
            );
            return Err(LightError::field("sequence.patterns", reason));
        }
        Ok(())
    }

    /// Measures phases and rejects, in `mask`, pixels without signal.
    ///
    /// # Panics
    /// When pictures and mask differ in size, or pictures and patterns in number.
    pub fn measure(&self, pictures: &[&GreyPicture], mask: &mut PixelMask) -> MeasuredPhases {
        if let Some(gray) = &self.gray {
            gray.reject_shadow(pictures, self.limits, mask);
        }
        let phase = |fringe: &Fringe| {
            let mut phase = WrappedPhase::new(mask.verdicts.len());
            fringe.extractor.extract(&pictures[fringe.pictures.clone()], mask, &mut phase);
            phase
        };
        MeasuredPhases(self.fringes.iter().map(phase).collect())
    }

    /// Coordinates of all kept pixels; rejects, in `mask`, those whose patterns contradict each other.
    ///
    /// # Panics
    /// As [`Self::measure`].
    pub fn resolve(
        &self,
        pictures: &[&GreyPicture],
        mut measured: MeasuredPhases,
        mask: &mut PixelMask,
    ) -> AbsoluteCoordinates {
        let mut is_absolute = self.gray.is_some();
        let mut coordinate_px = match &self.gray {
            Some(gray) => {
                let codes = gray.decode(pictures, mask);
                gray.coordinates_px(pictures, &codes, mask)
            }
            None if self.middle_px.len() == 1 => vec![self.middle_px[0]; mask.verdicts.len()],
            None => self.middle_px.clone(),
        };
        for signal in &self.chain {
            refine(signal, &measured.0, is_absolute, mask, &mut coordinate_px);
            is_absolute = true;
        }
        let background = measured.0.pop().map_or_else(Vec::new, |finest| finest.background);
        AbsoluteCoordinates { coordinate_px, background }
    }
}

/// Takes the order of `signal` nearest to the coordinates and the signal's coordinates for them.
fn refine(
    signal: &Signal,
    phases: &[WrappedPhase],
    is_absolute: bool,
    mask: &mut PixelMask,
    coordinate_px: &mut [f32],
) {
    let period_px = signal.period_px as f32;
    let used: Vec<(f32, &[f32])> = signal
        .factors
        .iter()
        .zip(phases)
        .filter(|(k, _)| **k != 0)
        .map(|(&k, phase)| (k as f32 / TAU, phase.phase_rad.as_slice()))
        .collect();
    for (i, (coordinate, verdict)) in coordinate_px.iter_mut().zip(&mut mask.verdicts).enumerate() {
        let turns: f32 = used.iter().map(|(factor, phase_rad)| factor * phase_rad[i]).sum();
        let expected = *coordinate / period_px;
        let order = (expected - turns).round();
        *coordinate = (turns + order) * period_px;
        let is_wrong = is_absolute && (expected - turns - order).abs() > MAX_DISAGREEMENT;
        if is_wrong && *verdict == Rejection::Kept {
            *verdict = Rejection::FringeOrder;
        }
    }
}

/// Fringes and the beats of neighbours, the beats of those and so on, the longest period first.
fn fringe_signals(periods_px: &[f64]) -> Vec<Signal> {
    let fringe = |(i, &period_px): (usize, &f64)| {
        let mut factors = vec![0; periods_px.len()];
        factors[i] = 1;
        Signal { period_px, factors }
    };
    let mut level: Vec<Signal> = periods_px.iter().enumerate().map(fringe).collect();
    let mut all = level.clone();
    // Beats of beats of beats amplify noise eightfold and are in no use.
    for _ in 0..2 {
        // The phase of the shorter period runs faster, so the difference has a positive frequency.
        let beat = |pair: &[Signal]| {
            let frequency = 1.0 / pair[1].period_px - 1.0 / pair[0].period_px;
            let factors = pair[1].factors.iter().zip(&pair[0].factors).map(|(a, b)| a - b).collect();
            (frequency > 1e-9).then(|| Signal { period_px: 1.0 / frequency, factors })
        };
        level = level.windows(2).filter_map(beat).collect();
        level.sort_by(|a, b| b.period_px.total_cmp(&a.period_px));
        all.extend(level.iter().cloned());
    }
    all.sort_by(|a, b| b.period_px.total_cmp(&a.period_px));
    let finest = periods_px.last().copied().unwrap_or(0.0);
    // A beat shorter than the finest fringe adds noise only.
    all.retain(|s| s.period_px >= finest);
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;
    use proptest::prelude::*;

    const SIZE: [u32; 2] = [912, 1140];

    /// Coordinates decoded from pictures in which pixel i sees `truth_px[i]` with Gaussian-like noise of `sigma` levels.
    fn decode(sequence: &PatternSequence, direction: Direction, truth_px: &[f64], sigma: f64) -> (Vec<f32>, PixelMask) {
        let mut state = 3u64;
        let mut noise = || {
            let mut uniform = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) as f64 / 2f64.powi(31)
            };
            sigma * ((0..12).map(|_| uniform()).sum::<f64>() - 6.0)
        };
        let n = truth_px.len() as u32;
        let pictures: Vec<GreyPicture> = sequence
            .patterns
            .iter()
            .map(|pattern| {
                let level = |u: f64| match (pattern.period_px(), pattern.shift_rad()) {
                    (Some(period_px), Some(shift)) => 0.5 + 0.5 * (std::f64::consts::TAU * u / period_px + shift).cos(),
                    _ => pattern.level(u.round() as u32),
                };
                let pixels = truth_px.iter().map(|&u| (20.0 + 180.0 * level(u) + noise()).round() as u8).collect();
                GreyPicture::new(n, 1, pixels)
            })
            .collect();
        let refs: Vec<&GreyPicture> = pictures.iter().collect();
        let made = AbsoluteDecoder::new(&rig(), sequence, direction, MaskLimits::default(), DepthRange::default());
        let decoder = made.unwrap().unwrap();
        let mut mask = PixelMask::new(n as usize, 1);
        let measured = decoder.measure(&refs, &mut mask);
        (decoder.resolve(&refs, measured, &mut mask).coordinate_px, mask)
    }

    #[test]
    fn every_scheme_gives_back_every_coordinate_of_the_projector() {
        for direction in [Direction::Columns, Direction::Rows] {
            let length = if direction == Direction::Columns { 912 } else { 1140 };
            let truth: Vec<f64> = (0..4 * (length - 1)).map(|i| f64::from(i) / 4.0).collect();
            for (sequence, bound) in [
                (PatternSequence::hierarchical(SIZE, direction, 18.0, 6.0, 3), 0.25),
                (PatternSequence::heterodyne(SIZE, direction, 24.0, 5), 0.35),
                (PatternSequence::gray_phase(SIZE, direction, 24.0, 4), 0.35),
                (PatternSequence::gray_code(SIZE, &[direction]), 0.51),
            ] {
                let (found, mask) = decode(&sequence, direction, &truth, 1.0);
                assert_eq!(mask.count().total(), 0);
                let errors = found.iter().zip(&truth).map(|(f, t)| (f64::from(*f) - t).abs());
                let worst = errors.fold(0.0, f64::max);
                assert!(worst < bound, "{direction:?}, {} pictures: {worst}", sequence.patterns.len());
            }
        }
    }

    proptest! {
        #[test]
        fn the_order_is_never_wrong_for_any_period_and_steps(
            u in 0.0f64..911.0, period in 10.0f64..60.0, ratio in 2.0f64..7.0, steps in 3u32..8
        ) {
            let sequence = PatternSequence::hierarchical(SIZE, Direction::Columns, period, ratio, steps);
            let (found, mask) = decode(&sequence, Direction::Columns, &[u; 20], 2.0);
            for (i, found) in found.iter().enumerate() {
                prop_assert!(mask.is_kept(i) && (f64::from(*found) - u).abs() < 0.2 * period, "{found} for {u}");
            }
        }
    }

    #[test]
    fn what_nothing_can_order_is_refused() {
        let error = |sequence: &PatternSequence| {
            AbsoluteDecoder::new(&rig(), sequence, Direction::Columns, MaskLimits::default(), DepthRange::default())
                .unwrap_err()
                .to_string()
        };
        let text = error(&PatternSequence::n_step(SIZE, Direction::Columns, 20.0, 3));
        assert!(text.contains("20.0 px, covers neither") && text.contains("add a coarser pattern"), "{text}");
        let mut coarse = PatternSequence::gray_phase(SIZE, Direction::Columns, 24.0, 3);
        coarse.patterns.drain(6..14);
        assert!(error(&coarse).contains("cannot order fringes of 24 px"));
    }
}
