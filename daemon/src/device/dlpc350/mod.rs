//! The TI LightCrafter 4500 (DLPC350) as a projector.
//!
//! Patterns come from images in its flash, written there beforehand with TI's tools, or from the bit planes of its video
//! input; gv3 itself never writes flash. TRIG_OUT_1 is high while a pattern is exposed, TRIG_OUT_2 marks the first pattern.
//! A thread looks every second whether the sequence still runs, and starts it again after the projector fell back to video
//! mode or was unplugged.

mod config;
mod conversation;
mod driver;
pub mod emulator;
#[cfg(target_os = "linux")]
mod hidraw;
mod link;
#[cfg(feature = "nusb")]
mod nusb;
mod planes;
mod program;
mod rehearsal;
#[cfg(test)]
mod tests;

use super::{DeviceError, ExposureFeed, PatternIndex, Projector, ProjectorInfo, SequenceTiming};
use crate::light::PatternSequence;
use driver::Driver;
use gv3_protocol::dlpc350::{HEIGHT_PX, WIDTH_PX};
use link::Wanted;
use program::Program;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

pub use config::{Dlpc350Config, Light, LinkKind, Source, TriggerOut1Config, TriggerOut2Config};
pub use driver::Dlpc350Counters;
#[cfg(target_os = "linux")]
pub use hidraw::{HidrawLink, HidrawNode, find_hidraw};
pub use link::{HidLink, HidOpener, LinkError};
pub use planes::{PackedImage, pack_images};
pub use rehearsal::{EmulatedProjector, open_simulated};

/// How often the projector is looked at.
const WATCH_INTERVAL: Duration = Duration::from_secs(1);

/// A LightCrafter 4500.
pub struct Dlpc350Projector {
    driver: Arc<Mutex<Driver>>,
    config: Dlpc350Config,
    firmware: String,
    /// Patterns of the loaded sequence.
    loaded: Option<usize>,
    /// Ends the watch when it is dropped.
    watch: Option<(Sender<()>, JoinHandle<()>)>,
}

impl Dlpc350Projector {
    /// Opens the projector that a configuration means and makes it dark.
    ///
    /// # Errors
    /// [`DeviceError`] naming the field, or what to do: not found, no rights, not well.
    pub fn open(config: &Dlpc350Config) -> Result<Self, DeviceError> {
        let opener: Box<dyn HidOpener> = match config.link {
            #[cfg(target_os = "linux")]
            LinkKind::Hidraw => Box::new(hidraw::HidrawOpener(Wanted::new(config))),
            #[cfg(feature = "nusb")]
            LinkKind::Usb => Box::new(nusb::NusbOpener(Wanted::new(config))),
            LinkKind::Emulated => Box::new(emulator::EmulatedLink::default()),
            #[cfg(not(all(target_os = "linux", feature = "nusb")))]
            _ => {
                let reason = "this build of gv3 cannot reach the projector so";
                return Err(DeviceError::config("projector.dlpc350.link", reason));
            }
        };
        Self::open_with(config, opener, WATCH_INTERVAL)
    }

    /// The same over a cable of the caller's, looked at every `watch_interval`.
    ///
    /// # Errors
    /// As [`Dlpc350Projector::open`].
    pub fn open_with(
        config: &Dlpc350Config,
        opener: Box<dyn HidOpener>,
        watch_interval: Duration,
    ) -> Result<Self, DeviceError> {
        config.validate()?;
        let mut driver = Driver::open(config.clone(), opener)?;
        let firmware = driver.firmware()?;
        let driver = Arc::new(Mutex::new(driver));
        let watch = Some(watch(Arc::clone(&driver), watch_interval)?);
        Ok(Self { driver, config: config.clone(), firmware, loaded: None, watch })
    }

    /// What happened since it was opened.
    pub fn counters(&self) -> Dlpc350Counters {
        self.driver().counters
    }

    fn driver(&self) -> MutexGuard<'_, Driver> {
        lock(&self.driver)
    }
}

fn lock(driver: &Mutex<Driver>) -> MutexGuard<'_, Driver> {
    driver.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Looks at the projector in a thread of its own until the sender is dropped.
fn watch(driver: Arc<Mutex<Driver>>, interval: Duration) -> Result<(Sender<()>, JoinHandle<()>), DeviceError> {
    let (end, ended) = channel();
    let look = move || {
        while ended.recv_timeout(interval) == Err(RecvTimeoutError::Timeout) {
            lock(&driver).watch();
        }
    };
    let thread = std::thread::Builder::new().name("gv3-dlpc350".into()).spawn(look);
    let thread = thread.map_err(|e| DeviceError::Failed(format!("thread gv3-dlpc350: {e}")))?;
    Ok((end, thread))
}

impl Projector for Dlpc350Projector {
    fn info(&self) -> ProjectorInfo {
        let least_us = self.config.least_exposure_us().map_or(0, u64::from);
        ProjectorInfo {
            model: format!("TI LightCrafter 4500, {}", self.firmware),
            serial: self.config.serial.clone().or(self.config.bus_path.clone()).unwrap_or_default(),
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            min_period_nanos: least_us * 1000,
            hardware_sequence: true,
        }
    }

    /// Notes how many patterns there are. Their pictures are in flash or come by video already.
    fn load(&mut self, sequence: &PatternSequence) -> Result<(), DeviceError> {
        sequence.validate()?;
        if [sequence.width_px, sequence.height_px] != [WIDTH_PX, HEIGHT_PX] {
            let size = format!("{} x {}", sequence.width_px, sequence.height_px);
            let reason = format!("{size}, but the projector has {WIDTH_PX} x {HEIGHT_PX}");
            return Err(DeviceError::config("sequence.width_px", reason));
        }
        program::check_fit(&self.config, sequence.patterns.len())?;
        self.loaded = Some(sequence.patterns.len());
        Ok(())
    }

    fn play(&mut self, timing: &SequenceTiming) -> Result<(), DeviceError> {
        let Some(count) = self.loaded else {
            return Err(DeviceError::State("the projector plays before a sequence is loaded"));
        };
        let program = Program::sequence(&self.config, count, timing)?;
        self.driver().play(program)
    }

    fn show(&mut self, pattern: PatternIndex) -> Result<(), DeviceError> {
        let index = usize::from(pattern.0);
        if self.loaded.is_none_or(|count| index >= count) {
            return Err(DeviceError::State("the projector shows a pattern that is not loaded"));
        }
        let program = Program::still(&self.config, index)?;
        self.driver().play(program)
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.driver().stop()
    }

    fn exposures(&self) -> Option<ExposureFeed> {
        Some(self.driver().runs.clone())
    }
}

impl Drop for Dlpc350Projector {
    fn drop(&mut self) {
        if let Some((end, thread)) = self.watch.take() {
            drop(end);
            // A watch that panicked has said so itself.
            let _ = thread.join();
        }
        // Unplugged is dark too.
        let _ = self.driver().stop();
    }
}
