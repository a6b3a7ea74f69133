//! Totals over a session, keyframes and in-between scans apart.

use super::{Distortion, ScanComparison};

/// Totals over many scans, keyframes and in-between scans apart.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Comparisons {
    /// All scans.
    pub all: Distortion,
    /// Keyframes only.
    pub keyframes: Distortion,
    /// Scans between keyframes only.
    pub in_between: Distortion,
}

impl Comparisons {
    /// Adds one scan.
    pub fn add(&mut self, comparison: &ScanComparison, is_key: bool) {
        self.all.merge(&comparison.distortion);
        let class = if is_key { &mut self.keyframes } else { &mut self.in_between };
        class.merge(&comparison.distortion);
    }

    /// Adds what `other` holds.
    pub fn merge(&mut self, other: &Self) {
        self.all.merge(&other.all);
        self.keyframes.merge(&other.keyframes);
        self.in_between.merge(&other.in_between);
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Share, TextureError};
    use super::*;

    /// A made-up comparison; all sums are exact in binary.
    fn comparison(mm: f64) -> ScanComparison {
        let mut distortion = Distortion { scans: 1, diagonal_mm: 10.0 * mm, ..Distortion::default() };
        distortion.scan_to_replay.add(mm);
        distortion.replay_to_scan.add(2.0 * mm);
        distortion.scan_to_replay_plane.add(mm);
        distortion.replay_to_scan_plane.add(mm);
        distortion.missing = Share { count: 1, total: 3 };
        distortion.invented = Share { count: 2, total: 5 };
        distortion.texture = TextureError { squared_sum: mm, count: 7 };
        ScanComparison { distortion, vertex_error_mm: vec![mm as f32] }
    }

    #[test]
    fn classes_are_kept_apart_and_merging_is_the_union() {
        let (mut first, mut second, mut both) =
            (Comparisons::default(), Comparisons::default(), Comparisons::default());
        for (mm, is_key) in [(1.0, true), (0.5, false)] {
            first.add(&comparison(mm), is_key);
            both.add(&comparison(mm), is_key);
        }
        for (mm, is_key) in [(0.25, false), (4.0, true)] {
            second.add(&comparison(mm), is_key);
            both.add(&comparison(mm), is_key);
        }
        first.merge(&second);
        assert_eq!(first, both);
        assert_eq!((both.all.scans, both.keyframes.scans, both.in_between.scans), (4, 2, 2));
        assert_eq!(both.keyframes.scan_to_replay.summary().max, 4.0);
        assert_eq!(both.in_between.replay_to_scan.summary().max, 1.0);
        assert_eq!(both.all.missing, Share { count: 4, total: 12 });
        assert_eq!(both.keyframes.invented, Share { count: 4, total: 10 });
        assert_eq!(both.keyframes.texture, TextureError { squared_sum: 5.0, count: 14 });
        assert_eq!(both.in_between.scan_to_replay_plane.squared_sum_mm2, 0.75);
        assert_eq!((both.all.diagonal_mm, both.in_between.diagonal_mm), (40.0, 5.0));
    }
}
