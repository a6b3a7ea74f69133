//! Chooses blocks by rate and distortion, with the costs that the models have at the time.

use super::blocks::{Block, BlockModels};
use super::canvas::{CELL, Canvas, Leaf, Square, quarters};
use super::levels::Levels;
use super::transform::{MAX_AREA, forward, inverse};

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
    if canvas.prediction.is_none() {
        let (levels, price) = transform_leaf(canvas, models, wanted, s, true, lambda, count);
        return (Leaf { intra: true, levels }, price);
    }
    let (levels, price) = transform_leaf(canvas, models, wanted, s, false, lambda, count);
    let mut best = (Leaf { intra: false, levels }, price + flag[0]);
    if best.1 > INTRA_BITS * lambda * count as f32 {
        let (levels, price) = transform_leaf(canvas, models, wanted, s, true, lambda, count);
        if price + flag[1] < best.1 {
            best = (Leaf { intra: true, levels }, price + flag[1]);
        }
    }
    best
}

fn transform_leaf(
    canvas: &Canvas<'_>,
    models: &BlockModels,
    wanted: &[i16],
    s: Square,
    intra: bool,
    lambda: f32,
    count: usize,
) -> (Levels, f32) {
    let area = s.side * s.side;
    let mut base = [0_i32; MAX_AREA];
    canvas.predict(s, intra, &mut base);
    let mut missing = [0.0_f32; MAX_AREA];
    let mut counts = [false; MAX_AREA];
    for (i, k) in canvas.places(s) {
        if canvas.mask[i] {
            missing[k] = (i32::from(wanted[i]) - base[k]) as f32;
            counts[k] = true;
        }
    }
    let shape = canvas.shape(s, intra);
    let step = canvas.step as f32;
    if count == area {
        let mut c = missing;
        forward(&mut c, s.side);
        return models.levels.choose(&shape, &c, step, lambda);
    }
    let mean = missing[..area].iter().sum::<f32>() / count as f32;
    for (m, _) in missing[..area].iter_mut().zip(&counts).filter(|(_, c)| !**c) {
        *m = mean;
    }
    let mut best: Option<(Levels, f32)> = None;
    for _ in 0..=FILLINGS {
        let mut c = missing;
        forward(&mut c, s.side);
        let (levels, price) = models.levels.choose(&shape, &c, step, lambda);
        let mut coded = [0_i32; MAX_AREA];
        inverse(&levels, s.side, canvas.step, &mut coded);
        let mut outside = 0.0;
        for k in 0..area {
            if !counts[k] {
                outside += (missing[k] - coded[k] as f32).powi(2);
                missing[k] = coded[k] as f32;
            }
        }
        let price = price - outside;
        let better = best.as_ref().is_none_or(|b| price < b.1);
        if better {
            best = Some((levels, price));
        }
    }
    best.unwrap_or((Levels { extent: 0, values: vec![0; area] }, 0.0))
}
