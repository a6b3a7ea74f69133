//! Lists, renames and deletes sessions; one process at a time has the directory.

use super::contents::{Curve, FileContents, FileGroups, SessionDetail};
use super::file_cache::FileCache;
use super::growing_file::GrowingFile;
use super::{SessionName, StoreError, rfc3339};
use crate::measure::Output;
use rustix::fs::{CWD, FlockOperation, RenameFlags};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, OpenOptions};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

/// File whose lock says that the directory is in use.
const LOCK_FILE: &str = ".gv3.lock";

/// Files of which the figures are kept.
const MOST_CONTENTS: u64 = 100_000;
/// Scans and events of which the figures are kept: some 20 MB.
const MOST_ENTRIES: u64 = 1_000_000;

/// How a session stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// Being recorded now.
    Recording,
    /// Every segment is finished.
    Complete,
    /// A segment ends early: its writer was stopped.
    Unfinished,
    /// A segment cannot be read at all.
    Damaged,
}

/// One line of the list of sessions.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SessionSummary {
    /// Name.
    pub name: SessionName,
    /// Bytes of all segments.
    pub bytes: u64,
    /// From first to last scan.
    pub seconds: f64,
    /// Scans.
    pub scans: u64,
    /// Keyframes.
    pub keyframes: u64,
    /// Size of the same scans as OBJ and BMP files over `bytes`, where it is known.
    pub ratio: Option<f64>,
    /// Error that its coding was told is worth correcting, mm, where the mode has one.
    pub tolerance_mm: Option<f64>,
    /// When it was begun (RFC 3339, UTC).
    pub created: Option<String>,
    /// How it stands.
    pub state: State,
    /// Coding mode; `raw` for pictures alone, empty when no segment can be read.
    pub mode: String,
    /// What can be shown of it, the usual first: `scan`, `mesh`.
    pub outputs: Vec<Output>,
    /// Files.
    pub segments: u32,
    /// Bytes of the raw pictures kept beside it, where there are any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub raw_bytes: Option<u64>,
    /// Why it is damaged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault: Option<String>,
}

/// One segment on disk.
#[derive(Debug, Clone)]
pub(super) struct Segment {
    pub number: u32,
    pub path: PathBuf,
    pub bytes: u64,
    pub modified: Option<SystemTime>,
}

/// An open session directory, locked against other processes for as long as it lives.
pub struct SessionDirectory {
    path: PathBuf,
    /// Why a file cannot be read is kept too.
    contents: FileCache<Result<Arc<FileContents>, String>>,
    groups: FileCache<Arc<FileGroups>>,
    /// The unfinished file that was asked for last: one is recorded at a time.
    growing: Mutex<Option<GrowingFile>>,
    lock: File,
}

impl SessionDirectory {
    /// Opens the directory, creating it if need be, and takes its lock.
    ///
    /// # Errors
    /// [`StoreError::Locked`] when another process has it, [`StoreError::Io`] as the system reports.
    pub fn open(path: &Path) -> Result<Self, StoreError> {
        fs::create_dir_all(path).map_err(StoreError::io(path, "create the session directory"))?;
        let path = fs::canonicalize(path).map_err(StoreError::io(path, "open the session directory"))?;
        let lock_path = path.join(LOCK_FILE);
        let mut lock = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&lock_path)
            .map_err(StoreError::io(&lock_path, "create"))?;
        if rustix::fs::flock(&lock, FlockOperation::NonBlockingLockExclusive).is_err() {
            let mut pid = String::new();
            // Who it is helps, but is not needed.
            let _ = (&lock).take(20).read_to_string(&mut pid);
            let is_known = !pid.trim().is_empty() && pid.trim().bytes().all(|b| b.is_ascii_digit());
            let holder = if is_known { format!(" (process {})", pid.trim()) } else { String::new() };
            return Err(StoreError::Locked { path, holder });
        }
        let written = lock.set_len(0).and_then(|()| lock.rewind()).and_then(|()| {
            let text = format!("{}\n", std::process::id());
            lock.write_all(text.as_bytes())
        });
        written.map_err(StoreError::io(&lock_path, "write"))?;
        remove_parts(&path);
        let (contents, groups) = (FileCache::new(MOST_CONTENTS), FileCache::new(MOST_ENTRIES));
        Ok(Self { path, contents, groups, growing: Mutex::new(None), lock })
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Lets other processes have the directory, while handles to it still live here.
    pub fn release(&self) {
        if let Err(error) = rustix::fs::flock(&self.lock, FlockOperation::Unlock) {
            tracing::warn!(%error, "the session directory stays locked until this process ends");
        }
    }

    /// All sessions in the order of their names; `recording` is the one being recorded.
    ///
    /// # Errors
    /// [`StoreError::Io`] when the directory cannot be read.
    pub fn list(&self, recording: Option<&SessionName>) -> Result<Vec<SessionSummary>, StoreError> {
        let all = self.segments()?;
        let known: BTreeSet<&PathBuf> = all.values().flatten().map(|s| &s.path).collect();
        self.contents.retain(|path| known.contains(path));
        self.groups.retain(|path| known.contains(path));
        Ok(all.iter().map(|(name, segments)| self.summarize(name, segments, recording == Some(name))).collect())
    }

    /// One session.
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub fn summary(&self, name: &SessionName, recording: Option<&SessionName>) -> Result<SessionSummary, StoreError> {
        Ok(self.summarize(name, &self.segments_of(name)?, recording == Some(name)))
    }

    /// Files of a session, in time order; at least one.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::RawOnly`].
    pub fn files(&self, name: &SessionName) -> Result<Vec<PathBuf>, StoreError> {
        let files: Vec<PathBuf> = self.segments_of(name)?.into_iter().map(|s| s.path).collect();
        if files.is_empty() { Err(StoreError::RawOnly(name.to_string())) } else { Ok(files) }
    }

    /// All that is told of a session without decoding a surface.
    ///
    /// # Errors
    /// As [`Self::files`], and what [`FileGroups::read`] says.
    pub fn detail(&self, name: &SessionName) -> Result<SessionDetail, StoreError> {
        Ok(SessionDetail::of(&self.all_groups(name)?))
    }

    /// Bytes of every scan.
    ///
    /// # Errors
    /// As [`Self::detail`].
    pub fn curve(&self, name: &SessionName) -> Result<Curve, StoreError> {
        Ok(Curve::of(&self.all_groups(name)?))
    }

    /// Gives a session another name, all its files or none.
    ///
    /// # Errors
    /// [`StoreError`]: not found, being recorded, the new name taken, or the system's refusal.
    pub fn rename(
        &self,
        from: &SessionName,
        to: &SessionName,
        recording: Option<&SessionName>,
    ) -> Result<(), StoreError> {
        let segments = self.not_recording(from, recording)?;
        let mut moves: Vec<(PathBuf, PathBuf)> =
            segments.iter().map(|s| (s.path.clone(), self.path.join(to.file(s.number)))).collect();
        let raw = self.path.join(from.raw_folder());
        if raw.is_dir() {
            moves.push((raw, self.path.join(to.raw_folder())));
        }
        if self.segments()?.contains_key(to) {
            return Err(StoreError::Exists(to.to_string()));
        }
        for (done, (old, new)) in moves.iter().enumerate() {
            let Err(error) = rustix::fs::renameat_with(CWD, old, CWD, new, RenameFlags::NOREPLACE) else { continue };
            for (old, new) in moves[..done].iter().rev() {
                // What cannot be moved back keeps its new name, which the list shows.
                let _ = rustix::fs::renameat_with(CWD, new, CWD, old, RenameFlags::NOREPLACE);
            }
            return Err(match error {
                rustix::io::Errno::EXIST => StoreError::Exists(to.to_string()),
                error => StoreError::io(old, "rename")(error.into()),
            });
        }
        self.sync()
    }

    /// Deletes a session with all its files and returns the bytes that it had.
    ///
    /// # Errors
    /// [`StoreError`]: not found, being recorded, or the system's refusal.
    pub fn delete(&self, name: &SessionName, recording: Option<&SessionName>) -> Result<u64, StoreError> {
        let segments = self.not_recording(name, recording)?;
        let raw = self.path.join(name.raw_folder());
        let mut freed = segments.iter().map(|s| s.bytes).sum();
        if fs::symlink_metadata(&raw).is_ok_and(|m| m.is_dir()) {
            freed += folder_bytes(&raw);
            fs::remove_dir_all(&raw).map_err(StoreError::io(&raw, "delete"))?;
        }
        // The first segment last: what is left after a failure is still listed under its name.
        for segment in segments.iter().rev() {
            fs::remove_file(&segment.path).map_err(StoreError::io(&segment.path, "delete"))?;
        }
        self.sync()?;
        Ok(freed)
    }

    fn not_recording(&self, name: &SessionName, recording: Option<&SessionName>) -> Result<Vec<Segment>, StoreError> {
        if recording == Some(name) {
            return Err(StoreError::Recording(name.to_string()));
        }
        self.segments_of(name)
    }

    /// Makes changes of names durable.
    fn sync(&self) -> Result<(), StoreError> {
        File::open(&self.path).and_then(|d| d.sync_all()).map_err(StoreError::io(&self.path, "sync"))
    }

    /// Regular files that are sessions, by name, in the order of their numbers; none for raw pictures alone.
    pub(super) fn segments(&self) -> Result<BTreeMap<SessionName, Vec<Segment>>, StoreError> {
        let mut all: BTreeMap<SessionName, Vec<Segment>> = BTreeMap::new();
        let entries = fs::read_dir(&self.path).map_err(StoreError::io(&self.path, "read"))?;
        for entry in entries.filter_map(Result::ok) {
            // Of the entry itself: a link is not followed.
            let Ok(metadata) = entry.metadata() else { continue };
            let file_name = entry.file_name();
            let file_name = file_name.to_str().unwrap_or_default();
            if let Some(name) = file_name.strip_suffix(".raw").filter(|_| metadata.is_dir()) {
                // Raw pictures without a session are listed too: they weigh most.
                if let Ok(name) = SessionName::new(name) {
                    all.entry(name).or_default();
                }
            }
            let Some((name, number)) = SessionName::of_file(file_name) else { continue };
            if metadata.is_file() {
                let (bytes, modified) = (metadata.len(), metadata.modified().ok());
                all.entry(name).or_default().push(Segment { number, path: entry.path(), bytes, modified });
            }
        }
        for segments in all.values_mut() {
            segments.sort_by_key(|s| s.number);
        }
        Ok(all)
    }

    fn segments_of(&self, name: &SessionName) -> Result<Vec<Segment>, StoreError> {
        self.segments()?.remove(name).ok_or_else(|| StoreError::NotFound(name.to_string()))
    }

    fn contents(&self, segment: &Segment) -> Result<Arc<FileContents>, String> {
        if let Some(contents) = self.contents.get(segment) {
            return contents;
        }
        let contents = FileContents::read(&segment.path).map(Arc::new).map_err(|e| e.to_string());
        self.contents.put(segment, contents.clone(), 1);
        contents
    }

    fn groups(&self, segment: &Segment) -> Result<Arc<FileGroups>, StoreError> {
        if let Some(groups) = self.groups.get(segment) {
            return Ok(groups);
        }
        let groups = self.read_groups(&segment.path)?;
        self.groups.put(segment, Arc::clone(&groups), groups.entries());
        Ok(groups)
    }

    fn read_groups(&self, path: &Path) -> Result<Arc<FileGroups>, StoreError> {
        let mut growing = self.growing.lock().unwrap_or_else(PoisonError::into_inner);
        if growing.as_ref().is_some_and(|file| file.is(path))
            && let Some(mut file) = growing.take()
        {
            file.read_on()?;
            return Ok(growing.insert(file).groups());
        }
        let file = GrowingFile::open(path)?;
        let groups = file.groups();
        if file.is(path) {
            *growing = Some(file);
        }
        Ok(groups)
    }

    fn all_groups(&self, name: &SessionName) -> Result<Vec<Arc<FileGroups>>, StoreError> {
        match self.segments_of(name)? {
            segments if segments.is_empty() => Err(StoreError::RawOnly(name.to_string())),
            segments => segments.iter().map(|segment| self.groups(segment)).collect(),
        }
    }

    fn summarize(&self, name: &SessionName, segments: &[Segment], is_recording: bool) -> SessionSummary {
        let bytes = segments.iter().map(|s| s.bytes).sum();
        let raw = self.path.join(name.raw_folder());
        let raw_bytes = fs::symlink_metadata(&raw).is_ok_and(|m| m.is_dir()).then(|| folder_bytes(&raw));
        let mut summary = SessionSummary {
            name: name.clone(),
            bytes,
            seconds: 0.0,
            scans: 0,
            keyframes: 0,
            ratio: None,
            tolerance_mm: None,
            created: None,
            state: State::Complete,
            mode: if segments.is_empty() { "raw".into() } else { String::new() },
            outputs: Vec::new(),
            segments: segments.len() as u32,
            raw_bytes,
            fault: None,
        };
        // The growing last segment of a recording would be read anew at every call; the engine has its figures.
        let read = if is_recording { &segments[..segments.len().saturating_sub(1)] } else { segments };
        self.add_contents(&mut summary, read);
        if is_recording {
            (summary.state, summary.fault) = (State::Recording, None);
        }
        summary
    }

    fn add_contents(&self, summary: &mut SessionSummary, segments: &[Segment]) {
        let (mut obj_bmp_bytes, mut ticks) = (Some(0), None);
        for segment in segments {
            let c = match self.contents(segment) {
                Ok(contents) => contents,
                Err(fault) => {
                    (summary.state, summary.fault) = (State::Damaged, Some(fault));
                    continue;
                }
            };
            if !c.is_finished && summary.state == State::Complete {
                summary.state = State::Unfinished;
            }
            summary.scans += c.scans;
            summary.keyframes += c.keyframes;
            summary.mode.clone_from(&c.mode);
            summary.outputs = c.outputs.to_vec();
            summary.tolerance_mm = c.tolerance_mm;
            summary.created = summary.created.take().or_else(|| c.created_unix_nanos.map(rfc3339));
            obj_bmp_bytes = obj_bmp_bytes.zip(c.obj_bmp_bytes).map(|(a, b)| a + b);
            if c.keyframes > 0 {
                let first = ticks.map_or(c.first_tick, |(first, _)| first);
                ticks = Some((first, c.last_tick));
                summary.seconds = c.last_tick.saturating_sub(first) as f64 * c.period_nanos as f64 * 1e-9;
            }
        }
        summary.ratio = obj_bmp_bytes.filter(|&b| b > 0).map(|b| b as f64 / summary.bytes.max(1) as f64);
    }
}

/// Removes what a repair left that was killed; the lock says that none is under way.
fn remove_parts(folder: &Path) {
    let names = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok).map(|e| e.path());
    for part in names.filter(|p| p.to_string_lossy().ends_with(".gv3.part")) {
        if let Err(error) = fs::remove_file(&part) {
            tracing::warn!(path = %part.display(), %error, "an unfinished repair was not removed");
        }
    }
}

/// Bytes of the files of a folder, no link to one; what cannot be read counts nothing.
pub(super) fn folder_bytes(folder: &Path) -> u64 {
    let is_folder = fs::symlink_metadata(folder).is_ok_and(|m| m.is_dir());
    let entries = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok).filter(|_| is_folder);
    entries.filter_map(|e| e.metadata().ok()).filter(fs::Metadata::is_file).map(|m| m.len()).sum()
}
