//! Mean difference in rate at the same distortion.
//!
//! G. Bjontegaard, "Calculation of average PSNR differences between RD-curves", ITU-T VCEG-M33, 2001, with the piecewise
//! cubic interpolation of later practice (ITU-T H-series supplement on working practices, HSTP-VID-WPOM): the logarithm of
//! the rate is interpolated over the quality by a monotone cubic Hermite spline (F. N. Fritsch and J. Butland, 1984) and
//! integrated over the range of quality that both curves cover.

use serde::Serialize;

/// One point of a rate-distortion curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RatePoint {
    /// Rate, any unit, positive.
    pub rate: f64,
    /// Quality, dB: larger is better.
    pub quality_db: f64,
}

/// A difference in rate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RateDifference {
    /// By how much more the test takes than the anchor, percent; negative: less.
    pub percent: f64,
    /// Range of quality that both cover, dB.
    pub from_db: f64,
    /// End of the range.
    pub to_db: f64,
}

/// By how much the rate of `test` differs from that of `anchor` at the same quality, on average; none when their ranges
/// of quality do not meet, or one has fewer than two points that are of use. A point that another one beats in both rate
/// and quality is of none.
pub fn bd_rate(anchor: &[RatePoint], test: &[RatePoint]) -> Option<RateDifference> {
    let (anchor, test) = (Interpolant::new(anchor)?, Interpolant::new(test)?);
    let (a, b) = (anchor.range(), test.range());
    let (from_db, to_db) = (a.0.max(b.0), a.1.min(b.1));
    if from_db >= to_db {
        return None;
    }
    let mean = (test.integral(from_db, to_db) - anchor.integral(from_db, to_db)) / (to_db - from_db);
    Some(RateDifference { percent: 100.0 * mean.exp_m1(), from_db, to_db })
}

/// ln(rate) over quality: cubic Hermite spline.
struct Interpolant {
    x: Vec<f64>,
    y: Vec<f64>,
    slope: Vec<f64>,
}

impl Interpolant {
    fn new(points: &[RatePoint]) -> Option<Self> {
        let mut points: Vec<_> = points.iter().filter(|p| p.rate > 0.0 && p.quality_db.is_finite()).collect();
        // From the best down, each must be cheaper than all better ones.
        points.sort_by(|a, b| b.quality_db.total_cmp(&a.quality_db).then(a.rate.total_cmp(&b.rate)));
        let mut cheapest = f64::INFINITY;
        points.retain(|p| {
            p.rate < cheapest && {
                cheapest = p.rate;
                true
            }
        });
        points.reverse();
        if points.len() < 2 {
            return None;
        }
        let x: Vec<f64> = points.iter().map(|p| p.quality_db).collect();
        let y: Vec<f64> = points.iter().map(|p| p.rate.ln()).collect();
        let slope = slopes(&x, &y);
        Some(Self { x, y, slope })
    }

    fn range(&self) -> (f64, f64) {
        (self.x[0], self.x[self.x.len() - 1])
    }

    fn integral(&self, from: f64, to: f64) -> f64 {
        (0..self.x.len() - 1).map(|k| self.piece(k, from.max(self.x[k]), to.min(self.x[k + 1]))).sum()
    }

    /// Integral of piece `k` over a part of it; 0 when that is empty.
    fn piece(&self, k: usize, from: f64, to: f64) -> f64 {
        if from >= to {
            return 0.0;
        }
        let h = self.x[k + 1] - self.x[k];
        let secant = (self.y[k + 1] - self.y[k]) / h;
        let (d0, d1) = (self.slope[k], self.slope[k + 1]);
        // y + d0 t + c t^2 + b t^3, t from the start of the piece.
        let c = (3.0 * secant - 2.0 * d0 - d1) / h;
        let b = (d0 + d1 - 2.0 * secant) / (h * h);
        let primitive = |t: f64| t * (self.y[k] + t * (d0 / 2.0 + t * (c / 3.0 + t * b / 4.0)));
        primitive(to - self.x[k]) - primitive(from - self.x[k])
    }
}

/// Slopes that keep the interpolant monotone: weighted harmonic means of the secants; at the ends three-point formulas,
/// limited.
fn slopes(x: &[f64], y: &[f64]) -> Vec<f64> {
    let n = x.len();
    let h: Vec<f64> = x.windows(2).map(|w| w[1] - w[0]).collect();
    let d: Vec<f64> = y.windows(2).zip(&h).map(|(w, h)| (w[1] - w[0]) / h).collect();
    if n == 2 {
        return vec![d[0]; 2];
    }
    let mut slope = vec![0.0; n];
    for k in 1..n - 1 {
        if d[k - 1] * d[k] > 0.0 {
            let (a, b) = (2.0 * h[k] + h[k - 1], h[k] + 2.0 * h[k - 1]);
            slope[k] = (a + b) / (a / d[k - 1] + b / d[k]);
        }
    }
    slope[0] = end_slope(h[0], h[1], d[0], d[1]);
    slope[n - 1] = end_slope(h[n - 2], h[n - 3], d[n - 2], d[n - 3]);
    slope
}

fn end_slope(h0: f64, h1: f64, d0: f64, d1: f64) -> f64 {
    let slope = ((2.0 * h0 + h1) * d0 - h0 * d1) / (h0 + h1);
    if slope * d0 <= 0.0 {
        0.0
    } else if d0 * d1 <= 0.0 && slope.abs() > 3.0 * d0.abs() {
        3.0 * d0
    } else {
        slope
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn curve(points: &[(f64, f64)]) -> Vec<RatePoint> {
        points.iter().map(|&(rate, quality_db)| RatePoint { rate, quality_db }).collect()
    }

    const ANCHOR: [(f64, f64); 4] = [(686.76, 40.28), (309.58, 37.18), (157.11, 34.24), (85.95, 31.42)];

    #[test]
    fn a_curve_against_itself_differs_by_nothing() {
        let d = bd_rate(&curve(&ANCHOR), &curve(&ANCHOR)).unwrap();
        assert_eq!((d.percent, d.from_db, d.to_db), (0.0, 31.42, 40.28));
    }

    #[test]
    fn two_points_are_joined_by_a_line() {
        // ln(rate) from 0 to 1 against 1 to 2 over the same decibels: e times the rate.
        let (a, b) = (curve(&[(1.0, 30.0), (1f64.exp(), 40.0)]), curve(&[(1f64.exp(), 30.0), (2f64.exp(), 40.0)]));
        let d = bd_rate(&a, &b).unwrap();
        assert!((d.percent - 100.0 * 1f64.exp_m1()).abs() < 1e-9);
        // Only half the range is shared; the mean of a line is that of its middle.
        let half = curve(&[(1.0, 35.0), (1f64.exp(), 45.0)]);
        let d = bd_rate(&a, &half).unwrap();
        assert_eq!((d.from_db, d.to_db), (35.0, 40.0));
        assert!((d.percent - 100.0 * (-0.5f64).exp_m1()).abs() < 1e-9);
    }

    #[test]
    fn a_cubic_piece_is_integrated_exactly() {
        // Simpson's rule is exact for cubics.
        let i = Interpolant::new(&curve(&ANCHOR)).unwrap();
        let value = |x: f64| {
            let step = 1e-3;
            (i.integral(31.42, x + step) - i.integral(31.42, x - step)) / (2.0 * step)
        };
        let (a, b) = (34.5, 37.0);
        let simpson = (b - a) / 6.0 * (value(a) + 4.0 * value((a + b) / 2.0) + value(b));
        assert!((i.integral(a, b) - simpson).abs() < 1e-5);
        for (rate, db) in ANCHOR.into_iter().skip(1).take(2) {
            assert!((value(db) - rate.ln()).abs() < 1e-6);
        }
    }

    #[test]
    fn curves_that_do_not_meet_and_single_points_give_none() {
        let high = curve(&[(1.0, 50.0), (2.0, 60.0)]);
        assert_eq!(bd_rate(&curve(&ANCHOR), &high), None);
        assert_eq!(bd_rate(&curve(&ANCHOR), &high[..1]), None);
        assert_eq!(bd_rate(&curve(&[(1.0, f64::INFINITY), (1.0, 3.0)]), &high), None);
    }

    #[test]
    fn beaten_points_and_order_do_not_matter() {
        let mut more = curve(&ANCHOR);
        more.push(RatePoint { rate: 700.0, quality_db: 36.0 });
        more.push(RatePoint { rate: 309.58, quality_db: 37.0 });
        more.reverse();
        assert_eq!(bd_rate(&curve(&ANCHOR), &more).unwrap().percent, 0.0);
    }

    proptest! {
        #[test]
        fn a_shift_of_the_rate_is_found_exactly(
            steps in proptest::collection::vec((0.01..2.0f64, 0.1..8.0f64), 2..9),
            factor in 0.05..20.0f64,
        ) {
            let (mut ln_rate, mut db) = (3.0, 20.0);
            let points: Vec<(f64, f64)> = steps.iter().map(|(r, q)| {
                ln_rate += r;
                db += q;
                (f64::exp(ln_rate), db)
            }).collect();
            let shifted: Vec<_> = points.iter().map(|&(r, q)| (r * factor, q)).collect();
            let d = bd_rate(&curve(&points), &curve(&shifted)).unwrap();
            prop_assert!((d.percent - 100.0 * (factor - 1.0)).abs() < 1e-8 * factor.max(1.0) * 100.0);
            // The other way round it is the inverse.
            let back = bd_rate(&curve(&shifted), &curve(&points)).unwrap();
            prop_assert!(((1.0 + d.percent / 100.0) * (1.0 + back.percent / 100.0) - 1.0).abs() < 1e-9);
        }
    }
}
