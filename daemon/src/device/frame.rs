//! One camera image with its stamp.

use gv3_codec::GreyPicture;

/// Position of a pattern in its sequence, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PatternIndex(pub u16);

/// One camera image with its stamp.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Triggers since the run began; a lost picture leaves a gap.
    pub sequence: u64,
    /// Pattern that the trigger counter says was shown.
    pub pattern: PatternIndex,
    /// Middle of the exposure on the sensor's clock, nanoseconds since the device was opened for the run.
    pub device_time_nanos: u64,
    /// Arrival on the host's clock, nanoseconds.
    pub host_time_nanos: u64,
    /// Length of the exposure, nanoseconds.
    pub exposure_nanos: u64,
    /// The image.
    pub picture: GreyPicture,
}
