//! A scanner whose time stands still until a test lets scans pass: what it proves does not depend on the machine's speed.

use super::{Ground, Live};
use crate::device::{self, Camera, CameraInfo, CameraSettings, DeviceError, Frame, Rig, RigConfig};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Far longer than a few scans take on the slowest machine.
const PATIENCE: Duration = Duration::from_secs(120);
/// Time between two looks at what moves.
const LOOK: Duration = Duration::from_micros(200);
/// Scans that may be on their way at once, and wait for the encoder when more are let pass: so few that nothing is left out.
const MOST_UNDERWAY: u64 = 4;

/// Lets scans pass; everything, once it is dropped.
pub(crate) struct Gate {
    /// Pictures allowed since the scanner was started.
    pictures: Arc<AtomicU64>,
    pictures_a_scan: u64,
    scans: u64,
}

impl Gate {
    /// A closed gate, and the ground of an engine whose pictures wait for it; the engine starts its scanner once.
    pub fn new(config: &RigConfig) -> (Self, Ground) {
        let pictures = Arc::new(AtomicU64::new(0));
        let allowed = Arc::clone(&pictures);
        let open_rig = move |config: &RigConfig| {
            let rig = device::open(config)?;
            Ok(Rig {
                camera: Box::new(GatedCamera { inner: rig.camera, allowed: Arc::clone(&allowed), given: 0 }),
                ..rig
            })
        };
        let gate = Self { pictures, pictures_a_scan: config.sequence.patterns.len() as u64, scans: 0 };
        (gate, Ground { open_rig: Box::new(open_rig), ..Ground::default() })
    }

    /// Scans let pass so far.
    pub fn scans(&self) -> u64 {
        self.scans
    }

    /// Lets so many scans pass, and returns when the last is made and the encoder has caught up with all but a few.
    #[track_caller]
    pub fn pass(&mut self, live: &Live, scans: u64) {
        let end = self.scans + scans;
        while self.scans < end {
            self.scans = (self.scans + MOST_UNDERWAY).min(end);
            self.pictures.store(self.scans * self.pictures_a_scan, Ordering::Relaxed);
            let begin = Instant::now();
            while live.metrics().scans < self.scans || live.status().queues.scans as u64 > MOST_UNDERWAY {
                assert!(begin.elapsed() < PATIENCE, "scan {} never came: {:?}", self.scans, live.status());
                std::thread::sleep(LOOK);
            }
        }
    }
}

impl Drop for Gate {
    /// A camera that waits holds up the end of its engine.
    fn drop(&mut self) {
        self.pictures.store(u64::MAX, Ordering::Relaxed);
    }
}

/// A live camera that has no picture before it is allowed.
struct GatedCamera {
    inner: Box<dyn Camera>,
    allowed: Arc<AtomicU64>,
    given: u64,
}

impl Camera for GatedCamera {
    fn info(&self) -> CameraInfo {
        CameraInfo { waits_for_reader: false, ..self.inner.info() }
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        self.inner.configure(want)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        self.inner.start()
    }

    /// The deadline is one of real time, which does not count here.
    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        while self.given >= self.allowed.load(Ordering::Relaxed) {
            std::thread::sleep(LOOK);
        }
        self.given += 1;
        self.inner.next_frame(deadline)
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.inner.stop()
    }
}
