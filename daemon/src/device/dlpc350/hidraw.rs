//! The kernel's HID driver: `/dev/hidraw*`, found through sysfs.

use super::link::{HidLink, HidOpener, LinkError, Wanted};
use gv3_protocol::dlpc350::{PRODUCT_ID, REPORT_BYTES, Report, VENDOR_ID};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::FlockOperation;
use rustix::io::Errno;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A hidraw node of a DLPC350.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HidrawNode {
    /// The node.
    pub path: PathBuf,
    /// Bus and ports, as `1-4.2`.
    pub bus_path: String,
    /// Serial number; many boards have none.
    pub serial: String,
}

/// The nodes of all DLPC350s that are plugged in, by place.
///
/// # Errors
/// [`LinkError::Failed`] when sysfs cannot be read.
pub fn find_hidraw() -> Result<Vec<HidrawNode>, LinkError> {
    find_in(Path::new("/sys/class/hidraw"), Path::new("/dev"))
}

/// Reads the nodes of a sysfs class folder. A projector may show two HID interfaces; commands go to the first.
fn find_in(class: &Path, devices: &Path) -> Result<Vec<HidrawNode>, LinkError> {
    let entries = match fs::read_dir(class) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(|e| LinkError::Failed(format!("{}: {e}", class.display())))?,
    };
    let mut nodes: Vec<HidrawNode> = entries
        .flatten()
        .filter_map(|entry| {
            // Whatever vanishes while it is looked at has been unplugged.
            let device = fs::canonicalize(entry.path().join("device")).ok()?;
            let uevent = fs::read_to_string(device.join("uevent")).ok()?;
            let (bus_path, interface) = usb_interface(&device)?;
            let value = |key: &str| uevent.lines().find_map(|l| l.strip_prefix(key)?.strip_prefix('='));
            let id = format!("{VENDOR_ID:08X}:{PRODUCT_ID:08X}");
            let is_ours = value("HID_ID")?.ends_with(&id) && interface == 0;
            is_ours.then(|| HidrawNode {
                path: devices.join(entry.file_name()),
                bus_path,
                serial: value("HID_UNIQ").unwrap_or_default().to_owned(),
            })
        })
        .collect();
    nodes.sort_by(|a, b| a.bus_path.cmp(&b.bus_path));
    Ok(nodes)
}

/// Place and interface number from a sysfs path's part such as `1-4.2:1.0`.
fn usb_interface(device: &Path) -> Option<(String, u8)> {
    device.components().rev().find_map(|part| {
        let (bus_path, setting) = part.as_os_str().to_str()?.split_once(':')?;
        let (bus, _) = bus_path.split_once('-')?;
        bus.parse::<u16>().ok()?;
        let (_, interface) = setting.split_once('.')?;
        Some((bus_path.to_owned(), interface.parse().ok()?))
    })
}

/// Opens the hidraw node that a configuration means.
pub(super) struct HidrawOpener(pub(super) Wanted);

impl HidOpener for HidrawOpener {
    fn name(&self) -> String {
        self.0.to_string()
    }

    fn open(&mut self) -> Result<Box<dyn HidLink>, LinkError> {
        let node = self.0.choose(find_hidraw()?, |node| [node.bus_path.clone(), node.serial.clone()])?;
        Ok(Box::new(HidrawLink::open(&node.path)?))
    }
}

/// An open hidraw node.
pub struct HidrawLink {
    file: File,
}

impl HidrawLink {
    /// Opens a node and locks it against other programs that do the same.
    ///
    /// # Errors
    /// [`LinkError::Failed`] with what to do.
    pub fn open(path: &Path) -> Result<Self, LinkError> {
        let flags = rustix::fs::OFlags::NONBLOCK.bits();
        let file = OpenOptions::new().read(true).write(true).custom_flags(flags.cast_signed()).open(path);
        let file = file.map_err(|error| {
            let hint = if error.kind() == ErrorKind::PermissionDenied {
                "; give your user access with `sudo gv3 install-udev`, then plug it in again"
            } else {
                ""
            };
            LinkError::Failed(format!("{}: {error}{hint}", path.display()))
        })?;
        // hidraw gives every program a turn; of two that drive one projector neither could know what it shows.
        if rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive).is_err() {
            let path = path.display();
            let reason = format!("{path}: in use by another program; end that one (`fuser -v {path}` names it)");
            return Err(LinkError::Failed(reason));
        }
        Ok(Self { file })
    }

    /// Waits until there is something to read.
    fn wait(&self, deadline: Instant, timeout: Duration) -> Result<(), LinkError> {
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
            let mut fds = [PollFd::new(&self.file, PollFlags::IN)];
            match poll(&mut fds, Some(&left)) {
                Ok(0) => return Err(LinkError::Timeout(timeout)),
                // What came before the cable was pulled can still be read.
                Ok(_) if fds[0].revents().contains(PollFlags::IN) => return Ok(()),
                Ok(_) => return Err(LinkError::Disconnected),
                Err(Errno::INTR) => {}
                Err(error) => return Err(LinkError::Failed(error.to_string())),
            }
        }
    }
}

impl HidLink for HidrawLink {
    fn write_report(&mut self, report: &Report) -> Result<(), LinkError> {
        // In front stands the report's number, 0, which the kernel takes off.
        let mut bytes = [0; 1 + REPORT_BYTES];
        bytes[1..].copy_from_slice(report);
        match self.file.write(&bytes) {
            Ok(count) if count == bytes.len() => Ok(()),
            Ok(count) => Err(LinkError::Failed(format!("{count} of {} bytes sent", bytes.len()))),
            Err(error) => Err(io_error(&error)),
        }
    }

    fn read_report(&mut self, timeout: Duration) -> Result<Report, LinkError> {
        let deadline = Instant::now() + timeout;
        let mut report = [0; REPORT_BYTES];
        loop {
            self.wait(deadline, timeout)?;
            match self.file.read(&mut report) {
                Ok(REPORT_BYTES) => return Ok(report),
                Ok(0) => return Err(LinkError::Disconnected),
                Ok(count) => {
                    return Err(LinkError::Failed(format!("report of {count} bytes, expected {REPORT_BYTES}")));
                }
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
                Err(error) => return Err(io_error(&error)),
            }
        }
    }
}

/// An unplugged device shows as one of three errors, by how far the kernel is with removing it.
fn io_error(error: &io::Error) -> LinkError {
    match Errno::from_io_error(error) {
        Some(Errno::NODEV | Errno::NXIO | Errno::IO) => LinkError::Disconnected,
        _ => LinkError::Failed(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    /// A node as the kernel shows it.
    fn plug_in(root: &Path, node: &str, interface: &str, id: &str, serial: &str) {
        let bus_path = interface.split(':').next().unwrap();
        let device = root.join(format!("devices/pci0000:00/0000:00:14.0/usb1/{bus_path}/{interface}/0003:{id}.0001"));
        fs::create_dir_all(&device).unwrap();
        let long: Vec<String> = id.split(':').map(|half| format!("0000{half}")).collect();
        let uevent = format!(
            "DRIVER=hid-generic\nHID_ID=0003:{}\nHID_NAME=Texas Instruments\nHID_PHYS=usb-0000:00:14.0-1/input0\nHID_UNIQ={serial}\n",
            long.join(":")
        );
        fs::write(device.join("uevent"), uevent).unwrap();
        let class = root.join("class").join(node);
        fs::create_dir_all(&class).unwrap();
        symlink(device, class.join("device")).unwrap();
    }

    #[test]
    fn the_first_interface_of_every_projector_is_found() {
        let root = tempfile::tempdir().unwrap();
        let find = || find_in(&root.path().join("class"), Path::new("/dev")).unwrap();
        assert_eq!(find(), []);
        plug_in(root.path(), "hidraw0", "1-2:1.0", "046D:C52B", "mouse");
        plug_in(root.path(), "hidraw1", "1-4.2:1.1", "0451:6401", "");
        plug_in(root.path(), "hidraw2", "1-4.2:1.0", "0451:6401", "");
        plug_in(root.path(), "hidraw10", "1-3:1.0", "0451:6401", "LCR3");
        let node = |path: &str, bus_path: &str, serial: &str| HidrawNode {
            path: path.into(),
            bus_path: bus_path.into(),
            serial: serial.into(),
        };
        assert_eq!(find(), [node("/dev/hidraw10", "1-3", "LCR3"), node("/dev/hidraw2", "1-4.2", "")]);
    }

    #[test]
    fn a_node_that_cannot_be_opened_is_named() {
        let error = HidrawLink::open(Path::new("/dev/hidraw-none")).err().unwrap().to_string();
        assert!(error.starts_with("/dev/hidraw-none: "), "{error}");
    }

    #[test]
    fn a_node_is_one_programs_until_it_is_closed() {
        let node = tempfile::NamedTempFile::new().unwrap();
        let first = HidrawLink::open(node.path()).unwrap();
        let error = HidrawLink::open(node.path()).err().unwrap().to_string();
        assert!(error.contains("in use by another program"), "{error}");
        drop(first);
        HidrawLink::open(node.path()).unwrap();
    }
}
