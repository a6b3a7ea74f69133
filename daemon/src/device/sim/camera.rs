//! The simulated camera.

use super::SimWorld;
use crate::device::{Camera, CameraInfo, CameraSettings, DeviceError, Frame, TriggerSource};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// Camera of a simulated world; returns at once, in virtual time.
pub struct SimCamera {
    world: Arc<Mutex<SimWorld>>,
    settings: Option<CameraSettings>,
    is_running: bool,
}

impl SimCamera {
    /// The camera of a world.
    pub fn new(world: Arc<Mutex<SimWorld>>) -> Self {
        Self { world, settings: None, is_running: false }
    }
}

impl Camera for SimCamera {
    fn info(&self) -> CameraInfo {
        let [width_px, height_px] = self.world.lock().unwrap_or_else(PoisonError::into_inner).camera_size_px;
        CameraInfo {
            model: "simulated camera".into(),
            serial: "sim-camera-1".into(),
            width_px,
            height_px,
            min_period_nanos: 5_000_000,
            waits_for_reader: true,
        }
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        let info = self.info();
        if (want.width_px, want.height_px) != (info.width_px, info.height_px) {
            let reason = format!(
                "{} x {}, but the sensor has {} x {}",
                want.width_px, want.height_px, info.width_px, info.height_px
            );
            return Err(DeviceError::config("camera.width_px", reason));
        }
        let mut set = *want;
        set.exposure_nanos = want.exposure_nanos.clamp(10_000, 1_000_000_000);
        if let TriggerSource::Internal { period_nanos } = &mut set.trigger {
            *period_nanos = (*period_nanos).max(info.min_period_nanos);
        }
        self.settings = Some(set);
        Ok(set)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        if self.settings.is_none() {
            return Err(DeviceError::State("the camera is started before it is configured"));
        }
        self.is_running = true;
        self.world.lock().unwrap_or_else(PoisonError::into_inner).plug_in();
        Ok(())
    }

    fn next_frame(&mut self, _deadline: Instant) -> Result<Frame, DeviceError> {
        let (Some(settings), true) = (self.settings, self.is_running) else {
            return Err(DeviceError::State("a frame is asked of a camera that is not started"));
        };
        let mut world = self.world.lock().unwrap_or_else(PoisonError::into_inner);
        if world.is_unplugged {
            return Err(DeviceError::Disconnected("the simulated camera".into()));
        }
        match settings.trigger {
            TriggerSource::Projector => world.next_triggered_frame(settings.exposure_nanos),
            TriggerSource::Internal { period_nanos } => {
                Ok(world.next_internal_frame(period_nanos, settings.exposure_nanos))
            }
        }
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.is_running = false;
        Ok(())
    }
}
