//! Frames to frame sets: complete, in order, on schedule, or not at all.
//!
//! Three witnesses tell which trigger a frame belongs to: its sequence number, its pattern index and its time on the sensor's
//! clock. Each frame is held against two references. Within a set the frames must follow one another: patterns from 0,
//! sequence numbers without a gap, exposures where the schedule puts them after the set's first; so pictures of two sets never
//! mix, whatever the frames before were like. And every frame must agree with the schedule that the last complete set fixes;
//! that gives the tick, and a fault is charged to the set of the frame's own sequence number alone. A set whose frames are
//! left alone therefore always comes out.
//!
//! What the witnesses cannot tell: a set all of whose frames are wrong in the same way is like a right one. It is dropped when
//! it contradicts the set before, so only the first of a run can be one; then the set after it is dropped, too. Two sets in a
//! row that agree with each other but not with what was before are a device that began anew: the schedule follows them.

use crate::device::{Frame, SequenceTiming};
use crate::light::PatternSequence;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// What a sensor's clock may differ from the schedule's over many pictures: one part in this.
const DRIFT_PART: i128 = 100;

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

/// Where the schedule has picture 0 of a set.
#[derive(Debug, Clone, Copy)]
struct Base {
    tick: u64,
    /// Sequence number and sensor time of pattern 0; before 0 when a run begins in the middle of a set.
    sequence: i128,
    start_nanos: i128,
}

/// Where a frame lies by its sequence number, seen from a base.
#[derive(Debug, Clone, Copy)]
struct Place {
    sets: i128,
    slot: usize,
    is_late: bool,
}

/// The set that frames are arriving of, or the last one if it is closed.
#[derive(Debug, Clone, Copy)]
struct OpenSet {
    tick: u64,
    fault: Option<Cause>,
    is_closed: bool,
}

/// Collects frames into frame sets.
#[derive(Debug)]
pub struct FrameSetAssembler {
    pattern_count: usize,
    timed_by: Range<usize>,
    period_nanos: i128,
    /// By the last complete set; until there is one, by the last frame of pattern 0.
    base: Option<Base>,
    has_complete: bool,
    /// Base by the last complete set before the devices began anew; ticks go on from it.
    origin: Option<Base>,
    /// Base by a complete set that contradicts `base`.
    rival: Option<Base>,
    open: Option<OpenSet>,
    /// Frames from pattern 0 on that follow one another.
    run: Vec<Frame>,
    last_sequence: Option<u64>,
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
            base: None,
            has_complete: false,
            origin: None,
            rival: None,
            open: None,
            run: Vec::new(),
            last_sequence: None,
            drops: DropCounts::default(),
            last_dropped_tick: None,
        }
    }

    /// Tick of the set dropped last.
    pub fn last_dropped_tick(&self) -> Option<u64> {
        self.last_dropped_tick
    }

    /// Scan period of a frame that is yet to be taken; `None` when its number and its time contradict each other.
    pub fn tick_of(&self, frame: &Frame) -> Option<u64> {
        let base = self.base.unwrap_or_else(|| self.base_of(frame));
        self.place(&base, frame).map(|place| tick_after(&base, place.sets))
    }

    /// The scan period after the last one that is closed; `None` while a set is open.
    pub fn complete_ticks(&self) -> Option<u64> {
        self.open.filter(|open| open.is_closed).map(|open| open.tick.saturating_add(1))
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
        let before = self.last_sequence.replace(frame.sequence);
        let repeated = (before == Some(frame.sequence)).then_some(Cause::Doubled);
        if self.base.is_none() || (!self.has_complete && pattern == 0 && repeated.is_none()) {
            self.begin(&frame);
        }
        let base = self.base?;
        let place = self.place(&base, &frame);
        let off_schedule = match place {
            Some(place) if place.slot != pattern => Some(Cause::Disordered),
            Some(Place { is_late: false, .. }) => None,
            _ => Some(Cause::Late),
        };
        let out_of_line = self.follow(frame, before);
        let tick = place.map(|place| tick_after(&base, place.sets));
        self.account(tick, repeated.or(off_schedule).or(out_of_line));
        if self.run.len() < self.pattern_count { None } else { self.complete(&base) }
    }

    /// The devices begin anew: no set has frames of both sides of this, and ticks go on with the sensor's clock.
    pub fn restart(&mut self) {
        self.close();
        self.origin = self.base.take().filter(|_| self.has_complete).or(self.origin);
        (self.has_complete, self.rival, self.last_sequence) = (false, None, None);
        self.run.clear();
    }

    /// Ends the run: a set that is still open is dropped as lost.
    pub fn finish(&mut self) -> DropCounts {
        self.close();
        self.drops
    }

    /// The base that `frame` alone claims; the tick is the nearest by its time.
    fn base_of(&self, frame: &Frame) -> Base {
        let pattern = i128::from(frame.pattern.0);
        let start_nanos = i128::from(frame.device_time_nanos) - pattern * self.period_nanos;
        let tick = match &self.origin {
            None => u64::try_from(self.sets_in(start_nanos)).unwrap_or(0),
            Some(origin) => {
                let first = self.open.map_or(0, |open| open.tick.saturating_add(u64::from(open.is_closed)));
                tick_after(origin, self.sets_in(start_nanos - origin.start_nanos)).max(first)
            }
        };
        Base { tick, sequence: i128::from(frame.sequence) - pattern, start_nanos }
    }

    /// The nearest whole number of set periods.
    fn sets_in(&self, nanos: i128) -> i128 {
        let set_nanos = self.period_nanos * self.pattern_count as i128;
        (nanos + set_nanos / 2).div_euclid(set_nanos)
    }

    /// Before the first complete set, every frame of pattern 0 may be its beginning.
    fn begin(&mut self, frame: &Frame) {
        let base = self.base_of(frame);
        if self.origin.is_some() && self.open.is_some_and(|open| base.tick > open.tick) {
            self.advance(base.tick, None);
        } else {
            if self.open.is_some_and(|open| open.tick != base.tick) {
                self.close();
            }
            self.open = Some(OpenSet { tick: base.tick, fault: None, is_closed: false });
        }
        self.base = Some(base);
    }

    /// `None` when sequence number and time are half a set or more apart.
    fn place(&self, base: &Base, frame: &Frame) -> Option<Place> {
        let count = self.pattern_count as i128;
        let triggers = i128::from(frame.sequence) - base.sequence;
        let due_nanos = triggers.saturating_mul(self.period_nanos);
        let off_nanos = (i128::from(frame.device_time_nanos) - base.start_nanos).saturating_sub(due_nanos);
        let excess_nanos = off_nanos.saturating_abs() - due_nanos.saturating_abs() / DRIFT_PART;
        (2 * excess_nanos < count * self.period_nanos).then(|| Place {
            sets: triggers.div_euclid(count),
            slot: triggers.rem_euclid(count) as usize,
            is_late: 2 * excess_nanos > self.period_nanos,
        })
    }

    /// Adds a frame to the run, or begins another; says what parts it from the frames `before` it in its own set.
    fn follow(&mut self, frame: Frame, before: Option<u64>) -> Option<Cause> {
        let pattern = usize::from(frame.pattern.0);
        let is_next = |last: &Frame| frame.sequence == last.sequence.wrapping_add(1);
        let is_in_order = pattern == self.run.len() && self.run.last().is_none_or(is_next);
        let is_on_time = self.run.first().is_none_or(|first| {
            let start_nanos = i128::from(frame.device_time_nanos) - pattern as i128 * self.period_nanos;
            4 * (start_nanos - i128::from(first.device_time_nanos)).abs() <= self.period_nanos
        });
        if is_in_order && is_on_time {
            self.run.push(frame);
            return None;
        }
        self.run.clear();
        let is_back = before.is_some_and(|before| frame.sequence < before);
        if pattern == 0 {
            self.run.push(frame);
            return None;
        }
        Some(match (is_in_order, is_back) {
            (true, _) => Cause::Late,
            (false, true) => Cause::Disordered,
            (false, false) => Cause::Lost,
        })
    }

    /// Charges a frame and its fault to the set of `tick`, or without one to the set that is open.
    fn account(&mut self, tick: Option<u64>, fault: Option<Cause>) {
        let Some(open) = self.open.as_mut() else { return };
        let tick = tick.unwrap_or(open.tick);
        if tick > open.tick {
            self.advance(tick, fault);
        } else if tick == open.tick && !open.is_closed {
            open.fault = open.fault.or(fault);
        } else {
            self.drops.stray_frames += 1;
        }
    }

    /// Opens the set of a later tick.
    fn advance(&mut self, tick: u64, fault: Option<Cause>) {
        self.close();
        let first_missing = self.open.map_or(tick, |open| open.tick.saturating_add(1));
        if tick > first_missing {
            // Sets of which nothing at all arrived.
            self.drops.lost = self.drops.lost.saturating_add(tick - first_missing);
            self.last_dropped_tick = Some(tick - 1);
        }
        self.open = Some(OpenSet { tick, fault, is_closed: false });
    }

    fn close(&mut self) {
        if let Some(open) = self.open.as_mut().filter(|open| !open.is_closed) {
            self.drops.count(open.fault.unwrap_or(Cause::Lost));
            self.last_dropped_tick = Some(open.tick);
            open.is_closed = true;
        }
    }

    /// The run as a set, if the schedule agrees, or if the set before was of the same other schedule.
    fn complete(&mut self, base: &Base) -> Option<FrameSet> {
        let frames = std::mem::take(&mut self.run);
        let first = frames.first()?;
        let place = self.place(base, first).filter(|place| !place.is_late && place.slot == 0);
        let tick = place.map(|place| tick_after(base, place.sets));
        let is_ahead = place.is_some_and(|place| place.sets > 0 || !self.has_complete);
        let is_agreed =
            is_ahead && self.open.is_some_and(|o| Some(o.tick) == tick && o.fault.is_none() && !o.is_closed);
        let tick = match (is_agreed, is_ahead) {
            (true, _) => tick?,
            // Whole, but one of its frames came twice.
            (false, true) => return None,
            (false, false) => self.begin_anew(base, first)?,
        };
        self.rival = None;
        self.has_complete = true;
        self.base = Some(Base { tick, ..self.base_of(first) });
        self.open = Some(OpenSet { tick, fault: None, is_closed: true });
        Some(FrameSet { tick, time_nanos: mean_time_nanos(&frames[self.timed_by.clone()]), frames })
    }

    /// Tick of a complete set that contradicts the base, when the complete set before it did so in the same way.
    fn begin_anew(&mut self, base: &Base, first: &Frame) -> Option<u64> {
        let here = self.base_of(first);
        let sets_on = (self.sets_in(here.start_nanos - base.start_nanos)).max(1);
        let rival = self.rival.replace(Base { tick: tick_after(base, sets_on), ..here })?;
        let place = self.place(&rival, first)?;
        if place.sets < 1 || place.slot != 0 || place.is_late {
            return None;
        }
        let open = self.open?;
        let tick = tick_after(&rival, place.sets).max(open.tick.saturating_add(u64::from(open.is_closed)));
        if tick > open.tick {
            self.advance(tick, None);
        }
        Some(tick)
    }
}

/// Ticks never go below 0 nor beyond their range.
fn tick_after(base: &Base, sets: i128) -> u64 {
    let tick = i128::from(base.tick).saturating_add(sets).max(0);
    u64::try_from(tick).unwrap_or(u64::MAX)
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
    use std::collections::BTreeSet;

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
    fn devices_that_begin_anew_go_on_with_later_ticks_and_mix_nothing() {
        let mut assembler = assembler();
        let mut sets: Vec<FrameSet> = (0..16).filter_map(|k| assembler.push(frame(k))).collect();
        // Numbers and patterns begin anew in the middle of set 2; the clock goes on and is off the old schedule.
        for (run, (begin, off_nanos)) in [(16, PERIOD / 3), (47, 2 * PERIOD / 3), (63, 0)].into_iter().enumerate() {
            assembler.restart();
            let anew = |k| Frame { device_time_nanos: (begin + k) * PERIOD + off_nanos, ..frame(k) };
            sets.extend((0..15).filter_map(|k| assembler.push(anew(k))));
            assert_eq!(sets.len(), 4 + 2 * run);
        }
        assert_eq!(ticks(&sets), [0, 1, 3, 4, 8, 9, 11, 12]);
        // 2, 5, 10 and 13 are torn, 6 and 7 never came.
        assert_eq!((assembler.finish().lost, assembler.drops().sets()), (6, 6));
    }

    #[test]
    fn a_slow_sensor_clock_does_not_shift_ticks() {
        let (sets, drops) =
            run((0..60_000)
                .map(|k| Frame { device_time_nanos: frame(k).device_time_nanos * 10_005 / 10_000, ..frame(k) }));
        assert_eq!((sets.len(), sets[9_999].tick, drops.sets()), (10_000, 9_999, 0));
    }

    #[test]
    fn a_wild_stamp_costs_one_set_and_a_clock_set_anew_one_more() {
        let wild =
            (0..120).map(|k| Frame { device_time_nanos: if k == 20 { u64::MAX } else { k * PERIOD }, ..frame(k) });
        let (sets, drops) = run(wild);
        assert_eq!((sets.len(), drops), (19, DropCounts { late: 1, ..DropCounts::default() }));
        let mut unknown = frame(3);
        unknown.pattern = PatternIndex(u16::MAX);
        assert_eq!(run([unknown]).1.stray_frames, 1);
        // The clock goes back, or on, and the numbers begin anew, between two sets: the first one proves nothing.
        for (back, numbers_back) in [(50, 0), (0, 60), (60, 60), (2, 0)] {
            let begun = (60..120).map(|k| Frame {
                sequence: k - numbers_back,
                device_time_nanos: (k - back) * PERIOD,
                ..frame(k)
            });
            let (sets, drops) = run((0..60).map(frame).chain(begun));
            assert_eq!(ticks(&sets), (0..10).chain(11..20).collect::<Vec<_>>(), "{back}, {numbers_back}");
            assert_eq!(drops.sets(), 1);
        }
    }

    #[test]
    fn a_whole_set_that_contradicts_the_run_is_dropped_alone() {
        let late = run((0..60).map(|k| {
            let delay = if (24..30).contains(&k) { PERIOD * 6 / 10 } else { 0 };
            Frame { device_time_nanos: k * PERIOD + delay, ..frame(k) }
        }));
        assert_eq!((ticks(&late.0), late.1.late), ((0..10).filter(|&t| t != 4).collect(), 1));
        // Six pictures from the middle of one set to the middle of the next, labelled as one.
        let relabelled = run((0..60).map(|k| {
            let pattern = if (27..33).contains(&k) { k - 27 } else { k % 6 };
            Frame { pattern: PatternIndex(pattern as u16), ..frame(k) }
        }));
        assert_eq!(ticks(&relabelled.0), [0, 1, 2, 3, 6, 7, 8, 9]);
        assert_eq!(relabelled.1, DropCounts { disordered: 2, ..DropCounts::default() });
    }

    #[derive(Debug, Clone, Copy)]
    enum Trouble {
        Lose,
        Double,
        Delay,
        Swap,
        Relabel,
    }

    /// Frames of 20 sets after the troubles, and the sets that had one.
    fn troubled(troubles: &[(usize, Trouble)]) -> (Vec<Frame>, BTreeSet<u64>) {
        let mut frames: Vec<Frame> = (0..120).map(frame).collect();
        let mut touched = BTreeSet::new();
        for &(at, trouble) in troubles {
            let at = at % frames.len();
            let next = (at + 1).min(frames.len() - 1);
            touched.insert(frames[at].sequence / 6);
            match trouble {
                Trouble::Lose => drop(frames.remove(at)),
                Trouble::Double => frames.insert(at, frames[at].clone()),
                Trouble::Delay => frames[at].device_time_nanos += PERIOD * 6 / 10,
                Trouble::Relabel => frames[at].pattern.0 = (frames[at].pattern.0 + 1) % 6,
                Trouble::Swap => {
                    touched.insert(frames[next].sequence / 6);
                    frames.swap(at, next);
                }
            }
        }
        (frames, touched)
    }

    fn trouble() -> impl Strategy<Value = Trouble> {
        use Trouble::{Delay, Double, Lose, Relabel, Swap};
        prop_oneof![Just(Lose), Just(Double), Just(Delay), Just(Swap), Just(Relabel)]
    }

    proptest! {
        #[test]
        fn troubles_spoil_their_own_sets_and_nothing_else(
            scattered in prop::collection::vec((0usize..120, trouble()), 0..12),
            heap_at in 0usize..110,
            heap in prop::collection::vec((0usize..8, trouble()), 0..5),
        ) {
            let troubles: Vec<_> = scattered.into_iter().chain(heap.iter().map(|&(at, t)| (heap_at + at, t))).collect();
            let (frames, touched) = troubled(&troubles);
            let (sets, drops) = run(frames);
            for set in &sets {
                for (n, f) in set.frames.iter().enumerate() {
                    prop_assert_eq!(usize::from(f.pattern.0), n);
                    prop_assert_eq!(u64::from(f.picture.pixels[0]), 6 * set.tick + n as u64);
                    prop_assert_eq!(f.sequence, 6 * set.tick + n as u64);
                }
            }
            prop_assert!(sets.windows(2).all(|w| w[0].tick < w[1].tick));
            for tick in (0..20).filter(|t| !touched.contains(t)) {
                prop_assert!(sets.iter().any(|s| s.tick == tick), "set {} is missing", tick);
            }
            // Up to the last set of which anything arrived, every set is given or counted.
            prop_assert!(sets.len() as u64 + drops.sets() <= 20);
            prop_assert!(sets.len() as u64 + drops.sets() >= sets.last().map_or(0, |s| s.tick));
        }
    }
}
