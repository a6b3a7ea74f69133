//! The end of a finished session: footer, summary section and its checksum.

use std::io::{Read, Seek};

use mcap::records::op;

use super::SUMMARY_LIMIT;
use super::bytes::Bytes;
use super::chunk::check_channel;
use super::error::Fault;
use super::source::{RECORD_HEAD, Source, Span};

/// Footer record and end magic, bytes.
const TAIL: u64 = RECORD_HEAD + 20 + 8;
/// Data end record, bytes.
pub(crate) const DATA_END: u64 = RECORD_HEAD + 4;

/// What a session needs of its summary section.
#[derive(Debug, Default)]
pub(crate) struct Summary {
    /// Chunks in the order of the file.
    pub chunks: Vec<Span>,
    pub metadata: Vec<Span>,
    /// Where the data end record lies, which is where the data section ends.
    pub data_end: u64,
}

/// Reads the summary; `start` is where the first record after the header lies. Damage means the session was not
/// finished (or its end is spoilt) and has to be read from its start.
pub(crate) fn read_summary<R: Read + Seek>(source: &mut Source<R>, start: u64) -> Result<Summary, Fault> {
    let length = source.length();
    let unfinished = || Fault::damaged(length, "the session was not finished: it has no closing summary");
    let footer = length.checked_sub(TAIL).filter(|footer| *footer >= start + DATA_END).ok_or_else(unfinished)?;
    let tail = source.read_vec(footer, TAIL, TAIL)?;
    if !tail.ends_with(mcap::MAGIC) {
        return Err(unfinished());
    }
    let mut fields = Bytes(&tail);
    let head = fields.u8().zip(fields.u64());
    let summary_start = fields.u64();
    fields.u64();
    let (Some((op::FOOTER, 20)), Some(summary_start), Some(crc)) = (head, summary_start, fields.u32()) else {
        return Err(Fault::damaged(footer, "the footer is damaged"));
    };
    if summary_start < start + DATA_END || summary_start > footer {
        return Err(Fault::damaged(footer, "the footer points outside the file"));
    }
    let mut bytes = source.read_vec(summary_start, footer - summary_start, SUMMARY_LIMIT)?;
    let records = bytes.len();
    bytes.extend_from_slice(&tail[..TAIL as usize - 12]);
    let found = crc32fast::hash(&bytes);
    if found != crc {
        let reason = format!("summary checksum {found:08x}, {crc:08x} expected");
        return Err(Fault::damaged(summary_start, reason));
    }
    parse_summary(&bytes[..records], summary_start, start)
}

fn parse_summary(bytes: &[u8], offset: u64, start: u64) -> Result<Summary, Fault> {
    let mut summary = Summary { data_end: offset - DATA_END, ..Summary::default() };
    let mut rest = Bytes(bytes);
    while !rest.0.is_empty() {
        let at = offset + (bytes.len() - rest.0.len()) as u64;
        let torn = || Fault::damaged(at, "a summary record does not parse");
        let opcode = rest.u8().ok_or_else(torn)?;
        let length = rest.u64().and_then(|length| usize::try_from(length).ok()).ok_or_else(torn)?;
        let body = rest.slice(length).ok_or_else(torn)?;
        let mut fields = Bytes(body);
        match opcode {
            op::CHANNEL => check_channel(body, at)?,
            op::CHUNK_INDEX => {
                fields.slice(16).ok_or_else(torn)?;
                let span = span(&mut fields).ok_or_else(torn)?;
                let previous = summary.chunks.last().map_or(start, Span::end);
                inside(span, previous, summary.data_end, at)?;
                summary.chunks.push(span);
            }
            op::METADATA_INDEX => {
                let span = span(&mut fields).ok_or_else(torn)?;
                inside(span, start, summary.data_end, at)?;
                summary.metadata.push(span);
            }
            _ => {}
        }
    }
    Ok(summary)
}

fn span(fields: &mut Bytes) -> Option<Span> {
    Some(Span { offset: fields.u64()?, length: fields.u64()? })
}

fn inside(span: Span, start: u64, end: u64, at: u64) -> Result<(), Fault> {
    if span.offset < start || span.end() > end {
        return Err(Fault::damaged(at, "an index record points outside the data or out of order"));
    }
    Ok(())
}
