//! Where devices are plugged in: a TCP port for USB/IP, the kernel's own virtual host controller, a socket for QEMU.

use super::connection::{Bell, End, Session, SharedDevice, serve};
use super::usbip::{Operation, Refusal, UsbIp, import_reply, list_reply};
use super::usbredir::UsbRedir;
use super::{Descriptors, Speed};
use std::io::{self, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::AsRawFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, PoisonError};
use std::time::Duration;

/// Most connections at a time, those that only ask for the list among them.
const MAX_CONNECTIONS: usize = 16;
/// A client says what it wants within this time.
const OPERATION_TIMEOUT: Duration = Duration::from_secs(5);
/// How long a pulled cable stays out.
pub const REPLUG_AFTER: Duration = Duration::from_secs(1);
/// Where Linux keeps its virtual host controller.
const VHCI: &str = "/sys/devices/platform/vhci_hcd.0";

/// A device that can be plugged in.
pub struct Exported {
    /// Its name in `usbip list`.
    pub bus_id: String,
    /// Its number on our one bus.
    pub number: u32,
    /// The device.
    pub device: SharedDevice,
    is_taken: AtomicBool,
}

impl Exported {
    /// The device `number` (from 1) of our bus.
    pub fn new(number: u32, device: SharedDevice) -> Self {
        Self { bus_id: format!("1-{number}"), number, device, is_taken: AtomicBool::new(false) }
    }

    fn descriptors(&self) -> Descriptors {
        self.device.lock().unwrap_or_else(PoisonError::into_inner).descriptors().clone()
    }

    /// Takes the device for one host; false when another has it.
    fn take(&self) -> bool {
        !self.is_taken.swap(true, Ordering::AcqRel)
    }

    fn give_back(&self) {
        self.is_taken.store(false, Ordering::Release);
    }
}

/// The devices and what wakes their threads.
pub struct Server {
    devices: Vec<Arc<Exported>>,
    bell: Arc<Bell>,
    connections: AtomicUsize,
}

impl Server {
    /// A server of some devices.
    pub fn new(devices: Vec<Arc<Exported>>, bell: Arc<Bell>) -> Self {
        Self { devices, bell, connections: AtomicUsize::new(0) }
    }

    /// Serves USB/IP clients for ever.
    ///
    /// # Errors
    /// When no thread can be had.
    pub fn listen(self: &Arc<Self>, listener: &TcpListener) -> io::Result<()> {
        for stream in listener.incoming() {
            // A client that has left before it was met is no loss.
            let Ok(stream) = stream else { continue };
            if self.connections.fetch_add(1, Ordering::AcqRel) >= MAX_CONNECTIONS {
                self.connections.fetch_sub(1, Ordering::AcqRel);
                tracing::warn!("more than {MAX_CONNECTIONS} USB/IP clients; one is turned away");
                continue;
            }
            let server = Arc::clone(self);
            std::thread::Builder::new().name("usbip-client".into()).spawn(move || {
                if let Err(error) = server.client(stream) {
                    tracing::warn!("USB/IP client: {error}");
                }
                server.connections.fetch_sub(1, Ordering::AcqRel);
            })?;
        }
        Ok(())
    }

    /// Answers operations; after an import the stream carries transfers.
    fn client(&self, mut stream: TcpStream) -> io::Result<()> {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(OPERATION_TIMEOUT))?;
        let mut bytes = Vec::new();
        let operation = loop {
            let invalid = |e| io::Error::new(io::ErrorKind::InvalidData, e);
            if let Some((operation, taken)) = Operation::read(&bytes).map_err(invalid)? {
                bytes.drain(..taken);
                break operation;
            }
            let mut part = [0; 64];
            match stream.read(&mut part)? {
                0 => return Ok(()),
                count => bytes.extend_from_slice(&part[..count]),
            }
        };
        let bus_id = match operation {
            Operation::List => {
                let all: Vec<_> = self.devices.iter().map(|d| (d.descriptors(), d)).collect();
                let rows = all.iter().map(|(descriptors, d)| (d.bus_id.as_str(), d.number, descriptors));
                return stream.write_all(&list_reply(rows));
            }
            Operation::Import(bus_id) => bus_id,
        };
        let Some(exported) = self.devices.iter().find(|d| d.bus_id == bus_id) else {
            return stream.write_all(&import_reply(Err(Refusal::Unknown)));
        };
        if !exported.take() {
            return stream.write_all(&import_reply(Err(Refusal::Busy)));
        }
        let descriptors = exported.descriptors();
        let begin = import_reply(Ok((&exported.bus_id, exported.number, &descriptors)));
        let mut session = Session::new(Box::new(UsbIp::default()));
        session.push(&bytes);
        let served = stream
            .set_read_timeout(None)
            .and_then(|()| serve(stream, session, begin, Arc::clone(&exported.device), Arc::clone(&self.bell)));
        exported.give_back();
        tell(&exported.bus_id, &served?);
        Ok(())
    }

    /// Plugs a device into this machine's own kernel, again after every unplugging, until the kernel lets it go.
    ///
    /// # Errors
    /// When there is no virtual host controller, no free port, or no right to use it.
    pub fn attach(&self, exported: &Exported) -> io::Result<()> {
        let descriptors = exported.descriptors();
        loop {
            let stream = plug_into_kernel(descriptors.speed, exported.number)?;
            let session = Session::new(Box::new(UsbIp::default()));
            let end = serve(stream, session, Vec::new(), Arc::clone(&exported.device), Arc::clone(&self.bell))?;
            tell(&exported.bus_id, &end);
            if end != End::Unplugged {
                return Ok(());
            }
            std::thread::sleep(REPLUG_AFTER);
        }
    }

    /// Serves a device to QEMU's `usb-redir` on a socket, one connection after another.
    ///
    /// # Errors
    /// When the socket cannot be made.
    pub fn redirect(&self, exported: &Exported, socket: &Path) -> io::Result<()> {
        loop {
            // QEMU takes whatever answers at once, so a pulled cable is a socket that is not there.
            match std::fs::remove_file(socket) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
                _ => {}
            }
            let (stream, _) = UnixListener::bind(socket)?.accept()?;
            let (wire, begin) = UsbRedir::new(&exported.descriptors());
            let session = Session::new(Box::new(wire));
            let end = serve(stream, session, begin, Arc::clone(&exported.device), Arc::clone(&self.bell))?;
            tell(&exported.bus_id, &end);
            if end == End::Unplugged {
                std::thread::sleep(REPLUG_AFTER);
            }
        }
    }
}

fn tell(bus_id: &str, end: &End) {
    match end {
        End::HostLeft => tracing::info!("{bus_id}: the host has left"),
        End::Unplugged => tracing::info!("{bus_id}: unplugged"),
        End::Refused(error) => tracing::warn!("{bus_id}: the host is refused: {error}"),
    }
}

/// Gives one end of a pair of sockets to the kernel.
fn plug_into_kernel(speed: Speed, number: u32) -> io::Result<UnixStream> {
    let about = |what: &str, e: io::Error| io::Error::new(e.kind(), format!("{VHCI}/{what}: {e}"));
    let status = std::fs::read_to_string(format!("{VHCI}/status")).map_err(|e| about("status", e))?;
    let port = free_port(&status, speed).ok_or_else(|| io::Error::other("no free port on vhci_hcd"))?;
    let (ours, theirs) = UnixStream::pair()?;
    let line = format!("{port} {} {} {}", theirs.as_raw_fd(), 1 << 16 | number, speed.linux_code());
    std::fs::write(format!("{VHCI}/attach"), line).map_err(|e| about("attach", e))?;
    Ok(ours)
}

/// First free port of the hub for a speed, from vhci's table: hub, port, status (4 is free), and more.
fn free_port(status: &str, speed: Speed) -> Option<u32> {
    let hub = if speed == Speed::Super { "ss" } else { "hs" };
    status.lines().find_map(|line| {
        let mut fields = line.split_whitespace();
        let (found, port, state) = (fields.next()?, fields.next()?, fields.next()?);
        (found == hub && state == "004").then(|| port.parse().ok())?
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::usb_device::bus::tests::Loop;
    use std::sync::Mutex;

    #[test]
    fn ports_are_found_in_the_kernels_table() {
        let status = "hub port sta spd dev      sockfd local_busid\n\
            hs  0000 006 000 00000000 000003 1-1\n\
            hs  0001 004 000 00000000 000000 0-0\n\
            ss  0008 004 000 00000000 000000 0-0\n";
        assert_eq!(free_port(status, Speed::High), Some(1));
        assert_eq!(free_port(status, Speed::Super), Some(8));
        assert_eq!(free_port("", Speed::High), None);
    }

    #[test]
    fn clients_list_and_import_and_a_device_has_one_host() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let device = Arc::new(Exported::new(1, Arc::new(Mutex::new(Loop::new()))));
        let server = Arc::new(Server::new(vec![device], Arc::default()));
        std::thread::spawn(move || server.listen(&listener));
        let ask = |bytes: &[u8], count: usize| {
            let mut stream = TcpStream::connect(address).unwrap();
            stream.write_all(bytes).unwrap();
            let mut reply = vec![0; count];
            stream.read_exact(&mut reply).unwrap();
            (stream, reply)
        };
        let (_, list) = ask(&[1, 0x11, 0x80, 5, 0, 0, 0, 0], 12 + 316);
        assert_eq!(list[12 + 256..][..3], *b"1-1");
        let mut import = vec![1, 0x11, 0x80, 3, 0, 0, 0, 0];
        import.extend(b"1-1");
        import.resize(40, 0);
        let (mut host, granted) = ask(&import, 8 + 312);
        assert_eq!(granted[4..8], [0; 4]);
        assert_eq!(ask(&import, 8).1[7], 2);
        host.write_all(&[0, 0, 0, 1, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 18]).unwrap();
        host.write_all(&[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x80, 6, 0, 1, 0, 0, 18, 0]).unwrap();
        let mut descriptor = [0; 48 + 18];
        host.read_exact(&mut descriptor).unwrap();
        assert_eq!((descriptor[7], descriptor[48], descriptor[48 + 17]), (9, 18, 1));
        import[8 + 2] = b'7';
        assert_eq!(ask(&import, 8).1[7], 4);
    }
}
