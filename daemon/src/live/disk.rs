//! Where sessions are written to.

use gv3_protocol::session::{Result, SessionFile, SyncData};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

/// Room on a disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DiskSpace {
    /// Bytes that can still be written.
    pub free_bytes: u64,
    /// Size, bytes.
    pub total_bytes: u64,
}

/// A file on it that can promise its bytes are durable.
pub trait DiskFile: Write + Seek + SyncData + Send {}

impl<T: Write + Seek + SyncData + Send> DiskFile for T {}

/// A disk: the system's, or one in a test that fills up, slows down, or forgets what was not synced.
pub trait Disk: Send + Sync {
    /// Makes a file that must not exist yet; its name is durable when this returns.
    ///
    /// # Errors
    /// As [`SessionFile::create`].
    fn create(&self, path: &Path) -> Result<Box<dyn DiskFile>>;
    /// Room on the disk that holds `folder`; `None` where the system does not tell.
    fn space(&self, folder: &Path) -> Option<DiskSpace>;
}

/// The file system.
#[derive(Debug, Clone, Copy)]
pub struct SystemDisk;

impl Disk for SystemDisk {
    fn create(&self, path: &Path) -> Result<Box<dyn DiskFile>> {
        Ok(Box::new(SessionFile::create(path, false)?))
    }

    fn space(&self, folder: &Path) -> Option<DiskSpace> {
        space(folder)
    }
}

#[cfg(target_os = "linux")]
fn space(folder: &Path) -> Option<DiskSpace> {
    let found = rustix::fs::statvfs(folder).ok()?;
    let bytes = |blocks: u64| blocks.saturating_mul(found.f_frsize);
    Some(DiskSpace { free_bytes: bytes(found.f_bavail), total_bytes: bytes(found.f_blocks) })
}

#[cfg(not(target_os = "linux"))]
fn space(_folder: &Path) -> Option<DiskSpace> {
    None
}

/// A file of any disk, as the session writer takes it.
pub(super) struct AnyFile(pub Box<dyn DiskFile>);

impl Write for AnyFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Seek for AnyFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.0.seek(to)
    }

    fn stream_position(&mut self) -> io::Result<u64> {
        self.0.stream_position()
    }
}

impl SyncData for AnyFile {
    fn sync_data(&mut self) -> io::Result<()> {
        self.0.sync_data()
    }

    fn sync_all(&mut self) -> io::Result<()> {
        self.0.sync_all()
    }
}
