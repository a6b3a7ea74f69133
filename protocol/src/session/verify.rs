//! Checks every byte of a session that carries meaning: all checksums, index against content, order of ticks.

use std::io::{Read, Seek};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::chunk::{self, ChunkHead};
use super::error::Fault;
use super::event::{Event, Telemetry};
use super::metadata::key;
use super::reader::{Index, open_file, parse_json, read_header};
use super::scanner::{Item, Scanner};
use super::source::{Source, Span};
use super::summary::{Summary, read_summary};
use super::{EVENT, Result, TELEMETRY};

/// Longest list of problems kept.
const PROBLEM_LIMIT: usize = 1000;

/// Something wrong with a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Problem {
    /// Where, bytes from the start of the file.
    pub offset: u64,
    /// What was found and what was expected.
    pub reason: String,
}

/// What verification found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct VerifyReport {
    /// The file.
    pub path: PathBuf,
    /// Its length.
    pub bytes: u64,
    /// Whether it ends with an intact summary.
    pub finished: bool,
    /// Chunks with a right checksum.
    pub chunks: usize,
    /// Intact stream headers.
    pub streams: usize,
    /// Intact groups.
    pub groups: usize,
    /// Intact textures.
    pub textures: usize,
    /// Intact events.
    pub events: usize,
    /// What is wrong, in the order it was found; at most 1000 entries.
    pub problems: Vec<Problem>,
}

impl VerifyReport {
    /// Whether nothing is wrong.
    #[must_use]
    pub fn ok(&self) -> bool {
        self.problems.is_empty()
    }

    fn problem(&mut self, offset: u64, reason: impl Into<String>) {
        if self.problems.len() < PROBLEM_LIMIT {
            self.problems.push(Problem { offset, reason: reason.into() });
        }
    }

    /// Takes damage as a problem; everything else ends the verification.
    fn note<T>(&mut self, outcome: std::result::Result<T, Fault>) -> std::result::Result<Option<T>, Fault> {
        match outcome {
            Ok(value) => Ok(Some(value)),
            Err(Fault::Damaged { offset, reason }) => {
                self.problem(offset, reason);
                Ok(None)
            }
            Err(fault) => Err(fault),
        }
    }
}

/// Verifies a session file.
///
/// # Errors
/// [`NotASession`](super::SessionError::NotASession), [`NewerVersion`](super::SessionError::NewerVersion) and
/// [`Io`](super::SessionError::Io); damage is not an error but a problem in the report.
pub fn verify(path: impl AsRef<Path>) -> Result<VerifyReport> {
    verify_source(open_file(path.as_ref())?, path.as_ref())
}

/// [`verify`] for any source; `name` stands for the file.
///
/// # Errors
/// As [`verify`].
pub fn verify_source<R: Read + Seek>(inner: R, name: impl Into<PathBuf>) -> Result<VerifyReport> {
    let name = name.into();
    let mut source = Source::new(inner).map_err(|error| Fault::Io(error).in_file(&name))?;
    let start = read_header(&mut source, &name)?;
    let mut report = VerifyReport {
        path: name.clone(),
        bytes: source.length(),
        finished: false,
        chunks: 0,
        streams: 0,
        groups: 0,
        textures: 0,
        events: 0,
        problems: Vec::new(),
    };
    check(&mut source, start, &mut report).map_err(|fault| fault.in_file(&name))?;
    Ok(report)
}

fn check<R: Read + Seek>(
    source: &mut Source<R>,
    start: u64,
    report: &mut VerifyReport,
) -> std::result::Result<(), Fault> {
    let summary = read_summary(source, start);
    let summary = report.note(summary)?;
    report.finished = summary.is_some();
    let indexed = match &summary {
        Some(summary) => {
            let index = Index::from_summary(source, summary);
            report.note(index)?
        }
        None => None,
    };
    let mut scan = Scan { index: Index::default(), spans: Vec::new(), data_end: None };
    scan.run(source, start, report)?;
    report.groups = scan.index.groups.len();
    report.streams = scan.index.streams.len();
    if scan.index.metadata.group(key::SESSION).is_none() {
        report.problem(start, "the metadata gv3.session is missing");
    }
    if let Some((offset, crc)) = scan.data_end {
        let found = source.crc(0, offset)?;
        if found != crc {
            report.problem(offset, format!("data checksum {found:08x}, {crc:08x} expected"));
        }
    }
    if let Some(summary) = &summary {
        compare(&scan, summary, indexed.as_ref(), report);
    }
    Ok(())
}

/// Holds the summary against what the data section really contains.
fn compare(scan: &Scan, summary: &Summary, indexed: Option<&Index>, report: &mut VerifyReport) {
    if scan.data_end.is_some_and(|(offset, _)| offset != summary.data_end) {
        report.problem(summary.data_end, "the summary does not follow the data section");
    }
    if summary.chunks != scan.spans {
        report.problem(summary.data_end, "the chunk index does not list the chunks of the file");
    }
    let Some(indexed) = indexed else { return };
    if indexed.groups != scan.index.groups || indexed.streams != scan.index.streams {
        report.problem(summary.data_end, "the heads in the index and the payloads do not agree");
    }
    if indexed.metadata != scan.index.metadata {
        report.problem(summary.data_end, "the metadata index does not list the metadata of the file");
    }
}

/// What a walk over the data section met.
struct Scan {
    index: Index,
    /// Chunks in the order of the file.
    spans: Vec<Span>,
    /// Where the data section ends, and its checksum.
    data_end: Option<(u64, u32)>,
}

impl Scan {
    fn run<R: Read + Seek>(
        &mut self,
        source: &mut Source<R>,
        start: u64,
        report: &mut VerifyReport,
    ) -> std::result::Result<(), Fault> {
        let mut scanner = Scanner::new(source, start);
        loop {
            match scanner.next()? {
                Item::Metadata { group: None, .. } => {}
                Item::Metadata { offset, group: Some((name, group)) } => {
                    let read = self.index.metadata.read_group(name, group, offset);
                    report.note(read)?;
                }
                Item::Chunk { head, records } => {
                    let read = self.chunk(&head, &records, report);
                    report.note(read)?;
                }
                Item::Damage { span, reason } => report.problem(span.offset, reason),
                Item::DataEnd { offset, crc } => {
                    self.data_end = Some((offset, crc));
                    return Ok(());
                }
                Item::EndOfFile { offset } => {
                    report.problem(offset, "the file ends before its data section does");
                    return Ok(());
                }
            }
        }
    }

    fn chunk(&mut self, head: &ChunkHead, records: &[u8], report: &mut VerifyReport) -> std::result::Result<(), Fault> {
        report.chunks += 1;
        self.spans.push(head.span);
        let content = chunk::content(records, head.records.offset)?;
        self.index.add_chunk(head.span, &content)?;
        report.textures += usize::from(content.texture.is_some());
        report.events += parse_json::<Event>(&content, EVENT.id)?.len();
        parse_json::<Telemetry>(&content, TELEMETRY.id)?;
        Ok(())
    }
}
