//! How long sessions are kept: by age, and by what all of them weigh together, the oldest going first.

use super::directory::{Segment, folder_bytes};
use super::{SessionDirectory, SessionName, StoreError};
use std::time::{Duration, SystemTime};

/// What is kept.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Retention {
    /// Days after which a session goes.
    pub keep_days: Option<f64>,
    /// Bytes of all sessions together, above which the oldest go.
    pub keep_bytes: Option<u64>,
}

/// A session that went.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Expired {
    /// Its name.
    pub name: SessionName,
    /// Bytes freed.
    pub bytes: u64,
}

/// A session's last change and weight.
struct Aged {
    name: SessionName,
    modified: SystemTime,
    bytes: u64,
}

/// Deletes what is too old or too much as of `now`. The session being recorded never goes, and one whose time of change
/// cannot be read neither. A clock that was set back keeps sessions longer, never shorter.
///
/// # Errors
/// [`StoreError`] when the directory cannot be read or a file not be deleted; what went before that stays gone.
pub fn expire(
    directory: &SessionDirectory,
    retention: &Retention,
    now: SystemTime,
    recording: Option<&SessionName>,
) -> Result<Vec<Expired>, StoreError> {
    let mut gone = Vec::new();
    for name in due(aged(directory, recording)?, retention, now) {
        let bytes = directory.delete(&name, recording)?;
        gone.push(Expired { name, bytes });
    }
    Ok(gone)
}

fn aged(directory: &SessionDirectory, recording: Option<&SessionName>) -> Result<Vec<Aged>, StoreError> {
    let mut all = Vec::new();
    for (name, segments) in directory.segments()? {
        let raw = directory.path().join(name.raw_folder());
        let raw_modified = std::fs::symlink_metadata(&raw).and_then(|m| m.modified()).ok();
        let modified = segments.iter().map(|s: &Segment| s.modified).max().flatten().or(raw_modified);
        if let Some(modified) = modified.filter(|_| recording != Some(&name)) {
            let bytes = segments.iter().map(|s| s.bytes).sum::<u64>() + folder_bytes(&raw);
            all.push(Aged { name, modified, bytes });
        }
    }
    Ok(all)
}

/// Names of the sessions to delete, oldest first.
fn due(mut all: Vec<Aged>, retention: &Retention, now: SystemTime) -> Vec<SessionName> {
    all.sort_by(|a, b| (a.modified, &a.name).cmp(&(b.modified, &b.name)));
    let keep = retention.keep_days.and_then(|days| Duration::try_from_secs_f64(days * 86_400.0).ok());
    let is_old = |a: &Aged| keep.is_some_and(|keep| now.duration_since(a.modified).is_ok_and(|age| age > keep));
    let mut total: u64 = all.iter().map(|a| a.bytes).sum();
    let mut names = Vec::new();
    for session in all {
        if is_old(&session) || retention.keep_bytes.is_some_and(|most| total > most) {
            total -= session.bytes;
            names.push(session.name);
        }
    }
    names
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::UNIX_EPOCH;

    const DAY: Duration = Duration::from_secs(86_400);

    fn session(name: &str, day: u32, bytes: u64) -> Aged {
        Aged { name: SessionName::new(name).unwrap(), modified: UNIX_EPOCH + DAY * day, bytes }
    }

    fn due_names(retention: Retention, day: u32) -> Vec<String> {
        let all = vec![session("c", 30, 5), session("a", 10, 7), session("b", 20, 9)];
        due(all, &retention, UNIX_EPOCH + DAY * day).iter().map(ToString::to_string).collect()
    }

    #[test]
    fn age_and_weight_take_the_oldest_and_nothing_goes_unasked() {
        assert!(due_names(Retention::default(), 1000).is_empty());
        let days = |keep| Retention { keep_days: Some(keep), keep_bytes: None };
        assert_eq!(due_names(days(10.0), 30), ["a"]);
        assert_eq!(due_names(days(10.0), 31), ["a", "b"]);
        let bytes = |most| Retention { keep_days: None, keep_bytes: Some(most) };
        assert!(due_names(bytes(21), 30).is_empty());
        assert_eq!(due_names(bytes(20), 30), ["a"]);
        assert_eq!(due_names(bytes(0), 30), ["a", "b", "c"]);
    }

    #[test]
    fn a_clock_set_back_takes_nothing() {
        assert!(due_names(Retention { keep_days: Some(1.0), keep_bytes: None }, 5).is_empty());
    }
}
