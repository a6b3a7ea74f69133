//! Quality-guided spatial unwrapping: relative phase for sequences without an absolute one.
//!
//! From the best pixel on, the phase grows over the picture through the best pixel at the border first, so that errors of bad
//! pixels cannot spread to good ones (T. R. Judge, P. J. Bryanston-Cross, "A review of phase unwrapping techniques in fringe
//! analysis", Optics and Lasers in Engineering 21, 1994). Quality is the modulation, in levels (as S. Zhang, X. Li, S.-T. Yau,
//! "Multilevel quality-guided phase unwrapping algorithm for real-time three-dimensional shape reconstruction", Applied Optics
//! 46(1), 2007, do with another measure), so that the border is a queue of buckets and a pixel costs a constant.
//!
//! Every connected piece has its own unknown whole number of periods. [`anchor`] asks the working range: a number that alone
//! puts the piece inside it is the right one.

use super::mask::{PixelMask, Rejection};
use super::phase::WrappedPhase;
use std::f32::consts::TAU;

/// Quality levels of the queue: modulation in half grey levels.
const LEVELS: usize = 256;
/// A pixel that was not reached.
pub const NO_PIECE: u32 = u32::MAX;

/// Least share of a piece inside the working range at its place, and most at every other place.
const INSIDE: f64 = 0.99;
const ELSEWHERE: f64 = 0.97;

/// Relative phase of a picture.
#[derive(Debug, Clone, Default)]
pub struct RelativePhase {
    /// Phase over 2 pi, continuous within a piece.
    pub turns: Vec<f32>,
    /// Piece of every pixel, or [`NO_PIECE`].
    pub pieces: Vec<u32>,
    /// Pixels of every piece.
    pub sizes: Vec<u32>,
}

/// Pixels at the border of what is unwrapped, by quality.
struct BucketQueue {
    buckets: Vec<Vec<u32>>,
    highest: usize,
}

impl BucketQueue {
    fn push(&mut self, quality: usize, pixel: u32) {
        self.buckets[quality].push(pixel);
        self.highest = self.highest.max(quality);
    }

    fn pop(&mut self) -> Option<u32> {
        loop {
            if let Some(pixel) = self.buckets[self.highest].pop() {
                return Some(pixel);
            }
            self.highest = self.highest.checked_sub(1)?;
        }
    }
}

fn quality(modulation: f32) -> usize {
    // A cast saturates, and NaN is 0.
    ((2.0 * modulation) as usize).min(LEVELS - 1)
}

/// Unwraps all kept pixels, each piece of them from its best pixel.
///
/// # Panics
/// When phase and mask differ in size.
pub fn unwrap(phase: &WrappedPhase, mask: &PixelMask) -> RelativePhase {
    let n = mask.verdicts.len();
    assert!(phase.phase_rad.len() == n && phase.modulation.len() == n, "phase and mask differ in size");
    let mut out = RelativePhase { turns: vec![0.0; n], pieces: vec![NO_PIECE; n], sizes: Vec::new() };
    let mut seeds = BucketQueue { buckets: vec![Vec::new(); LEVELS], highest: 0 };
    for i in (0..n).rev().filter(|&i| mask.is_kept(i)) {
        seeds.push(quality(phase.modulation[i]), i as u32);
    }
    let mut queue = BucketQueue { buckets: vec![Vec::new(); LEVELS], highest: 0 };
    while let Some(seed) = seeds.pop() {
        if out.pieces[seed as usize] == NO_PIECE {
            flood(seed, phase, mask, &mut queue, &mut out);
        }
    }
    out
}

fn flood(seed: u32, phase: &WrappedPhase, mask: &PixelMask, queue: &mut BucketQueue, out: &mut RelativePhase) {
    let (w, n) = (mask.width_px, mask.verdicts.len());
    let piece = out.sizes.len() as u32;
    out.turns[seed as usize] = phase.phase_rad[seed as usize] / TAU;
    out.pieces[seed as usize] = piece;
    let mut size = 1;
    queue.push(quality(phase.modulation[seed as usize]), seed);
    while let Some(pixel) = queue.pop() {
        let i = pixel as usize;
        let x = i % w;
        let neighbours =
            [(x > 0, i.wrapping_sub(1)), (x + 1 < w, i + 1), (i >= w, i.wrapping_sub(w)), (i + w < n, i + w)];
        for (_, j) in neighbours.into_iter().filter(|&(is_inside, j)| is_inside && mask.is_kept(j)) {
            if out.pieces[j] != NO_PIECE {
                continue;
            }
            let wrapped = phase.phase_rad[j] / TAU;
            out.turns[j] = wrapped + (out.turns[i] - wrapped).round();
            out.pieces[j] = piece;
            size += 1;
            queue.push(quality(phase.modulation[j]), j as u32);
        }
    }
    out.sizes.push(size);
}

/// Coordinates of relative phase, px: each piece moved by the whole number of periods that puts it into `range_px`, the least
/// and greatest coordinate of every pixel in the working range. Rejects, in `mask`, the pieces for which none or several do.
///
/// # Panics
/// When the slices differ in size.
pub fn anchor(
    relative: &RelativePhase,
    period_px: f32,
    range_px: &[[f32; 2]],
    mask: &mut PixelMask,
    coordinate_px: &mut [f32],
) {
    assert!(range_px.len() == relative.turns.len() && coordinate_px.len() == relative.turns.len());
    let places = places(relative, period_px, range_px);
    for (i, coordinate) in coordinate_px.iter_mut().enumerate() {
        match places.get(relative.pieces[i] as usize) {
            Some(Some(order)) => *coordinate = (relative.turns[i] + *order as f32) * period_px,
            _ if mask.is_kept(i) => mask.verdicts[i] = Rejection::Unanchored,
            _ => {}
        }
    }
}

/// Order of every piece; none where the working range does not settle it.
fn places(relative: &RelativePhase, period_px: f32, range_px: &[[f32; 2]]) -> Vec<Option<i32>> {
    // Orders that a pixel allows begin and end somewhere; a sweep over those ends counts the pixels for each order.
    let mut ends: Vec<(u32, i32, i32)> = Vec::with_capacity(2 * range_px.len());
    for ((&turns, &piece), range) in relative.turns.iter().zip(&relative.pieces).zip(range_px) {
        let (first, last) = ((range[0] / period_px - turns).ceil(), (range[1] / period_px - turns).floor());
        // NaN and endless ranges allow nothing.
        if piece != NO_PIECE && first <= last && first.abs().max(last.abs()) < 1e6 {
            ends.extend([(piece, first as i32, 1), (piece, last as i32 + 1, -1)]);
        }
    }
    ends.sort_unstable();
    let mut places = vec![None; relative.sizes.len()];
    for of_piece in ends.chunk_by(|a, b| a.0 == b.0) {
        let piece = of_piece[0].0 as usize;
        places[piece] = place(of_piece, f64::from(relative.sizes[piece]));
    }
    places
}

fn place(ends: &[(u32, i32, i32)], size: f64) -> Option<i32> {
    let mut inside = 0;
    let (mut best, mut second) = ((0, 0), 0);
    for steps in ends.chunk_by(|a, b| a.1 == b.1) {
        inside += steps.iter().map(|s| s.2).sum::<i32>();
        let next = ends.partition_point(|e| e.1 <= steps[0].1);
        let orders = ends.get(next).map_or(1, |e| e.1 - steps[0].1);
        if inside > best.0 {
            second = if orders > 1 { inside } else { best.0 };
            best = (inside, steps[0].1);
        } else {
            second = second.max(inside);
        }
    }
    let is_clear = f64::from(best.0) >= INSIDE * size && f64::from(second) < ELSEWHERE * size;
    is_clear.then_some(best.1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const W: usize = 60;
    const H: usize = 50;

    /// Wrapped phase of coordinates, with modulation low where `is_bad`.
    fn wrapped(truth_px: &[f64], period_px: f64, is_bad: impl Fn(usize) -> bool) -> WrappedPhase {
        let mut phase = WrappedPhase::new(truth_px.len());
        for (i, u) in truth_px.iter().enumerate() {
            let turns = u / period_px;
            phase.phase_rad[i] = ((turns - turns.round()) * f64::from(TAU)) as f32;
            phase.modulation[i] = if is_bad(i) { 16.0 } else { 80.0 };
            if is_bad(i) {
                // Noise of half a period, which would tear a scan line by scan line unwrapping apart.
                phase.phase_rad[i] = ((i * 7919 % 1000) as f32 / 1000.0 - 0.5) * TAU;
            }
        }
        phase
    }

    proptest! {
        #[test]
        fn good_pixels_are_continuous_whatever_bad_ones_do(slope in -2.5f64..2.5, bend in -0.02f64..0.02, shift in 0usize..20) {
            let truth: Vec<f64> = (0..W * H)
                .map(|i| ((i % W) as f64, (i / W) as f64))
                .map(|(x, y)| 300.0 + slope * x + bend * x * y + 0.7 * y)
                .collect();
            let is_bad = |i: usize| (i % W + shift).is_multiple_of(5) && (i / W + shift).is_multiple_of(4);
            let phase = wrapped(&truth, 16.0, is_bad);
            let relative = unwrap(&phase, &PixelMask::new(W, H));
            prop_assert_eq!(&relative.sizes, &[(W * H) as u32]);
            // Isolated bad pixels never cut good ones off.
            let good: Vec<usize> = (0..W * H).filter(|&i| !is_bad(i)).collect();
            let offset = f64::from(relative.turns[good[0]]) - truth[good[0]] / 16.0;
            for i in good {
                prop_assert!((f64::from(relative.turns[i]) - truth[i] / 16.0 - offset).abs() < 1e-3, "pixel {i}");
            }
        }
    }

    #[test]
    fn pieces_are_anchored_alone_or_rejected_by_name() {
        // Two pieces, a steep one left of the gap and a level one right of it.
        let truth: Vec<f64> =
            (0..W * H).map(|i| i % W).map(|x| if x < 30 { 300.0 + 2.0 * x as f64 } else { 310.0 }).collect();
        let mut mask = PixelMask::new(W, H);
        (0..W * H).filter(|i| i % W == 30).for_each(|i| mask.verdicts[i] = Rejection::LowModulation);
        let relative = unwrap(&wrapped(&truth, 20.0, |_| false), &mask);
        assert_eq!(relative.sizes.iter().sum::<u32>(), (W * H - H) as u32);
        assert_eq!(relative.sizes.len(), 2);
        let range = vec![[295.0, 365.0]; W * H];
        let mut column = vec![0.0; W * H];
        anchor(&relative, 20.0, &range, &mut mask, &mut column);
        // 58 px of 70 fit one way only; a level piece fits four ways.
        assert_eq!(mask.count().unanchored, (29 * H) as u64);
        for i in (0..W * H).filter(|i| i % W < 30) {
            assert!(mask.is_kept(i) && (f64::from(column[i]) - truth[i]).abs() < 1e-3, "{i}: {}", column[i]);
        }
    }
}
