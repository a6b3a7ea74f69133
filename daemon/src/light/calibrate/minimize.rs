//! Levenberg-Marquardt over shared parameters and poses.
//!
//! A view's corners depend on its own pose and on the shared parameters only, so the normal equations are block arrow:
//! the poses are eliminated by the Schur complement (B. Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000,
//! section 6.1) and what is left is as small as the number of shared parameters, however many views there are. Damping
//! as in K. Madsen, H. Nielsen, O. Tingleff, "Methods for non-linear least squares problems", 2004, algorithm 3.16,
//! with Marquardt's scaling by the diagonal, as parameters come in pixels, radians and millimetres.

use super::bundle::{Block, Bundle, POSE, SHARED};
use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, Side};

/// Steps tried at most.
const MAX_STEPS: usize = 200;
/// For a minimum: a step that promises to lower the sum of squares by less than this share is the last one.
pub(super) const EXACT: f64 = 1e-10;
/// The same for a place to start from.
pub(super) const COARSE: f64 = 1e-5;

/// Normal equations: u w; w' v with the right-hand sides, of the free shared parameters and of every view's pose.
pub(super) struct NormalEquations {
    pub u: Mat<f64>,
    pub u_side: Mat<f64>,
    pub views: Vec<ViewEquations>,
}

/// The part of a view.
pub(super) struct ViewEquations {
    pub v: Mat<f64>,
    /// Pose by shared.
    pub w: Mat<f64>,
    pub side: Mat<f64>,
}

impl NormalEquations {
    /// Of a bundle where it is.
    pub fn of(bundle: &Bundle) -> Self {
        let free = &bundle.free;
        let mut total = Sums::default();
        let mut views = Vec::with_capacity(bundle.views.len());
        for view in &bundle.views {
            let mut part = Sums::default();
            for corner in &view.corners {
                part.add(&bundle.whitened_block(view, corner));
            }
            views.push(ViewEquations {
                v: Mat::from_fn(POSE, POSE, |i, j| part.v[i.min(j)][i.max(j)]),
                w: Mat::from_fn(POSE, free.len(), |i, j| part.w[i][free[j]]),
                side: Mat::from_fn(POSE, 1, |i, _| part.v_side[i]),
            });
            for i in 0..SHARED {
                total.u_side[i] += part.u_side[i];
                total.u[i].iter_mut().zip(&part.u[i]).for_each(|(sum, more)| *sum += more);
            }
        }
        Self {
            u: Mat::from_fn(free.len(), free.len(), |i, j| total.u[free[i.min(j)]][free[i.max(j)]]),
            u_side: Mat::from_fn(free.len(), 1, |i, _| total.u_side[free[i]]),
            views,
        }
    }

    /// The equations with every diagonal entry times `1 + damping`, poses eliminated; `None` when not positive definite.
    pub fn reduced(&self, damping: f64) -> Option<Reduced> {
        let (mut s, mut side) = (damped(&self.u, damping), self.u_side.clone());
        let mut views = Vec::with_capacity(self.views.len());
        for view in &self.views {
            let v = damped(&view.v, damping).llt(Side::Lower).ok()?;
            s -= view.w.transpose() * v.solve(&view.w);
            side -= view.w.transpose() * v.solve(&view.side);
            views.push(v);
        }
        Some(Reduced { s, side, views })
    }
}

/// Sums of products of derivatives; of the symmetric ones the upper triangle.
struct Sums {
    u: [[f64; SHARED]; SHARED],
    u_side: [f64; SHARED],
    v: [[f64; POSE]; POSE],
    v_side: [f64; POSE],
    w: [[f64; SHARED]; POSE],
}

impl Default for Sums {
    fn default() -> Self {
        Self {
            u: [[0.0; SHARED]; SHARED],
            u_side: [0.0; SHARED],
            v: [[0.0; POSE]; POSE],
            v_side: [0.0; POSE],
            w: [[0.0; SHARED]; POSE],
        }
    }
}

impl Sums {
    fn add(&mut self, block: &Block) {
        for row in 0..block.rows {
            let (shared, pose, error) = (&block.shared[row], &block.pose[row], block.error[row]);
            for i in 0..SHARED {
                let a = shared[i];
                self.u[i][i..].iter_mut().zip(&shared[i..]).for_each(|(sum, b)| *sum += a * b);
                self.u_side[i] += a * error;
            }
            for i in 0..POSE {
                let a = pose[i];
                self.v[i][i..].iter_mut().zip(&pose[i..]).for_each(|(sum, b)| *sum += a * b);
                self.w[i].iter_mut().zip(shared).for_each(|(sum, b)| *sum += a * b);
                self.v_side[i] += a * error;
            }
        }
    }
}

/// Normal equations of the shared parameters alone.
pub(super) struct Reduced {
    pub s: Mat<f64>,
    side: Mat<f64>,
    views: Vec<Llt<f64>>,
}

struct Step {
    shared: Vec<f64>,
    poses: Vec<[f64; POSE]>,
    /// Fall of the cost that the linear model promises.
    promised: f64,
}

impl Reduced {
    fn step(&self, equations: &NormalEquations, damping: f64) -> Option<Step> {
        let n = self.s.nrows();
        let shared = if n == 0 { Mat::zeros(0, 1) } else { self.s.llt(Side::Lower).ok()?.solve(&self.side) };
        // For the damped step h: promised = h' (damping D h + g) / 2.
        let promise = |h: f64, diagonal: f64, side: f64| 0.5 * h * (damping * diagonal * h + side);
        let mut promised: f64 =
            (0..n).map(|i| promise(shared[(i, 0)], equations.u[(i, i)], equations.u_side[(i, 0)])).sum();
        let mut poses = Vec::with_capacity(self.views.len());
        for (view, v) in equations.views.iter().zip(&self.views) {
            let h = v.solve(&view.side - &view.w * &shared);
            promised += (0..POSE).map(|k| promise(h[(k, 0)], view.v[(k, k)], view.side[(k, 0)])).sum::<f64>();
            poses.push(std::array::from_fn(|k| h[(k, 0)]));
        }
        let shared: Vec<f64> = (0..n).map(|i| shared[(i, 0)]).collect();
        let is_finite = promised.is_finite() && shared.iter().all(|x| x.is_finite());
        is_finite.then_some(Step { shared, poses, promised })
    }
}

fn damped(matrix: &Mat<f64>, damping: f64) -> Mat<f64> {
    let mut m = matrix.clone();
    for i in 0..m.nrows() {
        m[(i, i)] *= 1.0 + damping;
    }
    m
}

/// Moves the bundle to the nearest minimum of its cost, to a `tolerance`; returns the steps taken, or `None` when there is no way down from
/// a point that is no minimum, or it is not reached.
pub(super) fn minimize(bundle: &mut Bundle, tolerance: f64) -> Option<usize> {
    let mut cost = bundle.cost();
    if !cost.is_finite() {
        return None;
    }
    let (mut damping, mut growth) = (1e-3, 2.0);
    let mut equations = NormalEquations::of(bundle);
    for steps in 0..MAX_STEPS {
        if let Some(step) = equations.reduced(damping).and_then(|r| r.step(&equations, damping)) {
            if step.promised <= tolerance * cost || cost < 1e-20 {
                return Some(steps);
            }
            let candidate = bundle.moved(&step.shared, &step.poses);
            let lower = candidate.cost();
            if lower < cost {
                let gain = (cost - lower) / step.promised;
                damping = (damping * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)).max(1e-15);
                growth = 2.0;
                *bundle = candidate;
                cost = lower;
                equations = NormalEquations::of(bundle);
                continue;
            }
        }
        damping *= growth;
        growth *= 2.0;
        if damping > 1e20 {
            return None;
        }
    }
    None
}
