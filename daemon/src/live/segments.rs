//! The files of a recording, each a complete session, each verified when it is closed.

use super::Ground;
use super::disk::AnyFile;
use crate::pipeline::record::write_group;
use crate::pipeline::{Closed, GroupSink, RecordError};
use crate::store::SessionName;
use gv3_codec::{EncodedGroup, StreamHeader, decode_stamps};
use gv3_protocol::session::{
    Event, MetadataGroup, SessionMetadata, SessionReader, SessionState, SessionWriter, StoredGroup, key,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::UNIX_EPOCH;

/// Writes a recording as NAME.gv3, NAME.0002.gv3 and so on.
pub(super) struct SegmentedSink {
    ground: Arc<Ground>,
    folder: PathBuf,
    name: SessionName,
    metadata: SessionMetadata,
    segment: u32,
    open: Option<OpenSegment>,
    closed: Closed,
}

/// A file being written.
struct OpenSegment {
    path: PathBuf,
    writer: SessionWriter<AnyFile>,
    header: Option<StreamHeader>,
    groups: usize,
    last: Option<EncodedGroup>,
}

impl SegmentedSink {
    /// Makes the first file, so that what cannot work is known before the recording begins. The time of creation in the
    /// metadata is set for every file.
    pub fn create(
        ground: Arc<Ground>,
        folder: &Path,
        name: &SessionName,
        metadata: SessionMetadata,
    ) -> Result<Self, RecordError> {
        let (folder, name, closed) = (folder.to_path_buf(), name.clone(), Closed::default());
        let mut sink = Self { ground, folder, name, metadata, segment: 0, open: None, closed };
        sink.open = Some(sink.create_next()?);
        Ok(sink)
    }

    fn create_next(&mut self) -> Result<OpenSegment, RecordError> {
        self.segment += 1;
        let path = self.folder.join(self.name.file(self.segment));
        let created = (self.ground.wall_clock)().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
        if let Some(mut session) = self.metadata.group(key::SESSION).cloned() {
            session.set(key::CREATED_UNIX_NANOS, created);
            self.metadata.set_group(key::SESSION, session);
        }
        let file = AnyFile(self.ground.disk.create(&path)?);
        // What cannot even be begun stands in nobody's way.
        let begun = SessionWriter::create(file, &self.metadata).inspect_err(|_| drop(std::fs::remove_file(&path)));
        Ok(OpenSegment { path, writer: begun?, header: None, groups: 0, last: None })
    }

    fn open(&mut self) -> Result<&mut OpenSegment, RecordError> {
        self.open.as_mut().ok_or(RecordError::Stage("write"))
    }
}

impl GroupSink for SegmentedSink {
    fn begin(&mut self, header: &StreamHeader) -> Result<(), RecordError> {
        if self.open.is_none() {
            self.open = Some(self.create_next()?);
        }
        let open = self.open()?;
        open.header = Some(*header);
        Ok(open.writer.write_stream(&header.encode())?)
    }

    fn group(&mut self, group: &EncodedGroup, events: &[Event]) -> Result<(), RecordError> {
        let open = self.open()?;
        write_group(&mut open.writer, group, events)?;
        (open.groups, open.last) = (open.groups + 1, Some(group.clone()));
        Ok(())
    }

    fn end(&mut self, events: &[Event], statistics: &MetadataGroup) -> Result<(), RecordError> {
        let Some(OpenSegment { path, mut writer, header, groups, last }) = self.open.take() else { return Ok(()) };
        let (Some(header), Some(last)) = (header, last) else {
            drop(writer);
            // It holds nothing but its header.
            let failed = |e| RecordError::Verify { path: path.clone(), reason: format!("an empty file is left: {e}") };
            return std::fs::remove_file(&path).map_err(failed);
        };
        self.closed.files.push(path.clone());
        let finished = events.iter().try_for_each(|event| writer.write_event(event));
        finished.and_then(|()| writer.finish(statistics).map(drop))?;
        verify_end(&path, &header, groups, &last)?;
        self.closed.bytes += std::fs::metadata(&path).map_or(0, |m| m.len());
        Ok(())
    }

    fn closed(&self) -> Closed {
        self.closed.clone()
    }
}

/// Opens a finished file again: it must have its summary, all its groups, and the last one as it was written.
fn verify_end(path: &Path, header: &StreamHeader, groups: usize, last: &EncodedGroup) -> Result<(), RecordError> {
    let fail = |reason: String| Err(RecordError::Verify { path: path.into(), reason });
    let mut reader = SessionReader::open(path)?;
    if let SessionState::Unfinished { reason, .. } = reader.state() {
        return fail(format!("it reads as unfinished: {reason}"));
    }
    if reader.groups().len() != groups {
        return fail(format!("{} groups are in its index, {groups} were written", reader.groups().len()));
    }
    let StoredGroup { entry, geometry, texture, .. } = reader.read_group(groups - 1)?;
    if entry.key_tick != last.key.tick || geometry != last.geometry || texture != last.texture {
        return fail(format!("its last group is not the one of tick {} that was written", last.key.tick));
    }
    let stamps = decode_stamps(header, &geometry)?;
    if stamps.len() != last.scans {
        return fail(format!("its last group has {} scans, {} were written", stamps.len(), last.scans));
    }
    Ok(())
}
