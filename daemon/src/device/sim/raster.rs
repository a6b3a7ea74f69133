//! Triangles to pixels.

/// 1.5 * 2^23: added to a number it leaves the nearest whole number in the low bits of the mantissa, for 0..2^22.
const ROUNDER: f32 = 12_582_912.0;

/// Nearest whole number, for `v` from -0.5 to 2^22; no conversion that needs care about range.
#[inline(always)]
pub fn nearest(v: f32) -> usize {
    (v + ROUNDER).to_bits().wrapping_sub(ROUNDER.to_bits()) as usize
}

/// Whole part of `v`, 0 to 2^22; of a whole number either it or, for odd ones, the one below.
#[inline(always)]
pub fn whole(v: f32) -> usize {
    nearest(v - 0.5)
}

#[inline(always)]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Calls `visit(pixel, b, c)` for every pixel centre inside a triangle (corners in pixels, image y down), either way round; `b`
/// and `c` are the weights of the second and third corner. Edges count as inside, so that neighbours leave no gap. A corner
/// that is not a number leaves the triangle out.
#[inline(always)]
pub fn for_each_pixel(
    corners: [[f32; 2]; 3],
    width_px: usize,
    height_px: usize,
    mut visit: impl FnMut(usize, f32, f32),
) {
    /// Weights this far outside are inside; the bounds reach a little further than whole pixels for the same reason.
    const TOLERANCE: f32 = 1e-5;
    const REACH: f32 = 0.4999;
    let [[ax, ay], [bx, by], [cx, cy]] = corners;
    let (right, bottom) = ((width_px - 1) as f32, (height_px - 1) as f32);
    let (low_x, low_y) = (smaller(smaller(ax, bx), cx), smaller(smaller(ay, by), cy));
    let (high_x, high_y) = (larger(larger(ax, bx), cx), larger(larger(ay, by), cy));
    let (abx, aby, acx, acy) = (bx - ax, by - ay, cx - ax, cy - ay);
    let area = abx * acy - aby * acx;
    let is_outside = (low_x > right) | (low_y > bottom) | (high_x < 0.0) | (high_y < 0.0);
    if is_outside | (area == 0.0) | !area.is_finite() {
        return;
    }
    let (x0, y0) = (nearest(larger(low_x, 0.0) + REACH), nearest(larger(low_y, 0.0) + REACH));
    let (x1, y1) = (nearest(smaller(high_x, right) - REACH), nearest(smaller(high_y, bottom) - REACH));
    let inverse = 1.0 / area;
    let (b_x, b_y) = (acy * inverse, -acx * inverse);
    let (c_x, c_y) = (-aby * inverse, abx * inverse);
    for y in y0..=y1 {
        let dy = y as u32 as i32 as f32 - ay;
        let (b_row, c_row) = (dy * b_y, dy * c_y);
        for x in x0..=x1 {
            let dx = x as u32 as i32 as f32 - ax;
            let (b, c) = (b_row + dx * b_x, c_row + dx * c_x);
            if (b >= -TOLERANCE) & (c >= -TOLERANCE) & (b + c <= 1.0 + TOLERANCE) {
                visit(y * width_px + x, b, c);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_triangles_cover_a_rectangle_without_gaps() {
        let corners = [[1.3, 2.1], [17.7, 2.4], [1.1, 12.9], [17.2, 12.6]];
        let mut hits = vec![0; 20 * 15];
        for [a, b, c] in [[0, 2, 1], [1, 2, 3]] {
            let corners: [[f32; 2]; 3] = [corners[a], corners[b], corners[c]];
            for_each_pixel(corners, 20, 15, |i, b, c| {
                let place = |k: usize| (1.0 - b - c) * corners[0][k] + b * corners[1][k] + c * corners[2][k];
                assert!((place(0) - (i % 20) as f32).abs() < 1e-4 && (place(1) - (i / 20) as f32).abs() < 1e-4);
                hits[i] += 1;
            });
        }
        for y in 3..=12 {
            assert!(hits[y * 20 + 2..y * 20 + 18].iter().all(|&h| h >= 1), "row {y}");
        }
        assert_eq!(hits[2 * 20 + 1] + hits[13 * 20 + 5] + hits[5 * 20 + 18], 0);
    }

    #[test]
    fn triangles_outside_the_picture_are_clipped() {
        let mut count = 0;
        for_each_pixel([[-5.0, -5.0], [30.0, -5.0], [-5.0, 30.0]], 4, 3, |_, _, _| count += 1);
        assert_eq!(count, 12);
        let outside = [
            [[-5.0, -5.0], [-1.0, -5.0], [-5.0, -1.0]],
            [[-0.4, -5.0], [-0.1, 5.0], [-5.0, -1.0]],
            [[3.2, 0.0], [3.4, 5.0], [9.0, -1.0]],
            [[0.0, f32::NAN], [30.0, 0.0], [0.0, 30.0]],
            [[0.0, 1e38], [30.0, -1e38], [0.0, 30.0]],
        ];
        for corners in outside {
            for_each_pixel(corners, 4, 3, |i, _, _| panic!("{i} is inside {corners:?}"));
        }
    }

    #[test]
    fn whole_parts_are_exact_to_a_pixel() {
        assert_eq!([0.0f32, 0.4, 0.6, 3.2, 1e6].map(nearest), [0, 0, 1, 3, 1_000_000]);
        assert_eq!([0.0f32, 0.9, 2.0, 2.01, 7.99].map(whole), [0, 0, 2, 2, 7]);
        assert_eq!(nearest(-0.3), 0);
    }
}
