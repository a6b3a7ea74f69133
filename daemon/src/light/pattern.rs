//! Patterns and their order.
//!
//! A sinusoid shows I(u) = 127.5 (1 + cos(2 pi u / period_px + shift_rad)) at projector column (or row) u, pixel centres at
//! whole numbers. So the phase that [`crate::light::phase`] measures is 2 pi u / period_px, modulo 2 pi. A Gray code bit shows
//! that bit of u xor (u >> 1) (the reflected code of F. Gray, US patent 2632058, 1953).

use super::LightError;
use super::dither::floyd_steinberg;
use super::pattern_text::SequenceText;
use gv3_codec::GreyPicture;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;
use std::ops::Range;

/// Most patterns one sequence may hold.
pub const MAX_PATTERNS: usize = 256;
/// Most columns or rows of a projector.
pub const MAX_SIDE_PX: u32 = 16_384;

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

/// What a pattern shows along its direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PatternKind {
    /// A sinusoid.
    Sinusoid {
        /// Fringe period, projector pixels.
        period_px: f64,
        /// Phase shift, radians.
        shift_rad: f64,
    },
    /// One bit of the reflected Gray code of the coordinate.
    Gray {
        /// Power of two of the bit: 0 is the least significant.
        bit: u32,
        /// Whether 1 is dark and 0 is bright.
        inverse: bool,
    },
    /// All light: texture, and the upper end of the range.
    White,
    /// No light: ambient light, and the lower end of the range.
    Black,
    /// The mean level of a sinusoid: the third picture of 2+1 phase shifting; belongs to the burst it follows.
    Half,
}

/// One projected pattern.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pattern {
    /// What is shown.
    pub kind: PatternKind,
    /// Coded coordinate.
    pub direction: Direction,
}

impl Pattern {
    /// A sinusoid.
    pub fn sinusoid(period_px: f64, shift_rad: f64, direction: Direction) -> Self {
        Self { kind: PatternKind::Sinusoid { period_px, shift_rad }, direction }
    }

    /// A pattern without a coordinate: white, black or half.
    pub fn flat(kind: PatternKind) -> Self {
        Self { kind, direction: Direction::Columns }
    }

    /// Level 0..=1 at projector pixel `u` along the pattern's direction.
    pub fn level(&self, u: u32) -> f64 {
        match self.kind {
            PatternKind::Sinusoid { period_px, shift_rad } => {
                0.5 + 0.5 * libm::cos(TAU * f64::from(u) / period_px + shift_rad)
            }
            PatternKind::Gray { bit, inverse } => {
                f64::from(u8::from(((u ^ (u >> 1)) >> bit) & 1 == u32::from(!inverse)))
            }
            PatternKind::White => 1.0,
            PatternKind::Black => 0.0,
            PatternKind::Half => 0.5,
        }
    }

    /// The pattern's 8-bit levels along its direction, `length_px` of them.
    pub fn levels(&self, length_px: u32) -> Vec<u8> {
        (0..length_px).map(|u| (self.level(u) * 255.0).round() as u8).collect()
    }

    /// Fringe period, projector pixels; `None` when the pattern is no sinusoid.
    pub fn period_px(&self) -> Option<f64> {
        match self.kind {
            PatternKind::Sinusoid { period_px, .. } => Some(period_px),
            _ => None,
        }
    }

    /// Phase shift, radians; `None` when the pattern is no sinusoid.
    pub fn shift_rad(&self) -> Option<f64> {
        match self.kind {
            PatternKind::Sinusoid { shift_rad, .. } => Some(shift_rad),
            _ => None,
        }
    }

    /// Whether `next` belongs to the burst that this pattern, a sinusoid, began.
    fn shares_burst(&self, next: &Self) -> bool {
        let is_same = self.period_px() == next.period_px() && self.direction == next.direction;
        is_same || next.kind == PatternKind::Half
    }

    fn check(&self, field: &str, length_px: u32) -> Result<(), LightError> {
        match self.kind {
            PatternKind::Sinusoid { period_px, .. } if !(period_px >= 2.0 && period_px.is_finite()) => {
                let reason = format!("{period_px} is below 2 pixels, which no projector can show");
                Err(LightError::field(format!("{field}.period_px"), reason))
            }
            PatternKind::Sinusoid { shift_rad, .. } if !shift_rad.is_finite() => {
                Err(LightError::field(format!("{field}.shift_rad"), "not a number"))
            }
            PatternKind::Gray { bit, .. } if bit >= gray_bits(length_px) => {
                let most = gray_bits(length_px);
                let reason = format!("{bit}, but {length_px} projector pixels take bits 0 to {}", i64::from(most) - 1);
                Err(LightError::field(format!("{field}.bit"), reason))
            }
            _ => Ok(()),
        }
    }
}

/// Bits of the Gray code that tells `length_px` pixels apart.
pub fn gray_bits(length_px: u32) -> u32 {
    length_px.max(1).next_power_of_two().trailing_zeros()
}

/// The ordered set of patterns shown for one scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "SequenceText", into = "SequenceText")]
pub struct PatternSequence {
    /// Projector columns.
    pub width_px: u32,
    /// Projector rows.
    pub height_px: u32,
    /// Patterns in the order shown.
    pub patterns: Vec<Pattern>,
}

impl PatternSequence {
    /// Checks size, count, periods, and that every burst's shifts divide the circle evenly.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the pattern (0-based).
    pub fn validate(&self) -> Result<(), LightError> {
        if !(1..=MAX_SIDE_PX).contains(&self.width_px) || !(1..=MAX_SIDE_PX).contains(&self.height_px) {
            let found = format!("{} x {} pixels, expected 1..=16384 each", self.width_px, self.height_px);
            return Err(LightError::field("sequence.width_px", found));
        }
        if self.patterns.is_empty() || self.patterns.len() > MAX_PATTERNS {
            let found = format!("{} patterns, expected 1..={MAX_PATTERNS}", self.patterns.len());
            return Err(LightError::field("sequence.patterns", found));
        }
        for (i, p) in self.patterns.iter().enumerate() {
            p.check(&format!("sequence.patterns[{i}]"), self.length_px(i))?;
        }
        self.bursts().into_iter().try_for_each(|burst| self.check_shifts(burst))
    }

    /// Shifts of three or more sinusoids divide the circle evenly; with the half level, two are a right angle apart.
    fn check_shifts(&self, burst: Range<usize>) -> Result<(), LightError> {
        let patterns = &self.patterns[burst.clone()];
        let shifts: Vec<f64> = patterns.iter().filter_map(Pattern::shift_rad).collect();
        let sum = |k: f64| {
            let s: f64 = shifts.iter().map(|shift| (k * shift).sin()).sum();
            let c: f64 = shifts.iter().map(|shift| (k * shift).cos()).sum();
            s.hypot(c)
        };
        let is_two_plus_one = patterns.len() == 3 && shifts.len() == 2 && ((shifts[1] - shifts[0]).cos()).abs() < 1e-6;
        let is_even = shifts.len() == patterns.len() && shifts.len() >= 3 && sum(1.0) <= 1e-6 && sum(2.0) <= 1e-6;
        if is_even || is_two_plus_one {
            return Ok(());
        }
        let field = format!("sequence.patterns[{}..{}].shift_rad", burst.start, burst.end);
        let reason = "a burst needs three or more shifts that divide the circle evenly, or two a right angle apart and \
                      the half level";
        Err(LightError::field(field, reason))
    }

    /// Runs of sinusoids with one period and direction, each with the half level that may end it, in order.
    pub fn bursts(&self) -> Vec<Range<usize>> {
        let mut bursts: Vec<Range<usize>> = Vec::new();
        for (i, pattern) in self.patterns.iter().enumerate() {
            match bursts.last_mut() {
                Some(last) if last.end == i && self.patterns[last.start].shares_burst(pattern) => last.end = i + 1,
                _ if pattern.period_px().is_some() => bursts.push(i..i + 1),
                _ => {}
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
        if a.len() + b.len() != self.patterns.len() {
            return Err(LightError::field("sequence.patterns", "a live scan needs sinusoids only"));
        }
        if self.patterns.iter().any(|p| p.direction != Direction::Columns) {
            return Err(LightError::field("sequence.patterns", "a scan needs patterns along columns"));
        }
        Ok(if self.burst_period_px(&a) > self.burst_period_px(&b) { (a, b) } else { (b, a) })
    }

    /// The patterns whose exposures a scan's time is the middle of: the burst with the shortest period, or all patterns when
    /// there is no sinusoid.
    pub fn finest_burst(&self) -> Range<usize> {
        let period = |burst: &Range<usize>| self.burst_period_px(burst);
        let finest = self.bursts().into_iter().min_by(|a, b| period(a).total_cmp(&period(b)));
        finest.unwrap_or(0..self.patterns.len())
    }

    /// Period of a burst (see [`Self::bursts`]), projector pixels.
    ///
    /// # Panics
    /// When `burst` does not begin with a sinusoid.
    pub fn burst_period_px(&self, burst: &Range<usize>) -> f64 {
        self.patterns[burst.start].period_px().expect("a burst begins with a sinusoid")
    }

    /// Projector pixels along `direction`.
    pub fn side_px(&self, direction: Direction) -> u32 {
        match direction {
            Direction::Columns => self.width_px,
            Direction::Rows => self.height_px,
        }
    }

    /// Projector pixels along pattern `index`'s direction.
    pub fn length_px(&self, index: usize) -> u32 {
        self.side_px(self.patterns[index].direction)
    }

    /// Pattern `index` in 1 bit a pixel, levels 0 and 255, by Floyd and Steinberg's error diffusion: for projectors that
    /// switch faster in black and white; slight defocus gives back the levels. Black and white patterns stay as they are.
    ///
    /// # Panics
    /// When there is no pattern `index`.
    pub fn render_dithered(&self, index: usize) -> GreyPicture {
        floyd_steinberg(self.width_px, self.height_px, |x, y| match self.patterns[index].direction {
            Direction::Columns => self.patterns[index].level(x),
            Direction::Rows => self.patterns[index].level(y),
        })
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
        bad.patterns[5] = Pattern::sinusoid(1.0, 0.0, Direction::Columns);
        assert!(bad.validate().unwrap_err().to_string().contains("patterns[5].period_px"));
        let mut uneven = s;
        uneven.patterns[1] = Pattern::sinusoid(240.0, TAU / 4.0 + 0.01, Direction::Columns);
        assert!(uneven.validate().unwrap_err().to_string().contains("patterns[0..4].shift_rad"));
    }

    #[test]
    fn neighbouring_gray_codes_differ_in_one_bit_and_inverses_in_all() {
        let bits = gray_bits(768);
        assert_eq!((bits, gray_bits(1024), gray_bits(1025), gray_bits(1)), (10, 10, 11, 0));
        let shown =
            |bit, inverse| Pattern { kind: PatternKind::Gray { bit, inverse }, direction: Direction::Rows }.levels(768);
        let planes: Vec<Vec<u8>> = (0..bits).map(|bit| shown(bit, false)).collect();
        for u in 1..768 {
            assert_eq!(planes.iter().filter(|p| p[u] != p[u - 1]).count(), 1, "{u}");
        }
        assert!(planes[3].iter().zip(shown(3, true)).all(|(a, b)| a ^ b == 255));
        assert_eq!(&planes[0][..6], [0, 255, 255, 0, 0, 255]);
    }

    #[test]
    fn dithered_patterns_keep_their_fundamental() {
        let s = PatternSequence::n_step([240, 60], Direction::Columns, 30.0, 3);
        for index in 0..3 {
            let picture = s.render_dithered(index);
            assert!(picture.pixels.iter().all(|&v| v == 0 || v == 255));
            let (mut re, mut im) = (0.0, 0.0);
            for (i, &v) in picture.pixels.iter().enumerate() {
                let angle = TAU * (i % 240) as f64 / 30.0 + s.patterns[index].shift_rad().unwrap();
                re += f64::from(v) * angle.cos();
                im += f64::from(v) * angle.sin();
            }
            let scale = 2.0 / picture.pixels.len() as f64;
            assert!((re * scale - 127.5).abs() < 4.0, "amplitude {}", re * scale);
            assert!((im / re).abs() < 0.02, "phase error {} rad", im / re);
        }
    }

    #[test]
    fn two_plus_one_is_one_burst_and_bits_beyond_the_projector_are_refused() {
        let s = PatternSequence::two_plus_one([912, 1140], Direction::Columns, 36.0);
        s.validate().unwrap();
        assert_eq!((s.bursts().len(), s.finest_burst()), (1, 0..3));
        let mut bad = PatternSequence::gray_code([912, 1140], &[Direction::Columns]);
        bad.validate().unwrap();
        bad.patterns[2] =
            Pattern { kind: PatternKind::Gray { bit: 10, inverse: false }, direction: Direction::Columns };
        let error = bad.validate().unwrap_err().to_string();
        assert_eq!(error, "sequence.patterns[2].bit: 10, but 912 projector pixels take bits 0 to 9");
    }
}
