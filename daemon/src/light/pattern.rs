//! Fringe patterns and their order.
//!
//! A pattern shows I(u) = 127.5 (1 + cos(2 pi u / period_px + shift_rad)) at projector column (or row) u, pixel centres at
//! whole numbers. So the phase that [`crate::light::phase`] measures is 2 pi u / period_px, modulo 2 pi.

use super::LightError;
use gv3_codec::GreyPicture;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;
use std::ops::Range;

/// Most patterns one sequence may hold.
pub const MAX_PATTERNS: usize = 256;

/// Coordinate of the projector that a pattern codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// Grey level changes from column to column.
    #[default]
    Columns,
    /// Grey level changes from row to row.
    Rows,
}

/// One projected sinusoid.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pattern {
    /// Fringe period, projector pixels.
    pub period_px: f64,
    /// Phase shift, radians.
    pub shift_rad: f64,
    /// Coded coordinate.
    #[serde(default)]
    pub direction: Direction,
}

impl Pattern {
    /// Level 0..=1 at projector coordinate `u_px` along the pattern's direction.
    pub fn level(&self, u_px: f64) -> f64 {
        0.5 + 0.5 * (TAU * u_px / self.period_px + self.shift_rad).cos()
    }

    /// The pattern's 8-bit levels along its direction, `length_px` of them.
    pub fn levels(&self, length_px: u32) -> Vec<u8> {
        (0..length_px).map(|u| (self.level(f64::from(u)) * 255.0).round() as u8).collect()
    }

    fn is_same_fringe(&self, other: &Self) -> bool {
        self.period_px == other.period_px && self.direction == other.direction
    }
}

/// The ordered set of patterns shown for one scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PatternSequence {
    /// Projector columns.
    pub width_px: u32,
    /// Projector rows.
    pub height_px: u32,
    /// Patterns in the order shown.
    pub patterns: Vec<Pattern>,
}

impl PatternSequence {
    /// Two frequencies, `steps` pictures each, columns: the low frequency first, so that a scan's time is the middle of the
    /// high-frequency exposures, which give its surface and texture.
    pub fn two_frequency(size_px: [u32; 2], low_period_px: f64, high_period_px: f64, steps: u32) -> Self {
        let burst = |period_px: f64| {
            (0..steps).map(move |n| Pattern {
                period_px,
                shift_rad: TAU * f64::from(n) / f64::from(steps),
                direction: Direction::Columns,
            })
        };
        let patterns = burst(low_period_px).chain(burst(high_period_px)).collect();
        Self { width_px: size_px[0], height_px: size_px[1], patterns }
    }

    /// Checks size, count, periods, and that every burst's shifts divide the circle evenly.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the pattern (0-based).
    pub fn validate(&self) -> Result<(), LightError> {
        if !(1..=16_384).contains(&self.width_px) || !(1..=16_384).contains(&self.height_px) {
            let found = format!("{} x {} pixels, expected 1..=16384 each", self.width_px, self.height_px);
            return Err(LightError::field("sequence.width_px", found));
        }
        if self.patterns.is_empty() || self.patterns.len() > MAX_PATTERNS {
            let found = format!("{} patterns, expected 1..={MAX_PATTERNS}", self.patterns.len());
            return Err(LightError::field("sequence.patterns", found));
        }
        for (i, p) in self.patterns.iter().enumerate() {
            if !(p.period_px >= 2.0 && p.period_px.is_finite()) {
                let reason = format!("{} is below 2 pixels, which no projector can show", p.period_px);
                return Err(LightError::field(format!("sequence.patterns[{i}].period_px"), reason));
            }
            if !p.shift_rad.is_finite() {
                return Err(LightError::field(format!("sequence.patterns[{i}].shift_rad"), "not a number"));
            }
        }
        self.bursts().into_iter().try_for_each(|burst| self.check_shifts(burst))
    }

    fn check_shifts(&self, burst: Range<usize>) -> Result<(), LightError> {
        let patterns = &self.patterns[burst.clone()];
        let sum = |k: f64| {
            let s: f64 = patterns.iter().map(|p| (k * p.shift_rad).sin()).sum();
            let c: f64 = patterns.iter().map(|p| (k * p.shift_rad).cos()).sum();
            s.hypot(c)
        };
        if patterns.len() < 3 || sum(1.0) > 1e-6 || sum(2.0) > 1e-6 {
            let field = format!("sequence.patterns[{}..{}].shift_rad", burst.start, burst.end);
            return Err(LightError::field(field, "a burst needs three or more shifts that divide the circle evenly"));
        }
        Ok(())
    }

    /// Runs of patterns with one period and direction, in order.
    pub fn bursts(&self) -> Vec<Range<usize>> {
        let mut bursts: Vec<Range<usize>> = Vec::new();
        for (i, pattern) in self.patterns.iter().enumerate() {
            match bursts.last_mut() {
                Some(last) if self.patterns[last.start].is_same_fringe(pattern) => last.end = i + 1,
                _ => bursts.push(i..i + 1),
            }
        }
        bursts
    }

    /// The low- and high-frequency bursts of a two-frequency column sequence, in this order.
    ///
    /// # Errors
    /// [`LightError::Field`] when the sequence is of another kind.
    pub fn low_and_high(&self) -> Result<(Range<usize>, Range<usize>), LightError> {
        self.validate()?;
        let [a, b]: [Range<usize>; 2] = self
            .bursts()
            .try_into()
            .map_err(|_| LightError::field("sequence.patterns", "expected two bursts, one of each period"))?;
        if self.patterns.iter().any(|p| p.direction != Direction::Columns) {
            return Err(LightError::field("sequence.patterns", "a scan needs patterns along columns"));
        }
        let first_is_low = self.patterns[a.start].period_px > self.patterns[b.start].period_px;
        Ok(if first_is_low { (a, b) } else { (b, a) })
    }

    /// The patterns whose exposures a scan's time is the middle of: the burst with the shortest period.
    pub fn finest_burst(&self) -> Range<usize> {
        let period = |burst: &Range<usize>| self.patterns[burst.start].period_px;
        self.bursts().into_iter().min_by(|a, b| period(a).total_cmp(&period(b))).unwrap_or(0..0)
    }

    /// Projector pixels along pattern `index`'s direction.
    pub fn length_px(&self, index: usize) -> u32 {
        match self.patterns[index].direction {
            Direction::Columns => self.width_px,
            Direction::Rows => self.height_px,
        }
    }

    /// Pattern `index` as the projector shows it, 8 bits.
    ///
    /// # Panics
    /// When there is no pattern `index`.
    pub fn render(&self, index: usize) -> GreyPicture {
        let levels = self.patterns[index].levels(self.length_px(index));
        let (w, h) = (self.width_px as usize, self.height_px as usize);
        let pixels = match self.patterns[index].direction {
            Direction::Columns => levels.repeat(h),
            Direction::Rows => levels.iter().flat_map(|&level| std::iter::repeat_n(level, w)).collect(),
        };
        GreyPicture::new(self.width_px, self.height_px, pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_frequency_shows_the_low_frequency_first() {
        let s = PatternSequence::two_frequency([912, 1140], 240.0, 20.0, 3);
        assert_eq!(s.low_and_high().unwrap(), (0..3, 3..6));
        assert_eq!(s.finest_burst(), 3..6);
    }

    #[test]
    fn rendered_levels_follow_the_cosine() {
        let s = PatternSequence::two_frequency([48, 4], 24.0, 12.0, 3);
        let picture = s.render(0);
        assert_eq!((picture.pixels[0], picture.pixels[12], picture.pixels[24 + 48]), (255, 0, 255));
        assert_eq!(s.render(3).pixels[6], 0);
        let rows = PatternSequence {
            patterns: s.patterns.iter().map(|p| Pattern { direction: Direction::Rows, ..*p }).collect(),
            ..s
        };
        assert!(rows.render(0).pixels[..48].iter().all(|&v| v == 255));
    }

    #[test]
    fn toml_round_trip_and_errors_name_the_pattern() {
        let s = PatternSequence::two_frequency([912, 1140], 240.0, 20.0, 4);
        let back: PatternSequence = toml::from_str(&toml::to_string(&s).unwrap()).unwrap();
        assert_eq!(back, s);
        let mut bad = s.clone();
        bad.patterns[5].period_px = 1.0;
        assert!(bad.validate().unwrap_err().to_string().contains("patterns[5].period_px"));
        let mut uneven = s;
        uneven.patterns[1].shift_rad += 0.01;
        assert!(uneven.validate().unwrap_err().to_string().contains("patterns[0..4].shift_rad"));
    }
}
