//! Counter-based random numbers: a function of seed and position, so that order and threads do not matter.

/// A well-mixed 64-bit hash of a counter (finalizer of SplitMix64, Steele, Lea, Flood 2014).
#[inline]
pub fn hash(counter: u64) -> u64 {
    let mut z = counter.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Uniform in 0..1.
pub fn uniform(counter: u64) -> f32 {
    (hash(counter) >> 40) as f32 / (1u32 << 24) as f32
}

/// Nearly normal, mean 0, variance 1, within 3.5: the sum of four uniforms.
#[inline]
pub fn normal(counter: u64) -> f32 {
    let z = hash(counter);
    let sum = (z & 0xFFFF) + ((z >> 16) & 0xFFFF) + ((z >> 32) & 0xFFFF) + (z >> 48);
    // Each term has mean 32767.5 and variance 65536^2 / 12.
    (sum as i32 as f32 - 131_070.0) * (1.0 / 37_837.227)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_a_normal() {
        let n = 200_000u64;
        let (mut sum, mut square, mut product) = (0.0f64, 0.0f64, 0.0f64);
        for i in 0..n {
            let (a, b) = (f64::from(normal(i)), f64::from(normal(i + 1)));
            sum += a;
            square += a * a;
            product += a * b;
        }
        let n = n as f64;
        assert!((sum / n).abs() < 0.01 && (square / n - 1.0).abs() < 0.01 && (product / n).abs() < 0.01);
        assert!((0..1000).all(|i| (0.0..1.0).contains(&uniform(i))));
    }
}
