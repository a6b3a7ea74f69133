//! What many viewers of the newest thing share: each is coded once, by one thread at a time, however many look.

use bytes::Bytes;
use tokio::sync::Mutex;

/// Forms of the newest thing that are kept.
const MAX_FORMS: usize = 16;

/// Coded forms of the thing with the newest tick.
#[derive(Default)]
pub struct Latest<K> {
    coded: Mutex<(u64, Vec<(K, Bytes)>)>,
}

impl<K: PartialEq> Latest<K> {
    /// The form `key` of the thing at `tick`, coded now if nobody asked for it before. `None` when coding panicked.
    pub async fn get(&self, tick: u64, key: K, code: impl FnOnce() -> Vec<u8> + Send + 'static) -> Option<Bytes> {
        // Held while coding: viewers of the same thing wait for it instead of coding it too.
        let mut coded = self.coded.lock().await;
        if coded.0 != tick {
            *coded = (tick, Vec::new());
        }
        if let Some((_, bytes)) = coded.1.iter().find(|(k, _)| *k == key) {
            return Some(bytes.clone());
        }
        let bytes: Bytes = tokio::task::spawn_blocking(code).await.ok()?.into();
        if coded.1.len() < MAX_FORMS {
            coded.1.push((key, bytes.clone()));
        }
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[tokio::test]
    async fn many_viewers_cost_one_coding_a_form_and_tick() {
        let (latest, coded) = (Arc::new(Latest::default()), Arc::new(AtomicUsize::new(0)));
        for tick in [1u64, 2] {
            let viewers = (0..50u8).map(|viewer| {
                let (latest, coded) = (Arc::clone(&latest), Arc::clone(&coded));
                tokio::spawn(async move {
                    let work = move || {
                        coded.fetch_add(1, Ordering::Relaxed);
                        vec![tick as u8, viewer % 2]
                    };
                    (viewer, latest.get(tick, viewer % 2, work).await.unwrap())
                })
            });
            for viewer in viewers.collect::<Vec<_>>() {
                let (viewer, bytes) = viewer.await.unwrap();
                assert_eq!(&bytes[..], [tick as u8, viewer % 2]);
            }
        }
        assert_eq!(coded.load(Ordering::Relaxed), 4);
    }
}
