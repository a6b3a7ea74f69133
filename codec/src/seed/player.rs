//! Plays a run of seed groups at any time: fetches the keyframes around it, keeps what the next call will need.

use super::flattened::{Flattened, Neighbours};
use super::interval::{Interval, Window};
use crate::player::Fetch;
use crate::{CodecError, Result, Scan, StreamHeader};
use std::collections::BTreeMap;

/// Keyframes on either side of an interval that shape its spline. The pull of a knot falls by 2 - sqrt(3) from knot to
/// knot, so those left out change a path by less than 4e-4 of their second difference.
pub const KNOT_REACH: usize = 6;

/// Decoder of one run.
pub struct Player {
    header: StreamHeader,
    key_times_nanos: Vec<u64>,
    keyframes: BTreeMap<usize, Flattened>,
    matches: BTreeMap<usize, Neighbours>,
    interval: Option<(usize, Interval)>,
}

impl Player {
    /// A player of the groups whose keyframes have these times (increasing).
    ///
    /// # Errors
    /// [`CodecError::Stream`] without keyframes or when times do not increase.
    pub fn new(header: StreamHeader, key_times_nanos: Vec<u64>) -> Result<Self> {
        if key_times_nanos.is_empty() || key_times_nanos.windows(2).any(|w| w[0] >= w[1]) {
            return Err(CodecError::Stream("a run needs keyframes whose times increase".into()));
        }
        Ok(Self { header, key_times_nanos, keyframes: BTreeMap::new(), matches: BTreeMap::new(), interval: None })
    }

    /// The scan at a time, held at the ends of the run. `fetch` gives the payloads (group, texture) of a group by index
    /// and is asked for each at most once while playing forward.
    ///
    /// # Errors
    /// What `fetch` returns, and the codec's own errors for payloads that do not fit.
    pub fn scan_at<E: From<CodecError>>(
        &mut self,
        time_nanos: u64,
        fetch: Fetch<'_, E>,
    ) -> std::result::Result<Scan, E> {
        let last = self.key_times_nanos.len() - 1;
        let time = time_nanos.clamp(self.key_times_nanos[0], self.key_times_nanos[last]);
        let at = self.key_times_nanos.partition_point(|&t| t <= time) - 1;
        if self.interval.as_ref().is_none_or(|(i, _)| *i != at) {
            self.load_window(at, fetch)?;
            let interval = self.build_interval(at).map_err(E::from)?;
            self.interval = Some((at, interval));
        }
        let mut scan = match &self.interval {
            Some((_, interval)) => interval.scan_at(time),
            None => return Err(CodecError::Stream("no interval".into()).into()),
        };
        scan.time_nanos = time_nanos;
        scan.tick = (time + self.header.scan_period_nanos / 2) / self.header.scan_period_nanos;
        Ok(scan)
    }

    /// Decodes what the window around `at` lacks and forgets what lies outside it.
    fn load_window<E: From<CodecError>>(&mut self, at: usize, fetch: Fetch<'_, E>) -> std::result::Result<(), E> {
        let range = self.window(at);
        self.keyframes.retain(|k, _| range.contains(k));
        self.matches.retain(|k, _| range.contains(k) && range.contains(&(k + 1)));
        for k in range.clone() {
            if !self.keyframes.contains_key(&k) {
                let (geometry, texture) = fetch(k)?;
                let keyframe = self.decode(&geometry, texture.as_deref())?;
                self.keyframes.insert(k, keyframe);
            }
        }
        for k in range.start..range.end - 1 {
            if !self.matches.contains_key(&k) {
                self.matches.insert(k, Neighbours::new(&self.keyframes[&k], &self.keyframes[&(k + 1)]));
            }
        }
        Ok(())
    }

    fn window(&self, at: usize) -> std::ops::Range<usize> {
        at.saturating_sub(KNOT_REACH)..(at + KNOT_REACH + 1).min(self.key_times_nanos.len())
    }

    fn decode(&self, geometry: &[u8], texture: Option<&[u8]>) -> Result<Flattened> {
        let group = super::group::decode(&self.header, geometry)?;
        let texture = texture.map(crate::texture::decode_key_texture).transpose()?;
        Flattened::new(group, texture)
    }

    fn build_interval(&self, at: usize) -> Result<Interval> {
        let range = self.window(at);
        let keyframes: Vec<&Flattened> = range.clone().map(|k| &self.keyframes[&k]).collect();
        let matches: Vec<&Neighbours> = (range.start..range.end - 1).map(|k| &self.matches[&k]).collect();
        Interval::new(&Window { keyframes: &keyframes, matches: &matches, at: at - range.start })
    }
}
