//! Sparse optical flow: pyramidal Lucas-Kanade for points, checked forward-backward and by correlation.
//!
//! Lucas, Kanade: An iterative image registration technique, IJCAI 1981, with the template gradient kept over the
//! iterations (Baker, Matthews: Lucas-Kanade 20 years on, IJCV 2004, section 3.2) and the pyramid of Bouguet: Pyramidal
//! implementation of the Lucas Kanade feature tracker, 1999. The forward-backward error is that of Kalal, Mikolajczyk,
//! Matas: Forward-backward error, ICPR 2010.

use super::pyramid::{Level, PAD_PX, Pyramid};

/// Smallest eigenvalue, per pixel of the window, of a structure tensor that fixes a point (normalised grey² / px²).
const MIN_EIGENVALUE: f32 = 1e-4;
/// Levels searched for a point whose step is about known.
const EXPECTED_LEVELS: u32 = 2;
/// What a coarse level leaves open the finer one finds: it ends at a step this much longer.
const COARSE_EPSILON: f32 = 4.0;
/// Largest window the border of the pyramid holds.
const MAX_WINDOW_PX: u32 = 2 * (PAD_PX as u32 - 8) + 1;

/// How points are followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlowOptions {
    /// Side of the square window, odd, 3 to 25.
    pub window_px: u32,
    /// Pyramid levels searched.
    pub levels: u32,
    /// Gauss-Newton steps a level at most.
    pub max_iterations: u32,
    /// A step shorter than this ends a level.
    pub epsilon_px: f32,
    /// A point followed there and back again must come home this near.
    pub max_backward_px: f32,
    /// Least zero-mean normalised cross-correlation of the two windows.
    pub min_zncc: f32,
    /// A point that went where it was expected and correlates like this need not be followed back.
    pub sure_zncc: f32,
}

impl Default for FlowOptions {
    fn default() -> Self {
        Self {
            window_px: 15,
            levels: 3,
            max_iterations: 12,
            epsilon_px: 0.03,
            max_backward_px: 0.5,
            min_zncc: 0.75,
            sure_zncc: 0.9,
        }
    }
}

/// Where each of `points` (px, finest level) of `from` has gone in `to`; `None` where the window has no texture, the point
/// left the picture, or a check of [`FlowOptions`] failed. The pictures may differ in size.
///
/// # Panics
/// When the window is even or not within 3..=25, or no level is asked for.
pub fn follow(from: &Pyramid, to: &Pyramid, points: &[[f32; 2]], options: &FlowOptions) -> Vec<Option<[f32; 2]>> {
    follow_from(from, to, &points.iter().map(|&point| (point, None)).collect::<Vec<_>>(), options)
}

/// As [`follow`], for points with the step (px) that each is expected to make, where there is one. From there the two
/// finest levels are enough; where they fail, all levels try again from a still start.
pub(super) fn follow_from(
    from: &Pyramid,
    to: &Pyramid,
    points: &[([f32; 2], Option<[f32; 2]>)],
    options: &FlowOptions,
) -> Vec<Option<[f32; 2]>> {
    assert!(options.levels > 0, "flow needs a pyramid level");
    let mut search = Search::new(options);
    let mut checked = |point: [f32; 2], levels: u32, step: Option<[f32; 2]>| {
        let there = search.track(from, to, point, levels, step.unwrap_or_default())?;
        let likeness = zncc(from.finest(), point, to.finest(), there, options.window_px);
        if step.is_some() && likeness >= options.sure_zncc {
            return Some(there);
        }
        let back = search.track(to, from, there, levels, step.map_or([0.0; 2], |s| s.map(|s| -s)))?;
        let home = libm::hypotf(back[0] - point[0], back[1] - point[1]) <= options.max_backward_px;
        (home && likeness >= options.min_zncc).then_some(there)
    };
    let mut one = |&(point, step): &([f32; 2], Option<[f32; 2]>)| {
        let expected = step.and_then(|_| checked(point, options.levels.min(EXPECTED_LEVELS), step));
        expected.or_else(|| checked(point, options.levels, None))
    };
    points.iter().map(&mut one).collect()
}

/// Zero-mean normalised cross-correlation, -1..1, of the windows about `a_px` in `a` and `b_px` in `b`; 0 where a window
/// is flat or its centre lies outside the picture.
///
/// # Panics
/// When the window is even or not within 3..=25.
pub fn zncc(a: &Level, a_px: [f32; 2], b: &Level, b_px: [f32; 2], window_px: u32) -> f32 {
    assert_window(window_px);
    if !a.contains(a_px) || !b.contains(b_px) {
        return 0.0;
    }
    let (n, half) = (window_px as usize, (window_px / 2) as f32);
    let (mut row_a, mut row_b) = ([0.0_f32; MAX_WINDOW_PX as usize], [0.0_f32; MAX_WINDOW_PX as usize]);
    let mut sums = [0.0_f32; 5];
    let corner = |px: [f32; 2]| Corner::of([px[0] - half, px[1] - half]);
    let (corner_a, corner_b) = (corner(a_px), corner(b_px));
    for r in 0..n {
        a.sample_row(&corner_a, r, &mut row_a[..n]);
        b.sample_row(&corner_b, r, &mut row_b[..n]);
        for (&p, &q) in row_a[..n].iter().zip(&row_b[..n]) {
            for (sum, term) in sums.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                *sum += term;
            }
        }
    }
    let count = (n * n) as f32;
    let [p, q, pp, qq, pq] = sums.map(|s| s / count);
    let (var_p, var_q) = (pp - p * p, qq - q * q);
    if var_p <= 1e-8 || var_q <= 1e-8 { 0.0 } else { (pq - p * q) / (var_p * var_q).sqrt() }
}

fn assert_window(window_px: u32) {
    assert!(window_px % 2 == 1 && (3..=MAX_WINDOW_PX).contains(&window_px), "window of {window_px} px: odd, 3 to 25");
}

/// First sample of a patch: its pixel in the padded level and the bilinear weights that the whole patch shares.
struct Corner {
    x: usize,
    y: usize,
    weights: [f32; 4],
}

impl Corner {
    /// Of a position at most `PAD_PX` px outside the picture.
    fn of(px: [f32; 2]) -> Self {
        let (x, y) = (px[0] + PAD_PX as f32, px[1] + PAD_PX as f32);
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - row as f32);
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        Self { x: column, y: row, weights }
    }
}

impl Level {
    /// Row `r` of the patch that begins at `corner`.
    fn sample_row(&self, corner: &Corner, r: usize, out: &mut [f32]) {
        let n = out.len();
        let start = (corner.y + r) * self.stride + corner.x;
        let (top, bottom) = (&self.padded[start..][..n + 1], &self.padded[start + self.stride..][..n + 1]);
        let [w00, w10, w01, w11] = corner.weights;
        for i in 0..n {
            out[i] = w00 * top[i] + w10 * top[i + 1] + w01 * bottom[i] + w11 * bottom[i + 1];
        }
    }

    /// A point of a coarse level may lie up to half a pixel beyond its outermost centres; further is lost.
    fn reaches(&self, px: [f32; 2]) -> bool {
        px[0] >= -1.0 && px[1] >= -1.0 && px[0] <= self.width as f32 && px[1] <= self.height as f32
    }
}

/// The template of one point at one level, with its gradient, and the room to compute it.
struct Search<'o> {
    options: &'o FlowOptions,
    window: usize,
    /// Window width rounded up to whole vectors; the gradient is 0 in the surplus columns.
    lanes: usize,
    wide: Vec<f32>,
    template: Vec<f32>,
    gradient_x: Vec<f32>,
    gradient_y: Vec<f32>,
}

impl<'o> Search<'o> {
    fn new(options: &'o FlowOptions) -> Self {
        assert_window(options.window_px);
        let window = options.window_px as usize;
        let lanes = window.next_multiple_of(4);
        let zeros = vec![0.0; window * lanes];
        let wide = vec![0.0; (window + 2) * (lanes + 2)];
        Self { options, window, lanes, wide, template: zeros.clone(), gradient_x: zeros.clone(), gradient_y: zeros }
    }

    /// Coarse to fine, beginning with the step that is expected.
    fn track(
        &mut self,
        from: &Pyramid,
        to: &Pyramid,
        point: [f32; 2],
        levels: u32,
        step: [f32; 2],
    ) -> Option<[f32; 2]> {
        let levels = (levels as usize).min(from.levels.len()).min(to.levels.len());
        let coarsest = 1.0 / (1_u32 << (levels - 1)) as f32;
        let mut flow = step.map(|s| s * coarsest);
        for l in (0..levels).rev() {
            let scale = 1.0 / (1_u32 << l) as f32;
            let epsilon_px = self.options.epsilon_px * if l > 0 { COARSE_EPSILON } else { 1.0 };
            let at = point.map(|c| c * scale);
            let start = [at[0] + flow[0], at[1] + flow[1]];
            match self.refine(&from.levels[l], &to.levels[l], at, start, epsilon_px) {
                Some(end) => flow = [end[0] - at[0], end[1] - at[1]],
                // A coarse level may be flat where a finer one is not.
                None if l > 0 => {}
                None => return None,
            }
            if l > 0 {
                flow = flow.map(|f| 2.0 * f);
            }
        }
        let end = [point[0] + flow[0], point[1] + flow[1]];
        to.finest().contains(end).then_some(end)
    }

    /// Gauss-Newton at one level from the position `start`.
    fn refine(&mut self, from: &Level, to: &Level, at: [f32; 2], start: [f32; 2], epsilon_px: f32) -> Option<[f32; 2]> {
        if !from.reaches(at) {
            return None;
        }
        let [xx, xy, yy] = self.set_template(from, at);
        let determinant = xx * yy - xy * xy;
        let smallest = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        if smallest < MIN_EIGENVALUE * (self.window * self.window) as f32 {
            return None;
        }
        let mut position = start;
        for _ in 0..self.options.max_iterations {
            if !to.reaches(position) {
                return None;
            }
            let [bx, by] = self.steepest_descent(to, position);
            let step = [(xy * by - yy * bx) / determinant, (xy * bx - xx * by) / determinant];
            position = [position[0] + step[0], position[1] + step[1]];
            if step[0] * step[0] + step[1] * step[1] < epsilon_px * epsilon_px {
                break;
            }
        }
        to.reaches(position).then_some(position)
    }

    /// Samples the template and its central-difference gradient; returns the structure tensor {xx, xy, yy}.
    fn set_template(&mut self, from: &Level, at: [f32; 2]) -> [f32; 3] {
        let (n, lanes, half) = (self.window, self.lanes, (self.window / 2) as f32);
        let stride = lanes + 2;
        let corner = Corner::of([at[0] - half - 1.0, at[1] - half - 1.0]);
        for (r, row) in self.wide.chunks_exact_mut(stride).enumerate() {
            from.sample_row(&corner, r, row);
        }
        let mut tensor = [[0.0_f32; 4]; 3];
        for r in 0..n {
            let [above, here, below] = [r, r + 1, r + 2].map(|k| &self.wide[k * stride..][..stride]);
            let template = &mut self.template[r * lanes..][..lanes];
            let gradient_x = &mut self.gradient_x[r * lanes..][..lanes];
            let gradient_y = &mut self.gradient_y[r * lanes..][..lanes];
            for i in 0..lanes {
                template[i] = here[i + 1];
                gradient_x[i] = 0.5 * (here[i + 2] - here[i]);
                gradient_y[i] = 0.5 * (below[i + 1] - above[i + 1]);
            }
            gradient_x[n..].fill(0.0);
            gradient_y[n..].fill(0.0);
            for (gx, gy) in gradient_x.as_chunks::<4>().0.iter().zip(gradient_y.as_chunks::<4>().0) {
                for k in 0..4 {
                    tensor[0][k] += gx[k] * gx[k];
                    tensor[1][k] += gx[k] * gy[k];
                    tensor[2][k] += gy[k] * gy[k];
                }
            }
        }
        tensor.map(|t| t.iter().sum())
    }

    /// Gradient of half the squared mismatch between the template and `to` about `position`.
    fn steepest_descent(&self, to: &Level, position: [f32; 2]) -> [f32; 2] {
        let (lanes, half) = (self.lanes, (self.window / 2) as f32);
        let corner = Corner::of([position[0] - half, position[1] - half]);
        let [w00, w10, w01, w11] = corner.weights;
        let mut sums = [[0.0_f32; 4]; 2];
        for r in 0..self.window {
            let start = (corner.y + r) * to.stride + corner.x;
            let [t0, t1, b0, b1] = [start, start + 1, start + to.stride, start + to.stride + 1]
                .map(|s| to.padded[s..][..lanes].as_chunks::<4>().0);
            let [template, gx, gy] = [&self.template, &self.gradient_x, &self.gradient_y]
                .map(|v| v[r * lanes..][..lanes].as_chunks::<4>().0);
            for i in 0..template.len() {
                for k in 0..4 {
                    let value = w00 * t0[i][k] + w10 * t1[i][k] + w01 * b0[i][k] + w11 * b1[i][k];
                    let mismatch = value - template[i][k];
                    sums[0][k] += gx[i][k] * mismatch;
                    sums[1][k] += gy[i][k] * mismatch;
                }
            }
        }
        sums.map(|s| s.iter().sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::test_texture::{Warp, median, render};
    use proptest::prelude::*;

    const SIZE_PX: (u32, u32) = (190, 160);

    /// Far enough from the border that a window of the coarsest level stays inside after 7 px.
    fn grid_points() -> Vec<[f32; 2]> {
        (0..63).map(|i| [52.25 + 10.5 * (i % 9) as f32, 50.5 + 9.75 * (i / 9) as f32]).collect()
    }

    /// Errors (px) of the points that are followed.
    fn errors(warp: &Warp, options: &FlowOptions) -> Vec<f32> {
        let (a, b) = (
            Pyramid::new(&render(&Warp::still(), SIZE_PX.0, SIZE_PX.1), 3),
            Pyramid::new(&render(warp, SIZE_PX.0, SIZE_PX.1), 3),
        );
        let points = grid_points();
        let ends = follow(&a, &b, &points, options);
        let error = |(p, e): (&[f32; 2], &Option<[f32; 2]>)| {
            e.map(|e| (e[0] - warp.apply(*p)[0]).hypot(e[1] - warp.apply(*p)[1]))
        };
        points.iter().zip(&ends).filter_map(error).collect()
    }

    #[test]
    fn known_warps_are_met_to_a_twentieth_of_a_pixel() {
        let nine = FlowOptions { window_px: 9, ..FlowOptions::default() };
        for options in [FlowOptions::default(), nine] {
            for warp in [
                Warp::shift(0.37, -0.81),
                Warp::shift(5.3, 3.9),
                Warp::about_centre([1.01, 0.005, -0.004, 0.99], [1.2, -0.7]),
                Warp::about_centre([0.99985, -0.01745, 0.01745, 0.99985], [0.4, 2.3]),
            ] {
                let e = errors(&warp, &options);
                assert!(e.len() >= 60, "{warp:?}: {} of 63 followed", e.len());
                assert!(median(&e) < 0.05, "{warp:?}: {}", median(&e));
            }
        }
    }

    #[test]
    fn unrelated_pictures_are_refused() {
        let a = Pyramid::new(&render(&Warp::still(), SIZE_PX.0, SIZE_PX.1), 3);
        let b = Pyramid::new(&render(&Warp::shift(5000.0, 700.0), SIZE_PX.0, SIZE_PX.1), 3);
        let ends = follow(&a, &b, &grid_points(), &FlowOptions::default());
        let followed = ends.iter().flatten().count();
        // The texture is smooth: a few windows do find their like.
        assert!(followed <= 6, "{followed} of 63");
    }

    #[test]
    fn flat_tiny_and_empty_pictures_give_nothing() {
        for (w, h) in [(0, 0), (1, 1), (40, 30)] {
            let p = Pyramid::new(&crate::motion::FloatPicture::new(w, h, vec![0.0; (w * h) as usize]), 3);
            let ends = follow(&p, &p, &[[20.0, 15.0], [0.0, 0.0], [-9e9, f32::NAN]], &FlowOptions::default());
            assert!(ends.iter().all(Option::is_none));
        }
    }

    #[test]
    fn correlation_is_one_with_itself_and_minus_one_with_the_negative() {
        let picture = render(&Warp::still(), 60, 50);
        let mut negative = picture.clone();
        negative.pixels.iter_mut().for_each(|v| *v = 0.3 - 2.0 * *v);
        let (a, b) = (Pyramid::new(&picture, 1), Pyramid::new(&negative, 1));
        let at = [30.3, 24.8];
        assert!((zncc(a.finest(), at, a.finest(), at, 15) - 1.0).abs() < 1e-4);
        assert!((zncc(a.finest(), at, b.finest(), at, 15) + 1.0).abs() < 1e-3);
        assert_eq!(zncc(a.finest(), at, b.finest(), [-1.0, 3.0], 15), 0.0);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn shifts_are_found(angle_rad in 0.0_f32..6.3, length_px in 0.0_f32..7.0) {
            let e = errors(&Warp::shift(length_px * angle_rad.cos(), length_px * angle_rad.sin()), &FlowOptions::default());
            prop_assert!(e.len() >= 58 && median(&e) < 0.05, "{} {}", e.len(), median(&e));
        }
    }
}
