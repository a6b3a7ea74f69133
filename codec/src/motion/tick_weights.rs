//! Exact weights of the natural cubic spline at integer ticks: what every decoder on every machine predicts from.

use crate::{CodecError, Result};

/// Most knots; predictions in a group use no more, and intermediate fractions stay small.
pub const MOST_KNOTS: usize = 4;

/// Weights `numerators[i] / denominator` of the values at the knots, in lowest terms; they sum to one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TickWeights {
    /// One a knot.
    pub numerators: Vec<i64>,
    /// Greater than 0.
    pub denominator: i64,
}

impl TickWeights {
    /// Weights at tick `at` of the natural cubic spline through `knots` (increasing, any gaps); outside the knots the end
    /// values are held.
    ///
    /// # Errors
    /// [`CodecError::Stream`] without knots or with more than [`MOST_KNOTS`], when they do not increase, or when the gaps
    /// are so large that the weights do not fit 64 bits.
    pub fn new(knots: &[i64], at: i64) -> Result<Self> {
        if knots.is_empty() || knots.len() > MOST_KNOTS || knots.windows(2).any(|w| w[0] >= w[1]) {
            return Err(CodecError::Stream(format!("1 to {MOST_KNOTS} increasing ticks wanted, got {knots:?}")));
        }
        let weights = weights(knots, at).and_then(|w| Self::common(&w));
        weights.ok_or_else(|| CodecError::Stream(format!("ticks {knots:?} lie too far apart for exact weights")))
    }

    /// Weighted sum of the values at the knots, rounded to the nearest integer, halves up; exact while the values and the
    /// numerators stay below 2^62 in magnitude.
    pub fn predict(&self, values: impl IntoIterator<Item = i64>) -> i64 {
        let sum: i128 = self.numerators.iter().zip(values).map(|(&w, v)| i128::from(w) * i128::from(v)).sum();
        let denominator = i128::from(self.denominator);
        ((2 * sum + denominator).div_euclid(2 * denominator)) as i64
    }

    fn common(weights: &[Ratio]) -> Option<Self> {
        let denominator =
            weights.iter().try_fold(1i128, |d, w| (d / gcd(d, w.denominator)).checked_mul(w.denominator))?;
        let numerators: Option<Vec<i64>> =
            weights.iter().map(|w| i64::try_from(w.numerator.checked_mul(denominator / w.denominator)?).ok()).collect();
        Some(Self { numerators: numerators?, denominator: i64::try_from(denominator).ok()? })
    }
}

/// Each unit spline by itself: second derivatives by the Thomas algorithm, then the cubic of the segment.
fn weights(knots: &[i64], at: i64) -> Option<Vec<Ratio>> {
    let n = knots.len();
    let at = at.clamp(knots[0], knots[n - 1]);
    if n == 1 {
        return Some(vec![Ratio::from(1)]);
    }
    let steps: Vec<Ratio> =
        knots.windows(2).map(|w| Some(Ratio::from(w[1].checked_sub(w[0])?))).collect::<Option<_>>()?;
    let j = knots.partition_point(|&k| k <= at).clamp(1, n - 1) - 1;
    let h = steps[j];
    let a = Ratio::from(knots[j + 1].checked_sub(at)?).over(h)?;
    let b = Ratio::from(at.checked_sub(knots[j])?).over(h)?;
    let sixth = h.times(h)?.over(Ratio::from(6))?;
    let cubic = |x: Ratio| x.times(x)?.times(x)?.minus(x)?.times(sixth);
    (0..n)
        .map(|i| {
            let second = second_derivatives(&steps, i)?;
            let bent = cubic(a)?.times(second[j])?.plus(cubic(b)?.times(second[j + 1])?)?;
            match i {
                i if i == j => bent.plus(a),
                i if i == j + 1 => bent.plus(b),
                _ => Some(bent),
            }
        })
        .collect()
}

/// Second derivatives at all knots of the spline that is 1 at knot `i` and 0 at the others.
fn second_derivatives(steps: &[Ratio], i: usize) -> Option<Vec<Ratio>> {
    let n = steps.len() + 1;
    let value = |k: usize| Ratio::from(i64::from(k == i));
    let (mut m, mut upper) = (vec![Ratio::from(0); n], vec![Ratio::from(0); n]);
    for k in 1..n - 1 {
        let (h0, h1) = (steps[k - 1], steps[k]);
        let slope = |k: usize, h: Ratio| value(k + 1).minus(value(k))?.over(h);
        let bend = slope(k, h1)?.minus(slope(k - 1, h0)?)?.times(Ratio::from(6))?;
        let pivot = h0.plus(h1)?.times(Ratio::from(2))?.minus(h0.times(upper[k - 1])?)?;
        upper[k] = h1.over(pivot)?;
        m[k] = bend.minus(h0.times(m[k - 1])?)?.over(pivot)?;
    }
    for k in (1..n - 1).rev() {
        m[k] = m[k].minus(upper[k].times(m[k + 1])?)?;
    }
    Some(m)
}

/// A fraction in lowest terms, denominator above 0; arithmetic is `None` on overflow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Ratio {
    numerator: i128,
    denominator: i128,
}

impl From<i64> for Ratio {
    fn from(numerator: i64) -> Self {
        Self { numerator: i128::from(numerator), denominator: 1 }
    }
}

impl Ratio {
    fn new(numerator: i128, denominator: i128) -> Option<Self> {
        let divisor = gcd(numerator, denominator);
        let sign = denominator.signum();
        (divisor > 0).then(|| Self { numerator: numerator / divisor * sign, denominator: denominator / divisor * sign })
    }

    fn plus(self, other: Self) -> Option<Self> {
        let numerator = self.numerator.checked_mul(other.denominator)?;
        let numerator = numerator.checked_add(other.numerator.checked_mul(self.denominator)?)?;
        Self::new(numerator, self.denominator.checked_mul(other.denominator)?)
    }

    fn minus(self, other: Self) -> Option<Self> {
        self.plus(Self { numerator: -other.numerator, ..other })
    }

    fn times(self, other: Self) -> Option<Self> {
        Self::new(self.numerator.checked_mul(other.numerator)?, self.denominator.checked_mul(other.denominator)?)
    }

    /// The divisor is never zero here: steps and pivots are positive.
    fn over(self, other: Self) -> Option<Self> {
        Self::new(self.numerator.checked_mul(other.denominator)?, self.denominator.checked_mul(other.numerator)?)
    }
}

/// Greatest common divisor, not negative.
fn gcd(a: i128, b: i128) -> i128 {
    let (mut a, mut b) = (a.unsigned_abs(), b.unsigned_abs());
    while b != 0 {
        (a, b) = (b, a % b);
    }
    i128::try_from(a).unwrap_or(1)
}

#[cfg(test)]
mod tests {
    use super::super::spline::NaturalSpline;
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn published_check_values() {
        let check = |knots: &[i64], at: i64, numerators: &[i64], denominator: i64| {
            let weights = TickWeights::new(knots, at).unwrap();
            assert_eq!(
                (weights.numerators.as_slice(), weights.denominator),
                (numerators, denominator),
                "{knots:?} {at}"
            );
        };
        check(&[-10, 0, 10], 5, &[-3, 22, 13], 32);
        check(&[-10, 0, 10, 20], 5, &[-3, 23, 23, -3], 40);
        check(&[0, 5, 10], 7, &[-12, 99, 38], 125);
        check(&[-5, 0, 5, 10], 2, &[-10, 87, 56, -8], 125);
        check(&[7], 3, &[1], 1);
        check(&[0, 4], 1, &[3, 1], 4);
        check(&[0, 4], 9, &[0, 1], 1);
    }

    #[test]
    fn predictions_round_halves_up_on_both_sides_of_zero() {
        let half = TickWeights::new(&[0, 2], 1).unwrap();
        assert_eq!([half.predict([0, 1]), half.predict([0, -1]), half.predict([-1, -2])], [1, 0, -1]);
        let bent = TickWeights::new(&[-10, 0, 10], 5).unwrap();
        assert_eq!(bent.predict([32, 32, 32]), 32);
        assert_eq!(bent.predict([100, -200, 300]), -25);
    }

    #[test]
    fn bad_knots_and_huge_gaps_are_errors() {
        for knots in [&[][..], &[1, 1], &[3, 2], &[0, 1, 2, 3, 4], &[i64::MIN, i64::MAX, i64::MAX - 1]] {
            assert!(TickWeights::new(knots, 0).is_err());
        }
        let far = TickWeights::new(&[i64::MIN, 0, 1, i64::MAX], 1 << 40).unwrap_err().to_string();
        assert!(far.contains("far apart"), "{far}");
    }

    proptest! {
        #[test]
        fn exact_weights_equal_the_floating_ones_and_sum_to_one(
            start in -1000i64..1000, gaps in prop::collection::vec(1i64..200, 0..3), share in -0.2..1.2f64,
        ) {
            let mut knots = vec![start];
            for g in gaps { knots.push(knots[knots.len() - 1] + g); }
            let span = knots[knots.len() - 1] - start;
            let at = start + (share * span as f64) as i64;
            let exact = TickWeights::new(&knots, at).unwrap();
            prop_assert_eq!(exact.numerators.iter().sum::<i64>(), exact.denominator);
            let divisor = exact.numerators.iter().fold(exact.denominator, |d, &n| gcd(d.into(), n.into()) as i64);
            prop_assert_eq!(divisor, 1);
            let knots: Vec<f64> = knots.iter().map(|&k| k as f64).collect();
            for (n, w) in exact.numerators.iter().zip(NaturalSpline::new(&knots).weights(at as f64)) {
                prop_assert!((*n as f64 / exact.denominator as f64 - w).abs() < 1e-9);
            }
            // Straight lines come back exactly.
            prop_assert_eq!(exact.predict(knots.iter().map(|&k| 7 * k as i64)), 7 * at.clamp(start, start + span));
        }
    }
}
