//! The file that is being recorded: what is added to it is read, and nothing twice.

use super::StoreError;
use super::contents::FileGroups;
use gv3_protocol::session::{SessionReader, SessionState};
use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An open file and what is known of it.
pub(super) struct GrowingFile {
    path: PathBuf,
    /// Another file may come to have its name.
    inode: u64,
    reader: SessionReader<File>,
    groups: Arc<FileGroups>,
}

impl GrowingFile {
    /// Opens a file and reads all that is there.
    pub fn open(path: &Path) -> Result<Self, StoreError> {
        let inode = inode(path)?;
        let mut reader = SessionReader::open(path)?;
        let mut groups = FileGroups::default();
        groups.add_from(0, path, &mut reader)?;
        Ok(Self { path: path.into(), inode, reader, groups: Arc::new(groups) })
    }

    /// Whether this is the file of that name, and may grow.
    pub fn is(&self, path: &Path) -> bool {
        self.path == path && self.valid_bytes().is_some() && inode(path).is_ok_and(|inode| inode == self.inode)
    }

    /// Reads what was added.
    pub fn read_on(&mut self) -> Result<(), StoreError> {
        let known = self.valid_bytes().unwrap_or(u64::MAX);
        self.reader.read_on()?;
        Arc::make_mut(&mut self.groups).add_from(known, &self.path, &mut self.reader)
    }

    /// All that was read.
    pub fn groups(&self) -> Arc<FileGroups> {
        Arc::clone(&self.groups)
    }

    /// Bytes read, of a file without an end.
    fn valid_bytes(&self) -> Option<u64> {
        match self.reader.state() {
            SessionState::Clean => None,
            SessionState::Unfinished { valid_bytes, .. } => Some(*valid_bytes),
        }
    }
}

fn inode(path: &Path) -> Result<u64, StoreError> {
    Ok(std::fs::symlink_metadata(path).map_err(StoreError::io(path, "read"))?.ino())
}
