//! A pattern as the projector shows it.

use super::raster::whole;
use crate::light::{Direction, Pattern};

/// Light of a black projector pixel over that of a white one.
const BLACK_LEVEL: f32 = 0.01;

/// Light of one pattern along its direction.
#[derive(Debug, Clone)]
pub struct ShownPattern {
    levels: Vec<f32>,
    /// Coordinate of the projector that the pattern changes along.
    pub direction: Direction,
}

impl ShownPattern {
    /// The pattern as an 8-bit projector of `length_px` pixels along its direction shows it, its light the `gamma`-th power of
    /// its input and blurred by a Gaussian of `sigma_px`.
    ///
    /// The blur lowers the modulation of period p by exp(-2 pi^2 sigma^2 / p^2), the Gaussian's Fourier transform.
    pub fn new(pattern: &Pattern, length_px: u32, gamma: f32, sigma_px: f32) -> Self {
        Self::of_levels(&pattern.levels(length_px), pattern.direction, gamma, sigma_px)
    }

    /// The same of a pattern's 8-bit levels along its direction.
    pub fn of_levels(levels: &[u8], direction: Direction, gamma: f32, sigma_px: f32) -> Self {
        let response =
            |v: u8| if gamma == 1.0 { f32::from(v) } else { 255.0 * libm::powf(f32::from(v) / 255.0, gamma) };
        let level = |v: u8| BLACK_LEVEL + (1.0 - BLACK_LEVEL) * response(v) / 255.0;
        let sharp: Vec<f32> = levels.iter().copied().map(level).collect();
        let mut levels = if sigma_px > 0.0 { blurred(&sharp, sigma_px) } else { sharp };
        // A projector of one pixel still has a pair to look up.
        levels.resize(levels.len().max(2), levels.last().copied().unwrap_or(BLACK_LEVEL));
        Self { levels, direction }
    }

    /// Light at a coordinate along the pattern's direction, pixels; beyond the ends it is that of the last pixel.
    #[inline]
    pub fn level(&self, u: f32) -> f32 {
        let last = self.levels.len() as f32 - 1.001;
        let u = if u > 0.0 { u } else { 0.0 };
        let u = if u < last { u } else { last };
        let i = whole(u);
        let pair = &self.levels[i..i + 2];
        pair[0] + (u - i as u32 as i32 as f32) * (pair[1] - pair[0])
    }
}

/// Levels after a Gaussian blur to five sigma; beyond the projector's edges it is dark.
fn blurred(levels: &[f32], sigma_px: f32) -> Vec<f32> {
    let reach = (5.0 * sigma_px).ceil() as isize;
    let weight = |d: isize| {
        let deviations = d as f64 / f64::from(sigma_px);
        libm::exp(-0.5 * deviations * deviations)
    };
    let kernel: Vec<f64> = (-reach..=reach).map(weight).collect();
    let total: f64 = kernel.iter().sum();
    let at = |u: isize| usize::try_from(u).ok().and_then(|u| levels.get(u)).map_or(0.0, |v| f64::from(*v));
    let blur = |u: isize| (-reach..=reach).zip(&kernel).map(|(d, w)| w * at(u + d)).sum::<f64>() / total;
    (0..levels.len() as isize).map(|u| blur(u) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// Amplitude of the harmonic `order` of a pattern of period 24 px, away from the projector's edges.
    fn amplitude(order: f64, gamma: f32, sigma_px: f32) -> f64 {
        let pattern = Pattern::sinusoid(24.0, 0.3, Direction::Columns);
        let shown = ShownPattern::new(&pattern, 480, gamma, sigma_px);
        let (s, c) = (0..240).fold((0.0, 0.0), |(s, c), u| {
            let angle = TAU * order * f64::from(u) / 24.0;
            let level = f64::from(shown.level(120.0 + u as f32));
            (s + level * angle.sin(), c + level * angle.cos())
        });
        s.hypot(c) / 120.0
    }

    #[test]
    fn defocus_lowers_the_modulation_as_the_gaussian_says() {
        for sigma_px in [1.0f32, 3.0, 6.0] {
            let found = amplitude(1.0, 1.0, sigma_px) / amplitude(1.0, 1.0, 0.0);
            let expected = (-0.5 * (TAU * f64::from(sigma_px) / 24.0).powi(2)).exp();
            assert!((found / expected - 1.0).abs() < 0.01, "sigma {sigma_px} px: {found}, expected {expected}");
        }
    }

    #[test]
    fn gamma_makes_harmonics_and_defocus_takes_them_away() {
        assert!(amplitude(2.0, 1.0, 0.0) < 1e-3);
        // ((1 + cos x) / 2)^2 = 3/8 + cos(x) / 2 + cos(2x) / 8.
        let ratio = |sigma_px| amplitude(2.0, 2.0, sigma_px) / amplitude(1.0, 2.0, sigma_px);
        assert!((ratio(0.0) - 0.25).abs() < 2e-3, "{}", ratio(0.0));
        assert!(ratio(6.0) < 0.01, "{}", ratio(6.0));
    }
}
