//! A camera in virtual time held to the sensor's pace.

use super::{Camera, CameraInfo, CameraSettings, DeviceError, Frame};
use std::time::{Duration, Instant};

/// A camera that is later than this lets its clock stand still rather than hurry after it.
const MOST_LATE: Duration = Duration::from_millis(250);
/// A stamp farther ahead than this is not waited for.
const MOST_AHEAD: Duration = Duration::from_secs(20);

/// Gives every frame when it is due by its own stamp, as a live sensor does.
pub struct PacedCamera {
    inner: Box<dyn Camera>,
    /// A frame's stamp, and when it was due.
    anchor: Option<(u64, Instant)>,
    /// Taken, but not due yet.
    early: Option<Frame>,
}

impl PacedCamera {
    /// Paces a camera.
    pub fn new(inner: Box<dyn Camera>) -> Self {
        Self { inner, anchor: None, early: None }
    }

    fn due(&mut self, device_time_nanos: u64) -> Instant {
        let now = Instant::now();
        let due = self.anchor.and_then(|(stamp, at)| {
            let later = device_time_nanos.checked_sub(stamp).map(Duration::from_nanos)?;
            let due = at.checked_add(later)?;
            (now.saturating_duration_since(due) <= MOST_LATE && due.saturating_duration_since(now) <= MOST_AHEAD)
                .then_some(due)
        });
        // The first frame, a clock that was set anew, or a camera that cannot keep up.
        let due = due.unwrap_or(now);
        self.anchor = Some((device_time_nanos, due));
        due
    }
}

impl Camera for PacedCamera {
    /// A live sensor goes on without its reader.
    fn info(&self) -> CameraInfo {
        CameraInfo { waits_for_reader: false, ..self.inner.info() }
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        self.inner.configure(want)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        (self.anchor, self.early) = (None, None);
        self.inner.start()
    }

    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        let frame = match self.early.take() {
            Some(frame) => frame,
            None => self.inner.next_frame(deadline)?,
        };
        let due = self.due(frame.device_time_nanos);
        std::thread::sleep(due.min(deadline).saturating_duration_since(Instant::now()));
        if due <= deadline {
            return Ok(frame);
        }
        self.early = Some(frame);
        Err(DeviceError::Timeout("the next picture is due later".into()))
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.inner.stop()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::{PatternIndex, RigConfig};
    use gv3_codec::GreyPicture;

    /// Gives frames with these stamps at once.
    struct Fast(std::vec::IntoIter<u64>);

    impl Camera for Fast {
        fn info(&self) -> CameraInfo {
            let (model, serial) = (String::new(), String::new());
            CameraInfo { model, serial, width_px: 1, height_px: 1, min_period_nanos: 1, waits_for_reader: true }
        }
        fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
            Ok(*want)
        }
        fn start(&mut self) -> Result<(), DeviceError> {
            Ok(())
        }
        fn next_frame(&mut self, _: Instant) -> Result<Frame, DeviceError> {
            let device_time_nanos = self.0.next().ok_or(DeviceError::Ended("test".into()))?;
            let (pattern, picture) = (PatternIndex(0), GreyPicture::filled(1, 1, 0));
            Ok(Frame { sequence: 0, pattern, device_time_nanos, host_time_nanos: 0, exposure_nanos: 1, picture })
        }
        fn stop(&mut self) -> Result<(), DeviceError> {
            Ok(())
        }
    }

    #[test]
    fn frames_never_come_before_their_time_and_wild_stamps_cost_none() {
        const MS: u64 = 1_000_000;
        let stamps = vec![0, 10 * MS, 20 * MS, u64::MAX, 30 * MS, 40 * MS];
        let mut camera = PacedCamera::new(Box::new(Fast(stamps.clone().into_iter())));
        camera.configure(&RigConfig::simulated().camera_settings()).unwrap();
        camera.start().unwrap();
        let begin = Instant::now();
        let mut given = Vec::new();
        loop {
            match camera.next_frame(Instant::now() + Duration::from_millis(4)) {
                Ok(frame) => {
                    given.push(frame.device_time_nanos);
                    if given.len() == 3 {
                        assert!(begin.elapsed() >= Duration::from_millis(20));
                    }
                }
                Err(DeviceError::Timeout(_)) => {}
                Err(error) => break assert!(matches!(error, DeviceError::Ended(_))),
            }
        }
        assert_eq!(given, stamps);
        assert!(!camera.info().waits_for_reader);
    }
}
