//! A short run of the devices, and what came of it.

use crate::device::{
    self, CameraInfo, CameraSettings, DeviceError, Frame, ProjectorInfo, Rig, RigConfig, SequenceTiming, TriggerInfo,
};
use crate::pipeline::{DropCounts, FrameSet, FrameSetAssembler};
use std::time::{Duration, Instant};

/// How long a picture is waited for, beyond its period.
const PATIENCE: Duration = Duration::from_secs(2);
/// Timeouts in a row that end the run.
const MOST_TIMEOUTS: u32 = 2;

/// Number and times of one picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stamp {
    pub sequence: u64,
    /// Sensor time of the middle of its exposure, nanoseconds.
    pub device_time_nanos: u64,
}

/// What was seen of a rig that played its sequence.
pub(super) struct Look {
    pub camera: CameraInfo,
    pub projector: ProjectorInfo,
    pub trigger: Option<TriggerInfo>,
    /// What the camera was really set to.
    pub settings: CameraSettings,
    pub stamps: Vec<Stamp>,
    pub sets: Vec<FrameSet>,
    pub drops: DropCounts,
    /// Pulses that the trigger controller says it fired.
    pub pulses: Option<u64>,
    /// Why the run ended before all pictures were there.
    pub ended_by: Option<String>,
}

impl Look {
    /// Plays a rig's sequence until `sets` sets should be complete.
    ///
    /// # Errors
    /// [`DeviceError`] when the devices cannot be opened or set going; what goes wrong later is part of what is seen.
    pub fn at(config: &RigConfig, sets: usize) -> Result<Self, DeviceError> {
        let mut rig = device::open(config)?;
        let settings = rig.camera.configure(&config.camera_settings())?;
        let mut look = Self {
            camera: rig.camera.info(),
            projector: rig.projector.info(),
            trigger: rig.trigger.as_ref().map(|trigger| trigger.info()),
            settings,
            stamps: Vec::new(),
            sets: Vec::new(),
            drops: DropCounts::default(),
            pulses: None,
            ended_by: None,
        };
        let begun = begin(&mut rig);
        if begun.is_ok() {
            look.watch(&mut rig, sets * config.sequence.patterns.len(), &config.timing);
        }
        let pulses = rig.trigger.as_mut().map(|trigger| trigger.disarm());
        let stopped = rig.projector.stop().and(rig.camera.stop());
        begun?;
        look.pulses = pulses.and_then(Result::ok);
        if let (None, Err(error)) = (&look.ended_by, stopped) {
            look.ended_by = Some(error.to_string());
        }
        Ok(look)
    }

    fn watch(&mut self, rig: &mut Rig, pictures: usize, timing: &SequenceTiming) {
        let mut assembler = FrameSetAssembler::new(&rig.sequence, timing);
        let patience = PATIENCE + Duration::from_nanos(timing.picture_period_nanos);
        let mut timeouts = 0;
        while self.stamps.last().is_none_or(|last| last.sequence + 1 < pictures as u64) {
            match rig.camera.next_frame(Instant::now() + patience) {
                Ok(frame) => {
                    timeouts = 0;
                    self.take(&mut assembler, frame);
                }
                Err(DeviceError::Timeout(_)) if timeouts + 1 < MOST_TIMEOUTS => timeouts += 1,
                Err(error) => {
                    self.ended_by = Some(error.to_string());
                    break;
                }
            }
        }
        self.drops = assembler.finish();
    }

    fn take(&mut self, assembler: &mut FrameSetAssembler, frame: Frame) {
        let Frame { sequence, device_time_nanos, .. } = frame;
        self.stamps.push(Stamp { sequence, device_time_nanos });
        self.sets.extend(assembler.push(frame));
    }
}

/// Sets the devices going: first who must be ready for whom.
fn begin(rig: &mut Rig) -> Result<(), DeviceError> {
    rig.projector.load(&rig.sequence)?;
    rig.camera.start()?;
    rig.projector.play(&rig.timing)?;
    if let Some(trigger) = &mut rig.trigger {
        trigger.arm(&rig.timing)?;
    }
    Ok(())
}
