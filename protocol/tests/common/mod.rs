//! A small session with everything a session can hold, and its known content.
#![allow(dead_code, reason = "each test file uses its own part")]

use std::io::{self, Cursor, Seek, SeekFrom, Write};

use gv3_protocol::session::{
    Event, EventKind, GroupRecord, MetadataGroup, Result, SessionMetadata, SessionReader, SessionWriter, SyncData,
    Telemetry, key,
};

pub const NAME: &str = "small.gv3";
pub const STREAM: &[u8] = b"stream header";

/// One group of the small session.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    pub first_tick: u64,
    pub key_tick: u64,
    pub time_nanos: u64,
    pub geometry: Vec<u8>,
    pub texture: Option<Vec<u8>>,
    pub events: Vec<Event>,
}

pub fn drop_event(tick: u64) -> Event {
    Event {
        time_nanos: tick * 33_000_000,
        tick,
        kind: EventKind::Drop { cause: "encode_queue_full".to_owned(), count: tick },
    }
}

pub fn groups() -> Vec<Group> {
    let group = |first_tick, key_tick, texture: Option<&[u8]>, events| Group {
        first_tick,
        key_tick,
        time_nanos: key_tick * 33_000_000,
        geometry: format!("geometry of {key_tick}").into_bytes(),
        texture: texture.map(<[u8]>::to_vec),
        events,
    };
    vec![
        group(0, 0, Some(b"texture 0"), vec![]),
        group(1, 10, None, vec![drop_event(4)]),
        group(11, 21, Some(b"texture 21"), vec![]),
    ]
}

pub fn metadata() -> SessionMetadata {
    SessionMetadata::new("default", "gv3 test", 1_700_000_000_000_000_000)
        .with_calibration("camera = 1")
        .with_configuration("mode = \"default\"")
}

pub fn statistics() -> MetadataGroup {
    MetadataGroup::new().with(key::SCANS, 22).with(key::KEYFRAMES, 3).with(key::ENCODE_MS_PER_SCAN, 12.5)
}

pub fn fault() -> Event {
    let kind = EventKind::Fault { source: "camera".to_owned(), message: "no frames for 2 s".to_owned() };
    Event { time_nanos: 400_000_000, tick: 12, kind }
}

pub fn telemetry() -> Telemetry {
    Telemetry { time_nanos: 100_000_000, values: [("queue_frames".to_owned(), 2.0)].into() }
}

pub fn write_group<W: Write + Seek + SyncData>(writer: &mut SessionWriter<W>, group: &Group) -> Result<()> {
    writer.write_group(GroupRecord {
        first_tick: group.first_tick,
        key_tick: group.key_tick,
        time_nanos: group.time_nanos,
        geometry: &group.geometry,
        texture: group.texture.as_deref(),
        events: &group.events,
    })
}

pub fn write_small<W: Write + Seek + SyncData>(sink: W) -> Result<W> {
    let mut writer = SessionWriter::create(sink, &metadata())?;
    writer.write_stream(STREAM)?;
    let groups = groups();
    write_group(&mut writer, &groups[0])?;
    writer.write_telemetry(&telemetry())?;
    write_group(&mut writer, &groups[1])?;
    writer.write_event(&fault())?;
    write_group(&mut writer, &groups[2])?;
    writer.finish(&statistics())
}

pub fn small() -> Vec<u8> {
    write_small(Cursor::new(Vec::new())).expect("memory does not fail").into_inner()
}

pub fn open(bytes: &[u8]) -> Result<SessionReader<Cursor<&[u8]>>> {
    SessionReader::from_source(Cursor::new(bytes), NAME)
}

/// A group read back, comparable to the one written.
pub fn read(reader: &mut SessionReader<Cursor<&[u8]>>, index: usize) -> Result<Group> {
    let stored = reader.read_group(index)?;
    Ok(Group {
        first_tick: stored.entry.first_tick,
        key_tick: stored.entry.key_tick,
        time_nanos: stored.entry.time_nanos,
        geometry: stored.geometry,
        texture: stored.texture,
        events: stored.events,
    })
}

/// A disk with room for `room` bytes; what it holds outlives the writer.
pub struct FullDisk<'a> {
    written: Cursor<&'a mut Vec<u8>>,
    room: usize,
}

impl<'a> FullDisk<'a> {
    pub fn new(disk: &'a mut Vec<u8>, room: usize) -> Self {
        FullDisk { written: Cursor::new(disk), room }
    }
}

impl Write for FullDisk<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let left = self.room - self.written.get_ref().len().min(self.room);
        if left == 0 {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.written.write(&bytes[..bytes.len().min(left)])
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for FullDisk<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.written.seek(to)
    }
}

impl SyncData for FullDisk<'_> {
    fn sync_data(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A disk that takes bytes but fails to make them durable after `good` times.
pub struct BadDisk {
    pub written: Cursor<Vec<u8>>,
    pub good: usize,
}

impl Write for BadDisk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.written.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for BadDisk {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.written.seek(to)
    }
}

impl SyncData for BadDisk {
    fn sync_data(&mut self) -> io::Result<()> {
        self.good = self.good.checked_sub(1).ok_or_else(|| io::Error::other("medium error"))?;
        Ok(())
    }
}
