//! Triangles to pixels.

/// Calls `visit(pixel, weights)` for every pixel centre inside a triangle (corners in pixels, image y down), either way round;
/// edges count as inside, so that neighbours leave no gap.
#[inline(always)]
pub fn for_each_pixel(
    corners: [[f32; 2]; 3],
    width_px: usize,
    height_px: usize,
    mut visit: impl FnMut(usize, [f32; 3]),
) {
    let [[ax, ay], [bx, by], [cx, cy]] = corners;
    let first = |a: f32, b: f32, c: f32| ceil(a.min(b).min(c).max(0.0));
    let (x0, y0) = (first(ax, bx, cx), first(ay, by, cy));
    let x1 = ax.max(bx).max(cx).min((width_px - 1) as f32);
    let y1 = ay.max(by).max(cy).min((height_px - 1) as f32);
    if x0 as f32 > x1 || y0 as f32 > y1 {
        return;
    }
    let (abx, aby, acx, acy) = (bx - ax, by - ay, cx - ax, cy - ay);
    let area = abx * acy - aby * acx;
    if area == 0.0 {
        return;
    }
    let inverse = 1.0 / area;
    for y in y0..=y1 as usize {
        let dy = y as f32 - ay;
        for x in x0..=x1 as usize {
            let dx = x as f32 - ax;
            let b = (dx * acy - dy * acx) * inverse;
            let c = (abx * dy - aby * dx) * inverse;
            let a = 1.0 - b - c;
            if a.min(b).min(c) >= -1e-5 {
                visit(y * width_px + x, [a, b, c]);
            }
        }
    }
}

/// Smallest whole number not below `v`, for `v` of 0 or more.
#[inline(always)]
fn ceil(v: f32) -> usize {
    let whole = v as i32;
    (whole + i32::from(v > whole as f32)) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_triangles_cover_a_rectangle_without_gaps() {
        let corners = [[1.3, 2.1], [17.7, 2.4], [1.1, 12.9], [17.2, 12.6]];
        let mut hits = vec![0; 20 * 15];
        for [a, b, c] in [[0, 2, 1], [1, 2, 3]] {
            for_each_pixel([corners[a], corners[b], corners[c]], 20, 15, |i, w: [f32; 3]| {
                assert!((w.iter().sum::<f32>() - 1.0).abs() < 1e-5);
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
        for_each_pixel([[-5.0, -5.0], [30.0, -5.0], [-5.0, 30.0]], 4, 3, |_, _| count += 1);
        assert_eq!(count, 12);
        for_each_pixel([[-5.0, -5.0], [-1.0, -5.0], [-5.0, -1.0]], 4, 3, |_, _| panic!("outside"));
    }
}
