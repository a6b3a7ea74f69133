//! Drawing triangles into a picture in integers: which one each pixel sees, and how deep.

use super::reciprocal::Reciprocal;
use super::view::{PX_BITS, Seen};
use std::ops::Range;

/// Depth of a pixel that sees nothing.
pub const NOTHING: i32 = i32::MAX;
/// Fraction bits of the depth's slope.
const SLOPE_BITS: u32 = 16;
/// Triangles that span more than this many pixels a side are not drawn: no surface of a scan does.
const MAX_SPAN: i32 = 512 << PX_BITS;

/// Nearest triangle and its depth at each pixel centre.
#[derive(Debug, Clone, Default)]
pub struct DepthPicture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Depth in units, [`NOTHING`] where no triangle is seen.
    pub depth: Vec<i32>,
    /// Index of the triangle seen; meaningless where there is none.
    pub triangle: Vec<u32>,
}

impl DepthPicture {
    /// A picture that sees nothing.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, depth: vec![NOTHING; width * height], triangle: vec![0; width * height] }
    }

    /// Forgets what was drawn.
    pub fn clear(&mut self) {
        self.depth.fill(NOTHING);
    }

    /// Columns and rows of the pixels around a triangle; `None` where there are none, or more than a surface of a scan has.
    fn around(&self, [a, b, c]: [Seen; 3]) -> Option<[Range<i32>; 2]> {
        let (x0, x1) = (a.x.min(b.x).min(c.x), a.x.max(b.x).max(c.x));
        let (y0, y1) = (a.y.min(b.y).min(c.y), a.y.max(b.y).max(c.y));
        if x1 - x0 > MAX_SPAN || y1 - y0 > MAX_SPAN {
            return None;
        }
        let up = |v: i32| (v + 255) >> PX_BITS;
        let (px0, py0) = (up(x0).max(0), up(y0).max(0));
        let (px1, py1) = (((x1 >> PX_BITS) + 1).min(self.width as i32), ((y1 >> PX_BITS) + 1).min(self.height as i32));
        (px0 < px1 && py0 < py1).then_some([px0..px1, py0..py1])
    }

    /// Draws a front-facing triangle (clockwise in the picture, whose rows go down); pixel centres on an edge belong to the
    /// triangle on its right or below (top-left rule), so that neighbours neither overlap nor leave gaps. Returns how many pixels were
    /// looked at: the triangle's extent within the picture.
    pub fn draw(&mut self, index: u32, corners: [Seen; 3]) -> usize {
        let [a, b, c] = corners;
        let (abx, aby) = (i64::from(b.x - a.x), i64::from(b.y - a.y));
        let (acx, acy) = (i64::from(c.x - a.x), i64::from(c.y - a.y));
        // Counter-clockwise as seen with y up is clockwise with y down.
        let area = acx * aby - abx * acy;
        if area <= 0 {
            return 0;
        }
        let Some([columns, rows]) = self.around(corners) else { return 0 };
        let (px0, py0) = (columns.start, rows.start);
        let (dz1, dz2) = (i64::from(b.depth - a.depth), i64::from(c.depth - a.depth));
        // Plane through the corners: depth slopes a pixel.
        let by = Reciprocal::new(area);
        let sx = by.truncated((dz2 * aby - dz1 * acy) << (SLOPE_BITS + PX_BITS)).clamp(-(1 << 40), 1 << 40);
        let sy = by.truncated((dz1 * acx - dz2 * abx) << (SLOPE_BITS + PX_BITS)).clamp(-(1 << 40), 1 << 40);
        let edges = [Edge::new(b, a), Edge::new(c, b), Edge::new(a, c)];
        let (ox, oy) = (i64::from((px0 << PX_BITS) - a.x), i64::from((py0 << PX_BITS) - a.y));
        let mut row_depth =
            (i64::from(a.depth) << SLOPE_BITS) + ((sx * ox + sy * oy) >> PX_BITS) + (1 << (SLOPE_BITS - 1));
        let mut row_edge = [0, 1, 2].map(|i: usize| edges[i].at(px0, py0));
        let looked_at = columns.len() * rows.len();
        for y in rows {
            let (mut depth, mut e) = (row_depth, row_edge);
            let start = y as usize * self.width;
            let pixels = start + columns.start as usize..start + columns.end as usize;
            for (nearest, triangle) in self.depth[pixels.clone()].iter_mut().zip(&mut self.triangle[pixels]) {
                // Without a branch: what is inside is hard to foresee.
                let d = (depth >> SLOPE_BITS) as i32;
                let is_seen = ((e[0] | e[1] | e[2]) >= 0) & (d < *nearest);
                *nearest = if is_seen { d } else { *nearest };
                *triangle = if is_seen { index } else { *triangle };
                for (e, edge) in e.iter_mut().zip(&edges) {
                    *e += edge.dx;
                }
                depth += sx;
            }
            for (e, edge) in row_edge.iter_mut().zip(&edges) {
                *e += edge.dy;
            }
            row_depth += sy;
        }
        looked_at
    }
}

/// An edge function: not negative on the inner side, zero on the edge only for edges that own their pixels.
struct Edge {
    a: i64,
    b: i64,
    c: i64,
    dx: i64,
    dy: i64,
}

impl Edge {
    fn new(from: Seen, to: Seen) -> Self {
        let (a, b) = (i64::from(from.y - to.y), i64::from(to.x - from.x));
        let owns = a > 0 || (a == 0 && b > 0);
        let c = -(a * i64::from(from.x) + b * i64::from(from.y)) - i64::from(!owns);
        Self { a, b, c, dx: a << PX_BITS, dy: b << PX_BITS }
    }

    fn at(&self, x: i32, y: i32) -> i64 {
        self.a * (i64::from(x) << PX_BITS) + self.b * (i64::from(y) << PX_BITS) + self.c
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(x: i32, y: i32, depth: i32) -> Seen {
        Seen { x, y, depth }
    }

    #[test]
    fn two_triangles_of_a_square_meet_without_gap_or_overlap() {
        let (a, b, c, d) =
            (seen(512, 512, 100), seen(5 * 256, 512, 100), seen(5 * 256, 6 * 256, 100), seen(512, 6 * 256, 100));
        let mut covered = 0;
        for t in [[a, c, b], [a, d, c]] {
            let mut p = DepthPicture::new(10, 10);
            p.draw(0, t);
            covered += p.depth.iter().filter(|d| **d != NOTHING).count();
        }
        assert_eq!(covered, 3 * 4);
    }

    #[test]
    fn depth_is_the_plane_and_the_nearest_wins() {
        let plane = |x: i32, y: i32| seen(x * 256, y * 256, 1000 + 30 * x - 20 * y);
        let mut p = DepthPicture::new(32, 32);
        p.draw(1, [plane(0, 0), plane(0, 31), plane(31, 0)]);
        for y in 1..15 {
            for x in 1..15 {
                assert_eq!(p.depth[y * 32 + x], 1000 + 30 * x as i32 - 20 * y as i32);
            }
        }
        p.draw(2, [seen(0, 0, 900), seen(0, 31 * 256, 900), seen(31 * 256, 0, 900)]);
        assert_eq!((p.depth[5 * 32 + 5], p.triangle[5 * 32 + 5]), (900, 2));
        p.draw(3, [seen(0, 0, 9), seen(31 * 256, 0, 9), seen(0, 31 * 256, 9)]);
        assert_eq!(p.triangle[5 * 32 + 5], 2, "a back face is not drawn");
    }
}
