//! Counter-based random numbers: a function of seed and position, so that order and threads do not matter.

use std::sync::LazyLock;

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

/// Normal numbers, mean 0, variance 1, by table: the middles of [`Normals::COUNT`] equally probable parts, within 3.7.
pub struct Normals {
    quantiles: [f32; Self::COUNT],
}

impl Normals {
    const BITS: u32 = 12;
    const COUNT: usize = 1 << Self::BITS;

    /// The table, made on first use.
    pub fn table() -> &'static Self {
        static TABLE: LazyLock<Normals> = LazyLock::new(Normals::new);
        &TABLE
    }

    /// Inverts the normal distribution by Newton's method, each part from the one before it, middle to tail.
    fn new() -> Self {
        let half = Self::COUNT / 2;
        let mut upper = vec![0.0f64; half];
        let mut x = 0.0;
        for (k, quantile) in upper.iter_mut().enumerate() {
            let beyond = (half as f64 - k as f64 - 0.5) / Self::COUNT as f64;
            for _ in 0..6 {
                let excess = 0.5 * libm::erfc(x * std::f64::consts::FRAC_1_SQRT_2) - beyond;
                x += excess * (2.0 * std::f64::consts::PI).sqrt() * libm::exp(0.5 * x * x);
            }
            *quantile = x;
        }
        let deviation = (upper.iter().map(|v| v * v).sum::<f64>() / half as f64).sqrt();
        let mut quantiles = [0.0; Self::COUNT];
        for (k, quantile) in upper.iter().enumerate() {
            quantiles[half + k] = (quantile / deviation) as f32;
            quantiles[half - 1 - k] = (-quantile / deviation) as f32;
        }
        Self { quantiles }
    }

    /// The normal number of a counter.
    #[inline]
    pub fn at(&self, counter: u64) -> f32 {
        self.quantiles[(hash(counter) >> (64 - Self::BITS)) as usize]
    }

    /// Fills a row with independent numbers, four a hash, those of `counter` and the numbers after it.
    #[inline]
    pub fn fill(&self, counter: u64, out: &mut [f32]) {
        const MASK: u64 = (1 << Normals::BITS) - 1;
        for (k, four) in out.chunks_mut(4).enumerate() {
            let mut z = hash(counter.wrapping_add(k as u64));
            for v in four {
                *v = self.quantiles[(z & MASK) as usize];
                z >>= 16;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_a_normal() {
        let n = 200_000;
        let mut drawn = vec![0.0; n + 1];
        Normals::table().fill(77, &mut drawn);
        let (mut sum, mut square, mut product, mut fourth) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
        for pair in drawn.windows(2) {
            let (a, b) = (f64::from(pair[0]), f64::from(pair[1]));
            sum += a;
            square += a * a;
            product += a * b;
            fourth += a.powi(4);
        }
        let n = n as f64;
        assert!((sum / n).abs() < 0.01 && (square / n - 1.0).abs() < 0.01 && (product / n).abs() < 0.01);
        assert!((fourth / n - 3.0).abs() < 0.1, "fourth moment {}", fourth / n);
        assert!((0..1000).all(|i| (0.0..1.0).contains(&uniform(i))));
    }

    #[test]
    fn the_table_is_symmetric_and_has_the_normal_quantiles() {
        let q = &Normals::table().quantiles;
        assert!((0..2048).all(|k| q[2048 + k] == -q[2047 - k]) && q.is_sorted());
        // One and two standard deviations: 84.13 % and 97.72 % of all lie below.
        for (below, deviations) in [(0.841_345, 1.0), (0.977_25, 2.0)] {
            let found = q[(below * 4096.0) as usize];
            assert!((found - deviations).abs() < 5e-3, "{found}");
        }
    }
}
