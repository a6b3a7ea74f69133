//! What travels between the stages, and the queues it travels in.

use super::monitor::Monitor;
use super::record::{RecordError, Recorded};
use super::recording::{Closed, Encoded, Rebuilt, Recording};
use gv3_codec::StreamHeader;
use gv3_protocol::session::{Event, EventKind};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc;
use std::time::Instant;
use tokio::sync::mpsc::Sender;
use tokio::sync::mpsc::error::TrySendError;
use tracing::warn;

/// Events kept while the queue has no room for them.
const MOST_LATE_EVENTS: usize = 1024;

/// What travels down the queues, in the order in which it happened.
pub(super) enum Item<T> {
    /// Something to work on, and when the last picture it is made of arrived.
    Work(T, Instant),
    /// Something that happened.
    Event(Event),
    /// A recording begins with the next scan.
    Begin(Box<Recording>),
    /// The recording goes on in a new file, under this header; what the file before holds.
    Segment(StreamHeader, Encoded),
    /// The recording ends with the scan before.
    End(Box<End>),
}

/// The end of a recording on its way down the stages, each of which adds what it did.
pub(super) struct End {
    /// Why it ends too early.
    pub cause: Option<RecordError>,
    pub rebuilt: Rebuilt,
    /// Of the last file, and of all.
    pub encoded: [Encoded; 2],
    pub captured: Captured,
    pub reply: mpsc::Sender<Result<Ended, RecordError>>,
}

/// What the pictures of a recording were.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Captured {
    pub drops: super::DropCounts,
    /// Bytes of all pictures; those of the sets that became scans when none.
    pub frame_bytes: Option<u64>,
}

/// A recording that ended as it should.
#[derive(Debug, Clone)]
pub struct Ended {
    /// What it did.
    pub recorded: Recorded,
    /// What it left.
    pub closed: Closed,
}

/// The sending end of a queue.
pub(super) struct Outlet<T> {
    queue: Sender<Item<T>>,
    /// Cause under which work is dropped when there is no room; it waits for room when there is none.
    drops_as: Option<&'static str>,
    monitor: Arc<Monitor>,
    late: VecDeque<Event>,
}

impl<T> Outlet<T> {
    /// An outlet that waits for room, or one that never does for work and events.
    pub fn new(queue: Sender<Item<T>>, drops_as: Option<&'static str>, monitor: Arc<Monitor>) -> Self {
        Self { queue, drops_as, monitor, late: VecDeque::new() }
    }

    /// Items in the queue.
    pub fn depth(&self) -> usize {
        self.queue.max_capacity() - self.queue.capacity()
    }

    /// Sends something that must not be lost, and waits for room.
    pub fn pass(&mut self, item: Item<T>) -> Result<(), RecordError> {
        while let Some(event) = self.late.pop_front() {
            self.send(Item::Event(event))?;
        }
        self.send(item)
    }

    /// Counts and sends something that happened here.
    pub fn tell(&mut self, event: Event) -> Result<(), RecordError> {
        self.monitor.happened(&event);
        self.pass_event(event)
    }

    /// Sends something that happened before; it waits for its turn without holding anybody up.
    pub fn pass_event(&mut self, event: Event) -> Result<(), RecordError> {
        if self.drops_as.is_none() {
            return self.pass(Item::Event(event));
        }
        if self.late.len() < MOST_LATE_EVENTS {
            self.late.push_back(event);
        }
        self.flush().map(drop)
    }

    /// Sends work, made of the set at `tick` and `time_nanos`, or drops it where there is no room; tells whether it is sent.
    pub fn offer(&mut self, work: T, arrived: Instant, (tick, time_nanos): (u64, u64)) -> Result<bool, RecordError> {
        let Some(cause) = self.drops_as else { return self.pass(Item::Work(work, arrived)).map(|()| true) };
        if self.flush()? {
            match self.queue.try_send(Item::Work(work, arrived)) {
                Ok(()) => return Ok(true),
                Err(TrySendError::Closed(_)) => return Err(RecordError::Stage("downstream")),
                Err(TrySendError::Full(_)) => {}
            }
        }
        self.drop_work(cause, tick, time_nanos);
        Ok(false)
    }

    /// Counts one piece of work that is left out; those in a row make one event.
    pub fn drop_work(&mut self, cause: &'static str, tick: u64, time_nanos: u64) {
        if let Some(Event { kind: EventKind::Drop { cause: last, count }, .. }) = self.late.back_mut()
            && last == cause
        {
            *count += 1;
            self.monitor.count_drop(cause, 1);
            return;
        }
        warn!(tick, cause, "dropped");
        let event = Event { time_nanos, tick, kind: EventKind::Drop { cause: cause.into(), count: 1 } };
        self.monitor.happened(&event);
        if self.late.len() < MOST_LATE_EVENTS {
            self.late.push_back(event);
        }
    }

    /// Whether no event is left waiting.
    fn flush(&mut self) -> Result<bool, RecordError> {
        while let Some(event) = self.late.pop_front() {
            match self.queue.try_send(Item::Event(event)) {
                Ok(()) => {}
                Err(TrySendError::Full(Item::Event(event))) => {
                    self.late.push_front(event);
                    return Ok(false);
                }
                Err(_) => return Err(RecordError::Stage("downstream")),
            }
        }
        Ok(true)
    }

    fn send(&self, item: Item<T>) -> Result<(), RecordError> {
        self.queue.blocking_send(item).map_err(|_| RecordError::Stage("downstream"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::sync::mpsc::channel;

    #[test]
    fn what_finds_no_room_is_counted_in_one_event_that_comes_in_its_place() {
        let (queue, mut items) = channel(2);
        let monitor = Arc::new(Monitor::default());
        let mut outlet = Outlet::new(queue, Some("queue_test"), Arc::clone(&monitor));
        let now = Instant::now();
        for tick in 0..7 {
            assert_eq!(outlet.offer(tick, now, (tick, 10 * tick)).unwrap(), tick < 2);
        }
        let mut got = Vec::new();
        for _ in 0..2 {
            got.push(items.try_recv().unwrap());
        }
        assert!(outlet.offer(7, now, (7, 70)).unwrap());
        got.extend(std::iter::from_fn(|| items.try_recv().ok()));
        let told = got.iter().map(|item| match item {
            Item::Work(tick, _) => (*tick, 0),
            Item::Event(Event { tick, kind: EventKind::Drop { count, .. }, .. }) => (*tick, *count),
            _ => panic!("nothing else was sent"),
        });
        assert_eq!(told.collect::<Vec<_>>(), [(0, 0), (1, 0), (2, 5), (7, 0)]);
        assert_eq!(monitor.drops().get("queue_test"), Some(&5));
    }
}
