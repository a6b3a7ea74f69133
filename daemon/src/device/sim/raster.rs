//! Triangles to pixels.

use glam::Vec4;

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

/// Weights this far outside a triangle are inside, so that neighbours leave no gap.
const TOLERANCE: f32 = 1e-5;
/// Added to a bound before it is rounded: a little less than a half, so that no pixel of the tolerance is missed.
const REACH: f32 = 0.4999;

/// Four triangles as the raster needs them: first and last pixel, and weights of the second and third corner at the first
/// pixel with their steps to the right and down.
struct Four {
    first: [[f32; 4]; 2],
    last: [[f32; 4]; 2],
    at_first: [[f32; 4]; 2],
    right: [[f32; 4]; 2],
    down: [[f32; 4]; 2],
    /// Neither degenerate, nor outside the picture, nor with a corner that is no number.
    is_drawn: u32,
}

impl Four {
    /// From corners by axis; four at once, since triangles of a scan or of the head are about as large as a pixel, so that
    /// this is most of the work.
    #[inline(always)]
    fn new([[ax, ay], [bx, by], [cx, cy]]: [[Vec4; 2]; 3], right_px: f32, bottom_px: f32) -> Self {
        let (abx, aby, acx, acy) = (bx - ax, by - ay, cx - ax, cy - ay);
        let area = abx * acy - aby * acx;
        let inverse = Vec4::ONE / area;
        let rounder = Vec4::splat(ROUNDER);
        let low =
            |a: Vec4, b: Vec4, c: Vec4| (a.min(b).min(c).max(Vec4::ZERO) + Vec4::splat(REACH) + rounder) - rounder;
        let high = |a: Vec4, b: Vec4, c: Vec4, most: f32| {
            (a.max(b).max(c).min(Vec4::splat(most)) - Vec4::splat(REACH) + rounder) - rounder
        };
        let (x0, y0) = (low(ax, bx, cx), low(ay, by, cy));
        let (x1, y1) = (high(ax, bx, cx, right_px), high(ay, by, cy, bottom_px));
        let (b_x, b_y, c_x, c_y) = (acy * inverse, -acx * inverse, -aby * inverse, abx * inverse);
        let (dx, dy) = (x0 - ax, y0 - ay);
        // The steps of a triangle without area are no numbers or infinite.
        let is_finite = (b_x + b_y + c_x + c_y).abs().cmplt(Vec4::MAX) & area.abs().cmplt(Vec4::MAX);
        let is_within = x0.cmple(x1) & y0.cmple(y1) & x1.cmpge(Vec4::ZERO) & y1.cmpge(Vec4::ZERO);
        Self {
            first: [x0, y0].map(|v| v.to_array()),
            last: [x1, y1].map(|v| v.to_array()),
            at_first: [dx * b_x + dy * b_y, dx * c_x + dy * c_y].map(|v| v.to_array()),
            right: [b_x, c_x].map(|v| v.to_array()),
            down: [b_y, c_y].map(|v| v.to_array()),
            is_drawn: (is_finite & is_within).bitmask(),
        }
    }
}

/// Calls `visit(triangle, pixel, b, c)` for every pixel centre inside every triangle, in order, either way round; `px` gives
/// the place of a corner (image y down), `b` and `c` are the weights of the second and third corner. Edges count as inside. A
/// corner that is not a number leaves its triangles out.
#[inline(always)]
pub fn for_each_pixel(
    triangles: &[[u32; 3]],
    px: impl Fn(u32) -> [f32; 2],
    [width_px, height_px]: [usize; 2],
    mut visit: impl FnMut(&[u32; 3], usize, f32, f32),
) {
    let (fours, rest) = triangles.as_chunks::<4>();
    for group in fours {
        draw_four(group, 4, &px, [width_px, height_px], &mut visit);
    }
    if let Some(last) = rest.last() {
        let mut group = [*last; 4];
        group[..rest.len()].copy_from_slice(rest);
        draw_four(&group, rest.len(), &px, [width_px, height_px], &mut visit);
    }
}

/// Visits the pixels of the first `count` of four triangles.
#[inline(always)]
fn draw_four(
    group: &[[u32; 3]; 4],
    count: usize,
    px: &impl Fn(u32) -> [f32; 2],
    [width_px, height_px]: [usize; 2],
    visit: &mut impl FnMut(&[u32; 3], usize, f32, f32),
) {
    let corner = |k: usize| {
        let (p, q, r, s) = (px(group[0][k]), px(group[1][k]), px(group[2][k]), px(group[3][k]));
        [Vec4::new(p[0], q[0], r[0], s[0]), Vec4::new(p[1], q[1], r[1], s[1])]
    };
    let four = Four::new([corner(0), corner(1), corner(2)], (width_px - 1) as f32, (height_px - 1) as f32);
    for (k, triangle) in group.iter().enumerate().take(count) {
        if four.is_drawn >> k & 1 != 0 {
            four.draw(k, width_px, height_px, |i, b, c| visit(triangle, i, b, c));
        }
    }
}

impl Four {
    /// Visits the pixels of triangle `k`, two by two at once: loops over the bounds of so few would only be guessed wrong.
    #[inline(always)]
    fn draw(&self, k: usize, width_px: usize, height_px: usize, mut visit: impl FnMut(usize, f32, f32)) {
        let (x0, y0) = (nearest(self.first[0][k]), nearest(self.first[1][k]));
        let (x1, y1) = (nearest(self.last[0][k]), nearest(self.last[1][k]));
        let (b_x, b_y) = (self.right[0][k], self.down[0][k]);
        let (c_x, c_y) = (self.right[1][k], self.down[1][k]);
        let b_block = Vec4::splat(self.at_first[0][k]) + Vec4::new(0.0, b_x, b_y, b_x + b_y);
        let c_block = Vec4::splat(self.at_first[1][k]) + Vec4::new(0.0, c_x, c_y, c_x + c_y);
        let mut y = y0;
        while y <= y1 {
            let mut x = x0;
            while x <= x1 {
                let (right, down) = (float(x - x0), float(y - y0));
                let b = b_block + Vec4::splat(right * b_x + down * b_y);
                let c = c_block + Vec4::splat(right * c_x + down * c_y);
                let low = Vec4::splat(-TOLERANCE);
                let is_inside = b.cmpge(low) & c.cmpge(low) & (b + c).cmple(Vec4::splat(1.0 + TOLERANCE));
                // Beyond the picture's last column and row there are no pixels.
                let mut bits = is_inside.bitmask() & (0b0101 | (u32::from(x < width_px - 1) * 0b1010));
                bits &= 0b0011 | (u32::from(y < height_px - 1) * 0b1100);
                let (b, c) = (b.to_array(), c.to_array());
                while bits != 0 {
                    let k = bits.trailing_zeros() as usize & 3;
                    visit((y + k / 2) * width_px + x + k % 2, b[k], c[k]);
                    bits &= bits - 1;
                }
                x += 2;
            }
            y += 2;
        }
    }
}

/// A pixel's number as a coordinate; 32 bits, which convert fastest.
#[inline(always)]
fn float(v: usize) -> f32 {
    v as u32 as i32 as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::sim::noise;

    #[test]
    fn two_triangles_cover_a_rectangle_without_gaps() {
        let corners = [[1.3, 2.1], [17.7, 2.4], [1.1, 12.9], [17.2, 12.6f32]];
        let mut hits = vec![0; 20 * 15];
        for_each_pixel(
            &[[0, 2, 1], [1, 2, 3]],
            |v| corners[v as usize],
            [20, 15],
            |t, i, b, c| {
                let [p, q, r] = t.map(|v| corners[v as usize]);
                let place = |k: usize| (1.0 - b - c) * p[k] + b * q[k] + c * r[k];
                assert!((place(0) - (i % 20) as f32).abs() < 1e-4 && (place(1) - (i / 20) as f32).abs() < 1e-4);
                hits[i] += 1;
            },
        );
        for y in 3..=12 {
            assert!(hits[y * 20 + 2..y * 20 + 18].iter().all(|&h| h >= 1), "row {y}");
        }
        assert_eq!(hits[2 * 20 + 1] + hits[13 * 20 + 5] + hits[5 * 20 + 18], 0);
    }

    #[test]
    fn small_triangles_hit_what_exact_arithmetic_says() {
        // A fan of slivers and small triangles, some across the borders; corners off the pixels' rows and columns.
        let at = |i: u32, k: u32| (noise::hash(u64::from(i * 2 + k)) % 4000) as f32 * 0.0037 - 2.013;
        let px = |v: u32| [at(v / 3 * 3, 0) + 0.2 * at(v + 9000, 0), at(v / 3 * 3, 1) + 0.2 * at(v + 9000, 1)];
        let triangles: Vec<[u32; 3]> = (0..999).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let mut found = vec![0u32; triangles.len()];
        for_each_pixel(&triangles, px, [9, 7], |t, _, _, _| found[t[0] as usize / 3] += 1);
        for (triangle, found) in triangles.iter().zip(found) {
            let [a, b, c] = triangle.map(|v| px(v).map(f64::from));
            let side =
                |p: [f64; 2], q: [f64; 2], x: f64, y: f64| (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]);
            let area = side(a, b, c[0], c[1]);
            let inside = |margin: f64| {
                let hit = |(x, y)| [(a, b), (b, c), (c, a)].iter().all(|(p, q)| side(*p, *q, x, y) / area >= -margin);
                (0..63).filter(|i| hit((f64::from(i % 9), f64::from(i / 9)))).count() as u32
            };
            // Single precision weighs a sliver's corners less exactly.
            let margin = 1e-4 + 3e-5 / area.abs();
            assert!((inside(-margin)..=inside(margin)).contains(&found), "{a:?} {b:?} {c:?}: {found}");
        }
    }

    #[test]
    fn triangles_outside_the_picture_are_clipped() {
        let count = |corners: [[f32; 2]; 3]| {
            let mut count = 0;
            for_each_pixel(&[[0, 1, 2]], |v| corners[v as usize], [4, 3], |_, _, _, _| count += 1);
            count
        };
        assert_eq!(count([[-5.0, -5.0], [30.0, -5.0], [-5.0, 30.0]]), 12);
        let outside = [
            [[-5.0, -5.0], [-1.0, -5.0], [-5.0, -1.0]],
            [[-0.4, -5.0], [-0.1, 5.0], [-5.0, -1.0]],
            [[3.2, 0.0], [3.4, 5.0], [9.0, -1.0]],
            [[0.0, f32::NAN], [30.0, 0.0], [0.0, 30.0]],
            [[0.0, 1e38], [30.0, -1e38], [0.0, 30.0]],
            [[1.0, 1.0], [2.0, 1.0], [3.0, 1.0]],
        ];
        for corners in outside {
            assert_eq!(count(corners), 0, "{corners:?}");
        }
    }

    #[test]
    fn whole_parts_are_exact_to_a_pixel() {
        assert_eq!([0.0f32, 0.4, 0.6, 3.2, 1e6].map(nearest), [0, 0, 1, 3, 1_000_000]);
        assert_eq!([0.0f32, 0.9, 2.0, 2.01, 7.99].map(whole), [0, 0, 2, 2, 7]);
        assert_eq!(nearest(-0.3), 0);
    }
}
