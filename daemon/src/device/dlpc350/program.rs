//! What the projector is told for a pattern sequence.

use super::config::{Dlpc350Config, Source};
use crate::device::{DeviceError, SequenceTiming};
use gv3_protocol::dlpc350::{
    BUFFER_PLANES, BitDepth, ExposurePeriod, LutControl, LutEntry, MAX_PATTERNS, PatternSource, StartTrigger,
    TriggerMode, TriggerOut1, TriggerOut2,
};

/// Time to load an image that is not in the buffers, microseconds.
const BUFFER_LOAD_US: u32 = 200_000;
/// Period of a pattern that stands still: the shortest at which every bit depth works, so that a camera that exposes for
/// whole periods sees whole patterns.
const STILL_PERIOD_US: u32 = 8333;

/// Tables and timing of a sequence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Program {
    pub source: PatternSource,
    pub trigger: TriggerMode,
    pub timing: ExposurePeriod,
    pub patterns: Vec<LutEntry>,
    /// Flash images in the order they are taken; empty for video.
    pub images: Vec<u8>,
    pub trigger_1: TriggerOut1,
    pub trigger_2: TriggerOut2,
}

impl Program {
    /// `count` patterns over and over.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field that the projector cannot do.
    pub(super) fn sequence(config: &Dlpc350Config, count: usize, timing: &SequenceTiming) -> Result<Self, DeviceError> {
        timing.validate()?;
        let timing = whole_microseconds(timing)?;
        let program = Self::of(config, 0..count, timing)?;
        match config.source {
            Source::Flash => check_buffers(config.depth()?, count, program.images.len(), timing)?,
            Source::Video => check_frame(config, count, timing)?,
        }
        Ok(program)
    }

    /// Pattern `index` alone, until stopped.
    pub(super) fn still(config: &Dlpc350Config, index: usize) -> Result<Self, DeviceError> {
        let period_us = match config.source {
            Source::Flash => STILL_PERIOD_US.max(config.least_exposure_us()?),
            Source::Video => frame_us(config),
        };
        Self::of(config, index..index + 1, ExposurePeriod { exposure_us: period_us, period_us })
    }

    fn of(
        config: &Dlpc350Config,
        patterns: std::ops::Range<usize>,
        timing: ExposurePeriod,
    ) -> Result<Self, DeviceError> {
        check_fit(config, patterns.end)?;
        let least_us = config.least_exposure_us()?;
        timing.check(least_us).map_err(|e| DeviceError::config("timing.exposure_nanos", e.to_string()))?;
        let depth = config.depth()?;
        let an_image = depth.patterns_per_image();
        let (source, trigger, first) = match config.source {
            Source::Flash => (PatternSource::Flash, TriggerMode::Internal, StartTrigger::Internal),
            Source::Video => (PatternSource::Video, TriggerMode::VerticalSync, StartTrigger::Rising),
        };
        let start = patterns.start;
        let entry = |i: usize| LutEntry {
            trigger: if i == start { first } else { StartTrigger::Continue },
            pattern: (i % an_image) as u8,
            depth,
            leds: config.light.leds(),
            inverted: false,
            // Black from the end of the exposure, where the next pattern does not follow at once.
            black_after: timing.exposure_us < timing.period_us,
            swaps_buffer: config.source == Source::Flash && (i == start || i.is_multiple_of(an_image)),
            shares_trigger: false,
        };
        let images = match config.source {
            Source::Flash => config.flash_images[start / an_image..patterns.end.div_ceil(an_image)].to_vec(),
            Source::Video => Vec::new(),
        };
        let (trigger_1, trigger_2) = config.triggers()?;
        Ok(Self { source, trigger, timing, patterns: patterns.map(entry).collect(), images, trigger_1, trigger_2 })
    }

    pub(super) fn control(&self) -> LutControl {
        LutControl {
            patterns: self.patterns.len() as u8,
            repeats: true,
            trigger_2_every: self.patterns.len() as u16,
            images: self.images.len().max(1) as u8,
        }
    }
}

/// Whether `count` patterns fit into the tables and images.
///
/// # Errors
/// [`DeviceError::Config`] with what to change.
pub(super) fn check_fit(config: &Dlpc350Config, count: usize) -> Result<(), DeviceError> {
    let an_image = config.depth()?.patterns_per_image();
    let bits = config.bit_depth;
    if !(1..=MAX_PATTERNS).contains(&count) {
        let reason = format!("{count} patterns, but the projector's table holds 1 to {MAX_PATTERNS}");
        return Err(DeviceError::config("sequence.patterns", reason));
    }
    match config.source {
        Source::Video if count > an_image => {
            let reason = format!(
                "{count} patterns, but a video frame carries {an_image} of {bits} bits; use fewer patterns, a lower \
                 projector.dlpc350.bit_depth, or projector.dlpc350.source = \"flash\""
            );
            Err(DeviceError::config("sequence.patterns", reason))
        }
        Source::Flash if count.div_ceil(an_image) > config.flash_images.len() => {
            let reason = format!(
                "{} named, but {count} patterns of {bits} bits, {an_image} an image, need {}",
                config.flash_images.len(),
                count.div_ceil(an_image)
            );
            Err(DeviceError::config("projector.dlpc350.flash_images", reason))
        }
        _ => Ok(()),
    }
}

/// The projector's clock counts microseconds; a period between two is shortened.
fn whole_microseconds(timing: &SequenceTiming) -> Result<ExposurePeriod, DeviceError> {
    let whole = |nanos: u64| u32::try_from(nanos / 1000).ok();
    match (whole(timing.exposure_nanos), whole(timing.picture_period_nanos)) {
        (Some(exposure_us), Some(period_us)) => Ok(ExposurePeriod { exposure_us, period_us }),
        _ => Err(DeviceError::config("timing.picture_period_nanos", "beyond what the projector counts")),
    }
}

fn check_buffers(depth: BitDepth, count: usize, images: usize, timing: ExposurePeriod) -> Result<(), DeviceError> {
    let planes = count * usize::from(depth.bits());
    if planes <= BUFFER_PLANES && images <= 2 || timing.period_us >= BUFFER_LOAD_US {
        return Ok(());
    }
    let reason = format!(
        "{count} patterns of {} bits are {planes} bit planes in {images} images; the projector holds {BUFFER_PLANES} \
         planes of 2 images ready: use fewer patterns, a lower projector.dlpc350.bit_depth, or a period of {BUFFER_LOAD_US} us",
        depth.bits()
    );
    Err(DeviceError::config("timing.picture_period_nanos", reason))
}

/// Period of the video input in whole microseconds.
fn frame_us(config: &Dlpc350Config) -> u32 {
    (1e6 / config.video_hz) as u32
}

/// The sequence begins anew at every video frame, so it has to fill one.
fn check_frame(config: &Dlpc350Config, count: usize, timing: ExposurePeriod) -> Result<(), DeviceError> {
    let frame_us = f64::from(frame_us(config));
    let sequence_us = f64::from(timing.period_us) * count as f64;
    if sequence_us <= frame_us && sequence_us >= 0.99 * frame_us {
        return Ok(());
    }
    let reason = format!(
        "{count} patterns take {sequence_us} us, but a video frame of {} Hz {frame_us} us; give {}",
        config.video_hz,
        (1e9 / config.video_hz / count as f64) as u64
    );
    Err(DeviceError::config("timing.picture_period_nanos", reason))
}
