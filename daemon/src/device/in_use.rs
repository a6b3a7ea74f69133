//! A device belongs to one process at a time, be it a second daemon that would be the other.

use rustix::fd::AsFd;
use rustix::fs::FlockOperation;
use rustix::io::Errno;
use std::io;

/// What is said of a device that another process has.
pub(super) const IN_USE: &str = "in use by another program, perhaps a second gv3; stop that one first";

/// Locks a device's node for as long as it is open. Not every driver keeps a second program out by itself: the kernel's for HID
/// lets both talk, and each takes the other's answers.
///
/// # Errors
/// EBUSY when another process has it, as drivers say that themselves.
pub(super) fn lock(node: impl AsFd) -> io::Result<()> {
    match rustix::fs::flock(node, FlockOperation::NonBlockingLockExclusive) {
        Err(Errno::WOULDBLOCK) => Err(Errno::BUSY.into()),
        done => Ok(done?),
    }
}

/// The text of an error, that of a busy device with what to do.
pub(super) fn told(error: &io::Error) -> String {
    match Errno::from_io_error(error) {
        Some(Errno::BUSY) => IN_USE.into(),
        _ => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

    #[test]
    fn a_node_is_one_holders_until_that_one_closes_it() {
        let folder = tempfile::tempdir().unwrap();
        let node = folder.path().join("hidraw0");
        let first = File::create(&node).unwrap();
        lock(&first).unwrap();
        let second = File::open(&node).unwrap();
        assert_eq!(told(&lock(&second).unwrap_err()), IN_USE);
        drop(first);
        lock(&second).unwrap();
        assert!(!told(&io::Error::from_raw_os_error(19)).contains(IN_USE));
    }
}
