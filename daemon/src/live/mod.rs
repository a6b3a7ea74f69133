//! The live engine: a scanner that previews, and recordings that begin and end while it runs.
//!
//! ```text
//! idle -> starting -> previewing <-> recording -> stopping -> previewing -> idle
//!                         any of them -> failed -> starting
//! ```
//! [`Live`] is a handle to the [`crate::pipeline`] of one rig and a thread that watches over it: the free space, the end of the
//! pictures, a disk that fails. All calls block; none of them waits for longer than its stages need to finish what is queued.

mod config;
mod control;
mod disk;
mod error;
#[cfg(test)]
pub(crate) mod gate;
mod request;
mod segments;
mod status;
#[cfg(test)]
mod tests;
mod watch;

pub use crate::pipeline::monitor::{
    ExposureHint, ExposureStatus, LiveEvent, LiveGroup, LiveGroupKind, LiveMetrics, LivePicture, LiveScan, MapsWanted,
    Monitor,
};
pub use config::LiveConfig;
pub use disk::{Disk, DiskFile, DiskSpace, SystemDisk};
pub use error::LiveError;
pub use request::{RecordingRequest, RecordingStarted, RecordingStopped};
pub use status::{DiskStatus, LatencyStatus, LiveState, LiveStatus, RecordingStatus};

use crate::device::{self, DeviceError, Rig, RigConfig};
use control::Control;
use status::Shown;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Instant, SystemTime};
use tokio::sync::{broadcast, watch as latest};

/// Opens the devices of a configuration.
pub type OpenRig = dyn Fn(&RigConfig) -> Result<Rig, DeviceError> + Send + Sync;
/// The system's time, a label of files and nothing else: all that is recorded has the sensor's.
pub type WallClock = dyn Fn() -> SystemTime + Send + Sync;

/// What the engine stands on; replaced in tests.
pub struct Ground {
    /// Opens the devices of a configuration, with its calibration, patterns and limits.
    pub open_rig: Box<OpenRig>,
    /// Where sessions are written to.
    pub disk: Arc<dyn Disk>,
    /// Tells when files were begun.
    pub wall_clock: Box<WallClock>,
}

impl Default for Ground {
    fn default() -> Self {
        Self { open_rig: Box::new(device::open), disk: Arc::new(SystemDisk), wall_clock: Box::new(SystemTime::now) }
    }
}

/// Shared by all handles and the watching thread.
struct Inner {
    ground: Arc<Ground>,
    monitor: Arc<Monitor>,
    /// Held while a command is carried out.
    control: Mutex<Control>,
    /// What the status shows; never held for long.
    shown: Mutex<Shown>,
    is_shut: AtomicBool,
    opened: Instant,
}

/// A handle to the engine; cheap to clone. The engine ends with [`Live::shut_down`], or with its last handle.
#[derive(Clone)]
pub struct Live {
    inner: Arc<Inner>,
    watcher: Arc<Mutex<Option<JoinHandle<()>>>>,
}

impl Live {
    /// An idle engine; the devices need not be there.
    ///
    /// # Errors
    /// [`LiveError::Config`] for a configuration that cannot work, [`LiveError::Disk`] when the session directory cannot be
    /// made.
    pub fn open(config: LiveConfig) -> Result<Self, LiveError> {
        Self::open_on(config, Ground::default())
    }

    /// As [`Self::open`], on other ground.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_on(config: LiveConfig, ground: Ground) -> Result<Self, LiveError> {
        let reconstructor = config.check()?;
        let directory = &config.sessions.directory;
        std::fs::create_dir_all(directory).map_err(|e| LiveError::disk(directory, format!("cannot make it: {e}")))?;
        let shown = Shown::of(&config, &*ground.disk);
        let inner = Arc::new(Inner {
            ground: Arc::new(ground),
            monitor: Arc::new(Monitor::default()),
            control: Mutex::new(Control::new(config, reconstructor)),
            shown: Mutex::new(shown),
            is_shut: AtomicBool::new(false),
            opened: Instant::now(),
        });
        let watched = Arc::downgrade(&inner);
        let watcher = std::thread::Builder::new().name("gv3-live".into()).spawn(move || watch::watch(&watched));
        let watcher = watcher.map_err(|_| LiveError::State("no thread can be started".into()))?;
        Ok(Self { inner, watcher: Arc::new(Mutex::new(Some(watcher))) })
    }

    /// How things stand.
    pub fn status(&self) -> LiveStatus {
        self.inner.shown().status(&self.inner.monitor, self.inner.opened.elapsed())
    }

    /// Counters since the engine was opened.
    pub fn metrics(&self) -> LiveMetrics {
        self.inner.monitor.metrics()
    }

    /// Opens the devices and lets them run; nothing to do when they do already.
    ///
    /// # Errors
    /// [`LiveError::Device`] and [`LiveError::Record`] when they cannot; the state is then failed.
    pub fn start_scanner(&self) -> Result<(), LiveError> {
        self.inner.control().start_scanner(&self.inner)
    }

    /// Ends a running recording and stops the devices; nothing to do when they are not running.
    ///
    /// # Errors
    /// What went wrong with the recording or the devices, which are stopped all the same.
    pub fn stop_scanner(&self) -> Result<(), LiveError> {
        self.inner.control().stop_scanner(&self.inner)
    }

    /// Begins a recording with the next frame set; starts the scanner if it is idle.
    ///
    /// # Errors
    /// [`LiveError::State`] while another recording runs, [`LiveError::Store`] for its name, [`LiveError::Space`] below the
    /// free-space floor, [`LiveError::Record`] when the file cannot be made.
    pub fn start_recording(&self, request: RecordingRequest) -> Result<RecordingStarted, LiveError> {
        self.inner.control().start_recording(&self.inner, request)
    }

    /// Ends the recording with the last frame set. When this returns, its files are closed, indexed and durable, were opened
    /// again, and ended with the group written last.
    ///
    /// # Errors
    /// [`LiveError::State`] when none runs, [`LiveError::Record`] when it cannot be finished; what was complete before is kept.
    pub fn stop_recording(&self) -> Result<RecordingStopped, LiveError> {
        self.inner.control().stop_recording(&self.inner)
    }

    /// Marks the newest frame set in the running recording; gives its tick.
    ///
    /// # Errors
    /// [`LiveError::State`] when no recording runs, [`LiveError::Text`] for a text longer than 1000 bytes.
    pub fn mark(&self, text: &str) -> Result<u64, LiveError> {
        self.inner.control().mark(&self.inner, text)
    }

    /// Takes another configuration: all of it or nothing. The scanner is started again when its devices change.
    ///
    /// # Errors
    /// [`LiveError::State`] while a recording runs and the devices would change, [`LiveError::Config`] for one that cannot
    /// work, [`LiveError::Device`] for one whose devices do not: the one before then holds on.
    pub fn reload(&self, config: LiveConfig) -> Result<(), LiveError> {
        self.inner.control().reload(&self.inner, config)
    }

    /// The configuration in use.
    pub fn config(&self) -> LiveConfig {
        self.inner.control().config.clone()
    }

    /// The newest frame sets.
    pub fn pictures(&self) -> latest::Receiver<Option<Arc<LivePicture>>> {
        self.inner.monitor.pictures()
    }

    /// Has frame sets come with their phase maps for as long as what this returns lives.
    pub fn want_maps(&self) -> MapsWanted {
        self.inner.monitor.want_maps()
    }

    /// Scans as they are asked for by [`Self::want_scan`].
    pub fn scans(&self) -> latest::Receiver<Option<Arc<LiveScan>>> {
        self.inner.monitor.scans()
    }

    /// Has the next scan be shown. Some ten megabytes are copied for it, so that each is asked for.
    pub fn want_scan(&self) {
        self.inner.monitor.want_scan();
    }

    /// Groups of recordings once they are on disk; every file's stream header comes first.
    pub fn groups(&self) -> broadcast::Receiver<Arc<LiveGroup>> {
        self.inner.monitor.groups()
    }

    /// Stream header of the newest file, for those who come after it was sent.
    pub fn stream_header(&self) -> Option<Arc<LiveGroup>> {
        self.inner.monitor.stream_header()
    }

    /// Drops, faults, gaps, marks and changes of state.
    pub fn events(&self) -> broadcast::Receiver<LiveEvent> {
        self.inner.monitor.events()
    }

    /// Stops everything; later calls fail.
    ///
    /// # Errors
    /// As [`Self::stop_scanner`].
    pub fn shut_down(self) -> Result<(), LiveError> {
        // First: nobody who waits for the commands' turn begins anything between the two.
        self.inner.is_shut.store(true, Ordering::Relaxed);
        let stopped = self.inner.control().stop_scanner(&self.inner);
        let watcher = self.watcher.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(watcher) = watcher {
            let _ = watcher.join();
        }
        stopped
    }
}

impl Inner {
    fn control(&self) -> MutexGuard<'_, Control> {
        self.control.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn shown(&self) -> MutexGuard<'_, Shown> {
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Another state, shown and announced.
    fn show(&self, state: LiveState, error: Option<String>) {
        let mut shown = self.shown();
        if (shown.state, &shown.error) == (state, &error) {
            return;
        }
        (shown.state, shown.error) = (state, error.clone());
        drop(shown);
        self.monitor.announce(state.name(), error);
    }
}
