//! Frames to frame sets: complete, in order, on schedule, or not at all.
//!
//! Three witnesses must agree on every frame of a set: the pattern index counts up from 0, the trigger counter runs on without a
//! gap, and the exposure is where the schedule puts it after the set's first. The tick comes from the sensor's clock, so a
//! dropped set leaves a gap.

use crate::device::{Frame, SequenceTiming};
use crate::light::PatternSequence;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// The frames of one pattern sequence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameSet {
    /// Sensor time in scan periods.
    pub tick: u64,
    /// Sensor time of the middle of the finest fringes' exposures, nanoseconds since the run began.
    pub time_nanos: u64,
    /// One frame a pattern, in the sequence's order.
    pub frames: Vec<Frame>,
}

/// Frame sets that were dropped, by the first cause seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DropCounts {
    /// A picture is missing, or the whole set.
    pub lost: u64,
    /// A picture came twice.
    pub doubled: u64,
    /// A picture was exposed off schedule.
    pub late: u64,
    /// Pattern index and trigger counter contradict each other.
    pub disordered: u64,
    /// Single frames that belong to no open set: repeats after a set was complete, times in the past, unknown patterns.
    pub stray_frames: u64,
}

impl DropCounts {
    /// Dropped sets of every cause.
    pub fn sets(&self) -> u64 {
        self.lost + self.doubled + self.late + self.disordered
    }

    fn count(&mut self, cause: Cause) {
        match cause {
            Cause::Lost => self.lost += 1,
            Cause::Doubled => self.doubled += 1,
            Cause::Late => self.late += 1,
            Cause::Disordered => self.disordered += 1,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cause {
    Lost,
    Doubled,
    Late,
    Disordered,
}

/// The set being collected, or the last one if it is closed.
#[derive(Debug)]
struct OpenSet {
    tick: u64,
    /// When pattern 0 of this set was exposed, by its first frame.
    start_nanos: i128,
    frames: Vec<Frame>,
    fault: Option<Cause>,
    is_closed: bool,
}

/// Collects frames into frame sets.
#[derive(Debug)]
pub struct FrameSetAssembler {
    pattern_count: usize,
    timed_by: Range<usize>,
    period_nanos: i128,
    current: Option<OpenSet>,
    strays_in_a_row: usize,
    drops: DropCounts,
    last_dropped_tick: Option<u64>,
}

impl FrameSetAssembler {
    /// An assembler for one run of a validated sequence.
    pub fn new(sequence: &PatternSequence, timing: &SequenceTiming) -> Self {
        Self {
            pattern_count: sequence.patterns.len(),
            timed_by: sequence.finest_burst(),
            period_nanos: i128::from(timing.picture_period_nanos.max(1)),
            current: None,
            strays_in_a_row: 0,
            drops: DropCounts::default(),
            last_dropped_tick: None,
        }
    }

    /// Tick of the set dropped last.
    pub fn last_dropped_tick(&self) -> Option<u64> {
        self.last_dropped_tick
    }

    /// What was dropped so far.
    pub fn drops(&self) -> DropCounts {
        self.drops
    }

    /// Takes the next frame in order of arrival; gives the frame set that it completes.
    pub fn push(&mut self, frame: Frame) -> Option<FrameSet> {
        let pattern = usize::from(frame.pattern.0);
        if pattern >= self.pattern_count {
            self.drops.stray_frames += 1;
            return None;
        }
        let start_nanos = i128::from(frame.device_time_nanos) - pattern as i128 * self.period_nanos;
        match self.sets_since_current(start_nanos) {
            Some(0) => {}
            Some(ahead) if ahead < 0 => {
                self.drops.stray_frames += 1;
                self.strays_in_a_row += 1;
                // The sensor's clock was set back, or one stamp was far off: believe the many.
                if self.strays_in_a_row < 2 * self.pattern_count {
                    return None;
                }
                self.open_next(1, start_nanos);
            }
            Some(ahead) => self.open_next(u64::try_from(ahead).unwrap_or(u64::MAX), start_nanos),
            None => self.open_first(start_nanos),
        }
        self.strays_in_a_row = 0;
        self.add(frame, start_nanos)
    }

    /// Ends the run: a set that is still open is dropped as lost.
    pub fn finish(&mut self) -> DropCounts {
        self.close_current();
        self.drops
    }

    /// How many sets later than the current one a set lies, to the nearest.
    fn sets_since_current(&self, start_nanos: i128) -> Option<i128> {
        let set_period = self.period_nanos * self.pattern_count as i128;
        let current = self.current.as_ref()?;
        Some((start_nanos - current.start_nanos + set_period / 2).div_euclid(set_period))
    }

    fn open_first(&mut self, start_nanos: i128) {
        let set_period = self.period_nanos * self.pattern_count as i128;
        let tick = u64::try_from((start_nanos + set_period / 2).div_euclid(set_period)).unwrap_or(0);
        self.current = Some(OpenSet { tick, start_nanos, frames: Vec::new(), fault: None, is_closed: false });
    }

    fn open_next(&mut self, sets: u64, start_nanos: i128) {
        self.close_current();
        // Sets of which nothing at all arrived.
        self.drops.lost = self.drops.lost.saturating_add(sets - 1);
        let tick = self.current.as_ref().map_or(0, |set| set.tick).saturating_add(sets);
        if sets > 1 {
            self.last_dropped_tick = Some(tick - 1);
        }
        self.current = Some(OpenSet { tick, start_nanos, frames: Vec::new(), fault: None, is_closed: false });
    }

    fn close_current(&mut self) {
        if let Some(set) = self.current.as_mut().filter(|set| !set.is_closed) {
            self.drops.count(set.fault.unwrap_or(Cause::Lost));
            self.last_dropped_tick = Some(set.tick);
            set.is_closed = true;
        }
    }

    fn add(&mut self, frame: Frame, start_nanos: i128) -> Option<FrameSet> {
        let set = self.current.as_mut()?;
        if set.is_closed {
            self.drops.stray_frames += 1;
            return None;
        }
        let is_late = (start_nanos - set.start_nanos).abs() > self.period_nanos / 4;
        set.fault = set.fault.or_else(|| set.contradiction(&frame)).or(is_late.then_some(Cause::Late));
        set.frames.push(frame);
        if set.fault.is_some() {
            // Nothing of this set will be used.
            set.frames.truncate(1);
            return None;
        }
        if set.frames.len() < self.pattern_count {
            return None;
        }
        set.is_closed = true;
        let frames = std::mem::take(&mut set.frames);
        Some(FrameSet { tick: set.tick, time_nanos: mean_time_nanos(&frames[self.timed_by.clone()]), frames })
    }
}

impl OpenSet {
    /// What is wrong with `frame` as the next of this set.
    fn contradiction(&self, frame: &Frame) -> Option<Cause> {
        let expected = self.frames.len();
        let pattern = usize::from(frame.pattern.0);
        match self.frames.last() {
            Some(last) if frame.sequence == last.sequence => Some(Cause::Doubled),
            _ if pattern > expected => Some(Cause::Lost),
            _ if pattern < expected => Some(Cause::Disordered),
            Some(last) if frame.sequence != last.sequence.wrapping_add(1) => Some(Cause::Disordered),
            _ => None,
        }
    }
}

fn mean_time_nanos(frames: &[Frame]) -> u64 {
    let sum: u128 = frames.iter().map(|f| u128::from(f.device_time_nanos)).sum();
    (sum / frames.len().max(1) as u128) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::PatternIndex;
    use gv3_codec::GreyPicture;
    use proptest::prelude::*;

    const PERIOD: u64 = 5_555_556;
    const TIMING: SequenceTiming = SequenceTiming { picture_period_nanos: PERIOD, exposure_nanos: 5_000_000 };

    fn assembler() -> FrameSetAssembler {
        FrameSetAssembler::new(&PatternSequence::two_frequency([912, 1140], 264.0, 22.0, 3), &TIMING)
    }

    /// Trigger `k` of a run; the picture carries the trigger it shows.
    fn frame(k: u64) -> Frame {
        Frame {
            sequence: k,
            pattern: PatternIndex((k % 6) as u16),
            device_time_nanos: k * PERIOD,
            host_time_nanos: k * PERIOD + 7_000_000,
            exposure_nanos: 5_000_000,
            picture: GreyPicture::filled(1, 1, k as u8),
        }
    }

    fn run(frames: impl IntoIterator<Item = Frame>) -> (Vec<FrameSet>, DropCounts) {
        let mut assembler = assembler();
        let sets = frames.into_iter().filter_map(|f| assembler.push(f)).collect();
        (sets, assembler.finish())
    }

    fn ticks(sets: &[FrameSet]) -> Vec<u64> {
        sets.iter().map(|s| s.tick).collect()
    }

    #[test]
    fn a_clean_run_gives_every_set_timed_by_its_fine_fringes() {
        let (sets, drops) = run((0..30).map(frame));
        assert_eq!(ticks(&sets), [0, 1, 2, 3, 4]);
        assert_eq!(sets[2].time_nanos, 16 * PERIOD);
        assert_eq!(drops, DropCounts::default());
    }

    #[test]
    fn each_fault_drops_one_set_under_its_name_and_leaves_a_gap() {
        let lost = run((0..30).filter(|&k| k != 14).map(frame));
        assert_eq!((ticks(&lost.0), lost.1), (vec![0, 1, 3, 4], DropCounts { lost: 1, ..DropCounts::default() }));
        let mut assembler = assembler();
        (0..30).filter(|&k| k != 14).for_each(|k| drop(assembler.push(frame(k))));
        assert_eq!(assembler.last_dropped_tick(), Some(2));
        let doubled = run((0..30).flat_map(|k| vec![frame(k); if k == 14 { 2 } else { 1 }]));
        assert_eq!((ticks(&doubled.0), doubled.1.doubled, doubled.1.sets()), (vec![0, 1, 3, 4], 1, 1));
        for first_or_later in [12, 14, 17] {
            let late = run((0..30).map(|k| {
                let mut f = frame(k);
                f.device_time_nanos += if k == first_or_later { PERIOD * 6 / 10 } else { 0 };
                f
            }));
            assert_eq!((ticks(&late.0), late.1.late, late.1.sets()), (vec![0, 1, 3, 4], 1, 1));
        }
    }

    #[test]
    fn a_long_gap_counts_every_set_and_a_run_may_begin_anywhere() {
        let (sets, drops) = run((8..20).chain(38..60).map(frame));
        // Set 1 began before the run, 3 and 6 are torn, 4 and 5 never came.
        assert_eq!((ticks(&sets), drops.lost), (vec![2, 7, 8, 9], 5));
    }

    #[test]
    fn a_slow_sensor_clock_does_not_shift_ticks() {
        let (sets, drops) =
            run((0..60_000)
                .map(|k| Frame { device_time_nanos: frame(k).device_time_nanos * 10_005 / 10_000, ..frame(k) }));
        assert_eq!((sets.len(), sets[9_999].tick, drops.sets()), (10_000, 9_999, 0));
    }

    #[test]
    fn a_wild_stamp_or_a_clock_set_back_is_survived() {
        let wild =
            (0..120).map(|k| Frame { device_time_nanos: if k == 20 { u64::MAX } else { k * PERIOD }, ..frame(k) });
        let (sets, drops) = run(wild);
        assert!(sets.len() >= 14 && drops.stray_frames > 0, "{} sets", sets.len());
        assert!(sets.windows(2).all(|w| w[0].tick < w[1].tick));
        let mut unknown = frame(3);
        unknown.pattern = PatternIndex(u16::MAX);
        assert_eq!(run([unknown]).1.stray_frames, 1);
    }

    #[derive(Debug, Clone, Copy)]
    enum Trouble {
        Lose,
        Double,
        Delay,
        Swap,
        Relabel,
    }

    proptest! {
        #[test]
        fn no_trouble_ever_mixes_a_set(
            troubles in prop::collection::vec((0usize..120, prop_oneof![
                Just(Trouble::Lose), Just(Trouble::Double), Just(Trouble::Delay), Just(Trouble::Swap), Just(Trouble::Relabel)
            ]), 0..12)
        ) {
            let mut frames: Vec<Frame> = (0..120).map(frame).collect();
            let mut touched = std::collections::BTreeSet::new();
            // Promises about ticks and about the sets around hold for one trouble at a time.
            let mut places: Vec<usize> = troubles.iter().map(|t| t.0).collect();
            places.sort_unstable();
            let is_sparse = places.windows(2).all(|w| w[1] - w[0] > 6);
            for (at, trouble) in troubles {
                let at = at % frames.len();
                let end = (at + 1).min(frames.len() - 1);
                touched.extend([frames[at].sequence / 6, frames[end].sequence / 6]);
                match trouble {
                    Trouble::Lose => { frames.remove(at); }
                    Trouble::Double => { let f = frames[at].clone(); frames.insert(at, f); }
                    Trouble::Delay => frames[at].device_time_nanos += PERIOD * 6 / 10,
                    Trouble::Swap => frames.swap(at, end),
                    Trouble::Relabel => frames[at].pattern.0 = (frames[at].pattern.0 + 1) % 6,
                }
            }
            // A frame whose label and stamp together claim a later set opens that one early, so it may spoil every set up to it.
            for f in &frames {
                let start = i128::from(f.device_time_nanos) - i128::from(f.pattern.0) * i128::from(PERIOD);
                let claimed = (start + i128::from(3 * PERIOD)).div_euclid(i128::from(6 * PERIOD)).max(0) as u64;
                touched.extend((f.sequence / 6).min(claimed)..=claimed);
            }
            let (sets, _) = run(frames);
            for set in &sets {
                for (n, f) in set.frames.iter().enumerate() {
                    prop_assert_eq!(usize::from(f.pattern.0), n);
                    prop_assert_eq!(u64::from(f.picture.pixels[0]), set.frames[0].sequence + n as u64);
                    prop_assert_eq!(f.sequence % 6, n as u64);
                }
                prop_assert!(!is_sparse || set.frames[0].sequence / 6 == set.tick);
            }
            prop_assert!(sets.windows(2).all(|w| w[0].tick < w[1].tick));
            // Whatever was left alone comes out.
            for tick in (0..20).filter(|t| is_sparse && !touched.contains(t)) {
                prop_assert!(sets.iter().any(|s| s.tick == tick), "set {} is missing", tick);
            }
        }
    }
}
