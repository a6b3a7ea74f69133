//! The world in the light of a projector that speaks the vendor protocol.

use super::{Gv3Device, Light, Shown, ShownPattern, SimWorld};
use crate::device::{PatternIndex, SequenceTiming};
use crate::light::Direction;
use gv3_protocol::gv3::Axis;

impl SimWorld {
    /// The world's time, nanoseconds: that of the last exposure.
    pub fn clock_nanos(&self) -> u64 {
        self.clock_nanos
    }

    /// Has the world lit as `device` shows it, by the patterns that it was sent. To be called after every request; the
    /// device's clock must be the world's.
    pub fn follow(&mut self, device: &Gv3Device) {
        let (number, light) = (device.patterns_number(), device.light());
        if number != self.followed.0 {
            let (gamma, sigma_px) = (self.config.projector_gamma, self.config.defocus_sigma_px);
            self.patterns = device
                .patterns_in_order()
                .map(|p| ShownPattern::of_levels(&p.levels, direction(p.axis), gamma, sigma_px))
                .collect();
        }
        if light != self.followed.1 {
            self.shown = match light {
                Light::Dark => Shown::Dark,
                Light::Still(position) => Shown::Still(PatternIndex(position)),
                Light::Playing { timing, start_nanos } => {
                    self.triggers = 0;
                    self.repeats.clear();
                    let (picture_period_nanos, exposure_nanos) = (timing.period_nanos, timing.exposure_nanos);
                    Shown::Playing { timing: SequenceTiming { picture_period_nanos, exposure_nanos }, start_nanos }
                }
            };
        }
        self.followed = (number, light);
    }
}

fn direction(axis: Axis) -> Direction {
    match axis {
        Axis::Columns => Direction::Columns,
        Axis::Rows => Direction::Rows,
    }
}
