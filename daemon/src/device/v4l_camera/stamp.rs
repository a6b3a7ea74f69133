//! Numbers and times of pictures, made of what the driver stamps on its buffers.
//!
//! Drivers stamp by CLOCK_MONOTONIC and say so; uvcvideo can be told to use CLOCK_BOOTTIME or CLOCK_REALTIME, and
//! v4l2loopback says nothing. So the clock is told by its time: it is the one that is nearest to the stamp. From then on
//! times are monotonic, and a picture of before the run's start, left over in a queue, is known as such.

use rustix::time::{ClockId, clock_gettime};

/// How far a stamp may be ahead of its clock, nanoseconds: some drivers stamp with the end that a picture is to have.
const AHEAD_NANOS: i128 = 1_000_000_000;
/// How old a stamp may be, nanoseconds.
const MAX_AGE_NANOS: i128 = 3_600_000_000_000;

/// The kernel's clocks at one moment, nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Clocks {
    pub monotonic: u64,
    pub boot: u64,
    pub real: u64,
}

impl Clocks {
    pub fn now() -> Self {
        let nanos = |id| {
            let time = clock_gettime(id);
            (time.tv_sec as u64).wrapping_mul(1_000_000_000).wrapping_add(time.tv_nsec as u64)
        };
        let (monotonic, boot) = (nanos(ClockId::Monotonic), nanos(ClockId::Boottime));
        Self { monotonic, boot, real: nanos(ClockId::Realtime) }
    }

    /// A stamp in monotonic time, by the clock that is nearest to it.
    pub fn monotonic_of(&self, stamp: u64) -> Option<u64> {
        let ahead = |clock: u64| i128::from(stamp) - i128::from(clock);
        let [monotonic, boot, real] = [self.monotonic, self.boot, self.real].map(ahead);
        // The clocks are read one after the other: a small difference tells nothing, and the drivers' habit decides.
        let is_other = |other: &i128| other.abs() + AHEAD_NANOS < monotonic.abs();
        let other = [boot, real].into_iter().filter(is_other).min_by_key(|other| other.abs());
        let ahead = other.unwrap_or(monotonic);
        let is_near = (-MAX_AGE_NANOS..=AHEAD_NANOS).contains(&ahead);
        u64::try_from(i128::from(self.monotonic) + ahead).ok().filter(|_| is_near)
    }
}

/// Driver's numbers, 32 bits and from wherever it begins, as numbers of the stream from 0.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SequenceCounter {
    /// The driver's number and the stream's of the last picture.
    last: Option<(u32, u64)>,
}

/// A driver that begins with a number below this begins with 0 and has lost the pictures before.
const FIRST_NUMBERS: u32 = 16;
/// No more buffers are on their way at once: a number further back is one of a driver that has begun anew.
const MOST_BUFFERS: u32 = 32;

impl SequenceCounter {
    /// The number of a picture, and how many are missing before it: -1 of one that comes after its successor, as uvcvideo's
    /// copying threads make it, and that was counted as missing then.
    pub fn number(&mut self, sequence: u32) -> (u64, i64) {
        let Some((last, number)) = self.last else {
            let number = if sequence < FIRST_NUMBERS { sequence } else { 0 };
            self.last = Some((sequence, number.into()));
            return (number.into(), number.into());
        };
        let back = last.wrapping_sub(sequence);
        if (1..MOST_BUFFERS).contains(&back) && u64::from(back) <= number {
            return (number - u64::from(back), -1);
        }
        let step = match sequence.wrapping_sub(last) {
            0 | 0x8000_0000.. => 1,
            step => step,
        };
        let number = number + u64::from(step);
        self.last = Some((sequence, number));
        (number, i64::from(step) - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    #[test]
    fn the_clock_is_told_by_its_time() {
        let clocks = Clocks { monotonic: 5000 * S, boot: 9000 * S, real: 1_700_000_000 * S };
        for clock in [clocks.monotonic, clocks.boot, clocks.real] {
            assert_eq!(clocks.monotonic_of(clock - 20_000_000), Some(clocks.monotonic - 20_000_000));
            assert_eq!(clocks.monotonic_of(clock + 500_000), Some(clocks.monotonic + 500_000));
        }
        assert_eq!(clocks.monotonic_of(0), None);
        assert_eq!(clocks.monotonic_of(u64::MAX), None);
        assert_eq!(clocks.monotonic_of(9002 * S), None);
        // One clock for two: a machine that never slept.
        let awake = Clocks { boot: 5000 * S + 40, ..clocks };
        assert_eq!(awake.monotonic_of(4999 * S), Some(4999 * S));
        let skewed = Clocks { boot: 5000 * S + 30_000_000, ..clocks };
        assert_eq!(skewed.monotonic_of(5000 * S + 29_000_000), Some(5000 * S + 29_000_000));
        let early = Clocks { monotonic: S, boot: S, real: 1_700_000_000 * S };
        assert_eq!(early.monotonic_of(1_699_999_990 * S), None);
    }

    #[test]
    fn clocks_of_this_machine_agree_with_themselves() {
        let clocks = Clocks::now();
        assert!(clocks.boot + S >= clocks.monotonic && clocks.real > clocks.boot);
        assert!(Clocks::now().monotonic >= clocks.monotonic);
    }

    #[test]
    fn gaps_are_counted_and_wrapping_is_none() {
        let number_all = |sequences: &[u32]| {
            let mut counter = SequenceCounter::default();
            sequences.iter().map(|s| counter.number(*s)).collect::<Vec<_>>()
        };
        assert_eq!(number_all(&[0, 1, 2, 5]), [(0, 0), (1, 0), (2, 0), (5, 2)]);
        assert_eq!(number_all(&[2, 3]), [(2, 2), (3, 0)]);
        assert_eq!(number_all(&[700, 702]), [(0, 0), (2, 1)]);
        assert_eq!(number_all(&[u32::MAX, 0, 1]), [(0, 0), (1, 0), (2, 0)]);
        assert_eq!(number_all(&[50, 0, 1]), [(0, 0), (1, 0), (2, 0)]);
        assert_eq!(number_all(&[0, 2, 1, 3, 6, 4, 5]), [(0, 0), (2, 1), (1, -1), (3, 0), (6, 2), (4, -1), (5, -1)]);
        assert_eq!(number_all(&[0, 0]), [(0, 0), (1, 0)]);
    }
}
