//! Scans to groups, in a thread of its own: one encoder a file. Pictures are left to the next stage.

use super::degrade::Degradation;
use super::flow::{End, Item, Outlet};
use super::monitor::{Monitor, Stage, thread_cpu};
use super::record::RecordError;
use super::recording::{Encoded, Progress, Recording, ScanObserver, SegmentLimits};
use gv3_codec::{CodecError, EncodedGroup, Encoder, EncoderConfig, Scan};
use gv3_protocol::session::{Event, EventKind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use tokio::sync::mpsc::Receiver;
use tracing::{debug_span, warn};

/// The stage.
pub(super) struct EncodeStage {
    out: Outlet<EncodedGroup>,
    monitor: Arc<Monitor>,
    run: Option<Run>,
}

/// A recording here.
struct Run {
    config: EncoderConfig,
    /// None after a failure.
    encoder: Option<Encoder>,
    observer: ScanObserver,
    limits: SegmentLimits,
    progress: Arc<Progress>,
    abort: Arc<AtomicBool>,
    failure: Option<RecordError>,
    /// Of this file, and of the files before.
    encoded: Encoded,
    before: Encoded,
    /// Of this file.
    first_tick: Option<u64>,
    /// Of the files before, but for what was on its way when this one began.
    bytes_before: u64,
    /// Of the last scan's last picture.
    arrived: Instant,
}

impl EncodeStage {
    pub fn new(out: Outlet<EncodedGroup>, monitor: Arc<Monitor>) -> Self {
        Self { out, monitor, run: None }
    }

    pub fn run(mut self, mut scans: Receiver<Item<Scan>>) -> Result<(), RecordError> {
        while let Some(item) = scans.blocking_recv() {
            let cpu = thread_cpu();
            match item {
                Item::Work(scan, arrived) => self.scan(scan, arrived)?,
                Item::Event(event) => self.out.pass_event(event)?,
                Item::Begin(recording) => self.begin(recording)?,
                Item::Segment(header, encoded) => self.out.pass(Item::Segment(header, encoded))?,
                Item::End(end) => self.end(end)?,
            }
            self.monitor.used_cpu(Stage::Encode, cpu);
        }
        // The stages before have died; what is here still goes into the file.
        self.finish_run().map(drop)
    }

    fn begin(&mut self, mut recording: Box<Recording>) -> Result<(), RecordError> {
        let made = encoder(&recording.encoder);
        let mut run = Run {
            config: recording.encoder.clone(),
            encoder: None,
            observer: std::mem::replace(&mut recording.observer, Box::new(|_| Ok(()))),
            limits: recording.limits,
            progress: Arc::clone(&recording.progress),
            abort: Arc::clone(&recording.abort),
            failure: None,
            encoded: Encoded::default(),
            before: Encoded::default(),
            first_tick: None,
            bytes_before: 0,
            arrived: Instant::now(),
        };
        match made {
            Ok(encoder) => run.encoder = Some(encoder),
            Err(error) => run.fail(error.into()),
        }
        self.run = Some(run);
        self.out.pass(Item::Begin(recording))
    }

    fn end(&mut self, mut end: Box<End>) -> Result<(), RecordError> {
        if let Some(run) = self.finish_run()? {
            let mut all = run.before;
            all += run.encoded;
            end.encoded = [run.encoded, all];
            end.cause = run.failure.or(end.cause);
        }
        self.out.pass(Item::End(end))
    }

    /// The scans since the last keyframe are closed by the last of them.
    fn finish_run(&mut self) -> Result<Option<Run>, RecordError> {
        let Some(mut run) = self.run.take() else { return Ok(None) };
        if let Some(encoder) = run.encoder.take() {
            let begin = Instant::now();
            let last = encoder.finish();
            run.encoded.time += begin.elapsed();
            match last {
                Ok(group) => forward(group, &mut run, &mut self.out)?,
                Err(error) => run.fail(error.into()),
            }
        }
        Ok(Some(run))
    }

    fn scan(&mut self, scan: Scan, arrived: Instant) -> Result<(), RecordError> {
        let Some(run) = &mut self.run else { return Ok(()) };
        let Some(encoder) = &mut run.encoder else { return Ok(()) };
        let span = debug_span!("encode", tick = scan.tick);
        let _entered = span.enter();
        if let Err(reason) = (run.observer)(&scan) {
            run.fail(RecordError::Observer(reason));
            return Ok(());
        }
        let (time_nanos, tick, uncoded) = (scan.time_nanos, scan.tick, run.encoded.uncoded.and(&scan));
        let begin = Instant::now();
        encoder.set_corrects_between(self.monitor.degradation() == Degradation::None);
        let pushed = encoder.push(scan);
        run.encoded.time += begin.elapsed();
        run.progress.encoded.fetch_add(1, Ordering::Relaxed);
        let note =
            |message: String| Event { time_nanos, tick, kind: EventKind::Fault { source: "encode".into(), message } };
        match pushed {
            Ok(pushed) => {
                (run.arrived, run.first_tick) = (arrived, run.first_tick.or(Some(tick)));
                run.encoded.uncoded = uncoded;
                self.monitor.is_key_refused.store(pushed.not_key.is_some(), Ordering::Relaxed);
                if let Some(error) = pushed.not_key {
                    warn!(tick, %error, "no keyframe, trying the next scan");
                    self.out.tell(note(error.to_string()))?;
                }
                let is_closed = pushed.group.is_some();
                forward(pushed.group, run, &mut self.out)?;
                if is_closed && run.is_full(tick) { rotate(run, &mut self.out) } else { Ok(()) }
            }
            Err(CodecError::Mesh(reason)) => {
                warn!(tick, reason, "scan left out");
                run.encoded.unusable += 1;
                self.monitor.is_key_refused.store(true, Ordering::Relaxed);
                self.out.tell(note(format!("scan left out: {reason}")))
            }
            Err(error) => {
                run.fail(error.into());
                Ok(())
            }
        }
    }
}

impl Run {
    /// Nothing more is encoded; whoever began the recording is to end it.
    fn fail(&mut self, error: RecordError) {
        warn!(%error, "the recording cannot go on");
        (self.encoder, self.failure) = (None, Some(error));
        self.abort.store(true, Ordering::Relaxed);
    }

    fn is_full(&self, key_tick: u64) -> bool {
        let periods = self.first_tick.map_or(0, |first| key_tick - first + 1);
        self.limits.periods.is_some_and(|most| periods >= most)
            || self
                .limits
                .bytes
                .is_some_and(|most| self.progress.coded_bytes.load(Ordering::Relaxed) - self.bytes_before >= most)
    }
}

/// An encoder that leaves pictures to the next stage.
fn encoder(config: &EncoderConfig) -> Result<Encoder, CodecError> {
    let mut encoder = Encoder::new(config.clone())?;
    encoder.defer_pictures();
    Ok(encoder)
}

/// After a keyframe: the next scan begins a file.
fn rotate(run: &mut Run, out: &mut Outlet<EncodedGroup>) -> Result<(), RecordError> {
    match encoder(&run.config) {
        // The old one holds no scan.
        Ok(encoder) => run.encoder = Some(encoder),
        Err(error) => run.fail(error.into()),
    }
    let encoded = std::mem::take(&mut run.encoded);
    run.before += encoded;
    (run.first_tick, run.bytes_before) = (None, run.progress.coded_bytes.load(Ordering::Relaxed));
    out.pass(Item::Segment(run.config.header(), encoded))
}

fn forward(group: Option<EncodedGroup>, run: &mut Run, out: &mut Outlet<EncodedGroup>) -> Result<(), RecordError> {
    let Some(group) = group else { return Ok(()) };
    run.encoded.scans += group.scans as u64;
    run.encoded.keyframes += 1;
    out.pass(Item::Work(group, run.arrived))
}
