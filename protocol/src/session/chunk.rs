//! One chunk: its head, its checksum, and the messages in it.

use std::io::{Read, Seek};

use mcap::records::op;

use super::bytes::Bytes;
use super::envelope::{self, EnvelopeError, Head, Kind};
use super::error::Fault;
use super::source::{RECORD_HEAD, RecordHead, Source, Span};
use super::{CHANNELS, CHUNK_LIMIT, EVENT, GROUP, STREAM, TELEMETRY, TEXTURE};

/// Chunk fields before the records when the name of the compression is empty, bytes.
pub(crate) const CHUNK_FIELDS: u64 = 40;
/// Message fields before the data, bytes.
const MESSAGE_FIELDS: u64 = 22;

/// Where a chunk and its records lie, and the checksum of the records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ChunkHead {
    pub span: Span,
    pub records: Span,
    pub crc: u32,
}

impl ChunkHead {
    /// Parses the first [`RECORD_HEAD`] + [`CHUNK_FIELDS`] bytes of a chunk at `offset`. The record's length and its
    /// two sizes must agree, so one flipped bit in any of them is found.
    pub fn parse(offset: u64, bytes: &[u8]) -> Result<Self, Fault> {
        let broken = |reason: &str| Fault::damaged(offset, reason);
        let short = || broken("the file ends inside a chunk's head");
        let mut fields = Bytes(bytes);
        if fields.u8().ok_or_else(short)? != op::CHUNK {
            return Err(broken("no chunk where one was expected"));
        }
        let length = fields.u64().ok_or_else(short)?;
        fields.slice(16).ok_or_else(short)?;
        let records = fields.u64().ok_or_else(short)?;
        let crc = fields.u32().ok_or_else(short)?;
        if fields.u32().ok_or_else(short)? != 0 {
            return Err(broken("the chunk is compressed by another program or its head is damaged"));
        }
        let stored = fields.u64().ok_or_else(short)?;
        if stored != records || length != records.saturating_add(CHUNK_FIELDS) {
            return Err(broken("the sizes in the chunk's head do not agree"));
        }
        if records > CHUNK_LIMIT {
            return Err(broken("the chunk is longer than the limit of 256 MiB"));
        }
        let start = offset.saturating_add(RECORD_HEAD + CHUNK_FIELDS);
        Ok(ChunkHead {
            span: Span { offset, length: RECORD_HEAD + length },
            records: Span { offset: start, length: records },
            crc,
        })
    }

    pub fn read<R: Read + Seek>(source: &mut Source<R>, offset: u64) -> Result<Self, Fault> {
        let mut bytes = [0; (RECORD_HEAD + CHUNK_FIELDS) as usize];
        source.read_at(offset, &mut bytes)?;
        let head = Self::parse(offset, &bytes)?;
        if head.span.end() > source.length() {
            return Err(Fault::damaged(
                offset,
                format!("the file ends {} bytes before the chunk does", head.span.end() - source.length()),
            ));
        }
        Ok(head)
    }

    /// The chunk's records, their checksum checked.
    pub fn read_records<R: Read + Seek>(&self, source: &mut Source<R>) -> Result<Vec<u8>, Fault> {
        let records = source.read_vec(self.records.offset, self.records.length, CHUNK_LIMIT)?;
        let found = crc32fast::hash(&records);
        if found != self.crc {
            let reason = format!("chunk checksum {found:08x}, {:08x} expected", self.crc);
            return Err(Fault::damaged(self.span.offset, reason));
        }
        Ok(records)
    }
}

/// A binary message: its envelope's head and its payload.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sealed<P> {
    pub head: Head,
    pub time_nanos: u64,
    pub payload: P,
}

/// A JSON message.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Json<P> {
    /// Identifier of the event or the telemetry channel.
    pub channel: u16,
    pub time_nanos: u64,
    pub text: P,
    /// Where the message record lies in the file.
    pub offset: u64,
}

/// What a chunk holds: a stream header, or a group with its texture, and JSON beside either. With `P = ()` only the
/// heads are known.
#[derive(Debug)]
pub(crate) struct Parts<P> {
    pub stream: Option<Sealed<P>>,
    pub group: Option<Sealed<P>>,
    pub texture: Option<Sealed<P>>,
    pub json: Vec<Json<P>>,
}

/// Payloads and all, borrowed from the chunk's records.
pub(crate) type Content<'a> = Parts<&'a [u8]>;

impl<P> Parts<P> {
    fn new() -> Self {
        Parts { stream: None, group: None, texture: None, json: Vec::new() }
    }

    fn add(&mut self, part: Sealed<P>, offset: u64) -> Result<(), Fault> {
        let room = match part.head.kind {
            Kind::Stream | Kind::Group => self.stream.is_none() && self.group.is_none(),
            Kind::Texture => {
                let key_tick = self.group.as_ref().map(|group| group.head.key_tick);
                self.texture.is_none() && key_tick == Some(part.head.key_tick)
            }
        };
        if !room {
            let reason = "a chunk holds one stream header, or one group with one texture of its keyframe";
            return Err(Fault::damaged(offset, reason));
        }
        match part.head.kind {
            Kind::Stream => self.stream = Some(part),
            Kind::Group => self.group = Some(part),
            Kind::Texture => self.texture = Some(part),
        }
        Ok(())
    }
}

/// Channel and log time of a message's fields.
fn message_fields(fields: &mut Bytes) -> Option<(u16, u64)> {
    let channel = fields.u16()?;
    fields.slice(4)?;
    let time_nanos = fields.u64()?;
    fields.slice(8)?;
    Some((channel, time_nanos))
}

/// The kind of payload a channel carries; `None` for JSON and channels this version does not know.
fn kind_of(channel: u16) -> Option<Kind> {
    match channel {
        id if id == STREAM.id => Some(Kind::Stream),
        id if id == GROUP.id => Some(Kind::Group),
        id if id == TEXTURE.id => Some(Kind::Texture),
        _ => None,
    }
}

fn envelope_fault(error: EnvelopeError, offset: u64) -> Fault {
    match error {
        EnvelopeError::Invalid { .. } => Fault::damaged(offset, error.to_string()),
        EnvelopeError::NewerVersion { found, supported } => {
            Fault::Newer { found: found.into(), supported: supported.into() }
        }
    }
}

fn check_kind(head: &Head, kind: Kind, offset: u64) -> Result<(), Fault> {
    if head.kind == kind {
        return Ok(());
    }
    Err(Fault::damaged(offset, format!("a payload of kind {:?} on the channel of {kind:?}", head.kind)))
}

/// Parses the records of a chunk, which start at `start` in the file; every envelope is opened.
pub(crate) fn content(records: &[u8], start: u64) -> Result<Content<'_>, Fault> {
    let mut parts = Parts::new();
    let mut rest = Bytes(records);
    while !rest.0.is_empty() {
        let offset = start + (records.len() - rest.0.len()) as u64;
        let torn = || Fault::damaged(offset, "a record runs past the end of its chunk");
        let opcode = rest.u8().ok_or_else(torn)?;
        let length = rest.u64().and_then(|length| usize::try_from(length).ok()).ok_or_else(torn)?;
        let body = rest.slice(length).ok_or_else(torn)?;
        match opcode {
            op::CHANNEL => check_channel(body, offset)?,
            op::MESSAGE => add_message(&mut parts, body, offset)?,
            _ => {}
        }
    }
    Ok(parts)
}

fn add_message<'a>(parts: &mut Content<'a>, body: &'a [u8], offset: u64) -> Result<(), Fault> {
    let mut fields = Bytes(body);
    let (channel, time_nanos) =
        message_fields(&mut fields).ok_or_else(|| Fault::damaged(offset, "a message shorter than its fields"))?;
    let Some(kind) = kind_of(channel) else {
        if channel == EVENT.id || channel == TELEMETRY.id {
            parts.json.push(Json { channel, time_nanos, text: fields.0, offset });
        }
        return Ok(());
    };
    let (head, payload) = envelope::open(fields.0).map_err(|error| envelope_fault(error, offset))?;
    check_kind(&head, kind, offset)?;
    parts.add(Sealed { head, time_nanos, payload }, offset)
}

/// Reads only the heads of a chunk's messages: enough for an index, a few dozen bytes a group. The heads carry
/// their own checksum; that of the chunk is checked when its payloads are read.
pub(crate) fn outline<R: Read + Seek>(source: &mut Source<R>, chunk: &ChunkHead) -> Result<Parts<()>, Fault> {
    let mut parts = Parts::new();
    let mut at = chunk.records.offset;
    while at < chunk.records.end() {
        let record = source.record_head(at)?;
        if record.end() > chunk.records.end() {
            return Err(Fault::damaged(at, "a record runs past the end of its chunk"));
        }
        if record.opcode == op::MESSAGE {
            outline_message(source, &record, &mut parts)?;
        }
        at = record.end();
    }
    Ok(parts)
}

fn outline_message<R: Read + Seek>(
    source: &mut Source<R>,
    record: &RecordHead,
    parts: &mut Parts<()>,
) -> Result<(), Fault> {
    let mut buffer = [0; MESSAGE_FIELDS as usize + envelope::HEAD_BYTES];
    let take = record.length.min(buffer.len() as u64) as usize;
    source.read_at(record.body(), &mut buffer[..take])?;
    let mut fields = Bytes(&buffer[..take]);
    let (channel, time_nanos) = message_fields(&mut fields)
        .ok_or_else(|| Fault::damaged(record.offset, "a message shorter than its fields"))?;
    let Some(kind) = kind_of(channel) else {
        if channel == EVENT.id || channel == TELEMETRY.id {
            parts.json.push(Json { channel, time_nanos, text: (), offset: record.offset });
        }
        return Ok(());
    };
    let head = envelope::open_head(fields.0).map_err(|error| envelope_fault(error, record.offset))?;
    check_kind(&head, kind, record.offset)?;
    if record.length != MESSAGE_FIELDS + envelope::HEAD_BYTES as u64 + u64::from(head.payload_bytes) {
        return Err(Fault::damaged(record.offset, "message and envelope disagree about their length"));
    }
    parts.add(Sealed { head, time_nanos, payload: () }, record.offset)
}

/// Checks that a channel record gives our topics the identifiers of SESSION.md.
pub(crate) fn check_channel(body: &[u8], offset: u64) -> Result<(), Fault> {
    let mut fields = Bytes(body);
    let parsed = fields.u16().zip(fields.u16()).zip(fields.text());
    let ((id, _schema), topic) = parsed.ok_or_else(|| Fault::damaged(offset, "channel record does not parse"))?;
    let clash = CHANNELS.iter().any(|channel| (channel.id == id) != (channel.topic == topic));
    if clash {
        return Err(Fault::damaged(offset, format!("channel {topic} has the identifier {id}, not that of SESSION.md")));
    }
    Ok(())
}
