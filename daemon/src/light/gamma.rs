//! Phase errors of a projector whose light is no straight line of its input, measured on a flat board and taken away.
//!
//! The response bends the sinusoids, and the error of the wrapped phase that follows depends on that phase alone, not on albedo
//! or ambient light, so that one table serves every pixel (S. Zhang, S.-T. Yau, "Generic nonsinusoidal phase error correction
//! for three-dimensional shape measurement using a digital video projector", Applied Optics 46(1), 2007). On a plane the true
//! coordinate is smooth: a polynomial over the picture follows it with both lenses' distortion, and what a burst's phase
//! differs from it, averaged by wrapped phase, is the table. One for each burst, since defocus takes the harmonics from short
//! periods first.
//!
//! Without a table: six pictures as two bursts of three, 60 degrees apart, cancel the error of three steps, sin(3 phi), to
//! first order (double three-step, [`super::PatternSequence::double_three_step`]).

use super::mask::{PixelMask, Rejection};
use super::{LightError, Pattern};
use serde::{Deserialize, Serialize};
use std::f32::consts::TAU;

/// Entries of a table.
pub const BINS: usize = 256;

/// Least share of a picture that a board must fill.
const MIN_SHARE: f64 = 0.05;
/// Largest part of a period that a board's coordinates may differ from the smooth surface, root mean square.
const MAX_RMS_PERIODS: f64 = 0.15;
/// Largest error that a table may hold, radians: more is no projector's response.
const MAX_ERROR_RAD: f32 = 1.5;
/// Degree of the polynomial in each of column and row together.
const DEGREE: usize = 5;
/// Terms of the polynomial.
const TERMS: usize = (DEGREE + 1) * (DEGREE + 2) / 2;

/// Phase error of one burst.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BurstErrors {
    /// Fringe period, projector pixels.
    pub period_px: f64,
    /// Shift of every picture, radians; the half level of 2+1 has none and is left out.
    pub shifts_rad: Vec<f64>,
    /// Measured minus true phase, radians, at the middles of [`BINS`] equal parts of -pi to pi of the measured phase.
    pub error_rad: Vec<f32>,
}

/// Phase errors of a sequence's bursts.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GammaTable {
    /// One table a burst.
    pub bursts: Vec<BurstErrors>,
}

/// A decoded burst of a flat board.
#[derive(Debug, Clone, Copy)]
pub struct BoardPhase<'a> {
    /// The burst's patterns.
    pub patterns: &'a [Pattern],
    /// Wrapped phase of every camera pixel, radians.
    pub phase_rad: &'a [f32],
}

/// What a table does on the board that it was made of.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BoardFigures {
    /// Pixels of the board.
    pub pixels: usize,
    /// Phase of the finest burst against the smooth surface, radians, root mean square.
    pub before_rad: f64,
    /// The same with the table: the camera's noise is left.
    pub after_rad: f64,
}

fn shifts_of(patterns: &[Pattern]) -> Vec<f64> {
    patterns.iter().filter_map(Pattern::shift_rad).collect()
}

impl GammaTable {
    /// Reads a table.
    ///
    /// # Errors
    /// [`LightError`] for text that is no table, or values that cannot be one.
    pub fn from_toml(text: &str) -> Result<Self, LightError> {
        let table: Self = toml::from_str(text).map_err(|e| {
            let line = 1 + e.span().map_or(0, |span| text[..span.start].matches('\n').count());
            LightError::Toml(format!("line {line}: {}", e.message()))
        })?;
        table.validate()?;
        Ok(table)
    }

    /// The table as TOML; [`Self::from_toml`] gives back the same.
    ///
    /// # Errors
    /// [`LightError::Toml`] when a number has no TOML form.
    pub fn to_toml(&self) -> Result<String, LightError> {
        toml::to_string(self).map_err(|e| LightError::Toml(e.to_string()))
    }

    /// Checks sizes and values.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the entry.
    pub fn validate(&self) -> Result<(), LightError> {
        for (i, burst) in self.bursts.iter().enumerate() {
            let field = |name: &str| format!("gamma.bursts[{i}].{name}");
            if burst.error_rad.len() != BINS {
                let reason = format!("{} entries, expected {BINS}", burst.error_rad.len());
                return Err(LightError::field(field("error_rad"), reason));
            }
            if let Some(k) = burst.error_rad.iter().position(|e| e.is_nan() || e.abs() > MAX_ERROR_RAD) {
                let reason =
                    format!("entry {k} is {}, expected -{MAX_ERROR_RAD} to {MAX_ERROR_RAD}", burst.error_rad[k]);
                return Err(LightError::field(field("error_rad"), reason));
            }
        }
        Ok(())
    }

    /// The table of a burst.
    ///
    /// # Errors
    /// [`LightError::Field`] when the table was made for other patterns.
    pub fn of_burst(&self, patterns: &[Pattern]) -> Result<&BurstErrors, LightError> {
        let (period_px, shifts) = (patterns.first().and_then(Pattern::period_px), shifts_of(patterns));
        let same = |a: &[f64], b: &[f64]| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        let found = self.bursts.iter().find(|b| Some(b.period_px) == period_px && same(&b.shifts_rad, &shifts));
        found.ok_or_else(|| {
            let period_px = period_px.unwrap_or(f64::NAN);
            let reason = format!(
                "the table has no burst of period {period_px} px in {} pictures with these shifts; make it again with this \
                 sequence (gv3 calibrate-gamma)",
                patterns.len()
            );
            LightError::field("gamma.bursts", reason)
        })
    }

    /// Measures the table of `bursts`, coarse to fine, on a flat board with coordinates `coordinate_px` decoded from them.
    ///
    /// # Errors
    /// [`LightError::Field`] when too little of the board is seen, or it is no smooth surface.
    ///
    /// # Panics
    /// When a slice is not of the mask's size.
    pub fn measure(
        bursts: &[BoardPhase<'_>],
        coordinate_px: &[f32],
        mask: &PixelMask,
    ) -> Result<(Self, BoardFigures), LightError> {
        let periods: Vec<f64> = bursts.iter().filter_map(|b| b.patterns.first()?.period_px()).collect();
        let Some(&finest_px) = periods.last().filter(|_| periods.len() == bursts.len()) else {
            return Err(LightError::field("gamma", "the sequence has no fringes along the coded direction"));
        };
        let board = Board::fit(coordinate_px, mask, finest_px)?;
        let mut table = Self::default();
        let mut figures = BoardFigures { pixels: board.pixels.len(), before_rad: 0.0, after_rad: 0.0 };
        for (burst, period_px) in bursts.iter().zip(periods) {
            let errors = board.errors(burst.phase_rad, period_px);
            let error_rad = tabulate(&errors);
            let one = BurstErrors { period_px, shifts_rad: shifts_of(burst.patterns), error_rad };
            let left = errors.iter().map(|&(phase_rad, error)| (phase_rad, error - f64::from(one.at(phase_rad))));
            figures.after_rad = rms(left);
            figures.before_rad = rms(errors.iter().copied());
            table.bursts.push(one);
        }
        table.validate()?;
        Ok((table, figures))
    }
}

fn rms(errors: impl Iterator<Item = (f32, f64)>) -> f64 {
    let (sum, count) = errors.fold((0.0, 0usize), |(sum, count), (_, e)| (sum + e * e, count + 1));
    (sum / count.max(1) as f64).sqrt()
}

impl BurstErrors {
    /// Error at a measured phase, radians, between entries by a straight line.
    #[inline]
    fn at(&self, phase_rad: f32) -> f32 {
        let x = (phase_rad * (1.0 / TAU) + 0.5) * BINS as f32 - 0.5;
        // x is -0.5 to 255.5; truncation of a value above zero is its floor.
        let floor = (x + BINS as f32) as usize;
        let part = x + BINS as f32 - floor as f32;
        let (low, high) = (self.error_rad[floor % BINS], self.error_rad[(floor + 1) % BINS]);
        low + part * (high - low)
    }

    /// Takes the error from every phase, radians; a corrected phase may reach beyond pi by as much.
    pub fn correct(&self, phase_rad: &mut [f32]) {
        /// 1.5 * 2^23: added to a number it leaves the nearest whole number in the low bits of the mantissa.
        const ROUNDER: f32 = 12_582_912.0;
        const GROUP: usize = 64;
        // Value and rise to the next entry, beginning with the last; twice, so that no place needs a test of its range.
        let line = |k: usize| {
            let (low, high) = (self.error_rad[(k + BINS - 1) % BINS], self.error_rad[k % BINS]);
            [low, high - low]
        };
        let lines: [[f32; 2]; 2 * BINS] = std::array::from_fn(line);
        let (mut places, mut parts) = ([0u32; GROUP], [0.0f32; GROUP]);
        for group in phase_rad.chunks_mut(GROUP) {
            for ((phase, place), part) in group.iter().zip(&mut places).zip(&mut parts) {
                let x = phase * (BINS as f32 / TAU) + (0.5 * BINS as f32 + 0.5);
                let rounded = x - 0.5 + ROUNDER;
                *place = rounded.to_bits();
                *part = x - (rounded - ROUNDER);
            }
            for ((phase, place), part) in group.iter_mut().zip(&places).zip(&parts) {
                let [low, rise] = lines[*place as usize % (2 * BINS)];
                *phase -= low + part * rise;
            }
        }
    }
}

/// Mean error by measured phase; gaps are bridged, so a table of one hump is as good as its board.
fn tabulate(errors: &[(f32, f64)]) -> Vec<f32> {
    let mut bins = [(0.0f64, 0u32); BINS];
    for &(phase_rad, error) in errors {
        let bin = ((phase_rad / TAU + 0.5) * BINS as f32).clamp(0.0, (BINS - 1) as f32) as usize;
        bins[bin].0 += error;
        bins[bin].1 += 1;
    }
    let mean = |bin: usize| (bins[bin].1 > 0).then(|| bins[bin].0 / f64::from(bins[bin].1));
    let fill = |bin: usize| {
        let before = (0..BINS).find_map(|d| Some((d, mean((bin + BINS - d) % BINS)?)));
        let after = (0..BINS).find_map(|d| Some((d, mean((bin + d) % BINS)?)));
        match (before, after) {
            (Some((0, value)), _) => value,
            (Some((a, low)), Some((b, high))) => (low * b as f64 + high * a as f64) / (a + b) as f64,
            _ => 0.0,
        }
    };
    (0..BINS).map(|bin| fill(bin) as f32).collect()
}

/// Pixels of the board and their true coordinates.
struct Board {
    pixels: Vec<usize>,
    true_px: Vec<f64>,
}

impl Board {
    /// Fits a polynomial to the coordinates, three times without what the fit before was off by more than 3 sigma.
    fn fit(coordinate_px: &[f32], mask: &PixelMask, finest_px: f64) -> Result<Self, LightError> {
        assert_eq!(coordinate_px.len(), mask.verdicts.len(), "coordinates and mask differ in size");
        let size = [mask.width_px, mask.height_px];
        let mut pixels: Vec<usize> = (0..coordinate_px.len()).filter(|&i| mask.is_kept(i)).collect();
        let mut rounds = 0;
        loop {
            let share = pixels.len() as f64 / coordinate_px.len().max(1) as f64;
            if share < MIN_SHARE {
                let reason =
                    format!("a flat board fills {:.1} % of the picture; it must fill 5 % or more", 100.0 * share);
                return Err(LightError::field("board", reason));
            }
            let Some(surface) = Polynomial::fit(&pixels, coordinate_px, size) else {
                return Err(LightError::field("board", "its pixels lie on a line; show more of it"));
            };
            let true_px: Vec<f64> = pixels.iter().map(|&i| surface.at(i)).collect();
            let error = |(&i, true_px): (&usize, &f64)| (f64::from(coordinate_px[i]) - true_px).abs();
            let square: f64 = pixels.iter().zip(&true_px).map(|pair| error(pair).powi(2)).sum();
            let rms_px = (square / pixels.len() as f64).sqrt();
            rounds += 1;
            if rounds == 4 && rms_px <= MAX_RMS_PERIODS * finest_px {
                return Ok(Self { pixels, true_px }.with_misordered(&surface, coordinate_px, mask, finest_px));
            } else if rounds == 4 {
                let reason =
                    "its coordinates are no smooth surface; take a flat, evenly lit board that fills the picture";
                return Err(LightError::field("board", reason));
            }
            let good = pixels.iter().zip(&true_px).filter(|&pair| error(pair) <= 3.0 * rms_px);
            pixels = good.map(|(&i, _)| i).collect();
        }
    }

    /// Adds pixels of the board whose frequencies disagree: that is where the errors are largest.
    fn with_misordered(
        mut self,
        surface: &Polynomial,
        coordinate_px: &[f32],
        mask: &PixelMask,
        finest_px: f64,
    ) -> Self {
        for i in (0..coordinate_px.len()).filter(|&i| mask.verdicts[i] == Rejection::FringeOrder) {
            let true_px = surface.at(i);
            if (f64::from(coordinate_px[i]) - true_px).abs() < 1.5 * finest_px {
                self.pixels.push(i);
                self.true_px.push(true_px);
            }
        }
        self
    }

    /// Measured phase and its error of every pixel.
    fn errors(&self, phase_rad: &[f32], period_px: f64) -> Vec<(f32, f64)> {
        let one = |(&i, &true_px): (&usize, &f64)| {
            let turns = f64::from(phase_rad[i]) / f64::from(TAU) - true_px / period_px;
            (phase_rad[i], (turns - turns.round()) * f64::from(TAU))
        };
        self.pixels.iter().zip(&self.true_px).map(one).collect()
    }
}

/// A polynomial over the picture, as products of Legendre polynomials, which keep the equations well conditioned.
struct Polynomial {
    size: [usize; 2],
    coefficients: [f64; TERMS],
}

impl Polynomial {
    fn terms(size: [usize; 2], i: usize) -> [f64; TERMS] {
        let scaled = |v: usize, n: usize| 2.0 * v as f64 / (n.max(2) - 1) as f64 - 1.0;
        let legendre = |x: f64| {
            let mut p = [1.0, x, 0.0, 0.0, 0.0, 0.0];
            for k in 2..=DEGREE {
                p[k] = ((2 * k - 1) as f64 * x * p[k - 1] - (k - 1) as f64 * p[k - 2]) / k as f64;
            }
            p
        };
        let (px, py) = (legendre(scaled(i % size[0], size[0])), legendre(scaled(i / size[0], size[1])));
        let mut terms = [0.0; TERMS];
        let mut k = 0;
        for (a, x) in px.iter().enumerate() {
            for y in &py[..=DEGREE - a] {
                terms[k] = x * y;
                k += 1;
            }
        }
        terms
    }

    /// Least squares; `None` when the pixels do not determine it.
    fn fit(pixels: &[usize], coordinate_px: &[f32], size: [usize; 2]) -> Option<Self> {
        let mut normal = [[0.0f64; TERMS + 1]; TERMS];
        // A few ten thousand pixels fix 21 numbers as well as all.
        for &i in pixels.iter().step_by(1 + pixels.len() / 60_000) {
            let terms = Self::terms(size, i);
            for (row, a) in normal.iter_mut().zip(terms) {
                for (cell, b) in row.iter_mut().zip(terms) {
                    *cell += a * b;
                }
                row[TERMS] += a * f64::from(coordinate_px[i]);
            }
        }
        Some(Self { size, coefficients: solve(normal)? })
    }

    fn at(&self, i: usize) -> f64 {
        Self::terms(self.size, i).iter().zip(self.coefficients).map(|(t, c)| t * c).sum()
    }
}

/// Gauss-Jordan elimination of positive definite equations.
fn solve(mut rows: [[f64; TERMS + 1]; TERMS]) -> Option<[f64; TERMS]> {
    for k in 0..TERMS {
        let pivot = rows[k][k];
        if pivot.is_nan() || pivot < 1e-9 {
            return None;
        }
        rows[k].iter_mut().for_each(|v| *v /= pivot);
        let row = rows[k];
        for (_, other) in rows.iter_mut().enumerate().filter(|(i, _)| *i != k) {
            let factor = other[k];
            other.iter_mut().zip(row).for_each(|(v, r)| *v -= factor * r);
        }
    }
    Some(rows.map(|row| row[TERMS]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::{Direction, PatternSequence};

    const W: usize = 160;
    const H: usize = 120;

    /// Coordinates of a board seen in perspective, and the phases of two bursts with errors of 0.2 sin(3 phi).
    fn board() -> (Vec<f64>, PatternSequence, [Vec<f32>; 2]) {
        let at = |i: usize| {
            let (x, y) = ((i % W) as f64 / W as f64, (i / W) as f64 / H as f64);
            (200.0 + 300.0 * x + 20.0 * y) / (1.0 + 0.2 * x - 0.05 * y)
        };
        let truth: Vec<f64> = (0..W * H).map(at).collect();
        let phases = [264.0, 22.0].map(|period| {
            let measured = |u: &f64| {
                let turns = u / period;
                let phi = (turns - turns.round()) * f64::from(TAU);
                let phi = phi + 0.2 * (3.0 * phi).sin();
                (phi - f64::from(TAU) * (phi / f64::from(TAU)).round()) as f32
            };
            truth.iter().map(measured).collect()
        });
        (truth, PatternSequence::two_frequency([912, 1140], 264.0, 22.0, 3), phases)
    }

    #[test]
    fn the_error_of_a_plane_is_found_and_taken_away() {
        let (truth, sequence, mut phases) = board();
        let coordinate = |(u, phi): (&f64, &f32)| {
            let turns = f64::from(*phi) / f64::from(TAU);
            ((turns + (u / 22.0 - turns).round()) * 22.0) as f32
        };
        let mut columns: Vec<f32> = truth.iter().zip(&phases[1]).map(coordinate).collect();
        let mut mask = PixelMask::new(W, H);
        // A corner is no board, and some orders are wrong.
        for i in (0..W * H).filter(|i| i % W < 30 && i / W < 20) {
            mask.verdicts[i] = Rejection::LowModulation;
        }
        (0..50).for_each(|k| columns[3000 + 71 * k] += 22.0);
        let patterns = [&sequence.patterns[..3], &sequence.patterns[3..]];
        let bursts = [0, 1].map(|k| BoardPhase { patterns: patterns[k], phase_rad: &phases[k] });
        let (table, figures) = GammaTable::measure(&bursts, &columns, &mask).unwrap();
        assert!(figures.before_rad > 0.13 && figures.after_rad < 0.006, "{figures:?}");
        let back = GammaTable::from_toml(&table.to_toml().unwrap()).unwrap();
        assert_eq!(back, table);
        for (k, period) in [264.0, 22.0].into_iter().enumerate() {
            let errors = back.of_burst(patterns[k]).unwrap();
            errors.correct(&mut phases[k]);
            let error = |(u, phi): (&f64, &f32)| {
                let turns = f64::from(*phi) / f64::from(TAU) - u / period;
                (turns - turns.round()).abs() * f64::from(TAU)
            };
            let worst = truth.iter().zip(&phases[k]).map(error).fold(0.0, f64::max);
            assert!(worst < 0.05, "{worst} rad at period {period}");
        }
    }

    #[test]
    fn correcting_takes_away_what_the_table_says_at_every_phase() {
        let error_rad: Vec<f32> = (0..BINS).map(|i| (i * 37 % 101) as f32 * 1e-3).collect();
        let errors = BurstErrors { period_px: 22.0, shifts_rad: Vec::new(), error_rad };
        let phases: Vec<f32> = (-1000..=1000).map(|i| i as f32 * (0.5 * TAU / 1000.0)).collect();
        let mut corrected = phases.clone();
        errors.correct(&mut corrected);
        for (phase, corrected) in phases.iter().zip(corrected) {
            assert!((phase - errors.at(*phase) - corrected).abs() < 2e-5, "{phase}: {corrected}");
        }
    }

    #[test]
    fn what_is_no_board_or_no_table_is_refused() {
        let (_, sequence, phases) = board();
        let patterns = &sequence.patterns[3..];
        let mask = PixelMask::new(W, H);
        let error = |columns: &[f32], mask: &PixelMask| {
            let burst = BoardPhase { patterns, phase_rad: &phases[1] };
            GammaTable::measure(&[burst], columns, mask).unwrap_err().to_string()
        };
        let rough: Vec<f32> = (0..W * H).map(|i| (i * 7919 % 500) as f32).collect();
        assert!(error(&rough, &mask).contains("no smooth surface"));
        let mut empty = mask.clone();
        empty.verdicts.fill(Rejection::Shadow);
        assert!(error(&rough, &empty).contains("fills 0.0 %"));
        let table = |count: usize, value: f32| GammaTable {
            bursts: vec![BurstErrors {
                period_px: 22.0,
                shifts_rad: shifts_of(patterns),
                error_rad: vec![value; count],
            }],
        };
        assert!(table(255, 0.0).validate().unwrap_err().to_string().contains("255 entries"));
        assert!(table(BINS, f32::NAN).validate().unwrap_err().to_string().contains("entry 0 is NaN"));
        let other = PatternSequence::n_step([912, 1140], Direction::Columns, 20.0, 3);
        let error = table(BINS, 0.0).of_burst(&other.patterns).unwrap_err().to_string();
        assert!(error.contains("no burst of period 20 px"), "{error}");
        assert!(GammaTable::from_toml("bursts = 3").is_err());
    }
}
