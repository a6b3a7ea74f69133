//! Where four squares meet: candidates, their edges, and their place to a fraction of a pixel.
//!
//! A corner of a chessboard is a saddle: after a blur, minus the determinant of the Hessian has a peak there and is zero along
//! edges. On a ring around it, light and dark change four times, at two pairs of opposite directions, which are those of
//! the edges (the ring test goes back to S. Bennett, J. Lasenby, "ChESS - quick and robust detection of chess-board
//! features", Computer Vision and Image Understanding 118, 2014). Every edge points at the corner, so the sub-pixel place x
//! solves sum w g g' (x - p) = 0 over the pixels p with gradients g (W. Förstner, E. Gülch, "A fast operator for detection and
//! precise location of distinct points, corners and centres of circular features", ISPRS Intercommission Workshop, 1987).

use super::field::Field;
use glam::DVec2;
use std::f64::consts::{PI, TAU};

/// Blur before derivatives are taken, pixels: less lets the pixels' own grid bias the places, more drowns small squares.
const GRADIENT_SIGMA_PX: f64 = 1.0;
/// Blur before saddles are sought, pixels.
const SADDLE_SIGMA_PX: f64 = 1.5;
/// Least saddle response: a corner of 15 grey levels in a picture blurred by 2 px.
const MIN_RESPONSE: f32 = 0.5;
/// Saddles are apart by more than this many pixels each way.
const PEAK_REACH_PX: usize = 2;
/// Radius and samples of the ring. Squares foreshortened to 6 px still hold it.
const RING_RADIUS_PX: f64 = 4.0;
const RING_SAMPLES: usize = 32;
/// Least difference between the light and dark parts of a ring, grey levels.
const MIN_CONTRAST: f32 = 10.0;
/// Most that an edge may bend at its corner, radians: uneven blur and noise, not geometry.
const MAX_BEND_RAD: f64 = 0.45;
/// Least angle between the two edges of a corner, radians: a square seen at 70 degrees.
const MIN_SECTOR_RAD: f64 = 0.6;
/// Most candidates kept, the strongest: more than any board has, and few enough to pair.
const MAX_CANDIDATES: usize = 4000;

/// A place where two light and two dark sectors meet.
#[derive(Debug, Clone, Copy)]
pub(super) struct Corner {
    /// Place, pixels.
    pub px: DVec2,
    /// Directions of the four edges, radians, ascending; x right, y down.
    pub edges_rad: [f64; 4],
    /// Whether the sector after edge 0 is light; after edge 1 it is the other, and so on.
    pub is_light_first: bool,
    /// Difference between light and dark, grey levels.
    pub contrast: f32,
}

impl Corner {
    /// Whether the sector after edge `k` is light.
    pub fn is_light_after(&self, k: usize) -> bool {
        self.is_light_first == (k % 2 == 0)
    }
}

/// A picture made ready for corners.
#[derive(Debug, Clone)]
pub(super) struct CornerFinder {
    /// Lightly blurred, for gradients.
    fine: Field,
    /// Blurred, for saddles and rings.
    coarse: Field,
}

impl CornerFinder {
    /// Blurs the picture as the stages need it.
    pub fn new(picture: &Field) -> Self {
        let fine = picture.blurred(GRADIENT_SIGMA_PX);
        let rest = (SADDLE_SIGMA_PX * SADDLE_SIGMA_PX - GRADIENT_SIGMA_PX * GRADIENT_SIGMA_PX).sqrt();
        Self { coarse: fine.blurred(rest), fine }
    }

    /// The blurred picture that light and dark are judged on.
    pub fn levels(&self) -> &Field {
        &self.coarse
    }

    /// All corners, the strongest saddles first.
    pub fn candidates(&self) -> Vec<Corner> {
        let (w, h) = (self.coarse.width, self.coarse.height);
        if w.min(h) < 2 * RING_RADIUS_PX as usize + 2 {
            return Vec::new();
        }
        let response = self.response();
        let mut peaks: Vec<(f32, usize)> = Vec::new();
        for y in PEAK_REACH_PX..h - PEAK_REACH_PX {
            for x in PEAK_REACH_PX..w - PEAK_REACH_PX {
                let i = y * w + x;
                if response[i] >= MIN_RESPONSE && is_peak(&response, w, i) {
                    peaks.push((response[i], i));
                }
            }
        }
        peaks.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        peaks.truncate(MAX_CANDIDATES);
        peaks.iter().filter_map(|&(_, i)| self.corner_at(self.saddle(i))).collect()
    }

    /// Minus the determinant of the Hessian, by differences; zero at the border.
    fn response(&self) -> Vec<f32> {
        let (w, h) = (self.coarse.width, self.coarse.height);
        let mut out = vec![0.0f32; w * h];
        for y in 1..h - 1 {
            let [above, here, below] = [y - 1, y, y + 1].map(|row| &self.coarse.values[row * w..][..w]);
            for ((o, a), (b, c)) in
                out[y * w + 1..][..w - 2].iter_mut().zip(above.windows(3)).zip(here.windows(3).zip(below.windows(3)))
            {
                let xx = b[0] - 2.0 * b[1] + b[2];
                let yy = a[1] - 2.0 * b[1] + c[1];
                let xy = 0.25 * (a[0] - a[2] - c[0] + c[2]);
                *o = xy * xy - xx * yy;
            }
        }
        out
    }

    /// Where the gradient is zero by the derivatives at pixel `i`, at most a pixel away.
    fn saddle(&self, i: usize) -> DVec2 {
        let w = self.coarse.width;
        let at = |k: usize| f64::from(self.coarse.values[k]);
        let (x, y) = (0.5 * (at(i + 1) - at(i - 1)), 0.5 * (at(i + w) - at(i - w)));
        let xx = at(i - 1) - 2.0 * at(i) + at(i + 1);
        let yy = at(i - w) - 2.0 * at(i) + at(i + w);
        let xy = 0.25 * (at(i - w - 1) - at(i - w + 1) - at(i + w - 1) + at(i + w + 1));
        // Peaks have a determinant of -MIN_RESPONSE or less.
        let scale = 1.0 / (xx * yy - xy * xy);
        let step = DVec2::new(-scale * (yy * x - xy * y), -scale * (xx * y - xy * x));
        DVec2::new((i % w) as f64, (i / w) as f64) + step.clamp(DVec2::NEG_ONE, DVec2::ONE)
    }

    /// The corner at a place, by its ring; `None` where light and dark do not meet as on a chessboard.
    pub fn corner_at(&self, px: DVec2) -> Option<Corner> {
        if !self.coarse.holds(px.to_array(), RING_RADIUS_PX) {
            return None;
        }
        let step_rad = TAU / RING_SAMPLES as f64;
        let ring: [f32; RING_SAMPLES] = std::array::from_fn(|n| {
            let (s, c) = libm::sincos(n as f64 * step_rad);
            self.coarse.sample((px + RING_RADIUS_PX * DVec2::new(c, s)).to_array())
        });
        let (least, most) = ring.iter().fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)));
        let contrast = most - least;
        if contrast < MIN_CONTRAST {
            return None;
        }
        let middle = 0.5 * (least + most);
        let mut edges_rad = [0.0; 4];
        let mut is_light_first = false;
        let mut count = 0;
        for n in 0..RING_SAMPLES {
            let (a, b) = (ring[n] - middle, ring[(n + 1) % RING_SAMPLES] - middle);
            if (a > 0.0) == (b > 0.0) {
                continue;
            }
            *edges_rad.get_mut(count)? = (n as f64 + f64::from(a / (a - b))) * step_rad;
            is_light_first = if count == 0 { b > 0.0 } else { is_light_first };
            count += 1;
        }
        let is_crossing = count == 4
            && (0..2).all(|k| (edges_rad[k + 2] - edges_rad[k] - PI).abs() < MAX_BEND_RAD)
            && (0..4).all(|k| (edges_rad[(k + 1) % 4] - edges_rad[k]).rem_euclid(TAU) > MIN_SECTOR_RAD);
        is_crossing.then_some(Corner { px, edges_rad, is_light_first, contrast })
    }

    /// The place near `start` that the gradients within `radius_px` point at; `None` when they point at none, or at one
    /// farther than that.
    pub fn refine(&self, start: DVec2, radius_px: f64) -> Option<DVec2> {
        const MAX_ROUNDS: usize = 40;
        const ENOUGH_PX: f64 = 1e-4;
        let mut px = start;
        for _ in 0..MAX_ROUNDS {
            // The derivatives reach one pixel further.
            if !self.fine.holds(px.to_array(), radius_px + 1.0) {
                return None;
            }
            let next = self.focus(px, radius_px)?;
            let is_done = next.distance(px) < ENOUGH_PX;
            px = next;
            if px.distance(start) > radius_px {
                return None;
            }
            if is_done {
                return Some(px);
            }
        }
        None
    }

    /// One round of [`Self::refine`]: weights (1 - r^2)^2 fall to zero at the radius, so that no pixel enters abruptly.
    fn focus(&self, centre: DVec2, radius_px: f64) -> Option<DVec2> {
        let w = self.fine.width;
        let scale = 1.0 / (radius_px * radius_px);
        let (mut xx, mut xy, mut yy, mut right) = (0.0f64, 0.0f64, 0.0f64, DVec2::ZERO);
        let (low, high) = ((centre - radius_px).ceil(), (centre + radius_px).floor());
        for y in low.y as usize..=high.y as usize {
            for x in low.x as usize..=high.x as usize {
                let offset = DVec2::new(x as f64, y as f64) - centre;
                let fall = 1.0 - offset.length_squared() * scale;
                if fall <= 0.0 {
                    continue;
                }
                let (v, i) = (&self.fine.values, y * w + x);
                let g = DVec2::new(f64::from(v[i + 1] - v[i - 1]), f64::from(v[i + w] - v[i - w]));
                let weight = fall * fall;
                xx += weight * g.x * g.x;
                xy += weight * g.x * g.y;
                yy += weight * g.y * g.y;
                right += weight * g.dot(offset) * g;
            }
        }
        let determinant = xx * yy - xy * xy;
        // Edges of one direction only leave the place free along them.
        if determinant <= 1e-3 * (xx + yy) * (xx + yy) {
            return None;
        }
        Some(centre + DVec2::new(yy * right.x - xy * right.y, xx * right.y - xy * right.x) / determinant)
    }
}

fn is_peak(response: &[f32], width: usize, i: usize) -> bool {
    for dy in 0..=2 * PEAK_REACH_PX {
        for dx in 0..=2 * PEAK_REACH_PX {
            let k = i + dy * width + dx - PEAK_REACH_PX * (width + 1);
            // Of two equal neighbours the first one is the peak.
            if response[k] > response[i] || (response[k] == response[i] && k < i) {
                return false;
            }
        }
    }
    true
}
