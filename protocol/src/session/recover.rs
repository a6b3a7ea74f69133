//! Copies every intact group of a torn or damaged session into a clean one.

use std::collections::BTreeMap;
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::chunk::{self, ChunkHead, Content};
use super::error::Fault;
use super::metadata::{MetadataGroup, SessionMetadata, key};
use super::reader::{open_file, read_header};
use super::scanner::{Item, Scanner};
use super::sink::SyncData;
use super::source::{Source, Span};
use super::writer::{GroupRecord, JsonText, SessionWriter};
use super::{Result, SessionError};
use crate::AtomicFile;

/// Longest list of losses kept; further ones are only counted.
const LOST_LIMIT: usize = 1000;

/// Bytes of the damaged session that were left out.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostSpan {
    /// Where they begin, bytes from the start of the file.
    pub offset: u64,
    /// How many.
    pub bytes: u64,
    /// What is wrong with them.
    pub reason: String,
    /// Keyframe tick of the last group kept before them; `None` at the start.
    pub after_tick: Option<u64>,
    /// First tick of the next group kept after them; `None` at the end. Ticks strictly between the two may be lost.
    pub before_tick: Option<u64>,
}

/// What recovery kept and lost.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecoverReport {
    /// The session read.
    pub path: PathBuf,
    /// Groups kept.
    pub groups: usize,
    /// First tick of the first group kept.
    pub first_tick: u64,
    /// Keyframe tick of the last group kept.
    pub last_tick: u64,
    /// What was left out, in the order of the file; at most 1000 entries.
    pub lost: Vec<LostSpan>,
    /// How many spans were left out, listed or not.
    pub lost_spans: u64,
    /// How many bytes were left out.
    pub lost_bytes: u64,
    /// Whether the session's opening metadata was kept; otherwise mode and producer are unknown.
    pub metadata_kept: bool,
}

/// Writes a clean session to `out` with every complete group of the session at `path`. The two may be the same file
/// if `overwrite` is set: `out` is replaced only when it is whole and durable.
///
/// # Errors
/// [`SessionError::NothingToRecover`] without a complete group, [`SessionError::Exists`] unless `overwrite`, and
/// what opening and writing give; no file is left then.
pub fn recover(path: impl AsRef<Path>, out: impl AsRef<Path>, overwrite: bool) -> Result<RecoverReport> {
    let input = open_file(path.as_ref())?;
    let (sink, report) = recover_source(input, path.as_ref(), AtomicFile::create(out, overwrite)?)?;
    sink.commit()?;
    Ok(report)
}

/// [`recover`] between any source and sink; `name` stands for the source in errors.
///
/// # Errors
/// As [`recover`].
pub fn recover_source<R, W>(inner: R, name: impl Into<PathBuf>, sink: W) -> Result<(W, RecoverReport)>
where
    R: Read + Seek,
    W: Write + Seek + SyncData,
{
    let name = name.into();
    let mut source = Source::new(inner).map_err(|error| Fault::Io(error).in_file(&name))?;
    let start = read_header(&mut source, &name)?;
    let mut recovery = Recovery::new(&name, sink);
    let mut scanner = Scanner::new(&mut source, start);
    loop {
        match scanner.next().map_err(|fault| fault.in_file(&name))? {
            Item::Metadata { offset, group } => recovery.metadata(offset, group)?,
            Item::Chunk { head, records } => recovery.chunk(&head, &records)?,
            Item::Damage { span, reason } => recovery.lose(span, reason),
            Item::DataEnd { .. } | Item::EndOfFile { .. } => return recovery.finish(),
        }
    }
}

struct Recovery<W: Write + Seek + SyncData> {
    /// Until the first chunk starts the writer.
    sink: Option<W>,
    writer: Option<SessionWriter<W>>,
    opening: SessionMetadata,
    closing: BTreeMap<String, MetadataGroup>,
    last_key_tick: Option<u64>,
    report: RecoverReport,
}

impl<W: Write + Seek + SyncData> Recovery<W> {
    fn new(path: &Path, sink: W) -> Self {
        let report = RecoverReport {
            path: path.to_path_buf(),
            groups: 0,
            first_tick: 0,
            last_tick: 0,
            lost: Vec::new(),
            lost_spans: 0,
            lost_bytes: 0,
            metadata_kept: false,
        };
        Recovery {
            sink: Some(sink),
            writer: None,
            opening: SessionMetadata::default(),
            closing: BTreeMap::new(),
            last_key_tick: None,
            report,
        }
    }

    fn metadata(&mut self, offset: u64, group: Option<(String, MetadataGroup)>) -> Result<()> {
        let Some((name, group)) = group else { return Ok(()) };
        let closing = self.writer.is_some() || name == key::STATISTICS || name == key::RECOVERY;
        if closing && self.opening.group(&name).is_none() {
            self.closing.insert(name, group);
            return Ok(());
        }
        match self.opening.read_group(name, group, offset) {
            Err(Fault::Damaged { offset, reason }) => self.lose(Span { offset, length: 0 }, reason),
            Err(fault) => return Err(fault.in_file(&self.report.path)),
            Ok(()) => {}
        }
        Ok(())
    }

    /// Copies an intact chunk; one whose content does not fit is lost.
    fn chunk(&mut self, head: &ChunkHead, records: &[u8]) -> Result<()> {
        let copied = match chunk::content(records, head.records.offset) {
            Ok(content) => self.copy(&content),
            Err(Fault::Damaged { reason, .. }) => Err(SessionError::Usage(reason)),
            Err(fault) => Err(fault.in_file(&self.report.path)),
        };
        match copied {
            Err(SessionError::Usage(reason)) => {
                self.lose(head.span, reason);
                Ok(())
            }
            other => other,
        }
    }

    fn copy(&mut self, content: &Content) -> Result<()> {
        let json: Vec<JsonText> =
            content.json.iter().map(|message| (message.channel, message.time_nanos, message.text)).collect();
        let writer = self.writer()?;
        if let Some(stream) = &content.stream {
            writer.replace_stream(stream.payload);
        }
        let Some(group) = &content.group else {
            return if json.is_empty() { Ok(()) } else { writer.write_json_raw(&json) };
        };
        let record = GroupRecord {
            first_tick: group.head.first_tick,
            key_tick: group.head.key_tick,
            time_nanos: group.time_nanos,
            geometry: group.payload,
            texture: content.texture.as_ref().map(|texture| texture.payload),
            events: &[],
        };
        writer.write_group_raw(&record, &json)?;
        self.keep(&record);
        Ok(())
    }

    fn keep(&mut self, group: &GroupRecord) {
        if self.report.groups == 0 {
            self.report.first_tick = group.first_tick;
        }
        self.report.groups += 1;
        self.report.last_tick = group.key_tick;
        self.last_key_tick = Some(group.key_tick);
        let open = self.report.lost.iter_mut().rev().take_while(|lost| lost.before_tick.is_none());
        open.for_each(|lost| lost.before_tick = Some(group.first_tick));
    }

    fn lose(&mut self, span: Span, reason: String) {
        self.report.lost_spans += 1;
        self.report.lost_bytes += span.length;
        if self.report.lost.len() < LOST_LIMIT {
            self.report.lost.push(LostSpan {
                offset: span.offset,
                bytes: span.length,
                reason,
                after_tick: self.last_key_tick,
                before_tick: None,
            });
        }
    }

    /// The writer, started with the metadata that stood before the first chunk.
    fn writer(&mut self) -> Result<&mut SessionWriter<W>> {
        if let Some(sink) = self.sink.take() {
            self.report.metadata_kept = self.opening.format_version().is_some();
            if !self.report.metadata_kept {
                let unknown = SessionMetadata::new("unknown", "gv3 recover", 0);
                unknown.iter().for_each(|(name, group)| self.opening.set_group(name, group.clone()));
            }
            self.writer = Some(SessionWriter::create(sink, &self.opening)?);
        }
        self.writer.as_mut().ok_or_else(|| SessionError::Usage("the recovered session is closed".to_owned()))
    }

    fn finish(mut self) -> Result<(W, RecoverReport)> {
        let nothing = |reason: String| SessionError::NothingToRecover { path: self.report.path.clone(), reason };
        let Some(writer) = self.writer.take().filter(|_| self.report.groups > 0) else {
            let reason = self.report.lost.first().map(|lost| format!("; byte {}: {}", lost.offset, lost.reason));
            return Err(nothing(format!("no complete group{}", reason.unwrap_or_default())));
        };
        let statistics = self.closing.entry(key::STATISTICS.to_owned()).or_default();
        if statistics.get(key::KEYFRAMES).is_none() {
            statistics.set(key::KEYFRAMES, self.report.groups);
        }
        let recovery = MetadataGroup::new()
            .with("groups", self.report.groups)
            .with("lost_spans", self.report.lost_spans)
            .with("lost_bytes", self.report.lost_bytes);
        self.closing.insert(key::RECOVERY.to_owned(), recovery);
        let closing: Vec<_> = self.closing.iter().map(|(name, group)| (name.as_str(), group)).collect();
        Ok((writer.finish_with(&closing)?, self.report))
    }
}
