//! Where four squares meet: candidates, their edges, and their place to a fraction of a pixel.
//!
//! A corner of a chessboard is a saddle: after a blur, minus the determinant of the Hessian has a peak there and is zero along
//! edges. On a ring around it, light and dark change four times, at two pairs of opposite directions, which are those of
//! the edges (the ring test goes back to S. Bennett, J. Lasenby, "ChESS - quick and robust detection of chess-board
//! features", Computer Vision and Image Understanding 118, 2014). Two straight lines part the plane alike on both sides of
//! their crossing, so blur of any width leaves the saddle point there: Newton's method on the blurred picture finds it (L.
//! Lucchese, S. K. Mitra, "Using saddle points for subpixel feature detection in camera calibration targets", APCCAS 2002).
//! For noise of sigma grey levels, a contrast c, a blur b of the picture and one of s here its error is 0.63 sigma / c
//! (1 + b^2 / s^2) pixels along each axis.

use super::field::Field;
use glam::DVec2;
use std::f64::consts::{PI, TAU};

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
/// Window of the sub-pixel search, of its blur, and the least distance from the border at which it is tried, pixels.
const WINDOW_SIGMAS: f64 = 4.0;
const BORDER_PX: f64 = 4.0;
/// Most candidates kept, the strongest: more than any board has, and few enough to pair.
const MAX_CANDIDATES: usize = 4000;

/// Blur of the sub-pixel search for corners some distance apart, pixels: wide for what the lens has blurred already, narrow
/// enough to leave out the next corners and what bends or hides the board beyond.
pub(super) fn refine_sigma_px(spacing_px: f64) -> f64 {
    (spacing_px / 6.0).clamp(1.5, 2.0)
}

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
        self.is_light_first == k.is_multiple_of(2)
    }
}

/// A picture made ready for corners.
#[derive(Debug, Clone)]
pub(super) struct CornerFinder {
    /// As it is.
    picture: Field,
    /// Blurred, for saddles and rings.
    coarse: Field,
}

impl CornerFinder {
    /// Blurs the picture.
    pub fn new(picture: Field) -> Self {
        Self { coarse: picture.blurred(SADDLE_SIGMA_PX), picture }
    }

    /// The picture as it is.
    pub fn picture(&self) -> &Field {
        &self.picture
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

    /// The saddle point near `start` after a blur of `sigma_px`, less where the border is near; `None` when there is none
    /// within `2 sigma_px`.
    pub fn refine(&self, start: DVec2, sigma_px: f64) -> Option<DVec2> {
        const MAX_ROUNDS: usize = 20;
        const ENOUGH_PX: f64 = 1e-4;
        let mut px = start;
        for _ in 0..MAX_ROUNDS {
            if !self.picture.holds(px.to_array(), BORDER_PX) {
                return None;
            }
            let size = DVec2::new(self.picture.width as f64, self.picture.height as f64);
            let room_px = px.min(size - 1.0 - px).min_element();
            let step = self.newton_step(px, sigma_px.min(room_px / WINDOW_SIGMAS))?;
            px += step.clamp_length_max(0.5 * sigma_px);
            if px.distance(start) > 2.0 * sigma_px {
                return None;
            }
            if step.length() < ENOUGH_PX {
                return Some(px);
            }
        }
        None
    }

    /// From a place to the zero of the gradient by the Hessian there, both of the picture after a Gaussian of `sigma_px`; `None`
    /// at no saddle. The blur lies about the place itself, not about a pixel, so that the grid of pixels leaves no trace.
    fn newton_step(&self, at: DVec2, sigma_px: f64) -> Option<DVec2> {
        let reach = WINDOW_SIGMAS * sigma_px;
        let [columns, rows] = [at.x, at.y].map(|c| (c - reach).ceil() as usize..(c + reach) as usize + 1);
        // Offsets in sigma and the Gaussian at them, less its value at the window's border: pixels that enter with the next
        // step come in at zero, so that steps shrink to nothing.
        let outermost = libm::exp(-0.5 * WINDOW_SIGMAS * WINDOW_SIGMAS);
        let weigh = |range: &std::ops::Range<usize>, centre: f64| -> Vec<(f64, f64)> {
            let offset = |i: usize| (i as f64 - centre) / sigma_px;
            range.clone().map(|i| (offset(i), libm::exp(-0.5 * offset(i) * offset(i)) - outermost)).collect()
        };
        let (across, down) = (weigh(&columns, at.x), weigh(&rows, at.y));
        // A level in common takes away what the cut at the window's border would add.
        let middle = f64::from(self.coarse.sample(at.to_array()));
        let (mut x, mut y, mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (row, &(v, down)) in rows.zip(&down) {
            let line = &self.picture.values[row * self.picture.width..][columns.clone()];
            let (mut sum, mut sum_u, mut sum_uu) = (0.0, 0.0, 0.0);
            for (&level, &(u, across)) in line.iter().zip(&across) {
                let weighted = across * (f64::from(level) - middle);
                sum += weighted;
                sum_u += weighted * u;
                sum_uu += weighted * (u * u - 1.0);
            }
            x += down * sum_u;
            y += down * v * sum;
            xx += down * sum_uu;
            xy += down * v * sum_u;
            yy += down * (v * v - 1.0) * sum;
        }
        let determinant = xx * yy - xy * xy;
        if determinant.is_nan() || determinant >= 0.0 {
            return None;
        }
        Some(-sigma_px / determinant * DVec2::new(yy * x - xy * y, xx * y - xy * x))
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
