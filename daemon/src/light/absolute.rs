//! Absolute projector coordinates from any pattern sequence; two frequencies of three steps, the live default, have their own
//! kernel in [`super::unwrap`].
//!
//! A chain from coarse to fine: what comes first is absolute, and every finer phase takes the fringe order nearest to the
//! coordinate before it. First comes a Gray code, or a fringe or beat of fringes that covers the projector, or the coarsest of
//! them in the working range (An, Hyun, Zhang 2016, see [`super::geometric`]). A beat is a whole-number combination of phases
//! with the same combination of frequencies (heterodyne; C. Reich, R. Ritter, J. Thesing, "White light heterodyne principle
//! for 3D-measurement", Proc. SPIE 3100, 1997).

use super::gamma::BurstErrors;
use super::mask::{PixelMask, Rejection};
use super::unwrap::{MAX_DISAGREEMENT, round};
use super::{
    Calibration, DepthRange, Direction, GrayDecoder, LightError, Limits, MaskLimits, MinimumPhase, PatternSequence,
    PhaseExtractor, Processing, Unwrap, WrappedPhase, geometric, spatial,
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
    errors: Option<BurstErrors>,
}

/// What makes the first of the chain absolute.
#[derive(Debug, Clone)]
enum Start {
    /// A Gray code, before the first fringe.
    Gray(GrayDecoder),
    /// A first signal that covers the projector, whose middle this is, px.
    Whole(f32),
    /// A first signal that covers the working range.
    Range(MinimumPhase),
    /// The working range around relative phase: least and greatest coordinate of each pixel, px.
    Spatial(Vec<[f32; 2]>),
}

/// Decodes the coordinate along one direction.
#[derive(Debug, Clone)]
pub struct AbsoluteDecoder {
    start: Start,
    limits: MaskLimits,
    fringes: Vec<Fringe>,
    /// Coarse to fine.
    chain: Vec<Signal>,
}

/// Pixels judged and phases measured, before the pixels next to rejected ones are eroded.
#[derive(Debug, Clone)]
pub struct MeasuredPhases(Vec<WrappedPhase>);

impl MeasuredPhases {
    /// Phases of every burst, coarse to fine.
    pub fn bursts(&self) -> &[WrappedPhase] {
        &self.0
    }

    /// Background A of the finest fringe, grey levels; `None` without fringes.
    pub fn background(&self) -> Option<&[f32]> {
        self.0.last().map(|finest| finest.background.as_slice())
    }
}

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
        let limits = Limits { mask: limits, depth, ..Limits::default() };
        Self::with(calibration, sequence, direction, &limits, &Processing::default())
    }

    /// As [`Self::new`], with the rig's choices.
    ///
    /// # Errors
    /// As [`Self::new`], and naming the choice that the sequence does not allow.
    pub fn with(
        calibration: &Calibration,
        sequence: &PatternSequence,
        direction: Direction,
        limits: &Limits,
        processing: &Processing,
    ) -> Result<Option<Self>, LightError> {
        Self::build(Some(calibration), sequence, direction, limits, processing)
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
        let limits = Limits { mask: limits, ..Limits::default() };
        Self::build(None, sequence, direction, &limits, &Processing::default())
    }

    fn build(
        calibration: Option<&Calibration>,
        sequence: &PatternSequence,
        direction: Direction,
        limits: &Limits,
        processing: &Processing,
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
        let mut chain = fringe_signals(&periods_px);
        let start = match gray {
            Some(gray) if processing.unwrap == Unwrap::Auto => after_gray(gray, &mut chain)?,
            None if processing.unwrap == Unwrap::Auto => {
                begin(calibration, sequence, direction, limits.depth, &mut chain)?
            }
            None if bursts.len() == 1 => {
                single(calibration, sequence, direction, periods_px[0], limits.depth, processing.unwrap)?
            }
            _ => {
                let reason = "geometric and spatial take one burst of sinusoids and no Gray code; leave the key out to \
                              unwrap this sequence by its other patterns";
                return Err(LightError::field("processing.unwrap", reason));
            }
        };
        let fringe = |pictures: Range<usize>| {
            let patterns = &sequence.patterns[pictures.clone()];
            let errors = processing.gamma.as_ref().map(|table| table.of_burst(patterns).cloned()).transpose()?;
            Ok(Fringe { pictures, extractor: PhaseExtractor::new(patterns, limits.mask)?, errors })
        };
        let fringes = bursts.into_iter().map(fringe).collect::<Result<_, LightError>>()?;
        Ok(Some(Self { start, limits: limits.mask, fringes, chain }))
    }

    /// The pictures of every burst, coarse to fine.
    pub fn bursts(&self) -> impl Iterator<Item = Range<usize>> + '_ {
        self.fringes.iter().map(|fringe| fringe.pictures.clone())
    }

    /// Depths between which every pixel gets its order, when it is the working range that gives it.
    pub fn valid_depth(&self) -> Option<DepthRange> {
        match &self.start {
            Start::Range(minimum) => Some(minimum.valid_depth()),
            _ => None,
        }
    }

    /// Room for the phases of `pixel_count` pixels, for [`Self::measure_into`].
    pub fn room(&self, pixel_count: usize) -> MeasuredPhases {
        MeasuredPhases(self.fringes.iter().map(|_| WrappedPhase::new(pixel_count)).collect())
    }

    /// Measures phases and rejects, in `mask`, pixels without signal.
    ///
    /// # Panics
    /// When pictures and mask differ in size, or pictures and patterns in number.
    pub fn measure(&self, pictures: &[&GreyPicture], mask: &mut PixelMask) -> MeasuredPhases {
        let mut measured = self.room(mask.verdicts.len());
        self.measure_into(pictures, mask, &mut measured);
        measured
    }

    /// As [`Self::measure`], into [`Self::room`].
    ///
    /// # Panics
    /// As [`Self::measure`].
    pub fn measure_into(&self, pictures: &[&GreyPicture], mask: &mut PixelMask, measured: &mut MeasuredPhases) {
        if let Start::Gray(gray) = &self.start {
            gray.reject_shadow(pictures, self.limits, mask);
        }
        for (fringe, phase) in self.fringes.iter().zip(&mut measured.0) {
            fringe.extractor.extract(&pictures[fringe.pictures.clone()], mask, phase);
            if let Some(errors) = &fringe.errors {
                errors.correct(&mut phase.phase_rad);
            }
        }
    }

    /// Projector coordinates of all kept pixels, px; rejects, in `mask`, those whose patterns contradict each other.
    ///
    /// # Panics
    /// As [`Self::measure`].
    pub fn resolve(&self, pictures: &[&GreyPicture], measured: &MeasuredPhases, mask: &mut PixelMask) -> Vec<f32> {
        let mut coordinate_px = vec![0.0; mask.verdicts.len()];
        self.resolve_into(pictures, measured, mask, &mut coordinate_px);
        coordinate_px
    }

    /// As [`Self::resolve`], into a slice of the picture's size, px.
    ///
    /// # Panics
    /// As [`Self::measure`].
    pub fn resolve_into(
        &self,
        pictures: &[&GreyPicture],
        measured: &MeasuredPhases,
        mask: &mut PixelMask,
        coordinate_px: &mut [f32],
    ) {
        let mut is_absolute = matches!(self.start, Start::Gray(_));
        match &self.start {
            Start::Gray(gray) => {
                let codes = gray.decode(pictures, mask);
                coordinate_px.copy_from_slice(&gray.coordinates_px(pictures, &codes, mask));
            }
            Start::Whole(middle_px) => coordinate_px.fill(*middle_px),
            Start::Range(minimum) => {
                coordinate_px.iter_mut().zip(minimum.middle_px()).for_each(|(out, middle_px)| *out = middle_px);
            }
            Start::Spatial(range_px) => {
                let relative = spatial::unwrap(&measured.0[0], mask);
                return spatial::anchor(&relative, self.chain[0].period_px as f32, range_px, mask, coordinate_px);
            }
        }
        for signal in &self.chain {
            refine(signal, &measured.0, is_absolute, mask, coordinate_px);
            is_absolute = true;
        }
    }
}

/// Finds what the chain begins with when there is no Gray code: a signal that covers the projector, or the longest in the
/// working range.
fn begin(
    calibration: Option<&Calibration>,
    sequence: &PatternSequence,
    direction: Direction,
    depth: DepthRange,
    chain: &mut Vec<Signal>,
) -> Result<Start, LightError> {
    let length_px = sequence.side_px(direction);
    if let Some(first) = chain.iter().rposition(|s| s.period_px >= f64::from(length_px)) {
        chain.drain(..first);
        return Ok(Start::Whole(0.5 * (length_px as f32 - 1.0)));
    }
    let period_px = chain.first().map_or(0.0, |s| s.period_px);
    let calibration = calibration.ok_or_else(|| without_calibration(period_px, length_px))?;
    Ok(Start::Range(MinimumPhase::new(calibration, direction, period_px, depth)?))
}

fn without_calibration(period_px: f64, length_px: u32) -> LightError {
    let reason = format!(
        "the longest period or beat, {period_px:.1} px, does not cover the projector's {length_px} px, and without \
         calibration nothing else orders fringes; add a coarser pattern or a Gray code"
    );
    LightError::field("sequence.patterns", reason)
}

/// The chain after a Gray code has no use for beats.
fn after_gray(gray: GrayDecoder, chain: &mut Vec<Signal>) -> Result<Start, LightError> {
    let cell_px = f64::from(gray.cell_px());
    chain.retain(|s| s.factors.iter().map(|k| k.abs()).sum::<i32>() == 1);
    if let Some(first) = chain.first().filter(|s| 0.75 * s.period_px < cell_px) {
        let reason = format!("a Gray code of {cell_px} px cannot order fringes of {} px", first.period_px);
        return Err(LightError::field("sequence.patterns", reason));
    }
    Ok(Start::Gray(gray))
}

/// The chosen way to order one burst.
fn single(
    calibration: Option<&Calibration>,
    sequence: &PatternSequence,
    direction: Direction,
    period_px: f64,
    depth: DepthRange,
    unwrap: Unwrap,
) -> Result<Start, LightError> {
    let calibration = calibration.ok_or_else(|| without_calibration(period_px, sequence.side_px(direction)))?;
    Ok(match unwrap {
        Unwrap::Spatial => Start::Spatial(geometric::ranges_px(calibration, direction, depth)?),
        Unwrap::Geometric | Unwrap::Auto => Start::Range(MinimumPhase::new(calibration, direction, period_px, depth)?),
    })
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
    let limit = if is_absolute { MAX_DISAGREEMENT } else { f32::INFINITY };
    let mut used = signal.factors.iter().zip(phases).filter(|(k, _)| **k != 0);
    let (Some((&first, phase)), None) = (used.next(), used.next()) else {
        return refine_beat(signal, phases, limit, mask, coordinate_px);
    };
    let factor = first as f32 / TAU;
    let pixels = coordinate_px.iter_mut().zip(&mut mask.verdicts);
    for ((coordinate, verdict), &phase_rad) in pixels.zip(&phase.phase_rad) {
        order_pixel(factor * phase_rad, period_px, limit, coordinate, verdict);
    }
}

fn refine_beat(signal: &Signal, phases: &[WrappedPhase], limit: f32, mask: &mut PixelMask, coordinate_px: &mut [f32]) {
    let period_px = signal.period_px as f32;
    for (i, (coordinate, verdict)) in coordinate_px.iter_mut().zip(&mut mask.verdicts).enumerate() {
        let turns: f32 = signal.factors.iter().zip(phases).map(|(&k, p)| k as f32 / TAU * p.phase_rad[i]).sum();
        order_pixel(turns, period_px, limit, coordinate, verdict);
    }
}

#[inline]
fn order_pixel(turns: f32, period_px: f32, limit: f32, coordinate_px: &mut f32, verdict: &mut Rejection) {
    let expected = *coordinate_px / period_px;
    let order = round(expected - turns);
    *coordinate_px = (turns + order) * period_px;
    let is_wrong = (expected - turns - order).abs() > limit && *verdict == Rejection::Kept;
    *verdict = if is_wrong { Rejection::FringeOrder } else { *verdict };
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
        decode_levels(sequence, direction, truth_px, [20.0, 200.0], sigma)
    }

    fn decode_levels(
        sequence: &PatternSequence,
        direction: Direction,
        truth_px: &[f64],
        [dark, bright]: [f64; 2],
        sigma: f64,
    ) -> (Vec<f32>, PixelMask) {
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
                let pixels =
                    truth_px.iter().map(|&u| (dark + (bright - dark) * level(u) + noise()).round() as u8).collect();
                GreyPicture::new(n, 1, pixels)
            })
            .collect();
        let refs: Vec<&GreyPicture> = pictures.iter().collect();
        let made = AbsoluteDecoder::new(&rig(), sequence, direction, MaskLimits::default(), DepthRange::default());
        let decoder = made.unwrap().unwrap();
        let mut mask = PixelMask::new(n as usize, 1);
        let measured = decoder.measure(&refs, &mut mask);
        (decoder.resolve(&refs, &measured, &mut mask), mask)
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

    /// A pixel is off by a period when the coordinate before it errs by more than 0.6 of the finer period: up to
    /// [`MAX_DISAGREEMENT`] = 0.4 it is accepted, beyond it rejected, and from 0.6 on a wrong order is accepted again. At the
    /// mask's least modulation, B = 15 levels, the simulated camera has sigma = 0.96 levels (read noise 0.7, shot noise of A = 25
    /// levels at 58 electrons a level), so the low phase of two frequencies errs by sqrt(2/3) 0.96 / 15 264 / (2 pi) = 2.2 px, a
    /// sixth of 0.6 22 px = 13.2 px. In ambient light, A = 60 levels (B/A = 0.25), it is still 4.7 sigma. A ratio r of
    /// periods has 0.6 / (0.0083 r) sigma, six for 12; a beat of beats has the noise of 1 - 2 + 1 phases, sqrt(6) times one.
    #[test]
    fn at_the_least_modulation_no_kept_pixel_is_off_by_a_period() {
        let truth: Vec<f64> = (0..40_000).map(|i| 2.0 + 906.0 * f64::from(i) / 40_000.0).collect();
        for sequence in [
            PatternSequence::hierarchical(SIZE, Direction::Columns, 18.0, 10.0, 3),
            PatternSequence::hierarchical(SIZE, Direction::Columns, 18.0, 6.0, 3),
            PatternSequence::heterodyne(SIZE, Direction::Columns, 36.0, 4),
            PatternSequence::gray_phase(SIZE, Direction::Columns, 24.0, 4),
        ] {
            let (found, mask) = decode_levels(&sequence, Direction::Columns, &truth, [10.0, 41.0], 0.96);
            let kept: Vec<usize> = (0..truth.len()).filter(|&i| mask.is_kept(i)).collect();
            let finest_px = sequence.burst_period_px(&sequence.finest_burst());
            for &i in &kept {
                assert!((f64::from(found[i]) - truth[i]).abs() < 0.5 * finest_px, "{} for {}", found[i], truth[i]);
            }
            println!("{} pictures: {} of {} kept", sequence.patterns.len(), kept.len(), truth.len());
            // So near to the limit, noise puts many pixels below it.
            assert!(kept.len() > truth.len() / 5, "{:?}", mask.count());
        }
    }

    #[test]
    fn choices_that_the_sequence_does_not_allow_are_refused() {
        let make = |sequence: &PatternSequence, unwrap| {
            let processing = Processing { unwrap, ..Processing::default() };
            AbsoluteDecoder::with(&rig(), sequence, Direction::Columns, &Limits::default(), &processing)
        };
        let one = PatternSequence::n_step(SIZE, Direction::Columns, 300.0, 3);
        let decoder = make(&one, Unwrap::Geometric).unwrap().unwrap();
        let valid = decoder.valid_depth().unwrap();
        assert!(valid.near_mm < 510.0 && valid.far_mm > 690.0, "{valid:?}");
        assert!(make(&one, Unwrap::Spatial).is_ok());
        for unwrap in [Unwrap::Geometric, Unwrap::Spatial] {
            for sequence in [
                PatternSequence::two_frequency(SIZE, 264.0, 22.0, 3),
                PatternSequence::gray_code(SIZE, &[Direction::Columns]),
            ] {
                let error = make(&sequence, unwrap).unwrap_err().to_string();
                assert!(error.starts_with("processing.unwrap: "), "{error}");
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
