//! What was read of files, kept for as long as a file has the same length and time of change.

use super::directory::Segment;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

/// Values read of files; beyond `most` in weight those used longest ago go.
pub(super) struct FileCache<V> {
    most: u64,
    kept: Mutex<Kept<V>>,
}

struct Kept<V> {
    files: BTreeMap<PathBuf, Entry<V>>,
    weight: u64,
    uses: u64,
}

struct Entry<V> {
    bytes: u64,
    modified: Option<SystemTime>,
    value: V,
    weight: u64,
    used: u64,
}

impl<V: Clone> FileCache<V> {
    /// Keeps values of so much weight together.
    pub fn new(most: u64) -> Self {
        Self { most, kept: Mutex::new(Kept { files: BTreeMap::new(), weight: 0, uses: 0 }) }
    }

    /// What was read of the file as it is.
    pub fn get(&self, file: &Segment) -> Option<V> {
        let mut kept = self.kept();
        kept.uses += 1;
        let uses = kept.uses;
        let entry = kept.files.get_mut(&file.path)?;
        if (entry.bytes, entry.modified) != (file.bytes, file.modified) {
            return None;
        }
        entry.used = uses;
        Some(entry.value.clone())
    }

    /// Keeps what was read of the file as it was before reading: one that changed meanwhile does not fit the next time.
    pub fn put(&self, file: &Segment, value: V, weight: u64) {
        let mut kept = self.kept();
        kept.remove(&file.path);
        if weight > self.most {
            return;
        }
        while kept.weight + weight > self.most {
            let oldest = kept.files.iter().min_by_key(|(_, e)| e.used).map(|(path, _)| path.clone());
            let Some(oldest) = oldest else { break };
            kept.remove(&oldest);
        }
        let (bytes, modified, used) = (file.bytes, file.modified, kept.uses);
        kept.weight += weight;
        kept.files.insert(file.path.clone(), Entry { bytes, modified, value, weight, used });
    }

    /// Forgets files that are gone.
    pub fn retain(&self, is_there: impl Fn(&PathBuf) -> bool) {
        let mut kept = self.kept();
        let gone: Vec<PathBuf> = kept.files.keys().filter(|path| !is_there(path)).cloned().collect();
        gone.iter().for_each(|path| kept.remove(path));
    }

    fn kept(&self) -> MutexGuard<'_, Kept<V>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<V> Kept<V> {
    fn remove(&mut self, path: &PathBuf) {
        if let Some(entry) = self.files.remove(path) {
            self.weight -= entry.weight;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn file(name: &str, bytes: u64, second: u64) -> Segment {
        let modified = Some(SystemTime::UNIX_EPOCH + Duration::from_secs(second));
        Segment { number: 1, path: name.into(), bytes, modified }
    }

    #[test]
    fn a_file_that_changed_is_read_again() {
        let cache = FileCache::new(10);
        cache.put(&file("a", 100, 1), 'a', 1);
        assert_eq!(cache.get(&file("a", 100, 1)), Some('a'));
        for other in [file("a", 101, 1), file("a", 100, 2), file("b", 100, 1)] {
            assert_eq!(cache.get(&other), None);
        }
        cache.put(&file("a", 101, 1), 'b', 1);
        assert_eq!(cache.get(&file("a", 101, 1)), Some('b'));
        cache.retain(|_| false);
        assert_eq!((cache.get(&file("a", 101, 1)), cache.kept().weight), (None, 0));
    }

    #[test]
    fn what_was_used_longest_ago_goes_first_and_the_weight_is_bounded() {
        let cache = FileCache::new(10);
        for name in ["a", "b", "c"] {
            cache.put(&file(name, 1, 1), name.to_owned(), 3);
        }
        assert!(cache.get(&file("a", 1, 1)).is_some());
        cache.put(&file("d", 1, 1), "d".into(), 6);
        let left = ["a", "b", "c", "d"].map(|name| cache.get(&file(name, 1, 1)).is_some());
        assert_eq!((left, cache.kept().weight), ([true, false, false, true], 9));
        cache.put(&file("e", 1, 1), "e".into(), 11);
        assert_eq!(cache.get(&file("e", 1, 1)), None);
    }
}
