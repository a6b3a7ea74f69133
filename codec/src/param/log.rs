//! Natural logarithm for warp kernels, which take it once a landmark and vertex: no call into libm.

use std::f64::consts::LN_2;

/// Natural logarithm of a normal positive number, relative error below 1e-9.
#[inline(always)]
pub(super) fn ln(x: f64) -> f64 {
    ln_ratio(x, 1.0)
}

/// ln(a / b) of normal positive numbers with a normal quotient: one division and no branch, relative error below 1e-9,
/// exactly 0 for a = b. The difference of the bit patterns gives log2(a / b) to 0.09, so the power of two nearest to that
/// goes apart; the rest is the odd series of 2 atanh((a - b) / (a + b)), |argument| <= 0.201. Every step is one that
/// baseline vector units have: the exponent is held biased, shifted without its sign and made a float by its bits.
#[inline(always)]
pub(super) fn ln_ratio(a: f64, b: f64) -> f64 {
    const BIAS: u64 = 1 << 10;
    const TWO_52: f64 = (1u64 << 52) as f64;
    let biased = a.to_bits().wrapping_sub(b.to_bits()).wrapping_add((BIAS << 52) + (1 << 51)) >> 52;
    let exponent = f64::from_bits(TWO_52.to_bits() | biased) - (TWO_52 + BIAS as f64);
    let a = f64::from_bits(a.to_bits().wrapping_sub(biased << 52).wrapping_add(BIAS << 52));
    let s = (a - b) / (a + b);
    let t = s * s;
    let series = 1.0 + t * (1.0 / 3.0 + t * (0.2 + t * (1.0 / 7.0 + t * (1.0 / 9.0 + t * (1.0 / 11.0)))));
    exponent * LN_2 + 2.0 * s * series
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn logarithm_is_accurate(exponent in -300.0..300.0f64) {
            let x = 10f64.powf(exponent);
            prop_assert!((ln(x) - x.ln()).abs() <= 1e-9 * x.ln().abs());
        }
    }

    #[test]
    fn logarithm_of_one_is_exactly_zero() {
        assert_eq!(ln(1.0), 0.0);
        assert!((ln(1.0 + 1e-12) - 1e-12).abs() < 1e-15);
    }
}
