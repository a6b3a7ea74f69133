//! Wrapped phase by N-step phase shifting.
//!
//! For I_n = A + B cos(phi + shift_n), shifts dividing the circle evenly:
//! phi = -atan2(sum I_n sin shift_n, sum I_n cos shift_n), B = 2/N |(sum sin, sum cos)|, A = mean I_n
//! (Creath, "Phase-measurement interferometry techniques", Progress in Optics 26, 1988, least squares form).
//! 2+1 (two sinusoids and the half level) is the exact solution of the same model.
//!
//! Noise of the phase for independent grey-level noise sigma, radians: sqrt(2/N) sigma / B for N steps, so 0.82 for 3, 0.71 for
//! 4 and 0.58 for the six of double three-step; sqrt(2) sigma / B for 2+1, whose half level enters both sums. Every scheme ends
//! in its finest burst, so that this noise times period / (2 pi) is the coordinate's: Gray code, multi-frequency, heterodyne
//! and geometric constraints decide the fringe order only. The last has one long period, hence its noise.

use super::mask::{MaskLimits, PixelMask, Rejection};
use super::{LightError, Pattern};
use glam::{DMat3, DVec3};
use gv3_codec::GreyPicture;
use std::f32::consts::{FRAC_PI_2, PI};

/// Largest error of [`atan2_rad`], radians.
pub const ATAN2_ERROR_RAD: f32 = 4e-6;

/// Four-quadrant arctangent in (-pi, pi], within [`ATAN2_ERROR_RAD`] = 4e-6; 0 for (0, 0). Branch-free, so that loops of it
/// vectorize.
///
/// Odd polynomial of degree 11 on [0, 1], fitted to least maximum error.
#[inline]
pub fn atan2_rad(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ax < ay { (ax, ay) } else { (ay, ax) };
    let t = small / if large > 0.0 { large } else { 1.0 };
    let t2 = t * t;
    let p = 0.999_977_26
        + t2 * (-0.332_623_47 + t2 * (0.193_543_46 + t2 * (-0.116_432_87 + t2 * (0.052_653_32 - t2 * 0.011_721_2))));
    let first_octant = t * p;
    let first_quadrant = if ay > ax { FRAC_PI_2 - first_octant } else { first_octant };
    let upper = if x < 0.0 { PI - first_quadrant } else { first_quadrant };
    if y < 0.0 { -upper } else { upper }
}

/// Phase, background and modulation of every camera pixel, row-major.
#[derive(Debug, Clone, Default)]
pub struct WrappedPhase {
    /// Wrapped phase phi in (-pi, pi].
    pub phase_rad: Vec<f32>,
    /// Background A, grey levels.
    pub background: Vec<f32>,
    /// Modulation B, grey levels.
    pub modulation: Vec<f32>,
}

impl WrappedPhase {
    /// Room for `pixel_count` pixels.
    pub fn new(pixel_count: usize) -> Self {
        let zeros = vec![0.0; pixel_count];
        Self { phase_rad: zeros.clone(), background: zeros.clone(), modulation: zeros }
    }
}

/// Computes wrapped phase from the pictures of one burst.
#[derive(Debug, Clone)]
pub struct PhaseExtractor {
    sines: Vec<f32>,
    cosines: Vec<f32>,
    /// Weight of every picture in the background, times their number.
    levels: Vec<f32>,
    limits: MaskLimits,
}

/// Sums over the pictures of a burst, for one row.
#[derive(Default)]
struct RowSums {
    sine: Vec<f32>,
    cosine: Vec<f32>,
    level: Vec<f32>,
    peak: Vec<u8>,
}

impl PhaseExtractor {
    /// An extractor for the shifts of `burst` (see [`super::PatternSequence::bursts`]).
    ///
    /// # Errors
    /// [`LightError::Field`] for fewer than three patterns or limits that cannot work.
    pub fn new(burst: &[Pattern], limits: MaskLimits) -> Result<Self, LightError> {
        limits.validate()?;
        if burst.len() < 3 {
            return Err(LightError::field("sequence.patterns", "a burst needs three or more patterns"));
        }
        let shifts: Vec<Option<f64>> = burst.iter().map(Pattern::shift_rad).collect();
        let Some(evenly) = shifts.iter().copied().collect::<Option<Vec<f64>>>() else {
            return Self::by_least_squares(&shifts, limits);
        };
        Ok(Self {
            sines: evenly.iter().map(|shift_rad| shift_rad.sin() as f32).collect(),
            cosines: evenly.iter().map(|shift_rad| shift_rad.cos() as f32).collect(),
            levels: vec![1.0; evenly.len()],
            limits,
        })
    }

    /// Factors of every picture in the sums of phase shifting, sine and cosine: phi = -atan2(sine sum, cosine sum).
    pub fn weights(&self) -> impl Iterator<Item = (f32, f32)> + '_ {
        self.sines.iter().copied().zip(self.cosines.iter().copied())
    }

    /// Weights for pictures whose shifts do not divide the circle evenly; without a shift a picture shows the half level.
    fn by_least_squares(shifts: &[Option<f64>], limits: MaskLimits) -> Result<Self, LightError> {
        // I_n = A + (B cos phi) cos shift_n - (B sin phi) sin shift_n.
        let row = |shift: &Option<f64>| shift.map_or(DVec3::X, |s: f64| DVec3::new(1.0, s.cos(), -s.sin()));
        let normal =
            shifts.iter().map(row).fold(DMat3::ZERO, |sum, r| sum + DMat3::from_cols(r * r.x, r * r.y, r * r.z));
        if normal.determinant().abs() < 1e-6 {
            return Err(LightError::field("sequence.patterns", "the shifts of a burst do not determine its phase"));
        }
        let inverse = normal.inverse();
        // The kernel expects sums as of N even steps: N/2 times the amplitudes, N times the background.
        let count = shifts.len() as f64;
        let weights: Vec<DVec3> = shifts.iter().map(|shift| inverse * row(shift) * count).collect();
        Ok(Self {
            sines: weights.iter().map(|w| (-0.5 * w.z) as f32).collect(),
            cosines: weights.iter().map(|w| (0.5 * w.y) as f32).collect(),
            levels: weights.iter().map(|w| w.x as f32).collect(),
            limits,
        })
    }

    /// Fills `out` from the burst's pictures and rejects, in `mask`, the pixels without a usable fringe.
    ///
    /// # Panics
    /// When the number of pictures or a picture's size differs from what extractor, mask and `out` were made for.
    pub fn extract(&self, pictures: &[&GreyPicture], mask: &mut PixelMask, out: &mut WrappedPhase) {
        let w = mask.width_px;
        assert_eq!(pictures.len(), self.sines.len(), "pictures and patterns differ in number");
        for picture in pictures {
            let size = (picture.width_px as usize, picture.height_px as usize);
            assert_eq!(size, (w, mask.height_px), "picture and mask differ in size");
        }
        let mut sums = RowSums { sine: vec![0.0; w], cosine: vec![0.0; w], level: vec![0.0; w], peak: vec![0; w] };
        for y in 0..mask.height_px {
            let row = y * w..(y + 1) * w;
            self.sum_row(pictures, row.start, &mut sums);
            let verdicts = &mut mask.verdicts[row.clone()];
            let phase = &mut out.phase_rad[row.clone()];
            let background = &mut out.background[row.clone()];
            let modulation = &mut out.modulation[row];
            self.finish_row(&sums, phase, background, modulation);
            self.judge_row(&sums.peak, background, modulation, verdicts);
        }
    }

    fn sum_row(&self, pictures: &[&GreyPicture], start: usize, sums: &mut RowSums) {
        let w = sums.sine.len();
        sums.sine.fill(0.0);
        sums.cosine.fill(0.0);
        sums.level.fill(0.0);
        sums.peak.fill(0);
        let weights = self.sines.iter().zip(&self.cosines).zip(&self.levels);
        for (picture, ((&sine, &cosine), &weight)) in pictures.iter().zip(weights) {
            let row = &picture.pixels[start..start + w];
            let trig = sums.sine.iter_mut().zip(sums.cosine.iter_mut());
            for ((&pixel, (s, c)), (level, peak)) in
                row.iter().zip(trig).zip(sums.level.iter_mut().zip(sums.peak.iter_mut()))
            {
                let grey = f32::from(pixel);
                *s += sine * grey;
                *c += cosine * grey;
                *level += weight * grey;
                *peak = (*peak).max(pixel);
            }
        }
    }

    fn finish_row(&self, sums: &RowSums, phase: &mut [f32], background: &mut [f32], modulation: &mut [f32]) {
        let per_picture = 1.0 / self.sines.len() as f32;
        for ((&s, &c), out) in sums.sine.iter().zip(&sums.cosine).zip(phase) {
            *out = atan2_rad(-s, c);
        }
        for ((&s, &c), out) in sums.sine.iter().zip(&sums.cosine).zip(modulation) {
            *out = 2.0 * per_picture * (s * s + c * c).sqrt();
        }
        for (&level, out) in sums.level.iter().zip(background) {
            *out = level * per_picture;
        }
    }

    fn judge_row(&self, peaks: &[u8], background: &[f32], modulation: &[f32], verdicts: &mut [Rejection]) {
        let limits = self.limits;
        for ((verdict, &peak), (&a, &b)) in verdicts.iter_mut().zip(peaks).zip(background.iter().zip(modulation)) {
            let mut new = Rejection::Kept;
            new = if b < limits.min_data_modulation * a { Rejection::LowDataModulation } else { new };
            new = if b < limits.min_modulation { Rejection::LowModulation } else { new };
            new = if peak >= limits.saturated_level { Rejection::Saturated } else { new };
            *verdict = if *verdict == Rejection::Kept { new } else { *verdict };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::{Direction, PatternSequence};
    use proptest::prelude::*;
    use std::f64::consts::TAU;

    fn burst(steps: u32) -> Vec<Pattern> {
        PatternSequence::two_frequency([64, 1], 32.0, 16.0, steps).patterns[..steps as usize].to_vec()
    }

    fn extract(pictures: &[GreyPicture], limits: MaskLimits) -> (WrappedPhase, PixelMask) {
        extract_burst(&burst(pictures.len() as u32), pictures, limits)
    }

    fn extract_burst(burst: &[Pattern], pictures: &[GreyPicture], limits: MaskLimits) -> (WrappedPhase, PixelMask) {
        let (w, h) = (pictures[0].width_px as usize, pictures[0].height_px as usize);
        let mut mask = PixelMask::new(w, h);
        let mut out = WrappedPhase::new(w * h);
        let refs: Vec<&GreyPicture> = pictures.iter().collect();
        PhaseExtractor::new(burst, limits).unwrap().extract(&refs, &mut mask, &mut out);
        (out, mask)
    }

    fn wrap(rad: f64) -> f64 {
        rad - TAU * (rad / TAU).round()
    }

    #[test]
    fn atan2_is_as_accurate_as_stated_all_around() {
        let mut worst = 0.0f64;
        for i in 0..200_000 {
            let angle = TAU * (f64::from(i) / 200_000.0 - 0.5);
            let radius = 10f64.powi(i % 7 - 3);
            let (y, x) = ((radius * angle.sin()) as f32, (radius * angle.cos()) as f32);
            let exact = f64::from(y).atan2(f64::from(x));
            worst = worst.max(wrap(f64::from(atan2_rad(y, x)) - exact).abs());
        }
        assert!(worst <= f64::from(ATAN2_ERROR_RAD), "worst {worst:e}");
        assert_eq!(atan2_rad(0.0, 0.0), 0.0);
        assert_eq!(atan2_rad(-0.0, -1.0), PI);
    }

    proptest! {
        #[test]
        fn phase_survives_any_step_count(steps in 3u32..12, phi in -3.1f64..3.1, a in 70.0f64..150.0, ratio in 0.4f64..0.9) {
            let b = a * ratio.min((250.0 - a) / a);
            let pictures: Vec<GreyPicture> = burst(steps)
                .iter()
                .map(|p| GreyPicture::filled(8, 2, (a + b * (phi + p.shift_rad().unwrap()).cos()).round() as u8))
                .collect();
            let (out, mask) = extract(&pictures, MaskLimits::default());
            // Rounding errs by at most half a level a picture.
            let bound = 0.5 * 2.0 / b + 1e-5;
            prop_assert!(wrap(f64::from(out.phase_rad[3]) - phi).abs() < bound);
            prop_assert!((f64::from(out.background[3]) - a).abs() < 0.51);
            prop_assert!((f64::from(out.modulation[3]) - b).abs() < 1.01);
            prop_assert!(mask.is_kept(3));
        }
    }

    proptest! {
        #[test]
        fn the_coordinate_survives_any_steps_order_and_period(
            order in (3usize..12).prop_flat_map(|n| Just((0..n).collect::<Vec<_>>()).prop_shuffle()),
            period_px in 4.0f64..300.0,
            first_rad in -3.0f64..3.0,
        ) {
            let steps = order.len() as f64;
            let shuffled: Vec<Pattern> = order
                .iter()
                .map(|&n| Pattern::sinusoid(period_px, first_rad + TAU * n as f64 / steps, Direction::Columns))
                .collect();
            let pictures: Vec<GreyPicture> =
                shuffled.iter().map(|p| GreyPicture::new(250, 1, p.levels(250).iter().map(|v| v / 2 + 20).collect())).collect();
            let (out, mask) = extract_burst(&shuffled, &pictures, MaskLimits::default());
            for u in 0..250 {
                prop_assert!(mask.is_kept(u));
                // Two roundings, one of them downwards, by a level in all.
                let error = wrap(f64::from(out.phase_rad[u]) - TAU * u as f64 / period_px);
                prop_assert!(error.abs() < 2.0 / 63.0, "{error} at {u}");
            }
        }
    }

    #[test]
    fn every_limit_rejects_under_its_own_name() {
        let three = |levels: [u8; 3]| levels.map(|v| GreyPicture::filled(1, 1, v));
        let verdict = |levels| extract(&three(levels), MaskLimits::default()).1.verdicts[0];
        assert_eq!(verdict([200, 80, 80]), Rejection::Kept);
        assert_eq!(verdict([255, 80, 80]), Rejection::Saturated);
        assert_eq!(verdict([12, 4, 4]), Rejection::LowModulation);
        assert_eq!(verdict([220, 190, 190]), Rejection::LowDataModulation);
    }

    #[test]
    fn phase_noise_follows_theory() {
        let (a, b, sigma, n) = (120.0, 80.0, 2.0, 40_000usize);
        let mut state = 7u64;
        let mut normal = || {
            // Sum of twelve uniforms: variance one.
            (0..12)
                .map(|_| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    (state >> 33) as f64 / 2f64.powi(31)
                })
                .sum::<f64>()
                - 6.0
        };
        let two_plus_one = PatternSequence::two_plus_one([64, 1], Direction::Columns, 16.0).patterns;
        let bursts = [3u32, 4, 5, 6, 8, 12].map(|steps| (burst(steps), (2.0 / f64::from(steps)).sqrt()));
        // The half level enters sine and cosine: variances 2 and covariance 1, on the mean of all phases sqrt(2).
        let double_three = PatternSequence::double_three_step([64, 1], Direction::Columns, 16.0).patterns;
        let others = [(two_plus_one, 2f64.sqrt()), (double_three, (2.0 / 6.0f64).sqrt())];
        for (burst, factor) in bursts.into_iter().chain(others) {
            let pictures: Vec<GreyPicture> = burst
                .iter()
                .map(|p| {
                    let wave = |i: usize| p.shift_rad().map_or(0.0, |s| (i as f64 * 0.37 + s).cos());
                    let clean = |i: usize| a + b * wave(i);
                    let pixels = (0..n).map(|i| (clean(i) + sigma * normal()).round() as u8).collect();
                    GreyPicture::new(n as u32, 1, pixels)
                })
                .collect();
            let (out, _) = extract_burst(&burst, &pictures, MaskLimits::default());
            let sum: f64 =
                (0..n).map(|i| wrap(f64::from(out.phase_rad[i]) - i as f64 * 0.37).powi(2)).sum::<f64>() / n as f64;
            // Rounding to whole levels adds its own 1/12.
            let theory = factor * (sigma * sigma + 1.0 / 12.0f64).sqrt() / b;
            println!("{} pictures: {:.5} rad, theory {theory:.5}", burst.len(), sum.sqrt());
            assert!((sum.sqrt() / theory - 1.0).abs() < 0.03, "{}: {} against {theory}", burst.len(), sum.sqrt());
        }
    }
}
