//! USB devices in software: what a device is, its transfers, and the two wires it can be plugged in by.
//!
//! ```text
//! socket --bytes--> wire (usbip or usbredir) --Request--> bus --transfers--> UsbDevice
//! socket <--bytes-- wire <--Completion-- bus <--transfers-- UsbDevice
//! ```
//! Everything but [`connection`] and [`server`] is free of input and output: bytes in, bytes out.

pub mod bus;
pub mod connection;
pub mod descriptor;
pub mod server;
pub mod usbip;
pub mod usbredir;

pub use bus::{Bus, Completion, Outcome, Request};
pub use connection::Session;
pub use descriptor::{Configuration, Descriptors, Speed};

/// Most bytes of one transfer from the host; the largest that usbfs passes on.
pub const MAX_TRANSFER_BYTES: u32 = 16 << 20;

/// Bytes of a peer that break the protocol; the connection ends with it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("byte {offset} of the stream: {field} is {found}: {reason}")]
pub struct WireError {
    /// Bytes of the stream before the message at fault.
    pub offset: u64,
    /// Field of the message.
    pub field: &'static str,
    /// What stands there.
    pub found: u64,
    /// What may stand there.
    pub reason: &'static str,
}

/// The eight bytes that begin a control transfer (USB 2.0, table 9-2).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setup {
    /// Direction (bit 7: to the host), type (bits 6..5) and recipient (bits 4..0).
    pub request_type: u8,
    /// The request.
    pub request: u8,
    /// Its parameter.
    pub value: u16,
    /// Its second parameter: interface, endpoint, or entity and interface.
    pub index: u16,
    /// Bytes of data that follow or are wanted.
    pub length: u16,
}

impl Setup {
    /// Reads the eight bytes.
    pub fn new(bytes: [u8; 8]) -> Self {
        let u16_at = |i: usize| u16::from_le_bytes([bytes[i], bytes[i + 1]]);
        Self { request_type: bytes[0], request: bytes[1], value: u16_at(2), index: u16_at(4), length: u16_at(6) }
    }

    /// The eight bytes.
    pub fn to_bytes(self) -> [u8; 8] {
        let [v, i, l] = [self.value, self.index, self.length].map(u16::to_le_bytes);
        [self.request_type, self.request, v[0], v[1], i[0], i[1], l[0], l[1]]
    }

    /// Data goes to the host.
    pub fn is_in(&self) -> bool {
        self.request_type & 0x80 != 0
    }
}

/// Answer to a control transfer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ControlReply {
    /// Data for the host; cut to what it asked for.
    Data(Vec<u8>),
    /// Done, nothing to say.
    Done,
    /// The request is not known or not possible.
    Stall,
}

/// Answer to a transfer that wants data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Transmit {
    /// Nothing yet: the transfer waits.
    Nothing,
    /// Bytes, no more than were asked for; fewer end the transfer, as a short packet does.
    Data(Vec<u8>),
    /// The endpoint has halted.
    Stall,
}

/// A device behind its descriptors. It never blocks: what it cannot give yet is asked for again.
pub trait UsbDevice: Send {
    /// What the host is told.
    fn descriptors(&self) -> &Descriptors;
    /// A control transfer, standard requests included; [`Descriptors::answer`] knows those.
    fn control(&mut self, setup: &Setup, data: &[u8]) -> ControlReply;
    /// Data for OUT endpoint `endpoint` (1..=15); false halts it.
    fn receive(&mut self, endpoint: u8, data: &[u8]) -> bool;
    /// At most `max_bytes` from IN endpoint `endpoint` (1..=15).
    fn transmit(&mut self, endpoint: u8, max_bytes: usize) -> Transmit;
    /// A host has come or gone, or resets the bus.
    fn reset(&mut self) {}
    /// The cable is to be pulled; asked for after every change, and true once a pull.
    fn take_unplug(&mut self) -> bool {
        false
    }
}

/// A message on its way to the host, in as many transfers as it takes.
#[derive(Debug, Default)]
pub struct Outgoing {
    bytes: Vec<u8>,
    sent: usize,
    ends_full: bool,
}

impl Outgoing {
    /// A message that ends with a short transfer, if need be an empty one.
    pub fn new(bytes: Vec<u8>) -> Self {
        Self { bytes, sent: 0, ends_full: false }
    }

    /// Bytes of a stream without ends.
    pub fn stream(bytes: Vec<u8>) -> Self {
        Self { bytes, sent: 0, ends_full: true }
    }

    /// The next transfer and whether it is the last.
    pub fn next(&mut self, max_bytes: usize) -> (Vec<u8>, bool) {
        let end = self.sent + max_bytes.min(self.bytes.len() - self.sent);
        let part = self.bytes[self.sent..end].to_vec();
        self.sent = end;
        let is_last = end == self.bytes.len() && (self.ends_full || part.len() < max_bytes);
        (part, is_last)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn setup_bytes_round_trip() {
        let bytes = [0xa1, 0x81, 0x00, 0x02, 0x01, 0x00, 0x1a, 0x00];
        let setup = Setup::new(bytes);
        assert_eq!((setup.request_type, setup.request, setup.value, setup.index), (0xa1, 0x81, 0x0200, 1));
        assert_eq!((setup.length, setup.is_in(), setup.to_bytes()), (26, true, bytes));
    }

    #[test]
    fn messages_end_short_and_streams_do_not() {
        let mut message = Outgoing::new(vec![7; 8]);
        assert_eq!(message.next(4), (vec![7; 4], false));
        assert_eq!(message.next(4), (vec![7; 4], false));
        assert_eq!(message.next(4), (vec![], true));
        let mut stream = Outgoing::stream(vec![7; 8]);
        assert_eq!(stream.next(4), (vec![7; 4], false));
        assert_eq!(stream.next(4), (vec![7; 4], true));
        assert_eq!(Outgoing::new(vec![7; 3]).next(4), (vec![7; 3], true));
    }
}
