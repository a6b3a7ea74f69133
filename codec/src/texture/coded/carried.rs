//! Decoded pictures seen through offsets of blocks.

use super::canvas::NOT_YET;
use super::offsets::{BLOCK, NOWHERE, Offsets};
use super::planes::{MAX_VALUE, Planes, continue_outside};
use super::shifts::Shifts;

/// Weights of two sources add up to this.
const WHOLE: i32 = 256;
/// Taps of the interpolation.
const TAPS: usize = 8;
/// Rows and columns that the pixels of a block are interpolated from.
const REACH: usize = BLOCK + TAPS - 1;
/// Columns that are read: whole vectors.
const READ: usize = 12;
/// Bits dropped after the first direction, so that sums fit 16 bits, and after the second.
const DROPPED: [u32; 2] = [4, 8];
/// Largest offset, 1/256 px.
const MAX_OFFSET: i32 = 1 << 28;

/// Interpolation at 1/16 px: the luma filters of ITU-T H.266 (section 8.5.6.3.2), sum 64.
const FILTER: [[i16; TAPS]; 16] = [
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
    /// From each block of the new picture to this one.
    pub offsets: &'a Offsets,
    /// Weight, 0 to 256, for blending two; the two add up to 256.
    pub weight: u16,
}

/// Pixels of a block, row-major; [`NOT_YET`] where its source does not show it.
type Block = [i16; BLOCK * BLOCK];

/// What the sources let expect of a picture of so many planes and this width and height where `mask` holds; `None` without
/// sources.
///
/// # Panics
/// When the sources do not fit the picture.
pub fn expect(
    sources: &[Source<'_>],
    shifts: &Shifts,
    (planes, [width, height]): (usize, [usize; 2]),
    mask: &[bool],
) -> Option<Planes> {
    let first = sources.first()?;
    let blocks = width.div_ceil(BLOCK) * height.div_ceil(BLOCK);
    for s in sources {
        assert_eq!((s.offsets.blocks.len(), s.planes.levels.len()), (blocks, planes), "a source fits its picture");
    }
    let shifts = Some(shifts).filter(|s| !s.is_none());
    let plane = |p: usize| {
        let mut pixels = vec![NOT_YET; width * height];
        for block in 0..blocks {
            let [x, y] = first.offsets.corner(block);
            let (columns, rows) = (BLOCK.min(width - x), BLOCK.min(height - y));
            let starts = (0..rows).map(|row| (y + row) * width + x);
            if !starts.clone().any(|at| mask[at..at + columns].contains(&true)) {
                continue;
            }
            let expected = match sources {
                [one] => refined(one, p, block, shifts, [width, height]),
                [one, two] => {
                    let weight = i32::from(two.weight).min(WHOLE);
                    blend(moved(one, p, block), &moved(two, p, block), weight)
                }
                _ => panic!("a picture has none, one or two sources"),
            };
            for (at, row) in starts.zip(expected.chunks_exact(BLOCK)) {
                pixels[at..at + columns].copy_from_slice(&row[..columns]);
            }
        }
        continue_outside(&mut pixels, width);
        pixels
    };
    Some(Planes { width, height, levels: (0..planes).map(plane).collect() })
}

fn blend(mut one: Block, two: &Block, weight: i32) -> Block {
    match (one[0], two[0]) {
        (NOT_YET, _) => return *two,
        (_, NOT_YET) => return one,
        _ => {}
    }
    for (a, b) in one.iter_mut().zip(two) {
        *a = ((i32::from(*a) * (WHOLE - weight) + i32::from(*b) * weight + WHOLE / 2) >> 8) as i16;
    }
    one
}

/// A block as its source shows it.
fn moved(source: &Source<'_>, plane: usize, block: usize) -> Block {
    let offset = source.offsets.blocks[block];
    if offset == NOWHERE {
        return [NOT_YET; BLOCK * BLOCK];
    }
    let corner = source.offsets.corner(block);
    View::new(source, plane).block([0, 1].map(|k| place(corner[k], offset[k])))
}

/// A block of a single source, whose pixels have offsets of their own, `shifts` further on.
fn refined(source: &Source<'_>, plane: usize, block: usize, shifts: Option<&Shifts>, size: [usize; 2]) -> Block {
    let mut out = [NOT_YET; BLOCK * BLOCK];
    if source.offsets.blocks[block] == NOWHERE {
        return out;
    }
    let (corner, view) = (source.offsets.corner(block), View::new(source, plane));
    for (k, out) in out.iter_mut().enumerate() {
        let [x, y] = [corner[0] + k % BLOCK, corner[1] + k / BLOCK];
        if x < size[0] && y < size[1] {
            let (offset, shift) = (source.offsets.between(x, y), shifts.map_or([0; 2], |s| s.at(x, y)));
            *out = view.pixel([place(x, offset[0] + shift[0]), place(y, offset[1] + shift[1])]);
        }
    }
    out
}

fn place(v: usize, offset: i32) -> i32 {
    ((v as i32) << 8) + offset.clamp(-MAX_OFFSET, MAX_OFFSET)
}

/// One plane of a source.
struct View<'a> {
    pixels: &'a [i16],
    width: usize,
    height: usize,
}

impl<'a> View<'a> {
    fn new(source: &Source<'a>, plane: usize) -> Self {
        Self { pixels: &source.planes.levels[plane], width: source.planes.width, height: source.planes.height }
    }

    /// The pixel at a position, as [`Self::block`] gives its first one.
    fn pixel(&self, at: [i32; 2]) -> i16 {
        let [x, y] = at.map(|v| (v + 8) >> 4);
        let (fx, fy) = (&FILTER[(x & 15) as usize], &FILTER[(y & 15) as usize]);
        let (x0, y0) = ((x >> 4) - 3, (y >> 4) - 3);
        let mut columns = [0_i32; TAPS];
        let taps = TAPS as i32;
        if x0 >= 0 && y0 >= 0 && x0 + taps <= self.width as i32 && y0 + taps <= self.height as i32 {
            let start = y0 as usize * self.width + x0 as usize;
            for (row, weight) in self.pixels[start..].chunks(self.width).zip(fy) {
                for (c, p) in columns.iter_mut().zip(&row[..TAPS]) {
                    *c += i32::from(*weight) * i32::from(*p);
                }
            }
        } else {
            let inside = |v: i32, size: usize| v.clamp(0, size as i32 - 1) as usize;
            for (j, weight) in (0..).zip(fy) {
                let row = inside(y0 + j, self.height) * self.width;
                for (i, c) in (0..).zip(&mut columns) {
                    *c += i32::from(*weight) * i32::from(self.pixels[row + inside(x0 + i, self.width)]);
                }
            }
        }
        let sum: i32 = columns.iter().zip(fx).map(|(c, weight)| (c >> DROPPED[0]) * i32::from(*weight)).sum();
        ((sum + (1 << (DROPPED[1] - 1))) >> DROPPED[1]).clamp(0, MAX_VALUE) as i16
    }

    /// The block whose first pixel is at a position (1/256 px, rounded to 1/16), the border continued.
    fn block(&self, at: [i32; 2]) -> Block {
        let [x, y] = at.map(|v| (v + 8) >> 4);
        let (fx, fy) = (&FILTER[(x & 15) as usize], &FILTER[(y & 15) as usize]);
        let (x0, y0) = ((x >> 4) - 3, (y >> 4) - 3);
        if x0 >= 0 && y0 >= 0 && x0 as usize + READ <= self.width && y0 as usize + REACH <= self.height {
            let start = y0 as usize * self.width + x0 as usize;
            return interpolate(&self.pixels[start..], self.width, fx, fy);
        }
        let inside = |v: i32, size: usize| v.clamp(0, size as i32 - 1) as usize;
        let mut around = [0; READ * REACH];
        for (j, row) in (0..).zip(around.chunks_exact_mut(READ)) {
            let from = inside(y0 + j, self.height) * self.width;
            for (i, out) in (0..).zip(row) {
                *out = self.pixels[from + inside(x0 + i, self.width)];
            }
        }
        interpolate(&around, READ, fx, fy)
    }
}

/// Interpolates a block between the pixels that begin three above and three to the left of it, rows `stride` apart.
fn interpolate(pixels: &[i16], stride: usize, fx: &[i16; TAPS], fy: &[i16; TAPS]) -> Block {
    let mut out = [0; BLOCK * BLOCK];
    for (r, out) in out.chunks_exact_mut(BLOCK).enumerate() {
        let mut columns = [0_i32; READ];
        for (row, weight) in pixels[r * stride..].chunks(stride).zip(fy) {
            for (c, p) in columns.iter_mut().zip(&row[..READ]) {
                *c += i32::from(*weight) * i32::from(*p);
            }
        }
        let columns = columns.map(|c| (c >> DROPPED[0]) as i16);
        let mut sums = [1_i32 << (DROPPED[1] - 1); BLOCK];
        for (i, weight) in fx.iter().enumerate() {
            for (s, c) in sums.iter_mut().zip(&columns[i..i + BLOCK]) {
                *s += i32::from(*weight) * i32::from(*c);
            }
        }
        for (o, s) in out.iter_mut().zip(sums) {
            *o = (s >> DROPPED[1]).clamp(0, MAX_VALUE) as i16;
        }
    }
    out
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
            assert_eq!(f.iter().sum::<i16>(), 64, "{k}");
            if k > 0 {
                assert!((0..TAPS).all(|i| f[i] == FILTER[16 - k][TAPS - 1 - i]), "{k}");
            }
        }
    }

    #[test]
    fn intermediate_sums_fit_sixteen_bits() {
        let most = |f: &[i16; TAPS], sign: i16| f.iter().map(|w| i32::from((*w * sign).max(0))).sum::<i32>();
        for f in &FILTER {
            for sign in [1, -1] {
                assert!((most(f, sign) * MAX_VALUE) >> DROPPED[0] <= i32::from(i16::MAX));
            }
        }
    }

    #[test]
    fn a_moved_wave_is_expected_where_it_is() {
        let (w, h) = (60, 50);
        let here = waves(w, h, 0.0, 0.0);
        for (dx, dy) in [(0.25, 0.0), (-1.5, 2.3125), (0.5, 0.5), (3.0, -2.0)] {
            let offsets = Offsets::even(w, h, [dx, dy].map(|v| (v * 256.0) as i32));
            let source = Source { planes: &here, offsets: &offsets, weight: 256 };
            let seen = expect(&[source], &Shifts::none(w, h), (1, [w, h]), &vec![true; w * h]).unwrap();
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
    fn a_block_that_one_source_shows_is_taken_from_it() {
        let plane = |v: i16| Planes { width: 12, height: 1, levels: vec![vec![v; 12]] };
        let (a, b) = (plane(160), plane(320));
        let at = |blocks: [[i32; 2]; 3]| Offsets { columns: 3, blocks: blocks.into() };
        let p = [0, 0];
        let sources = [
            Source { planes: &a, offsets: &at([p, NOWHERE, p]), weight: 64 },
            Source { planes: &b, offsets: &at([p, p, NOWHERE]), weight: 192 },
        ];
        let seen = expect(&sources, &Shifts::none(12, 1), (1, [12, 1]), &[true; 12]).unwrap();
        assert_eq!(seen.levels[0], [280, 280, 280, 280, 320, 320, 320, 320, 160, 160, 160, 160]);
        // Where the mask is off its neighbours go on.
        let mask = [vec![false; 4], vec![true; 8]].concat();
        let seen = expect(&sources, &Shifts::none(12, 1), (1, [12, 1]), &mask).unwrap();
        assert_eq!(seen.levels[0][..5], [320; 5]);
    }
}
