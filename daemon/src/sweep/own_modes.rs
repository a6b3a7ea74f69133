//! Our own modes as coders: what a session takes without its textures.

use super::{Coded, Coder, SweepInput};
use crate::measure::{Decoded, MeasureError, Output};
use crate::pipeline::record::write_group;
use crate::replay::{Replay, ReplayStamp};
use gv3_codec::shot::encoder::ShotConfig;
use gv3_codec::{EncodedGroup, Encoder, EncoderConfig, Mode, Scan, seed};
use gv3_protocol::AtomicFile;
use gv3_protocol::session::{MetadataGroup, SessionMetadata, SessionWriter};
use std::path::Path;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// One of our modes at several settings.
pub struct ModeCoder {
    name: &'static str,
    about: &'static str,
    output: Output,
    settings: Vec<(String, EncoderConfig)>,
}

impl ModeCoder {
    /// The default mode at tolerances.
    pub fn shots(tolerances_mm: &[f32], period_nanos: u64) -> Self {
        let setting = |&mm: &f32| {
            let mut config = ShotConfig::new(period_nanos);
            config.set_tolerance_mm(f64::from(mm));
            (format!("tolerance {mm} mm"), EncoderConfig::Shots(config))
        };
        let settings = tolerances_mm.iter().map(setting).collect();
        let about = "gv3, each scan as it was seen; container included";
        Self { name: "gv3", about, output: Output::Scan, settings }
    }

    /// The seed mode at every pair of a keyframe interval and a largest error of rounding a coordinate (half the
    /// quantizer's step).
    pub fn seed(intervals: &[u8], tolerances_mm: &[f32], period_nanos: u64) -> Self {
        let setting = |interval: u8, mm: f32| {
            let mut config = seed::EncoderConfig::new(period_nanos);
            config.header.keyframe_interval = interval;
            config.header.mode = Mode::Seed { position_step_mm: 2.0 * mm };
            (format!("every {interval}, {mm} mm"), EncoderConfig::Seed(config))
        };
        let settings = intervals.iter().flat_map(|&i| tolerances_mm.iter().map(move |&t| setting(i, t))).collect();
        let about = "gv3 --mode seed: a sixth of the vertices at keyframes, natural spline between; container included";
        Self { name: "seed", about, output: Output::Mesh, settings }
    }

    fn encode(&self, setting: usize, input: &SweepInput, path: &Path) -> anyhow::Result<Duration> {
        let config = self.settings[setting].1.clone();
        let metadata = SessionMetadata::new(config.header().mode.name(), "gv3 sweep", 0);
        let mut encoder = Encoder::new(config)?;
        let mut writer = SessionWriter::create(AtomicFile::create(path, false)?, &metadata)?;
        writer.write_stream(&encoder.header().encode())?;
        let mut time = Duration::ZERO;
        let mut write = |group: Option<EncodedGroup>| group.map_or(Ok(()), |g| write_group(&mut writer, &g, &[]));
        for scan in &input.scans {
            let scan = scan.clone();
            let begin = Instant::now();
            let pushed = encoder.push(scan)?;
            time += begin.elapsed();
            write(pushed.group)?;
        }
        let begin = Instant::now();
        let last = encoder.finish()?;
        time += begin.elapsed();
        write(last)?;
        writer.finish(&MetadataGroup::new())?.commit()?;
        Ok(time)
    }
}

impl Coder for ModeCoder {
    fn name(&self) -> &'static str {
        self.name
    }

    fn about(&self) -> String {
        self.about.into()
    }

    fn settings(&self) -> Vec<String> {
        self.settings.iter().map(|(name, _)| name.clone()).collect()
    }

    fn code(&self, setting: usize, input: &SweepInput) -> Result<Coded, MeasureError> {
        let fail = |reason: String| MeasureError::Coder { coder: self.name, reason };
        let folder = TempDir::new().map_err(|e| fail(format!("no temporary folder: {e}")))?;
        let path = folder.path().join("session.gv3");
        let encode_time = self.encode(setting, input, &path).map_err(|e| fail(format!("{e:#}")))?;
        let replay = Replay::open_as(&path, self.output.played())?;
        let totals = replay.reader().totals();
        let bytes = totals.session - totals.texture;
        Ok(Coded { bytes, encode_time, decoded: Box::new(OwnSession { replay, _folder: folder }) })
    }
}

/// A session that goes when it has been judged.
struct OwnSession {
    replay: Replay,
    _folder: TempDir,
}

impl Decoded for OwnSession {
    fn stamps(&self) -> &[ReplayStamp] {
        self.replay.stamps()
    }
    fn period_nanos(&self) -> u64 {
        self.replay.header().scan_period_nanos
    }
    fn scan(&mut self, stamp: &ReplayStamp) -> Result<Scan, MeasureError> {
        Ok(self.replay.scan_at(stamp.time_nanos)?)
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_scans::rising;
    use super::*;
    use crate::measure::measure;

    #[test]
    fn closer_keyframes_and_finer_steps_take_more() {
        let input = rising(40, 7);
        let coder = ModeCoder::seed(&[3, 6], &[0.01, 0.1], input.period_nanos);
        assert_eq!(coder.settings(), ["every 3, 0.01 mm", "every 3, 0.1 mm", "every 6, 0.01 mm", "every 6, 0.1 mm"]);
        let mut bytes = Vec::new();
        for setting in 0..4 {
            let mut coded = coder.code(setting, &input).unwrap();
            let seen = |_: &Scan, _: &Scan, _: &[f32]| Ok(());
            let (measurement, _) = measure(coded.decoded.as_mut(), &mut input.reference(), seen, || ()).unwrap();
            assert_eq!(measurement.comparisons.all.scans, 7);
            assert!(measurement.comparisons.all.replay_to_scan.summary().rms < 0.5);
            bytes.push(coded.bytes);
        }
        assert!(bytes[0] > bytes[1] && bytes[0] > bytes[2] && bytes[2] > bytes[3], "{bytes:?}");
    }
}
