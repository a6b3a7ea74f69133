//! An emulated LightCrafter 4500 whose light falls into the simulated world: the driver and every byte of it without hardware.

use super::emulator::{EmulatedLink, Shown};
use super::{Dlpc350Config, Dlpc350Projector, LinkKind, WATCH_INTERVAL};
use crate::device::sim::{SimCamera, SimProjector, SimWorld};
use crate::device::{DeviceError, ExposureFeed, PatternIndex, Projector, ProjectorInfo, RigConfig, SequenceTiming};
use crate::light::PatternSequence;
use std::sync::{Arc, Mutex};

/// The projector's driver, the emulated device at its other end, and the light.
pub struct EmulatedProjector {
    projector: Dlpc350Projector,
    device: EmulatedLink,
    config: Dlpc350Config,
    light: SimProjector,
}

/// A simulated camera that sees the emulated projector's light.
///
/// # Errors
/// [`DeviceError::Config`] when the projector is a real one, or its settings cannot work.
pub fn open_simulated(
    config: &RigConfig,
    projector: &Dlpc350Config,
) -> Result<(SimCamera, EmulatedProjector), DeviceError> {
    if projector.link != LinkKind::Emulated {
        let reason =
            "a simulated camera sees no real light; take a real camera, or projector.dlpc350.link = \"emulated\"";
        return Err(DeviceError::config("camera.backend", reason));
    }
    let world = Arc::new(Mutex::new(SimWorld::new(config)?));
    let device = EmulatedLink::default();
    let driver = Dlpc350Projector::open_with(projector, Box::new(device.clone()), WATCH_INTERVAL)?;
    let light = SimProjector::new(Arc::clone(&world));
    Ok((SimCamera::new(world), EmulatedProjector { projector: driver, device, config: projector.clone(), light }))
}

impl EmulatedProjector {
    /// Patterns of the sequence, in the order in which the device shows them, and when.
    fn shown(&self) -> Result<(Vec<usize>, SequenceTiming), DeviceError> {
        let Shown::Patterns { patterns, timing, .. } = self.device.device().shown() else {
            return Err(DeviceError::Failed("the emulated projector shows no patterns".into()));
        };
        let an_image = self.config.depth()?.patterns_per_image();
        let index = |image: Option<u8>| {
            image.and_then(|image| self.config.flash_images.iter().position(|&i| i == image)).unwrap_or(0)
        };
        let order = patterns.iter().map(|p| index(p.image) * an_image + usize::from(p.entry.pattern)).collect();
        let timing = SequenceTiming {
            picture_period_nanos: u64::from(timing.period_us) * 1000,
            exposure_nanos: u64::from(timing.exposure_us) * 1000,
        };
        Ok((order, timing))
    }
}

impl Projector for EmulatedProjector {
    fn info(&self) -> ProjectorInfo {
        self.projector.info()
    }

    fn load(&mut self, sequence: &PatternSequence) -> Result<(), DeviceError> {
        self.projector.load(sequence)?;
        self.light.load(sequence)
    }

    fn play(&mut self, timing: &SequenceTiming) -> Result<(), DeviceError> {
        self.projector.play(timing)?;
        let (order, timing) = self.shown()?;
        if order.iter().enumerate().any(|(i, &index)| i != index) {
            return Err(DeviceError::Failed(format!(
                "the emulated projector shows the patterns in the order {order:?}"
            )));
        }
        self.light.play(&timing)
    }

    fn show(&mut self, pattern: PatternIndex) -> Result<(), DeviceError> {
        self.projector.show(pattern)?;
        match self.shown()?.0[..] {
            [index] => self.light.show(PatternIndex(index as u16)),
            _ => Err(DeviceError::Failed("the emulated projector shows more than one pattern".into())),
        }
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.projector.stop()?;
        self.light.stop()
    }

    fn exposures(&self) -> Option<ExposureFeed> {
        self.projector.exposures()
    }
}
