//! What many viewers of the newest thing share: each is coded once, by one thread at a time, however many look.

use bytes::Bytes;
use std::sync::Arc;
use tokio::sync::Mutex;

/// Forms of the newest thing that are kept.
const MAX_FORMS: usize = 16;

/// Coded forms of the newest thing.
pub struct Latest<T, K> {
    coded: Mutex<(Option<Arc<T>>, Vec<(K, Bytes)>)>,
}

impl<T, K> Default for Latest<T, K> {
    fn default() -> Self {
        Self { coded: Mutex::new((None, Vec::new())) }
    }
}

impl<T: Send + Sync + 'static, K: PartialEq> Latest<T, K> {
    /// The form `key` of a thing, coded now if nobody asked for it before. `None` when coding panicked.
    pub async fn get(
        &self,
        thing: &Arc<T>,
        key: K,
        code: impl FnOnce(&T) -> Vec<u8> + Send + 'static,
    ) -> Option<Bytes> {
        // Held while coding: viewers of the same thing wait for it instead of coding it too.
        let mut coded = self.coded.lock().await;
        if !coded.0.as_ref().is_some_and(|known| Arc::ptr_eq(known, thing)) {
            *coded = (Some(Arc::clone(thing)), Vec::new());
        }
        if let Some((_, bytes)) = coded.1.iter().find(|(k, _)| *k == key) {
            return Some(bytes.clone());
        }
        let thing = Arc::clone(thing);
        let bytes: Bytes = tokio::task::spawn_blocking(move || code(&thing)).await.ok()?.into();
        if coded.1.len() < MAX_FORMS {
            coded.1.push((key, bytes.clone()));
        }
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[tokio::test]
    async fn many_viewers_cost_one_coding_a_form_and_tick() {
        let (latest, coded) = (Arc::new(Latest::default()), Arc::new(AtomicUsize::new(0)));
        for tick in [1u8, 2].map(Arc::new) {
            let viewers = (0..50u8).map(|viewer| {
                let (latest, coded, tick) = (Arc::clone(&latest), Arc::clone(&coded), Arc::clone(&tick));
                tokio::spawn(async move {
                    let work = move |tick: &u8| {
                        coded.fetch_add(1, Ordering::Relaxed);
                        vec![*tick, viewer % 2]
                    };
                    (viewer, latest.get(&tick, viewer % 2, work).await.unwrap())
                })
            });
            for viewer in viewers.collect::<Vec<_>>() {
                let (viewer, bytes) = viewer.await.unwrap();
                assert_eq!(&bytes[..], [*tick, viewer % 2]);
            }
        }
        assert_eq!(coded.load(Ordering::Relaxed), 4);
    }
}
