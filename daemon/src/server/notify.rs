//! Tells systemd how the service stands (sd_notify(3)): datagrams to the socket that NOTIFY_SOCKET names.

use std::ffi::OsStr;
use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::Duration;

/// How long a message may wait for a manager that does not read: its socket takes a handful, and a daemon whose manager hangs
/// goes on.
const PATIENCE: Duration = Duration::from_millis(100);

/// The way to the service manager; without one, messages go nowhere.
#[derive(Debug, Default)]
pub struct Notify {
    to: Option<(UnixDatagram, SocketAddr)>,
    watchdog: Option<Duration>,
}

impl Notify {
    /// As the environment says: NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID.
    pub fn from_environment() -> Self {
        let socket = std::env::var_os("NOTIFY_SOCKET");
        let is_for_us = std::env::var("WATCHDOG_PID").map_or(true, |pid| pid == std::process::id().to_string());
        let watchdog = std::env::var("WATCHDOG_USEC").ok().filter(|_| is_for_us).and_then(|usec| usec.parse().ok());
        socket.map_or_else(Self::default, |socket| Self::new(&socket, watchdog.map(Duration::from_micros)))
    }

    /// Messages to a socket, `@` first for the abstract name space.
    pub fn new(socket: &OsStr, watchdog: Option<Duration>) -> Self {
        let open = || -> io::Result<_> {
            let address = match socket.as_bytes() {
                [b'@', name @ ..] => SocketAddr::from_abstract_name(name)?,
                _ => SocketAddr::from_pathname(socket)?,
            };
            let socket = UnixDatagram::unbound()?;
            socket.set_write_timeout(Some(PATIENCE))?;
            Ok((socket, address))
        };
        let to = open().inspect_err(|error| tracing::warn!(?socket, %error, "NOTIFY_SOCKET cannot be used")).ok();
        Self { to, watchdog }
    }

    /// How often the watchdog wants to hear from us at least.
    pub fn watchdog(&self) -> Option<Duration> {
        self.watchdog
    }

    /// Ready to answer.
    pub fn ready(&self, status: &str) {
        self.send(&format!("READY=1\nSTATUS={status}"));
    }

    /// The configuration is being read again; [`Self::ready`] says that it is done.
    pub fn reloading(&self) {
        let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        self.send(&format!("RELOADING=1\nMONOTONIC_USEC={}", now.tv_sec * 1_000_000 + now.tv_nsec / 1000));
    }

    /// On the way out.
    pub fn stopping(&self) {
        self.send("STOPPING=1\nSTATUS=stopping");
    }

    /// One line for `systemctl status`.
    pub fn status(&self, status: &str) {
        self.send(&format!("STATUS={status}"));
    }

    /// Sign of life.
    pub fn alive(&self) {
        self.send("WATCHDOG=1");
    }

    fn send(&self, message: &str) {
        if let Some((socket, address)) = &self.to
            && let Err(error) = socket.send_to_addr(message.as_bytes(), address)
        {
            tracing::debug!(%error, "the service manager was not told");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn heard(socket: &UnixDatagram) -> String {
        let mut buffer = [0; 256];
        let n = socket.recv(&mut buffer).unwrap();
        String::from_utf8(buffer[..n].to_vec()).unwrap()
    }

    #[test]
    fn a_manager_that_does_not_read_holds_nobody_up() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let manager = UnixDatagram::bind(&path).unwrap();
        let crowd = UnixDatagram::unbound().unwrap();
        crowd.set_nonblocking(true).unwrap();
        while crowd.send_to(b"STATUS=busy", &path).is_ok() {}
        let notify = Notify::new(path.as_os_str(), None);
        notify.stopping();
        assert_eq!(heard(&manager), "STATUS=busy");
        notify.alive();
        manager.set_nonblocking(true).unwrap();
        let mut buffer = [0; 64];
        let rest: Vec<usize> = std::iter::from_fn(|| manager.recv(&mut buffer).ok()).collect();
        assert_eq!(rest.last(), Some(&"WATCHDOG=1".len()));
    }

    #[test]
    fn a_socket_of_either_kind_hears_the_messages_of_the_manual() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let abstract_name = format!("gv3-test-{}", std::process::id());
        let address = SocketAddr::from_abstract_name(&abstract_name).unwrap();
        let ends = [
            (UnixDatagram::bind(&path).unwrap(), path.into_os_string()),
            (UnixDatagram::bind_addr(&address).unwrap(), format!("@{abstract_name}").into()),
        ];
        for (socket, name) in ends {
            socket.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
            let notify = Notify::new(&name, None);
            notify.ready("idle");
            assert_eq!(heard(&socket), "READY=1\nSTATUS=idle");
            notify.reloading();
            let reloading = heard(&socket);
            let micros = reloading.strip_prefix("RELOADING=1\nMONOTONIC_USEC=").unwrap();
            assert!(micros.parse::<u64>().unwrap() > 0);
            notify.alive();
            assert_eq!(heard(&socket), "WATCHDOG=1");
            notify.stopping();
            assert!(heard(&socket).starts_with("STOPPING=1\n"));
        }
    }

    #[test]
    fn without_a_manager_nothing_happens() {
        Notify::default().ready("idle");
        Notify::new(OsStr::new("/nonexistent/socket"), None).alive();
    }
}
