//! Simulated scanner: one world behind camera and projector, in virtual time.
//!
//! The camera renders what the projector shows at the instant of the exposure, so a late trigger gives a wrong picture, as in
//! life. Nothing sleeps: the clock moves from exposure to exposure. Same configuration, same bytes.

mod board;
mod camera;
mod face;
mod follow;
mod gv3_descriptors;
mod gv3_device;
#[cfg(test)]
mod gv3_device_tests;
mod lens;
mod motion;
mod noise;
mod projector;
mod raster;
mod render;
mod scene;
mod sequence;
mod shown;
mod skin;

use super::{DeviceError, Frame, PatternIndex, RigConfig, SequenceTiming};
use crate::light::PatternSequence;
use glam::Vec3;
use gv3_codec::{GreyPicture, mesh::TriMesh};
use motion::Posture;
use render::Renderer;
use scene::Scene;
use sequence::{Place, Sequence};
use serde::{Deserialize, Serialize};
use shown::ShownPattern;
use skin::Skin;
use std::collections::VecDeque;

pub use board::BoardScene;
pub use camera::SimCamera;
pub use gv3_device::{Gv3Device, Light, Stall, StoredPattern};
pub use projector::SimProjector;
pub use scene::{Placement, SceneConfig};
pub use sequence::SequenceScene;

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
    /// It is exposed eight times as long as it says, and saturates.
    Saturated,
    /// Its transfer stalls: the camera times out once, and then delivers it.
    Stalled,
    /// The camera is unplugged, once, when it should deliver it, and is gone until it is started again: a second later.
    Unplugged,
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

/// What a region of the surface is like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Finish {
    /// Hardly reflects, as hair and pupils.
    Dark,
    /// Reflects like something wet on top of its skin.
    Shiny,
}

/// A round region of the surface with another finish; it moves with the material.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// Its finish.
    pub finish: Finish,
    /// Centre at rest, to the picture's right and up, mm: on the head from the nose's root, on solids from the camera's axis.
    pub centre_mm: [f32; 2],
    /// Radius, mm.
    pub radius_mm: f32,
}

impl Region {
    /// 1 inside, 0 outside, smooth over the last millimetre.
    fn weight(&self, x_mm: f32, y_mm: f32) -> f32 {
        let (dx, dy) = (x_mm - self.centre_mm[0], y_mm - self.centre_mm[1]);
        face::smoothstep(self.radius_mm, self.radius_mm - 1.0, (dx * dx + dy * dy).sqrt())
    }
}

/// Most sub-exposures of one picture.
const MAX_MOTION_SAMPLES: u32 = 64;

/// The simulated world's settings. The effects of optics and exposure are off unless they are asked for.
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
    /// Velocity of the scene in the scan frame on top of the head's own movement, mm/s; it is in its place at time 0.
    pub velocity_mm_s: [f32; 3],
    /// Instants over which an exposure is integrated; 1 freezes all movement.
    pub motion_samples: u32,
    /// Light of the projector over its input, both 0..=1, is input to this power; 1 is linear.
    pub projector_gamma: f32,
    /// Standard deviation of the projector's Gaussian blur, projector pixels; 0 is sharp.
    pub defocus_sigma_px: f32,
    /// What stands before the scanner.
    pub scene: SceneConfig,
    /// Where a solid stands; the head has its own place.
    pub placement: Placement,
    /// Dark and shiny parts of the surface.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub regions: Vec<Region>,
    /// How much faster than the world's the camera's clock runs, parts in a million.
    #[serde(skip_serializing_if = "is_zero")]
    pub clock_drift_ppm: f32,
    /// Pictures that go wrong.
    pub faults: Vec<Fault>,
}

fn is_zero(value: &f32) -> bool {
    *value == 0.0
}

impl Default for SimConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            motion: 1.0,
            read_noise_levels: 0.7,
            electrons_per_level: 58.0,
            ambient: 0.03,
            velocity_mm_s: [0.0; 3],
            motion_samples: 1,
            projector_gamma: 1.0,
            defocus_sigma_px: 0.0,
            scene: SceneConfig::Head,
            placement: Placement::default(),
            regions: Vec::new(),
            clock_drift_ppm: 0.0,
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
            ("sim.velocity_mm_s[0]", self.velocity_mm_s[0], -1e4, 1e4),
            ("sim.velocity_mm_s[1]", self.velocity_mm_s[1], -1e4, 1e4),
            ("sim.velocity_mm_s[2]", self.velocity_mm_s[2], -1e4, 1e4),
            ("sim.placement.offset_mm[0]", self.placement.offset_mm[0], -1e3, 1e3),
            ("sim.placement.offset_mm[1]", self.placement.offset_mm[1], -1e3, 1e3),
            ("sim.placement.offset_mm[2]", self.placement.offset_mm[2], -1e3, 550.0),
            ("sim.placement.turn_deg[0]", self.placement.turn_deg[0], -360.0, 360.0),
            ("sim.placement.turn_deg[1]", self.placement.turn_deg[1], -360.0, 360.0),
            ("sim.placement.turn_deg[2]", self.placement.turn_deg[2], -360.0, 360.0),
            ("sim.motion_samples", self.motion_samples as f32, 1.0, MAX_MOTION_SAMPLES as f32),
            ("sim.projector_gamma", self.projector_gamma, 0.1, 10.0),
            ("sim.defocus_sigma_px", self.defocus_sigma_px, 0.0, 100.0),
            ("sim.clock_drift_ppm", self.clock_drift_ppm, -1000.0, 1000.0),
        ];
        for (field, value, low, high) in ranges {
            if !(low..=high).contains(&value) {
                return Err(DeviceError::config(field, format!("{value} is outside {low} ..= {high}")));
            }
        }
        for (i, region) in self.regions.iter().enumerate() {
            if !region.centre_mm.iter().all(|c| c.is_finite()) {
                return Err(DeviceError::config(format!("sim.regions[{i}].centre_mm"), "not a number"));
            }
            if !(1.0..=1000.0).contains(&region.radius_mm) {
                let reason = format!("{} is outside 1 ..= 1000", region.radius_mm);
                return Err(DeviceError::config(format!("sim.regions[{i}].radius_mm"), reason));
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

/// Where everything is at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Instant {
    posture: Posture,
    shift_mm: Vec3,
    place: Place,
}

/// The world: a scene, a rig and a clock.
pub struct SimWorld {
    config: SimConfig,
    /// What stands there; of a sequence, what stood there when the renderer last looked.
    scene: Scene,
    sequence: Option<Sequence>,
    skin: Skin,
    renderer: Renderer,
    posed_mm: Vec<Vec3>,
    /// What the renderer last looked at.
    seen: Option<Instant>,
    camera_size_px: [u32; 2],
    projector_size_px: [u32; 2],
    patterns: Vec<ShownPattern>,
    shown: Shown,
    /// What the device last followed shows, with the number of its patterns.
    followed: (u64, Light),
    clock_nanos: u64,
    triggers: u64,
    /// Doubled and stalled frames still to be delivered.
    repeats: VecDeque<Frame>,
    is_unplugged: bool,
}

impl SimWorld {
    /// The world of a configuration, at time 0, its projector dark.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field that cannot work.
    pub fn new(config: &RigConfig) -> Result<Self, DeviceError> {
        config.validate()?;
        let calibration = config.calibration()?;
        let sequence = match &config.sim.scene {
            SceneConfig::Sequence(sequence) => Some(Sequence::read(sequence)?),
            _ => None,
        };
        let scene = match &sequence {
            Some(sequence) => Scene::of_sequence(sequence, Place::default()),
            None => Scene::new(&config.sim.scene, &config.sim.placement)?,
        };
        let skin = match sequence.as_ref().and_then(|s| s.skin(Place::default())) {
            Some(skin) => skin.clone(),
            None => scene.skin(&config.sim),
        };
        Ok(Self {
            renderer: Renderer::new(&calibration, &scene, &skin, &config.sim.regions)?,
            sequence,
            skin,
            config: config.sim.clone(),
            scene,
            posed_mm: Vec::new(),
            seen: None,
            camera_size_px: [calibration.camera.width_px, calibration.camera.height_px],
            projector_size_px: [calibration.projector.width_px, calibration.projector.height_px],
            patterns: Vec::new(),
            shown: Shown::Dark,
            followed: (0, Light::Dark),
            clock_nanos: 0,
            triggers: 0,
            repeats: VecDeque::new(),
            is_unplugged: false,
        })
    }

    /// True surface at a time, scan frame, with `uv` at the places of [`Self::truth_albedo`]; of a sequence with pictures, at
    /// those of the scan's own picture. For tests and reports.
    pub fn truth_mesh(&self, time_nanos: u64) -> TriMesh {
        let instant = self.instant(time_nanos as i64);
        let moving = self.sequence.as_ref().map(|s| Scene::of_sequence(s, instant.place));
        let scene = moving.as_ref().unwrap_or(&self.scene);
        let mut positions_mm = Vec::new();
        scene.pose(&instant.posture, instant.shift_mm, &mut positions_mm);
        let laid_on = || scene.rest_mm().iter().map(|p| Skin::uv_of(p.x, p.y)).collect();
        let uv = scene.uv().map_or_else(laid_on, <[_]>::to_vec);
        TriMesh { positions_mm, triangles: scene.triangles(), uv: Some(uv) }
    }

    /// True albedo, 255 for a white surface. For tests and reports.
    pub fn truth_albedo(&self) -> GreyPicture {
        self.skin.picture()
    }

    /// True depth of every camera pixel at a time, mm, 0 where there is no surface. For tests and reports.
    pub fn truth_depth_mm(&mut self, time_nanos: u64) -> Vec<f32> {
        self.look(time_nanos as i64);
        self.renderer.depth_mm()
    }

    /// Where everything is. Exposures at the start of a run reach back before time 0, so this time has a sign.
    fn instant(&self, time_nanos: i64) -> Instant {
        Instant {
            posture: Posture::at(time_nanos, self.config.seed, self.config.motion),
            shift_mm: Vec3::from(self.config.velocity_mm_s) * (time_nanos as f64 * 1e-9) as f32,
            place: self.sequence.as_ref().map_or_else(Place::default, |s| s.place(time_nanos)),
        }
    }

    /// Has the renderer look at the scene, unless nothing has moved since it last did.
    fn look(&mut self, time_nanos: i64) {
        let mut instant = self.instant(time_nanos);
        if !matches!(self.scene, Scene::Head(_)) {
            // Only the head takes postures.
            instant.posture = Posture::at(0, self.config.seed, 0.0);
        }
        if self.seen == Some(instant) {
            return;
        }
        if let Some(sequence) = self.sequence.as_ref().filter(|_| self.seen.map(|s| s.place) != Some(instant.place)) {
            self.scene = Scene::of_sequence(sequence, instant.place);
            if let Some(skin) = sequence.skin(instant.place) {
                self.skin.clone_from(skin);
            }
            self.renderer.set_scene(&self.scene, &self.skin, &self.config.regions);
        }
        self.scene.pose(&instant.posture, instant.shift_mm, &mut self.posed_mm);
        self.renderer.look(&self.posed_mm, &self.skin, self.config.ambient);
        self.seen = Some(instant);
    }

    /// The picture of an exposure with its middle at `time_nanos` in the light of one pattern, or in the dark.
    pub fn expose(
        &mut self,
        time_nanos: u64,
        pattern: Option<PatternIndex>,
        exposure_nanos: u64,
        picture_number: u64,
    ) -> GreyPicture {
        let samples = i64::from(self.config.motion_samples);
        self.renderer.clear();
        for k in 0..samples {
            // Middles of equal parts of the exposure.
            let offset_nanos = exposure_nanos as i64 * (2 * k + 1 - samples) / (2 * samples);
            self.look(time_nanos as i64 + offset_nanos);
            self.renderer.add_light(pattern.and_then(|p| self.patterns.get(usize::from(p.0))));
        }
        self.renderer.develop(exposure_nanos, &self.config, picture_number)
    }

    /// Stores a sequence in the projector, which goes dark.
    pub fn load(&mut self, sequence: &PatternSequence) {
        let (gamma, sigma_px) = (self.config.projector_gamma, self.config.defocus_sigma_px);
        let shown = |(i, pattern)| ShownPattern::new(pattern, sequence.length_px(i), gamma, sigma_px);
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
        self.fault_at(trigger, self.patterns.len() as u16)
    }

    /// The camera's cable is put back, after the second that this takes.
    fn plug_in(&mut self) {
        if std::mem::take(&mut self.is_unplugged) {
            self.clock_nanos += 1_000_000_000;
        }
    }

    /// What goes wrong with a picture of a run, in sets of `count` above 0.
    pub(crate) fn fault_at(&self, trigger: u64, count: u16) -> Option<FaultKind> {
        let count = u64::from(count);
        let hit = |f: &&Fault| f.set == trigger / count && u64::from(f.picture) == trigger % count;
        self.config.faults.iter().find(hit).map(|f| f.kind)
    }

    /// The frame of the projector's next trigger that the camera gets.
    ///
    /// # Errors
    /// [`DeviceError::Timeout`] when the projector plays nothing, [`DeviceError`] of a fault.
    fn next_triggered_frame(&mut self, exposure_nanos: u64) -> Result<Frame, DeviceError> {
        if let Some(frame) = self.repeats.pop_front() {
            return Ok(frame);
        }
        let Shown::Playing { timing, start_nanos } = self.shown else {
            // Without triggers virtual time stands still, so waiting for the deadline could change nothing.
            return Err(DeviceError::Timeout("the projector plays nothing, so no trigger comes".into()));
        };
        let mut sequence = self.triggers;
        while self.fault_of(sequence) == Some(FaultKind::Lost) {
            sequence += 1;
        }
        self.triggers = sequence + 1;
        let fault = self.fault_of(sequence);
        if fault == Some(FaultKind::Unplugged) {
            let count = self.patterns.len() as u64;
            // A cable that is back in its place stays there.
            let is_pulled = |f: &Fault| [f.set, f.picture.into()] == [sequence / count, sequence % count];
            self.config.faults.retain(|f| f.kind != FaultKind::Unplugged || !is_pulled(f));
            self.is_unplugged = true;
            return Err(DeviceError::Disconnected("the simulated camera".into()));
        }
        let trigger_nanos = start_nanos + sequence * timing.picture_period_nanos;
        let late = if fault == Some(FaultKind::Late) { timing.picture_period_nanos * 6 / 10 } else { 0 };
        let pattern = PatternIndex((sequence % self.patterns.len() as u64) as u16);
        let true_nanos = if fault == Some(FaultKind::Saturated) { exposure_nanos * 8 } else { exposure_nanos };
        let mut frame = self.frame(sequence, pattern, trigger_nanos + late, true_nanos);
        frame.exposure_nanos = exposure_nanos;
        match fault {
            Some(FaultKind::Doubled) => self.repeats.push_back(frame.clone()),
            Some(FaultKind::Stalled) => {
                self.repeats.push_back(frame);
                return Err(DeviceError::Timeout(format!("the transfer of picture {sequence} stalled")));
            }
            _ => {}
        }
        Ok(frame)
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
        let drift_nanos = (time_nanos as f64 * f64::from(self.config.clock_drift_ppm) * 1e-6).round() as i64;
        Frame {
            sequence,
            pattern,
            device_time_nanos: time_nanos.saturating_add_signed(drift_nanos),
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
    fn faults_saturate_stall_and_unplug() {
        let mut config = RigConfig::simulated();
        let fault = |kind, picture| Fault { kind, set: 0, picture };
        config.sim.faults =
            vec![fault(FaultKind::Saturated, 0), fault(FaultKind::Stalled, 1), fault(FaultKind::Unplugged, 3)];
        let mut rig = playing(&config);
        let mut next = || rig.camera.next_frame(Instant::now());
        let white = |f: &Frame| f.picture.pixels.iter().filter(|v| **v >= 252).count();
        let saturated = next().unwrap();
        assert!(white(&saturated) > 40_000 && saturated.exposure_nanos == config.timing.exposure_nanos);
        assert!(matches!(next(), Err(DeviceError::Timeout(reason)) if reason.contains("picture 1 stalled")));
        let late = next().unwrap();
        assert!(late.sequence == 1 && white(&late) < 20);
        assert_eq!(next().unwrap().sequence, 2);
        assert!(matches!(next(), Err(DeviceError::Disconnected(_))));
        assert!(matches!(next(), Err(DeviceError::Disconnected(_))));
        rig.camera.start().unwrap();
        assert_eq!(rig.camera.next_frame(Instant::now()).unwrap().sequence, 4);
    }

    #[test]
    fn a_clock_that_drifts_stamps_the_same_pictures_with_other_times() {
        let mut config = RigConfig::simulated();
        let right = frames(&config, 7);
        config.sim.clock_drift_ppm = -400.0;
        let drifted = frames(&config, 7);
        assert!(right.iter().zip(&drifted).all(|(a, b)| a.picture == b.picture));
        // 400 millionths of 33,333,336 ns.
        assert_eq!(right[6].device_time_nanos - drifted[6].device_time_nanos, 13_333);
    }

    /// CRC-32 of Ethernet and zip, bit by bit.
    fn crc32(bytes: &[u8]) -> u32 {
        let step = |crc: u32, _| if crc & 1 != 0 { (crc >> 1) ^ 0xEDB8_8320 } else { crc >> 1 };
        !bytes.iter().fold(!0, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
    }

    /// Every machine and every build renders these bytes; another sum means that old simulated recordings cannot be made again.
    #[test]
    fn pictures_of_a_seed_are_the_same_everywhere() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
        let mut found = Vec::new();
        for scene in [SceneConfig::Head, SceneConfig::Plane, SceneConfig::Spheres, SceneConfig::Step] {
            let mut config = RigConfig::simulated();
            config.sim.scene = scene;
            let plain = frames(&config, 4).iter().fold(Vec::new(), |all, f| [all, f.picture.pixels.clone()].concat());
            config.sim.seed = 7;
            config.sim.velocity_mm_s = [40.0, -20.0, 30.0];
            config.sim.motion_samples = 3;
            config.sim.projector_gamma = 2.2;
            config.sim.defocus_sigma_px = 1.5;
            config.sim.regions = [Finish::Dark, Finish::Shiny]
                .map(|finish| Region { finish, centre_mm: [8.0, 20.0], radius_mm: 12.0 })
                .to_vec();
            let mut world = SimWorld::new(&config).unwrap();
            world.load(&config.sequence);
            let effects = world.expose(1_234_567_890, Some(PatternIndex(4)), 5_000_000, 222);
            found.push((crc32(&plain), crc32(&effects.pixels)));
        }
        assert_eq!(found, GOLDEN);
    }

    /// Checksums of a head, a plane, spheres and a step: four plain pictures, and one with every effect.
    const GOLDEN: [(u32, u32); 4] = [
        (0xF37E_518A, 0x24F6_0D70),
        (0x0BDB_E69A, 0xF68D_3527),
        (0x1E6B_B746, 0x5D65_616A),
        (0x2016_3139, 0x950E_9460),
    ];

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

    fn noiseless() -> RigConfig {
        let mut config = RigConfig::simulated();
        config.sim.read_noise_levels = 0.0;
        config.sim.electrons_per_level = 1e9;
        config
    }

    fn exposed(config: &RigConfig, time_nanos: u64, exposure_nanos: u64) -> Vec<u8> {
        let mut world = SimWorld::new(config).unwrap();
        world.load(&config.sequence);
        world.expose(time_nanos, Some(PatternIndex(0)), exposure_nanos, 0).pixels
    }

    #[test]
    fn an_edge_moving_through_the_exposure_becomes_a_ramp() {
        let mut config = noiseless();
        config.sim.motion = 0.0;
        config.sim.ambient = 1.0;
        // 2000 mm/s over 5 ms are 10 mm: 18 pixels over which the outline of the cheek sweeps.
        config.sim.velocity_mm_s = [2000.0, 0.0, 0.0];
        let width_px = |config: &RigConfig| {
            let row = &exposed(config, 0, 5_000_000)[200 * 640..][..320];
            row.iter().position(|v| *v > 60).unwrap() as i64 - row.iter().position(|v| *v > 3).unwrap() as i64
        };
        let sharp = width_px(&config);
        config.sim.motion_samples = 16;
        let swept = width_px(&config);
        assert!(sharp <= 3 && swept >= 4, "sharp {sharp} px, swept {swept} px");
    }

    #[test]
    fn an_integrated_exposure_is_the_mean_of_its_instants() {
        let mut config = noiseless();
        config.sim.velocity_mm_s = [300.0, 0.0, 0.0];
        let instants: Vec<Vec<u8>> = (0..4).map(|k| exposed(&config, 91_250_000 + k * 2_500_000, 10_000_000)).collect();
        config.sim.motion_samples = 4;
        let integrated = exposed(&config, 95_000_000, 10_000_000);
        let saturated = |i: usize| instants.iter().any(|p| p[i] == 255);
        for (i, &found) in integrated.iter().enumerate().filter(|(i, _)| !saturated(*i)) {
            let mean = instants.iter().map(|p| f32::from(p[i])).sum::<f32>() / 4.0;
            assert!((f32::from(found) - mean).abs() <= 1.01, "pixel {i}: {found}, mean {mean}");
        }
        assert!(integrated != instants[1]);
    }

    #[test]
    fn dark_regions_lose_their_light_and_shiny_ones_saturate() {
        let mut config = noiseless();
        config.sim.motion = 0.0;
        let count = |config: &RigConfig, hit: fn(u8) -> bool| {
            exposed(config, 0, 5_000_000).iter().filter(|v| hit(**v)).count() as i64
        };
        let (dim, white) = (|v| v <= 12, |v| v >= 252);
        let (few_dim, few_white) = (count(&config, dim), count(&config, white));
        // A disc of 10 mm on the forehead, 315 mm^2, is about 1000 pixels; half of it or more is in the bright halves of fringes.
        config.sim.regions = vec![Region { finish: Finish::Dark, centre_mm: [0.0, 60.0], radius_mm: 10.0 }];
        let dark = count(&config, dim) - few_dim;
        assert!((300..1400).contains(&dark), "{dark} dark pixels");
        config.sim.regions[0].finish = Finish::Shiny;
        let shiny = count(&config, white) - few_white;
        assert!((200..1400).contains(&shiny), "{shiny} saturated pixels");
    }

    #[test]
    fn effects_out_of_range_are_refused_by_name() {
        let error = |change: fn(&mut SimConfig)| {
            let mut config = SimConfig::default();
            change(&mut config);
            config.validate(6).unwrap_err().to_string()
        };
        assert!(error(|c| c.projector_gamma = 0.0).starts_with("sim.projector_gamma"));
        assert!(error(|c| c.defocus_sigma_px = f32::NAN).starts_with("sim.defocus_sigma_px"));
        assert!(error(|c| c.motion_samples = 0).starts_with("sim.motion_samples"));
        assert!(error(|c| c.velocity_mm_s[2] = f32::INFINITY).starts_with("sim.velocity_mm_s[2]"));
        let region = |centre_mm, radius_mm| Region { finish: Finish::Dark, centre_mm, radius_mm };
        let refused =
            |r: Region| SimConfig { regions: vec![r], ..SimConfig::default() }.validate(6).unwrap_err().to_string();
        assert!(refused(region([0.0, f32::NAN], 5.0)).starts_with("sim.regions[0].centre_mm"));
        assert!(refused(region([0.0, 0.0], 0.0)).starts_with("sim.regions[0].radius_mm"));
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
