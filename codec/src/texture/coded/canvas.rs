//! The picture being decoded: blocks are predicted, corrected and written here, and their neighbours ask what they were.

use super::levels::{Levels, Shape, activity};
use super::planes::{LEVEL_BITS, MAX_VALUE};
use super::transform::{MAX_AREA, MAX_SIDE, inverse};
use std::ops::Range;

/// Side of the largest block.
pub const SUPER: usize = MAX_SIDE;
/// Side of the smallest block.
pub const CELL: usize = 8;
/// A pixel that is not decoded yet.
pub const NOT_YET: i16 = i16::MIN;

/// What pixels are expected to be, 1/16 grey level.
#[derive(Debug, Clone, Copy)]
pub enum Prediction<'a> {
    /// Each as in a picture.
    Pixels(&'a [i16]),
    /// All alike.
    Mean(i32),
}

impl Prediction<'_> {
    /// Of a pixel of the picture.
    pub fn at(&self, pixel: usize) -> i32 {
        match self {
            Self::Pixels(p) => i32::from(p[pixel]),
            Self::Mean(mean) => *mean,
        }
    }
}

/// A square of pixels.
#[derive(Debug, Clone, Copy)]
pub struct Square {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns and rows.
    pub side: usize,
}

/// A block that is not split.
#[derive(Debug, Clone)]
pub struct Leaf {
    /// Predicted from the same picture.
    pub intra: bool,
    /// Quantized coefficients of the correction.
    pub levels: Levels,
}

/// What is known of the block that covers 8x8 px; all zero for none.
#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    activity: u8,
    reach: u8,
    intra: bool,
    side: u8,
}

/// Decoded pixels of a plane and what is known of its blocks.
#[derive(Debug)]
pub struct Canvas<'a> {
    width: usize,
    height: usize,
    /// Pixels that count.
    pub mask: &'a [bool],
    /// What the pixels are expected to be, 1/16 grey level.
    pub prediction: Option<&'a [i16]>,
    /// Decoded pixels.
    pub pixels: Vec<i16>,
    /// Size of a level, 1/16 grey level.
    pub step: i32,
    cells: Vec<Cell>,
    columns: usize,
}

impl<'a> Canvas<'a> {
    /// An empty canvas.
    pub fn new(width: usize, mask: &'a [bool], prediction: Option<&'a [i16]>, step: i32) -> Self {
        let height = mask.len() / width;
        let columns = width.div_ceil(CELL);
        let cells = vec![Cell::default(); columns * height.div_ceil(CELL)];
        Self { width, height, mask, prediction, pixels: vec![NOT_YET; width * height], step, cells, columns }
    }

    /// Pixels of each row of a square inside the picture, with the place of the first in the square, row-major.
    pub fn rows(&self, s: Square) -> impl Iterator<Item = (Range<usize>, usize)> + use<'a> {
        let (w, h) = (self.width, self.height);
        let end = (s.x + s.side).min(w);
        (s.y..(s.y + s.side).min(h)).map(move |y| (y * w + s.x..y * w + end, (y - s.y) * s.side))
    }

    /// Pixels of a square that count.
    pub fn count(&self, s: Square) -> usize {
        let end = (s.x + s.side).min(self.width);
        if s.x >= end {
            return 0;
        }
        let row = |y: usize| self.mask[y * self.width + s.x..y * self.width + end].iter().filter(|m| **m).count();
        (s.y..(s.y + s.side).min(self.height)).map(row).sum()
    }

    /// Cells on the left and above a square's first pixel.
    fn neighbours(&self, s: Square) -> [Cell; 2] {
        let at = s.y / CELL * self.columns + s.x / CELL;
        let left = if s.x > 0 { self.cells[at - 1] } else { Cell::default() };
        let above = if s.y > 0 { self.cells[at - self.columns] } else { Cell::default() };
        [left, above]
    }

    /// Contexts of a square's coefficients.
    pub fn shape(&self, s: Square, intra: bool) -> Shape {
        let [left, above] = self.neighbours(s);
        let reach = (usize::from(left.reach) + usize::from(above.reach)) / 8;
        Shape { side: s.side, intra, activity: [left.activity.into(), above.activity.into()], reach }
    }

    /// Context of a split flag: 0 to 2 neighbours are smaller.
    pub fn smaller(&self, s: Square) -> usize {
        self.neighbours(s).iter().filter(|c| c.side > 0 && usize::from(c.side) < s.side).count()
    }

    /// Context of an intra flag.
    pub fn intra_around(&self, s: Square) -> usize {
        self.neighbours(s).iter().filter(|c| c.intra).count()
    }

    /// Mean of the decoded pixels above and on the left, which predicts a block without reference.
    fn mean_around(&self, s: Square) -> i32 {
        let (mut sum, mut count) = (0, 0);
        let mut take = |i: usize| {
            if self.mask[i] && self.pixels[i] != NOT_YET {
                sum += i32::from(self.pixels[i]);
                count += 1;
            }
        };
        if s.y > 0 {
            (s.x..(s.x + s.side).min(self.width)).for_each(|x| take((s.y - 1) * self.width + x));
        }
        if s.x > 0 {
            (s.y..(s.y + s.side).min(self.height)).for_each(|y| take(y * self.width + s.x - 1));
        }
        if count > 0 { (sum + count / 2) / count } else { 128 << LEVEL_BITS }
    }

    /// Prediction of a square, where it is one of each pixel; the mean of its neighbours, where it is one for all.
    pub fn predict(&self, s: Square, intra: bool) -> Prediction<'a> {
        match self.prediction {
            Some(p) if !intra => Prediction::Pixels(p),
            _ => Prediction::Mean(self.mean_around(s)),
        }
    }

    /// Writes a decoded block.
    pub fn put(&mut self, s: Square, leaf: &Leaf) {
        let base = self.predict(s, leaf.intra);
        let mut correction = [0_i32; MAX_AREA];
        if leaf.levels.extent > 0 {
            inverse(&leaf.levels, s.side, self.step, &mut correction[..s.side * s.side]);
        }
        for (row, k) in self.rows(s) {
            let (mask, out) = (&self.mask[row.clone()], &mut self.pixels[row.clone()]);
            for (((i, on), out), correction) in row.zip(mask).zip(out).zip(&correction[k..]) {
                if *on {
                    *out = (base.at(i) + correction).clamp(0, MAX_VALUE) as i16;
                }
            }
        }
        let cell = Cell {
            activity: activity(&leaf.levels, s.side),
            reach: (leaf.levels.extent * (SUPER / s.side)).min(255) as u8,
            intra: leaf.intra,
            side: s.side as u8,
        };
        for y in (s.y / CELL)..((s.y + s.side) / CELL).min(self.height.div_ceil(CELL)) {
            for x in (s.x / CELL)..((s.x + s.side) / CELL).min(self.columns) {
                self.cells[y * self.columns + x] = cell;
            }
        }
    }
}

/// All 32x32 squares of a picture in coding order.
pub fn squares(width: usize, height: usize) -> impl Iterator<Item = Square> {
    (0..height).step_by(SUPER).flat_map(move |y| (0..width).step_by(SUPER).map(move |x| Square { x, y, side: SUPER }))
}

/// The four quarters of a square in coding order.
pub fn quarters(s: Square) -> [Square; 4] {
    let side = s.side / 2;
    [(0, 0), (side, 0), (0, side), (side, side)].map(|(dx, dy)| Square { x: s.x + dx, y: s.y + dy, side })
}
