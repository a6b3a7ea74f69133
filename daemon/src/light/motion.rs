//! Phase shifting on a moving surface.
//!
//! While the N pictures of a burst are taken, the phase of a camera pixel drifts by w radians a picture. To first order an even
//! burst then errs by w [mean(t) - mean(t_n cos(2 phi + 2 shift_n))], with times t_n in pictures from the burst's middle: no
//! bias, but a ripple of twice the fringe frequency, for three steps of amplitude w / sqrt(3) (the shift errors e_n = w t_n in
//! Creath, Progress in Optics 26, 1988).
//!
//! Here w is measured: the coordinate of the same pixel in the frame set before gives the rate, averaged over a window since
//! neighbours move alike. With I_n = A + B cos(phi + shift_n + w t_n) both sums of phase shifting stay linear in cos phi and
//! sin phi, with factors that depend on w alone, here as polynomials of third order; their 2 x 2 system gives phi exactly.
//! T. Weise, B. Leibe, L. Van Gool, "Fast 3D scanning with automatic motion compensation", CVPR 2007, correct the same drift with
//! a rate found within the set; with one camera it comes from the set before.
//!
//! Distance of the simulated head's scans from the truth, mm root mean square, when the whole head moves. At rest it is the
//! noise: 0.048 mm for six pictures a set, 0.290 mm for three of one long period (config/three-pattern.toml). The mean stays
//! within 0.06 mm:
//!
//! | mm/s | 6, depth | corrected | 6, sideways | corrected | 3, depth | corrected | 3, sideways | corrected |
//! |---|---|---|---|---|---|---|---|---|
//! | 0 | 0.048 | 0.048 | 0.048 | 0.048 | 0.290 | 0.290 | 0.290 | 0.290 |
//! | 25 | 0.068 | 0.048 | 0.061 | 0.057 | 0.293 | 0.289 | 0.330 | 0.330 |
//! | 50 | 0.107 | 0.048 | 0.086 | 0.075 | 0.306 | 0.292 | 0.404 | 0.402 |
//! | 100 | 0.192 | 0.050 | 0.141 | 0.114 | 0.352 | 0.299 | 0.546 | 0.540 |
//! | 200 | 0.347 | 0.057 | 0.240 | 0.187 | 0.490 | 0.326 | 0.772 | 0.758 |
//!
//! (`cargo test -p gv3 --test live_schemes -- --ignored --nocapture motion_table`.) The rate is a mean over a window, so that
//! its noise adds nothing that can be seen at rest. What the correction cannot do: albedo and outlines that move through a
//! pixel, which rule sideways motion (the table leaves out what is more than 5 mm off at outlines: of 113,000 vertices of six
//! pictures 42 at 100 mm/s and 566 at 200 mm/s, corrected or not, which make 0.35 and 1.9 mm rms of all); acceleration between
//! sets, since the rate is half a set old; the first set of a run, and one after a gap of more than [`MAX_GAP_SETS`]. Gray code and
//! multi-frequency sequences of many pictures are for things at rest: their fringe orders come from long before the fringes.

use super::mask::{PixelMask, Rejection};
use super::phase::{PhaseExtractor, atan2_rad};
use super::{LightError, Pattern};
use std::f32::consts::TAU;

/// Largest number of scan periods between two frame sets whose rate is used.
pub const MAX_GAP_SETS: u64 = 2;

/// Half the side of the window in which rates are averaged, pixels.
const WINDOW_PX: usize = 8;

/// Pixels that are told together to have no rate.
const GROUP_PX: usize = 32;

/// Largest drift between the middle and the end of a burst, radians; more is a depth edge passing by, not a moving surface.
const MAX_DRIFT_RAD: f32 = 1.0;

/// Corrects projector coordinates of consecutive frame sets for motion within each.
#[derive(Debug, Clone)]
pub struct MotionCorrector {
    width_px: usize,
    period_px: f32,
    pictures_per_set: f32,
    max_rate_px: f32,
    system: RateSystem,
    previous_tick: Option<u64>,
    /// Corrected coordinates of the set before; NaN where there were none.
    previous_px: Vec<f32>,
    /// Change of the coordinate, px a picture; NaN where unknown.
    rate_px: Vec<f32>,
    window: Window,
}

/// Factors of cos phi and sin phi in both sums of phase shifting, as polynomials of the rate in radians a picture.
#[derive(Debug, Clone, Copy)]
struct RateSystem {
    sine_by_cos: [f32; 4],
    sine_by_sin: [f32; 4],
    cosine_by_cos: [f32; 4],
    cosine_by_sin: [f32; 4],
}

impl RateSystem {
    fn new(burst: &[Pattern], extractor: &PhaseExtractor) -> Self {
        let mut out = [[0.0f64; 4]; 4];
        let middle = 0.5 * (burst.len() as f64 - 1.0);
        let weights = extractor.weights();
        for ((n, pattern), (sine, cosine)) in burst.iter().enumerate().zip(weights) {
            // The half level does not change with the phase.
            let Some(shift_rad) = pattern.shift_rad() else { continue };
            let (s, c) = shift_rad.sin_cos();
            let t = n as f64 - middle;
            let powers = [1.0, t, t * t / 2.0, t * t * t / 6.0];
            // Derivatives of cos and of -sin at the shift.
            let by_cos = [c, -s, -c, s];
            let by_sin = [-s, -c, s, c];
            for k in 0..4 {
                out[0][k] += f64::from(sine) * by_cos[k] * powers[k];
                out[1][k] += f64::from(sine) * by_sin[k] * powers[k];
                out[2][k] += f64::from(cosine) * by_cos[k] * powers[k];
                out[3][k] += f64::from(cosine) * by_sin[k] * powers[k];
            }
        }
        let [sine_by_cos, sine_by_sin, cosine_by_cos, cosine_by_sin] = out.map(|row| row.map(|v| v as f32));
        Self { sine_by_cos, sine_by_sin, cosine_by_cos, cosine_by_sin }
    }

    /// What to add to a phase measured as `turns` periods while it drifted by `rate_rad` a picture, radians.
    #[inline]
    fn correction_rad(&self, turns: f32, rate_rad: f32) -> f32 {
        let (sin, cos) = sin_cos(turns);
        let at = |p: [f32; 4]| p[0] + rate_rad * (p[1] + rate_rad * (p[2] + rate_rad * p[3]));
        let (a, b) = (at(self.sine_by_cos), at(self.sine_by_sin));
        let (c, d) = (at(self.cosine_by_cos), at(self.cosine_by_sin));
        // The measured sums are -sin and cos, to a common factor; Cramer's rule for the true cosine and sine.
        let (y, x) = (c * sin + a * cos, -d * sin - b * cos);
        atan2_rad(y * cos - x * sin, x * cos + y * sin)
    }

    fn correct_group(&self, rates_px: &[f32], period_px: f32, coordinate_px: &mut [f32]) {
        let per_period = 1.0 / period_px;
        for (coordinate, rate_px) in coordinate_px.iter_mut().zip(rates_px) {
            let turns = *coordinate * per_period;
            let correction_rad = self.correction_rad(turns, rate_px * (TAU * per_period));
            *coordinate += correction_rad * period_px * (1.0 / TAU);
        }
    }
}

/// Sine and cosine of an angle in periods, within 4e-6.
#[inline]
fn sin_cos(turns: f32) -> (f32, f32) {
    /// Adding and taking away 1.5 * 2^23 rounds to the nearest whole number.
    const ROUNDER: f32 = 12_582_912.0;
    // Taylor polynomial of degree 9, for a quarter period either way.
    let sine = |quarter: f32| {
        let x = TAU * quarter;
        let x2 = x * x;
        x * (1.0 + x2 * (-1.0 / 6.0 + x2 * (1.0 / 120.0 + x2 * (-1.0 / 5040.0 + x2 * (1.0 / 362_880.0)))))
    };
    let f = turns - ((turns + ROUNDER) - ROUNDER);
    let size = f.abs();
    let s = sine(if size > 0.25 { 0.5 - size } else { size });
    (if f < 0.0 { -s } else { s }, sine(0.25 - size))
}

impl MotionCorrector {
    /// A corrector for coordinates whose finest fringes are `burst`, of a sequence of `pictures_per_set` pictures at an even
    /// pace.
    ///
    /// # Errors
    /// [`LightError::Field`] when `burst` is no burst of sinusoids.
    pub fn new(size_px: [usize; 2], burst: &[Pattern], pictures_per_set: usize) -> Result<Self, LightError> {
        let extractor = PhaseExtractor::new(burst, super::MaskLimits::default())?;
        let period_px = burst.first().and_then(Pattern::period_px);
        let Some(period_px) = period_px else {
            return Err(LightError::field("processing.motion", "needs a sequence that ends in fringes"));
        };
        let pixels = size_px[0] * size_px[1];
        let period_px = period_px as f32;
        let max_rate_rad = MAX_DRIFT_RAD / (0.5 * (burst.len() as f32 - 1.0));
        Ok(Self {
            width_px: size_px[0],
            period_px,
            pictures_per_set: pictures_per_set as f32,
            max_rate_px: max_rate_rad * period_px / TAU,
            system: RateSystem::new(burst, &extractor),
            previous_tick: None,
            previous_px: vec![f32::NAN; pixels],
            rate_px: vec![f32::NAN; pixels],
            window: Window::new(size_px[0]),
        })
    }

    /// Corrects the coordinates of the frame set of `tick`, px, where they are kept; sets come in the order of their ticks.
    ///
    /// # Panics
    /// When mask or coordinates are not of the size given to [`Self::new`].
    pub fn correct(&mut self, tick: u64, mask: &PixelMask, coordinate_px: &mut [f32]) {
        assert!(coordinate_px.len() == self.previous_px.len() && mask.verdicts.len() == coordinate_px.len());
        let gap = self.previous_tick.and_then(|previous| tick.checked_sub(previous));
        if let Some(sets) = gap.filter(|sets| (1..=MAX_GAP_SETS).contains(sets)) {
            self.measure_rates(sets as f32 * self.pictures_per_set, mask, coordinate_px);
            let (w, rows) = (self.width_px, coordinate_px.len() / self.width_px);
            for y in 0..rows {
                let rates = self.window.row_means(&self.rate_px, y);
                let row = &mut coordinate_px[y * w..(y + 1) * w];
                for (coordinates, rates) in row.chunks_mut(GROUP_PX).zip(rates.chunks(GROUP_PX)) {
                    // Around the head, where nothing is known, is about half of the picture.
                    if rates.iter().any(|&rate| rate != 0.0) {
                        self.system.correct_group(rates, self.period_px, coordinates);
                    }
                }
            }
        }
        self.previous_tick = Some(tick);
        for ((previous, &now), verdict) in self.previous_px.iter_mut().zip(&*coordinate_px).zip(&mask.verdicts) {
            *previous = if *verdict == Rejection::Kept { now } else { f32::NAN };
        }
    }

    fn measure_rates(&mut self, pictures: f32, mask: &PixelMask, coordinate_px: &[f32]) {
        let (per_picture, max_rate_px) = (1.0 / pictures, self.max_rate_px);
        let pixels = self.rate_px.iter_mut().zip(&self.previous_px).zip(coordinate_px.iter().zip(&mask.verdicts));
        for ((rate, previous), (now, verdict)) in pixels {
            let value = (now - previous) * per_picture;
            let is_known = (value.abs() <= max_rate_px) & (*verdict == Rejection::Kept);
            *rate = if is_known { value } else { f32::NAN };
        }
    }
}

/// Means over square windows that ignore NaN: running sums down the columns, and along a row sums of 2, 4, 8, 16 and 17.
#[derive(Debug, Clone)]
struct Window {
    width_px: usize,
    /// Sums and counts of the columns, with zeros for [`WINDOW_PX`] pixels beyond either end of the row.
    sums: Vec<f32>,
    counts: Vec<f32>,
    /// Sums and counts over windows that begin at each place.
    wide_sums: Vec<f32>,
    wide_counts: Vec<f32>,
    means: Vec<f32>,
}

impl Window {
    fn new(width_px: usize) -> Self {
        let padded = vec![0.0; width_px + 2 * WINDOW_PX];
        Self {
            width_px,
            sums: padded.clone(),
            counts: padded.clone(),
            wide_sums: padded.clone(),
            wide_counts: padded,
            means: vec![0.0; width_px],
        }
    }

    /// Means around the pixels of row `y`, 0 where nothing is known. Rows are to be asked for in order from 0.
    fn row_means(&mut self, values: &[f32], y: usize) -> &[f32] {
        let (w, reach) = (self.width_px, WINDOW_PX);
        let rows = values.len() / w;
        if y == 0 {
            self.sums.fill(0.0);
            self.counts.fill(0.0);
            (0..reach.min(rows)).for_each(|row| self.add_row(&values[row * w..(row + 1) * w], 1.0));
        }
        if y + reach < rows {
            self.add_row(&values[(y + reach) * w..(y + reach + 1) * w], 1.0);
        }
        if y > reach {
            self.add_row(&values[(y - reach - 1) * w..(y - reach) * w], -1.0);
        }
        widen(&self.sums, &mut self.wide_sums);
        widen(&self.counts, &mut self.wide_counts);
        for ((mean, sum), count) in self.means.iter_mut().zip(&self.wide_sums).zip(&self.wide_counts) {
            // Counts are whole; without any, rounding of the running sums may be left.
            *mean = if *count > 0.5 { sum / count } else { 0.0 };
        }
        &self.means
    }

    fn add_row(&mut self, row: &[f32], sign: f32) {
        let (sums, counts) = (&mut self.sums[WINDOW_PX..], &mut self.counts[WINDOW_PX..]);
        for ((sum, count), &value) in sums.iter_mut().zip(counts).zip(row) {
            let is_known = !value.is_nan();
            *sum += if is_known { sign * value } else { 0.0 };
            *count += if is_known { sign } else { 0.0 };
        }
    }
}

/// Sums of `2 * WINDOW_PX + 1` values from each place on, where there are as many, by doubling.
fn widen(values: &[f32], out: &mut [f32]) {
    const { assert!(WINDOW_PX.is_power_of_two()) };
    out.copy_from_slice(values);
    let mut length = 1;
    while length < 2 * WINDOW_PX {
        // Each place is read by places before it, which are done by then.
        for i in 0..out.len() - length {
            out[i] += out[i + length];
        }
        length *= 2;
    }
    for (sum, last) in out.iter_mut().zip(&values[2 * WINDOW_PX..]) {
        *sum += last;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::{Direction, PatternSequence};
    use proptest::prelude::*;

    const PERIOD_PX: f64 = 22.0;

    /// Coordinate that a burst measures of one that is `u_px` in its middle and changes by `rate_px` a picture; exact levels.
    fn measured_px(burst: &[Pattern], u_px: f64, rate_px: f64) -> f32 {
        let extractor = PhaseExtractor::new(burst, crate::light::MaskLimits::default()).unwrap();
        let (mut sine, mut cosine) = (0.0, 0.0);
        for ((n, pattern), (s, c)) in burst.iter().enumerate().zip(extractor.weights()) {
            let u = u_px + rate_px * (n as f64 - 0.5 * (burst.len() as f64 - 1.0));
            let turn = std::f64::consts::TAU * u / PERIOD_PX;
            let level = 120.0 + pattern.shift_rad().map_or(0.0, |shift| 80.0 * (turn + shift).cos());
            sine += f64::from(s) * level;
            cosine += f64::from(c) * level;
        }
        let turns = (-sine).atan2(cosine) / std::f64::consts::TAU;
        ((turns + (u_px / PERIOD_PX - turns).round()) * PERIOD_PX) as f32
    }

    fn bursts() -> Vec<Vec<Pattern>> {
        let size = [912, 1140];
        let steps = [3, 4, 5].map(|n| PatternSequence::n_step(size, Direction::Columns, PERIOD_PX, n).patterns);
        let two_plus_one = PatternSequence::two_plus_one(size, Direction::Columns, PERIOD_PX).patterns;
        steps.into_iter().chain([two_plus_one]).collect()
    }

    #[test]
    fn sine_and_cosine_are_as_accurate_as_stated() {
        for i in -4000..4000 {
            let turns = i as f32 / 1000.0;
            let (s, c) = (f64::from(turns) * std::f64::consts::TAU).sin_cos();
            let (found_s, found_c) = sin_cos(turns);
            assert!((f64::from(found_s) - s).abs() < 6e-6 && (f64::from(found_c) - c).abs() < 6e-6, "{turns}");
        }
    }

    proptest! {
        #[test]
        fn a_steady_drift_is_undone_to_third_order(u in 100.0f64..800.0, rate_px in -1.2f64..1.2) {
            for burst in bursts() {
                let mut corrector = MotionCorrector::new([20, 20], &burst, 6).unwrap();
                let mut mask = PixelMask::new(20, 20);
                mask.verdicts[7] = crate::light::Rejection::Saturated;
                let column = |u: f64| vec![measured_px(&burst, u, rate_px); 400];
                // What the set before was corrected to, or would have been.
                let mut before = vec![(u - 6.0 * rate_px) as f32; 400];
                corrector.correct(4, &mask, &mut before);
                let mut now = column(u);
                let raw_error = (f64::from(now[3]) - u).abs();
                corrector.correct(5, &mask, &mut now);
                let error = (f64::from(now[3]) - u).abs();
                // The rate itself is measured with the raw error.
                prop_assert!(error < 0.25 * raw_error + 0.012, "{} pictures: {error} of {raw_error}", burst.len());
            }
        }
    }

    #[test]
    fn the_ripple_of_three_steps_is_the_rate_over_the_root_of_three() {
        let burst = &bursts()[0];
        let rate_px = 0.02;
        let worst =
            (0..220).map(|i| f64::from(i) / 10.0 + 100.0).map(|u| f64::from(measured_px(burst, u, rate_px)) - u);
        let worst = worst.fold(0.0, |worst: f64, error| worst.max(error.abs()));
        assert!((worst / (rate_px / 3f64.sqrt()) - 1.0).abs() < 0.02, "{worst}");
    }

    #[test]
    fn without_a_neighbour_nothing_is_changed() {
        let mut corrector = MotionCorrector::new([20, 20], &bursts()[0], 6).unwrap();
        let mask = PixelMask::new(20, 20);
        for (tick, value) in [(3, 100.0), (9, 103.0), (8, 105.0)] {
            let mut column = vec![value; 400];
            corrector.correct(tick, &mask, &mut column);
            assert_eq!(column, vec![value; 400], "tick {tick}");
        }
        // A jump by more than any surface moves is no rate.
        let mut column = vec![300.0; 400];
        corrector.correct(9, &mask, &mut column);
        assert!(column.iter().all(|c| (c - 300.0).abs() < 1e-3));
    }

    #[test]
    fn window_means_are_those_of_the_definition() {
        let (w, h) = (30usize, 25usize);
        let value = |i: usize| if i % 7 == 3 { f32::NAN } else { (i * 31 % 17) as f32 };
        let values: Vec<f32> = (0..w * h).map(value).collect();
        let mut window = Window::new(w);
        for y in 0..h {
            let means = window.row_means(&values, y).to_vec();
            for (x, mean) in means.iter().enumerate() {
                let rows = y.saturating_sub(WINDOW_PX)..(y + WINDOW_PX + 1).min(h);
                let columns = x.saturating_sub(WINDOW_PX)..(x + WINDOW_PX + 1).min(w);
                let inside: Vec<f32> = rows
                    .flat_map(|y| columns.clone().map(move |x| y * w + x))
                    .map(|i| values[i])
                    .filter(|v| !v.is_nan())
                    .collect();
                let exact = inside.iter().sum::<f32>() / inside.len() as f32;
                assert!((mean - exact).abs() < 1e-3, "{x}, {y}: {mean} for {exact}");
            }
        }
    }
}
