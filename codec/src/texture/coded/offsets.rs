//! Where blocks of pixels come from: one offset for all pixels of a block, as the blocks of affine motion have in ITU-T H.266
//! (section 8.5.5.9).

/// Columns and rows of a block, px.
pub const BLOCK: usize = 4;
/// Offset of a block that the other picture does not show.
pub const NOWHERE: [i32; 2] = [i32::MIN; 2];

/// Parts that the way from the middle of a block to the next one has.
const WHOLE: i64 = 2 * BLOCK as i64;

/// For each block of a picture how far its pixels lie from there in another picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Offsets {
    /// Blocks a row.
    pub columns: usize,
    /// (x, y) in 1/256 px, rows of blocks; [`NOWHERE`] for a block that is not shown.
    pub blocks: Vec<[i32; 2]>,
}

impl Offsets {
    /// One offset for a whole picture of this size.
    pub fn even(width: usize, height: usize, offset: [i32; 2]) -> Self {
        let columns = width.div_ceil(BLOCK);
        Self { columns, blocks: vec![offset; columns * height.div_ceil(BLOCK)] }
    }

    /// Offset of a pixel, 1/256 px.
    pub fn at(&self, x: usize, y: usize) -> [i32; 2] {
        self.blocks[y / BLOCK * self.columns + x / BLOCK]
    }

    /// Offset of a pixel, linear between the middles of blocks, 1/256 px.
    ///
    /// # Panics
    /// When the pixel is in no block.
    pub fn between(&self, x: usize, y: usize) -> [i32; 2] {
        let rows = self.blocks.len() / self.columns;
        // In eighths of a block from the middle of the first one.
        let along = |v: usize, count: usize| {
            let from_middle = (2 * v).saturating_sub(BLOCK - 1);
            let first = from_middle / (2 * BLOCK);
            (first, (first + 1).min(count - 1), (from_middle % (2 * BLOCK)) as i64)
        };
        let ((left, right, fx), (above, below, fy)) = (along(x, self.columns), along(y, rows));
        let row = |row: usize, k: usize| {
            let [a, b] = [left, right].map(|column| i64::from(self.blocks[row * self.columns + column][k]));
            a * (WHOLE - fx) + b * fx
        };
        [0, 1].map(|k| ((row(above, k) * (WHOLE - fy) + row(below, k) * fy) / (WHOLE * WHOLE)) as i32)
    }

    /// First pixel of a block.
    pub fn corner(&self, block: usize) -> [usize; 2] {
        [block % self.columns * BLOCK, block / self.columns * BLOCK]
    }
}
