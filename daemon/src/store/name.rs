//! Names that sessions may have: they can neither leave the session directory nor be mistaken for another file of it.

use super::StoreError;
use super::time_text::time_name;
use serde::Serialize;
use std::fmt;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// Longest name, bytes; with its endings it fits any file system.
pub const MAX_NAME_BYTES: usize = 120;
/// Endings that files beside sessions have.
const RESERVED_ENDINGS: [&str; 4] = [".gv3", ".raw", ".part", ".tmp"];

/// A session's name, without folder or ending.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(transparent)]
pub struct SessionName(String);

impl SessionName {
    /// Checks a name: letters and digits of any script, `-`, `_` and `.`; beginning with a letter or a digit.
    ///
    /// # Errors
    /// [`StoreError::Name`] saying what is wrong.
    pub fn new(name: &str) -> Result<Self, StoreError> {
        match fault(name) {
            Some(reason) => Err(StoreError::Name { name: name.chars().take(MAX_NAME_BYTES).collect(), reason }),
            None => Ok(Self(name.into())),
        }
    }

    /// A name made of a time, UTC: `2026-07-30_14-05-09`, with a number where a session of the folder has it.
    ///
    /// # Errors
    /// [`StoreError::Exists`] when a thousand of them are taken, [`StoreError::Io`] when the folder cannot be read.
    pub fn of_time(now: SystemTime, folder: &Path) -> Result<Self, StoreError> {
        let base = time_name(now.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs()));
        for name in std::iter::once(base.clone()).chain((2..1000).map(|n| format!("{base}-{n}"))) {
            let name = Self::new(&name)?;
            if name.is_free(folder)? {
                return Ok(name);
            }
        }
        Err(StoreError::Exists(base))
    }

    /// Whether nothing in a folder is a file of a session of this name, or its raw pictures.
    ///
    /// # Errors
    /// [`StoreError::Io`] when the folder cannot be read.
    pub fn is_free(&self, folder: &Path) -> Result<bool, StoreError> {
        let entries = std::fs::read_dir(folder).map_err(StoreError::io(folder, "read"))?;
        let raw = self.raw_folder();
        Ok(!entries.filter_map(Result::ok).any(|entry| {
            let file = entry.file_name();
            let file = file.to_str().unwrap_or_default();
            file == raw || Self::of_file(file).is_some_and(|(name, _)| name == *self)
        }))
    }

    /// The name and the number of the segment (from 1) of a file of the session directory; `None` for other files.
    pub(super) fn of_file(file: &str) -> Option<(Self, u32)> {
        let stem = file.strip_suffix(".gv3")?;
        let (name, segment) = match segment_of(stem) {
            Some((name, segment)) => (name, segment),
            None => (stem, 1),
        };
        Some((Self::new(name).ok()?, segment))
    }

    /// File of a segment, counted from 1.
    pub fn file(&self, segment: u32) -> String {
        if segment <= 1 { format!("{}.gv3", self.0) } else { format!("{}.{segment:04}.gv3", self.0) }
    }

    /// Folder of the raw pictures.
    pub fn raw_folder(&self) -> String {
        format!("{}.raw", self.0)
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for SessionName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// `NAME.0002` as `NAME` and 2.
fn segment_of(stem: &str) -> Option<(&str, u32)> {
    let (name, digits) = stem.rsplit_once('.')?;
    let is_number = (4..=9).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_digit());
    let segment = is_number.then(|| digits.parse().ok())??;
    (segment >= 2).then_some((name, segment))
}

fn fault(name: &str) -> Option<&'static str> {
    let first = name.chars().next();
    if first.is_none() {
        Some("it is empty")
    } else if name.len() > MAX_NAME_BYTES {
        Some("it is longer than 120 bytes")
    } else if !name.chars().all(|c| c.is_alphanumeric() || "-_.".contains(c)) {
        Some("only letters, digits, - _ and . are allowed")
    } else if !first.is_some_and(char::is_alphanumeric) {
        Some("it must begin with a letter or a digit")
    } else if RESERVED_ENDINGS.iter().any(|e| name.to_ascii_lowercase().ends_with(e)) {
        Some("the endings .gv3 .raw .part and .tmp belong to files")
    } else if segment_of(name).is_some() {
        Some("it ends like the number of a segment")
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::path::Component;
    use std::time::Duration;

    #[test]
    fn names_that_leave_the_directory_or_look_like_other_files_are_refused() {
        let long = "a".repeat(121);
        let bad = [
            "", ".", "..", "../x", "a/b", "a\\b", ".hidden", "-rf", "a\0b", "a b", "a\n", "x.gv3", "x.GV3", "x.raw",
            "x.part", "x.0002", "x.12345", "C:x", "%2e%2e", "~", "$(id)", "a;b", &long,
        ];
        for name in bad {
            assert!(SessionName::new(name).is_err(), "{name:?}");
        }
        for name in ["smile", "smile-2", "2026-07-30_12.30", "größe", "x.0001", "x.12", &"a".repeat(120)] {
            assert!(SessionName::new(name).is_ok(), "{name:?}");
        }
    }

    #[test]
    fn files_and_names_are_inverse() {
        let name = SessionName::new("smile.v2").unwrap();
        for segment in [1, 2, 37, 9999, 10_000] {
            assert_eq!(SessionName::of_file(&name.file(segment)), Some((name.clone(), segment)));
        }
        for other in ["smile.gv3.part", "smile.raw", ".gv3.lock", ".x.gv3", "notes.txt", "a b.gv3"] {
            assert_eq!(SessionName::of_file(other), None, "{other}");
        }
    }

    #[test]
    fn names_of_times_are_not_taken_twice_whatever_the_clock_does() {
        let folder = tempfile::tempdir().unwrap();
        let now = UNIX_EPOCH + Duration::from_secs(951_827_696);
        let name = |now| SessionName::of_time(now, folder.path()).unwrap().to_string();
        for (taken, next) in [
            ("2000-02-29_12-34-56.gv3", "2000-02-29_12-34-56-2"),
            ("2000-02-29_12-34-56-2.0003.gv3", "2000-02-29_12-34-56-3"),
            ("2000-02-29_12-34-56-3.raw", "2000-02-29_12-34-56-4"),
            ("notes.txt", "2000-02-29_12-34-56-4"),
        ] {
            std::fs::write(folder.path().join(taken), "").unwrap();
            assert_eq!(name(now), next);
        }
        assert_eq!(name(UNIX_EPOCH - Duration::from_secs(5)), "1970-01-01_00-00-00");
    }

    proptest! {
        #[test]
        fn a_name_is_one_ordinary_path_component(text in "\\PC{0,12}|[./\\\\a]{1,8}") {
            if let Ok(name) = SessionName::new(&text) {
                let file = name.file(1);
                let parts: Vec<_> = Path::new(&file).components().collect();
                prop_assert_eq!(parts.len(), 1);
                prop_assert!(matches!(parts[0], Component::Normal(_)));
                prop_assert_eq!(SessionName::of_file(&file), Some((name, 1)));
            }
        }
    }
}
