//! The cable to the simulated projector in this process, with the faults that cables have.

use super::transport::{UsbError, UsbOpener, UsbPlace, UsbTransport};
use crate::device::sim::{Gv3Device, SimWorld};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Longest transfer that is asked for, as the other transports do.
const REPLY_BYTES: usize = 512;
/// How often is looked for what is not there yet.
const LOOK_AGAIN: Duration = Duration::from_micros(500);

/// How a transfer goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CableFault {
    /// The request does not arrive.
    LostRequest,
    /// The request arrives with one byte changed.
    CorruptRequest,
    /// The reply does not arrive.
    LostReply,
    /// The reply arrives with one byte changed.
    CorruptReply,
    /// Half of the reply arrives.
    ShortReply,
    /// A zero-length packet arrives before the reply.
    EmptyReply,
    /// The endpoint of the reply stalls.
    StalledReply,
    /// The cable is pulled while the reply is on its way.
    PulledOut,
}

/// Tells the device's time, nanoseconds.
type Clock = Box<dyn Fn() -> u64 + Send + Sync>;
/// Looks at what the device does after a request.
type Onlooker = Box<dyn Fn(&Gv3Device) + Send + Sync>;

/// A place where the simulated projector is plugged in.
pub struct Socket {
    device: Mutex<Plugged>,
    clock: Clock,
    onlooker: Onlooker,
    faults: Mutex<VecDeque<CableFault>>,
}

struct Plugged {
    device: Option<Gv3Device>,
    /// How often something was plugged in.
    number: u64,
}

impl Socket {
    /// A projector by itself, its clock that of the host.
    pub fn new(device: Gv3Device) -> Arc<Self> {
        let begin = Instant::now();
        let clock = move || u64::try_from(begin.elapsed().as_nanos()).unwrap_or(u64::MAX);
        Self::with(device, Box::new(clock), Box::new(|_| {}))
    }

    /// A projector that lights a world and goes by its time.
    pub fn in_world(device: Gv3Device, world: Arc<Mutex<SimWorld>>) -> Arc<Self> {
        let lit = Arc::clone(&world);
        let clock = move || world.lock().unwrap_or_else(PoisonError::into_inner).clock_nanos();
        let onlooker = move |device: &Gv3Device| lit.lock().unwrap_or_else(PoisonError::into_inner).follow(device);
        Self::with(device, Box::new(clock), Box::new(onlooker))
    }

    fn with(device: Gv3Device, clock: Clock, onlooker: Onlooker) -> Arc<Self> {
        let device = Mutex::new(Plugged { device: Some(device), number: 0 });
        Arc::new(Self { device, clock, onlooker, faults: Mutex::default() })
    }

    /// Opens whatever is plugged in.
    pub fn opener(self: &Arc<Self>) -> UsbOpener {
        let socket = Arc::clone(self);
        Box::new(move || {
            let plugged = socket.lock();
            let Some(device) = &plugged.device else {
                return Err(UsbError::NotFound("the simulated projector is not plugged in".into()));
            };
            let place = UsbPlace { bus_path: "0-1".into(), serial: Some(device.identity().serial.clone()) };
            Ok(Arc::new(InProcess { place, number: plugged.number, socket: Arc::clone(&socket) }))
        })
    }

    /// Has the transfers of the next requests go wrong, one fault each.
    pub fn fail_next(&self, faults: impl IntoIterator<Item = CableFault>) {
        self.faults.lock().unwrap_or_else(PoisonError::into_inner).extend(faults);
    }

    /// Pulls the cable out.
    pub fn unplug(&self) {
        let mut plugged = self.lock();
        if let Some(mut device) = plugged.device.take() {
            device.power_off();
            (self.onlooker)(&device);
        }
    }

    /// Plugs a device in that was just powered on.
    pub fn plug(&self, device: Gv3Device) {
        let mut plugged = self.lock();
        plugged.number += 1;
        plugged.device = Some(device);
    }

    /// Does something with the device that is plugged in, if one is.
    pub fn with_device<T>(&self, act: impl FnOnce(&mut Gv3Device) -> T) -> Option<T> {
        self.lock().device.as_mut().map(act)
    }

    fn lock(&self) -> MutexGuard<'_, Plugged> {
        self.device.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The fault of the request under way, if it is one that `is_meant` picks out.
    fn fault(&self, is_meant: impl Fn(CableFault) -> bool) -> Option<CableFault> {
        let mut faults = self.faults.lock().unwrap_or_else(PoisonError::into_inner);
        if faults.front().is_some_and(|fault| is_meant(*fault)) { faults.pop_front() } else { None }
    }
}

/// The host's end of the cable.
struct InProcess {
    place: UsbPlace,
    number: u64,
    socket: Arc<Socket>,
}

impl InProcess {
    /// Uses the device at its present time, if it is still the one that was opened.
    fn device<T>(&self, act: impl FnOnce(&mut Gv3Device) -> T) -> Result<T, UsbError> {
        let mut plugged = self.socket.lock();
        let is_same = plugged.number == self.number;
        let device = plugged.device.as_mut().filter(|_| is_same).ok_or(UsbError::Disconnected)?;
        device.advance_to((self.socket.clock)());
        let result = act(device);
        (self.socket.onlooker)(device);
        Ok(result)
    }

    /// Looks until there is something.
    fn wait(
        &self,
        timeout: Duration,
        mut look: impl FnMut(&mut Gv3Device) -> Option<Vec<u8>>,
    ) -> Result<Vec<u8>, UsbError> {
        let deadline = Instant::now() + timeout;
        loop {
            if let Some(bytes) = self.device(&mut look)? {
                return Ok(bytes);
            }
            if Instant::now() >= deadline {
                return Err(UsbError::Timeout);
            }
            std::thread::sleep(LOOK_AGAIN);
        }
    }
}

fn with_one_byte_changed(bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    if let Some(byte) = bytes.last_mut() {
        *byte ^= 0x10;
    }
    bytes
}

impl UsbTransport for InProcess {
    fn place(&self) -> &UsbPlace {
        &self.place
    }

    fn control_in(&self, request: u8, length: u16, _timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let [low, high] = length.to_le_bytes();
        self.device(|d| d.handle_control([0xc1, request, 0, 0, 0, 0, low, high], &[]))?.map_err(|_| UsbError::Stall)
    }

    fn control_out(&self, request: u8, _timeout: Duration) -> Result<(), UsbError> {
        let answer = self.device(|d| d.handle_control([0x41, request, 0, 0, 0, 0, 0, 0], &[]))?;
        answer.map(drop).map_err(|_| UsbError::Stall)
    }

    fn write(&self, message: &[u8], _timeout: Duration) -> Result<(), UsbError> {
        match self.socket.fault(|f| matches!(f, CableFault::LostRequest | CableFault::CorruptRequest)) {
            Some(CableFault::LostRequest) => Ok(()),
            Some(_) => self.device(|d| d.write_out(&with_one_byte_changed(message))),
            None => self.device(|d| d.write_out(message)),
        }
    }

    fn read(&self, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let take = |d: &mut Gv3Device| d.read_in(REPLY_BYTES);
        match self.socket.fault(|f| !matches!(f, CableFault::LostRequest | CableFault::CorruptRequest)) {
            None => self.wait(timeout, take),
            Some(CableFault::LostReply) => self.wait(timeout, take).and(Err(UsbError::Timeout)),
            Some(CableFault::CorruptReply) => Ok(with_one_byte_changed(&self.wait(timeout, take)?)),
            Some(CableFault::ShortReply) => {
                let reply = self.wait(timeout, take)?;
                Ok(reply[..reply.len() / 2].to_vec())
            }
            Some(CableFault::EmptyReply) => Ok(Vec::new()),
            Some(CableFault::PulledOut) => {
                self.socket.unplug();
                Err(UsbError::Disconnected)
            }
            Some(_) => Err(UsbError::Stall),
        }
    }

    fn read_event(&self, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        let clock = &self.socket.clock;
        self.wait(timeout, |d| d.poll_events(clock()))
    }
}
