//! The projector as a TI LightCrafter 4500 on the bus: the DLPC350's emulator behind a HID interface.
//!
//! Its light is that of the rig's projector: whenever the emulated device shows something else, the rig's projector is told to
//! show the same. The images in its flash hold the rig's patterns.

use super::rig::{DeviceKind, VirtualRig};
use super::show_requests;
use crate::device::dlpc350::emulator::{
    CONFIGURATION_DESCRIPTOR, DEVICE_DESCRIPTOR, Dlpc350Emulator, REPORT_DESCRIPTOR, STRINGS, Shown,
};
use crate::device::sim::Gv3Device;
use crate::device::{RigConfig, SequenceTiming};
use crate::light::PatternSequence;
use crate::usb_device::{ControlReply, Descriptors, Setup, Speed, Transmit, UsbDevice};
use gv3_protocol::dlpc350::REPORT_BYTES;
use gv3_protocol::gv3::CONTROL_RESET;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Reports' endpoint, both ways.
const REPORTS: u8 = 1;

/// The emulated device and the patterns in its flash.
#[derive(Debug)]
pub struct LightCrafter {
    emulator: Dlpc350Emulator,
    sequence: PatternSequence,
    flash_images: Vec<u8>,
    shown: Shown,
}

impl LightCrafter {
    /// A projector just switched on, with a rig's patterns in its flash.
    pub fn new(config: &RigConfig) -> Self {
        let flash_images = config.projector.dlpc350.as_ref().map_or(vec![0, 1], |dlpc350| dlpc350.flash_images.clone());
        let count = flash_images.iter().max().map_or(0, |most| most.saturating_add(1));
        let emulator = Dlpc350Emulator::new().with_flash_images(count);
        Self { emulator, sequence: config.sequence.clone(), flash_images, shown: Shown::Dark }
    }

    /// Falls back to video mode, as when a video cable is plugged in; `light` is the rig's projector.
    pub(super) fn lose_mode(&mut self, light: &mut Gv3Device) {
        self.emulator.hot_plug_video();
        self.follow(light);
    }

    /// Has the rig's projector show what the emulated device does.
    fn follow(&mut self, light: &mut Gv3Device) {
        let shown = self.emulator.shown();
        if shown == self.shown {
            return;
        }
        // Its own reset is one that it knows.
        let _ = light.handle_control([0x41, CONTROL_RESET, 0, 0, 0, 0, 0, 0], &[]);
        if let Shown::Patterns { patterns, timing, .. } = &shown {
            let place = |image: Option<u8>| {
                image.and_then(|image| self.flash_images.iter().position(|i| *i == image)).unwrap_or(0)
            };
            let index = |entry: &crate::device::dlpc350::emulator::ShownPattern| {
                place(entry.image) * entry.entry.depth.patterns_per_image() + usize::from(entry.entry.pattern)
            };
            let order: Vec<usize> =
                patterns.iter().map(index).filter(|index| *index < self.sequence.patterns.len()).collect();
            let timing = SequenceTiming {
                picture_period_nanos: u64::from(timing.period_us) * 1000,
                exposure_nanos: u64::from(timing.exposure_us) * 1000,
            };
            light.write_out(&show_requests(&self.sequence, &order, &timing));
        }
        self.shown = shown;
    }
}

/// The device on the bus.
pub struct HidProjector {
    descriptors: Descriptors,
    rig: Arc<Mutex<VirtualRig>>,
}

impl HidProjector {
    /// The LightCrafter of a rig; none when its descriptors are not as they must be.
    pub fn new(rig: Arc<Mutex<VirtualRig>>) -> Option<Self> {
        let mut descriptors = Descriptors::read(Speed::Full, &DEVICE_DESCRIPTOR, CONFIGURATION_DESCRIPTOR.to_vec())?;
        let [manufacturer, product, serial] = STRINGS.map(String::from);
        let identity = &mut descriptors.identity;
        (identity.manufacturer, identity.product, identity.serial) = (manufacturer, product, serial);
        Some(Self { descriptors, rig })
    }

    /// The rig at the present time.
    fn rig(&self) -> MutexGuard<'_, VirtualRig> {
        let mut rig = self.rig.lock().unwrap_or_else(PoisonError::into_inner);
        rig.tick(Instant::now());
        rig
    }

    /// Does something with the emulated device; the light follows.
    fn with<T>(&self, act: impl FnOnce(&mut Dlpc350Emulator) -> T) -> Option<T> {
        let mut rig = self.rig();
        let VirtualRig { projector, light_crafter, .. } = &mut *rig;
        let device = light_crafter.as_mut()?;
        let result = act(&mut device.emulator);
        device.follow(projector);
        Some(result)
    }
}

impl UsbDevice for HidProjector {
    fn descriptors(&self) -> &Descriptors {
        &self.descriptors
    }

    fn control(&mut self, setup: &Setup, _data: &[u8]) -> ControlReply {
        if let Some(reply) = self.descriptors.answer(setup) {
            return reply;
        }
        match (setup.request_type, setup.request, setup.value >> 8) {
            (0x81, 6, 0x22) => ControlReply::Data(REPORT_DESCRIPTOR.to_vec()),
            // Idle rate and protocol of HID: it sends no report unasked.
            (0x21, 0x0a | 0x0b, _) => ControlReply::Done,
            _ => ControlReply::Stall,
        }
    }

    fn receive(&mut self, endpoint: u8, data: &[u8]) -> bool {
        let Ok(report) = <&[u8; REPORT_BYTES]>::try_from(data) else { return false };
        endpoint == REPORTS && self.with(|emulator| emulator.output_report(report)).is_some()
    }

    fn transmit(&mut self, endpoint: u8, _max_bytes: usize) -> Transmit {
        if endpoint != REPORTS {
            return Transmit::Stall;
        }
        let report = self.with(Dlpc350Emulator::input_report).flatten();
        report.map_or(Transmit::Nothing, |report| Transmit::Data(report.to_vec()))
    }

    fn take_unplug(&mut self) -> bool {
        let is_pulled = self.rig.lock().unwrap_or_else(PoisonError::into_inner).take_unplug(DeviceKind::Projector);
        if is_pulled {
            // Without its cable it has no power.
            self.with(Dlpc350Emulator::plug_in);
        }
        is_pulled
    }
}
