//! Pattern sequences in use.

use super::pattern::{Direction, Pattern, PatternKind, PatternSequence, gray_bits};
use std::f64::consts::{FRAC_PI_2, TAU};

/// Spare part of a period that covers the whole projector, so that noise at either edge cannot wrap.
const SPARE: f64 = 1.1;

/// `steps` sinusoids that divide the circle evenly.
fn burst(period_px: f64, steps: u32, direction: Direction) -> impl Iterator<Item = Pattern> {
    (0..steps).map(move |n| Pattern::sinusoid(period_px, TAU * f64::from(n) / f64::from(steps), direction))
}

/// Bits of the Gray code from the most significant down to `last_bit`, each followed by its inverse.
fn gray_pairs(length_px: u32, last_bit: u32, direction: Direction) -> impl Iterator<Item = Pattern> {
    let pair = move |bit| [false, true].map(|inverse| Pattern { kind: PatternKind::Gray { bit, inverse }, direction });
    (last_bit..gray_bits(length_px)).rev().flat_map(pair)
}

impl PatternSequence {
    fn of(size_px: [u32; 2], patterns: Vec<Pattern>) -> Self {
        Self { width_px: size_px[0], height_px: size_px[1], patterns }
    }

    fn length_of(size_px: [u32; 2], direction: Direction) -> u32 {
        match direction {
            Direction::Columns => size_px[0],
            Direction::Rows => size_px[1],
        }
    }

    /// One burst of `steps` sinusoids; absolute only by a working range.
    pub fn n_step(size_px: [u32; 2], direction: Direction, period_px: f64, steps: u32) -> Self {
        Self::of(size_px, burst(period_px, steps, direction).collect())
    }

    /// Two bursts of three sinusoids, the second 60 degrees after the first, after P. S. Huang, Q. J. Hu, F.-P. Chiang, "Double
    /// three-step phase-shifting algorithm", Applied Optics 41(22), 2002: the error of three steps under a projector's gamma,
    /// sin(3 phi), has opposite signs in both. Averaging their sums instead of their angles is the same to first order, and
    /// makes the six one even burst with the noise of six steps.
    pub fn double_three_step(size_px: [u32; 2], direction: Direction, period_px: f64) -> Self {
        let three = |first_rad: f64| (0..3).map(move |n| first_rad + TAU * f64::from(n) / 3.0);
        let shifts = three(0.0).chain(three(TAU / 6.0));
        Self::of(size_px, shifts.map(|shift_rad| Pattern::sinusoid(period_px, shift_rad, direction)).collect())
    }

    /// Two sinusoids a quarter period apart and the half level, after S. Zhang and S.-T. Yau, "High-speed three-dimensional
    /// shape measurement system using a modified two-plus-one phase-shifting algorithm", Optical Engineering 46(11), 2007.
    pub fn two_plus_one(size_px: [u32; 2], direction: Direction, period_px: f64) -> Self {
        let sinusoids = [0.0, -FRAC_PI_2].map(|shift_rad| Pattern::sinusoid(period_px, shift_rad, direction));
        Self::of(size_px, sinusoids.into_iter().chain([Pattern::flat(PatternKind::Half)]).collect())
    }

    /// Two frequencies, `steps` pictures each, columns: the low frequency first, so that a scan's time is the middle of the
    /// high-frequency exposures, which give its surface and texture.
    pub fn two_frequency(size_px: [u32; 2], low_period_px: f64, high_period_px: f64, steps: u32) -> Self {
        let direction = Direction::Columns;
        let low = burst(low_period_px, steps, direction);
        Self::of(size_px, low.chain(burst(high_period_px, steps, direction)).collect())
    }

    /// Periods `finest_px ratio^k`, the longest first and covering the whole projector, after J. M. Huntley and
    /// H. Saldner, "Temporal phase-unwrapping algorithm for automated interferogram analysis", Applied Optics 32(17), 1993.
    pub fn hierarchical(size_px: [u32; 2], direction: Direction, finest_px: f64, ratio: f64, steps: u32) -> Self {
        let whole_px = SPARE * f64::from(Self::length_of(size_px, direction));
        let count = ((whole_px / finest_px).ln() / ratio.ln()).ceil().clamp(0.0, 64.0) as i32;
        let periods = (0..=count).rev().map(|k| finest_px * ratio.powi(k));
        Self::of(size_px, periods.flat_map(|period_px| burst(period_px, steps, direction)).collect())
    }

    /// Three periods whose beats cover the projector: N - sqrt(N), N - 1 and N fringes, after C. E. Towers, D. P. Towers,
    /// J. D. C. Jones, "Absolute fringe order calculation using optimised multi-frequency selection in full-field
    /// profilometry", Optics and Lasers in Engineering 43(7), 2005.
    pub fn heterodyne(size_px: [u32; 2], direction: Direction, finest_px: f64, steps: u32) -> Self {
        let whole_px = SPARE * f64::from(Self::length_of(size_px, direction));
        let fringes = whole_px / finest_px;
        let counts = [fringes - fringes.sqrt(), fringes - 1.0, fringes];
        Self::of(size_px, counts.into_iter().flat_map(|n| burst(whole_px / n, steps, direction)).collect())
    }

    /// Gray code with inverses, most significant bit first, a direction after the other, then white and black.
    pub fn gray_code(size_px: [u32; 2], directions: &[Direction]) -> Self {
        let code = directions.iter().flat_map(|&d| gray_pairs(Self::length_of(size_px, d), 0, d));
        Self::of(size_px, code.chain([PatternKind::White, PatternKind::Black].map(Pattern::flat)).collect())
    }

    /// Gray code with inverses down to half a fringe period or finer, white, black, then one burst of sinusoids. Code edges
    /// twice a period keep the fringe order safe at each (the half-period correction).
    pub fn gray_phase(size_px: [u32; 2], direction: Direction, period_px: f64, steps: u32) -> Self {
        let length_px = Self::length_of(size_px, direction);
        let last_bit =
            (0..gray_bits(length_px)).rev().find(|&bit| f64::from(1u32 << bit) <= 0.5 * period_px).unwrap_or(0);
        let code = gray_pairs(length_px, last_bit, direction);
        let flat = [PatternKind::White, PatternKind::Black].map(Pattern::flat);
        Self::of(size_px, code.chain(flat).chain(burst(period_px, steps, direction)).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_scheme_is_valid_on_any_projector() {
        for size_px in [[912, 1140], [1024, 768], [1920, 1080], [608, 684]] {
            for d in [Direction::Columns, Direction::Rows] {
                let length = f64::from(PatternSequence::length_of(size_px, d));
                for sequence in [
                    PatternSequence::n_step(size_px, d, 18.0, 5),
                    PatternSequence::two_plus_one(size_px, d, 36.0),
                    PatternSequence::double_three_step(size_px, d, 36.0),
                    PatternSequence::hierarchical(size_px, d, 16.0, 5.0, 3),
                    PatternSequence::heterodyne(size_px, d, 20.0, 4),
                    PatternSequence::gray_code(size_px, &[d]),
                    PatternSequence::gray_phase(size_px, d, 24.0, 4),
                ] {
                    sequence.validate().unwrap();
                }
                let h = PatternSequence::hierarchical(size_px, d, 16.0, 5.0, 3);
                assert!(h.patterns[0].period_px().unwrap() >= length);
                let b = PatternSequence::heterodyne(size_px, d, 20.0, 3);
                let beat = 1.0 / (1.0 / b.patterns[6].period_px().unwrap() - 1.0 / b.patterns[3].period_px().unwrap());
                assert!((beat / length - SPARE).abs() < 1e-9);
            }
        }
    }
}
