//! Exact integer division by one divisor many times: a floating-point estimate, set right by its remainder.

/// Estimates below this are off by less than a half.
const MAX_ESTIMATE: f64 = (1_u64 << 50) as f64;

/// A divisor and its inverse.
#[derive(Debug, Clone, Copy)]
pub struct Reciprocal {
    divisor: i64,
    inverse: f64,
}

impl Reciprocal {
    /// # Panics
    /// When `divisor` is not positive.
    pub fn new(divisor: i64) -> Self {
        assert!(divisor > 0, "a positive divisor");
        Self { divisor, inverse: 1.0 / divisor as f64 }
    }

    /// Quotient and remainder of magnitudes, for estimates below [`MAX_ESTIMATE`].
    fn divide(self, magnitude: i64, estimate: f64) -> (i64, i64) {
        let quotient = estimate as i64;
        // The product may exceed 63 bits, the remainder does not.
        let rest = magnitude.wrapping_sub(quotient.wrapping_mul(self.divisor));
        let step = i64::from(rest >= self.divisor) - i64::from(rest < 0);
        (quotient + step, rest - step * self.divisor)
    }

    /// `n / divisor` rounded towards zero.
    pub fn truncated(self, n: i64) -> i64 {
        let magnitude = n.unsigned_abs() as i64;
        let estimate = magnitude as f64 * self.inverse;
        if !(0.0..MAX_ESTIMATE).contains(&estimate) {
            return n / self.divisor;
        }
        let (quotient, _) = self.divide(magnitude, estimate);
        if n < 0 { -quotient } else { quotient }
    }

    /// `n / divisor` rounded down.
    pub fn floor(self, n: i64) -> i64 {
        let magnitude = n.unsigned_abs() as i64;
        let estimate = magnitude as f64 * self.inverse;
        if !(0.0..MAX_ESTIMATE).contains(&estimate) {
            return n.div_euclid(self.divisor);
        }
        let (quotient, rest) = self.divide(magnitude, estimate);
        if n < 0 { -quotient - i64::from(rest > 0) } else { quotient }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_size() -> impl Strategy<Value = i64> {
        (any::<i64>(), 0..64_u32).prop_map(|(v, shift)| v >> shift)
    }

    proptest! {
        #[test]
        fn quotients_are_those_of_integer_division(n in any_size(), d in any_size(), k in -1_i64..=1) {
            let d = d.unsigned_abs().clamp(1, i64::MAX as u64) as i64;
            let by = Reciprocal::new(d);
            // Also next to multiples, where an estimate falls on the wrong side.
            for n in [n, (n / d * d).saturating_add(k)] {
                prop_assert_eq!(by.truncated(n), n / d);
                prop_assert_eq!(by.floor(n), n.div_euclid(d));
            }
        }
    }

    #[test]
    fn the_ends_of_the_range_are_exact() {
        for n in [i64::MIN, i64::MIN + 1, -1, 0, 1, i64::MAX] {
            for d in [1, 2, 3, 1 << 31, i64::MAX] {
                assert_eq!((Reciprocal::new(d).truncated(n), Reciprocal::new(d).floor(n)), (n / d, n.div_euclid(d)));
            }
        }
    }
}
