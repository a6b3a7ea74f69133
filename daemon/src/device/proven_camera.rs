//! A camera whose every picture is proven to belong to its pulse.
//!
//! A driver's own numbers do not prove it: a picture that the sensor skipped leaves no gap in them, and from then on every
//! picture would be taken for the pattern of the one before. So every number is held against the picture's time. The first
//! picture of a run fixes where pulse 0 lies on the sensor's clock, and the clock's drift is followed slowly. One that comes
//! whole periods before it is due is one that came twice, and gets the number of its time. One that comes late by half a
//! period or more may have been held up, or may be of a later pulse: it moves nothing, from three quarters on it is left out,
//! and when several in a row are late, nobody guesses, and the run is over.
//!
//! The first picture may itself be late, and everything after it seem early: until a few pictures have confirmed where the
//! pulses lie, a picture that is early by half a period ends the run, too.
//!
//! What time cannot tell: a run whose very first picture the sensor skipped without the driver's numbers showing it is off by
//! one throughout. A camera that is started before the first pulse, as it is here, has no reason to; where one does, what its
//! pictures show tells, when they are decoded, for every sequence of more than one period.
//!
//! With a trigger controller, or a projector that reports its exposures, every pulse must be reported besides: pictures wait
//! until the report of their pulse, or of a later one of the same schedule, has come. Pulses that came late, or not at all,
//! take their pictures with them. What is left over has the numbers of the pulses, and
//! [`crate::pipeline::FrameSetAssembler`] drops the sets that have gaps.
//!
//! Reports and pictures are on two clocks. When one slips against the other by a pulse, no picture after it has a number that
//! can be trusted; nor has one when the projector or the controller began anew. Then the device counts as disconnected: the
//! run is over, and who wants pictures begins another with all devices. A projector's word goes beyond the controller's: what
//! it shows at a pulse only it knows.

use super::{
    Camera, CameraInfo, CameraSettings, DeviceError, ExposureFeed, Frame, PatternIndex, TriggerEvent, TriggerSource,
};
use std::collections::{BTreeSet, VecDeque};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};
use tracing::warn;

/// Pictures that wait for the report of their pulse; beyond it the camera waits.
const MOST_HELD: usize = 32;
/// How long to wait for a picture while reports are due.
const SLICE: Duration = Duration::from_millis(5);
/// The clock's distance is followed by this part of every picture's.
const FOLLOW_PART: i128 = 8;
/// Pictures on time that confirm where the pulses lie.
const CONFIRMING: u32 = 4;
/// Who ends a run that began with a late picture.
const LATE_BEGIN: &str = "the camera, whose first pictures came at the wrong times,";
/// Pictures in a row that came late, after which a run is over, and who ends it.
const MOST_LATE: u32 = 3;
const OUT_OF_STEP: &str = "the camera, whose pictures come late,";
/// Pictures too many that a driver may count.
const MOST_REPEATS: i128 = 8;
/// The device that an [`ExposureFeed`] is of.
const PROJECTOR: &str = "the projector";
/// Bad pulses that are remembered.
const MOST_BAD: usize = 1024;

/// Pictures with the numbers of their pulses.
#[derive(Debug, Default)]
struct PulseProof {
    period_nanos: i128,
    pattern_count: u64,
    /// Who reports pulses.
    reporter: Option<&'static str>,
    /// Number of a pulse and when it is on the sensor's clock.
    anchor: Option<(i128, i128)>,
    /// Pictures that were on time.
    confirmed: u32,
    /// Pictures in a row that came late by half a period or more.
    late: u32,
    /// The driver's number and the pulse's of the picture before.
    last: Option<(u64, i128)>,
    /// The last pulse reported, and when it was on the controller's clock.
    reported: Option<(u64, u64)>,
    /// From the sensor's clock to that of the reports, nanoseconds.
    skew_nanos: Option<i128>,
    bad: BTreeSet<u64>,
    held: VecDeque<Frame>,
    /// With whom the run has ended.
    ended_by: Option<&'static str>,
    /// Pictures that got another number than the driver's.
    renumbered: u64,
    /// Pictures dropped with their pulses.
    disproven: u64,
}

impl PulseProof {
    fn begin(&mut self) {
        let Self { period_nanos, pattern_count, reporter, .. } = *self;
        *self = Self { period_nanos, pattern_count, reporter, ..Self::default() };
    }

    /// When a pulse is due on the sensor's clock.
    fn due_nanos(&self, (number, time_nanos): (i128, i128), pulse: i128) -> i128 {
        time_nanos + (pulse - number) * self.period_nanos
    }

    /// The pulse of a picture, unless it comes so late that it may be of a later one, or its time is a wild one; and whether it
    /// comes late by half a period or more.
    fn pulse_of(&self, frame: &Frame) -> (Option<i128>, bool) {
        let (Some(anchor), Some((sequence, number))) = (self.anchor, self.last) else {
            return (Some(frame.sequence.into()), false);
        };
        let time_nanos = i128::from(frame.device_time_nanos);
        let told = number + i128::from(frame.sequence) - i128::from(sequence);
        let off_nanos = time_nanos - self.due_nanos(anchor, told);
        if 2 * off_nanos.abs() < self.period_nanos {
            return (Some(told), false);
        }
        if off_nanos > 0 {
            return ((4 * off_nanos < 3 * self.period_nanos).then_some(told), true);
        }
        let nearest = anchor.0 + (time_nanos - anchor.1 + self.period_nanos / 2).div_euclid(self.period_nanos);
        let is_whole = 4 * (time_nanos - self.due_nanos(anchor, nearest)).abs() <= self.period_nanos;
        match told - nearest {
            back if back > MOST_REPEATS => (None, true),
            _ if is_whole => (Some(nearest), false),
            _ => (Some(told), false),
        }
    }

    /// Follows the clock by a picture of a pulse; as long as the pulses' place is not confirmed, being early disproves it.
    fn follow(&mut self, pulse: i128, is_next: bool, time_nanos: i128) {
        let due_nanos = self.anchor.map_or(time_nanos, |anchor| self.due_nanos(anchor, pulse));
        let off_nanos = time_nanos - due_nanos;
        let is_on_time = 4 * off_nanos.abs() <= self.period_nanos;
        self.confirmed = self.confirmed.saturating_add(u32::from(is_on_time));
        let is_early =
            self.last.is_some_and(|(_, last)| is_next && pulse <= last) || 2 * off_nanos <= -self.period_nanos;
        if self.confirmed < CONFIRMING && is_early {
            warn!(pulse, off_nanos, "a picture came too early: those before it were late");
            self.ended_by = Some(LATE_BEGIN);
        }
        let quarter_nanos = self.period_nanos / 4;
        self.anchor = Some((pulse, due_nanos + off_nanos.clamp(-quarter_nanos, quarter_nanos) / FOLLOW_PART));
    }

    fn picture(&mut self, mut frame: Frame) {
        let (pulse, is_late) = self.pulse_of(&frame);
        self.late = if is_late { self.late + 1 } else { 0 };
        if self.late >= MOST_LATE {
            warn!(sequence = frame.sequence, "pictures come late: held up, or of later pulses");
            self.ended_by = Some(OUT_OF_STEP);
        }
        let Some(pulse) = pulse.filter(|_| self.late < MOST_LATE) else {
            self.disproven += 1;
            return;
        };
        if !is_late {
            let is_next = self.last.is_some_and(|(sequence, _)| frame.sequence > sequence);
            self.follow(pulse, is_next, frame.device_time_nanos.into());
        }
        self.last = Some((frame.sequence, pulse));
        let Ok(number) = u64::try_from(pulse) else { return };
        self.renumbered += u64::from(number != frame.sequence);
        frame.sequence = number;
        frame.pattern = PatternIndex((number % self.pattern_count) as u16);
        self.held.push_back(frame);
    }

    fn event(&mut self, event: TriggerEvent) {
        match event {
            TriggerEvent::Pulse { counter, time_nanos } => {
                if let Some((last, last_nanos)) = self.reported.filter(|(last, _)| counter > *last) {
                    let due_nanos = i128::from(last_nanos) + i128::from(counter - last) * self.period_nanos;
                    if 4 * (i128::from(time_nanos) - due_nanos).abs() > self.period_nanos {
                        self.bad.extend((last + 1..=counter).take(MOST_BAD));
                    }
                }
                self.reported = Some((counter, time_nanos));
                self.compare_clocks(counter, time_nanos);
            }
            TriggerEvent::Overrun { counter } => self.bad.extend([counter]),
            TriggerEvent::Restarted => self.ended_by = self.reporter,
        }
        while self.bad.len() > MOST_BAD {
            self.bad.pop_first();
        }
    }

    /// Follows the distance of the two clocks; a step of nearly a period is a pulse that one of them does not know of.
    fn compare_clocks(&mut self, counter: u64, time_nanos: u64) {
        let Some(anchor) = self.anchor else { return };
        let skew_nanos = i128::from(time_nanos) - self.due_nanos(anchor, counter.into());
        let known_nanos = *self.skew_nanos.get_or_insert(skew_nanos);
        let step_nanos = skew_nanos - known_nanos;
        if 4 * step_nanos.abs() > 3 * self.period_nanos {
            warn!(counter, step_nanos, "pictures and pulses are out of step");
            self.ended_by = self.reporter;
        } else if 4 * step_nanos.abs() <= self.period_nanos {
            self.skew_nanos = Some(known_nanos + step_nanos / FOLLOW_PART);
        }
    }

    /// The next picture whose pulse is proven.
    fn take(&mut self) -> Option<Frame> {
        loop {
            let number = self.held.front()?.sequence;
            if self.reporter.is_some() && self.reported.is_none_or(|(reported, _)| number > reported) {
                return None;
            }
            let frame = self.held.pop_front()?;
            if !self.bad.contains(&number) {
                return Some(frame);
            }
            self.disproven += 1;
        }
    }
}

/// A camera with the proof of its pictures.
pub struct ProvenCamera {
    inner: Box<dyn Camera>,
    reports: Option<Receiver<TriggerEvent>>,
    exposures: Option<ExposureFeed>,
    /// Which of the projector's runs the pictures are of, once one is there.
    run: Option<u64>,
    proof: PulseProof,
    /// Exposures are started by the trigger line; the camera's own clock needs no proof.
    is_triggered: bool,
}

impl ProvenCamera {
    /// Puts the proof before a camera; `reports` are a trigger controller's, if there is one, `exposures` the projector's, if
    /// it tells of them.
    pub fn new(
        inner: Box<dyn Camera>,
        reports: Option<Receiver<TriggerEvent>>,
        exposures: Option<ExposureFeed>,
        period_nanos: u64,
        pattern_count: usize,
    ) -> Self {
        let tells_exposures = exposures.as_ref().is_some_and(ExposureFeed::tells_exposures);
        let reporter = match (&reports, tells_exposures) {
            (Some(_), _) => Some("the trigger controller"),
            (None, true) => Some(PROJECTOR),
            (None, false) => None,
        };
        let proof = PulseProof {
            period_nanos: i128::from(period_nanos.max(1)),
            pattern_count: pattern_count.max(1) as u64,
            reporter,
            ..PulseProof::default()
        };
        Self { inner, reports, exposures, run: None, proof, is_triggered: true }
    }

    /// The first picture tells which of the projector's runs it is of.
    fn picture(&mut self, frame: Frame) {
        self.run = self.run.or(self.exposures.as_ref().map(ExposureFeed::runs));
        self.proof.picture(frame);
    }

    /// Takes what the projector has reported; without a controller it waits up to `patience` for the first.
    fn listen_to_projector(&mut self, patience: Duration) {
        let (Some(feed), Some(run)) = (&self.exposures, self.run) else { return };
        let is_alone = self.reports.is_none() && feed.tells_exposures();
        let first = if is_alone && !patience.is_zero() { feed.next(Instant::now() + patience).ok() } else { None };
        let (now, rest) = feed.take();
        if now != run {
            warn!("the projector is gone, or began anew");
            self.proof.ended_by = Some(PROJECTOR);
        } else if is_alone {
            for exposure in first.into_iter().chain(rest) {
                let (counter, time_nanos) = (exposure.sequence, exposure.device_time_nanos);
                self.proof.event(TriggerEvent::Pulse { counter, time_nanos });
            }
        }
    }

    /// Takes what was reported; waits up to `patience` for the first.
    fn listen(&mut self, patience: Duration) {
        self.listen_to_projector(patience);
        let Some(reports) = &self.reports else { return };
        match reports.recv_timeout(patience) {
            Ok(event) => self.proof.event(event),
            Err(RecvTimeoutError::Timeout) => return,
            Err(RecvTimeoutError::Disconnected) => self.proof.ended_by = self.proof.reporter,
        }
        reports.try_iter().for_each(|event| self.proof.event(event));
    }
}

impl Camera for ProvenCamera {
    fn info(&self) -> CameraInfo {
        self.inner.info()
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        self.is_triggered = want.trigger == TriggerSource::Projector;
        self.inner.configure(want)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        // Reports of a run before are none of this one.
        self.reports.iter().for_each(|reports| reports.try_iter().for_each(drop));
        self.proof.begin();
        self.run = None;
        self.inner.start()
    }

    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        if !self.is_triggered {
            return self.inner.next_frame(deadline);
        }
        loop {
            self.listen(Duration::ZERO);
            if let Some(device) = self.proof.ended_by {
                return Err(DeviceError::Disconnected(device.into()));
            }
            if let Some(frame) = self.proof.take() {
                return Ok(frame);
            }
            let now = Instant::now();
            if self.proof.held.len() >= MOST_HELD {
                if now >= deadline {
                    return Err(DeviceError::Timeout("no pulses are reported".into()));
                }
                self.listen(deadline - now);
                continue;
            }
            let is_waiting = !self.proof.held.is_empty();
            let until = if is_waiting { deadline.min(now + SLICE) } else { deadline };
            match self.inner.next_frame(until) {
                Ok(frame) => self.picture(frame),
                Err(DeviceError::Timeout(_)) if is_waiting && Instant::now() < deadline => {
                    // A camera in virtual time does not wait itself.
                    self.listen(until.saturating_duration_since(Instant::now()));
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        let PulseProof { renumbered, disproven, .. } = self.proof;
        if renumbered + disproven > 0 {
            warn!(renumbered, disproven, "pictures that the trigger's pulses contradict");
        }
        self.proof.begin();
        self.inner.stop()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gv3_codec::GreyPicture;
    use proptest::prelude::*;

    const PERIOD: u64 = 5_555_556;
    const PATTERNS: u64 = 6;

    /// Picture of pulse `pulse`, of which the driver says that it is its `sequence`th.
    fn frame(sequence: u64, pulse: u64) -> Frame {
        Frame {
            sequence,
            pattern: PatternIndex((sequence % PATTERNS) as u16),
            device_time_nanos: 30_000_000 + pulse * PERIOD,
            host_time_nanos: 40_000_000 + pulse * PERIOD,
            exposure_nanos: 5_000_000,
            picture: GreyPicture::filled(1, 1, pulse as u8),
        }
    }

    fn proof(has_trigger: bool) -> PulseProof {
        let period_nanos = i128::from(PERIOD);
        let reporter = has_trigger.then_some(PROJECTOR);
        PulseProof { period_nanos, pattern_count: PATTERNS, reporter, ..PulseProof::default() }
    }

    fn report(counter: u64) -> TriggerEvent {
        TriggerEvent::Pulse { counter, time_nanos: 7_000_000_000 + counter * PERIOD }
    }

    fn all(proof: &mut PulseProof) -> Vec<u64> {
        std::iter::from_fn(|| proof.take()).map(|f| f.sequence).collect()
    }

    #[test]
    fn a_picture_that_the_driver_does_not_miss_ends_the_run() {
        let mut proof = proof(false);
        // The sensor skipped pulse 4: its numbers go on as if nothing was.
        for (n, pulse) in (0..4).chain(5..8).enumerate() {
            assert!(proof.ended_by.is_none(), "pulse {pulse}");
            proof.picture(frame(n as u64, pulse));
        }
        assert_eq!((proof.ended_by, proof.disproven, all(&mut proof)), (Some(OUT_OF_STEP), 3, (0..4).collect()));
    }

    #[test]
    fn a_picture_missed_while_all_others_come_late_shifts_none() {
        for (first_late, late) in [(0, 0), (0, 25), (0, 50), (0, 70), (45, 0), (45, 45), (0, 110)] {
            let mut proof = proof(false);
            // The sensor skips pulse 3, and from then on everything is held up; the driver tells of nothing.
            for (n, pulse) in (0..3).chain(4..40).enumerate() {
                let mut f = frame(n as u64, pulse);
                f.device_time_nanos += PERIOD
                    * if n == 0 {
                        first_late
                    } else if pulse > 3 {
                        late
                    } else {
                        0
                    }
                    / 100;
                proof.picture(f);
                if proof.ended_by.is_some() {
                    break;
                }
            }
            let wrong = proof.held.iter().filter(|f| f.sequence != u64::from(f.picture.pixels[0])).count();
            // Two that are late may pass; they are late in their set, too.
            assert!(proof.ended_by.is_some() && wrong < MOST_LATE as usize, "{first_late}, {late}: {wrong}");
        }
    }

    #[test]
    fn pictures_that_were_held_up_are_left_out_and_those_after_them_are_right() {
        let mut proof = proof(false);
        // Pulses 8 and 9 come with 12 and 13, of which the camera had no room for 10 to 13; the driver does not know.
        let held = [8, 9].map(|k| Frame { device_time_nanos: frame(k, k + 4).device_time_nanos, ..frame(k, k) });
        (0..8).map(|k| frame(k, k)).chain(held).for_each(|f| proof.picture(f));
        assert_eq!((all(&mut proof), proof.ended_by), ((0..8).collect(), None));
        (14..20).for_each(|k| proof.picture(frame(k - 4, k)));
        assert_eq!((all(&mut proof), proof.ended_by), (Vec::new(), Some(OUT_OF_STEP)));
    }

    #[test]
    fn a_picture_that_came_twice_is_known_as_one() {
        let mut proof = proof(false);
        // The driver counts the second one as another.
        (0..20).for_each(|n| proof.picture(frame(n, if n < 9 { n } else { n - 1 })));
        let numbers = all(&mut proof);
        assert_eq!((numbers, proof.ended_by), ((0..9).chain(8..19).collect(), None));
    }

    #[test]
    fn a_late_picture_keeps_its_number_and_moves_nothing() {
        let mut proof = proof(false);
        for k in 0..20 {
            let mut f = frame(k, k);
            f.device_time_nanos += if k == 7 { PERIOD * 45 / 100 } else { 0 };
            proof.picture(f);
        }
        assert_eq!(all(&mut proof), (0..20).collect::<Vec<_>>());
    }

    #[test]
    fn a_first_picture_that_is_late_ends_the_run_instead_of_shifting_it() {
        let late = |parts_late: &[u64]| {
            let mut proof = proof(false);
            for k in 0..20 {
                let mut f = frame(k, k);
                f.device_time_nanos += PERIOD * parts_late.get(k as usize).unwrap_or(&0) / 100;
                proof.picture(f);
            }
            (proof.ended_by.is_some(), all(&mut proof))
        };
        // A quarter late shifts nothing, and nor does what comes later.
        for parts in [&[25][..], &[45], &[0, 60, 0], &[0, 0, 0, 0, 70, 0, 60, 65, 0], &[0, 0, 0, 0, 160, 60], &[0, 100]]
        {
            let (is_over, numbers) = late(parts);
            let right = (0..20).filter(|k| numbers.contains(k)).count();
            assert!(!is_over && right + 2 >= 20, "{parts:?}: {numbers:?}");
            assert!(numbers.ends_with(&[12, 13, 14, 15, 16, 17, 18, 19]), "{numbers:?}");
        }
        // One that is later cannot be told from one that is missing: nobody guesses.
        for parts in [&[60][..], &[100], &[160, 61], &[90, 90], &[300, 210, 120, 30]] {
            assert!(late(parts).0, "{parts:?}");
        }
    }

    #[test]
    fn pulses_that_slip_little_by_little_keep_their_numbers() {
        let mut proof = proof(false);
        for k in 0..400 {
            let mut f = frame(k, k);
            f.device_time_nanos += k / 40 * (PERIOD * 3 / 10);
            proof.picture(f);
        }
        assert_eq!(all(&mut proof), (0..400).collect::<Vec<_>>());
    }

    #[test]
    fn pictures_wait_for_the_report_of_their_pulse() {
        let mut proof = proof(true);
        (0..6).for_each(|k| proof.picture(frame(k, k)));
        assert!(all(&mut proof).is_empty());
        proof.event(report(0));
        assert_eq!(all(&mut proof), [0]);
        // A report that was lost is made up for by the next one.
        proof.event(report(3));
        assert_eq!(all(&mut proof), [1, 2, 3]);
        proof.event(TriggerEvent::Overrun { counter: 4 });
        proof.event(report(5));
        assert_eq!((all(&mut proof), proof.disproven), (vec![5], 1));
    }

    #[test]
    fn pulses_off_their_schedule_prove_nothing() {
        let mut proof = proof(true);
        (0..12).for_each(|k| proof.picture(frame(k, k)));
        proof.event(report(0));
        proof.event(TriggerEvent::Pulse { counter: 4, time_nanos: 7_000_000_000 + 4 * PERIOD + PERIOD * 2 / 5 });
        (7..12).for_each(|k| proof.event(report(k)));
        // Neither the pulses up to the late one nor those between it and the next on time.
        assert_eq!((all(&mut proof), proof.disproven), (vec![0, 8, 9, 10, 11], 7));
        proof.event(TriggerEvent::Restarted);
        assert_eq!(proof.ended_by, Some(PROJECTOR));
        proof.begin();
        assert!(proof.ended_by.is_none() && proof.reporter.is_some());
    }

    #[test]
    fn a_pulse_that_only_one_side_knows_ends_the_run() {
        for skipped in [-1i64, 1, 2] {
            let mut proof = proof(true);
            for k in 0..40u64 {
                // Both clocks drift, the camera's stamps jitter.
                let mut picture = frame(k, k);
                picture.device_time_nanos += k * 900 + k * 7919 % 1_000_000;
                proof.picture(picture);
                let shown = if k < 20 { 0 } else { skipped * PERIOD as i64 };
                let time_nanos = (7_000_000_000 + k * (PERIOD - 1700)).saturating_add_signed(shown);
                proof.event(TriggerEvent::Pulse { counter: k, time_nanos });
                assert_eq!(proof.ended_by.is_some(), k >= 20, "pulse {k}, {skipped} skipped");
            }
        }
    }

    proptest! {
        #[test]
        fn numbers_are_right_whatever_is_lost(
            lost in prop::collection::vec((any::<bool>(), 0u8..20), 1..300),
            drift_ppm in -300i64..300, jitter in prop::collection::vec(-900_000i64..900_000, 300),
        ) {
            let mut proof = proof(false);
            let mut sequence = 0;
            for (pulse, (is_told, chance)) in lost.iter().enumerate() {
                // One picture in ten is lost; the driver tells of half of them.
                if pulse > 0 && *chance < 2 {
                    sequence += u64::from(*is_told);
                    continue;
                }
                let mut f = frame(sequence, pulse as u64);
                let drift = (pulse as i64 * PERIOD as i64) / 1_000_000 * drift_ppm;
                let jitter = if pulse > 0 { jitter[pulse] } else { 0 };
                f.device_time_nanos = f.device_time_nanos.saturating_add_signed(drift + jitter);
                f.picture.pixels = vec![(pulse % 256) as u8];
                proof.picture(f);
                sequence += 1;
                if proof.ended_by.is_some() {
                    break;
                }
            }
            while let Some(f) = proof.take() {
                prop_assert_eq!((f.sequence % 256) as u8, f.picture.pixels[0]);
            }
        }

        #[test]
        fn wild_stamps_harm_no_picture_after_them(
            wild in any::<u64>(), at in 1u64..30, number in any::<u64>(),
        ) {
            let mut proof = proof(false);
            for k in 0..60 {
                let mut f = frame(k, k);
                if k == at { (f.device_time_nanos, f.sequence) = (wild, number) }
                proof.picture(f);
            }
            let numbers = all(&mut proof);
            prop_assert_eq!(&numbers[numbers.len() - 29..], (31..60).collect::<Vec<_>>());
        }
    }
}
