// What the fuzz targets do with their bytes; `tests/tests/virtual_scanner.rs` runs the same on the corpus.

use gv3::usb_device::bus::MAX_WAITING;
use gv3::usb_device::connection::Wire;
use gv3::usb_device::descriptor::{Configuration, Identity, TransferKind};
use gv3::usb_device::usbip::{Operation, UsbIp};
use gv3::usb_device::usbredir::UsbRedir;
use gv3::usb_device::{ControlReply, Descriptors, Session, Setup, Speed, Transmit, UsbDevice};

/// Takes everything, and has a byte for everyone every other time.
struct Echo {
    descriptors: Descriptors,
    asked: u32,
}

impl Echo {
    fn new() -> Self {
        let [manufacturer, product, serial] = ["gv3", "echo", "1"].map(String::from);
        let class = [0xff, 0, 0];
        let identity = Identity { vendor_id: 0x1209, product_id: 1, release: 1, class, manufacturer, product, serial };
        let configuration = Configuration::new(Speed::High)
            .interface(3, class)
            .endpoint(0x01, TransferKind::Bulk)
            .endpoint(0x81, TransferKind::Bulk)
            .endpoint(0x82, TransferKind::Interrupt { interval: 4, packet_bytes: 8 });
        Self { descriptors: Descriptors::new(identity, configuration), asked: 0 }
    }
}

impl UsbDevice for Echo {
    fn descriptors(&self) -> &Descriptors {
        &self.descriptors
    }
    fn control(&mut self, setup: &Setup, _data: &[u8]) -> ControlReply {
        self.descriptors.answer(setup).unwrap_or(ControlReply::Stall)
    }
    fn receive(&mut self, endpoint: u8, _data: &[u8]) -> bool {
        endpoint == 1
    }
    fn transmit(&mut self, _endpoint: u8, max_bytes: usize) -> Transmit {
        self.asked += 1;
        if self.asked.is_multiple_of(2) { Transmit::Data(vec![1; max_bytes.min(1)]) } else { Transmit::Nothing }
    }
}

/// Bytes of a host, the first of which says how they are cut, do no harm, and answers stay in proportion.
fn session(wire: Box<dyn Wire>, bytes: &[u8]) {
    let Some((&cut, bytes)) = bytes.split_first() else { return };
    let (mut session, mut device, mut out) = (Session::new(wire), Echo::new(), Vec::new());
    for part in bytes.chunks(usize::from(cut) + 1) {
        session.push(part);
        loop {
            match session.handle(&mut device, &mut out) {
                Ok(true) => {}
                Ok(false) => break,
                Err(_) => return,
            }
        }
        session.pump(&mut device, 1 << 16, &mut out);
    }
    // The shortest request is 16 bytes long, the longest answer to it a descriptor; what waits is answered once.
    assert!(out.len() <= 64 * bytes.len() + 128 * MAX_WAITING, "{} bytes of answers", out.len());
}

/// A USB/IP client, before and after an import.
pub fn usbip(bytes: &[u8]) {
    if let Ok(Some((_, taken))) = Operation::read(bytes) {
        assert!(taken <= bytes.len());
    }
    session(Box::new(UsbIp::default()), bytes);
}

/// A QEMU.
pub fn usbredir(bytes: &[u8]) {
    session(Box::new(UsbRedir::new(Echo::new().descriptors()).0), bytes);
}
