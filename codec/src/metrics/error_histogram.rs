//! Distribution of distances in bounded memory.

/// Bins in a millimetre: one a micrometre.
const BINS_PER_MM: f64 = 1000.0;
/// Bins a histogram has at most; a distance that rounds to 100 mm or more goes to the overflow.
const MAX_BINS: usize = 100_000;

/// Distances in bins of 1 µm up to 100 mm, with exact count, sum of squares and maximum.
///
/// Holds any number of distances in at most 800 kB; the bins reach no farther than the largest distance.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ErrorHistogram {
    /// Element k counts the distances that round to k µm.
    counts: Vec<u64>,
    count: u64,
    squared_sum_mm2: f64,
    max_mm: f64,
}

/// The usual figures of a distribution of distances, millimetres; zeros when there are none.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct SurfaceErrors {
    /// Root mean square, exact.
    pub rms: f64,
    /// 95th percentile by nearest rank, to 0.5 µm.
    pub p95: f64,
    /// 99th percentile by nearest rank, to 0.5 µm.
    pub p99: f64,
    /// Largest distance, exact.
    pub max: f64,
    /// Number of distances.
    pub count: u64,
}

impl ErrorHistogram {
    /// Counts one distance, finite and not negative, millimetres.
    #[inline]
    pub fn add(&mut self, mm: f64) {
        debug_assert!(mm.is_finite() && mm >= 0.0, "{mm} is no distance");
        let bin = (mm * BINS_PER_MM + 0.5) as usize;
        if bin < MAX_BINS {
            if bin >= self.counts.len() {
                self.counts.resize(bin + 1, 0);
            }
            self.counts[bin] += 1;
        }
        self.count += 1;
        self.squared_sum_mm2 += mm * mm;
        self.max_mm = self.max_mm.max(mm);
    }

    /// Counts everything that `other` counted.
    pub fn merge(&mut self, other: &Self) {
        if self.counts.len() < other.counts.len() {
            self.counts.resize(other.counts.len(), 0);
        }
        for (count, more) in self.counts.iter_mut().zip(&other.counts) {
            *count += more;
        }
        self.count += other.count;
        self.squared_sum_mm2 += other.squared_sum_mm2;
        self.max_mm = self.max_mm.max(other.max_mm);
    }

    /// Number of distances.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Mean of the squared distances, mm²; `None` when there are none.
    pub fn mean_square_mm2(&self) -> Option<f64> {
        (self.count > 0).then(|| self.squared_sum_mm2 / self.count as f64)
    }

    /// Smallest distance that `percent` (0..=100) of all distances do not exceed (nearest rank), to 0.5 µm; the
    /// maximum when it lies above 100 mm, 0 when there are no distances.
    pub fn percentile_mm(&self, percent: u64) -> f64 {
        let rank = (self.count * percent).div_ceil(100).max(1);
        let mut below = 0;
        let bin = self.counts.iter().position(|&n| {
            below += n;
            below >= rank
        });
        bin.map_or(self.max_mm, |bin| (bin as f64 / BINS_PER_MM).min(self.max_mm))
    }

    /// Root mean square, percentiles and maximum.
    pub fn summary(&self) -> SurfaceErrors {
        SurfaceErrors {
            rms: self.mean_square_mm2().unwrap_or(0.0).sqrt(),
            p95: self.percentile_mm(95),
            p99: self.percentile_mm(99),
            max: self.max_mm,
            count: self.count,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn histogram(distances_mm: &[f64]) -> ErrorHistogram {
        let mut h = ErrorHistogram::default();
        distances_mm.iter().for_each(|&d| h.add(d));
        h
    }

    #[test]
    fn nothing_sums_up_to_zeros() {
        assert_eq!(ErrorHistogram::default().summary(), SurfaceErrors::default());
        assert_eq!(ErrorHistogram::default().mean_square_mm2(), None);
    }

    #[test]
    fn distances_beyond_the_bins_keep_count_squares_and_maximum() {
        let s = histogram(&[0.5, 99.9994, 100.0, 1234.5]).summary();
        assert_eq!((s.p95, s.max, s.count), (1234.5, 1234.5, 4));
        let h = histogram(&[0.5, 99.9994, 100.0, 1234.5]);
        assert_eq!(h.percentile_mm(25), 0.5);
        assert_eq!(h.percentile_mm(50), 99.999);
        assert_eq!(h.counts.len(), MAX_BINS);
        let mean = (0.25 + 99.9994f64.powi(2) + 1e4 + 1234.5f64.powi(2)) / 4.0;
        assert!((h.mean_square_mm2().unwrap() - mean).abs() < 1e-6);
    }

    fn distances() -> impl Strategy<Value = Vec<f64>> {
        proptest::collection::vec(prop_oneof![0.0..0.01f64, 0.0..3.0f64, 0.0..99.999f64], 1..400)
    }

    proptest! {
        #[test]
        fn percentiles_are_those_of_the_sorted_distances(mut d in distances()) {
            let h = histogram(&d);
            let s = h.summary();
            d.sort_by(f64::total_cmp);
            for percent in 0..=100 {
                let rank = (percent as usize * d.len()).div_ceil(100).max(1);
                prop_assert!((h.percentile_mm(percent) - d[rank - 1]).abs() <= 0.000_500_001);
            }
            prop_assert_eq!((s.p95, s.p99), (h.percentile_mm(95), h.percentile_mm(99)));
            let rms = (d.iter().map(|x| x * x).sum::<f64>() / d.len() as f64).sqrt();
            prop_assert!((s.rms - rms).abs() <= 1e-12 * rms);
            prop_assert_eq!((s.max, s.count), (d[d.len() - 1], d.len() as u64));
        }

        #[test]
        fn merging_is_the_union(a in distances(), b in distances()) {
            let mut merged = histogram(&a);
            merged.merge(&histogram(&b));
            let union = histogram(&[a, b].concat());
            prop_assert_eq!(&merged.counts, &union.counts);
            prop_assert_eq!((merged.count, merged.max_mm), (union.count, union.max_mm));
            prop_assert!((merged.squared_sum_mm2 - union.squared_sum_mm2).abs() <= 1e-12 * union.squared_sum_mm2);
        }
    }
}
