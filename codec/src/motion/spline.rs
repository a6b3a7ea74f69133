//! Natural cubic spline in time, as weights on the knot values.
//!
//! A spline is linear in its knot values, so one row of weights serves every vertex and channel.

/// Natural cubic spline through knots at increasing times (second derivative zero at both ends; straight with two
/// knots, constant with one).
#[derive(Debug, Clone)]
pub struct NaturalSpline {
    knots: Vec<f64>,
    /// `second[j][i]`: second derivative at knot `j` per unit of value at knot `i`.
    second: Vec<Vec<f64>>,
}

impl NaturalSpline {
    /// A spline over `knots`.
    ///
    /// # Panics
    /// When `knots` is empty or not strictly increasing.
    pub fn new(knots: &[f64]) -> Self {
        assert!(!knots.is_empty(), "a spline needs a knot");
        assert!(knots.windows(2).all(|w| w[0] < w[1]), "knots must increase");
        let n = knots.len();
        let mut second = vec![vec![0.0; n]; n];
        for i in 0..n {
            let column = unit_second_derivatives(knots, i);
            for (row, m) in second.iter_mut().zip(column) {
                row[i] = m;
            }
        }
        Self { knots: knots.to_vec(), second }
    }

    /// Weight of each knot value at time `t`; outside the knots the end values are held.
    pub fn weights(&self, t: f64) -> Vec<f64> {
        let n = self.knots.len();
        let t = t.clamp(self.knots[0], self.knots[n - 1]);
        let j = self.knots.partition_point(|&k| k <= t).clamp(1, n.max(2) - 1) - 1;
        let mut w = vec![0.0; n];
        if n == 1 {
            w[0] = 1.0;
            return w;
        }
        let h = self.knots[j + 1] - self.knots[j];
        let (a, b) = ((self.knots[j + 1] - t) / h, (t - self.knots[j]) / h);
        let (ca, cb) = ((a * a * a - a) * h * h / 6.0, (b * b * b - b) * h * h / 6.0);
        for (i, w) in w.iter_mut().enumerate() {
            *w = ca * self.second[j][i] + cb * self.second[j + 1][i];
        }
        w[j] += a;
        w[j + 1] += b;
        w
    }
}

/// Second derivatives at all knots of the spline that is 1 at knot `i` and 0 at the others (Thomas algorithm).
fn unit_second_derivatives(x: &[f64], i: usize) -> Vec<f64> {
    let n = x.len();
    let y = |k: usize| if k == i { 1.0 } else { 0.0 };
    let mut m = vec![0.0; n];
    let mut upper = vec![0.0; n];
    for k in 1..n.saturating_sub(1) {
        let (h0, h1) = (x[k] - x[k - 1], x[k + 1] - x[k]);
        let rhs = 6.0 * ((y(k + 1) - y(k)) / h1 - (y(k) - y(k - 1)) / h0);
        let pivot = 2.0 * (h0 + h1) - h0 * upper[k - 1];
        upper[k] = h1 / pivot;
        m[k] = (rhs - h0 * m[k - 1]) / pivot;
    }
    for k in (1..n.saturating_sub(1)).rev() {
        m[k] -= upper[k] * m[k + 1];
    }
    m
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn value(s: &NaturalSpline, y: &[f64], t: f64) -> f64 {
        s.weights(t).iter().zip(y).map(|(w, y)| w * y).sum()
    }

    #[test]
    fn known_weights() {
        let check = |knots: &[f64], t: f64, want: &[f64]| {
            for (w, v) in NaturalSpline::new(knots).weights(t).iter().zip(want) {
                assert!((w - v).abs() < 1e-12, "{knots:?} {t}: {w} {v}");
            }
        };
        check(&[-10.0, 0.0, 10.0], 5.0, &[-3.0 / 32.0, 22.0 / 32.0, 13.0 / 32.0]);
        check(&[-10.0, 0.0, 10.0, 20.0], 5.0, &[-3.0 / 40.0, 23.0 / 40.0, 23.0 / 40.0, -3.0 / 40.0]);
        check(&[0.0, 5.0, 10.0], 7.0, &[-12.0 / 125.0, 99.0 / 125.0, 38.0 / 125.0]);
        check(&[-5.0, 0.0, 5.0, 10.0], 2.0, &[-10.0 / 125.0, 87.0 / 125.0, 56.0 / 125.0, -8.0 / 125.0]);
    }

    proptest! {
        #[test]
        fn interpolates_reproduces_lines_and_is_c2(
            steps in prop::collection::vec(0.2..3.0f64, 1..8), y in prop::collection::vec(-5.0..5.0f64, 9), t in 0.0..1.0f64,
        ) {
            let mut knots = vec![0.0];
            for s in steps { knots.push(knots[knots.len() - 1] + s); }
            let s = NaturalSpline::new(&knots);
            let end = knots[knots.len() - 1];
            prop_assert!((s.weights(t * end).iter().sum::<f64>() - 1.0).abs() < 1e-9);
            prop_assert!((value(&s, &knots, t * end) - t * end).abs() < 1e-9);
            for (k, &x) in knots.iter().enumerate() {
                prop_assert!((value(&s, &y[..knots.len()], x) - y[k]).abs() < 1e-9);
            }
            for w in knots.windows(3) {
                // First and second differences agree on both sides of an inner knot.
                let (e, f) = (1e-3, |u: f64| value(&s, &y[..knots.len()], u));
                let x = w[1];
                let left = (3.0 * f(x) - 4.0 * f(x - e) + f(x - 2.0 * e)) / (2.0 * e);
                let right = (-3.0 * f(x) + 4.0 * f(x + e) - f(x + 2.0 * e)) / (2.0 * e);
                prop_assert!((left - right).abs() < 1e-2 * (1.0 + left.abs()), "{left} {right}");
            }
        }
    }

    #[test]
    fn one_and_two_knots_and_times_outside() {
        assert_eq!(NaturalSpline::new(&[3.0]).weights(7.0), vec![1.0]);
        let two = NaturalSpline::new(&[0.0, 2.0]);
        assert_eq!(two.weights(0.5), vec![0.75, 0.25]);
        assert_eq!(two.weights(-1.0), vec![1.0, 0.0]);
        assert_eq!(two.weights(9.0), vec![0.0, 1.0]);
    }
}
