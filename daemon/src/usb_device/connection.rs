//! One plugged-in device: a session of requests and answers, and the two threads that move its bytes.

use super::bus::TooManyWaiting;
use super::{Bus, Completion, Request, UsbDevice, WireError};
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Answers that may wait for a slow host; above it nothing more is read or asked of the device.
const MAX_OUTBOX_BYTES: usize = 1 << 20;
/// A host that takes nothing for this long is gone.
const WRITE_TIMEOUT: Duration = Duration::from_secs(30);

/// A device that several threads look at.
pub type SharedDevice = Arc<Mutex<dyn UsbDevice>>;

/// How transfers are written down on a stream. Bytes that break the rules end the connection.
pub trait Wire: Send {
    /// Takes bytes of the host.
    fn push(&mut self, bytes: &[u8]);
    /// The next request that is whole.
    ///
    /// # Errors
    /// [`WireError`] for bytes that are none.
    fn next_request(&mut self) -> Result<Option<Request>, WireError>;
    /// Appends an answer to `out`.
    fn write(&mut self, completion: &Completion, out: &mut Vec<u8>);
}

/// Why a session ends before the host leaves.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SessionError {
    /// Bytes that break the protocol.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// Too much is asked for at once.
    #[error(transparent)]
    TooMany(#[from] TooManyWaiting),
}

/// Requests and answers of one plugged-in device, free of input and output.
pub struct Session {
    wire: Box<dyn Wire>,
    bus: Bus,
    done: Vec<Completion>,
}

impl Session {
    /// A session on a wire.
    pub fn new(wire: Box<dyn Wire>) -> Self {
        Self { wire, bus: Bus::default(), done: Vec::new() }
    }

    /// Takes bytes of the host.
    pub fn push(&mut self, bytes: &[u8]) {
        self.wire.push(bytes);
    }

    /// Handles one request of the bytes taken and appends what it completes to `out`; false when there is none.
    ///
    /// # Errors
    /// [`SessionError`] when the connection is to be closed.
    pub fn handle(&mut self, device: &mut dyn UsbDevice, out: &mut Vec<u8>) -> Result<bool, SessionError> {
        let Some(request) = self.wire.next_request()? else { return Ok(false) };
        let handled = self.bus.handle(request, device, &mut self.done);
        self.write(out);
        handled?;
        Ok(true)
    }

    /// Appends to `out` what the device has for waiting transfers, about `budget_bytes` at most.
    pub fn pump(&mut self, device: &mut dyn UsbDevice, budget_bytes: usize, out: &mut Vec<u8>) {
        self.bus.pump(device, budget_bytes, &mut self.done);
        self.write(out);
    }

    fn write(&mut self, out: &mut Vec<u8>) {
        for completion in self.done.drain(..) {
            self.wire.write(&completion, out);
        }
    }
}

/// Wakes the threads that wait for a device to have something.
#[derive(Debug, Default)]
pub struct Bell {
    count: Mutex<u64>,
    rung: Condvar,
}

impl Bell {
    /// How often it has rung.
    pub fn count(&self) -> u64 {
        *lock(&self.count)
    }

    /// Something has changed.
    pub fn ring(&self) {
        *lock(&self.count) += 1;
        self.rung.notify_all();
    }

    /// Waits until it has rung more than `seen` times, or for `timeout`.
    pub fn wait(&self, seen: u64, timeout: Duration) {
        let waited = self.rung.wait_timeout_while(lock(&self.count), timeout, |count| *count == seen);
        drop(waited.unwrap_or_else(PoisonError::into_inner));
    }
}

fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A socket.
pub trait Stream: Read + Write + Send + Sized + 'static {
    /// Another handle on it.
    ///
    /// # Errors
    /// As the system says.
    fn another(&self) -> io::Result<Self>;
    /// Bounds the time a write may take.
    ///
    /// # Errors
    /// As the system says.
    fn bound_writes(&self, timeout: Duration) -> io::Result<()>;
    /// Ends it for both sides.
    fn hang_up(&self);
}

macro_rules! stream {
    ($socket:ty) => {
        impl Stream for $socket {
            fn another(&self) -> io::Result<Self> {
                self.try_clone()
            }
            fn bound_writes(&self, timeout: Duration) -> io::Result<()> {
                self.set_write_timeout(Some(timeout))
            }
            fn hang_up(&self) {
                // It may be gone already.
                let _ = self.shutdown(Shutdown::Both);
            }
        }
    };
}
stream!(TcpStream);
stream!(UnixStream);

/// How a connection ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum End {
    /// The host has gone.
    HostLeft,
    /// The device had its cable pulled.
    Unplugged,
    /// The host broke the rules.
    Refused(SessionError),
}

struct State {
    session: Session,
    outbox: Vec<u8>,
    end: Option<End>,
}

/// What both threads of a connection share.
struct Connection {
    state: Mutex<State>,
    has_room: Condvar,
    device: SharedDevice,
    bell: Arc<Bell>,
}

impl Connection {
    /// Reads until the host leaves or breaks the rules.
    fn read(&self, mut stream: impl Read) -> End {
        let mut bytes = vec![0; 1 << 16];
        loop {
            let count = match stream.read(&mut bytes) {
                Ok(0) => return End::HostLeft,
                Ok(count) => count,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
                Err(_) => return End::HostLeft,
            };
            let mut state = lock(&self.state);
            state.session.push(&bytes[..count]);
            loop {
                let is_full = |s: &mut State| s.end.is_none() && s.outbox.len() > MAX_OUTBOX_BYTES;
                state = self.has_room.wait_while(state, is_full).unwrap_or_else(PoisonError::into_inner);
                let State { session, outbox, .. } = &mut *state;
                match session.handle(&mut *lock(&self.device), outbox) {
                    Ok(true) => {}
                    Ok(false) => break,
                    Err(error) => return End::Refused(error),
                }
            }
            drop(state);
            self.bell.ring();
        }
    }

    /// What is to be written now; none when the connection is over.
    fn answers(&self) -> Option<Vec<u8>> {
        let mut state = lock(&self.state);
        let mut device = lock(&self.device);
        if state.end.is_none() && device.take_unplug() {
            state.end = Some(End::Unplugged);
        }
        if state.end.is_some() {
            return None;
        }
        let State { session, outbox, .. } = &mut *state;
        session.pump(&mut *device, MAX_OUTBOX_BYTES.saturating_sub(outbox.len()), outbox);
        self.has_room.notify_all();
        Some(std::mem::take(outbox))
    }

    fn write(&self, stream: &mut impl Write) {
        loop {
            let seen = self.bell.count();
            let Some(answers) = self.answers() else { return };
            if answers.is_empty() {
                self.bell.wait(seen, Duration::from_millis(100));
            } else if stream.write_all(&answers).is_err() {
                return self.finish(End::HostLeft);
            }
        }
    }

    fn finish(&self, end: End) {
        lock(&self.state).end.get_or_insert(end);
        self.has_room.notify_all();
        self.bell.ring();
    }
}

/// Serves a device on a stream until one of them goes. `begin` is sent first.
///
/// # Errors
/// When the stream cannot be shared by two threads.
pub fn serve<S: Stream>(
    mut stream: S,
    session: Session,
    begin: Vec<u8>,
    device: SharedDevice,
    bell: Arc<Bell>,
) -> io::Result<End> {
    stream.bound_writes(WRITE_TIMEOUT)?;
    let reading = stream.another()?;
    let state = Mutex::new(State { session, outbox: begin, end: None });
    let connection = Arc::new(Connection { state, has_room: Condvar::new(), device, bell });
    lock(&connection.device).reset();
    let reader = Arc::clone(&connection);
    let thread = std::thread::Builder::new().name("usb-reader".into()).spawn(move || {
        let end = reader.read(reading);
        reader.finish(end);
    })?;
    connection.write(&mut stream);
    stream.hang_up();
    // A reader that panicked has told so itself.
    let _ = thread.join();
    lock(&connection.device).reset();
    let end = lock(&connection.state).end.take();
    Ok(end.unwrap_or(End::HostLeft))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::usb_device::bus::tests::Loop;
    use crate::usb_device::usbip::UsbIp;
    use proptest::prelude::*;

    fn submit(id: u32, is_in: bool, endpoint: u32, length: u32, data: &[u8]) -> Vec<u8> {
        let words = [1, id, 0, is_in.into(), endpoint, 0, length, 0, 0, 0, 0, 0];
        words.iter().flat_map(|w: &u32| w.to_be_bytes()).chain(data.iter().copied()).collect()
    }

    #[test]
    fn bytes_go_through_a_device_and_back() {
        let (mut host, ours) = UnixStream::pair().unwrap();
        let device: SharedDevice = Arc::new(Mutex::new(Loop::new()));
        let session = Session::new(Box::new(UsbIp::default()));
        let server = std::thread::spawn(move || serve(ours, session, Vec::new(), device, Arc::default()).unwrap());
        host.write_all(&submit(1, true, 1, 8, &[])).unwrap();
        host.write_all(&submit(2, false, 1, 3, b"abc")).unwrap();
        let mut answers = vec![0; 48 + 48 + 3];
        host.read_exact(&mut answers).unwrap();
        assert_eq!((answers[7], answers[48 + 7], &answers[96..]), (2, 1, &b"abc"[..]));
        drop(host);
        assert_eq!(server.join().unwrap(), End::HostLeft);
    }

    #[test]
    fn a_host_that_breaks_the_rules_is_refused() {
        let (mut host, ours) = UnixStream::pair().unwrap();
        let device: SharedDevice = Arc::new(Mutex::new(Loop::new()));
        host.write_all(&[0xee; 48]).unwrap();
        let session = Session::new(Box::new(UsbIp::default()));
        let end = serve(ours, session, Vec::new(), device, Arc::default()).unwrap();
        assert!(matches!(end, End::Refused(SessionError::Wire(e)) if e.field == "command"));
        assert_eq!(host.read(&mut [0; 1]).unwrap(), 0);
    }

    proptest! {
        /// Every submitted transfer ends exactly once: completed or taken back, never both.
        #[test]
        fn transfers_end_once(steps in prop::collection::vec((0u8..4, 0u32..24), 1..80)) {
            let (mut session, mut device) = (Session::new(Box::new(UsbIp::default())), Loop::new());
            let mut out = Vec::new();
            let (mut asked, mut unlinked) = (0, 0);
            for (id, &(kind, n)) in (100u32..).zip(&steps) {
                match kind {
                    0 => { asked += 1; session.push(&submit(id, true, 1, n, &[])); }
                    1 => { asked += 1; session.push(&submit(id, false, 1, n, &vec![7; n as usize])); }
                    2 => {
                        unlinked += 1;
                        let words = [2, id, 0, 0, 0, 100 + n, 0, 0, 0, 0, 0, 0];
                        session.push(&words.iter().flat_map(|w: &u32| w.to_be_bytes()).collect::<Vec<_>>());
                    }
                    _ => session.pump(&mut device, 1 << 20, &mut out),
                }
                while session.handle(&mut device, &mut out).unwrap() {}
            }
            let (completed, taken_back, answered) = count(&out);
            let waiting = session.bus.waiting_count();
            prop_assert_eq!(answered, unlinked);
            prop_assert_eq!(completed + taken_back + waiting, asked);
        }

        #[test]
        fn arbitrary_bytes_do_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..400), cut in 1usize..64) {
            let (mut session, mut device) = (Session::new(Box::new(UsbIp::default())), Loop::new());
            let mut out = Vec::new();
            'bytes: for part in bytes.chunks(cut) {
                session.push(part);
                loop {
                    match session.handle(&mut device, &mut out) {
                        Ok(true) => {}
                        Ok(false) => break,
                        Err(_) => break 'bytes,
                    }
                }
            }
        }
    }

    /// Completed transfers, those taken back, and answers to unlinks in a stream of answers.
    fn count(mut answers: &[u8]) -> (usize, usize, usize) {
        let (mut completed, mut taken_back, mut unlinks) = (0, 0, 0);
        while let Some((header, rest)) = answers.split_at_checked(48) {
            let word = |i: usize| i32::from_be_bytes([header[i], header[i + 1], header[i + 2], header[i + 3]]);
            // Data follows only what was asked for: no answer to OUT has any, and OUT lengths are told apart by their status.
            let data = if word(0) == 3 && rest.first().is_some_and(|b| *b == 7) { word(24) as usize } else { 0 };
            completed += usize::from(word(0) == 3);
            unlinks += usize::from(word(0) == 4);
            taken_back += usize::from(word(0) == 4 && word(20) != 0);
            answers = &rest[data..];
        }
        (completed, taken_back, unlinks)
    }
}
