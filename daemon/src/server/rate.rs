//! How often an address may ask.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Requests a second that go on for ever, and at once.
const REQUESTS: (f64, f64) = (200.0, 1000.0);
/// The same of attempts to log in.
const LOGINS: (f64, f64) = (0.5, 10.0);
/// Addresses kept; beyond this those that have been quiet longest are forgotten.
const MAX_ADDRESSES: usize = 4096;

#[derive(Debug, Clone, Copy)]
struct Buckets {
    requests: f64,
    logins: f64,
    at: Instant,
}

/// Token buckets by address.
#[derive(Debug, Default)]
pub struct Rates {
    buckets: Mutex<BTreeMap<IpAddr, Buckets>>,
}

impl Rates {
    /// Full buckets.
    pub fn new() -> Self {
        Self::default()
    }

    /// Whether one more request may pass.
    pub fn take(&self, peer: IpAddr, is_login: bool) -> bool {
        self.take_at(peer, is_login, Instant::now())
    }

    fn take_at(&self, peer: IpAddr, is_login: bool, now: Instant) -> bool {
        let mut all = self.buckets.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() >= MAX_ADDRESSES && !all.contains_key(&peer) {
            let quietest = all.iter().min_by_key(|(_, b)| b.at).map(|(ip, _)| *ip);
            quietest.map(|ip| all.remove(&ip));
        }
        let bucket = all.entry(peer).or_insert(Buckets { requests: REQUESTS.1, logins: LOGINS.1, at: now });
        let seconds = now.saturating_duration_since(bucket.at).as_secs_f64();
        bucket.at = now;
        bucket.requests = (bucket.requests + seconds * REQUESTS.0).min(REQUESTS.1);
        bucket.logins = (bucket.logins + seconds * LOGINS.0).min(LOGINS.1);
        let passes = bucket.requests >= 1.0 && (!is_login || bucket.logins >= 1.0);
        if passes {
            bucket.requests -= 1.0;
            bucket.logins -= f64::from(is_login);
        }
        passes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_burst_passes_and_then_the_rate_holds() {
        let (rates, now) = (Rates::new(), Instant::now());
        let (a, b) = (IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2]));
        let passed = (0..2000).filter(|_| rates.take_at(a, false, now)).count();
        assert_eq!(passed, 1000);
        assert!(rates.take_at(b, false, now), "others are not held up");
        let later = now + Duration::from_secs(1);
        assert_eq!((0..2000).filter(|_| rates.take_at(a, false, later)).count(), 200);
    }

    #[test]
    fn logging_in_is_slower() {
        let (rates, now) = (Rates::new(), Instant::now());
        let a = IpAddr::from([10, 0, 0, 1]);
        assert_eq!((0..100).filter(|_| rates.take_at(a, true, now)).count(), 10);
        assert!(rates.take_at(a, false, now));
        assert_eq!((0..100).filter(|_| rates.take_at(a, true, now + Duration::from_secs(4))).count(), 2);
    }

    #[test]
    fn memory_is_bounded() {
        let (rates, now) = (Rates::new(), Instant::now());
        for i in 0..MAX_ADDRESSES as u32 + 100 {
            rates.take_at(IpAddr::from(i.to_be_bytes()), false, now + Duration::from_millis(u64::from(i)));
        }
        assert_eq!(rates.buckets.lock().unwrap().len(), MAX_ADDRESSES);
    }
}
