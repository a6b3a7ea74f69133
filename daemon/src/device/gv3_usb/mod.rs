//! Projectors that speak the gv3 vendor protocol (GV3.md), over any [`UsbTransport`].
//!
//! A projector that is unplugged is found again by its serial number or its place when it is next used; while it should be
//! playing or showing it is looked for by itself, loaded anew and set going again.

mod in_process;
mod link;
#[cfg(feature = "nusb")]
mod nusb;
#[cfg(feature = "rusb")]
mod rusb;
#[cfg(test)]
mod tests;
mod transport;
mod watch;

pub use in_process::{CableFault, Socket};
#[cfg(feature = "nusb")]
pub use nusb::NusbTransport;
#[cfg(feature = "nusb")]
pub(super) use nusb::plugged;
#[cfg(feature = "rusb")]
pub use rusb::RusbTransport;
pub use transport::{
    UsbEndpoint, UsbError, UsbOpener, UsbPipes, UsbPlace, UsbSelector, UsbTransport, UsbTransportKind,
};

use super::{
    DeviceError, ExposureFeed, PatternIndex, Projector, ProjectorConfig, ProjectorInfo, RigConfig, SequenceTiming, sim,
};
use crate::light::{Direction, PatternSequence};
use gv3_protocol::gv3::{Axis, BodyError, Identity, Refusal, Reply, Request, Timing};
use link::{Current, Link, LinkError};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tracing::{info, warn};
use watch::Watch;

/// Opens the projector that a configuration names.
///
/// # Errors
/// [`DeviceError`] saying what is plugged in, or which right is missing.
pub fn open(config: &ProjectorConfig) -> Result<Gv3Projector, DeviceError> {
    let selector = UsbSelector { serial: config.serial.clone(), bus_path: config.bus_path.clone() };
    Gv3Projector::open(transport::opener(config.transport.unwrap_or_default(), selector)?)
}

/// The simulated camera in the light of the simulated projector behind the protocol.
///
/// # Errors
/// [`DeviceError::Config`] naming what cannot be simulated.
pub fn open_simulated(config: &RigConfig) -> Result<(sim::SimCamera, Gv3Projector), DeviceError> {
    let world = Arc::new(Mutex::new(sim::SimWorld::new(config)?));
    let size_px = [config.sequence.width_px, config.sequence.height_px];
    let serial = config.projector.serial.as_deref().unwrap_or("sim-projector-1");
    let device = sim::Gv3Device::simulated(size_px, serial);
    let projector = Gv3Projector::open(Socket::in_world(device, Arc::clone(&world)).opener())?;
    Ok((sim::SimCamera::new(world), projector))
}

/// What the projector is to show, also after it was unplugged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wanted {
    Dark,
    Still(PatternIndex),
    Playing(SequenceTiming),
}

/// What both the caller and the thread that reads events use.
struct Shared {
    opener: UsbOpener,
    connection: Mutex<Connection>,
    current: Current,
    feed: ExposureFeed,
    run: Mutex<Run>,
}

/// The device as far as it is known.
struct Connection {
    link: Option<Link>,
    identity: Identity,
    stored: Option<PatternSequence>,
    wanted: Wanted,
}

/// Which exposures belong to the run under way.
#[derive(Debug, Clone, Copy, Default)]
struct Run {
    /// As the feed counts runs.
    number: u64,
    /// When it was armed, on the device's clock, nanoseconds.
    armed_nanos: u64,
    pattern_count: u64,
}

/// A projector behind the vendor protocol.
pub struct Gv3Projector {
    shared: Arc<Shared>,
    _watch: Watch,
}

impl Gv3Projector {
    /// Finds and opens the projector.
    ///
    /// # Errors
    /// [`DeviceError`] saying what is plugged in, or which right is missing.
    pub fn open(opener: UsbOpener) -> Result<Self, DeviceError> {
        let link = Link::open(&opener).map_err(|e| device_error(e, "the projector"))?;
        info!(place = %link.transport().place(), model = link.identity().model, "projector");
        let current = Current::default();
        current.set(Some(link.transport()));
        let identity = link.identity().clone();
        let connection = Connection { link: Some(link), identity, stored: None, wanted: Wanted::Dark };
        let shared = Arc::new(Shared {
            opener,
            connection: Mutex::new(connection),
            current,
            feed: ExposureFeed::default(),
            run: Mutex::default(),
        });
        Ok(Self { _watch: Watch::begin(Arc::clone(&shared))?, shared })
    }
}

impl Projector for Gv3Projector {
    fn info(&self) -> ProjectorInfo {
        let identity = self.shared.connection().identity.clone();
        ProjectorInfo {
            model: identity.model,
            serial: identity.serial,
            width_px: identity.width_px.into(),
            height_px: identity.height_px.into(),
            min_period_nanos: identity.min_period_nanos,
            hardware_sequence: true,
        }
    }

    fn load(&mut self, sequence: &PatternSequence) -> Result<(), DeviceError> {
        sequence.validate()?;
        let mut connection = self.shared.connection();
        check_fits(sequence, &connection.identity)?;
        (connection.stored, connection.wanted) = (None, Wanted::Dark);
        self.shared.with_link(&mut connection, |link| upload(link, sequence))?;
        connection.stored = Some(sequence.clone());
        Ok(())
    }

    fn play(&mut self, timing: &SequenceTiming) -> Result<(), DeviceError> {
        timing.validate()?;
        let mut connection = self.shared.connection();
        if timing.picture_period_nanos < connection.identity.min_period_nanos {
            let reason = format!("{} is shorter than a pattern can be shown", timing.picture_period_nanos);
            return Err(DeviceError::config("timing.picture_period_nanos", reason));
        }
        if connection.stored.is_none() {
            return Err(DeviceError::State("the projector plays before a sequence is loaded"));
        }
        self.shared.show_wanted(&mut connection, Wanted::Playing(*timing))
    }

    fn show(&mut self, pattern: PatternIndex) -> Result<(), DeviceError> {
        let mut connection = self.shared.connection();
        if connection.stored.as_ref().is_none_or(|stored| usize::from(pattern.0) >= stored.patterns.len()) {
            return Err(DeviceError::State("the projector shows a pattern that is not loaded"));
        }
        self.shared.show_wanted(&mut connection, Wanted::Still(pattern))
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        let mut connection = self.shared.connection();
        connection.wanted = Wanted::Dark;
        if connection.link.is_none() {
            return Err(DeviceError::Disconnected(connection.name()));
        }
        self.shared.with_link(&mut connection, |link| link.ask(&Request::Stop).map(drop))
    }

    fn exposures(&self) -> Option<ExposureFeed> {
        Some(self.shared.feed.clone())
    }
}

/// Nothing goes on shining when the program no longer cares.
impl Drop for Gv3Projector {
    fn drop(&mut self) {
        let is_lit = self.shared.connection().wanted != Wanted::Dark;
        if is_lit && let Err(error) = self.stop() {
            warn!(%error, "the projector may not be dark");
        }
    }
}

impl Connection {
    fn name(&self) -> String {
        format!("{} {}", self.identity.model, self.identity.serial)
    }
}

impl Shared {
    fn connection(&self) -> MutexGuard<'_, Connection> {
        self.connection.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn run(&self) -> MutexGuard<'_, Run> {
        self.run.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// From now on exposures of the run before do not count.
    fn begin_run(&self, armed_nanos: u64, pattern_count: u64) {
        let mut run = self.run();
        *run = Run { number: self.feed.begin(), armed_nanos, pattern_count };
    }

    /// Uses the link, opened anew if it was lost; a transport that fails is lost.
    fn with_link<T>(
        &self,
        connection: &mut Connection,
        act: impl FnOnce(&mut Link) -> Result<T, LinkError>,
    ) -> Result<T, DeviceError> {
        self.reopen(connection)?;
        let name = connection.name();
        let Some(link) = &mut connection.link else { return Err(DeviceError::Disconnected(name)) };
        let result = act(link).map_err(|error| explain(link, error));
        if let Err(LinkError::Usb(error)) = &result {
            warn!(%error, projector = name, "connection lost");
            connection.link = None;
            self.current.set(None);
            self.feed.end();
        }
        result.map_err(|error| device_error(error, &name))
    }

    /// Finds a lost projector again and gives it the patterns it had.
    fn reopen(&self, connection: &mut Connection) -> Result<(), DeviceError> {
        if connection.link.is_some() {
            return Ok(());
        }
        let name = connection.name();
        let again = |error| match error {
            LinkError::Usb(UsbError::NotFound(_)) => DeviceError::Disconnected(name.clone()),
            other => device_error(other, &name),
        };
        let mut link = Link::open(&self.opener).map_err(again)?;
        if let Some(stored) = &connection.stored {
            check_fits(stored, link.identity())?;
            upload(&mut link, stored).map_err(again)?;
        }
        connection.identity = link.identity().clone();
        info!(place = %link.transport().place(), "projector found again");
        self.current.set(Some(link.transport()));
        connection.link = Some(link);
        Ok(())
    }

    /// Shows what is wanted from now on.
    fn show_wanted(&self, connection: &mut Connection, wanted: Wanted) -> Result<(), DeviceError> {
        let pattern_count = connection.stored.as_ref().map_or(0, |stored| stored.patterns.len() as u64);
        // Wanted only once it was possible: what the device refuses is not tried again by itself.
        connection.wanted = Wanted::Dark;
        match wanted {
            Wanted::Dark => {}
            Wanted::Still(PatternIndex(position)) => self.with_link(connection, |link| {
                link.ask(&Request::Stop)?;
                link.ask(&Request::Show(position)).map(drop)
            })?,
            Wanted::Playing(timing) => {
                let set = self.with_link(connection, |link| arm(link, &timing))?;
                check_timing(&timing, &set)?;
                self.with_link(connection, |link| {
                    let Reply::Status(status) = link.ask(&Request::Status)? else { return Ok(()) };
                    self.begin_run(status.device_time_nanos, pattern_count);
                    link.ask(&Request::Start).map(drop)
                })?;
            }
        }
        connection.wanted = wanted;
        Ok(())
    }
}

/// Stores a sequence in a projector that is dark afterwards.
fn upload(link: &mut Link, sequence: &PatternSequence) -> Result<(), LinkError> {
    link.ask(&Request::ClearFault)?;
    link.ask(&Request::Stop)?;
    link.ask(&Request::Clear)?;
    // At most MAX_PATTERNS, as check_fits has found.
    let order: Vec<u16> = (0..sequence.patterns.len() as u16).collect();
    for &index in &order {
        let pattern = &sequence.patterns[usize::from(index)];
        let axis = match pattern.direction {
            Direction::Columns => Axis::Columns,
            Direction::Rows => Axis::Rows,
        };
        let levels = pattern.levels(sequence.length_px(index.into()));
        link.ask(&Request::Pattern { index, axis, levels })?;
    }
    link.ask(&Request::Order(order)).map(drop)
}

/// Stops and arms; gives the timing that the device will keep.
fn arm(link: &mut Link, timing: &SequenceTiming) -> Result<Timing, LinkError> {
    let wanted = Timing { period_nanos: timing.picture_period_nanos, exposure_nanos: timing.exposure_nanos };
    link.ask(&Request::ClearFault)?;
    link.ask(&Request::Stop)?;
    let reply = link.ask(&Request::Timing(wanted))?;
    link.ask(&Request::Arm)?;
    Ok(match reply {
        Reply::Timing(set) => set,
        _ => wanted,
    })
}

/// A device may round, but not so far that frame sets drift off the schedule.
fn check_timing(wanted: &SequenceTiming, set: &Timing) -> Result<(), DeviceError> {
    /// One part in this.
    const TOLERANCE: u64 = 1000;
    let pairs = [
        ("timing.picture_period_nanos", wanted.picture_period_nanos, set.period_nanos),
        ("timing.exposure_nanos", wanted.exposure_nanos, set.exposure_nanos),
    ];
    match pairs.into_iter().find(|(_, wanted, set)| wanted.abs_diff(*set) > wanted / TOLERANCE) {
        Some((field, wanted, set)) => {
            Err(DeviceError::config(field, format!("{wanted}, but the projector can only do {set}; write that")))
        }
        None => Ok(()),
    }
}

fn check_fits(sequence: &PatternSequence, identity: &Identity) -> Result<(), DeviceError> {
    let size = [identity.width_px, identity.height_px].map(u32::from);
    if [sequence.width_px, sequence.height_px] != size {
        let [width, height] = size;
        let reason =
            format!("{} x {}, but the projector has {width} x {height}", sequence.width_px, sequence.height_px);
        return Err(DeviceError::config("sequence.width_px", reason));
    }
    let room = identity.max_patterns.min(identity.max_order);
    if sequence.patterns.len() > room.into() {
        let reason = format!("{} patterns, but the projector has room for {room}", sequence.patterns.len());
        return Err(DeviceError::config("sequence.patterns", reason));
    }
    Ok(())
}

/// A refusal because of a fault says only that there is one; the status says which.
fn explain(link: &mut Link, error: LinkError) -> LinkError {
    let LinkError::Body(BodyError::Refused { refusal: Refusal::Fault, .. }) = &error else { return error };
    let Ok(Reply::Status(status)) = link.ask(&Request::Status) else { return error };
    let Some(fault) = status.fault else { return error };
    let degrees = [("electronics", status.board_millidegrees), ("light source", status.light_millidegrees)]
        .into_iter()
        .filter_map(|(part, milli)| Some(format!(", {part} at {:.1} °C", f64::from(milli?) / 1000.0)));
    let text = format!("{fault}{}; let it cool or mend it, then start again", degrees.collect::<String>());
    LinkError::Body(BodyError::Refused { refusal: Refusal::Fault, text })
}

fn device_error(error: LinkError, name: &str) -> DeviceError {
    match error {
        LinkError::Usb(error) => error.of(name),
        LinkError::Body(error) => DeviceError::Failed(format!("{name}: {error}")),
    }
}
