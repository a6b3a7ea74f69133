//! Frame set to scan: the stages of [`crate::light`] in order, on buffers kept between scans.

use super::FrameSet;
use crate::light::{
    Calibration, GridMesher, LightError, Limits, PatternSequence, PhaseExtractor, PixelMask, PointGrid, RejectedPixels,
    Triangulator, Unwrapper, WrappedPhase, grid_mesh,
};
use gv3_codec::{GreyPicture, Scan};
use std::ops::Range;

/// A scan and what is missing from it.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// The surface with its texture, scan frame.
    pub scan: Scan,
    /// Pixels without a vertex, by cause; with the scan's vertices they make the whole picture.
    pub rejected: RejectedPixels,
}

/// Turns frame sets of a two-frequency sequence into scans.
#[derive(Debug, Clone)]
pub struct Reconstructor {
    size_px: [u32; 2],
    pattern_count: usize,
    low: Range<usize>,
    high: Range<usize>,
    low_extractor: PhaseExtractor,
    high_extractor: PhaseExtractor,
    unwrapper: Unwrapper,
    triangulator: Triangulator,
    mesher: GridMesher,
    mask: PixelMask,
    low_phase: WrappedPhase,
    high_phase: WrappedPhase,
    column_px: Vec<f32>,
    grid: PointGrid,
}

impl Reconstructor {
    /// Tables and buffers for a rig.
    ///
    /// # Errors
    /// [`LightError::Field`] naming what cannot work, or what does not fit together.
    pub fn new(calibration: &Calibration, sequence: &PatternSequence, limits: &Limits) -> Result<Self, LightError> {
        limits.validate()?;
        let (low, high) = sequence.low_and_high()?;
        let size_px = [calibration.camera.width_px, calibration.camera.height_px];
        let [width, height] = size_px.map(|n| n as usize);
        Ok(Self {
            size_px,
            pattern_count: sequence.patterns.len(),
            low_extractor: PhaseExtractor::new(&sequence.patterns[low.clone()], limits.mask)?,
            high_extractor: PhaseExtractor::new(&sequence.patterns[high.clone()], limits.mask)?,
            unwrapper: Unwrapper::new(calibration, sequence, limits.depth)?,
            triangulator: Triangulator::new(calibration, limits.depth)?,
            mesher: GridMesher::new(limits.mesh)?,
            mask: PixelMask::new(width, height),
            low_phase: WrappedPhase::new(width * height),
            high_phase: WrappedPhase::new(width * height),
            column_px: vec![0.0; width * height],
            grid: PointGrid::new(width, height),
            low,
            high,
        })
    }

    /// The scan of a frame set.
    ///
    /// # Errors
    /// [`LightError::Field`] when a frame is missing or of another size than the calibration's camera.
    pub fn reconstruct(&mut self, set: &FrameSet) -> Result<Reconstruction, LightError> {
        let pictures: Vec<&GreyPicture> = set.frames.iter().map(|f| &f.picture).collect();
        self.check_pictures(&pictures)?;
        self.mask.clear();
        self.low_extractor.extract(&pictures[self.low.clone()], &mut self.mask, &mut self.low_phase);
        self.high_extractor.extract(&pictures[self.high.clone()], &mut self.mask, &mut self.high_phase);
        self.mask.erode();
        let (low, high) = (&self.low_phase.phase_rad, &self.high_phase.phase_rad);
        self.unwrapper.unwrap(low, high, &mut self.mask, &mut self.column_px);
        self.triangulator.triangulate(&self.column_px, &mut self.mask, &mut self.grid);
        let mesh = self.mesher.mesh(&self.grid, &mut self.mask);
        let texture = grid_mesh::texture(self.size_px[0], self.size_px[1], &self.high_phase.background);
        let scan = Scan { tick: set.tick, time_nanos: set.time_nanos, mesh, texture: Some(texture) };
        Ok(Reconstruction { scan, rejected: self.mask.count() })
    }

    fn check_pictures(&self, pictures: &[&GreyPicture]) -> Result<(), LightError> {
        if pictures.len() != self.pattern_count {
            let reason = format!("{}, but the sequence has {} patterns", pictures.len(), self.pattern_count);
            return Err(LightError::field("frames", reason));
        }
        let [width, height] = self.size_px;
        match pictures.iter().position(|p| (p.width_px, p.height_px) != (width, height)) {
            Some(i) => {
                let reason = format!(
                    "{} x {} pixels, but the calibration's camera has {width} x {height}",
                    pictures[i].width_px, pictures[i].height_px
                );
                Err(LightError::field(format!("frames[{i}]"), reason))
            }
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::sim::{Fault, FaultKind, SimWorld};
    use crate::device::{self, RigConfig};
    use crate::pipeline::{DropCounts, FrameSetAssembler};
    use std::time::Instant;

    fn run(config: &RigConfig, pictures: usize) -> (Vec<FrameSet>, Reconstructor, DropCounts) {
        let mut rig = device::open(config).unwrap();
        rig.camera.configure(&config.camera_settings()).unwrap();
        rig.projector.load(&rig.sequence).unwrap();
        rig.camera.start().unwrap();
        rig.projector.play(&rig.timing).unwrap();
        let mut assembler = FrameSetAssembler::new(&rig.sequence, &rig.timing);
        let mut next = || rig.camera.next_frame(Instant::now()).unwrap();
        let sets = (0..pictures).filter_map(|_| assembler.push(next())).collect();
        let reconstructor = Reconstructor::new(&rig.calibration, &rig.sequence, &rig.limits).unwrap();
        (sets, reconstructor, assembler.finish())
    }

    /// Distances of the scan's vertices from the true surface along its normals, mm: root mean square, and how many exceed 2 mm.
    fn distance_to_truth(scan: &Scan, world: &mut SimWorld) -> (f64, usize) {
        let depth_mm = world.truth_depth_mm(scan.time_nanos);
        let (texture, uv) = (scan.texture.as_ref().unwrap(), scan.mesh.uv.as_ref().unwrap());
        let normals = scan.mesh.vertex_normals();
        let (mut sum, mut count, mut far) = (0.0, 0, 0);
        for (i, p) in scan.mesh.positions_mm.iter().enumerate() {
            let [x, y] = texture.uv_to_px(uv[i]).map(|v| v.round() as usize);
            let truth_mm = depth_mm[y * 640 + x];
            if truth_mm > 0.0 {
                let distance = f64::from((*p - *p * (truth_mm / -p.z)).dot(normals[i]));
                sum += distance * distance;
                count += 1;
                far += usize::from(distance.abs() > 2.0);
            }
        }
        assert!(count * 1000 > scan.mesh.vertex_count() * 999, "vertices where nothing is");
        ((sum / f64::from(count as u32)).sqrt(), far)
    }

    #[test]
    fn scans_of_the_moving_head_match_the_truth() {
        let config = RigConfig::simulated();
        let (sets, mut reconstructor, drops) = run(&config, 18);
        assert_eq!((sets.len(), drops.sets()), (3, 0));
        let mut world = SimWorld::new(&config).unwrap();
        for set in &sets {
            let Reconstruction { scan, rejected } = reconstructor.reconstruct(set).unwrap();
            scan.mesh.validate().unwrap();
            let vertices = scan.mesh.vertex_count();
            assert!((100_000..130_000).contains(&vertices), "{vertices} vertices");
            assert_eq!(vertices as u64 + rejected.total(), 640 * 480);
            let (rms_mm, far) = distance_to_truth(&scan, &mut world);
            assert!(rms_mm < 0.15, "{rms_mm} mm");
            // A wrong fringe order is off by 19 mm.
            assert_eq!((far, rejected.fringe_order), (0, 0));
        }
    }

    #[test]
    fn without_noise_and_motion_only_rounding_is_left() {
        let mut config = RigConfig::simulated();
        config.sim.motion = 0.0;
        config.sim.read_noise_levels = 0.0;
        config.sim.electrons_per_level = 1e9;
        let (sets, mut reconstructor, _) = run(&config, 6);
        let scan = reconstructor.reconstruct(&sets[0]).unwrap().scan;
        let (rms_mm, _) = distance_to_truth(&scan, &mut SimWorld::new(&config).unwrap());
        assert!(rms_mm < 0.025, "{rms_mm} mm");
    }

    #[test]
    fn faults_drop_their_sets_and_the_next_is_right_again() {
        let mut config = RigConfig::simulated();
        config.sim.faults = [(FaultKind::Lost, 0), (FaultKind::Doubled, 1), (FaultKind::Late, 3)]
            .map(|(kind, set)| Fault { kind, set, picture: 4 })
            .to_vec();
        let (sets, mut reconstructor, drops) = run(&config, 30);
        assert_eq!(sets.iter().map(|s| s.tick).collect::<Vec<_>>(), [2, 4]);
        assert_eq!(drops, DropCounts { lost: 1, doubled: 1, late: 1, ..DropCounts::default() });
        let scan = reconstructor.reconstruct(&sets[1]).unwrap().scan;
        assert_eq!((scan.tick, scan.time_nanos), (4, 28 * 5_555_556));
        assert!(distance_to_truth(&scan, &mut SimWorld::new(&config).unwrap()).0 < 0.15);
    }

    #[test]
    fn pictures_of_another_size_are_refused_by_name() {
        let (mut sets, mut reconstructor, _) = run(&RigConfig::simulated(), 6);
        sets[0].frames[2].picture = GreyPicture::filled(320, 240, 0);
        assert!(reconstructor.reconstruct(&sets[0]).unwrap_err().to_string().starts_with("frames[2]"));
    }
}
