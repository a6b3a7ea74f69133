//! The prediction filter of raw pictures: each pixel less what its neighbours say it is.
//!
//! The median edge detector of LOCO-I (Weinberger, Seroussi, Sapiro, IEEE Trans. Image Processing 9(8), 2000, eq. 1), which
//! takes the pixel above along a vertical fringe, the one to the left along a horizontal one, and their plane elsewhere.

/// Prediction of a pixel from the one to its left, above, and above left.
fn predicted(left: u8, above: u8, corner: u8) -> u8 {
    let plane = i16::from(left) + i16::from(above) - i16::from(corner);
    // Between the smaller and the larger of two bytes, so a byte.
    plane.clamp(i16::from(left.min(above)), i16::from(left.max(above))) as u8
}

/// Residuals of a picture of rows of `width_px`, modulo 256, into `out`. The first row is predicted from the left, the first
/// column from above, the first pixel as 0.
///
/// # Panics
/// When `out` is not as long as `pixels`, or `width_px` is 0 or no divisor of it.
pub fn residuals(pixels: &[u8], width_px: usize, out: &mut [u8]) {
    assert_eq!(pixels.len(), out.len(), "a residual a pixel");
    assert!(width_px > 0 && pixels.len().is_multiple_of(width_px), "whole rows");
    let mut above: &[u8] = &[];
    for (row, out) in pixels.chunks_exact(width_px).zip(out.chunks_exact_mut(width_px)) {
        out[0] = row[0].wrapping_sub(above.first().copied().unwrap_or(0));
        if above.is_empty() {
            for (out, pair) in out[1..].iter_mut().zip(row.windows(2)) {
                *out = pair[1].wrapping_sub(pair[0]);
            }
        } else {
            // Windows instead of indices, so that the loop has no bounds to check and becomes vector code.
            for ((out, pair), above) in out[1..].iter_mut().zip(row.windows(2)).zip(above.windows(2)) {
                *out = pair[1].wrapping_sub(predicted(pair[0], above[1], above[0]));
            }
        }
        above = row;
    }
}

/// Turns residuals back into pixels in place: the inverse of [`residuals`].
///
/// # Panics
/// When `width_px` is 0 or no divisor of the length.
pub fn undo(bytes: &mut [u8], width_px: usize) {
    assert!(width_px > 0 && bytes.len().is_multiple_of(width_px), "whole rows");
    let (first, rest) = bytes.split_at_mut(width_px.min(bytes.len()));
    let mut left = 0u8;
    for pixel in first.iter_mut() {
        *pixel = pixel.wrapping_add(left);
        left = *pixel;
    }
    let mut above: &[u8] = first;
    for rows in rest.chunks_mut(2 * width_px) {
        let (upper, lower) = rows.split_at_mut(width_px);
        if lower.is_empty() {
            undo_row(above, upper);
        } else {
            undo_pair(above, upper, lower);
        }
        above = lower;
    }
}

/// A pixel from its residual: [`predicted`], written so that little waits for the pixel to the left.
fn restored(residual: u8, left: u8, above: u8, corner: u8) -> u8 {
    let slope = i16::from(above) - i16::from(corner);
    let (low, high) = (slope.min(0), slope.max(0));
    let left = i16::from(left);
    residual.wrapping_add(i16::from(above).max(left + low).min(left + high) as u8)
}

fn undo_row(above: &[u8], row: &mut [u8]) {
    row[0] = row[0].wrapping_add(above[0]);
    let mut left = row[0];
    for (pixel, above) in row[1..].iter_mut().zip(above.windows(2)) {
        *pixel = restored(*pixel, left, above[1], above[0]);
        left = *pixel;
    }
}

/// Two rows at once, the lower a pixel behind: in each, every pixel waits for the one before, but no row for the other.
fn undo_pair(above: &[u8], upper: &mut [u8], lower: &mut [u8]) {
    upper[0] = upper[0].wrapping_add(above[0]);
    lower[0] = lower[0].wrapping_add(upper[0]);
    let (mut corner, mut left, mut lower_left) = (upper[0], upper[0], lower[0]);
    if let (Some(pixel), [corner, above, ..]) = (upper.get_mut(1), above) {
        *pixel = restored(*pixel, left, *above, *corner);
        left = *pixel;
    } else {
        return;
    }
    for ((pixel, lower), above) in upper[2..].iter_mut().zip(&mut lower[1..]).zip(above[1..].windows(2)) {
        *lower = restored(*lower, lower_left, left, corner);
        lower_left = *lower;
        *pixel = restored(*pixel, left, above[1], above[0]);
        (corner, left) = (left, *pixel);
    }
    if let Some(last) = lower.last_mut() {
        *last = restored(*last, lower_left, left, corner);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn known_residuals() {
        let pixels: Vec<u8> = (0..6 * 5).map(|i| 10 + 2 * (i % 6) + 3 * (i / 6)).collect();
        let mut out = vec![0; 30];
        residuals(&pixels, 6, &mut out);
        assert_eq!(out[..7], [10, 2, 2, 2, 2, 2, 3]);
        // Both neighbours rise from the corner, so the larger is taken, and the slope of the row remains.
        assert_eq!(out[7..12], [2; 5]);
        assert_eq!(predicted(13, 12, 10), 13);
        assert_eq!(predicted(10, 14, 12), 12);
        assert_eq!(predicted(200, 250, 10), 250);
        assert_eq!(predicted(5, 9, 255), 5);
    }

    #[test]
    fn restoring_is_adding_to_the_prediction() {
        for (left, above, corner) in (0..=255).step_by(5).flat_map(|l| {
            (0..=255).step_by(5).flat_map(move |a| (0..=255).step_by(5).map(move |c| (l as u8, a as u8, c as u8)))
        }) {
            let expected = predicted(left, above, corner).wrapping_add(77);
            assert_eq!(restored(77, left, above, corner), expected, "{left} {above} {corner}");
        }
    }

    proptest! {
        #[test]
        fn undo_is_the_inverse(width in 1usize..40, height in 1usize..12, seed in any::<u64>()) {
            let mut state = seed;
            let mut next = || { state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1); (state >> 56) as u8 };
            let pixels: Vec<u8> = (0..width * height).map(|_| next()).collect();
            let mut bytes = vec![0; pixels.len()];
            residuals(&pixels, width, &mut bytes);
            undo(&mut bytes, width);
            prop_assert_eq!(bytes, pixels);
        }
    }
}
