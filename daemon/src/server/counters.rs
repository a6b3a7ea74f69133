//! What the server counts of itself.

use std::sync::atomic::{AtomicU64, Ordering};

/// One number that only grows, or a level.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    /// Adds one.
    pub fn add(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// Takes one back.
    pub fn sub(&self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }

    /// As it stands.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Counters of requests and connections.
#[derive(Debug, Default)]
pub struct Counters {
    /// Answers by class: 1xx to 5xx.
    pub answers: [Counter; 5],
    /// Connections open.
    pub connections: Counter,
    /// Connections turned away: too many.
    pub refused: Counter,
    /// Clients of coded groups closed for lagging.
    pub lagged: Counter,
}
