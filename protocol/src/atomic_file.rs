//! An output file that appears whole or not at all.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use crate::session::{Result, SessionError, SyncData};

/// A file written as `NAME.part` beside its target, then made durable and renamed by [`commit`](Self::commit).
///
/// Dropping it without a commit removes the part file; the target stays as it was. Two writers of the same target
/// at the same time share the part file and spoil each other: callers keep to one.
#[derive(Debug)]
pub struct AtomicFile {
    target: PathBuf,
    part: PathBuf,
    overwrite: bool,
    /// `None` once committed.
    file: Option<BufWriter<File>>,
}

impl AtomicFile {
    /// Starts writing `path`; a symbolic link is followed, so that its target is replaced and not the link.
    ///
    /// # Errors
    /// [`SessionError::Exists`] if the target is there and `overwrite` is false; [`SessionError::Io`] if it is not a
    /// regular file or the folder refuses.
    pub fn create(path: impl AsRef<Path>, overwrite: bool) -> Result<Self> {
        let target = fs::canonicalize(&path).unwrap_or_else(|_| path.as_ref().to_path_buf());
        let permissions = match fs::metadata(&target) {
            Ok(found) if !found.is_file() => {
                let source = io::Error::new(io::ErrorKind::InvalidInput, "it is not a regular file");
                return Err(SessionError::Io { path: target, action: "replace", source });
            }
            Ok(_) if !overwrite => return Err(SessionError::Exists { path: target }),
            Ok(found) => Some(found.permissions()),
            Err(_) => None,
        };
        let mut name = OsString::from(target.as_os_str());
        name.push(".part");
        let part = PathBuf::from(name);
        let failed = |source| SessionError::Io { path: part.clone(), action: "create", source };
        let file = File::create(&part).map_err(failed)?;
        let new =
            AtomicFile { target, part: part.clone(), overwrite, file: Some(BufWriter::with_capacity(1 << 16, file)) };
        if let Some(permissions) = permissions {
            fs::set_permissions(&part, permissions).map_err(failed)?;
        }
        Ok(new)
    }

    /// Makes the bytes durable, gives the file its name, and makes the name durable.
    ///
    /// # Errors
    /// [`SessionError::Exists`] if the target appeared meanwhile and must not be replaced; [`SessionError::Io`] as
    /// the system reports. The part file is gone in either case.
    pub fn commit(mut self) -> Result<()> {
        let failed = |path: &Path, source| SessionError::Io { path: path.to_path_buf(), action: "finish", source };
        // Through the option, so that a failure leaves the removal to drop.
        let Some(file) = &mut self.file else { return Ok(()) };
        file.flush().and_then(|()| file.get_ref().sync_all()).map_err(|error| failed(&self.part, error))?;
        if !self.overwrite && self.target.exists() {
            return Err(SessionError::Exists { path: self.target.clone() });
        }
        fs::rename(&self.part, &self.target).map_err(|error| failed(&self.target, error))?;
        self.file = None;
        sync_folder_of(&self.target).map_err(|error| failed(&self.target, error))
    }

    fn open(&mut self) -> io::Result<&mut BufWriter<File>> {
        self.file.as_mut().ok_or_else(|| io::Error::other("the file is committed"))
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        if self.file.take().is_some() {
            // Nobody is left to tell; the next writer of the same target truncates what remains.
            let _ = fs::remove_file(&self.part);
        }
    }
}

impl Write for AtomicFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.open()?.write(bytes).map_err(|error| named(&self.part, error))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.open()?.flush().map_err(|error| named(&self.part, error))
    }
}

impl Seek for AtomicFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.open()?.seek(to).map_err(|error| named(&self.part, error))
    }

    fn stream_position(&mut self) -> io::Result<u64> {
        self.open()?.stream_position().map_err(|error| named(&self.part, error))
    }
}

/// Nothing is promised before the commit, so a group costs no fsync.
impl SyncData for AtomicFile {
    fn sync_data(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The same error with the file's name in front; the kind stays.
pub(crate) fn named(path: &Path, error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

/// Makes the folder's entry of `path` durable; systems whose folders cannot be opened have no such call.
pub(crate) fn sync_folder_of(path: &Path) -> io::Result<()> {
    if !cfg!(unix) {
        return Ok(());
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn appears_whole_on_commit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gv3");
        let mut file = AtomicFile::create(&path, false).unwrap();
        file.write_all(b"whole").unwrap();
        assert_eq!(names(folder.path()), ["a.gv3.part"]);
        file.commit().unwrap();
        assert_eq!(names(folder.path()), ["a.gv3"]);
        assert_eq!(fs::read(&path).unwrap(), b"whole");
    }

    #[test]
    fn vanishes_on_drop_and_leaves_the_target() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gv3");
        fs::write(&path, b"old").unwrap();
        assert!(matches!(AtomicFile::create(&path, false), Err(SessionError::Exists { .. })));
        let mut file = AtomicFile::create(&path, true).unwrap();
        file.write_all(b"new").unwrap();
        drop(file);
        assert_eq!(names(folder.path()), ["a.gv3"]);
        assert_eq!(fs::read(&path).unwrap(), b"old");
    }

    #[test]
    fn refuses_a_target_that_appeared_meanwhile() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gv3");
        let file = AtomicFile::create(&path, false).unwrap();
        fs::write(&path, b"other").unwrap();
        assert!(matches!(file.commit(), Err(SessionError::Exists { .. })));
        assert_eq!(names(folder.path()), ["a.gv3"]);
    }

    #[test]
    fn refuses_what_is_not_a_regular_file() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(AtomicFile::create(folder.path(), true), Err(SessionError::Io { .. })));
        assert!(matches!(AtomicFile::create(folder.path().join("no/such/a.gv3"), true), Err(SessionError::Io { .. })));
    }

    #[cfg(unix)]
    #[test]
    fn follows_a_link() {
        let folder = tempfile::tempdir().unwrap();
        let (path, link) = (folder.path().join("a.gv3"), folder.path().join("link"));
        fs::write(&path, b"old").unwrap();
        std::os::unix::fs::symlink(&path, &link).unwrap();
        let mut file = AtomicFile::create(&link, true).unwrap();
        file.write_all(b"new").unwrap();
        file.commit().unwrap();
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(fs::read(&path).unwrap(), b"new");
    }
}
