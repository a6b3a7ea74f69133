//! Pictures of groups, in a thread of its own: the encoder goes on with the next scans meanwhile.

use super::flow::{Item, Outlet};
use super::monitor::{Monitor, Stage, thread_cpu};
use super::record::RecordError;
use super::recording::{Encoded, Progress, payload_bytes};
use gv3_codec::EncodedGroup;
use gv3_codec::shot::pictures::PictureEncoder;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tokio::sync::mpsc::Receiver;
use tracing::debug_span;

/// The stage.
pub(super) struct PictureStage {
    out: Outlet<EncodedGroup>,
    monitor: Arc<Monitor>,
    encoder: PictureEncoder,
    progress: Arc<Progress>,
    /// Spent on this file, and on the files before.
    time: Duration,
    before: Duration,
}

impl PictureStage {
    pub fn new(out: Outlet<EncodedGroup>, monitor: Arc<Monitor>) -> Self {
        let (time, before) = (Duration::ZERO, Duration::ZERO);
        Self { out, monitor, encoder: PictureEncoder::default(), progress: Arc::default(), time, before }
    }

    pub fn run(mut self, mut groups: Receiver<Item<EncodedGroup>>) -> Result<(), RecordError> {
        while let Some(item) = groups.blocking_recv() {
            let cpu = thread_cpu();
            let item = match item {
                Item::Work(group, arrived) => Item::Work(self.group(group), arrived),
                Item::Begin(recording) => {
                    (self.time, self.before) = Default::default();
                    self.progress = Arc::clone(&recording.progress);
                    Item::Begin(recording)
                }
                Item::Segment(header, encoded) => {
                    let time = std::mem::take(&mut self.time);
                    self.before += time;
                    Item::Segment(header, Encoded { time: encoded.time + time, ..encoded })
                }
                Item::End(mut end) => {
                    let [last, all] = &mut end.encoded;
                    last.time += self.time;
                    all.time += self.time + self.before;
                    Item::End(end)
                }
                Item::Event(event) => Item::Event(event),
            };
            self.monitor.used_cpu(Stage::Pictures, cpu);
            self.out.pass(item)?;
        }
        Ok(())
    }

    fn group(&mut self, mut group: EncodedGroup) -> EncodedGroup {
        let span = debug_span!("pictures", tick = group.key.tick);
        let _entered = span.enter();
        let begin = Instant::now();
        self.encoder.encode(&mut group);
        self.time += begin.elapsed();
        self.progress.coded_bytes.fetch_add(payload_bytes(&group), Ordering::Relaxed);
        group
    }
}
