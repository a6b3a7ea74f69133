//! Framing: a request in one or more reports, a reply in one.

use super::{Dlpc350Error, MAX_MESSAGE_BYTES, MAX_REPLY_BYTES, REPORT_BYTES, Register, Result};

/// A HID report. Its report number is 0 and not among the bytes: hidraw wants it written in front.
pub type Report = [u8; REPORT_BYTES];

const READ: u8 = 0x80;
const REPLY_WANTED: u8 = 0x40;
const NACK: u8 = 0x20;
const HEADER_BYTES: usize = 4;
const COMMAND_BYTES: usize = 2;

/// What a request wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestKind {
    /// To set, with an answer that says whether it was done.
    Write,
    /// To set, without an answer.
    WriteUnanswered,
    /// To know.
    Read,
}

/// A message to the projector.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// What it wants.
    pub kind: RequestKind,
    /// Number that the reply repeats.
    pub sequence: u8,
    /// The command: high byte is TI's CMD2, low byte CMD3.
    pub command: u16,
    /// What follows the command.
    pub payload: Vec<u8>,
}

impl Request {
    /// Sets a register.
    pub fn write<R: Register>(sequence: u8, value: &R) -> Self {
        Self { kind: RequestKind::Write, sequence, command: R::COMMAND, payload: value.encode() }
    }

    /// Asks for a register.
    pub fn read<R: Register>(sequence: u8) -> Self {
        Self { kind: RequestKind::Read, sequence, command: R::COMMAND, payload: Vec::new() }
    }

    /// The reports to send, in order; only the first has a header.
    ///
    /// # Errors
    /// [`Dlpc350Error::MessageSize`] when command and payload exceed [`MAX_MESSAGE_BYTES`].
    pub fn reports(&self) -> Result<Vec<Report>> {
        let length = COMMAND_BYTES + self.payload.len();
        if length > MAX_MESSAGE_BYTES {
            return Err(Dlpc350Error::MessageSize { found: length, expected: "at most 512" });
        }
        let flags = match self.kind {
            RequestKind::Write => REPLY_WANTED,
            RequestKind::WriteUnanswered => 0,
            RequestKind::Read => READ | REPLY_WANTED,
        };
        let mut bytes = vec![flags, self.sequence];
        bytes.extend((length as u16).to_le_bytes());
        bytes.extend(self.command.to_le_bytes());
        bytes.extend(&self.payload);
        Ok(bytes.chunks(REPORT_BYTES).map(padded).collect())
    }
}

fn padded(bytes: &[u8]) -> Report {
    let mut report = [0; REPORT_BYTES];
    report[..bytes.len()].copy_from_slice(bytes);
    report
}

/// The projector's side of [`Request::reports`]: reports in, whole requests out.
#[derive(Debug, Clone, Default)]
pub struct RequestAssembler {
    /// Header and what came of the message, while more is to come.
    bytes: Vec<u8>,
}

impl RequestAssembler {
    /// Takes the next report; gives the request that it completes.
    ///
    /// # Errors
    /// [`Dlpc350Error::MessageSize`] for an impossible length; the next report is then taken as the start of a request.
    pub fn push(&mut self, report: &Report) -> Result<Option<Request>> {
        self.bytes.extend(report);
        let length = usize::from(u16::from_le_bytes([self.bytes[2], self.bytes[3]]));
        if !(COMMAND_BYTES..=MAX_MESSAGE_BYTES).contains(&length) {
            self.bytes.clear();
            return Err(Dlpc350Error::MessageSize { found: length, expected: "2 to 512" });
        }
        if self.bytes.len() < HEADER_BYTES + length {
            return Ok(None);
        }
        let bytes = std::mem::take(&mut self.bytes);
        let kind = match bytes[0] & (READ | REPLY_WANTED) {
            REPLY_WANTED => RequestKind::Write,
            0 => RequestKind::WriteUnanswered,
            _ => RequestKind::Read,
        };
        let payload = bytes[HEADER_BYTES + COMMAND_BYTES..HEADER_BYTES + length].to_vec();
        Ok(Some(Request { kind, sequence: bytes[1], command: u16::from_le_bytes([bytes[4], bytes[5]]), payload }))
    }
}

/// The projector's answer, always one report.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reply {
    /// Whether it answers a read.
    pub is_read: bool,
    /// Refused.
    pub is_nack: bool,
    /// Number of the request it answers.
    pub sequence: u8,
    /// What was asked for; empty after a write.
    pub data: Vec<u8>,
}

impl Reply {
    /// Reads a report as it came from the device.
    ///
    /// # Errors
    /// [`Dlpc350Error::ReportSize`] or, for a length that does not fit into a report, [`Dlpc350Error::MessageSize`].
    pub fn parse(report: &[u8]) -> Result<Self> {
        let report: &Report = report.try_into().map_err(|_| Dlpc350Error::ReportSize { found: report.len() })?;
        let is_read = report[0] & READ != 0;
        let is_nack = report[0] & NACK != 0;
        let length = usize::from(u16::from_le_bytes([report[2], report[3]]));
        // An acknowledged write may repeat the length of its request: only a read has data.
        let data = match (is_read, length) {
            (false, _) => Vec::new(),
            (true, 0..=MAX_REPLY_BYTES) => report[HEADER_BYTES..HEADER_BYTES + length].to_vec(),
            (true, found) => return Err(Dlpc350Error::MessageSize { found, expected: "at most 60" }),
        };
        // TI's own software takes a read without data for a refusal.
        Ok(Self { is_read, is_nack: is_nack || (is_read && length == 0), sequence: report[1], data })
    }

    /// The report; data beyond [`MAX_REPLY_BYTES`] is cut off.
    pub fn encode(&self) -> Report {
        let data = &self.data[..self.data.len().min(MAX_REPLY_BYTES)];
        let flags = REPLY_WANTED | if self.is_read { READ } else { 0 } | if self.is_nack { NACK } else { 0 };
        let mut bytes = vec![flags, self.sequence, data.len() as u8, 0];
        bytes.extend(data);
        padded(&bytes)
    }

    /// Whether it is the answer to `request` and not to an earlier one.
    pub fn answers(&self, request: &Request) -> bool {
        self.sequence == request.sequence && self.is_read == (request.kind == RequestKind::Read)
    }
}
