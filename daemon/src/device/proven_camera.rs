//! A camera whose every picture is proven to belong to its pulse.
//!
//! A driver's own numbers do not prove it: a picture that the sensor skipped leaves no gap in them, and from then on every
//! picture would be taken for the pattern of the one before. So pictures are numbered by their time. The first picture of a run
//! fixes where pulse 0 lies on the sensor's clock; from then on a picture belongs to the pulse that is nearest to it, and the
//! clock's drift is followed slowly. Where the driver's number puts a picture within half a period of its time the number
//! stands, so a late picture is still a late picture of its own pulse.
//!
//! What time cannot tell: a run whose very first picture the sensor skipped without the driver's numbers showing it is off by
//! one throughout. A camera that is started before the first pulse, as it is here, has no reason to.
//!
//! With a trigger controller every pulse must be reported besides: pictures wait until the report of their pulse, or of a later
//! one of the same schedule, has come. Pulses that came late, or not at all, take their pictures with them. What is left over
//! has the numbers of the pulses, and [`crate::pipeline::FrameSetAssembler`] drops the sets that have gaps.

use super::{Camera, CameraInfo, CameraSettings, DeviceError, Frame, PatternIndex, TriggerEvent, TriggerSource};
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
/// Bad pulses that are remembered.
const MOST_BAD: usize = 1024;

/// Pictures with the numbers of their pulses.
#[derive(Debug, Default)]
struct PulseProof {
    period_nanos: i128,
    pattern_count: u64,
    has_trigger: bool,
    /// Number of a pulse and when it is on the sensor's clock.
    anchor: Option<(i128, i128)>,
    /// The driver's number and the pulse's of the picture before.
    last: Option<(u64, i128)>,
    /// The last pulse reported, and when it was on the controller's clock.
    reported: Option<(u64, u64)>,
    bad: BTreeSet<u64>,
    held: VecDeque<Frame>,
    is_restarted: bool,
    /// Pictures that got another number than the driver's.
    renumbered: u64,
    /// Pictures dropped with their pulses.
    disproven: u64,
}

impl PulseProof {
    fn begin(&mut self) {
        let Self { period_nanos, pattern_count, has_trigger, .. } = *self;
        *self = Self { period_nanos, pattern_count, has_trigger, ..Self::default() };
    }

    /// When a pulse is due on the sensor's clock.
    fn due_nanos(&self, (number, time_nanos): (i128, i128), pulse: i128) -> i128 {
        time_nanos + (pulse - number) * self.period_nanos
    }

    fn pulse_of(&self, frame: &Frame) -> i128 {
        let (Some(anchor), Some((sequence, number))) = (self.anchor, self.last) else {
            return i128::from(frame.sequence);
        };
        let time_nanos = i128::from(frame.device_time_nanos);
        let told = number + i128::from(frame.sequence) - i128::from(sequence);
        if 2 * (time_nanos - self.due_nanos(anchor, told)).abs() < self.period_nanos {
            return told;
        }
        anchor.0 + (time_nanos - anchor.1 + self.period_nanos / 2).div_euclid(self.period_nanos)
    }

    fn picture(&mut self, mut frame: Frame) {
        let pulse = self.pulse_of(&frame);
        let time_nanos = i128::from(frame.device_time_nanos);
        let due_nanos = self.anchor.map_or(time_nanos, |anchor| self.due_nanos(anchor, pulse));
        let off_nanos = time_nanos - due_nanos;
        if 4 * off_nanos.abs() <= self.period_nanos {
            self.anchor = Some((pulse, due_nanos + off_nanos / FOLLOW_PART));
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
            }
            TriggerEvent::Overrun { counter } => self.bad.extend([counter]),
            TriggerEvent::Restarted => self.is_restarted = true,
        }
        while self.bad.len() > MOST_BAD {
            self.bad.pop_first();
        }
    }

    /// The next picture whose pulse is proven.
    fn take(&mut self) -> Option<Frame> {
        loop {
            let number = self.held.front()?.sequence;
            if self.has_trigger && self.reported.is_none_or(|(reported, _)| number > reported) {
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
    proof: PulseProof,
    /// Exposures are started by the trigger line; the camera's own clock needs no proof.
    is_triggered: bool,
}

impl ProvenCamera {
    /// Puts the proof before a camera; `reports` are a trigger controller's, if there is one.
    pub fn new(
        inner: Box<dyn Camera>,
        reports: Option<Receiver<TriggerEvent>>,
        period_nanos: u64,
        pattern_count: usize,
    ) -> Self {
        let proof = PulseProof {
            period_nanos: i128::from(period_nanos.max(1)),
            pattern_count: pattern_count.max(1) as u64,
            has_trigger: reports.is_some(),
            ..PulseProof::default()
        };
        Self { inner, reports, proof, is_triggered: true }
    }

    /// Takes what the controller has reported; waits up to `patience` for the first.
    fn listen(&mut self, patience: Duration) {
        let Some(reports) = &self.reports else { return };
        match reports.recv_timeout(patience) {
            Ok(event) => self.proof.event(event),
            Err(RecvTimeoutError::Timeout) => return,
            Err(RecvTimeoutError::Disconnected) => self.proof.is_restarted = true,
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
        self.inner.start()
    }

    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        if !self.is_triggered {
            return self.inner.next_frame(deadline);
        }
        loop {
            self.listen(Duration::ZERO);
            if self.proof.is_restarted {
                return Err(DeviceError::Disconnected("the trigger controller".into()));
            }
            if let Some(frame) = self.proof.take() {
                return Ok(frame);
            }
            let now = Instant::now();
            if self.proof.held.len() >= MOST_HELD {
                if now >= deadline {
                    return Err(DeviceError::Timeout("the trigger controller reports no pulses".into()));
                }
                self.listen(deadline - now);
                continue;
            }
            let is_waiting = !self.proof.held.is_empty();
            let until = if is_waiting { deadline.min(now + SLICE) } else { deadline };
            match self.inner.next_frame(until) {
                Ok(frame) => self.proof.picture(frame),
                Err(DeviceError::Timeout(_)) if is_waiting && Instant::now() < deadline => {}
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
        PulseProof { period_nanos, pattern_count: PATTERNS, has_trigger, ..PulseProof::default() }
    }

    fn report(counter: u64) -> TriggerEvent {
        TriggerEvent::Pulse { counter, time_nanos: 7_000_000_000 + counter * PERIOD }
    }

    fn all(proof: &mut PulseProof) -> Vec<u64> {
        std::iter::from_fn(|| proof.take()).map(|f| f.sequence).collect()
    }

    #[test]
    fn a_picture_that_the_driver_does_not_miss_is_missed() {
        let mut proof = proof(false);
        // The sensor skipped pulse 4: its numbers go on as if nothing was.
        (0..4).chain(5..12).enumerate().for_each(|(n, pulse)| proof.picture(frame(n as u64, pulse)));
        let frames: Vec<Frame> = std::iter::from_fn(|| proof.take()).collect();
        for f in &frames {
            assert_eq!(f.sequence, u64::from(f.picture.pixels[0]));
            assert_eq!(u64::from(f.pattern.0), f.sequence % PATTERNS);
        }
        assert_eq!((frames.len(), proof.renumbered), (11, 7));
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
        (0..8).for_each(|k| proof.picture(frame(k, k)));
        proof.event(report(0));
        proof.event(TriggerEvent::Pulse { counter: 4, time_nanos: 7_000_000_000 + 6 * PERIOD });
        proof.event(TriggerEvent::Pulse { counter: 7, time_nanos: 7_000_000_000 + 9 * PERIOD });
        assert_eq!((all(&mut proof), proof.disproven), (vec![0, 5, 6, 7], 4));
        proof.event(TriggerEvent::Restarted);
        assert!(proof.is_restarted);
        proof.begin();
        assert!(!proof.is_restarted && proof.has_trigger);
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
