//! The quadtree of blocks under each 32x32 square, one walk for both directions.

use super::canvas::{CELL, Canvas, Leaf, SUPER, Square, quarters};
use super::levels::{LevelModels, Levels};
use super::mixing::{Coder, Contexts, Mixer};

/// A square with what is in it.
#[derive(Debug, Clone)]
pub enum Block {
    /// Nothing of it counts.
    Empty,
    /// Four quarters: rows, then columns.
    Split(Box<[Block; 4]>),
    /// Not split.
    Whole(Leaf),
}

/// What the coder has learned of one plane.
#[derive(Debug, Clone)]
pub struct BlockModels {
    /// Coefficients.
    pub levels: LevelModels,
    flags: Mixer,
}

impl Default for BlockModels {
    fn default() -> Self {
        Self { levels: LevelModels::default(), flags: Mixer::new(64, 8) }
    }
}

impl BlockModels {
    fn split_contexts(canvas: &Canvas<'_>, s: Square) -> Contexts {
        let size = usize::from(s.side == SUPER);
        let i = (size * 3 + canvas.smaller(s)) * 2 + usize::from(canvas.prediction.is_some());
        Contexts { counters: [i as u32, 24 + size as u32, i as u32, 24 + size as u32], weights: size as u32 }
    }

    fn intra_contexts(canvas: &Canvas<'_>, s: Square) -> Contexts {
        let i = 32 + canvas.intra_around(s) as u32;
        let j = 40 + canvas.intra_around(s) as u32 * 4 + s.side.ilog2() - 3;
        Contexts { counters: [i, j, i, j], weights: 4 }
    }

    /// Cost of a split flag, 1/256 bit.
    pub fn split_cost(&self, canvas: &Canvas<'_>, s: Square) -> [u32; 2] {
        self.flags.cost(&Self::split_contexts(canvas, s))
    }

    /// Cost of an intra flag, 1/256 bit.
    pub fn intra_cost(&self, canvas: &Canvas<'_>, s: Square) -> [u32; 2] {
        if canvas.prediction.is_none() { [0; 2] } else { self.flags.cost(&Self::intra_contexts(canvas, s)) }
    }

    /// Codes what is in a square, or reads it into `block`, and writes it to the canvas; `None` for what is out of range.
    pub fn code<C: Coder>(
        &mut self,
        coder: &mut C,
        canvas: &mut Canvas<'_>,
        s: Square,
        block: Option<&Block>,
    ) -> Option<()> {
        if canvas.count(s) == 0 {
            return Some(());
        }
        let split = s.side > CELL
            && coder.bit(&mut self.flags, &Self::split_contexts(canvas, s), matches!(block, Some(Block::Split(_))));
        if split {
            for (i, q) in quarters(s).into_iter().enumerate() {
                let inner = if let Some(Block::Split(b)) = block { Some(&b[i]) } else { None };
                self.code(coder, canvas, q, inner)?;
            }
            return Some(());
        }
        let mut leaf = match block {
            Some(Block::Whole(leaf)) => leaf.clone(),
            _ => Leaf { intra: false, levels: Levels { extent: 0, values: vec![0; s.side * s.side] } },
        };
        leaf.intra =
            canvas.prediction.is_none() || coder.bit(&mut self.flags, &Self::intra_contexts(canvas, s), leaf.intra);
        let shape = canvas.shape(s, leaf.intra);
        self.levels.code(coder, &shape, &mut leaf.levels)?;
        canvas.put(s, &leaf);
        Some(())
    }
}
