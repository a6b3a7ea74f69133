//! Natural logarithm for warp kernels, which take it once a landmark and vertex: no call into libm.

use std::f64::consts::LN_2;

/// Natural logarithm of a normal positive number, relative error below 1e-9: exponent, then the odd series of
/// 2 atanh((m-1)/(m+1)) on m in [sqrt(1/2), sqrt(2)). Exactly 0 at 1.
#[inline]
pub(super) fn ln(x: f64) -> f64 {
    const SQRT_HALF_BITS: u64 = 0x3FE6_A09E_667F_3BCD;
    let bits = x.to_bits();
    let exponent = ((bits.wrapping_sub(SQRT_HALF_BITS)) as i64) >> 52;
    let mantissa = f64::from_bits(bits.wrapping_sub((exponent as u64) << 52));
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let t = s * s;
    let series = 1.0 + t * (1.0 / 3.0 + t * (0.2 + t * (1.0 / 7.0 + t * (1.0 / 9.0 + t * (1.0 / 11.0)))));
    exponent as f64 * LN_2 + 2.0 * s * series
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
