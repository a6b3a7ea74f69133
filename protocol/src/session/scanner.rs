//! A session from its start, record by record: for files without a summary, for verification and recovery.
//!
//! Only the records SESSION.md allows are stepped over, and only if they are consistent in themselves; anything else
//! is damage, after which the next intact chunk or metadata record is searched byte by byte. So a flipped length
//! cannot make a group disappear unnoticed.

use std::io::{Read, Seek};

use mcap::records::op;

use super::METADATA_LIMIT;
use super::bytes::Bytes;
use super::chunk::{CHUNK_FIELDS, ChunkHead};
use super::error::Fault;
use super::metadata::MetadataGroup;
use super::source::{RECORD_HEAD, Source, Span};
use super::summary::DATA_END;

/// Bytes of candidates whose checksum fails, in file lengths, before a scan gives up searching: a damaged chunk costs
/// its own length once, while forged nested ones would make the search quadratic.
const SEARCH_BUDGET: u64 = 8;
/// Fewest and most bytes read at a time while searching: the next record is mostly near.
const SEARCH_BLOCKS: (u64, u64) = (1 << 12, 1 << 16);
/// Longest message index, bytes: a chunk has a handful of messages.
const INDEX_LIMIT: u64 = 16 << 20;

/// What the scanner met.
#[derive(Debug)]
pub(crate) enum Item {
    /// `None` for a metadata record of another program.
    Metadata { offset: u64, group: Option<(String, MetadataGroup)> },
    /// A chunk whose checksum is right.
    Chunk { head: ChunkHead, records: Vec<u8> },
    /// Bytes passed over.
    Damage { span: Span, reason: String },
    /// The data section is complete.
    DataEnd { offset: u64, crc: u32 },
    /// The file ends at a record's boundary before the data section is complete.
    EndOfFile { offset: u64 },
}

pub(crate) struct Scanner<'a, R> {
    source: &'a mut Source<R>,
    at: u64,
    /// What failing candidates may still cost, bytes.
    budget: u64,
}

impl<'a, R: Read + Seek> Scanner<'a, R> {
    /// Starts at the first record after the header.
    pub fn new(source: &'a mut Source<R>, start: u64) -> Self {
        let budget = source.length().saturating_mul(SEARCH_BUDGET);
        Scanner { source, at: start, budget }
    }

    /// The next item; after `DataEnd` or `EndOfFile` there is none to ask for.
    pub fn next(&mut self) -> Result<Item, Fault> {
        loop {
            if self.at >= self.source.length() {
                return Ok(Item::EndOfFile { offset: self.at });
            }
            match self.record() {
                Ok(Some(item)) => return Ok(item),
                Ok(None) => {}
                Err(Fault::Damaged { reason, .. }) => {
                    let offset = self.at;
                    self.at = self.search(offset + 1)?;
                    return Ok(Item::Damage { span: Span { offset, length: self.at - offset }, reason });
                }
                Err(other) => return Err(other),
            }
        }
    }

    /// Handles the record at `self.at` and steps over it; on damage `self.at` stays.
    fn record(&mut self) -> Result<Option<Item>, Fault> {
        let head = self.source.record_head(self.at)?;
        let broken = |reason: &str| Err(Fault::damaged(head.offset, reason));
        let item = match head.opcode {
            op::CHUNK => return self.chunk().map(Some),
            op::METADATA => Some(self.metadata()?),
            op::MESSAGE_INDEX => {
                let body = self.source.read_vec(head.body(), head.length, INDEX_LIMIT)?;
                let mut fields = Bytes(&body);
                if fields.u16().and(fields.counted()).is_none() || !fields.0.is_empty() {
                    return broken("a message index whose sizes do not agree");
                }
                None
            }
            op::DATA_END if head.length == DATA_END - RECORD_HEAD => {
                let mut bytes = [0; 4];
                self.source.read_at(head.body(), &mut bytes)?;
                Some(Item::DataEnd { offset: head.offset, crc: u32::from_le_bytes(bytes) })
            }
            opcode => return broken(&format!("record 0x{opcode:02x} does not belong here")),
        };
        self.at = head.end();
        Ok(item)
    }

    /// A chunk with agreeing sizes but a wrong checksum is stepped over whole: its framing is intact.
    fn chunk(&mut self) -> Result<Item, Fault> {
        let head = ChunkHead::read(self.source, self.at)?;
        let item = match head.read_records(self.source) {
            Ok(records) => Item::Chunk { head, records },
            Err(Fault::Damaged { reason, .. }) => Item::Damage { span: head.span, reason },
            Err(other) => return Err(other),
        };
        self.at = head.span.end();
        Ok(item)
    }

    fn metadata(&mut self) -> Result<Item, Fault> {
        let body = self.source.record_body(self.at, op::METADATA, METADATA_LIMIT)?;
        Ok(Item::Metadata { offset: self.at, group: MetadataGroup::parse(&body, self.at)? })
    }

    /// Where the next intact chunk or metadata record begins, or the end of the file.
    fn search(&mut self, from: u64) -> Result<u64, Fault> {
        let window = RECORD_HEAD + CHUNK_FIELDS;
        let end = self.source.length();
        let (mut step, most) = SEARCH_BLOCKS;
        let mut at = from;
        while at + window <= end {
            let length = (end - at).min(step);
            let block = self.source.read_vec(at, length, most)?;
            for (offset, bytes) in (at..).zip(block.windows(window as usize)) {
                let Some(cost) = self.candidate(offset, bytes) else { continue };
                if self.is_intact(offset, bytes[0])? {
                    return Ok(offset);
                }
                let Some(left) = self.budget.checked_sub(cost) else { return Ok(end) };
                self.budget = left;
            }
            at += length - window + 1;
            step = (2 * step).min(most);
        }
        Ok(end)
    }

    /// Length of the chunk or metadata record that may begin with `bytes`, judged without reading further.
    fn candidate(&self, offset: u64, bytes: &[u8]) -> Option<u64> {
        match bytes[0] {
            op::CHUNK => ChunkHead::parse(offset, bytes).ok().map(|head| head.span.length),
            op::METADATA if bytes[13..].starts_with(b"gv3.") => Bytes(&bytes[1..]).u64(),
            _ => None,
        }
        .filter(|length| offset.saturating_add(*length) <= self.source.length())
    }

    fn is_intact(&mut self, offset: u64, opcode: u8) -> Result<bool, Fault> {
        let read = match opcode {
            op::CHUNK => ChunkHead::read(self.source, offset).and_then(|head| head.read_records(self.source)).map(drop),
            _ => self
                .source
                .record_body(offset, op::METADATA, METADATA_LIMIT)
                .and_then(|body| MetadataGroup::parse(&body, offset))
                .map(drop),
        };
        match read {
            Ok(()) => Ok(true),
            Err(Fault::Damaged { .. }) => Ok(false),
            Err(other) => Err(other),
        }
    }
}
