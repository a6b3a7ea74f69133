//! A recording: capture, reconstruct, encode and write, each in a named thread, joined by bounded queues.

use super::capture::capture;
use super::{DropCounts, FrameSet, Reconstruction, Reconstructor};
use crate::device::{DeviceError, Rig};
use crate::light::{DepthRange, LightError, RejectedPixels};
use gv3_codec::{CodecError, EncodedGroup, Encoder, EncoderConfig, Scan};
use gv3_protocol::session::{
    Event, EventKind, GroupRecord, MetadataGroup, SessionError, SessionFile, SessionWriter, SyncData, key,
};
use std::io::{Seek, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::mpsc::{Receiver, Sender, channel};
use tracing::{info, warn};

/// Items a queue between two stages holds: enough to ride out a keyframe, few enough to bound memory.
const QUEUE: usize = 4;

/// Why a recording ended early. What was complete before is in the file.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// A device failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// Reconstruction cannot work with this rig.
    #[error(transparent)]
    Light(#[from] LightError),
    /// The encoder refused its input.
    #[error(transparent)]
    Codec(#[from] CodecError),
    /// The session could not be written.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The raw recording could not be begun.
    #[error(transparent)]
    Raw(#[from] gv3_protocol::raw::RawError),
    /// The caller's observer failed.
    #[error("{0}")]
    Observer(String),
    /// A stage could not be started or died.
    #[error("stage {0} ended unexpectedly")]
    Stage(&'static str),
}

/// Looks at every scan before it is encoded.
pub type ScanObserver = Box<dyn FnMut(&Scan) -> Result<(), String> + Send>;

/// How to record.
pub struct RecordSettings {
    /// Scan periods to record; until told to stop when none.
    pub scan_periods: Option<u64>,
    /// Encoder settings.
    pub encoder: EncoderConfig,
    /// Called with every scan.
    pub observer: ScanObserver,
    /// Set to end the recording; what is on its way is finished.
    pub stop: Arc<AtomicBool>,
    /// Scans encoded so far, for progress.
    pub progress: Arc<AtomicU64>,
}

/// What a recording did.
#[derive(Debug, Clone, Default, serde::Serialize)]
pub struct Recorded {
    /// Complete frame sets.
    pub frame_sets: u64,
    /// Frame sets dropped, by cause.
    pub drops: DropCounts,
    /// Pixels rejected in all scans, by cause.
    pub rejected_pixels: RejectedPixels,
    /// Scans that the encoder could not use.
    pub unusable_scans: u64,
    /// Scans in the session.
    pub scans: u64,
    /// Keyframes in the session.
    pub keyframes: u64,
    /// Mean reconstruction time, milliseconds a scan.
    pub reconstruct_ms_per_scan: f64,
    /// Mean encoding time, milliseconds a scan.
    pub encode_ms_per_scan: f64,
    /// What the pictures took, bytes.
    pub raw_fringe_bytes: u64,
}

/// What travels down the queues.
pub(super) enum Item<T> {
    Work(T),
    Event(Event),
}

/// Records until the wanted length, the stop flag, or an error; the session is finished in every case where the file can
/// still be written.
///
/// # Errors
/// [`RecordError`] of the first stage that failed.
pub async fn record(
    rig: Rig,
    settings: RecordSettings,
    mut writer: SessionWriter<SessionFile>,
) -> Result<Recorded, RecordError> {
    let reconstructor = Reconstructor::with(&rig.calibration, &rig.sequence, &rig.limits, &rig.processing)?;
    if let Some(DepthRange { near_mm, far_mm }) = reconstructor.valid_depth() {
        info!("one frequency: fringe orders are right from {near_mm:.0} to {far_mm:.0} mm");
    }
    let encoder = Encoder::new(settings.encoder)?;
    writer.write_stream(&encoder.header().encode())?;
    let (set_out, sets) = channel(QUEUE);
    let (scan_out, scans) = channel(QUEUE);
    let (group_out, groups) = channel(QUEUE);
    let stop = Arc::clone(&settings.stop);
    let periods = settings.scan_periods;
    let capture = stage("capture", move || capture(rig, periods, &stop, &set_out));
    let stop = Arc::clone(&settings.stop);
    let reconstruct = stage("reconstruct", move || stopping(&stop, || run_reconstruct(reconstructor, sets, &scan_out)));
    let stop = Arc::clone(&settings.stop);
    let RecordSettings { observer, progress, .. } = settings;
    let encode =
        stage("encode", move || stopping(&stop, || run_encode(encoder, observer, &progress, scans, &group_out)));
    let write = stage("write", move || run_write(writer, groups));
    let (captured, rebuilt, encoded, written) = tokio::join!(capture, reconstruct, encode, write);
    // A later stage's error is the cause of those before it: a full disk closes the queues upstream.
    let writer = written?;
    match (encoded, rebuilt, captured) {
        (Ok(encoded), Ok(rebuilt), Ok(drops)) => {
            let recorded = summarize(&drops, &rebuilt, &encoded);
            writer.finish(&statistics(&recorded))?;
            let dropped = recorded.drops.sets();
            info!(scans = recorded.scans, keyframes = recorded.keyframes, dropped, "recording finished");
            Ok(recorded)
        }
        (encoded, rebuilt, captured) => {
            let cause = encoded.err().or(rebuilt.err()).or(captured.err()).unwrap_or(RecordError::Stage("record"));
            writer.finish(&MetadataGroup::new().with("ended_early", &cause))?;
            Err(cause)
        }
    }
}

/// Runs a blocking stage in a thread of its own name.
async fn stage<T: Send + 'static>(
    name: &'static str,
    work: impl FnOnce() -> Result<T, RecordError> + Send + 'static,
) -> Result<T, RecordError> {
    let (done, result) = tokio::sync::oneshot::channel();
    std::thread::Builder::new()
        .name(format!("gv3-{name}"))
        .spawn(move || done.send(work()))
        .map_err(|_| RecordError::Stage(name))?;
    result.await.unwrap_or(Err(RecordError::Stage(name)))
}

/// A stage that fails stops the capture.
fn stopping<T>(stop: &AtomicBool, work: impl FnOnce() -> Result<T, RecordError>) -> Result<T, RecordError> {
    work().inspect_err(|_| stop.store(true, Ordering::Relaxed))
}

pub(super) fn send<T>(out: &Sender<T>, item: T) -> Result<(), RecordError> {
    out.blocking_send(item).map_err(|_| RecordError::Stage("downstream"))
}

/// Says of a scan without a surface what rejected most of its pixels: `empty_scan_low_modulation` when all was dark.
fn empty_event(result: &Reconstruction) -> Option<Event> {
    let Scan { tick, time_nanos, mesh, .. } = &result.scan;
    let (cause, pixels) = result.rejected.main_cause().filter(|_| mesh.triangles.is_empty())?;
    warn!(tick, cause, pixels, "empty scan");
    let kind = EventKind::Drop { cause: format!("empty_scan_{cause}"), count: 1 };
    Some(Event { time_nanos: *time_nanos, tick: *tick, kind })
}

#[derive(Default)]
struct Rebuilt {
    sets: u64,
    rejected: RejectedPixels,
    time: Duration,
}

fn run_reconstruct(
    mut reconstructor: Reconstructor,
    mut sets: Receiver<Item<FrameSet>>,
    out: &Sender<Item<Scan>>,
) -> Result<Rebuilt, RecordError> {
    let mut rebuilt = Rebuilt::default();
    while let Some(item) = sets.blocking_recv() {
        let item = match item {
            Item::Event(event) => Item::Event(event),
            Item::Work(set) => {
                let begin = Instant::now();
                let result = reconstructor.reconstruct(&set)?;
                rebuilt.time += begin.elapsed();
                rebuilt.sets += 1;
                rebuilt.rejected += result.rejected;
                if let Some(event) = empty_event(&result) {
                    send(out, Item::Event(event))?;
                }
                Item::Work(result.scan)
            }
        };
        send(out, item)?;
    }
    Ok(rebuilt)
}

#[derive(Default)]
struct Encoded {
    scans: u64,
    keyframes: u64,
    unusable: u64,
    time: Duration,
}

fn run_encode(
    mut encoder: Encoder,
    mut observer: ScanObserver,
    progress: &AtomicU64,
    mut scans: Receiver<Item<Scan>>,
    out: &Sender<Item<EncodedGroup>>,
) -> Result<Encoded, RecordError> {
    let mut encoded = Encoded::default();
    while let Some(item) = scans.blocking_recv() {
        let scan = match item {
            Item::Event(event) => {
                send(out, Item::Event(event))?;
                continue;
            }
            Item::Work(scan) => scan,
        };
        observer(&scan).map_err(RecordError::Observer)?;
        let (time_nanos, tick) = (scan.time_nanos, scan.tick);
        let begin = Instant::now();
        let pushed = encoder.push(scan);
        encoded.time += begin.elapsed();
        progress.fetch_add(1, Ordering::Relaxed);
        let note =
            |message: String| Event { time_nanos, tick, kind: EventKind::Fault { source: "encode".into(), message } };
        match pushed {
            Ok(pushed) => {
                if let Some(error) = pushed.not_key {
                    warn!(tick, %error, "no keyframe, trying the next scan");
                    send(out, Item::Event(note(error.to_string())))?;
                }
                forward(pushed.group, &mut encoded, out)?;
            }
            Err(CodecError::Mesh(reason)) => {
                warn!(tick, reason, "scan left out");
                encoded.unusable += 1;
                send(out, Item::Event(note(format!("scan left out: {reason}"))))?;
            }
            Err(error) => return Err(error.into()),
        }
    }
    let begin = Instant::now();
    let last = encoder.finish()?;
    encoded.time += begin.elapsed();
    forward(last, &mut encoded, out)?;
    Ok(encoded)
}

fn forward(
    group: Option<EncodedGroup>,
    encoded: &mut Encoded,
    out: &Sender<Item<EncodedGroup>>,
) -> Result<(), RecordError> {
    let Some(group) = group else { return Ok(()) };
    encoded.scans += group.scans as u64;
    encoded.keyframes += 1;
    send(out, Item::Work(group))
}

fn run_write(
    mut writer: SessionWriter<SessionFile>,
    mut groups: Receiver<Item<EncodedGroup>>,
) -> Result<SessionWriter<SessionFile>, RecordError> {
    let mut events = Vec::new();
    while let Some(item) = groups.blocking_recv() {
        match item {
            Item::Event(event) => events.push(event),
            Item::Work(group) => {
                write_group(&mut writer, &group, &events)?;
                events.clear();
            }
        }
    }
    for event in &events {
        writer.write_event(event)?;
    }
    Ok(writer)
}

/// Writes a group with the events since the one before; durable when this returns.
///
/// # Errors
/// As [`SessionWriter::write_group`].
pub fn write_group<W: Write + Seek + SyncData>(
    writer: &mut SessionWriter<W>,
    group: &EncodedGroup,
    events: &[Event],
) -> Result<(), SessionError> {
    writer.write_group(GroupRecord {
        first_tick: group.first.tick,
        key_tick: group.key.tick,
        time_nanos: group.key.time_nanos,
        geometry: &group.geometry,
        texture: group.texture.as_deref(),
        events,
    })
}

fn per_scan_ms(time: Duration, scans: u64) -> f64 {
    time.as_secs_f64() * 1e3 / scans.max(1) as f64
}

fn summarize((drops, frame_bytes): &(DropCounts, u64), rebuilt: &Rebuilt, encoded: &Encoded) -> Recorded {
    Recorded {
        frame_sets: rebuilt.sets,
        drops: *drops,
        rejected_pixels: rebuilt.rejected,
        unusable_scans: encoded.unusable,
        scans: encoded.scans,
        keyframes: encoded.keyframes,
        reconstruct_ms_per_scan: per_scan_ms(rebuilt.time, rebuilt.sets),
        encode_ms_per_scan: per_scan_ms(encoded.time, encoded.scans),
        raw_fringe_bytes: *frame_bytes,
    }
}

fn statistics(recorded: &Recorded) -> MetadataGroup {
    MetadataGroup::new()
        .with(key::SCANS, recorded.scans)
        .with(key::KEYFRAMES, recorded.keyframes)
        .with(key::ENCODE_MS_PER_SCAN, format!("{:.3}", recorded.encode_ms_per_scan))
        .with(key::RAW_FRINGE_BYTES, recorded.raw_fringe_bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::{Frame, PatternIndex, RigConfig};
    use gv3_codec::GreyPicture;

    #[test]
    fn a_set_all_dark_or_clipped_is_an_event_by_its_cause() {
        let config = RigConfig::simulated();
        let calibration = config.calibration().unwrap();
        let mut reconstructor = Reconstructor::new(&calibration, &config.sequence, &config.limits).unwrap();
        for (level, cause) in [(0, "empty_scan_low_modulation"), (255, "empty_scan_saturated")] {
            let frame = |n: u16| Frame {
                sequence: u64::from(n),
                pattern: PatternIndex(n),
                device_time_nanos: 0,
                host_time_nanos: 0,
                exposure_nanos: 0,
                picture: GreyPicture::filled(640, 480, level),
            };
            let set = FrameSet { tick: 7, time_nanos: 9, frames: (0..6).map(frame).collect() };
            let event = empty_event(&reconstructor.reconstruct(&set).unwrap()).unwrap();
            let kind = EventKind::Drop { cause: cause.into(), count: 1 };
            assert_eq!(event, Event { time_nanos: 9, tick: 7, kind });
        }
    }
}
