//! Gray-code decoding.
//!
//! Every bit is decided by comparing a pixel under the pattern and under its inverse (or under the mean of white and black),
//! so albedo and ambient light drop out. Between neighbouring pixels whose codes differ by one, the difference of that bit
//! passes through zero where the projected edge is; interpolation between these edges gives coordinates finer than the code
//! (M. Trobina, "Error model of a coded-light range sensor", ETH Zürich BIWI-TR-164, 1995).
//!
//! Code c names the centre of projector pixel c; a code that leaves out the k least bits names the centre of 2^k pixels.

use super::mask::{PixelMask, Rejection};
use super::pattern::gray_bits;
use super::{Direction, LightError, MaskLimits, PatternKind, PatternSequence};
use gv3_codec::GreyPicture;

/// A bit is uncertain below this part of the range from black to white.
pub const MIN_BIT_CONTRAST: f32 = 0.05;
/// And below this many grey levels, whatever the range.
const MIN_BIT_LEVELS: f32 = 2.0;

/// Where the pictures of a Gray code stand in a sequence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GrayDecoder {
    length_px: u32,
    /// Bits left out at the fine end.
    last_bit: u32,
    /// Picture and inverse of every bit, most significant first.
    bits: Vec<(usize, Option<usize>)>,
    white_black: Option<(usize, usize)>,
}

/// Decoded coordinates of every camera pixel, row-major.
#[derive(Debug, Clone, Default)]
pub struct GrayCodes {
    /// Code: cell number along the direction.
    pub codes: Vec<u32>,
    /// Least contrast of the bits but one, 0..=1 of the range; one bit of a pixel on an edge is always uncertain.
    pub confidence: Vec<f32>,
}

impl GrayDecoder {
    /// The decoder of a sequence's Gray code along `direction`; `None` when it has none.
    ///
    /// # Errors
    /// [`LightError::Field`] when a bit is missing or twice, or without inverse there is no white and black.
    pub fn new(sequence: &PatternSequence, direction: Direction) -> Result<Option<Self>, LightError> {
        let find = |wanted: PatternKind| sequence.patterns.iter().position(|p| p.kind == wanted);
        let white_black = find(PatternKind::White).zip(find(PatternKind::Black));
        let length_px = sequence.side_px(direction);
        let mut table = vec![[None; 2]; gray_bits(length_px) as usize];
        for (i, pattern) in sequence.patterns.iter().enumerate().filter(|(_, p)| p.direction == direction) {
            if let PatternKind::Gray { bit, inverse } = pattern.kind
                && table[bit as usize][usize::from(inverse)].replace(i).is_some()
            {
                return Err(LightError::field(format!("sequence.patterns[{i}].bit"), format!("{bit} is there twice")));
            }
        }
        let Some(last_bit) = table.iter().position(|pair| *pair != [None; 2]) else { return Ok(None) };
        let mut bits = Vec::new();
        for bit in (last_bit..table.len()).rev() {
            let [Some(picture), inverse] = table[bit] else {
                let reason = format!("bit {bit} of the Gray code along {direction:?} is missing");
                return Err(LightError::field("sequence.patterns", reason));
            };
            if inverse.is_none() && white_black.is_none() {
                let reason = "a bit without its inverse needs a white and a black picture to compare with";
                return Err(LightError::field(format!("sequence.patterns[{picture}]"), reason));
            }
            bits.push((picture, inverse));
        }
        Ok(Some(Self { length_px, last_bit: last_bit as u32, bits, white_black }))
    }

    /// Projector pixels a code names.
    pub fn cell_px(&self) -> u32 {
        1 << self.last_bit
    }

    /// Coordinate that a code names, projector pixels.
    pub fn centre_px(&self, code: u32) -> f32 {
        let cell_px = self.cell_px() as f32;
        code as f32 * cell_px + 0.5 * (cell_px - 1.0)
    }

    /// Range from dark to bright of pixel `i`, grey levels, and the sum of both.
    fn range(&self, pictures: &[&GreyPicture], i: usize) -> (f32, f32) {
        let of = |bright: usize, dark: usize| {
            let (b, d) = (f32::from(pictures[bright].pixels[i]), f32::from(pictures[dark].pixels[i]));
            (b - d, b + d)
        };
        if let Some((white, black)) = self.white_black {
            return of(white, black);
        }
        let pairs = self.bits.iter().filter_map(|&(picture, inverse)| Some(of(picture, inverse?)));
        pairs.map(|(range, sum)| (range.abs(), sum)).fold((0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a })
    }

    /// Difference of pixel `i` in one bit, positive for 1, grey levels.
    #[inline]
    fn difference(&self, pictures: &[&GreyPicture], bit: (usize, Option<usize>), i: usize) -> f32 {
        let level = |picture: usize| f32::from(pictures[picture].pixels[i]);
        match (bit.1, self.white_black) {
            (Some(inverse), _) => level(bit.0) - level(inverse),
            (None, Some((white, black))) => 2.0 * level(bit.0) - level(white) - level(black),
            // `new` refuses such a sequence.
            (None, None) => 0.0,
        }
    }

    /// Whether any picture that the code is read from clips pixel `i`, so that differences no longer say where an edge is.
    fn is_saturated(&self, pictures: &[&GreyPicture], level: u8, i: usize) -> bool {
        let is_clipped = |picture: usize| pictures[picture].pixels[i] >= level;
        self.bits.iter().any(|&(picture, inverse)| is_clipped(picture) || inverse.is_some_and(is_clipped))
            || self.white_black.is_some_and(|(white, black)| is_clipped(white) || is_clipped(black))
    }

    /// Rejects, in `mask`, pixels that are saturated, and those that the projector does not light or lights too little; `limits` are those of a sinusoid,
    /// whose modulation is half the range.
    ///
    /// # Panics
    /// When pictures and mask differ in size.
    pub fn reject_shadow(&self, pictures: &[&GreyPicture], limits: MaskLimits, mask: &mut PixelMask) {
        for i in 0..mask.verdicts.len() {
            let (range, sum) = self.range(pictures, i);
            let new = if self.is_saturated(pictures, limits.saturated_level, i) {
                Rejection::Saturated
            } else if range < 2.0 * limits.min_modulation {
                Rejection::Shadow
            } else if range < limits.min_data_modulation * sum {
                Rejection::LowDataModulation
            } else {
                continue;
            };
            if mask.is_kept(i) {
                mask.verdicts[i] = new;
            }
        }
    }

    /// Codes of all kept pixels; rejects, in `mask`, those with two or more uncertain bits, and codes beyond the projector.
    ///
    /// # Panics
    /// When pictures and mask differ in size.
    pub fn decode(&self, pictures: &[&GreyPicture], mask: &mut PixelMask) -> GrayCodes {
        let n = mask.verdicts.len();
        let mut out = GrayCodes { codes: vec![0; n], confidence: vec![0.0; n] };
        for i in (0..n).filter(|&i| mask.verdicts[i] == Rejection::Kept).collect::<Vec<_>>() {
            let (range, _) = self.range(pictures, i);
            let (mut least, mut second) = (f32::INFINITY, f32::INFINITY);
            let (mut code, mut binary) = (0, 0);
            for &bit in &self.bits {
                let difference = self.difference(pictures, bit, i);
                binary ^= u32::from(difference > 0.0);
                code = code << 1 | binary;
                let contrast = difference.abs();
                second = second.min(least.max(contrast));
                least = least.min(contrast);
            }
            // A code of one bit has no second.
            let second = second.min(range);
            out.codes[i] = code;
            out.confidence[i] = (second / range).clamp(0.0, 1.0);
            if second < MIN_BIT_LEVELS.max(MIN_BIT_CONTRAST * range) {
                mask.verdicts[i] = Rejection::UncertainBit;
            } else if u64::from(code) << self.last_bit >= u64::from(self.length_px) {
                mask.verdicts[i] = Rejection::CodeRange;
            }
        }
        out
    }

    /// Coordinates of all kept pixels, projector pixels: between two projected edges by interpolation along the picture's
    /// rows or columns, whichever cross more edges; elsewhere the centre that the code names.
    ///
    /// # Panics
    /// When pictures, codes and mask differ in size.
    pub fn coordinates_px(&self, pictures: &[&GreyPicture], codes: &GrayCodes, mask: &PixelMask) -> Vec<f32> {
        let (w, h) = (mask.width_px, mask.height_px);
        let mut out: Vec<f32> = codes.codes.iter().map(|&code| self.centre_px(code)).collect();
        let edges = |lines: usize, count: usize, line_step: usize, step: usize| {
            let line = |l: usize| (0..count.saturating_sub(1)).map(move |k| l * line_step + k * step);
            (0..lines).flat_map(line).filter(|&i| self.is_edge(codes, mask, i, i + step)).count()
        };
        let along_rows = edges(h, w, w, 1) >= edges(w, h, 1, w);
        let (lines, count, line_step, step) = if along_rows { (h, w, w, 1) } else { (w, h, 1, w) };
        for line in 0..lines {
            self.refine_line(pictures, codes, mask, Line { start: line * line_step, step, count }, &mut out);
        }
        out
    }

    fn is_edge(&self, codes: &GrayCodes, mask: &PixelMask, a: usize, b: usize) -> bool {
        mask.is_kept(a) && mask.is_kept(b) && codes.codes[a].abs_diff(codes.codes[b]) == 1
    }

    fn refine_line(&self, pictures: &[&GreyPicture], codes: &GrayCodes, mask: &PixelMask, line: Line, out: &mut [f32]) {
        let mut previous: Option<(usize, f32, f32)> = None;
        for k in 0..line.count.saturating_sub(1) {
            let (a, b) = (line.start + k * line.step, line.start + (k + 1) * line.step);
            if !self.is_edge(codes, mask, a, b) {
                let is_same = mask.is_kept(a) && mask.is_kept(b) && codes.codes[a] == codes.codes[b];
                previous = previous.filter(|_| is_same);
                continue;
            }
            let gray = |code: u32| code ^ (code >> 1);
            let changed = (gray(codes.codes[a]) ^ gray(codes.codes[b])).trailing_zeros() as usize;
            let bit = self.bits[self.bits.len() - 1 - changed];
            let (da, db) = (self.difference(pictures, bit, a), self.difference(pictures, bit, b));
            // One of both may be zero, not both: the codes differ.
            let position = k as f32 + (da / (da - db)).clamp(0.0, 1.0);
            let value = codes.codes[a].max(codes.codes[b]) as f32 * self.cell_px() as f32 - 0.5;
            if let Some((first, from, from_value)) = previous {
                let slope = (value - from_value) / (position - from).max(1e-3);
                for j in first..=k {
                    out[line.start + j * line.step] = from_value + slope * (j as f32 - from).max(0.0);
                }
            }
            previous = Some((k + 1, position, value));
        }
    }
}

/// A row or column of the picture.
#[derive(Debug, Clone, Copy)]
struct Line {
    start: usize,
    step: usize,
    count: usize,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::Pattern;

    /// The pictures of a camera whose pixel (x, y) sees projector coordinate `u_px(x, y)`, box-filtered over `width` of it.
    fn pictures(
        sequence: &PatternSequence,
        size: [u32; 2],
        width: f64,
        u_px: impl Fn(u32, u32) -> f64,
    ) -> Vec<GreyPicture> {
        let one = |index: usize| {
            let pattern = sequence.patterns[index];
            let level = |x: u32, y: u32| {
                let samples = 16;
                let mean = (0..samples)
                    .map(|s| {
                        let u = u_px(x, y) + width * ((f64::from(s) + 0.5) / f64::from(samples) - 0.5);
                        pattern.level(u.round().clamp(0.0, f64::from(sequence.length_px(index) - 1)) as u32)
                    })
                    .sum::<f64>()
                    / f64::from(samples);
                // Albedo changes from pixel to pixel by a factor of two.
                (10.0 + mean * (100.0 + f64::from((x * 37 + y * 11) % 100))).round() as u8
            };
            let pixels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x, y))).map(|(x, y)| level(x, y));
            GreyPicture::new(size[0], size[1], pixels.collect())
        };
        (0..sequence.patterns.len()).map(one).collect()
    }

    #[test]
    fn codes_name_pixel_centres_and_edges_refine_them() {
        for direction in [Direction::Columns, Direction::Rows] {
            let sequence = PatternSequence::gray_code([300, 200], &[direction]);
            let u = |x: u32, y: u32| match direction {
                Direction::Columns => 40.0 + 0.47 * f64::from(x) + 0.05 * f64::from(y),
                Direction::Rows => 30.0 + 0.05 * f64::from(x) + 0.47 * f64::from(y),
            };
            let pictures = pictures(&sequence, [160, 120], 0.6, u);
            let refs: Vec<&GreyPicture> = pictures.iter().collect();
            let decoder = GrayDecoder::new(&sequence, direction).unwrap().unwrap();
            let mut mask = PixelMask::new(160, 120);
            decoder.reject_shadow(&refs, MaskLimits::default(), &mut mask);
            let codes = decoder.decode(&refs, &mut mask);
            assert_eq!(mask.count().total(), 0);
            let fine = decoder.coordinates_px(&refs, &codes, &mask);
            let (mut coarse_sum, mut fine_sum) = (0.0, 0.0);
            for i in 0..160 * 120 {
                let truth = u(i % 160, i / 160);
                assert!((f64::from(codes.codes[i as usize]) - truth).abs() < 0.85, "{i}");
                coarse_sum += (f64::from(codes.codes[i as usize]) - truth).powi(2);
                fine_sum += (f64::from(fine[i as usize]) - truth).powi(2);
            }
            assert!(fine_sum < 0.1 * coarse_sum, "{fine_sum} against {coarse_sum}");
        }
    }

    #[test]
    fn shadow_doubt_and_codes_beyond_the_projector_are_told_apart() {
        let sequence = PatternSequence::gray_code([300, 200], &[Direction::Columns]);
        let mut pictures = pictures(&sequence, [4, 1], 0.0, |x, _| f64::from(x) * 50.0);
        let white = sequence.patterns.iter().position(|p| p.kind == PatternKind::White).unwrap();
        pictures[white].pixels[0] = 12;
        for picture in [2, 3, 8, 9] {
            pictures[picture].pixels[1] = 70;
        }
        // 511 is 100000000 in Gray code: bright in the first pair, dark in the others.
        for picture in &mut pictures[..18].chunks_exact_mut(2).skip(1) {
            (picture[0].pixels[2], picture[1].pixels[2]) = (10, 120);
        }
        (pictures[0].pixels[2], pictures[1].pixels[2]) = (120, 10);
        let refs: Vec<&GreyPicture> = pictures.iter().collect();
        let decoder = GrayDecoder::new(&sequence, Direction::Columns).unwrap().unwrap();
        let mut mask = PixelMask::new(4, 1);
        decoder.reject_shadow(&refs, MaskLimits::default(), &mut mask);
        let codes = decoder.decode(&refs, &mut mask);
        let expected = [Rejection::Shadow, Rejection::UncertainBit, Rejection::CodeRange, Rejection::Kept];
        assert_eq!(mask.verdicts, expected);
        assert_eq!(codes.codes[3], 150);
        assert!(codes.confidence[3] > 0.9 && codes.confidence[1] < 0.05);
    }

    #[test]
    fn a_clipped_picture_rejects_the_pixel_as_saturated() {
        let sequence = PatternSequence::gray_code([300, 200], &[Direction::Columns]);
        for picture in [3, 18] {
            let mut pictures = pictures(&sequence, [4, 1], 0.0, |x, _| f64::from(x) * 50.0);
            pictures[picture].pixels[2] = 253;
            let refs: Vec<&GreyPicture> = pictures.iter().collect();
            let mut mask = PixelMask::new(4, 1);
            let decoder = GrayDecoder::new(&sequence, Direction::Columns).unwrap().unwrap();
            decoder.reject_shadow(&refs, MaskLimits::default(), &mut mask);
            assert_eq!((mask.verdicts[2], mask.count().saturated), (Rejection::Saturated, 1), "picture {picture}");
        }
    }

    #[test]
    fn incomplete_codes_are_refused() {
        let whole = PatternSequence::gray_code([300, 200], &[Direction::Columns]);
        assert_eq!(GrayDecoder::new(&whole, Direction::Rows).unwrap(), None);
        let error = |change: fn(&mut Vec<Pattern>)| {
            let mut sequence = whole.clone();
            change(&mut sequence.patterns);
            GrayDecoder::new(&sequence, Direction::Columns).unwrap_err().to_string()
        };
        assert!(error(|p| drop(p.drain(4..6))).contains("bit 6 of the Gray code along Columns is missing"));
        assert!(error(|p| p[5] = p[4]).contains("patterns[5].bit: 6 is there twice"));
        assert!(
            error(|p| {
                p.retain(|p| p.kind != PatternKind::White && !matches!(p.kind, PatternKind::Gray { inverse: true, .. }))
            })
            .contains("needs a white and a black picture")
        );
    }
}
