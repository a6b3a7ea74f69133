//! Simulated scanner: one world behind camera and projector, in virtual time.
//!
//! The camera renders what the projector shows at the instant of the exposure, so a late trigger gives a wrong picture, as in
//! life. Nothing sleeps: the clock moves from exposure to exposure. Same configuration, same bytes.

mod camera;
mod face;
mod motion;
mod noise;
mod projector;
mod raster;
mod render;
mod skin;

use super::{DeviceError, Frame, PatternIndex, RigConfig, SequenceTiming};
use crate::light::PatternSequence;
use face::Face;
use glam::Vec3;
use gv3_codec::{GreyPicture, mesh::TriMesh};
use motion::Posture;
use render::{Renderer, ShownPattern};
use serde::{Deserialize, Serialize};
use skin::Skin;
use std::collections::VecDeque;

pub use camera::SimCamera;
pub use projector::SimProjector;

/// How a picture goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FaultKind {
    /// It never arrives.
    Lost,
    /// It arrives twice.
    Doubled,
    /// It is exposed six tenths of a period too late, when the next pattern is shown.
    Late,
}

/// One wrong picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// What happens.
    pub kind: FaultKind,
    /// Frame set, from 0.
    pub set: u64,
    /// Picture within the set, from 0.
    pub picture: u32,
}

/// The simulated world's settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimConfig {
    /// Seed of skin, sway and noise.
    pub seed: u64,
    /// Scale of all movement; 0 holds the head still.
    pub motion: f32,
    /// Read noise, grey levels (standard deviation).
    pub read_noise_levels: f32,
    /// Photoelectrons a grey level, for shot noise; 58 is a full well of 15,000 on 8 bits.
    pub electrons_per_level: f32,
    /// Ambient light over the projector's white.
    pub ambient: f32,
    /// Pictures that go wrong.
    pub faults: Vec<Fault>,
}

impl Default for SimConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            motion: 1.0,
            read_noise_levels: 0.7,
            electrons_per_level: 58.0,
            ambient: 0.03,
            faults: Vec::new(),
        }
    }
}

impl SimConfig {
    /// Checks ranges, and that faults name pictures of the sequence.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field.
    pub fn validate(&self, pattern_count: usize) -> Result<(), DeviceError> {
        let ranges = [
            ("sim.motion", self.motion, 0.0, 3.0),
            ("sim.read_noise_levels", self.read_noise_levels, 0.0, 50.0),
            ("sim.electrons_per_level", self.electrons_per_level, 1e-3, 1e9),
            ("sim.ambient", self.ambient, 0.0, 10.0),
        ];
        for (field, value, low, high) in ranges {
            if !(low..=high).contains(&value) {
                return Err(DeviceError::config(field, format!("{value} is outside {low} ..= {high}")));
            }
        }
        match self.faults.iter().position(|f| f.picture as usize >= pattern_count) {
            Some(i) => {
                let reason = format!("{}, but a set has {pattern_count}", self.faults[i].picture);
                Err(DeviceError::config(format!("sim.faults[{i}].picture"), reason))
            }
            None => Ok(()),
        }
    }
}

/// What the projector is doing.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shown {
    Dark,
    Still(PatternIndex),
    Playing { timing: SequenceTiming, start_nanos: u64 },
}

/// The world: a moving face, a rig and a clock.
pub struct SimWorld {
    config: SimConfig,
    face: Face,
    skin: Skin,
    renderer: Renderer,
    posed_mm: Vec<Vec3>,
    camera_size_px: [u32; 2],
    projector_size_px: [u32; 2],
    patterns: Vec<ShownPattern>,
    shown: Shown,
    clock_nanos: u64,
    triggers: u64,
    delivered_late: VecDeque<Frame>,
}

impl SimWorld {
    /// The world of a configuration, at time 0, its projector dark.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field that cannot work.
    pub fn new(config: &RigConfig) -> Result<Self, DeviceError> {
        config.validate()?;
        let calibration = config.calibration()?;
        let face = Face::new();
        Ok(Self {
            renderer: Renderer::new(&calibration, &face)?,
            skin: Skin::new(config.sim.seed),
            config: config.sim.clone(),
            face,
            posed_mm: Vec::new(),
            camera_size_px: [calibration.camera.width_px, calibration.camera.height_px],
            projector_size_px: [calibration.projector.width_px, calibration.projector.height_px],
            patterns: Vec::new(),
            shown: Shown::Dark,
            clock_nanos: 0,
            triggers: 0,
            delivered_late: VecDeque::new(),
        })
    }

    /// True surface at a time, scan frame, with `uv` at the places of [`Self::truth_albedo`]. For tests and reports.
    pub fn truth_mesh(&self, time_nanos: u64) -> TriMesh {
        let mut positions_mm = Vec::new();
        self.face.pose(&self.posture(time_nanos), &mut positions_mm);
        let uv = self.face.rest_mm.iter().map(|p| Skin::uv_of(p.x, p.y)).collect();
        TriMesh { positions_mm, triangles: self.face.triangles(), uv: Some(uv) }
    }

    /// True albedo, 255 for a white surface. For tests and reports.
    pub fn truth_albedo(&self) -> GreyPicture {
        self.skin.picture()
    }

    /// True depth of every camera pixel at a time, mm, 0 where there is no surface. For tests and reports.
    pub fn truth_depth_mm(&mut self, time_nanos: u64) -> Vec<f32> {
        self.face.pose(&self.posture(time_nanos), &mut self.posed_mm);
        self.renderer.depth_mm(&self.posed_mm)
    }

    fn posture(&self, time_nanos: u64) -> Posture {
        Posture::at(time_nanos, self.config.seed, self.config.motion)
    }

    /// The picture of an exposure in the light of one pattern, or in the dark.
    pub fn expose(
        &mut self,
        time_nanos: u64,
        pattern: Option<PatternIndex>,
        exposure_nanos: u64,
        picture_number: u64,
    ) -> GreyPicture {
        self.face.pose(&self.posture(time_nanos), &mut self.posed_mm);
        let shown = pattern.and_then(|p| self.patterns.get(usize::from(p.0)));
        self.renderer.render(&self.posed_mm, &self.skin, shown, exposure_nanos, &self.config, picture_number)
    }

    /// Stores a sequence in the projector, which goes dark.
    pub fn load(&mut self, sequence: &PatternSequence) {
        let shown = |(i, pattern)| ShownPattern::new(pattern, sequence.length_px(i));
        self.patterns = sequence.patterns.iter().enumerate().map(shown).collect();
        self.shown = Shown::Dark;
    }

    /// The pattern shown at a time: each from half a period before its trigger to half a period after.
    fn pattern_at(&self, time_nanos: u64) -> Option<PatternIndex> {
        match self.shown {
            Shown::Dark => None,
            Shown::Still(pattern) => Some(pattern),
            Shown::Playing { timing, start_nanos } => {
                let since = time_nanos.saturating_sub(start_nanos) + timing.picture_period_nanos / 2;
                Some(PatternIndex((since / timing.picture_period_nanos % self.patterns.len() as u64) as u16))
            }
        }
    }

    fn fault_of(&self, trigger: u64) -> Option<FaultKind> {
        let count = self.patterns.len() as u64;
        let hit = |f: &&Fault| f.set == trigger / count && u64::from(f.picture) == trigger % count;
        self.config.faults.iter().find(hit).map(|f| f.kind)
    }

    /// The frame of the projector's next trigger that the camera gets; `None` when the projector plays nothing.
    fn next_triggered_frame(&mut self, exposure_nanos: u64) -> Option<Frame> {
        if let Some(frame) = self.delivered_late.pop_front() {
            return Some(frame);
        }
        let Shown::Playing { timing, start_nanos } = self.shown else { return None };
        loop {
            let sequence = self.triggers;
            self.triggers += 1;
            let trigger_nanos = start_nanos + sequence * timing.picture_period_nanos;
            let fault = self.fault_of(sequence);
            if fault == Some(FaultKind::Lost) {
                continue;
            }
            let late = if fault == Some(FaultKind::Late) { timing.picture_period_nanos * 6 / 10 } else { 0 };
            let time_nanos = trigger_nanos + late;
            let pattern = PatternIndex((sequence % self.patterns.len() as u64) as u16);
            let frame = self.frame(sequence, pattern, time_nanos, exposure_nanos);
            if fault == Some(FaultKind::Doubled) {
                self.delivered_late.push_back(frame.clone());
            }
            return Some(frame);
        }
    }

    /// The frame of the camera's own clock.
    fn next_internal_frame(&mut self, period_nanos: u64, exposure_nanos: u64) -> Frame {
        let sequence = self.triggers;
        self.triggers += 1;
        let time_nanos = self.clock_nanos + period_nanos;
        let pattern = self.pattern_at(time_nanos).unwrap_or(PatternIndex(0));
        self.frame(sequence, pattern, time_nanos, exposure_nanos)
    }

    fn frame(&mut self, sequence: u64, pattern: PatternIndex, time_nanos: u64, exposure_nanos: u64) -> Frame {
        /// Readout and transfer.
        const TRANSFER_NANOS: u64 = 4_000_000;
        self.clock_nanos = time_nanos;
        let shown = self.pattern_at(time_nanos);
        Frame {
            sequence,
            pattern,
            device_time_nanos: time_nanos,
            host_time_nanos: time_nanos + exposure_nanos / 2 + TRANSFER_NANOS,
            exposure_nanos,
            picture: self.expose(time_nanos, shown, exposure_nanos, sequence),
        }
    }
}
