//! Decoded pictures seen through maps of positions.

use super::canvas::NOT_YET;
use super::planes::{MAX_VALUE, Planes, continue_outside};
use super::shifts::Shifts;

/// Position of a pixel that a source does not show.
pub const NOWHERE: [i32; 2] = [i32::MIN; 2];
/// Weights of two sources add up to this.
const WHOLE: i32 = 256;
/// Taps of the interpolation.
const TAPS: usize = 8;
/// Largest position, 1/256 px.
const MAX_PLACE: i32 = 1 << 28;

/// Interpolation at 1/16 px: the luma filters of ITU-T H.266 (section 8.5.6.3.2), sum 64.
const FILTER: [[i32; TAPS]; 16] = [
    [0, 0, 0, 64, 0, 0, 0, 0],
    [0, 1, -3, 63, 4, -2, 1, 0],
    [-1, 2, -5, 62, 8, -3, 1, 0],
    [-1, 3, -8, 60, 13, -4, 1, 0],
    [-1, 4, -10, 58, 17, -5, 1, 0],
    [-1, 4, -11, 52, 26, -8, 3, -1],
    [-1, 3, -9, 47, 31, -10, 4, -1],
    [-1, 4, -11, 45, 34, -10, 4, -1],
    [-1, 4, -11, 40, 40, -11, 4, -1],
    [-1, 4, -10, 34, 45, -11, 4, -1],
    [-1, 4, -10, 31, 47, -9, 3, -1],
    [-1, 3, -8, 26, 52, -11, 4, -1],
    [0, 1, -5, 17, 58, -10, 4, -1],
    [0, 1, -4, 13, 60, -8, 3, -1],
    [0, 1, -3, 8, 62, -5, 2, -1],
    [0, 1, -2, 4, 63, -3, 1, 0],
];

/// A decoded picture and where it shows what the new one shows.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// The decoded picture.
    pub planes: &'a Planes,
    /// For each pixel of the new picture its position in this one, 1/256 px; [`NOWHERE`] where it is not seen.
    pub places: &'a [[i32; 2]],
    /// Weight, 0 to 256, for blending two; the two add up to 256.
    pub weight: u16,
}

/// What the sources let expect of a picture of so many planes and this width and height; `None` without sources.
///
/// # Panics
/// When the sources do not fit the picture.
pub fn expect(
    sources: &[Source<'_>],
    shifts: &Shifts,
    (planes, [width, height]): (usize, [usize; 2]),
) -> Option<Planes> {
    for s in sources {
        assert_eq!((s.places.len(), s.planes.levels.len()), (width * height, planes), "a source fits its picture");
    }
    let plane = |p: usize| {
        let mut pixels = vec![NOT_YET; width * height];
        match sources {
            [one] => carry(one, p, Some(shifts), width, &mut pixels),
            [one, two] => {
                let mut second = pixels.clone();
                carry(one, p, None, width, &mut pixels);
                carry(two, p, None, width, &mut second);
                let weight = i32::from(two.weight).min(WHOLE);
                pixels.iter_mut().zip(second).for_each(|(a, b)| *a = blend(*a, b, weight));
            }
            _ => panic!("a picture has none, one or two sources"),
        }
        continue_outside(&mut pixels, width);
        pixels
    };
    (!sources.is_empty()).then(|| Planes { width, height, levels: (0..planes).map(plane).collect() })
}

fn blend(a: i16, b: i16, weight: i32) -> i16 {
    match (a, b) {
        (NOT_YET, v) | (v, NOT_YET) => v,
        _ => ((i32::from(a) * (WHOLE - weight) + i32::from(b) * weight + WHOLE / 2) >> 8) as i16,
    }
}

fn carry(source: &Source<'_>, plane: usize, shifts: Option<&Shifts>, width: usize, out: &mut [i16]) {
    let shifts = shifts.filter(|s| !s.is_none());
    let view = View { pixels: &source.planes.levels[plane], width: source.planes.width, height: source.planes.height };
    for (i, (out, place)) in out.iter_mut().zip(source.places).enumerate() {
        if *place != NOWHERE {
            let shift = shifts.map_or([0; 2], |s| s.at(i % width, i / width));
            *out = view.sample([0, 1].map(|k| place[k].clamp(-MAX_PLACE, MAX_PLACE) + shift[k]));
        }
    }
}

/// One plane of a source.
struct View<'a> {
    pixels: &'a [i16],
    width: usize,
    height: usize,
}

impl View<'_> {
    /// Value at a position (1/256 px, rounded to 1/16), the border continued.
    fn sample(&self, at: [i32; 2]) -> i16 {
        let [x, y] = at.map(|v| (v + 8) >> 4);
        let (fx, fy) = (&FILTER[(x & 15) as usize], &FILTER[(y & 15) as usize]);
        let (x0, y0) = ((x >> 4) - 3, (y >> 4) - 3);
        let mut columns = [0_i32; TAPS];
        let taps = TAPS as i32;
        if x0 >= 0 && y0 >= 0 && x0 + taps <= self.width as i32 && y0 + taps <= self.height as i32 {
            let start = y0 as usize * self.width + x0 as usize;
            for (row, weight) in self.pixels[start..].chunks(self.width).zip(fy) {
                for (c, p) in columns.iter_mut().zip(&row[..TAPS]) {
                    *c += weight * i32::from(*p);
                }
            }
        } else {
            let inside = |v: i32, size: usize| v.clamp(0, size as i32 - 1) as usize;
            for (j, weight) in (0..).zip(fy) {
                let row = inside(y0 + j, self.height) * self.width;
                for (i, c) in (0..).zip(&mut columns) {
                    *c += weight * i32::from(self.pixels[row + inside(x0 + i, self.width)]);
                }
            }
        }
        let sum: i32 = columns.iter().zip(fx).map(|(c, weight)| c * weight).sum();
        ((sum + (1 << 11)) >> 12).clamp(0, MAX_VALUE) as i16
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waves(width: usize, height: usize, dx: f64, dy: f64) -> Planes {
        let at = |i: usize| {
            let (x, y) = ((i % width) as f64 + dx, (i / width) as f64 + dy);
            (2000.0 + 900.0 * (0.7 * x + 0.2 * y).sin() + 700.0 * (0.5 * y - 0.3 * x).cos()) as i16
        };
        Planes { width, height, levels: vec![(0..width * height).map(at).collect()] }
    }

    #[test]
    fn filters_sum_to_one_and_mirror() {
        for (k, f) in FILTER.iter().enumerate() {
            assert_eq!(f.iter().sum::<i32>(), 64, "{k}");
            if k > 0 {
                assert!((0..TAPS).all(|i| f[i] == FILTER[16 - k][TAPS - 1 - i]), "{k}");
            }
        }
    }

    #[test]
    fn a_moved_wave_is_expected_where_it_is() {
        let (w, h) = (60, 50);
        let here = waves(w, h, 0.0, 0.0);
        for (dx, dy) in [(0.25, 0.0), (-1.5, 2.3125), (0.5, 0.5), (3.0, -2.0)] {
            let place = |i: usize| [(i % w) as f64 + dx, (i / w) as f64 + dy].map(|v| (v * 256.0) as i32);
            let places: Vec<_> = (0..w * h).map(place).collect();
            let source = Source { planes: &here, places: &places, weight: 256 };
            let seen = expect(&[source], &Shifts::none(w, h), (1, [w, h])).unwrap();
            let there = waves(w, h, dx, dy);
            for y in 8..h - 8 {
                for x in 8..w - 8 {
                    let i = y * w + x;
                    assert!((seen.levels[0][i] - there.levels[0][i]).abs() < 48, "{dx} {dy} at {x} {y}");
                }
            }
        }
    }

    #[test]
    fn a_pixel_that_one_source_shows_is_taken_from_it() {
        let plane = |v: i16| Planes { width: 3, height: 1, levels: vec![vec![v; 3]] };
        let (a, b) = (plane(160), plane(320));
        let p = [0, 0];
        let sources = [
            Source { planes: &a, places: &[p, NOWHERE, p], weight: 64 },
            Source { planes: &b, places: &[p, p, NOWHERE], weight: 192 },
        ];
        let seen = expect(&sources, &Shifts::none(3, 1), (1, [3, 1])).unwrap();
        assert_eq!(seen.levels[0], [280, 320, 160]);
    }
}
