//! Names of recordings and of their files.

use super::LiveError;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Longest name, bytes.
const MAX_BYTES: usize = 120;

/// A name given, or the time in UTC: `2026-07-30_14-05-09`, with a number where it is taken.
pub(super) fn choose(given: Option<String>, folder: &Path) -> Result<String, LiveError> {
    if let Some(name) = given {
        return match fault(&name) {
            None => Ok(name),
            Some(reason) => Err(LiveError::Name(format!("the name {name:?}: {reason}"))),
        };
    }
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let base = utc(seconds);
    let is_free = |name: &String| !file(folder, name, 1).exists() && !raw_folder(folder, name).exists();
    let numbered = (2..1000).map(|n| format!("{base}-{n}"));
    std::iter::once(base.clone())
        .chain(numbered)
        .find(is_free)
        .ok_or_else(|| LiveError::Name(format!("{base}: too many recordings of this second; give a name")))
}

/// File of a segment, counted from 1.
pub(super) fn file(folder: &Path, name: &str, segment: u32) -> PathBuf {
    match segment {
        0 | 1 => folder.join(format!("{name}.gv3")),
        _ => folder.join(format!("{name}.{segment:04}.gv3")),
    }
}

/// Folder of the raw pictures.
pub(super) fn raw_folder(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{name}.raw"))
}

fn fault(name: &str) -> Option<&'static str> {
    let is_first = |c: char| c.is_alphanumeric();
    if name.len() > MAX_BYTES {
        Some("longer than 120 bytes")
    } else if !name.starts_with(is_first) {
        Some("it must begin with a letter or a digit")
    } else if !name.chars().all(|c| c.is_alphanumeric() || "-_.".contains(c)) {
        Some("only letters, digits, - _ and . are allowed")
    } else if [".gv3", ".raw"].iter().any(|ending| name.ends_with(ending)) {
        Some("the endings .gv3 and .raw belong to files")
    } else {
        None
    }
}

/// Seconds since 1970 as date and time (days to civil date after Hinnant, "chrono-compatible low-level date algorithms").
fn utc(seconds: u64) -> String {
    let (days, time) = (seconds / 86_400 + 719_468, seconds % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 { shifted_month + 3 } else { shifted_month - 9 };
    let year = year_of_era + 400 * era + u64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}_{:02}-{:02}-{:02}", time / 3600, time / 60 % 60, time % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_of_known_seconds() {
        assert_eq!(utc(0), "1970-01-01_00-00-00");
        assert_eq!(utc(951_827_696), "2000-02-29_12-34-56");
        assert_eq!(utc(1_767_225_599), "2025-12-31_23-59-59");
    }

    #[test]
    fn names_stay_in_their_folder_and_are_not_taken_twice() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["", ".", "..", "../x", "a/b", ".x", "-x", "a b", "x.gv3", "x.raw", "a\0"] {
            assert!(choose(Some(name.into()), folder.path()).is_err(), "{name:?}");
        }
        assert_eq!(choose(Some("größe-2.b".into()), folder.path()).unwrap(), "größe-2.b");
        let first = choose(None, folder.path()).unwrap();
        std::fs::write(file(folder.path(), &first, 1), "").unwrap();
        assert_ne!(choose(None, folder.path()).unwrap(), first);
    }
}
