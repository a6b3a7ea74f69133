//! USB/IP 1.1.1, the device's side: how Linux plugs in devices over TCP (Documentation/usb/usbip_protocol.rst of Linux).
//!
//! All numbers are big-endian. A connection begins with operations ([`Operation`]: list, import); after an import it carries
//! transfers ([`UsbIp`]).

use super::bus::{Completion, Outcome, Request};
use super::connection::Wire;
use super::{Descriptors, MAX_TRANSFER_BYTES, Setup, WireError};

/// Version 1.1.1 in the header of operations.
const VERSION: u16 = 0x0111;
/// Bytes before the data of every transfer message.
const HEADER_BYTES: usize = 48;
/// Bytes a packet of an isochronous transfer is described with, and the most packets.
const ISO_BYTES: usize = 16;
const MAX_ISO_PACKETS: u32 = 1024;
/// Status codes of Linux, negated.
const EPIPE: i32 = -32;
const ECONNRESET: i32 = -104;

/// What a client asks for before it has a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Operation {
    /// The devices there are.
    List,
    /// The device of a bus id.
    Import(String),
}

impl Operation {
    /// Reads an operation from the start of a stream; none while bytes are missing, else also how many bytes it took.
    ///
    /// # Errors
    /// [`WireError`] for another version or an unknown operation.
    pub fn read(bytes: &[u8]) -> Result<Option<(Self, usize)>, WireError> {
        let error = |offset, field, found: u16, reason| WireError { offset, field, found: found.into(), reason };
        let Some(&[v0, v1, c0, c1, _, _, _, _]) = bytes.first_chunk() else { return Ok(None) };
        let (version, code) = (u16::from_be_bytes([v0, v1]), u16::from_be_bytes([c0, c1]));
        if version != VERSION {
            return Err(error(0, "version", version, "only 0x0111 is spoken here"));
        }
        match (code, bytes.get(8..40)) {
            (0x8005, _) => Ok(Some((Self::List, 8))),
            (0x8003, Some(id)) => {
                let length = id.iter().position(|b| *b == 0).unwrap_or(id.len());
                Ok(Some((Self::Import(String::from_utf8_lossy(&id[..length]).into_owned()), 40)))
            }
            (0x8003, None) => Ok(None),
            _ => Err(error(2, "operation", code, "list (0x8005) or import (0x8003)")),
        }
    }
}

/// A device as a list of them shows it.
fn device_record(bus_id: &str, number: u32, descriptors: &Descriptors) -> Vec<u8> {
    let mut record = vec![0; 288];
    let path = format!("/sys/devices/gv3/{bus_id}");
    record[..path.len().min(255)].copy_from_slice(&path.as_bytes()[..path.len().min(255)]);
    record[256..256 + bus_id.len().min(31)].copy_from_slice(&bus_id.as_bytes()[..bus_id.len().min(31)]);
    for value in [1, number, descriptors.speed.linux_code()] {
        record.extend(value.to_be_bytes());
    }
    let identity = &descriptors.identity;
    for value in [identity.vendor_id, identity.product_id, identity.release] {
        record.extend(value.to_be_bytes());
    }
    record.extend(identity.class);
    // Configuration in use, configurations, interfaces.
    record.extend([1, 1, descriptors.interfaces().len() as u8]);
    record
}

/// Answer to [`Operation::List`]: bus id, number and descriptors of every device.
pub fn list_reply<'a>(devices: impl ExactSizeIterator<Item = (&'a str, u32, &'a Descriptors)>) -> Vec<u8> {
    let mut reply = [VERSION.to_be_bytes(), 0x0005u16.to_be_bytes()].concat();
    reply.extend(0u32.to_be_bytes());
    reply.extend((devices.len() as u32).to_be_bytes());
    for (bus_id, number, descriptors) in devices {
        reply.extend(device_record(bus_id, number, descriptors));
        for class in descriptors.interfaces() {
            reply.extend([class[0], class[1], class[2], 0]);
        }
    }
    reply
}

/// Why an import is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// Someone else has it.
    Busy,
    /// There is none of this bus id.
    Unknown,
}

/// Answer to [`Operation::Import`].
pub fn import_reply(device: Result<(&str, u32, &Descriptors), Refusal>) -> Vec<u8> {
    let mut reply = [VERSION.to_be_bytes(), 0x0003u16.to_be_bytes()].concat();
    let status: u32 = match device {
        Ok(_) => 0,
        Err(Refusal::Busy) => 2,
        Err(Refusal::Unknown) => 4,
    };
    reply.extend(status.to_be_bytes());
    if let Ok((bus_id, number, descriptors)) = device {
        reply.extend(device_record(bus_id, number, descriptors));
    }
    reply
}

/// Transfers of an imported device.
#[derive(Debug, Default)]
pub struct UsbIp {
    buffer: Vec<u8>,
    /// Bytes of the stream before the buffer, for errors.
    consumed: u64,
}

impl UsbIp {
    fn error(&self, at: usize, field: &'static str, found: u32, reason: &'static str) -> WireError {
        WireError { offset: self.consumed + at as u64, field, found: found.into(), reason }
    }

    /// A submitted transfer; none while its data is missing.
    fn submitted(&self, header: &[u8; HEADER_BYTES]) -> Result<Option<(Request, usize)>, WireError> {
        let word = |i: usize| u32::from_be_bytes([header[i], header[i + 1], header[i + 2], header[i + 3]]);
        let (id, is_in, endpoint) = (u64::from(word(4)), word(12) == 1, word(16));
        let (length, packets) = (word(24), word(32));
        if word(12) > 1 {
            return Err(self.error(12, "direction", word(12), "0 (out) or 1 (in)"));
        }
        if endpoint > 15 {
            return Err(self.error(16, "endpoint", endpoint, "0 ..= 15"));
        }
        if length > MAX_TRANSFER_BYTES {
            return Err(self.error(24, "transfer_buffer_length", length, "at most 16 MiB"));
        }
        // Absent packets are 0 or -1, as the kernel's version has it.
        let packets = if packets == u32::MAX { 0 } else { packets };
        if packets > MAX_ISO_PACKETS {
            return Err(self.error(32, "number_of_packets", packets, "at most 1024"));
        }
        let data_bytes = if is_in { 0 } else { length as usize };
        let total = HEADER_BYTES + data_bytes + packets as usize * ISO_BYTES;
        let Some(data) = self.buffer.get(HEADER_BYTES..total).map(|d| d[..data_bytes].to_vec()) else {
            return Ok(None);
        };
        let endpoint = endpoint as u8;
        let request = match (endpoint, packets, is_in) {
            (0, 0, _) => {
                let [.., a, b, c, d, e, f, g, h] = *header;
                Request::Control { id, setup: Setup::new([a, b, c, d, e, f, g, h]), data }
            }
            (_, 0, true) => Request::In { id, endpoint, max_bytes: length },
            (_, 0, false) => Request::Out { id, endpoint, data },
            _ => Request::Unsupported { id, endpoint },
        };
        Ok(Some((request, total)))
    }
}

impl Wire for UsbIp {
    fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    fn next_request(&mut self) -> Result<Option<Request>, WireError> {
        let Some(header) = self.buffer.first_chunk::<HEADER_BYTES>() else { return Ok(None) };
        let word = |i: usize| u32::from_be_bytes([header[i], header[i + 1], header[i + 2], header[i + 3]]);
        let found = match word(0) {
            1 => self.submitted(header)?,
            2 => Some((Request::Cancel { id: word(4).into(), victim: word(20).into() }, HEADER_BYTES)),
            command => return Err(self.error(0, "command", command, "submit (1) or unlink (2)")),
        };
        Ok(found.map(|(request, taken)| {
            self.buffer.drain(..taken);
            self.consumed += taken as u64;
            request
        }))
    }

    fn write(&mut self, completion: &Completion, out: &mut Vec<u8>) {
        let (command, status, length, data): (u32, i32, usize, &[u8]) = match &completion.outcome {
            Outcome::Taken(bytes) => (3, 0, *bytes as usize, &[]),
            Outcome::Data(data) => (3, 0, data.len(), data),
            Outcome::Stall => (3, EPIPE, 0, &[]),
            // Zero says that the transfer's own answer is on its way.
            Outcome::Cancelled { was_waiting, .. } => (4, if *was_waiting { ECONNRESET } else { 0 }, 0, &[]),
            // Hosts of this wire poll by transfers.
            Outcome::Polled(_) | Outcome::PollSet => return,
        };
        for word in [command, completion.id as u32, 0, 0, 0, status as u32, length as u32, 0, 0, 0, 0, 0] {
            out.extend(word.to_be_bytes());
        }
        out.extend_from_slice(data);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::usb_device::Speed;
    use crate::usb_device::descriptor::tests::example;
    use proptest::prelude::*;

    fn submit(id: u32, is_in: bool, endpoint: u32, length: u32, packets: u32, setup: [u8; 8]) -> Vec<u8> {
        let words = [1, id, 0x10002, is_in.into(), endpoint, 0x200, length, 0, packets, 0];
        words.iter().flat_map(|w: &u32| w.to_be_bytes()).chain(setup).collect()
    }

    fn requests(bytes: &[u8]) -> Result<Vec<Request>, WireError> {
        let mut wire = UsbIp::default();
        wire.push(bytes);
        let mut all = Vec::new();
        while let Some(request) = wire.next_request()? {
            all.push(request);
        }
        Ok(all)
    }

    /// The messages of the examples in the protocol's page.
    #[test]
    fn golden_messages() {
        let get_descriptor = [0x80, 6, 0, 1, 0, 0, 0x40, 0];
        let bytes = hex(
            "00000001 00000d05 0001000f 00000001 00000001 00000200 00000040 ffffffff 00000000 00000004 0000000000000000",
        );
        assert_eq!(requests(&bytes).unwrap(), [Request::In { id: 0xd05, endpoint: 1, max_bytes: 64 }]);
        let mut answer = Vec::new();
        let completion =
            Completion { id: 0xd05, endpoint: 1, outcome: Outcome::Data(hex("ffffffff860011a784ce5ae2376312891b")) };
        UsbIp::default().write(&completion, &mut answer);
        let expected = "00000003 00000d05 00000000 00000000 00000000 00000000 00000011 00000000 00000000 00000000 0000000000000000 ffffffff860011a784ce5ae2376312891b";
        assert_eq!(answer, hex(expected));
        let control = submit(2, true, 0, 64, u32::MAX, get_descriptor);
        let setup = Setup { request_type: 0x80, request: 6, value: 0x0100, index: 0, length: 64 };
        assert_eq!(requests(&control).unwrap(), [Request::Control { id: 2, setup, data: vec![] }]);
        let unlink = hex(
            "00000002 00000006 00010002 00000000 00000000 00000005 000000000000000000000000000000000000000000000000",
        );
        assert_eq!(requests(&unlink).unwrap(), [Request::Cancel { id: 6, victim: 5 }]);
        let mut answer = Vec::new();
        let outcome = Outcome::Cancelled { victim: 5, was_waiting: true };
        UsbIp::default().write(&Completion { id: 6, endpoint: 1, outcome }, &mut answer);
        assert_eq!(answer[..24], hex("00000004 00000006 00000000 00000000 00000000 ffffff98"));
        assert_eq!(answer.len(), 48);
    }

    fn hex(text: &str) -> Vec<u8> {
        let digits: Vec<u8> = text.bytes().filter_map(|b| (b as char).to_digit(16)).map(|d| d as u8).collect();
        digits.chunks(2).map(|d| d[0] << 4 | d[1]).collect()
    }

    #[test]
    fn operations() {
        assert_eq!(Operation::read(&hex("0111 8005 00000000")).unwrap(), Some((Operation::List, 8)));
        let mut import = hex("0111 8003 00000000");
        import.extend(b"1-2");
        import.resize(39, 0);
        assert_eq!(Operation::read(&import).unwrap(), None);
        import.push(0);
        assert_eq!(Operation::read(&import).unwrap(), Some((Operation::Import("1-2".into()), 40)));
        assert_eq!(Operation::read(&hex("0106 8005 00000000")).unwrap_err().field, "version");
        assert_eq!(Operation::read(&hex("0111 8004 00000000")).unwrap_err().field, "operation");
        let descriptors = example(Speed::High);
        let list = list_reply([("1-1", 2, &descriptors)].into_iter());
        assert_eq!(list[..12], hex("0111 0005 00000000 00000001"));
        assert_eq!(list.len(), 12 + 312 + 4);
        assert_eq!(list[12 + 288..], hex("00000001 00000002 00000003 1209 0001 0102 ff0000 01 01 01 ff010200"));
        let granted = import_reply(Ok(("1-1", 2, &descriptors)));
        assert_eq!((granted.len(), &granted[8..]), (8 + 312, &list[12..12 + 312]));
        assert_eq!(import_reply(Err(Refusal::Busy)), hex("0111 0003 00000002"));
    }

    #[test]
    fn limits_hold_before_any_allocation() {
        let field = |bytes: Vec<u8>| requests(&bytes).unwrap_err().field;
        assert_eq!(field(submit(1, false, 1, MAX_TRANSFER_BYTES + 1, 0, [0; 8])), "transfer_buffer_length");
        assert_eq!(field(submit(1, true, 1, u32::MAX, 0, [0; 8])), "transfer_buffer_length");
        assert_eq!(field(submit(1, true, 1, 64, 1025, [0; 8])), "number_of_packets");
        assert_eq!(field(submit(1, true, 16, 64, 0, [0; 8])), "endpoint");
        assert_eq!(field(vec![0; 48]), "command");
        let mut second = submit(1, true, 1, 64, 0, [0; 8]);
        second.extend([0xff; 48]);
        assert_eq!(requests(&second).unwrap_err().offset, 48);
    }

    #[test]
    fn isochronous_transfers_are_read_over_and_refused() {
        let mut bytes = submit(1, true, 2, 64, 2, [0; 8]);
        bytes.extend([0; 2 * ISO_BYTES]);
        bytes.extend(submit(2, true, 1, 64, 0, [0; 8]));
        let expected = [Request::Unsupported { id: 1, endpoint: 2 }, Request::In { id: 2, endpoint: 1, max_bytes: 64 }];
        assert_eq!(requests(&bytes).unwrap(), expected);
    }

    proptest! {
        #[test]
        fn any_cut_of_the_stream_gives_the_same_requests(
            lengths in prop::collection::vec((0u32..200, any::<bool>(), 0u32..16), 1..12),
            cut in 1usize..97,
        ) {
            let mut bytes = Vec::new();
            for (id, &(length, is_in, endpoint)) in lengths.iter().enumerate() {
                bytes.extend(submit(id as u32, is_in, endpoint, length, 0, [id as u8; 8]));
                if !is_in {
                    bytes.extend((0..length).map(|k| k as u8));
                }
            }
            let mut wire = UsbIp::default();
            let mut found = Vec::new();
            for part in bytes.chunks(cut) {
                wire.push(part);
                while let Some(request) = wire.next_request().unwrap() {
                    found.push(request);
                }
            }
            prop_assert_eq!(found.len(), lengths.len());
            prop_assert_eq!(found, requests(&bytes).unwrap());
        }
    }
}
