//! Lines with their checksum: out of bytes as they come, and back.

use super::TriggerError;

/// Longest line with its checksum, without its line end, bytes.
pub const MAX_LINE_BYTES: usize = 120;

/// `*` and four digits.
const CHECKSUM_BYTES: usize = 5;

/// CRC-16/IBM-3740 (polynomial 0x1021 from 0xFFFF, not reflected): short enough for the smallest board.
#[must_use]
pub fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ (u16::from(*byte) << 8), |crc, _| (crc << 1) ^ if crc & 0x8000 == 0 { 0 } else { 0x1021 })
    })
}

/// A body with checksum and line end.
#[must_use]
pub fn seal(body: &str) -> String {
    format!("{body}*{:04X}\n", crc16(body.as_bytes()))
}

/// The body of a line without its line end.
fn unseal(line: &[u8]) -> Result<&str, TriggerError> {
    if let Some(offset) = line.iter().position(|byte| !(b' '..=b'~').contains(byte)) {
        return Err(TriggerError::NotText { offset, byte: line[offset] });
    }
    let text = std::str::from_utf8(line).map_err(|_| TriggerError::NoChecksum)?;
    let (body, tail) = text.len().checked_sub(CHECKSUM_BYTES).map_or(("", text), |at| text.split_at(at));
    let digits = tail.strip_prefix('*').filter(|d| d.bytes().all(|b| matches!(b, b'0'..=b'9' | b'A'..=b'F')));
    let found = digits.and_then(|d| u16::from_str_radix(d, 16).ok()).ok_or(TriggerError::NoChecksum)?;
    let expected = crc16(body.as_bytes());
    if found == expected { Ok(body) } else { Err(TriggerError::Checksum { found, expected }) }
}

/// Cuts bytes into lines. Holds at most one line; what is too long is passed over up to its end.
#[derive(Debug, Clone, Default)]
pub struct LineReader {
    line: Vec<u8>,
    is_too_long: bool,
}

impl LineReader {
    /// Takes bytes as they come and hands on the body of every line they complete. Carriage returns before a line end and
    /// empty lines are passed over.
    pub fn feed(&mut self, bytes: &[u8], mut each: impl FnMut(Result<&str, TriggerError>)) {
        for &byte in bytes {
            match byte {
                b'\n' => {
                    let line = self.line.strip_suffix(b"\r").unwrap_or(&self.line);
                    if self.is_too_long || line.len() > MAX_LINE_BYTES {
                        each(Err(TriggerError::TooLong));
                    } else if !line.is_empty() {
                        each(unseal(line));
                    }
                    self.clear();
                }
                // One more than a line, for its carriage return.
                _ if self.line.len() > MAX_LINE_BYTES => self.is_too_long = true,
                _ => self.line.push(byte),
            }
        }
    }

    /// Forgets a line begun, as after a connection was lost.
    pub fn clear(&mut self) {
        self.line.clear();
        self.is_too_long = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Vec<Result<String, TriggerError>> {
        let (mut reader, mut lines) = (LineReader::default(), Vec::new());
        reader.feed(bytes, |line| lines.push(line.map(str::to_owned)));
        lines
    }

    #[test]
    fn checksum_of_the_standards_example() {
        assert_eq!(crc16(b"123456789"), 0x29B1);
        assert_eq!(crc16(b""), 0xFFFF);
    }

    #[test]
    fn lines_come_whole_or_with_their_reason() {
        let good = seal("7 status");
        assert_eq!(read(good.as_bytes()), [Ok("7 status".to_owned())]);
        assert_eq!(read(format!("\r\n\n{}\r\n", good.trim_end()).as_bytes()), [Ok("7 status".to_owned())]);
        assert_eq!(read(b"7 status\n"), [Err(TriggerError::NoChecksum)]);
        assert_eq!(read(b"*\n"), [Err(TriggerError::NoChecksum)]);
        assert_eq!(read(b"7 \xffstatus*0000\n"), [Err(TriggerError::NotText { offset: 2, byte: 0xff })]);
        let expected = crc16(b"7 status");
        assert_eq!(read(b"7 status*0000\n"), [Err(TriggerError::Checksum { found: 0, expected })]);
    }

    #[test]
    fn a_line_without_end_takes_no_more_memory_than_a_line() {
        let mut reader = LineReader::default();
        for _ in 0..1000 {
            reader.feed(&[b'a'; 1000], |_| panic!("no line has ended"));
        }
        assert!(reader.line.capacity() <= 4 * MAX_LINE_BYTES);
        let mut lines = Vec::new();
        reader.feed(format!("\n{}", seal("after")).as_bytes(), |line| lines.push(line.map(str::to_owned)));
        assert_eq!(lines, [Err(TriggerError::TooLong), Ok("after".to_owned())]);
        let longest = "x".repeat(MAX_LINE_BYTES - CHECKSUM_BYTES);
        assert_eq!(read(seal(&longest).as_bytes()), [Ok(longest.clone())]);
        assert_eq!(read(seal(&format!("{longest}x")).as_bytes()), [Err(TriggerError::TooLong)]);
    }
}
