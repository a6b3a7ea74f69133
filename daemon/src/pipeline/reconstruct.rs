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
