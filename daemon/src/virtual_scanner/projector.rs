//! The projector with the gv3 vendor protocol on the bus.

use super::rig::{DeviceKind, VirtualRig};
use crate::device::sim::Gv3Device;
use crate::usb_device::{ControlReply, Descriptors, Setup, Speed, Transmit, UsbDevice};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// The projector.
pub struct VendorProjector {
    descriptors: Descriptors,
    rig: Arc<Mutex<VirtualRig>>,
}

impl VendorProjector {
    /// The projector of a rig; none when its descriptors are not as they must be.
    pub fn new(rig: Arc<Mutex<VirtualRig>>) -> Option<Self> {
        let get = |kind: u8| {
            let setup = [0x80, 6, 0, kind, 0, 0, 0xff, 0xff];
            rig.lock().unwrap_or_else(PoisonError::into_inner).projector.handle_control(setup, &[]).ok()
        };
        let (device, configuration) = (get(1)?, get(2)?);
        let descriptors = Descriptors::read(Speed::High, &device, configuration)?;
        Some(Self { descriptors, rig })
    }

    /// The rig at the present time.
    fn rig(&self) -> MutexGuard<'_, VirtualRig> {
        let mut rig = self.rig.lock().unwrap_or_else(PoisonError::into_inner);
        rig.tick(Instant::now());
        rig
    }
}

impl UsbDevice for VendorProjector {
    fn descriptors(&self) -> &Descriptors {
        &self.descriptors
    }

    fn control(&mut self, setup: &Setup, data: &[u8]) -> ControlReply {
        match self.rig().projector.handle_control(setup.to_bytes(), data) {
            Err(_) => ControlReply::Stall,
            Ok(answer) if setup.is_in() => ControlReply::Data(answer),
            Ok(_) => ControlReply::Done,
        }
    }

    fn receive(&mut self, endpoint: u8, data: &[u8]) -> bool {
        let mut rig = self.rig();
        if endpoint != Gv3Device::OUT || rig.projector.is_halted(endpoint) {
            return false;
        }
        rig.projector.write_out(data);
        true
    }

    fn transmit(&mut self, endpoint: u8, max_bytes: usize) -> Transmit {
        let address = endpoint | 0x80;
        let mut rig = self.rig();
        if rig.projector.is_halted(address) {
            return Transmit::Stall;
        }
        let now_nanos = rig.clock_nanos();
        let found = match address {
            Gv3Device::IN => rig.projector.read_in(max_bytes),
            Gv3Device::EVENTS => rig.projector.poll_events(now_nanos),
            _ => return Transmit::Stall,
        };
        found.map_or(Transmit::Nothing, Transmit::Data)
    }

    fn reset(&mut self) {
        self.rig().reset_projector();
    }

    fn take_unplug(&mut self) -> bool {
        self.rig.lock().unwrap_or_else(PoisonError::into_inner).take_unplug(DeviceKind::Projector)
    }
}
