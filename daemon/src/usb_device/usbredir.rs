//! usbredir 0.7, the device's side: how QEMU plugs in devices over a socket (docs/usb-redirection-protocol.md of usbredir).
//!
//! All numbers are little-endian. Both sides begin with a hello; the device then describes itself, and transfers follow.

use super::bus::{Completion, Outcome, Request};
use super::connection::Wire;
use super::{Descriptors, MAX_TRANSFER_BYTES, Setup, Speed, WireError};
use std::collections::BTreeMap;

/// Connected with version, largest packets in the endpoints' description, 64-bit ids, 32-bit lengths of bulk transfers.
const CAPABILITIES: u32 = 1 << 1 | 1 << 4 | 1 << 5 | 1 << 6;
/// Most bytes a message has beside its data.
const MAX_MESSAGE_BYTES: u32 = MAX_TRANSFER_BYTES + 64;
/// The peer's hello: version text, then capabilities.
const HELLO_BYTES: usize = 68;
const STALL: u8 = 4;
const CANCELLED: u8 = 1;

/// What a transfer was, for the form of its answer.
#[derive(Debug, Clone)]
enum Pending {
    Control(Setup),
    /// Set configuration, or the alternate setting of an interface: kind of the answer and what stands in it.
    Setting(u32, Vec<u8>),
    Bulk(u8),
    Interrupt(u8),
    Poll,
}

/// Transfers with a QEMU.
#[derive(Debug)]
pub struct UsbRedir {
    buffer: Vec<u8>,
    consumed: u64,
    has_hello: bool,
    pending: BTreeMap<u64, Pending>,
    polled_id: u64,
}

impl UsbRedir {
    /// The device's side, and the bytes that introduce the device.
    pub fn new(descriptors: &Descriptors) -> (Self, Vec<u8>) {
        let wire = Self { buffer: Vec::new(), consumed: 0, has_hello: false, pending: BTreeMap::new(), polled_id: 0 };
        let mut bytes = hello();
        // The peer must have all our capabilities, so what follows its hello can be sent before it has come.
        describe(descriptors, &mut bytes);
        (wire, bytes)
    }

    fn error(&self, field: &'static str, found: u32, reason: &'static str) -> WireError {
        WireError { offset: self.consumed, field, found: found.into(), reason }
    }

    fn consume(&mut self, bytes: usize) -> Vec<u8> {
        self.consumed += bytes as u64;
        self.buffer.drain(..bytes).collect()
    }

    /// The peer's hello; it alone has ids of 32 bits. False while bytes are missing.
    fn take_hello(&mut self) -> Result<bool, WireError> {
        let Some(&[k0, k1, k2, k3, l0, l1, l2, l3, ..]) = self.buffer.first_chunk::<12>() else { return Ok(false) };
        let (kind, length) = (u32::from_le_bytes([k0, k1, k2, k3]), u32::from_le_bytes([l0, l1, l2, l3]));
        if kind != 0 {
            return Err(self.error("type", kind, "a stream begins with hello (0)"));
        }
        if !(HELLO_BYTES..=1024).contains(&(length as usize)) {
            return Err(self.error("length", length, "68 ..= 1024 of a hello"));
        }
        let Some(body) = self.buffer.get(12..12 + length as usize) else { return Ok(false) };
        let capabilities = u32::from_le_bytes([body[64], body[65], body[66], body[67]]);
        if capabilities & CAPABILITIES != CAPABILITIES {
            return Err(self.error("capabilities", capabilities, "0x72 must be among them"));
        }
        self.consume(12 + length as usize);
        self.has_hello = true;
        Ok(true)
    }

    /// The request of a message; none for what asks for nothing.
    fn request(&mut self, kind: u32, id: u64, body: &[u8]) -> Result<Option<Request>, WireError> {
        let (pending, request) = match kind {
            3 => return Ok(Some(Request::Reset)),
            21 => return Ok(Some(Request::Cancel { id, victim: id })),
            6..=10 | 15 | 16 => match self.setting(kind, id, body)? {
                Some(found) => found,
                None => return Ok(None),
            },
            100 | 101 | 103 => self.transfer(kind, id, body)?,
            // Filters, streams, acknowledgements.
            _ => return Ok(None),
        };
        if self.pending.len() >= 4 * super::bus::MAX_WAITING {
            return Err(self.error("transfers", self.pending.len() as u32, "too many wait"));
        }
        self.pending.insert(id, pending);
        Ok(Some(request))
    }

    /// The first bytes of a message, and the rest.
    fn head<'a>(&self, body: &'a [u8], count: usize) -> Result<(&'a [u8], &'a [u8]), WireError> {
        let found = body.split_at_checked(count);
        found.ok_or_else(|| self.error("length", body.len() as u32, "too short for its type"))
    }

    /// What USB does by standard requests and this wire by messages of its own: configuration, alternate settings, polling.
    fn setting(&self, kind: u32, id: u64, body: &[u8]) -> Result<Option<(Pending, Request)>, WireError> {
        let standard = |request_type, request, value: u8, index: u8, length| {
            let setup = Setup { request_type, request, value: value.into(), index: index.into(), length };
            Request::Control { id, setup, data: vec![] }
        };
        Ok(Some(match kind {
            6 => {
                let (b, _) = self.head(body, 1)?;
                (Pending::Setting(8, vec![b[0]]), standard(0, 9, b[0], 0, 0))
            }
            7 => (Pending::Setting(8, vec![1]), standard(0x80, 8, 0, 0, 1)),
            9 => {
                let (b, _) = self.head(body, 2)?;
                (Pending::Setting(11, vec![b[0], b[1]]), standard(1, 11, b[1], b[0], 0))
            }
            10 => {
                let (b, _) = self.head(body, 1)?;
                (Pending::Setting(11, vec![b[0], 0]), standard(0x81, 10, 0, b[0], 1))
            }
            15 | 16 => {
                let (b, _) = self.head(body, 1)?;
                (Pending::Poll, Request::Poll { id, endpoint: b[0] & 15, on: kind == 15 })
            }
            // Answers, which are ours to give.
            _ => return Ok(None),
        }))
    }

    /// A control, bulk or interrupt transfer.
    fn transfer(&self, kind: u32, id: u64, body: &[u8]) -> Result<(Pending, Request), WireError> {
        if kind == 103 {
            let (b, data) = self.head(body, 4)?;
            let length = u32::from(u16::from_le_bytes([b[2], b[3]]));
            return Ok((Pending::Interrupt(b[0]), data_request(id, b[0], length, data)));
        }
        let (b, data) = self.head(body, 10)?;
        if kind == 100 {
            let setup = Setup::new([b[2], b[1], b[4], b[5], b[6], b[7], b[8], b[9]]);
            return Ok((Pending::Control(setup), Request::Control { id, setup, data: data.to_vec() }));
        }
        let length = u32::from_le_bytes([b[2], b[3], b[8], b[9]]);
        if length > MAX_TRANSFER_BYTES {
            return Err(self.error("length of a transfer", length, "at most 16 MiB"));
        }
        Ok((Pending::Bulk(b[0]), data_request(id, b[0], length, data)))
    }
}

fn data_request(id: u64, address: u8, length: u32, data: &[u8]) -> Request {
    let endpoint = address & 15;
    match address & 0x80 {
        0 => Request::Out { id, endpoint, data: data.to_vec() },
        _ => Request::In { id, endpoint, max_bytes: length },
    }
}

fn hello() -> Vec<u8> {
    let mut version = [0; 64];
    version[..3].copy_from_slice(b"gv3");
    let mut bytes: Vec<u8> = [0, HELLO_BYTES as u32, 0].iter().flat_map(|w| w.to_le_bytes()).collect();
    bytes.extend(version);
    bytes.extend(CAPABILITIES.to_le_bytes());
    bytes
}

fn message(kind: u32, id: u64, head: &[u8], data: &[u8], out: &mut Vec<u8>) {
    out.extend(kind.to_le_bytes());
    out.extend(((head.len() + data.len()) as u32).to_le_bytes());
    out.extend(id.to_le_bytes());
    out.extend_from_slice(head);
    out.extend_from_slice(data);
}

/// Endpoints, interfaces, then the device itself.
fn describe(descriptors: &Descriptors, out: &mut Vec<u8>) {
    // Thirty-two endpoints: OUT, then IN; kind 255 for none.
    let (mut kinds, mut intervals, mut interfaces) = ([255u8; 32], [0u8; 32], [0u8; 32]);
    let mut packets = [0u16; 32];
    for i in [0, 16] {
        (kinds[i], packets[i]) = (0, 64);
    }
    for endpoint in descriptors.endpoints() {
        let i = usize::from((endpoint.address & 0x80) >> 3 | endpoint.address & 15);
        (kinds[i], intervals[i]) = (endpoint.attributes & 3, endpoint.interval);
        (interfaces[i], packets[i]) = (endpoint.interface, endpoint.packet_bytes);
    }
    let mut body = [kinds, intervals, interfaces].concat();
    body.extend(packets.iter().flat_map(|p| p.to_le_bytes()));
    message(5, 0, &body, &[], out);
    let classes = descriptors.interfaces();
    let mut body = (classes.len() as u32).to_le_bytes().to_vec();
    let mut columns = [[0u8; 32]; 4];
    for (i, class) in classes.iter().enumerate().take(32) {
        for (column, value) in columns.iter_mut().zip([i as u8, class[0], class[1], class[2]]) {
            column[i] = value;
        }
    }
    body.extend(columns.concat());
    message(4, 0, &body, &[], out);
    let d = descriptors.device();
    let speed = match descriptors.speed {
        Speed::Full => 1,
        Speed::High => 2,
        Speed::Super => 3,
    };
    message(1, 0, &[speed, d[4], d[5], d[6], d[8], d[9], d[10], d[11], d[12], d[13]], &[], out);
}

/// Answer to a transfer of a kind, with its data and status.
fn write_answer(pending: &Pending, id: u64, status: u8, taken: u32, data: &[u8], out: &mut Vec<u8>) {
    match pending {
        Pending::Control(setup) => {
            let length = if setup.is_in() { data.len() as u16 } else { taken as u16 };
            let [_, _, v0, v1, i0, i1, ..] = setup.to_bytes();
            let [l0, l1] = length.to_le_bytes();
            let endpoint = setup.request_type & 0x80;
            let head = [endpoint, setup.request, setup.request_type, status, v0, v1, i0, i1, l0, l1];
            message(100, id, &head, data, out);
        }
        Pending::Setting(kind, body) => {
            let mut head = vec![status];
            head.extend(body);
            message(*kind, id, &head, &[], out);
        }
        Pending::Bulk(address) => {
            let length = if address & 0x80 == 0 { taken } else { data.len() as u32 };
            let [l0, l1, l2, l3] = length.to_le_bytes();
            message(101, id, &[*address, status, l0, l1, 0, 0, 0, 0, l2, l3], data, out);
        }
        Pending::Interrupt(address) => {
            let length = if address & 0x80 == 0 { taken } else { data.len() as u32 };
            let [l0, l1, ..] = length.to_le_bytes();
            message(103, id, &[*address, status, l0, l1], data, out);
        }
        Pending::Poll => {}
    }
}

impl Wire for UsbRedir {
    fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    fn next_request(&mut self) -> Result<Option<Request>, WireError> {
        if !self.has_hello && !self.take_hello()? {
            return Ok(None);
        }
        while let Some(&[k0, k1, k2, k3, l0, l1, l2, l3, ref id @ ..]) = self.buffer.first_chunk::<16>() {
            let (kind, length) = (u32::from_le_bytes([k0, k1, k2, k3]), u32::from_le_bytes([l0, l1, l2, l3]));
            let id = u64::from_le_bytes(*id);
            if length > MAX_MESSAGE_BYTES {
                return Err(self.error("length", length, "at most 16 MiB of data"));
            }
            if self.buffer.len() < 16 + length as usize {
                return Ok(None);
            }
            let message = self.consume(16 + length as usize);
            if let Some(request) = self.request(kind, id, &message[16..])? {
                if request == Request::Reset {
                    self.pending.clear();
                }
                return Ok(Some(request));
            }
        }
        Ok(None)
    }

    fn write(&mut self, completion: &Completion, out: &mut Vec<u8>) {
        let Completion { id, endpoint, outcome } = completion;
        if let Outcome::Polled(data) = outcome {
            let [l0, l1, ..] = (data.len() as u32).to_le_bytes();
            self.polled_id += 1;
            return message(103, self.polled_id, &[endpoint | 0x80, 0, l0, l1], data, out);
        }
        // What was answered before it was taken back needs no second answer.
        let Some(pending) = self.pending.remove(id) else { return };
        match outcome {
            Outcome::Taken(bytes) => write_answer(&pending, *id, 0, *bytes, &[], out),
            Outcome::Data(data) => write_answer(&pending, *id, 0, 0, data, out),
            Outcome::Stall => write_answer(&pending, *id, STALL, 0, &[], out),
            Outcome::Cancelled { .. } => write_answer(&pending, *id, CANCELLED, 0, &[], out),
            Outcome::PollSet => message(17, *id, &[0, endpoint | 0x80], &[], out),
            Outcome::Polled(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::usb_device::descriptor::tests::example;

    fn greeted() -> UsbRedir {
        let (mut wire, introduction) = UsbRedir::new(&example(Speed::High));
        assert_eq!(introduction[..12], [0, 0, 0, 0, 68, 0, 0, 0, 0, 0, 0, 0]);
        wire.push(&hello());
        assert_eq!(wire.next_request(), Ok(None));
        wire
    }

    fn asked(wire: &mut UsbRedir, kind: u32, id: u64, body: &[u8]) -> Result<Option<Request>, WireError> {
        let mut bytes = Vec::new();
        message(kind, id, body, &[], &mut bytes);
        wire.push(&bytes);
        wire.next_request()
    }

    #[test]
    fn golden_messages() {
        let mut wire = greeted();
        let body = [0x80, 6, 0x80, 0, 0, 1, 0, 0, 18, 0];
        let setup = Setup { request_type: 0x80, request: 6, value: 0x100, index: 0, length: 18 };
        let request = asked(&mut wire, 100, 7, &body).unwrap();
        assert_eq!(request, Some(Request::Control { id: 7, setup, data: vec![] }));
        let mut answer = Vec::new();
        wire.write(&Completion { id: 7, endpoint: 0, outcome: Outcome::Data(vec![18, 1]) }, &mut answer);
        let expected = [100, 0, 0, 0, 12, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 0x80, 6, 0x80, 0, 0, 1, 0, 0, 2, 0, 18, 1];
        assert_eq!(answer, expected);
        let request = asked(&mut wire, 101, 8, &[0x81, 0, 0, 0x80, 0, 0, 0, 0, 1, 0]).unwrap();
        assert_eq!(request, Some(Request::In { id: 8, endpoint: 1, max_bytes: 0x18000 }));
        assert_eq!(asked(&mut wire, 21, 8, &[]).unwrap(), Some(Request::Cancel { id: 8, victim: 8 }));
        let outcome = Outcome::Cancelled { victim: 8, was_waiting: true };
        let mut answer = Vec::new();
        wire.write(&Completion { id: 8, endpoint: 1, outcome: outcome.clone() }, &mut answer);
        assert_eq!(answer[16..18], [0x81, CANCELLED]);
        answer.clear();
        wire.write(&Completion { id: 8, endpoint: 1, outcome }, &mut answer);
        assert!(answer.is_empty());
    }

    #[test]
    fn interrupt_endpoints_are_polled() {
        let mut wire = greeted();
        let request = asked(&mut wire, 15, 3, &[0x82]).unwrap();
        assert_eq!(request, Some(Request::Poll { id: 3, endpoint: 2, on: true }));
        let mut answer = Vec::new();
        wire.write(&Completion { id: 3, endpoint: 2, outcome: Outcome::PollSet }, &mut answer);
        assert_eq!((answer[0], &answer[16..]), (17, &[0, 0x82][..]));
        answer.clear();
        wire.write(&Completion { id: 0, endpoint: 2, outcome: Outcome::Polled(vec![5, 6]) }, &mut answer);
        assert_eq!(answer[16..], [0x82, 0, 2, 0, 5, 6]);
    }

    #[test]
    fn foreign_bytes_are_refused_by_field() {
        let (mut wire, _) = UsbRedir::new(&example(Speed::High));
        wire.push(&[9; 12]);
        assert_eq!(wire.next_request().unwrap_err().field, "type");
        let mut poor = hello();
        poor[12 + 64] = 0;
        let (mut wire, _) = UsbRedir::new(&example(Speed::High));
        wire.push(&poor);
        assert_eq!(wire.next_request().unwrap_err().field, "capabilities");
        let error = asked(&mut greeted(), 101, 1, &[0x81]).unwrap_err();
        assert_eq!((error.field, error.found), ("length", 1));
        let mut wire = greeted();
        wire.push(&[101, 0, 0, 0, 255, 255, 255, 255, 0, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(wire.next_request().unwrap_err().found, 0xffff_ffff);
    }
}
