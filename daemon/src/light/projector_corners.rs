//! Projector pixels of board corners.
//!
//! The code cannot be read at a corner itself: dark squares reflect too little, and the corner falls between pixels. But around
//! it camera and projector see the same plane through small pieces of their lenses, so that the decoded pixels nearby give
//! a homography from camera to projector pixels, and that takes the corner over (D. Moreno, G. Taubin, "Simple, accurate,
//! and robust projector-camera calibration", 3DIMPVT 2012, section 3.3).
//!
//! A pixel with a wrong fringe order is off by a whole period, so least squares alone would not do. The homography that most
//! pixels agree on is that with the least median of squared distances over minimal samples (P. Rousseeuw, "Least median of
//! squares regression", JASA 79, 1984); least squares over the pixels near it follow.

use super::PixelMask;
use super::homography::{apply_homography, fit_homography};
use glam::{DMat3, DVec2};

/// Fewest decoded pixels that give a corner.
const MIN_PIXELS: usize = 40;
/// Radius that pixels are taken from, of the distance to the nearest other corner, and its limits, pixels: as wide as the
/// lenses allow, and two of the four squares even where they are foreshortened.
const RADIUS_PART: f64 = 0.9;
const RADIUS_PX: [f64; 2] = [5.0, 40.0];
/// More pixels than this are thinned out evenly.
const MAX_PIXELS: usize = 1500;
/// Largest median distance from the homography, of the window's radius in the projector.
const MAX_MEDIAN: f64 = 0.15;
/// Minimal samples drawn: with half of the pixels wrong, 64 samples of four all have a wrong one in 2 % of the cases.
const SAMPLES: u64 = 64;

/// Corners without projector pixel, by cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct UnreadCorners {
    /// Too few pixels around the corner decode: shadow, glare, or outside the projector's field.
    pub too_few_pixels: usize,
    /// The pixels that decode are all on one side of the corner.
    pub one_sided: usize,
    /// The pixels that decode contradict each other.
    pub contradictory: usize,
}

impl UnreadCorners {
    /// Corners of every cause.
    pub fn total(&self) -> usize {
        self.too_few_pixels + self.one_sided + self.contradictory
    }
}

impl std::fmt::Display for UnreadCorners {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { too_few_pixels, one_sided, contradictory } = self;
        write!(
            f,
            "{too_few_pixels} with too few decoded pixels around, {one_sided} with decoded pixels on one side only, \
             {contradictory} with pixels that contradict each other"
        )
    }
}

enum Unread {
    TooFew,
    OneSided,
    Contradictory,
}

/// Projector pixels of corners given in camera pixels, from the projector columns and rows of the camera's pixels that `mask`
/// keeps, row-major; `None`, counted by cause, where they cannot be read.
///
/// # Panics
/// When columns, rows and mask differ in size.
pub fn projector_corners(
    corners_px: &[[f64; 2]],
    columns_px: &[f32],
    rows_px: &[f32],
    mask: &PixelMask,
) -> (Vec<Option<[f64; 2]>>, UnreadCorners) {
    let n = mask.verdicts.len();
    assert!(columns_px.len() == n && rows_px.len() == n, "coordinates and mask differ in size");
    let mut unread = UnreadCorners::default();
    let mut read = |(i, corner): (usize, &[f64; 2])| {
        let others = corners_px.iter().enumerate().filter(|(k, _)| *k != i);
        let nearest = others.map(|(_, p)| DVec2::from(*p).distance((*corner).into())).fold(f64::INFINITY, f64::min);
        let radius_px = (RADIUS_PART * nearest).clamp(RADIUS_PX[0], RADIUS_PX[1]);
        let (from, to) = pixels_around(*corner, radius_px, columns_px, rows_px, mask);
        match at_corner(&from, &to, radius_px) {
            Ok(px) => return Some(px.to_array()),
            Err(Unread::TooFew) => unread.too_few_pixels += 1,
            Err(Unread::OneSided) => unread.one_sided += 1,
            Err(Unread::Contradictory) => unread.contradictory += 1,
        }
        None
    };
    let px = corners_px.iter().enumerate().map(&mut read).collect();
    (px, unread)
}

/// Kept pixels within a radius, as offsets from the corner, and their projector pixels.
fn pixels_around(
    corner: [f64; 2],
    radius_px: f64,
    columns_px: &[f32],
    rows_px: &[f32],
    mask: &PixelMask,
) -> (Vec<DVec2>, Vec<DVec2>) {
    let corner = DVec2::from(corner);
    let last = DVec2::new(mask.width_px as f64, mask.height_px as f64) - 1.0;
    let low = (corner - radius_px).ceil().max(DVec2::ZERO);
    let high = (corner + radius_px).floor().min(last);
    let (mut from, mut to) = (Vec::new(), Vec::new());
    if !(low.cmple(high).all()) {
        return (from, to);
    }
    for y in low.y as usize..=high.y as usize {
        for x in low.x as usize..=high.x as usize {
            let i = y * mask.width_px + x;
            let offset = DVec2::new(x as f64, y as f64) - corner;
            let px = DVec2::new(f64::from(columns_px[i]), f64::from(rows_px[i]));
            if mask.is_kept(i) && offset.length() <= radius_px && px.is_finite() {
                from.push(offset);
                to.push(px);
            }
        }
    }
    let step = from.len().div_ceil(MAX_PIXELS).max(1);
    (from.into_iter().step_by(step).collect(), to.into_iter().step_by(step).collect())
}

/// Projector pixel of offset zero.
fn at_corner(from: &[DVec2], to: &[DVec2], radius_px: f64) -> Result<DVec2, Unread> {
    if from.len() < MIN_PIXELS {
        return Err(Unread::TooFew);
    }
    check_surrounded(from, radius_px)?;
    let (first, median2) = least_median(from, to).ok_or(Unread::Contradictory)?;
    // Rousseeuw's scale, and the finest difference that codes tell.
    let limit_px = (2.5 * 1.4826 * median2.sqrt()).max(0.05);
    // What half of the pixels miss by a good part of the whole window is no agreement.
    let reach_px = apply_homography(&first, DVec2::X * radius_px).distance(apply_homography(&first, DVec2::ZERO));
    if reach_px.is_nan() || median2.sqrt() >= MAX_MEDIAN * reach_px {
        return Err(Unread::Contradictory);
    }
    let mut homography = first;
    for _ in 0..3 {
        let is_near = |(p, q): &(&DVec2, &DVec2)| apply_homography(&homography, **p).distance(**q) <= limit_px;
        let (p, q): (Vec<DVec2>, Vec<DVec2>) = from.iter().zip(to).filter(is_near).unzip();
        if 2 * p.len() < from.len() || p.len() < MIN_PIXELS {
            return Err(Unread::Contradictory);
        }
        check_surrounded(&p, radius_px)?;
        homography = fit_homography(&p, &q).ok_or(Unread::Contradictory)?;
    }
    let px = apply_homography(&homography, DVec2::ZERO);
    if px.is_finite() { Ok(px) } else { Err(Unread::Contradictory) }
}

/// A homography holds among its points, not beside them.
fn check_surrounded(offsets: &[DVec2], radius_px: f64) -> Result<(), Unread> {
    let n = offsets.len() as f64;
    let mean = offsets.iter().sum::<DVec2>() / n;
    let (xx, xy, yy) = offsets.iter().fold((0.0, 0.0, 0.0), |(xx, xy, yy), p| {
        let d = *p - mean;
        (xx + d.x * d.x / n, xy + d.x * d.y / n, yy + d.y * d.y / n)
    });
    let least_variance = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
    // A full disk has its mean in the corner and a standard deviation of half its radius; a half disk is 0.42 radii off.
    if mean.length() < 0.33 * radius_px && least_variance > (0.15 * radius_px).powi(2) {
        Ok(())
    } else {
        Err(Unread::OneSided)
    }
}

/// The homography with the least median of squared distances, and that median, px^2.
fn least_median(from: &[DVec2], to: &[DVec2]) -> Option<(DMat3, f64)> {
    let mut best: Option<(DMat3, f64)> = None;
    let mut state = 1u64;
    let mut squares = vec![0.0; from.len()];
    for _ in 0..SAMPLES {
        let chosen: [usize; 4] = std::array::from_fn(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % from.len()
        });
        let Some(h) = fit_homography(&chosen.map(|i| from[i]), &chosen.map(|i| to[i])) else { continue };
        for (square, (p, q)) in squares.iter_mut().zip(from.iter().zip(to)) {
            let distance2 = apply_homography(&h, *p).distance_squared(*q);
            *square = if distance2.is_nan() { f64::INFINITY } else { distance2 };
        }
        let middle = squares.len() / 2;
        let median2 = *squares.select_nth_unstable_by(middle, f64::total_cmp).1;
        if best.is_none_or(|(_, least)| median2 < least) {
            best = Some((h, median2));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::Rejection;
    use glam::DVec3;

    const W: usize = 160;
    const H: usize = 120;

    fn truth() -> DMat3 {
        DMat3::from_cols(DVec3::new(1.3, 0.1, 2e-4), DVec3::new(-0.2, 1.6, -1e-4), DVec3::new(200.0, 300.0, 1.0))
    }

    /// Coordinates of the truth, changed by `change(pixel number, px)`.
    fn coordinates(change: impl Fn(usize, DVec2) -> DVec2) -> (Vec<f32>, Vec<f32>) {
        let px = |i: usize| change(i, apply_homography(&truth(), DVec2::new((i % W) as f64, (i / W) as f64)));
        (0..W * H).map(px).map(|p| (p.x as f32, p.y as f32)).unzip()
    }

    const CORNERS: [[f64; 2]; 4] = [[40.3, 50.6], [70.2, 51.1], [40.9, 80.4], [71.5, 81.0]];

    fn worst_px(found: &[Option<[f64; 2]>]) -> f64 {
        let error = |(found, corner): (&Option<[f64; 2]>, [f64; 2])| {
            DVec2::from(found.unwrap()).distance(apply_homography(&truth(), corner.into()))
        };
        found.iter().zip(CORNERS).map(error).fold(0.0, f64::max)
    }

    #[test]
    fn corners_are_carried_over_whole_codes_dark_squares_and_wrong_orders() {
        let mut mask = PixelMask::new(W, H);
        let (columns, rows) = coordinates(|_, p| p);
        let (found, unread) = projector_corners(&CORNERS, &columns, &rows, &mask);
        assert!(unread.total() == 0 && worst_px(&found) < 1e-3, "{}", worst_px(&found));
        // Dark squares do not decode, a third of the rest is off by whole periods, and codes are whole.
        for (i, verdict) in mask.verdicts.iter_mut().enumerate() {
            let (x, y) = (i % W, i / W);
            if (x + 20) / 30 % 2 == (y + 10) / 30 % 2 {
                *verdict = Rejection::LowModulation;
            }
        }
        let (columns, rows) = coordinates(|i, p| {
            let wrong = if i * 7919 % 30 < 10 { 22.0 * ((i % 7) as f64 - 3.2).round() } else { 0.0 };
            p.round() + DVec2::new(wrong, 0.0)
        });
        let (found, unread) = projector_corners(&CORNERS, &columns, &rows, &mask);
        assert!(unread.total() == 0 && worst_px(&found) < 0.15, "{unread}: {} px", worst_px(&found));
    }

    #[test]
    fn corners_that_cannot_be_read_are_counted_by_cause() {
        let (columns, rows) = coordinates(|_, p| p);
        let read = |is_dark: fn(usize) -> bool, columns: &[f32]| {
            let mut mask = PixelMask::new(W, H);
            for i in (0..W * H).filter(|&i| is_dark(i)) {
                mask.verdicts[i] = Rejection::Shadow;
            }
            projector_corners(&CORNERS, columns, &rows, &mask)
        };
        let (found, unread) = read(|i| i % W < 90, &columns);
        assert!(found.iter().take(1).all(Option::is_none));
        assert_eq!((unread.too_few_pixels + unread.one_sided, unread.contradictory), (4, 0));
        let (found, unread) = read(|i| i % W < 40, &columns);
        assert_eq!((unread, found[1].is_some()), (UnreadCorners { one_sided: 2, ..UnreadCorners::default() }, true));
        let noise: Vec<f32> = (0..W * H).map(|i| (i * 7919 % 1000) as f32).collect();
        let (_, unread) = read(|_| false, &noise);
        assert!(unread.total() == 4 || unread.contradictory > 0, "{unread:?}");
        let far = [[-500.0, 20.0], [10.0, f64::NAN]];
        let mask = PixelMask::new(W, H);
        assert_eq!(projector_corners(&far, &columns, &rows, &mask).1.too_few_pixels, 2);
    }
}
