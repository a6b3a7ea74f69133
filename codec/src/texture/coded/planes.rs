//! Pictures in sixteenths of a grey level: one plane, or brightness and two of colour.

use super::canvas::NOT_YET;
use crate::GreyPicture;

/// Fraction bits of a grey level.
pub const LEVEL_BITS: u32 = 4;
/// Largest value of a pixel.
pub const MAX_VALUE: i32 = 255 << LEVEL_BITS;

/// A picture of one or three planes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Planes {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// For each plane its pixels, row-major, 0 to 255 x 16.
    pub levels: Vec<Vec<i16>>,
}

impl Planes {
    /// One plane.
    pub fn from_grey(picture: &GreyPicture) -> Self {
        let levels = picture.pixels.iter().map(|p| i16::from(*p) << LEVEL_BITS).collect();
        Self { width: picture.width_px as usize, height: picture.height_px as usize, levels: vec![levels] }
    }

    /// Three planes of a colour picture: Y, Co and Cg (H. S. Malvar, G. J. Sullivan, "YCoCg-R", JVT-I014, 2003), the latter
    /// two halved and about 128.
    ///
    /// # Panics
    /// When `rgb` does not hold `width` x `height` pixels.
    pub fn from_rgb(width: usize, height: usize, rgb: &[[u8; 3]]) -> Self {
        assert_eq!(rgb.len(), width * height, "picture size and data differ");
        let mut levels: Vec<Vec<i16>> = (0..3).map(|_| Vec::with_capacity(rgb.len())).collect();
        for [r, g, b] in rgb.iter().map(|p| p.map(i32::from)) {
            let co = r - b;
            let t = 2 * b + co;
            let cg = 2 * g - t;
            let y = 2 * t + cg;
            let values = [y * 4, 128 * 16 + co * 8, 128 * 16 + cg * 4];
            levels.iter_mut().zip(values).for_each(|(l, v)| l.push(v.clamp(0, MAX_VALUE) as i16));
        }
        Self { width, height, levels }
    }

    /// Brightness rounded to grey levels.
    pub fn to_grey(&self) -> GreyPicture {
        let pixels = self.levels[0].iter().map(|v| rounded(i32::from(*v), LEVEL_BITS)).collect();
        GreyPicture::new(self.width as u32, self.height as u32, pixels)
    }

    /// Red, green and blue of each pixel.
    pub fn to_rgb(&self) -> Vec<[u8; 3]> {
        let [y, co, cg] = match &self.levels[..] {
            [y, co, cg] => [y, co, cg],
            _ => return self.to_grey().pixels.iter().map(|p| [*p; 3]).collect(),
        };
        let pixels = y.iter().zip(co).zip(cg).map(|((y, co), cg)| {
            // In 1/32 of a grey level.
            let (y, co, cg) = (2 * i32::from(*y), 4 * (i32::from(*co) - 2048), 4 * (i32::from(*cg) - 2048));
            let rest = y - cg / 2;
            [rest + co / 2, y + cg / 2, rest - co / 2].map(|v| rounded(v, LEVEL_BITS + 1))
        });
        pixels.collect()
    }

    /// Number of planes, width and height.
    pub(super) fn shape(&self) -> (usize, [usize; 2]) {
        (self.levels.len(), [self.width, self.height])
    }

    /// Decoded planes, what is [`NOT_YET`] in them continued.
    pub(super) fn continued(width: usize, mut levels: Vec<Vec<i16>>) -> Self {
        levels.iter_mut().for_each(|l| continue_outside(l, width));
        Self { width, height: levels[0].len() / width, levels }
    }
}

fn rounded(value: i32, bits: u32) -> u8 {
    ((value + (1 << (bits - 1))) >> bits).clamp(0, 255) as u8
}

/// As [`continue_unknown`] for pixels that are [`NOT_YET`]; a plane without any becomes middle grey.
pub fn continue_outside(pixels: &mut [i16], width: usize) {
    if !continue_unknown(pixels, width, NOT_YET) {
        pixels.fill(128 << LEVEL_BITS);
    }
}

/// Gives pixels that are `unknown` the nearest value of their row (the later one of two alike), rows without any the
/// nearest row that has one (the earlier of two alike). False when there is none at all.
///
/// # Panics
/// When the pixels are no whole rows.
pub fn continue_unknown<T: Copy + PartialEq>(pixels: &mut [T], width: usize, unknown: T) -> bool {
    let height = pixels.len() / width;
    let mut filled: Option<usize> = None;
    for y in 0..height {
        if !continue_row(&mut pixels[y * width..(y + 1) * width], unknown) {
            continue;
        }
        for above in filled.map_or(0, |f| f + 1)..y {
            let from = filled.filter(|f| above - f <= y - above).unwrap_or(y);
            pixels.copy_within(from * width..(from + 1) * width, above * width);
        }
        filled = Some(y);
    }
    let Some(last) = filled else { return false };
    (last + 1..height).for_each(|y| pixels.copy_within(last * width..(last + 1) * width, y * width));
    true
}

/// False for a row without any value.
fn continue_row<T: Copy + PartialEq>(row: &mut [T], unknown: T) -> bool {
    let known = |p: &T| *p != unknown;
    let Some(first) = row.iter().position(known) else { return false };
    let value = row[first];
    row[..first].fill(value);
    let mut last = first;
    while let Some(gap) = row[last..].iter().position(|p| *p == unknown).map(|n| last + n) {
        let before = row[gap - 1];
        match row[gap..].iter().position(known).map(|n| gap + n) {
            Some(end) => {
                let middle = gap + (end - gap) / 2;
                row[gap..middle].fill(before);
                let after = row[end];
                row[middle..end].fill(after);
                last = end;
            }
            None => {
                row[gap..].fill(before);
                break;
            }
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_take_the_nearest_value() {
        const N: i16 = NOT_YET;
        let mut pixels = vec![N, N, N, N, N, N, 5, N, N, 8, N, N, N, N, N, N, N, N, N, 7];
        continue_outside(&mut pixels, 5);
        assert_eq!(pixels[..5], [5, 5, 5, 8, 8]);
        assert_eq!(pixels[5..10], [5, 5, 5, 8, 8]);
        assert_eq!(pixels[10..], [5, 5, 5, 8, 8, 7, 7, 7, 7, 7]);
        let mut nothing = vec![N; 6];
        continue_outside(&mut nothing, 3);
        assert_eq!(nothing, [2048; 6]);
    }

    #[test]
    fn colours_come_back_within_one_level() {
        let rgb: Vec<[u8; 3]> =
            (0..512).map(|i| [(i % 8 * 36) as u8, (i / 8 % 8 * 36) as u8, (i / 64 * 36) as u8]).collect();
        let back = Planes::from_rgb(32, 16, &rgb).to_rgb();
        for (a, b) in rgb.iter().flatten().zip(back.iter().flatten()) {
            assert!(a.abs_diff(*b) <= 1, "{a} became {b}");
        }
    }
}
