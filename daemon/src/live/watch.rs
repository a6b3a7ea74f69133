//! The thread that looks after a running engine when nobody asks: the end of the pictures, failed recordings, the free space,
//! and the rates of the status.

use super::Inner;
use std::collections::VecDeque;
use std::sync::atomic::Ordering;
use std::sync::{TryLockError, Weak};
use std::time::{Duration, Instant};

/// Time between two looks.
const INTERVAL: Duration = Duration::from_millis(100);
/// Looks from one at the disk to the next.
const DISK_EVERY: u32 = 5;
/// Time over which rates are measured.
const RATE_TIME: Duration = Duration::from_secs(2);

/// Looks after an engine until it is shut down or its last handle is gone.
pub(super) fn watch(watched: &Weak<Inner>) {
    let mut rates = Rates::default();
    for round in 0u32.. {
        std::thread::sleep(INTERVAL);
        let Some(inner) = watched.upgrade() else { return };
        if inner.is_shut.load(Ordering::Relaxed) {
            return;
        }
        rates.update(&inner);
        if round % DISK_EVERY == 0 {
            look_at_disk(&inner);
        }
        // While a command is carried out there is nothing to look after.
        match inner.control.try_lock() {
            Ok(mut control) => control.look_after(&inner),
            Err(TryLockError::Poisoned(control)) => control.into_inner().look_after(&inner),
            Err(TryLockError::WouldBlock) => {}
        }
    }
}

fn look_at_disk(inner: &Inner) {
    let (folder, floor_bytes) = {
        let shown = inner.shown();
        (shown.folder.clone(), shown.disk.floor_bytes)
    };
    // Not under the lock: a network file system may take its time.
    let Some(space) = inner.ground.disk.space(&folder) else { return };
    let mut shown = inner.shown();
    let rate = shown.recording.as_ref().map(|recording| {
        let status = recording.status();
        status.bytes as f64 / status.seconds.max(1.0)
    });
    shown.disk.free_bytes = space.free_bytes;
    shown.disk.total_bytes = space.total_bytes;
    let room = space.free_bytes.saturating_sub(floor_bytes) as f64;
    shown.disk.seconds_left = rate.filter(|rate| *rate > 0.0).map(|rate| (room / rate).floor());
}

/// Pictures and scans a second over the last while.
#[derive(Default)]
struct Rates(VecDeque<(Instant, [u64; 2])>);

impl Rates {
    fn update(&mut self, inner: &Inner) {
        let now = (Instant::now(), inner.monitor.pictures_and_scans());
        self.0.push_back(now);
        while self.0.len() > 2 && now.0.duration_since(self.0[1].0) >= RATE_TIME {
            self.0.pop_front();
        }
        let (then, before) = self.0[0];
        let seconds = now.0.duration_since(then).as_secs_f64();
        if seconds > 0.0 {
            inner.shown().rates = std::array::from_fn(|i| (now.1[i] - before[i]) as f64 / seconds);
        }
    }
}
