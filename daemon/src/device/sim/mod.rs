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
    /// Doubled frames still to be delivered.
    repeats: VecDeque<Frame>,
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
            repeats: VecDeque::new(),
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
        if let Some(frame) = self.repeats.pop_front() {
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
                self.repeats.push_back(frame.clone());
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::{self, CameraSettings, Rig, TriggerSource};
    use std::time::Instant;

    fn playing(config: &RigConfig) -> Rig {
        let mut rig = device::open(config).unwrap();
        rig.camera.configure(&config.camera_settings()).unwrap();
        rig.projector.load(&rig.sequence).unwrap();
        rig.camera.start().unwrap();
        rig.projector.play(&rig.timing).unwrap();
        rig
    }

    fn frames(config: &RigConfig, count: usize) -> Vec<Frame> {
        let mut rig = playing(config);
        (0..count).map(|_| rig.camera.next_frame(Instant::now()).unwrap()).collect()
    }

    #[test]
    fn same_seed_same_bytes_and_another_seed_another_world() {
        let config = RigConfig::simulated();
        let first = frames(&config, 4);
        assert!(first == frames(&config, 4));
        let mut other = config;
        other.sim.seed = 2;
        assert!(first != frames(&other, 4));
    }

    #[test]
    fn pictures_are_well_exposed_and_follow_the_patterns() {
        let frames = frames(&RigConfig::simulated(), 6);
        let saturated: usize = frames.iter().flat_map(|f| &f.picture.pixels).filter(|&&v| v >= 252).count();
        assert!(saturated < 20, "{saturated} saturated pixels");
        let forehead = |f: &Frame| (100..130).map(|y| f32::from(f.picture.pixels[y * 640 + 330])).sum::<f32>() / 30.0;
        let levels: Vec<f32> = frames[3..].iter().map(forehead).collect();
        let spread = levels.iter().copied().fold(0.0, f32::max) - levels.iter().copied().fold(255.0, f32::min);
        assert!(spread > 60.0, "{levels:?}");
        assert_eq!(frames[4].device_time_nanos, 4 * 5_555_556);
    }

    #[test]
    fn faults_lose_double_and_delay_pictures() {
        let mut config = RigConfig::simulated();
        let fault = |kind, set, picture| Fault { kind, set, picture };
        config.sim.faults =
            vec![fault(FaultKind::Lost, 0, 1), fault(FaultKind::Doubled, 0, 3), fault(FaultKind::Late, 0, 5)];
        let wrong = frames(&config, 6);
        let sequences: Vec<u64> = wrong.iter().map(|f| f.sequence).collect();
        assert_eq!(sequences, [0, 2, 3, 3, 4, 5]);
        assert_eq!(wrong[5].device_time_nanos, 5 * 5_555_556 + 3_333_333);
        config.sim.faults.clear();
        let right = frames(&config, 7);
        // The late picture shows the next pattern, whatever its label says.
        let distance = |a: &Frame, b: &Frame| -> i64 {
            a.picture.pixels.iter().zip(&b.picture.pixels).map(|(a, b)| i64::from(a.abs_diff(*b))).sum()
        };
        assert!(distance(&wrong[5], &right[6]) * 4 < distance(&wrong[5], &right[5]));
    }

    #[test]
    fn calls_out_of_order_are_errors() {
        let config = RigConfig::simulated();
        let mut rig = device::open(&config).unwrap();
        assert!(matches!(rig.camera.next_frame(Instant::now()), Err(DeviceError::State(_))));
        assert!(matches!(rig.camera.start(), Err(DeviceError::State(_))));
        assert!(matches!(rig.projector.play(&rig.timing), Err(DeviceError::State(_))));
        rig.camera.configure(&config.camera_settings()).unwrap();
        rig.camera.start().unwrap();
        assert!(matches!(rig.camera.next_frame(Instant::now()), Err(DeviceError::Timeout(_))));
        let too_small = CameraSettings { width_px: 320, ..config.camera_settings() };
        assert!(rig.camera.configure(&too_small).unwrap_err().to_string().starts_with("camera.width_px"));
    }

    #[test]
    fn a_still_pattern_is_seen_on_the_cameras_own_clock() {
        let config = RigConfig::simulated();
        let mut rig = device::open(&config).unwrap();
        rig.projector.load(&rig.sequence).unwrap();
        let own_clock = TriggerSource::Internal { period_nanos: 20_000_000 };
        rig.camera.configure(&CameraSettings { trigger: own_clock, ..config.camera_settings() }).unwrap();
        rig.camera.start().unwrap();
        let dark = rig.camera.next_frame(Instant::now()).unwrap();
        rig.projector.show(PatternIndex(2)).unwrap();
        let lit = rig.camera.next_frame(Instant::now()).unwrap();
        let brightest = |f: &Frame| f.picture.pixels.iter().copied().max();
        assert!(brightest(&dark) < Some(30) && brightest(&lit) > Some(120));
        assert_eq!((lit.pattern, lit.device_time_nanos), (PatternIndex(2), 40_000_000));
    }

    #[test]
    fn truth_is_a_valid_surface_that_the_camera_sees() {
        let mut world = SimWorld::new(&RigConfig::simulated()).unwrap();
        let truth = world.truth_mesh(1_000_000_000);
        truth.validate().unwrap();
        assert!(truth.vertex_normals().iter().filter(|n| n.z > 0.0).count() > truth.vertex_count() * 9 / 10);
        let seen = world.truth_depth_mm(1_000_000_000).iter().filter(|z| **z > 0.0).count();
        assert!((100_000..135_000).contains(&seen), "{seen} pixels");
        let albedo = world.truth_albedo();
        assert_eq!(albedo.pixels.len(), albedo.width_px as usize * albedo.height_px as usize);
    }
}
