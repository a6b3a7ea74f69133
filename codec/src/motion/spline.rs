//! Natural cubic spline in time, as weights on the knot values.
//!
//! A spline is linear in its knot values, so one row of weights serves every vertex and channel ([`NaturalSpline`], few
//! knots); a whole run is solved for all channels at once ([`ChannelSplines`]).

use crate::{CodecError, Result};

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
        // The channels of the identity: one unit knot each.
        let units: Vec<f64> = (0..n * n).map(|i| if i / n == i % n { 1.0 } else { 0.0 }).collect();
        let second = Tridiagonal::new(knots).second_derivatives(&units, n);
        Self { knots: knots.to_vec(), second: second.chunks_exact(n).map(<[f64]>::to_vec).collect() }
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
        let [a, b, ca, cb] = segment_weights(self.knots[j], self.knots[j + 1], t);
        for (i, w) in w.iter_mut().enumerate() {
            *w = ca * self.second[j][i] + cb * self.second[j + 1][i];
        }
        w[j] += a;
        w[j + 1] += b;
        w
    }
}

/// The tridiagonal system of the second derivatives m_k at the inner knots,
/// h_{k-1} m_{k-1} + 2 (h_{k-1} + h_k) m_k + h_k m_{k+1} = 6 ((y_{k+1} - y_k)/h_k - (y_k - y_{k-1})/h_{k-1}), m = 0 at
/// both ends, eliminated once (Thomas algorithm; diagonally dominant, so no pivoting).
#[derive(Debug, Clone)]
struct Tridiagonal {
    /// h_k between knots k and k + 1.
    steps: Vec<f64>,
    /// 1 / pivot of each knot; unused at the ends.
    inverse_pivot: Vec<f64>,
}

impl Tridiagonal {
    fn new(knots: &[f64]) -> Self {
        let steps: Vec<f64> = knots.windows(2).map(|w| w[1] - w[0]).collect();
        let mut inverse_pivot = vec![0.0; knots.len()];
        for k in 1..steps.len() {
            let eliminated = if k > 1 { steps[k - 1] * steps[k - 1] * inverse_pivot[k - 1] } else { 0.0 };
            inverse_pivot[k] = 1.0 / (2.0 * (steps[k - 1] + steps[k]) - eliminated);
        }
        Self { steps, inverse_pivot }
    }

    /// Second derivatives of `channels` splines at once; `values` and the result hold the channels of knot 0, then those of
    /// knot 1, and so on.
    fn second_derivatives<T>(&self, values: &[T], channels: usize) -> Vec<T>
    where
        T: Copy + Default + Into<f64> + FromF64,
    {
        let mut m = vec![T::default(); values.len()];
        let row = |k: usize| k * channels..(k + 1) * channels;
        for k in 1..self.steps.len() {
            let (h0, h1, inverse) = (self.steps[k - 1], self.steps[k], self.inverse_pivot[k]);
            let (before, here) = m[row(k - 1).start..row(k).end].split_at_mut(channels);
            let ys = values[row(k - 1)].iter().zip(&values[row(k)]).zip(&values[row(k + 1)]);
            for ((m, m0), ((y0, y), y1)) in here.iter_mut().zip(before).zip(ys) {
                let (y0, y, y1): (f64, f64, f64) = ((*y0).into(), (*y).into(), (*y1).into());
                let bend = 6.0 * ((y1 - y) / h1 - (y - y0) / h0);
                *m = T::from_f64((bend - h0 * (*m0).into()) * inverse);
            }
        }
        for k in (1..self.steps.len().saturating_sub(1)).rev() {
            let upper = self.steps[k] * self.inverse_pivot[k];
            let (here, after) = m[row(k).start..row(k + 1).end].split_at_mut(channels);
            for (m, m1) in here.iter_mut().zip(after) {
                *m = T::from_f64((*m).into() - upper * (*m1).into());
            }
        }
        m
    }
}

/// Back from the accumulation type.
trait FromF64 {
    fn from_f64(x: f64) -> Self;
}

impl FromF64 for f64 {
    fn from_f64(x: f64) -> Self {
        x
    }
}

impl FromF64 for f32 {
    fn from_f64(x: f64) -> Self {
        x as f32
    }
}

/// Natural cubic splines of many channels through the same knots: a whole run of vertex positions, solved in one
/// sweep, O(knots x channels).
#[derive(Debug, Clone)]
pub struct ChannelSplines {
    knots: Vec<f64>,
    channels: usize,
    /// Channels of knot 0, of knot 1, ...
    values: Vec<f32>,
    second: Vec<f32>,
}

impl ChannelSplines {
    /// Splines through `values`: the channels at knot 0, then those at knot 1, and so on.
    ///
    /// # Errors
    /// [`CodecError::Stream`] without knots, when they do not increase, or when `values` are not `channels` a knot.
    pub fn new(knots: &[f64], values: Vec<f32>, channels: usize) -> Result<Self> {
        if knots.is_empty() || !knots.windows(2).all(|w| w[0] < w[1]) {
            return Err(CodecError::Stream("a spline needs knots whose times increase".into()));
        }
        if values.len() != knots.len() * channels {
            return Err(CodecError::Stream(format!(
                "{} values for {} knots of {channels} channels",
                values.len(),
                knots.len()
            )));
        }
        let second = Tridiagonal::new(knots).second_derivatives(&values, channels);
        Ok(Self { knots: knots.to_vec(), channels, values, second })
    }

    /// Channels a knot.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// All channels at time `t`; before the first and after the last knot they run on straight, as a natural spline does
    /// (clamp `t` to hold the ends).
    ///
    /// # Panics
    /// When `out` has not one entry a channel.
    pub fn sample(&self, t: f64, out: &mut [f32]) {
        assert_eq!(out.len(), self.channels, "one entry a channel");
        let n = self.knots.len();
        if n == 1 {
            out.copy_from_slice(&self.values);
            return;
        }
        let j = self.knots.partition_point(|&k| k <= t).clamp(1, n - 1) - 1;
        let [a, b, ca, cb] = segment_weights(self.knots[j], self.knots[j + 1], t).map(|w| w as f32);
        let (here, there) = (j * self.channels, (j + 1) * self.channels);
        let values = self.values[here..].iter().zip(&self.values[there..]);
        let second = self.second[here..].iter().zip(&self.second[there..]);
        for (out, ((y0, y1), (m0, m1))) in out.iter_mut().zip(values.zip(second)) {
            *out = a * y0 + b * y1 + ca * m0 + cb * m1;
        }
    }
}

/// Weights of the values at both knots of a segment and of the second derivatives there; outside the segment those of the
/// straight line that meets it in value and slope (right at the ends of a natural spline).
fn segment_weights(from: f64, to: f64, t: f64) -> [f64; 4] {
    let h = to - from;
    let (a, b) = ((to - t) / h, (t - from) / h);
    let cubic = h * h / 6.0;
    if b > 1.0 {
        // d/db of (b^3 - b) is 2 at 1, of (a^3 - a) it is 1.
        return [a, b, cubic * (b - 1.0), cubic * 2.0 * (b - 1.0)];
    }
    if b < 0.0 {
        return [a, b, cubic * 2.0 * (a - 1.0), cubic * (a - 1.0)];
    }
    [a, b, cubic * (a * a * a - a), cubic * (b * b * b - b)]
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

    proptest! {
        #[test]
        fn a_whole_run_equals_its_weights(
            steps in prop::collection::vec(0.2..3.0f64, 1..40), channels in 1usize..5, share in 0.0..1.0f64, seed: u32,
        ) {
            let mut knots = vec![-2.0];
            for s in steps { knots.push(knots[knots.len() - 1] + s); }
            let hash = |i: usize| f64::from((seed ^ i as u32).wrapping_mul(2_654_435_761) >> 16) as f32 / 6553.6 - 5.0;
            let values: Vec<f32> = (0..knots.len() * channels).map(hash).collect();
            let run = ChannelSplines::new(&knots, values.clone(), channels).unwrap();
            let t = -2.0 + share * (knots[knots.len() - 1] + 2.0);
            let mut row = vec![0.0; channels];
            run.sample(t, &mut row);
            let weights = NaturalSpline::new(&knots).weights(t);
            for (c, found) in row.iter().enumerate() {
                let want: f64 = weights.iter().enumerate().map(|(k, w)| w * f64::from(values[k * channels + c])).sum();
                prop_assert!((f64::from(*found) - want).abs() < 2e-4, "{found} {want}");
            }
        }
    }

    #[test]
    fn a_run_goes_on_straight_beyond_its_ends() {
        let run = ChannelSplines::new(&[0.0, 1.0, 3.0, 4.0], vec![0.0, 2.0, -1.0, 5.0], 1).unwrap();
        let at = |t: f64| {
            let mut out = [0.0];
            run.sample(t, &mut out);
            f64::from(out[0])
        };
        for (end, out) in [(4.0, 1.0), (0.0, -1.0)] {
            let slope = (at(end) - at(end - 1e-2 * out)) / 1e-2;
            assert!((at(end + out) - at(end) - slope).abs() < 2e-2, "slope {slope}, step {}", at(end + out) - at(end));
            assert!((at(end + 2.0 * out) - 2.0 * at(end + out) + at(end)).abs() < 1e-4);
        }
    }

    #[test]
    fn runs_that_do_not_fit_are_errors() {
        assert!(ChannelSplines::new(&[], vec![], 3).is_err());
        assert!(ChannelSplines::new(&[0.0, 0.0], vec![0.0; 2], 1).is_err());
        assert!(ChannelSplines::new(&[0.0, f64::NAN], vec![0.0; 2], 1).is_err());
        assert!(ChannelSplines::new(&[0.0, 1.0], vec![0.0; 3], 1).is_err());
        let one = ChannelSplines::new(&[5.0], vec![7.0, 8.0], 2).unwrap();
        let mut row = [0.0; 2];
        one.sample(-3.0, &mut row);
        assert_eq!(row, [7.0, 8.0]);
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
