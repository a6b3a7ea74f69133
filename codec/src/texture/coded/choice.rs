//! Chooses blocks by rate and distortion, with the costs that the models have at the time.

use super::blocks::{Block, BlockModels};
use super::canvas::{CELL, Canvas, Leaf, Square, quarters};
use super::levels::{Levels, Shape, is_zero};
use super::transform::{forward, inverse};

/// Times that pixels which do not count take over what is coded for the others (projection onto convex sets; H. H. Chen,
/// M. R. Civanlar, B. G. Haskell, A block transform coder for arbitrarily shaped image segments, 1994).
const FILLINGS: usize = 1;
/// Price of a block without coefficients, bits a pixel, above which its quarters are tried.
const SPLIT_BITS: f32 = 0.15;
/// Price of a predicted block, bits a pixel, above which prediction from the same picture is tried.
const INTRA_BITS: f32 = 0.12;

/// Chooses what is in a square and writes it to the canvas. Returns the price too.
pub fn choose(canvas: &mut Canvas<'_>, models: &BlockModels, wanted: &[i16], s: Square, lambda: f32) -> (Block, f32) {
    let count = canvas.count(s);
    if count == 0 {
        return (Block::Empty, 0.0);
    }
    let split_cost = if s.side > CELL { models.split_cost(canvas, s) } else { [0; 2] };
    let per_cost = lambda / 256.0;
    let (leaf, price) = choose_leaf(canvas, models, wanted, s, lambda, count);
    let price = price + per_cost * split_cost[0] as f32;
    let good_enough = leaf.levels.extent == 0 && price < SPLIT_BITS * lambda * count as f32;
    if s.side == CELL || good_enough {
        canvas.put(s, &leaf);
        return (Block::Whole(leaf), price);
    }
    let mut sum = per_cost * split_cost[1] as f32;
    let inner = quarters(s).map(|q| {
        let (block, price) = choose(canvas, models, wanted, q, lambda);
        sum += price;
        block
    });
    if sum < price {
        return (Block::Split(Box::new(inner)), sum);
    }
    canvas.put(s, &leaf);
    (Block::Whole(leaf), price)
}

fn choose_leaf(
    canvas: &Canvas<'_>,
    models: &BlockModels,
    wanted: &[i16],
    s: Square,
    lambda: f32,
    count: usize,
) -> (Leaf, f32) {
    let flag = models.intra_cost(canvas, s).map(|c| c as f32 * lambda / 256.0);
    let leaf = |intra: bool| {
        let missing = Missing::new(canvas, wanted, s, intra, count);
        let (levels, price) = missing.levels(models, &canvas.shape(s, intra), canvas.step, lambda);
        (Leaf { intra, levels }, price + flag[usize::from(intra)])
    };
    if canvas.prediction.is_none() {
        return leaf(true);
    }
    let predicted = leaf(false);
    if predicted.1 > INTRA_BITS * lambda * count as f32 {
        let intra = leaf(true);
        if intra.1 < predicted.1 {
            return intra;
        }
    }
    predicted
}

/// What a prediction lacks in a block.
struct Missing {
    values: Vec<f32>,
    counts: Vec<bool>,
    /// Number of pixels that count.
    count: usize,
}

impl Missing {
    /// Pixels that do not count miss the mean of the others.
    fn new(canvas: &Canvas<'_>, wanted: &[i16], s: Square, intra: bool, count: usize) -> Self {
        let area = s.side * s.side;
        let base = canvas.predict(s, intra);
        let (mut values, mut counts) = (vec![0.0_f32; area], vec![false; area]);
        for (row, k) in canvas.rows(s) {
            for (i, k) in row.zip(k..).filter(|(i, _)| canvas.mask[*i]) {
                values[k] = (i32::from(wanted[i]) - base.at(i)) as f32;
                counts[k] = true;
            }
        }
        if count < area {
            let mean = values.iter().sum::<f32>() / count as f32;
            values.iter_mut().zip(&counts).filter(|(_, c)| !**c).for_each(|(v, _)| *v = mean);
        }
        Self { values, counts, count }
    }

    /// The best levels found and their price.
    fn levels(mut self, models: &BlockModels, shape: &Shape, step: i32, lambda: f32) -> (Levels, f32) {
        let area = shape.side * shape.side;
        let squares = |values: &[f32]| values.iter().map(|v| v * v).sum::<f32>();
        if is_zero(squares(&self.values), step as f32) {
            let counted = self.values.iter().zip(&self.counts).map(|(v, c)| if *c { v * v } else { 0.0 });
            let price = counted.sum::<f32>() + lambda / 256.0 * models.levels.extent_cost(shape, 0) as f32;
            return (Levels { extent: 0, values: vec![0; area] }, price);
        }
        let mut coefficients = vec![0.0; area];
        let mut choose = |values: &[f32]| {
            forward(values, shape.side, &mut coefficients);
            models.levels.choose(shape, &coefficients, squares(values), step as f32, lambda)
        };
        let mut best = choose(&self.values);
        if self.count == area {
            return best;
        }
        best.1 -= self.refill(&best.0, shape.side, step);
        for _ in 0..FILLINGS {
            let (levels, price) = choose(&self.values);
            let price = price - self.refill(&levels, shape.side, step);
            if price < best.1 {
                best = (levels, price);
            }
        }
        best
    }

    /// Gives the pixels that do not count what is coded for them; returns their squared error before.
    fn refill(&mut self, levels: &Levels, side: usize, step: i32) -> f32 {
        let mut coded = vec![0_i32; side * side];
        if levels.extent > 0 {
            inverse(levels, side, step, &mut coded);
        }
        let mut error = 0.0;
        for ((v, coded), _) in self.values.iter_mut().zip(coded).zip(&self.counts).filter(|(_, c)| !**c) {
            error += (*v - coded as f32).powi(2);
            *v = coded as f32;
        }
        error
    }
}
