//! What `gv3 bench live` measured, and what it is held against.

use crate::pipeline::LatencySummary;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write;

/// What the engine did and what it took.
#[derive(Debug, Serialize)]
pub struct LiveReport {
    pub source: String,
    pub patterns: usize,
    /// From the beginning of the recording until it was verified.
    pub seconds: f64,
    pub pictures_per_second: f64,
    /// Scans reconstructed, and scans in the session, a second of recording.
    pub scans_per_second: f64,
    pub recorded_scans_per_second: f64,
    pub drops: BTreeMap<String, u64>,
    /// Share of the time with each degradation.
    pub degradation: BTreeMap<&'static str, f64>,
    /// Processor time of the whole process, source included, over the time measured, in cores.
    pub cpu_cores: f64,
    /// The same by stage: capture with the source, reconstruct, encode, pictures, write.
    pub stage_cores: [f64; 5],
    pub memory_bytes: Memory,
    pub picture_to_mesh: LatencySummary,
    pub group_on_disk: LatencySummary,
    /// From opening the engine until the scanner runs, and until its first scan.
    pub ready_ms: f64,
    pub first_scan_ms: f64,
    pub stop_to_verified_ms: f64,
    pub session_bytes: u64,
    pub keyframes: u64,
    pub verified: bool,
    /// Filled by [`Self::judge`].
    pub aims: Vec<Aim>,
}

/// Resident memory; zeros where the system does not tell.
#[derive(Debug, Default, Serialize)]
pub struct Memory {
    pub end: u64,
    pub peak: u64,
    /// Means of the last and the third quarter of the time, the first from the second.
    pub growth_in_second_half: i64,
}

impl Memory {
    /// Of samples at equal distances.
    pub fn of(samples: &[u64]) -> Self {
        let mean = |part: &[u64]| part.iter().sum::<u64>() as i64 / part.len().max(1) as i64;
        let (half, rest) = (samples.len() / 2, samples.len() * 3 / 4);
        Self {
            end: samples.last().copied().unwrap_or(0),
            peak: samples.iter().copied().max().unwrap_or(0),
            growth_in_second_half: mean(&samples[rest..]) - mean(&samples[half..rest]),
        }
    }
}

/// A figure that must be reached.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Aim {
    pub name: &'static str,
    pub measured: f64,
    /// At most this, or at least when `is_least`.
    pub limit: f64,
    pub is_least: bool,
    pub unit: &'static str,
    pub is_met: bool,
}

impl LiveReport {
    /// Holds the figures against those that must be reached.
    pub fn judge(self) -> Self {
        Self { aims: self.figures(), ..self }
    }

    /// In the order of the table.
    fn figures(&self) -> Vec<Aim> {
        // The first and the last scan may fall out of the time measured.
        let scans = 30.0 - 2.0 / self.seconds.max(1.0);
        let cores = if self.patterns > 3 { 1.3 } else { 0.8 };
        let mb = |bytes: f64| bytes * 1e-6;
        let at_most = |name, measured, limit, unit| Aim {
            name,
            measured,
            limit,
            is_least: false,
            unit,
            is_met: measured <= limit,
        };
        let at_least = |name, measured, limit, unit| Aim {
            name,
            measured,
            limit,
            is_least: true,
            unit,
            is_met: measured >= limit,
        };
        let full = self.degradation.get("none").copied().unwrap_or(0.0);
        vec![
            at_least("scans made", self.scans_per_second, scans, "/s"),
            at_least("scans recorded", self.recorded_scans_per_second, scans, "/s"),
            at_most("dropped", self.drops.values().sum::<u64>() as f64, 0.0, ""),
            at_least("time without degradation", full * 100.0, 100.0, "%"),
            at_most("processor, source included", self.cpu_cores, cores, "cores"),
            at_most("memory, peak", mb(self.memory_bytes.peak as f64), 500.0, "MB"),
            at_most("memory, growth, 2nd half", mb(self.memory_bytes.growth_in_second_half as f64), 10.0, "MB"),
            at_most("picture to mesh, p99", self.picture_to_mesh.p99_ms, 400.0, "ms"),
            at_most("group on disk, longest", self.group_on_disk.max_ms, 2000.0, "ms"),
            at_most("start-up to ready", self.ready_ms, 1000.0, "ms"),
            at_most("stop to verified", self.stop_to_verified_ms, 1000.0, "ms"),
        ]
    }

    /// Whether every figure is reached and the session is whole.
    pub fn is_met(&self) -> bool {
        self.verified && self.aims.iter().all(|aim| aim.is_met)
    }

    /// The table.
    pub fn text(&self) -> String {
        let mut text = format!("recorded live for {:.1} s from {}\n\n", self.seconds, self.source);
        // Writing to a String cannot fail.
        let _ = writeln!(text, "  {:<26} {:>10}       {:>12}", "", "measured", "aim");
        for Aim { name, measured, limit, is_least, unit, is_met } in &self.aims {
            let digits = if *unit == "cores" || *unit == "/s" { 2 } else { 0 };
            let sign = if *is_least { ">=" } else { "<=" };
            let verdict = if *is_met { "" } else { "  missed" };
            let _ = writeln!(text, "  {name:<26} {measured:>10.digits$} {unit:<5} {sign} {limit:>8.digits$}{verdict}");
        }
        let _ = writeln!(text, "\n{}", self.details().join("\n"));
        text
    }

    fn details(&self) -> Vec<String> {
        let named = |(name, n): (&String, &u64)| format!("{n} {name}");
        let drops: Vec<String> = self.drops.iter().filter(|(_, n)| **n > 0).map(named).collect();
        let levels: Vec<String> =
            self.degradation.iter().map(|(level, share)| format!("{level} {:.0} %", share * 100.0)).collect();
        let [capture, reconstruct, encode, pictures, write] = self.stage_cores;
        let latency = |l: &LatencySummary| format!("{:.0} / {:.0} / {:.0} ms", l.p50_ms, l.p99_ms, l.max_ms);
        let mut lines = vec![
            format!("  pictures                   {:.1} /s", self.pictures_per_second),
            format!("  degradation                {}", levels.join(", ")),
            format!(
                "  cores by stage             source {capture:.2}, reconstruct {reconstruct:.2}, encode {encode:.2}, \
                 pictures {pictures:.2}, write {write:.3}"
            ),
            format!("  picture to mesh            p50 / p99 / longest {}", latency(&self.picture_to_mesh)),
            format!("  group on disk              p50 / p99 / longest {}", latency(&self.group_on_disk)),
            format!("  first scan                 {:.0} ms after the start", self.first_scan_ms),
            format!(
                "  session                    {:.2} MB, {} keyframes, {}",
                self.session_bytes as f64 * 1e-6,
                self.keyframes,
                if self.verified { "verified" } else { "NOT verified" }
            ),
        ];
        if !drops.is_empty() {
            lines.insert(1, format!("  dropped                    {}", drops.join(", ")));
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_that_grows_is_told_from_memory_that_moves() {
        let moving: Vec<u64> = (0..400).map(|i| 1000 + 10 * (i % 4)).collect();
        assert_eq!(Memory::of(&moving).growth_in_second_half, 0);
        let growing: Vec<u64> = (0..400).map(|i| 1000 + i).collect();
        let memory = Memory::of(&growing);
        assert_eq!((memory.growth_in_second_half, memory.peak, memory.end), (100, 1399, 1399));
        assert_eq!(Memory::of(&[]).peak, 0);
    }
}
