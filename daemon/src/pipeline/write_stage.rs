//! Groups to disk, in a thread of its own.

use super::flow::{Captured, End, Ended, Item};
use super::monitor::{Monitor, Stage, thread_cpu};
use super::record::{RecordError, Recorded};
use super::recording::{Encoded, GroupSink, Progress, Rebuilt, Recording, payload_bytes};
use gv3_codec::{EncodedGroup, StreamHeader};
use gv3_protocol::session::{Event, MetadataGroup, key};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::mpsc::Receiver;
use tracing::{debug, debug_span, info};

/// Events kept until the next group; of those beyond only the count in the status is left.
const MOST_EVENTS: usize = 4096;

/// The stage.
pub(super) struct WriteStage {
    monitor: Arc<Monitor>,
    /// Bytes of the pictures of one set.
    set_bytes: u64,
    run: Option<Run>,
}

/// A recording here.
struct Run {
    sink: Box<dyn GroupSink>,
    events: Vec<Event>,
    progress: Arc<Progress>,
    abort: Arc<AtomicBool>,
    failure: Option<RecordError>,
}

impl WriteStage {
    pub fn new(monitor: Arc<Monitor>, set_bytes: u64) -> Self {
        Self { monitor, set_bytes, run: None }
    }

    pub fn run(mut self, mut groups: Receiver<Item<EncodedGroup>>) -> Result<(), RecordError> {
        while let Some(item) = groups.blocking_recv() {
            let cpu = thread_cpu();
            match item {
                Item::Work(group, arrived) => self.group(group, arrived),
                Item::Event(event) => self.event(event),
                Item::Begin(recording) => self.begin(*recording),
                Item::Segment(header, encoded) => self.segment(&header, &encoded),
                Item::End(end) => self.end(*end),
            }
            self.monitor.used_cpu(Stage::Write, cpu);
        }
        if let Some(mut run) = self.run.take() {
            // The stages before have died.
            run.close(&MetadataGroup::new().with("ended_early", "a stage ended unexpectedly"));
        }
        Ok(())
    }

    fn begin(&mut self, recording: Recording) {
        let Recording { encoder, sink, progress, abort, .. } = recording;
        let mut run = Run { sink, events: Vec::new(), progress, abort, failure: None };
        run.open(&encoder.header(), &self.monitor);
        self.run = Some(run);
    }

    fn event(&mut self, event: Event) {
        if let Some(run) = self.run.as_mut().filter(|run| run.events.len() < MOST_EVENTS) {
            run.events.push(event);
        }
    }

    fn group(&mut self, group: EncodedGroup, arrived: Instant) {
        let Some(run) = self.run.as_mut().filter(|run| run.failure.is_none()) else { return };
        let span = debug_span!("write", tick = group.key.tick);
        let _entered = span.enter();
        match run.sink.group(&group, &run.events) {
            Ok(()) => {
                run.events.clear();
                run.wrote(&group);
                self.monitor.stored(group, arrived);
            }
            Err(error) => run.fail(error),
        }
    }

    fn segment(&mut self, header: &StreamHeader, encoded: &Encoded) {
        let Some(run) = &mut self.run else { return };
        run.close(&statistics(encoded, encoded.scans * self.set_bytes));
        run.open(header, &self.monitor);
    }

    fn end(&mut self, end: End) {
        let End { cause, rebuilt, encoded: [last, all], captured, reply } = end;
        let Some(mut run) = self.run.take() else {
            let _ = reply.send(Err(cause.unwrap_or(RecordError::Stage("record"))));
            return;
        };
        let closing = match &cause {
            None => statistics(&last, captured.frame_bytes.unwrap_or(last.scans * self.set_bytes)),
            Some(cause) => MetadataGroup::new().with("ended_early", cause),
        };
        run.close(&closing);
        let result = match run.failure.or(cause) {
            Some(error) => Err(error),
            None => {
                let frame_bytes = captured.frame_bytes.unwrap_or(all.scans * self.set_bytes);
                let recorded = summarize(&captured, frame_bytes, &rebuilt, &all);
                info!(scans = recorded.scans, keyframes = recorded.keyframes, "recording finished");
                Ok(Ended { recorded, closed: run.sink.closed() })
            }
        };
        // Who asked may have given up.
        let _ = reply.send(result);
    }
}

impl Run {
    fn open(&mut self, header: &StreamHeader, monitor: &Monitor) {
        if self.failure.is_some() {
            return;
        }
        match self.sink.begin(header) {
            Ok(()) => {
                self.progress.segments.fetch_add(1, Ordering::Relaxed);
                monitor.began_file(header.encode());
            }
            Err(error) => self.fail(error),
        }
    }

    fn close(&mut self, statistics: &MetadataGroup) {
        // Also after a failure: what is complete may still be made a whole file.
        if let Err(error) = self.sink.end(&self.events, statistics)
            && self.failure.is_none()
        {
            self.fail(error);
        }
        self.events.clear();
    }

    fn wrote(&self, group: &EncodedGroup) {
        let progress = &self.progress;
        if progress.keyframes.fetch_add(1, Ordering::Relaxed) == 0 {
            progress.first_nanos.store(group.first.time_nanos, Ordering::Relaxed);
        }
        progress.scans.fetch_add(group.scans as u64, Ordering::Relaxed);
        progress.bytes.fetch_add(payload_bytes(group), Ordering::Relaxed);
        progress.last_nanos.store(group.key.time_nanos, Ordering::Relaxed);
    }

    fn fail(&mut self, error: RecordError) {
        debug!(%error, "nothing more is written");
        self.failure = Some(error);
        self.abort.store(true, Ordering::Relaxed);
    }
}

fn per_scan_ms(time: Duration, scans: u64) -> f64 {
    time.as_secs_f64() * 1e3 / scans.max(1) as f64
}

fn summarize(captured: &Captured, raw_fringe_bytes: u64, rebuilt: &Rebuilt, encoded: &Encoded) -> Recorded {
    Recorded {
        frame_sets: rebuilt.sets,
        drops: captured.drops,
        rejected_pixels: rebuilt.rejected,
        unusable_scans: encoded.unusable,
        scans: encoded.scans,
        keyframes: encoded.keyframes,
        reconstruct_ms_per_scan: per_scan_ms(rebuilt.time, rebuilt.sets),
        encode_ms_per_scan: per_scan_ms(encoded.time, encoded.scans),
        raw_fringe_bytes,
    }
}

fn statistics(encoded: &Encoded, raw_fringe_bytes: u64) -> MetadataGroup {
    MetadataGroup::new()
        .with(key::SCANS, encoded.scans)
        .with(key::KEYFRAMES, encoded.keyframes)
        .with(key::ENCODE_MS_PER_SCAN, format!("{:.3}", per_scan_ms(encoded.time, encoded.scans)))
        .with(key::RAW_OBJ_BMP_BYTES, encoded.uncoded.obj_bmp_bytes())
        .with(key::RAW_BINARY_BYTES, encoded.uncoded.binary_bytes)
        .with(key::RAW_FRINGE_BYTES, raw_fringe_bytes)
}
