//! A session's bytes at offsets: record framing and bounded reads over any `Read + Seek`.

use std::io::{Read, Seek, SeekFrom};

use super::error::Fault;

/// Opcode and length in front of every MCAP record, bytes.
pub(crate) const RECORD_HEAD: u64 = 9;

/// Opcode and extent of one MCAP record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RecordHead {
    pub offset: u64,
    pub opcode: u8,
    /// Bytes after the head.
    pub length: u64,
}

impl RecordHead {
    pub fn body(&self) -> u64 {
        self.offset.saturating_add(RECORD_HEAD)
    }

    pub fn end(&self) -> u64 {
        self.body().saturating_add(self.length)
    }
}

/// Extent of a record, head included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Span {
    pub offset: u64,
    pub length: u64,
}

impl Span {
    pub fn end(&self) -> u64 {
        self.offset.saturating_add(self.length)
    }
}

/// A seekable source and its length when it was measured last.
pub(crate) struct Source<R> {
    inner: R,
    /// Where `inner` stands; a seek to the place already reached costs no system call.
    position: u64,
    length: u64,
}

impl<R: Read + Seek> Source<R> {
    pub fn new(mut inner: R) -> std::io::Result<Self> {
        let length = inner.seek(SeekFrom::End(0))?;
        Ok(Source { inner, position: length, length })
    }

    pub fn length(&self) -> u64 {
        self.length
    }

    /// Takes the length as it is now.
    pub fn measure(&mut self) -> std::io::Result<()> {
        self.position = u64::MAX;
        self.length = self.inner.seek(SeekFrom::End(0))?;
        self.position = self.length;
        Ok(())
    }

    /// Fills `buffer` from `offset`; bytes past the end are damage, not end of file.
    pub fn read_at(&mut self, offset: u64, buffer: &mut [u8]) -> Result<(), Fault> {
        let end = offset.saturating_add(buffer.len() as u64);
        if end > self.length {
            return Err(Fault::damaged(offset, format!("the file ends {} bytes early", end - self.length)));
        }
        if self.position != offset {
            // An interrupted read leaves the place unknown, so it is set only after success.
            self.position = u64::MAX;
            self.inner.seek(SeekFrom::Start(offset))?;
        }
        self.position = u64::MAX;
        self.inner.read_exact(buffer)?;
        self.position = end;
        Ok(())
    }

    /// Reads `length` bytes; the limit and the file's own length are checked before allocating.
    pub fn read_vec(&mut self, offset: u64, length: u64, limit: u64) -> Result<Vec<u8>, Fault> {
        if length > limit {
            return Err(Fault::damaged(offset, format!("{length} bytes claimed, the limit is {limit}")));
        }
        let end = offset.saturating_add(length);
        if end > self.length {
            return Err(Fault::damaged(offset, format!("the file ends {} bytes early", end - self.length)));
        }
        let size = usize::try_from(length).map_err(|_| Fault::damaged(offset, "longer than this machine addresses"))?;
        let mut bytes = vec![0; size];
        self.read_at(offset, &mut bytes)?;
        Ok(bytes)
    }

    /// Opcode and length at `offset`; the record must end inside the file.
    pub fn record_head(&mut self, offset: u64) -> Result<RecordHead, Fault> {
        let mut bytes = [0; RECORD_HEAD as usize];
        self.read_at(offset, &mut bytes)?;
        let [opcode, length @ ..] = bytes;
        let head = RecordHead { offset, opcode, length: u64::from_le_bytes(length) };
        if head.end() > self.length {
            return Err(Fault::damaged(
                offset,
                format!("a record of {} bytes runs past the end of the file", head.length),
            ));
        }
        Ok(head)
    }

    /// Body of a record, if its opcode is the expected one.
    pub fn record_body(&mut self, offset: u64, opcode: u8, limit: u64) -> Result<Vec<u8>, Fault> {
        let head = self.record_head(offset)?;
        if head.opcode != opcode {
            return Err(Fault::damaged(
                offset,
                format!("record 0x{:02x} where 0x{opcode:02x} was expected", head.opcode),
            ));
        }
        self.read_vec(head.body(), head.length, limit)
    }

    /// CRC-32 of `[start, end)`, read in blocks.
    pub fn crc(&mut self, start: u64, end: u64) -> Result<u32, Fault> {
        let mut hasher = crc32fast::Hasher::new();
        let mut block = vec![0; 1 << 16];
        let mut at = start;
        while at < end {
            let take = (end - at).min(block.len() as u64) as usize;
            self.read_at(at, &mut block[..take])?;
            hasher.update(&block[..take]);
            at += take as u64;
        }
        Ok(hasher.finalize())
    }
}
