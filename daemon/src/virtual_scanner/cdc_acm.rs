//! The trigger controller as a serial port (CDC-ACM, PSTN 1.2).

use super::rig::{DeviceKind, VirtualRig};
use crate::usb_device::descriptor::{Configuration, Identity, TransferKind};
use crate::usb_device::{ControlReply, Descriptors, Setup, Speed, Transmit, UsbDevice};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Notifications, of which there are none, and the line's bytes.
const NOTIFICATIONS: u8 = 1;
const LINE: u8 = 2;
/// 115200 baud, one stop bit, no parity, eight bits.
const LINE_CODING: [u8; 7] = [0x00, 0xc2, 0x01, 0x00, 0, 0, 8];

/// The serial port.
pub struct SerialTrigger {
    descriptors: Descriptors,
    rig: Arc<Mutex<VirtualRig>>,
    line_coding: [u8; 7],
}

impl SerialTrigger {
    /// The controller of a rig.
    pub fn new(rig: Arc<Mutex<VirtualRig>>) -> Self {
        Self { descriptors: descriptors(), rig, line_coding: LINE_CODING }
    }

    fn rig(&self) -> MutexGuard<'_, VirtualRig> {
        self.rig.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn descriptors() -> Descriptors {
    let identity = Identity {
        vendor_id: 0x1209,
        product_id: 0x0003,
        release: 0x0100,
        class: [2, 0, 0],
        manufacturer: "gv3".into(),
        product: "gv3 virtual trigger".into(),
        serial: "virtual-trigger-1".into(),
    };
    let configuration = Configuration::new(Speed::High)
        .interface(1, [2, 2, 1])
        // Release 1.10; calls are not managed; line coding is understood; interface 0 leads interface 1.
        .class_descriptor(&[0x24, 0, 0x10, 0x01])
        .class_descriptor(&[0x24, 1, 0, 1])
        .class_descriptor(&[0x24, 2, 2])
        .class_descriptor(&[0x24, 6, 0, 1])
        .endpoint(0x80 | NOTIFICATIONS, TransferKind::Interrupt { interval: 9, packet_bytes: 16 })
        .interface(2, [10, 0, 0])
        .endpoint(LINE, TransferKind::Bulk)
        .endpoint(0x80 | LINE, TransferKind::Bulk);
    Descriptors::new(identity, configuration)
}

impl UsbDevice for SerialTrigger {
    fn descriptors(&self) -> &Descriptors {
        &self.descriptors
    }

    fn control(&mut self, setup: &Setup, data: &[u8]) -> ControlReply {
        if let Some(reply) = self.descriptors.answer(setup) {
            return reply;
        }
        match (setup.request_type, setup.request, data.first_chunk()) {
            (0x21, 0x20, Some(coding)) => {
                self.line_coding = *coding;
                ControlReply::Done
            }
            (0xa1, 0x21, _) => ControlReply::Data(self.line_coding.to_vec()),
            // Control lines and break.
            (0x21, 0x22 | 0x23, _) => ControlReply::Done,
            _ => ControlReply::Stall,
        }
    }

    fn receive(&mut self, endpoint: u8, data: &[u8]) -> bool {
        let mut rig = self.rig();
        rig.tick(Instant::now());
        rig.trigger.receive(data);
        endpoint == LINE
    }

    fn transmit(&mut self, endpoint: u8, max_bytes: usize) -> Transmit {
        if endpoint != LINE {
            return Transmit::Nothing;
        }
        let bytes = self.rig().trigger.take_output(max_bytes);
        if bytes.is_empty() { Transmit::Nothing } else { Transmit::Data(bytes) }
    }

    fn take_unplug(&mut self) -> bool {
        self.rig().take_unplug(DeviceKind::Trigger)
    }
}
