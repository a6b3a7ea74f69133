//! Where a session is written to: any `Write + Seek` that can promise its bytes are on disk.

use std::fs::{File, OpenOptions};
use std::io::{self, BufWriter, Cursor, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::{Result, SessionError};
use crate::atomic_file::{named, sync_folder_of};

/// A sink that can promise its bytes survive a power cut.
pub trait SyncData {
    /// Called after the opening metadata and after every group: what was written so far must be durable.
    ///
    /// # Errors
    /// As the system reports them; the bytes must then be taken as lost.
    fn sync_data(&mut self) -> io::Result<()>;

    /// Called once at the end, for names and lengths too.
    ///
    /// # Errors
    /// As [`sync_data`](Self::sync_data).
    fn sync_all(&mut self) -> io::Result<()> {
        self.sync_data()
    }
}

/// Memory has nothing to promise.
impl SyncData for Cursor<Vec<u8>> {
    fn sync_data(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A session file at its final name, on disk after every group: for recording live, where what was captured must
/// survive a kill. Errors name the file.
#[derive(Debug)]
pub struct SessionFile {
    path: PathBuf,
    file: BufWriter<File>,
}

impl SessionFile {
    /// Creates the file; its name is durable when this returns.
    ///
    /// # Errors
    /// [`SessionError::Exists`] unless `overwrite`, [`SessionError::Io`] as the system reports.
    pub fn create(path: impl AsRef<Path>, overwrite: bool) -> Result<Self> {
        let path = path.as_ref().to_path_buf();
        let mut options = OpenOptions::new();
        options.write(true);
        if overwrite {
            options.create(true).truncate(true);
        } else {
            options.create_new(true);
        }
        let created = options.open(&path).and_then(|file| sync_folder_of(&path).map(|()| file));
        match created {
            Ok(file) => Ok(SessionFile { path, file: BufWriter::with_capacity(1 << 16, file) }),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Err(SessionError::Exists { path }),
            Err(source) => Err(SessionError::Io { path, action: "create", source }),
        }
    }

    /// Name of the file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Write for SessionFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes).map_err(|error| named(&self.path, error))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush().map_err(|error| named(&self.path, error))
    }
}

impl Seek for SessionFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to).map_err(|error| named(&self.path, error))
    }

    fn stream_position(&mut self) -> io::Result<u64> {
        self.file.stream_position().map_err(|error| named(&self.path, error))
    }
}

impl SyncData for SessionFile {
    fn sync_data(&mut self) -> io::Result<()> {
        self.flush()?;
        self.file.get_ref().sync_data().map_err(|error| named(&self.path, error))
    }

    fn sync_all(&mut self) -> io::Result<()> {
        self.flush()?;
        let synced = self.file.get_ref().sync_all().and_then(|()| sync_folder_of(&self.path));
        synced.map_err(|error| named(&self.path, error))
    }
}

/// Ties durability to `flush`, the only call of the MCAP writer that reaches the sink after each chunk.
pub(crate) struct SyncOnFlush<W>(pub W);

impl<W: Write + SyncData> Write for SyncOnFlush<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()?;
        self.0.sync_data()
    }
}

impl<W: Seek> Seek for SyncOnFlush<W> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.0.seek(to)
    }

    fn stream_position(&mut self) -> io::Result<u64> {
        self.0.stream_position()
    }
}
