//! Reads a session: an index of its groups first, payloads when asked for, one chunk in memory at a time.

use std::fs::{self, File};
use std::io::{Read, Seek};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use mcap::records::op;

use super::bytes::Bytes;
use super::chunk::{self, ChunkHead, Content, Parts};
use super::error::Fault;
use super::event::{Event, Telemetry};
use super::metadata::{MetadataGroup, SessionMetadata, key};
use super::scanner::{Item, Scanner};
use super::source::{Source, Span};
use super::summary::{Summary, read_summary};
use super::{EVENT, HEADER_LIMIT, METADATA_LIMIT, PROFILE, Result, SessionError, TELEMETRY};

/// How a session ends.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum SessionState {
    /// Finished, its summary intact.
    Clean,
    /// The writer was stopped, or the file is torn or damaged; read up to the last complete group before that.
    Unfinished {
        /// Groups that can be read.
        complete_groups: usize,
        /// Bytes from the start that are intact.
        valid_bytes: u64,
        /// Why reading stopped there.
        reason: String,
    },
}

/// One group in the index.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GroupEntry {
    /// Tick of the first scan.
    pub first_tick: u64,
    /// Tick of the keyframe.
    pub key_tick: u64,
    /// Sensor time of the keyframe, nanoseconds.
    pub time_nanos: u64,
    /// Where the chunk lies, bytes from the start of the file.
    pub chunk_offset: u64,
    /// Length of the chunk record, bytes.
    pub chunk_bytes: u64,
    /// Length of the geometry payload, bytes.
    pub geometry_bytes: u64,
    /// Length of the texture payload, bytes; 0 without a texture.
    pub texture_bytes: u64,
}

/// One stream header in the index.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct StreamEntry {
    /// First tick of the run.
    pub first_tick: u64,
    /// Index of the run's first group.
    pub first_group: usize,
    /// Where the chunk lies, bytes from the start of the file.
    pub chunk_offset: u64,
    /// Length of the payload, bytes.
    pub payload_bytes: u64,
}

/// A group as it was written.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredGroup {
    /// Its place in the index.
    pub entry: GroupEntry,
    /// The codec's group payload.
    pub geometry: Vec<u8>,
    /// The keyframe's texture.
    pub texture: Option<Vec<u8>>,
    /// Events stored with the group.
    pub events: Vec<Event>,
}

/// Where the bytes of a session go.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ByteTotals {
    /// Geometry payloads of all groups.
    pub geometry: u64,
    /// Texture payloads of all groups.
    pub texture: u64,
    /// Everything else: framing, indices, metadata, stream headers, events.
    pub container: u64,
    /// The whole file.
    pub session: u64,
}

/// An open session. Memory: the index (about 60 bytes a group), the metadata, and one chunk while it is read.
pub struct SessionReader<R> {
    source: Source<R>,
    name: PathBuf,
    state: SessionState,
    index: Index,
}

/// What is known of a session without its payloads.
#[derive(Debug, Default)]
pub(crate) struct Index {
    pub metadata: SessionMetadata,
    pub groups: Vec<GroupEntry>,
    pub streams: Vec<StreamEntry>,
    /// Offsets of the chunks that hold events or telemetry.
    pub json: Vec<u64>,
}

impl SessionReader<File> {
    /// Opens a session file. An unfinished or torn one opens too, up to its last complete group: see
    /// [`state`](Self::state).
    ///
    /// # Errors
    /// [`SessionError::NotASession`], [`SessionError::NewerVersion`], [`SessionError::Io`], and
    /// [`SessionError::Damaged`] if not even the opening metadata is intact.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        Self::from_source(open_file(path)?, path)
    }
}

impl<R: Read + Seek> SessionReader<R> {
    /// Opens a session in any seekable source; `name` stands for the file in errors.
    ///
    /// # Errors
    /// As [`open`](SessionReader::open).
    pub fn from_source(inner: R, name: impl Into<PathBuf>) -> Result<Self> {
        let name = name.into();
        let mut source = Source::new(inner).map_err(|error| Fault::Io(error).in_file(&name))?;
        let start = read_header(&mut source, &name)?;
        let (state, index) = match read_summary(&mut source, start) {
            Ok(summary) => {
                (SessionState::Clean, Index::from_summary(&mut source, &summary).map_err(|fault| fault.in_file(&name))?)
            }
            Err(Fault::Damaged { reason, .. }) => {
                let mut index = Index::default();
                (index.scan(&mut source, start, reason, &name)?, index)
            }
            Err(fault) => return Err(fault.in_file(&name)),
        };
        Ok(SessionReader { source, name, state, index })
    }

    /// Reads on where an unfinished session ended when it was looked at last: what its writer has added since is then there as
    /// if it had been when the session was opened. Nothing before that is read again; a finished session is not read at all.
    ///
    /// # Errors
    /// [`SessionError::Io`]; damage ends the session as it does for [`open`](SessionReader::open).
    pub fn read_on(&mut self) -> Result<()> {
        let SessionState::Unfinished { valid_bytes, .. } = self.state else { return Ok(()) };
        self.source.measure().map_err(|error| Fault::Io(error).in_file(&self.name))?;
        self.state = self.index.scan(&mut self.source, valid_bytes, "it is being written".to_owned(), &self.name)?;
        Ok(())
    }

    /// How the session ends.
    #[must_use]
    pub fn state(&self) -> &SessionState {
        &self.state
    }

    /// Metadata groups, the closing ones among them if the session is finished.
    #[must_use]
    pub fn metadata(&self) -> &SessionMetadata {
        &self.index.metadata
    }

    /// Index of the groups, ticks strictly increasing.
    #[must_use]
    pub fn groups(&self) -> &[GroupEntry] {
        &self.index.groups
    }

    /// Index of the stream headers, one a run.
    #[must_use]
    pub fn streams(&self) -> &[StreamEntry] {
        &self.index.streams
    }

    /// Index of the group that holds a tick, or of the one after a gap; `None` after the last keyframe.
    #[must_use]
    pub fn group_at(&self, tick: u64) -> Option<usize> {
        let at = self.index.groups.partition_point(|group| group.key_tick < tick);
        (at < self.index.groups.len()).then_some(at)
    }

    /// Where the bytes go.
    #[must_use]
    pub fn totals(&self) -> ByteTotals {
        let geometry = self.index.groups.iter().map(|group| group.geometry_bytes).sum();
        let texture = self.index.groups.iter().map(|group| group.texture_bytes).sum();
        let session = self.source.length();
        ByteTotals { geometry, texture, container: session.saturating_sub(geometry + texture), session }
    }

    /// Reads one group; every checksum is checked.
    ///
    /// # Errors
    /// [`SessionError::Damaged`] if a checksum is wrong or the chunk is not what the index says,
    /// [`SessionError::Usage`] if there is no such group.
    pub fn read_group(&mut self, index: usize) -> Result<StoredGroup> {
        let Some(&entry) = self.index.groups.get(index) else {
            let count = self.index.groups.len();
            return Err(SessionError::Usage(format!("no group {index}, the session has {count}")));
        };
        self.with_chunk(entry.chunk_offset, |head, content| {
            let changed = || Fault::damaged(entry.chunk_offset, "the chunk is not the group the index names");
            let group = content.group.as_ref().ok_or_else(changed)?;
            if GroupEntry::new(head.span, content) != Some(entry) {
                return Err(changed());
            }
            Ok(StoredGroup {
                entry,
                geometry: group.payload.to_vec(),
                texture: content.texture.as_ref().map(|texture| texture.payload.to_vec()),
                events: parse_json(content, EVENT.id)?,
            })
        })
    }

    /// Reads the stream header that opens a run.
    ///
    /// # Errors
    /// As [`read_group`](Self::read_group).
    pub fn read_stream(&mut self, index: usize) -> Result<Vec<u8>> {
        let Some(&entry) = self.index.streams.get(index) else {
            let count = self.index.streams.len();
            return Err(SessionError::Usage(format!("no stream header {index}, the session has {count}")));
        };
        self.with_chunk(entry.chunk_offset, |_, content| {
            let changed = || Fault::damaged(entry.chunk_offset, "the chunk is not the stream header the index names");
            let stream = content.stream.as_ref().filter(|stream| stream.head.first_tick == entry.first_tick);
            Ok(stream.ok_or_else(changed)?.payload.to_vec())
        })
    }

    /// All events in the order of the file; reads only the chunks that hold some.
    ///
    /// # Errors
    /// [`SessionError::Damaged`] if a chunk's checksum is wrong or a message is not an event.
    pub fn events(&mut self) -> Result<Vec<Event>> {
        self.events_from(0)
    }

    /// Events of the chunks that lie at `offset` of the file or after it, as [`events`](Self::events) gives them.
    ///
    /// # Errors
    /// As [`events`](Self::events).
    pub fn events_from(&mut self, offset: u64) -> Result<Vec<Event>> {
        self.json(EVENT.id, offset)
    }

    /// All telemetry in the order of the file.
    ///
    /// # Errors
    /// As [`events`](Self::events).
    pub fn telemetry(&mut self) -> Result<Vec<Telemetry>> {
        self.json(TELEMETRY.id, 0)
    }

    fn json<T: for<'a> Deserialize<'a>>(&mut self, channel: u16, from: u64) -> Result<Vec<T>> {
        let mut all = Vec::new();
        for at in self.index.json.partition_point(|&chunk| chunk < from)..self.index.json.len() {
            let offset = self.index.json[at];
            all.extend(self.with_chunk(offset, |_, content| parse_json(content, channel))?);
        }
        Ok(all)
    }

    fn with_chunk<T>(
        &mut self,
        offset: u64,
        take: impl FnOnce(&ChunkHead, &Content) -> std::result::Result<T, Fault>,
    ) -> Result<T> {
        let taken = ChunkHead::read(&mut self.source, offset).and_then(|head| {
            let records = head.read_records(&mut self.source)?;
            take(&head, &chunk::content(&records, head.records.offset)?)
        });
        taken.map_err(|fault| fault.in_file(&self.name))
    }
}

impl GroupEntry {
    /// Entry of a chunk; `None` if it holds no group.
    pub(crate) fn new<P>(span: Span, parts: &Parts<P>) -> Option<Self> {
        let group = parts.group.as_ref()?;
        Some(GroupEntry {
            first_tick: group.head.first_tick,
            key_tick: group.head.key_tick,
            time_nanos: group.time_nanos,
            chunk_offset: span.offset,
            chunk_bytes: span.length,
            geometry_bytes: group.head.payload_bytes.into(),
            texture_bytes: parts.texture.as_ref().map_or(0, |texture| texture.head.payload_bytes.into()),
        })
    }
}

impl Index {
    /// Index of a finished session: metadata first, for its version, then the heads in every chunk.
    pub fn from_summary<R: Read + Seek>(source: &mut Source<R>, summary: &Summary) -> std::result::Result<Self, Fault> {
        let mut index = Index::default();
        for span in &summary.metadata {
            let body = source.record_body(span.offset, op::METADATA, METADATA_LIMIT)?;
            if let Some((name, group)) = MetadataGroup::parse(&body, span.offset)? {
                index.metadata.read_group(name, group, span.offset)?;
            }
        }
        if index.metadata.group(key::SESSION).is_none() {
            return Err(Fault::damaged(source.length(), "the metadata gv3.session is missing"));
        }
        for span in &summary.chunks {
            let head = ChunkHead::read(source, span.offset)?;
            if head.span != *span {
                return Err(Fault::damaged(span.offset, "the chunk is not as long as the index says"));
            }
            let parts = chunk::outline(source, &head)?;
            index.add_chunk(*span, &parts)?;
        }
        Ok(index)
    }

    /// Adds what an unfinished session holds from `start` on: everything before the first damage or the end.
    fn scan<R: Read + Seek>(
        &mut self,
        source: &mut Source<R>,
        start: u64,
        missing: String,
        name: &Path,
    ) -> Result<SessionState> {
        let mut scanner = Scanner::new(source, start);
        let stop = loop {
            match scanner.next().and_then(|item| self.add_item(item)) {
                Ok(None) => {}
                Ok(Some(stop)) => break stop,
                Err(fault) => return Err(fault.in_file(name)),
            }
        };
        let Stop { valid_bytes, reason } = stop;
        let reason = reason.unwrap_or(missing);
        if self.metadata.group(key::SESSION).is_none() {
            let reason = format!("the opening metadata is not intact ({reason})");
            return Err(SessionError::Damaged { path: name.to_path_buf(), offset: valid_bytes, reason });
        }
        let complete_groups = self.groups.len();
        Ok(SessionState::Unfinished { complete_groups, valid_bytes, reason })
    }

    /// Adds what the scanner met, or says why the scan stops here.
    fn add_item(&mut self, item: Item) -> std::result::Result<Option<Stop>, Fault> {
        let (at, added) = match item {
            Item::Metadata { offset, group } => {
                (offset, group.map_or(Ok(()), |(name, group)| self.metadata.read_group(name, group, offset)))
            }
            Item::Chunk { head, records } => {
                let content = chunk::content(&records, head.records.offset);
                (head.span.offset, content.and_then(|content| self.add_chunk(head.span, &content)))
            }
            Item::Damage { span, reason } => (span.offset, Err(Fault::damaged(span.offset, reason))),
            Item::DataEnd { offset, .. } | Item::EndOfFile { offset } => {
                return Ok(Some(Stop { valid_bytes: offset, reason: None }));
            }
        };
        match added {
            Ok(()) => Ok(None),
            Err(Fault::Damaged { offset, reason }) => {
                Ok(Some(Stop { valid_bytes: at, reason: Some(format!("byte {offset}: {reason}")) }))
            }
            Err(fault) => Err(fault),
        }
    }

    /// Adds a chunk in the order of the file.
    pub fn add_chunk<P>(&mut self, span: Span, parts: &Parts<P>) -> std::result::Result<(), Fault> {
        if let Some(entry) = GroupEntry::new(span, parts) {
            if let Some(last) = self.groups.last().filter(|last| entry.first_tick <= last.key_tick) {
                let reason = format!("tick {} after tick {}", entry.first_tick, last.key_tick);
                return Err(Fault::damaged(span.offset, reason));
            }
            self.groups.push(entry);
        }
        if let Some(stream) = &parts.stream {
            self.streams.push(StreamEntry {
                first_tick: stream.head.first_tick,
                first_group: self.groups.len(),
                chunk_offset: span.offset,
                payload_bytes: stream.head.payload_bytes.into(),
            });
        }
        if !parts.json.is_empty() {
            self.json.push(span.offset);
        }
        Ok(())
    }
}

/// Where a scan stops; without a reason of its own, because the data does.
struct Stop {
    valid_bytes: u64,
    reason: Option<String>,
}

/// Opens a file that may be a session.
pub(crate) fn open_file(path: &Path) -> Result<File> {
    let failed = |source| SessionError::Io { path: path.to_path_buf(), action: "open", source };
    let metadata = fs::metadata(path).map_err(failed)?;
    if metadata.is_dir() {
        return Err(SessionError::NotASession { path: path.to_path_buf(), reason: "it is a folder".to_owned() });
    }
    if !metadata.is_file() {
        let reason = "it is not a regular file; copy it to one first".to_owned();
        return Err(SessionError::NotASession { path: path.to_path_buf(), reason });
    }
    File::open(path).map_err(failed)
}

/// Checks magic and header; returns where the first record after them lies.
pub(crate) fn read_header<R: Read + Seek>(source: &mut Source<R>, name: &Path) -> Result<u64> {
    let other = |reason: String| SessionError::NotASession { path: name.to_path_buf(), reason };
    let magic_bytes = mcap::MAGIC.len() as u64;
    if source.length() == 0 {
        return Err(other("the file is empty".to_owned()));
    }
    let mut magic = vec![0; source.length().min(magic_bytes) as usize];
    source.read_at(0, &mut magic).map_err(|fault| fault.in_file(name))?;
    if magic != mcap::MAGIC {
        return Err(other("it does not begin as an MCAP file does".to_owned()));
    }
    let body = match source.record_body(magic_bytes, op::HEADER, HEADER_LIMIT) {
        Ok(body) => body,
        Err(Fault::Damaged { reason, .. }) => return Err(other(format!("its MCAP header is incomplete: {reason}"))),
        Err(fault) => return Err(fault.in_file(name)),
    };
    match Bytes(&body).text() {
        Some(PROFILE) => {}
        Some(profile) => {
            return Err(other(format!("it is an MCAP file of profile {profile:?}, a session has {PROFILE:?}")));
        }
        None => return Err(other("its MCAP header does not parse".to_owned())),
    }
    Ok(magic_bytes + super::source::RECORD_HEAD + body.len() as u64)
}

pub(crate) fn parse_json<T: for<'a> Deserialize<'a>>(
    content: &Content,
    channel: u16,
) -> std::result::Result<Vec<T>, Fault> {
    let messages = content.json.iter().filter(|message| message.channel == channel);
    messages
        .map(|message| {
            serde_json::from_slice(message.text)
                .map_err(|error| Fault::damaged(message.offset, format!("JSON message: {error}")))
        })
        .collect()
}
