//! The thread that reads a projector's events and finds it again when it was unplugged.

use super::transport::{UsbError, UsbTransport};
use super::{Shared, Wanted};
use crate::device::{DeviceError, Exposure, PatternIndex};
use gv3_protocol::gv3::{self, Decoder, Event};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;
use tracing::{debug, error, warn};

/// How long is waited for an event before looking whether to end.
const EVENT_TIME: Duration = Duration::from_millis(100);
/// How often a projector that was unplugged is looked for.
const SEARCH_PERIOD: Duration = Duration::from_millis(200);
/// Failed transfers in a row that are taken for an unplugged device.
const MOST_FAILURES: u32 = 3;

/// The thread; it ends when this is dropped.
pub(super) struct Watch {
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    /// Begins to read events.
    ///
    /// # Errors
    /// [`DeviceError::Failed`] when there is no thread to be had.
    pub fn begin(shared: Arc<Shared>) -> Result<Self, DeviceError> {
        let is_over = Arc::new(AtomicBool::new(false));
        let reader = Reader { shared, is_over: Arc::clone(&is_over), decoder: Decoder::default(), due: (0, 0) };
        let thread = std::thread::Builder::new().name("gv3-projector".into()).spawn(|| reader.run());
        let thread = thread.map_err(|e| DeviceError::Failed(format!("a thread for the projector's events: {e}")))?;
        Ok(Self { is_over, thread: Some(thread) })
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            error!("the thread of the projector's events died");
        }
    }
}

struct Reader {
    shared: Arc<Shared>,
    is_over: Arc<AtomicBool>,
    decoder: Decoder,
    /// Run and trigger that is to be reported next.
    due: (u64, u64),
}

impl Reader {
    fn run(mut self) {
        let mut failures = 0;
        while !self.is_over.load(Ordering::Relaxed) {
            let Some(transport) = self.shared.current.get() else {
                self.find_again();
                continue;
            };
            match transport.read_event(EVENT_TIME) {
                Ok(bytes) => {
                    failures = 0;
                    self.take(&bytes);
                }
                Err(UsbError::Timeout | UsbError::Stall) => {}
                Err(UsbError::Disconnected) => self.give_up(&transport),
                Err(error) => {
                    warn!(%error, "the projector's events");
                    failures += 1;
                    if failures >= MOST_FAILURES {
                        failures = 0;
                        self.give_up(&transport);
                    }
                }
            }
        }
    }

    /// The device behind a transport is gone, unless another was opened meanwhile.
    fn give_up(&mut self, gone: &Arc<dyn UsbTransport>) {
        let mut connection = self.shared.connection();
        if connection.link.as_ref().is_some_and(|link| Arc::ptr_eq(&link.transport(), gone)) {
            warn!(projector = connection.name(), "unplugged");
            connection.link = None;
            self.shared.current.set(None);
            self.shared.feed.end();
        }
    }

    /// Has a projector that should be showing something do so again, if it is back.
    fn find_again(&self) {
        {
            let mut connection = self.shared.connection();
            let wanted = connection.wanted;
            if connection.link.is_none() && wanted != Wanted::Dark {
                let found = self.shared.reopen(&mut connection);
                match found.and_then(|()| self.shared.show_wanted(&mut connection, wanted)) {
                    Ok(()) => return,
                    Err(error) => debug!(%error, "the projector is not back"),
                }
                connection.wanted = wanted;
            }
        }
        std::thread::sleep(SEARCH_PERIOD);
    }

    fn take(&mut self, bytes: &[u8]) {
        let damaged = self.decoder.damaged_bytes();
        self.decoder.push(bytes);
        while let Some(message) = self.decoder.next_message() {
            match Event::decode(&message) {
                Ok(Event::Exposure(exposure)) => self.exposed(&exposure),
                Ok(Event::Fault(fault)) => error!(fault = %fault.fault, "the projector went dark"),
                Err(error) => warn!(%error, "an event that cannot be read"),
            }
        }
        // An event is one transfer.
        self.decoder.discard();
        if self.decoder.damaged_bytes() > damaged {
            warn!(bytes = self.decoder.damaged_bytes() - damaged, "damaged event");
        }
    }

    fn exposed(&mut self, told: &gv3::Exposure) {
        let run = *self.shared.run();
        // Of the run before, still on its way.
        if told.device_time_nanos < run.armed_nanos {
            return;
        }
        let counted = told.set.checked_mul(run.pattern_count).and_then(|t| t.checked_add(told.position.into()));
        let due = if self.due.0 == run.number { self.due.1 } else { 0 };
        let is_sound = told.trigger >= due
            && counted == Some(told.trigger)
            && u64::from(told.position) < run.pattern_count
            && told.pattern == told.position;
        if !is_sound {
            warn!(?told, "an exposure that contradicts itself");
            return;
        }
        let lost = told.trigger - due;
        if lost > 0 {
            warn!(lost, trigger = told.trigger, "exposures not reported");
            self.shared.feed.lose(lost);
        }
        self.due = (run.number, told.trigger.saturating_add(1));
        let exposure = Exposure {
            sequence: told.trigger,
            set: told.set,
            pattern: PatternIndex(told.pattern),
            device_time_nanos: told.device_time_nanos,
            exposure_nanos: told.exposure_nanos,
        };
        self.shared.feed.push(run.number, exposure);
    }
}
