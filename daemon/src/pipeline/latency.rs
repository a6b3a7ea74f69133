//! Latencies: of the whole run by the millisecond, and of the last while.

use serde::Serialize;
use std::collections::VecDeque;
use std::time::Duration;

/// Longest latency told apart, milliseconds.
const MOST_MS: usize = 16_384;
/// The last while: half a minute of scans.
const RECENT: usize = 1024;

/// Figures of a run.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct LatencySummary {
    /// How many there were.
    pub count: u64,
    /// Sum, milliseconds.
    pub sum_ms: f64,
    /// Median, milliseconds.
    pub p50_ms: f64,
    /// 99th percentile, milliseconds.
    pub p99_ms: f64,
    /// Longest, milliseconds.
    pub max_ms: f64,
}

/// Collects latencies.
#[derive(Debug)]
pub(super) struct Latencies {
    /// By whole milliseconds, longer ones in the last.
    counts: Vec<u64>,
    summed: LatencySummary,
    recent_ms: VecDeque<f32>,
}

impl Default for Latencies {
    fn default() -> Self {
        Self { counts: vec![0; MOST_MS], summed: LatencySummary::default(), recent_ms: VecDeque::new() }
    }
}

impl Latencies {
    pub fn add(&mut self, latency: Duration) {
        let ms = latency.as_secs_f64() * 1e3;
        self.counts[(ms as usize).min(MOST_MS - 1)] += 1;
        self.summed.count += 1;
        self.summed.sum_ms += ms;
        self.summed.max_ms = self.summed.max_ms.max(ms);
        if self.recent_ms.len() == RECENT {
            self.recent_ms.pop_front();
        }
        self.recent_ms.push_back(ms as f32);
    }

    /// Percentiles are right to a millisecond, upwards.
    pub fn summary(&self) -> LatencySummary {
        LatencySummary { p50_ms: self.percentile_ms(0.5), p99_ms: self.percentile_ms(0.99), ..self.summed }
    }

    fn percentile_ms(&self, share: f64) -> f64 {
        let rank = (share * self.summed.count as f64).ceil() as u64;
        let mut seen = 0;
        let at = self.counts.iter().position(|count| {
            seen += count;
            seen >= rank.max(1)
        });
        at.map_or(0.0, |ms| (ms as f64 + 1.0).min(self.summed.max_ms))
    }

    /// Median and 99th percentile of the last while, milliseconds.
    pub fn recent_ms(&self) -> [f64; 2] {
        let mut sorted: Vec<f32> = self.recent_ms.iter().copied().collect();
        sorted.sort_by(f32::total_cmp);
        let at = |share: f64| sorted.get(((sorted.len() as f64 * share) as usize).min(sorted.len().saturating_sub(1)));
        [0.5, 0.99].map(|share| at(share).map_or(0.0, |ms| f64::from(*ms)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_of_a_ramp() {
        let mut latencies = Latencies::default();
        assert_eq!((latencies.summary(), latencies.recent_ms()), (LatencySummary::default(), [0.0; 2]));
        (0..1000).for_each(|ms| latencies.add(Duration::from_millis(ms)));
        let summary = latencies.summary();
        assert_eq!((summary.count, summary.p50_ms, summary.p99_ms, summary.max_ms), (1000, 500.0, 990.0, 999.0));
        assert!((summary.sum_ms - 499_500.0).abs() < 1e-6);
        let [p50, p99] = latencies.recent_ms();
        assert!((p50 - 500.0).abs() < 1e-3 && (p99 - 990.0).abs() < 1e-3);
        latencies.add(Duration::from_secs(100));
        assert_eq!(latencies.summary().max_ms, 100_000.0);
    }
}
