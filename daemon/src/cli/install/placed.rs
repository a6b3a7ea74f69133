//! A file that is put in place: written when it is missing, replaced when it differs, whole or not at all.

use anyhow::{Context, Result};
use serde::Serialize;
use std::fs::{self, Permissions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// What is done, or would be done, to a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Change {
    /// It was not there.
    Written,
    /// Another was there.
    Replaced,
    /// It is as it should be.
    Unchanged,
    /// It is somebody's own and stays.
    Kept,
    /// It is taken away.
    Removed,
    /// It was not there to be taken away.
    Absent,
}

impl Change {
    /// The change in words.
    pub fn text(self, path: &Path, is_dry_run: bool) -> String {
        let path = path.display();
        match (self, is_dry_run) {
            (Self::Unchanged, _) => format!("{path}: already as it should be"),
            (Self::Kept, _) => format!("{path}: kept, it is yours"),
            (Self::Absent, _) => format!("{path}: not there"),
            (Self::Written, false) => format!("{path}: written"),
            (Self::Replaced, false) => format!("{path}: replaced"),
            (Self::Removed, false) => format!("{path}: removed"),
            (Self::Written, true) => format!("would write {path}"),
            (Self::Replaced, true) => format!("would replace {path}"),
            (Self::Removed, true) => format!("would remove {path}"),
        }
    }
}

/// A file and where it belongs.
#[derive(Debug, Clone)]
pub struct Placed {
    /// Where.
    pub path: PathBuf,
    /// All of it.
    pub content: Vec<u8>,
    /// Permissions.
    pub mode: u32,
    /// Meant to be edited: written when it is missing, and then never touched again.
    pub is_config: bool,
}

impl Placed {
    /// A file that everybody may read.
    pub fn new(path: PathBuf, content: impl Into<Vec<u8>>) -> Self {
        Self { path, content: content.into(), mode: 0o644, is_config: false }
    }

    /// What [`Self::put`] has to do.
    ///
    /// # Errors
    /// A file that cannot be read, named.
    pub fn needed(&self) -> Result<Change> {
        Ok(match self.found()? {
            None => Change::Written,
            Some(true) => Change::Unchanged,
            Some(false) if self.is_config => Change::Kept,
            Some(false) => Change::Replaced,
        })
    }

    /// What [`Self::remove`] has to do.
    ///
    /// # Errors
    /// As [`Self::needed`].
    pub fn removal(&self) -> Result<Change> {
        Ok(match self.found()? {
            None => Change::Absent,
            Some(false) if self.is_config => Change::Kept,
            Some(_) => Change::Removed,
        })
    }

    /// Whether it is there, and if so, whether it is the same.
    fn found(&self) -> Result<Option<bool>> {
        match fs::read(&self.path) {
            Ok(content) => {
                let mode = fs::metadata(&self.path).map_or(self.mode, |m| m.permissions().mode() & 0o777);
                // An owner may give a configuration other rights.
                Ok(Some(content == self.content && (self.is_config || mode == self.mode)))
            }
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error).with_context(|| format!("{}: cannot read", self.path.display())),
        }
    }

    /// Puts the file in place; its folder must be there.
    ///
    /// # Errors
    /// A file that cannot be written, named; `as_root` says what to run instead where rights are missing.
    pub fn put(&self, as_root: &str) -> Result<()> {
        let written = self.write().map_err(anyhow::Error::from);
        blame(written, as_root).with_context(|| format!("{}: cannot write", self.path.display()))
    }

    fn write(&self) -> std::io::Result<()> {
        let folder = self.path.parent().unwrap_or(Path::new("/"));
        let mut file = tempfile::Builder::new().prefix(".gv3-install-").tempfile_in(folder)?;
        file.write_all(&self.content)?;
        file.as_file().set_permissions(Permissions::from_mode(self.mode))?;
        file.as_file().sync_all()?;
        file.persist(&self.path)?;
        fs::File::open(folder)?.sync_all()
    }

    /// Takes the file away.
    ///
    /// # Errors
    /// As [`Self::put`].
    pub fn remove(&self, as_root: &str) -> Result<()> {
        let removed = fs::remove_file(&self.path).map_err(anyhow::Error::from);
        blame(removed, as_root).with_context(|| format!("{}: cannot remove", self.path.display()))
    }
}

/// Says what to run where rights are missing.
pub fn blame<T>(result: Result<T>, as_root: &str) -> Result<T> {
    let is_denied = |error: &anyhow::Error| {
        let mut causes = error.chain().filter_map(|cause| cause.downcast_ref::<std::io::Error>());
        causes.any(|cause| cause.kind() == ErrorKind::PermissionDenied)
    };
    match result {
        Err(error) if is_denied(&error) => Err(error.context(format!("run it as root: {as_root}"))),
        other => other,
    }
}
