//! Writes a session: metadata first, then one durable chunk a group, then statistics and the summary.

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use mcap::McapError;
use mcap::records::MessageHeader;

use super::envelope::{self, Kind};
use super::event::{Event, Telemetry};
use super::metadata::{MetadataGroup, SessionMetadata, key};
use super::sink::{SyncData, SyncOnFlush};
use super::{CHANNELS, CHUNK_LIMIT, Channel, EVENT, FORMAT_VERSION, GROUP, Result, STREAM, SessionError};
use super::{PROFILE, TELEMETRY, TEXTURE};

/// Room kept in a chunk for the records around the payloads, bytes.
const CHUNK_RESERVE: u64 = 1 << 20;

/// A JSON message: channel identifier, sensor time in nanoseconds, text.
pub(crate) type JsonText<'a> = (u16, u64, &'a [u8]);

/// Everything of one group.
#[derive(Debug, Clone, Copy)]
pub struct GroupRecord<'a> {
    /// Tick of the first scan the group holds.
    pub first_tick: u64,
    /// Tick of the keyframe that closes it.
    pub key_tick: u64,
    /// Sensor time of the keyframe, nanoseconds.
    pub time_nanos: u64,
    /// The codec's group payload.
    pub geometry: &'a [u8],
    /// The keyframe's texture, if it has one.
    pub texture: Option<&'a [u8]>,
    /// What happened since the group before.
    pub events: &'a [Event],
}

/// Writes a session into a sink. Dropping it without [`finish`](Self::finish) leaves a file that reads up to its
/// last complete group.
pub struct SessionWriter<W: Write + Seek + SyncData> {
    /// `None` after a failure: what would follow could not be trusted.
    mcap: Option<mcap::Writer<SyncOnFlush<W>>>,
    /// Stream header of a run whose first group is not written yet.
    stream: Option<Vec<u8>>,
    /// JSON bytes waiting in the open chunk.
    queued: u64,
    last_key_tick: Option<u64>,
    sequence: u32,
}

impl<W: Write + Seek + SyncData> SessionWriter<W> {
    /// Starts a session at the sink's start; header and metadata are durable when this returns.
    ///
    /// # Errors
    /// [`SessionError::Write`] if the sink fails, [`SessionError::Usage`] if the metadata is not that of a session
    /// of this version.
    pub fn create(sink: W, metadata: &SessionMetadata) -> Result<Self> {
        if metadata.format_version() != Some(FORMAT_VERSION) {
            return Err(SessionError::Usage(format!("metadata must say format_version {FORMAT_VERSION}")));
        }
        if let Some(name) = [key::STATISTICS, key::RECOVERY].into_iter().find(|name| metadata.group(name).is_some()) {
            return Err(SessionError::Usage(format!("metadata {name} is written at the end, not at the start")));
        }
        let records: Vec<_> = metadata.iter().map(|(name, group)| group.to_record(name)).collect::<Result<_>>()?;
        let options = mcap::WriteOptions::new()
            .profile(PROFILE)
            .library(concat!("gv3 ", env!("CARGO_PKG_VERSION")))
            .compression(None)
            .chunk_size(None)
            // Chunks are built in memory and written once, front to back: every torn file is a prefix of a whole one.
            .disable_seeking(true);
        let mcap = mcap::Writer::with_options(SyncOnFlush(sink), options).map_err(write_error)?;
        let mut writer = SessionWriter { mcap: Some(mcap), stream: None, queued: 0, last_key_tick: None, sequence: 0 };
        writer.attempt(|mcap| {
            records.iter().try_for_each(|record| mcap.write_metadata(record))?;
            mcap.flush()?;
            CHANNELS.iter().try_for_each(|channel| add_channel(mcap, channel))
        })?;
        Ok(writer)
    }

    /// Opens a run: the codec's stream header, kept until the run's first group gives it a time.
    ///
    /// # Errors
    /// [`SessionError::Usage`] if the payload is empty or too long, or the run before has no group.
    pub fn write_stream(&mut self, payload: &[u8]) -> Result<()> {
        if self.stream.is_some() {
            return Err(SessionError::Usage("a stream header follows another without a group between".to_owned()));
        }
        envelope::seal(Kind::Stream, 0, 0, payload).map_err(|error| SessionError::Usage(error.to_string()))?;
        self.check_room(payload.len() as u64)?;
        self.stream = Some(payload.to_vec());
        Ok(())
    }

    /// Opens a run whose header is known to be good; one still waiting lost all its groups and gives way.
    pub(crate) fn replace_stream(&mut self, payload: &[u8]) {
        self.stream = Some(payload.to_vec());
    }

    /// Writes one group as one chunk; it is durable when this returns.
    ///
    /// # Errors
    /// [`SessionError::Usage`] if ticks do not increase or a payload is empty or too long, and the writer goes on;
    /// [`SessionError::Write`] if the sink fails, and every later call fails too.
    pub fn write_group(&mut self, group: GroupRecord) -> Result<()> {
        let events =
            group.events.iter().map(|event| Ok((event.time_nanos, json(event)?))).collect::<Result<Vec<_>>>()?;
        let events: Vec<_> = events.iter().map(|(time_nanos, text)| (EVENT.id, *time_nanos, text.as_slice())).collect();
        self.write_group_raw(&group, &events)
    }

    /// [`write_group`](Self::write_group) with JSON messages as they are: channel, time, text.
    pub(crate) fn write_group_raw(&mut self, group: &GroupRecord, json: &[JsonText]) -> Result<()> {
        let usage = |error: envelope::EnvelopeError| SessionError::Usage(error.to_string());
        if self.last_key_tick.is_some_and(|last| group.first_tick <= last) {
            let last = self.last_key_tick.unwrap_or_default();
            return Err(SessionError::Usage(format!("tick {} after tick {last}", group.first_tick)));
        }
        let texture_bytes = group.texture.map_or(0, <[u8]>::len) as u64;
        self.check_room(group.geometry.len() as u64 + texture_bytes + json_bytes(json))?;
        let geometry = envelope::seal(Kind::Group, group.first_tick, group.key_tick, group.geometry).map_err(usage)?;
        let texture =
            group.texture.map(|payload| envelope::seal(Kind::Texture, group.key_tick, group.key_tick, payload));
        let texture = texture.transpose().map_err(usage)?;

        self.flush_stream(group.first_tick, group.time_nanos)?;
        self.message(GROUP.id, group.time_nanos, &geometry)?;
        if let Some(texture) = texture {
            self.message(TEXTURE.id, group.time_nanos, &texture)?;
        }
        self.json_messages(json)?;
        self.flush()?;
        self.last_key_tick = Some(group.key_tick);
        Ok(())
    }

    /// Writes one event between groups as a chunk of its own; it is durable when this returns.
    ///
    /// # Errors
    /// [`SessionError::Write`] if the sink fails, [`SessionError::Usage`] if the event is too long.
    pub fn write_event(&mut self, event: &Event) -> Result<()> {
        self.write_json_raw(&[(EVENT.id, event.time_nanos, &json(event)?)])
    }

    /// Writes JSON messages as they are, in a chunk of their own.
    pub(crate) fn write_json_raw(&mut self, json: &[JsonText]) -> Result<()> {
        self.check_room(json_bytes(json))?;
        self.json_messages(json)?;
        self.flush()
    }

    /// Adds telemetry to the next chunk written.
    ///
    /// # Errors
    /// [`SessionError::Usage`] if a value is not finite or the chunk is full, [`SessionError::Write`] if the sink
    /// failed before.
    pub fn write_telemetry(&mut self, telemetry: &Telemetry) -> Result<()> {
        if let Some((name, value)) = telemetry.values.iter().find(|(_, value)| !value.is_finite()) {
            return Err(SessionError::Usage(format!("telemetry {name} is {value}; JSON has no such number")));
        }
        let text = json(telemetry)?;
        let message = [(TELEMETRY.id, telemetry.time_nanos, text.as_slice())];
        self.check_room(json_bytes(&message))?;
        self.json_messages(&message)?;
        self.queued += json_bytes(&message);
        Ok(())
    }

    /// Writes the statistics (keys in [`key`]) and the summary, makes everything durable, and hands the sink back.
    ///
    /// # Errors
    /// [`SessionError::Write`] if the sink fails; the file then reads as unfinished.
    pub fn finish(self, statistics: &MetadataGroup) -> Result<W> {
        self.finish_with(&[(key::STATISTICS, statistics)])
    }

    /// [`finish`](Self::finish) with any closing groups.
    pub(crate) fn finish_with(mut self, closing: &[(&str, &MetadataGroup)]) -> Result<W> {
        let records: Vec<_> = closing.iter().map(|(name, group)| group.to_record(name)).collect::<Result<_>>()?;
        let tick = self.last_key_tick.unwrap_or_default();
        self.flush_stream(tick, 0)?;
        self.attempt(|mcap| {
            records.iter().try_for_each(|record| mcap.write_metadata(record))?;
            mcap.finish().map(drop)
        })?;
        let mcap = self.mcap.take().ok_or_else(failed_before)?;
        let mut sink = mcap.into_inner().0;
        sink.sync_all().map_err(SessionError::Write)?;
        Ok(sink)
    }

    /// Writes a waiting stream header as a chunk of its own, so that it outlives damage to the first group.
    fn flush_stream(&mut self, first_tick: u64, time_nanos: u64) -> Result<()> {
        let Some(payload) = self.stream.take() else { return Ok(()) };
        let sealed = envelope::seal(Kind::Stream, first_tick, first_tick, &payload)
            .map_err(|error| SessionError::Usage(error.to_string()))?;
        self.message(STREAM.id, time_nanos, &sealed)?;
        self.flush()
    }

    fn json_messages(&mut self, json: &[JsonText]) -> Result<()> {
        json.iter().try_for_each(|(channel, time_nanos, text)| self.message(*channel, *time_nanos, text))
    }

    fn message(&mut self, channel_id: u16, time_nanos: u64, data: &[u8]) -> Result<()> {
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        let header = MessageHeader { channel_id, sequence, log_time: time_nanos, publish_time: time_nanos };
        self.attempt(|mcap| mcap.write_to_known_channel(&header, data))
    }

    fn flush(&mut self) -> Result<()> {
        self.attempt(mcap::Writer::flush)?;
        self.queued = 0;
        Ok(())
    }

    fn check_room(&self, bytes: u64) -> Result<()> {
        if bytes + self.queued <= CHUNK_LIMIT - CHUNK_RESERVE {
            return Ok(());
        }
        let limit = CHUNK_LIMIT - CHUNK_RESERVE;
        Err(SessionError::Usage(format!("{} bytes in one group, the limit is {limit}", bytes + self.queued)))
    }

    /// Runs one step on the MCAP writer; a failure closes it for good, keeping what the sink already has.
    fn attempt(&mut self, step: impl FnOnce(&mut mcap::Writer<SyncOnFlush<W>>) -> mcap::McapResult<()>) -> Result<()> {
        let mcap = self.mcap.as_mut().ok_or_else(failed_before)?;
        step(mcap).map_err(|error| {
            self.close();
            write_error(error)
        })
    }

    /// Lets the sink go without the summary that the MCAP writer would add when dropped: an unfinished session must
    /// look unfinished.
    fn close(&mut self) {
        drop(self.mcap.take().map(mcap::Writer::into_inner));
    }
}

impl<W: Write + Seek + SyncData> Drop for SessionWriter<W> {
    fn drop(&mut self) {
        self.close();
    }
}

/// Length of JSON messages in a chunk, their record heads included, bytes.
fn json_bytes(json: &[JsonText]) -> u64 {
    json.iter().map(|(_, _, text)| 31 + text.len() as u64).sum()
}

fn add_channel<W: Write + Seek>(mcap: &mut mcap::Writer<W>, channel: &Channel) -> mcap::McapResult<()> {
    let (encoding, schema, message_encoding) = match channel.json_schema {
        Some(schema) => ("jsonschema", schema, "json"),
        None => ("", "", PROFILE),
    };
    mcap.add_schema_with_id(channel.id, channel.schema, encoding, schema.as_bytes())?;
    mcap.add_channel_with_id(channel.id, channel.id, channel.topic, message_encoding, &BTreeMap::new())?;
    Ok(())
}

fn json(value: &impl serde::Serialize) -> Result<Vec<u8>> {
    serde_json::to_vec(value).map_err(|error| SessionError::Usage(format!("JSON: {error}")))
}

fn failed_before() -> SessionError {
    SessionError::Write(std::io::Error::other("the session is closed after an earlier failure"))
}

fn write_error(error: McapError) -> SessionError {
    match error {
        McapError::Io(source) => SessionError::Write(source),
        other => SessionError::Write(std::io::Error::other(other)),
    }
}
