//! Frame set to scan: the stages of [`crate::light`] in order, on buffers kept between scans.

use super::FrameSet;
use crate::device::Rig;
use crate::light::absolute::MeasuredPhases;
use crate::light::gamma::BurstErrors;
use crate::light::{
    AbsoluteDecoder, Calibration, DepthRange, Direction, GridMesher, Intersector, LightError, Limits, MotionCorrection,
    MotionCorrector, PatternKind, PatternSequence, PhaseExtractor, PixelMask, PointGrid, Processing,
    ProjectorCoordinates, RejectedPixels, Triangulator, Unwrap, Unwrapper, WrappedPhase, geometric, grid_mesh,
};
use gv3_codec::{GreyPicture, Scan};
use std::ops::Range;

/// Least share of the other direction's change over the working range that a direction coded alone must have: less is across
/// the baseline and measures no depth.
const MIN_SPAN: f64 = 0.2;

/// A scan and what is missing from it.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// The surface with its texture, scan frame.
    pub scan: Scan,
    /// Pixels without a vertex, by cause; with the scan's vertices they make the whole picture.
    pub rejected: RejectedPixels,
}

/// What was decoded of a frame set on the way to its scan, row by row, a value a pixel of the camera.
#[derive(Debug, Clone)]
pub struct PhaseMaps {
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Modulation B of the finest fringes, grey levels.
    pub modulation: Vec<f32>,
    /// Wrapped phase of the finest fringes, in (-pi, pi].
    pub wrapped_phase_rad: Vec<f32>,
    /// Whether the pixel became a vertex.
    pub is_kept: Vec<bool>,
}

/// Turns frame sets into scans, whatever absolute scheme their sequence is of.
#[derive(Debug, Clone)]
pub struct Reconstructor {
    size_px: [u32; 2],
    pattern_count: usize,
    white: Option<usize>,
    decoding: Decoding,
    motion: Option<MotionCorrector>,
    points: Points,
    mesher: GridMesher,
    mask: PixelMask,
    column_px: Vec<f32>,
    grid: PointGrid,
}

/// How pictures become projector coordinates.
#[derive(Debug, Clone)]
enum Decoding {
    /// Two bursts of sinusoids along columns: the kernel of the live default.
    TwoFrequency(Box<TwoFrequency>),
    /// One direction of any scheme.
    Columns(Decoder),
    Rows(Decoder),
    /// Columns, and rows with their coordinates.
    Both(Decoder, Decoder, Vec<f32>),
}

/// A decoder with its buffers.
#[derive(Debug, Clone)]
struct Decoder {
    decoder: AbsoluteDecoder,
    measured: MeasuredPhases,
}

#[derive(Debug, Clone)]
struct TwoFrequency {
    low: Range<usize>,
    high: Range<usize>,
    low_extractor: PhaseExtractor,
    high_extractor: PhaseExtractor,
    errors: Option<[BurstErrors; 2]>,
    unwrapper: Unwrapper,
    low_phase: WrappedPhase,
    high_phase: WrappedPhase,
}

/// How coordinates become points.
#[derive(Debug, Clone)]
enum Points {
    Columns(Triangulator),
    Any(Box<Intersector>),
}

impl TwoFrequency {
    /// `None` when the sequence is of another kind.
    fn new(
        calibration: &Calibration,
        sequence: &PatternSequence,
        limits: &Limits,
        processing: &Processing,
    ) -> Result<Option<Self>, LightError> {
        let Ok((low, high)) = sequence.low_and_high() else { return Ok(None) };
        let Ok(unwrapper) = Unwrapper::new(calibration, sequence, limits.depth) else { return Ok(None) };
        let pixels = calibration.camera.width_px as usize * calibration.camera.height_px as usize;
        let [low_patterns, high_patterns] = [&low, &high].map(|burst| &sequence.patterns[burst.clone()]);
        let errors = match &processing.gamma {
            Some(t) => Some([t.of_burst(low_patterns)?.clone(), t.of_burst(high_patterns)?.clone()]),
            None => None,
        };
        Ok(Some(Self {
            low_extractor: PhaseExtractor::new(low_patterns, limits.mask)?,
            high_extractor: PhaseExtractor::new(high_patterns, limits.mask)?,
            errors,
            unwrapper,
            low_phase: WrappedPhase::new(pixels),
            high_phase: WrappedPhase::new(pixels),
            low,
            high,
        }))
    }

    fn decode(&mut self, pictures: &[&GreyPicture], mask: &mut PixelMask, column_px: &mut [f32]) {
        self.low_extractor.extract(&pictures[self.low.clone()], mask, &mut self.low_phase);
        self.high_extractor.extract(&pictures[self.high.clone()], mask, &mut self.high_phase);
        if let Some([low, high]) = &self.errors {
            low.correct(&mut self.low_phase.phase_rad);
            high.correct(&mut self.high_phase.phase_rad);
        }
        mask.erode();
        self.unwrapper.unwrap(&self.low_phase.phase_rad, &self.high_phase.phase_rad, mask, column_px);
    }
}

impl Decoder {
    fn measure(&mut self, pictures: &[&GreyPicture], mask: &mut PixelMask) {
        self.decoder.measure_into(pictures, mask, &mut self.measured);
    }

    fn resolve(&self, pictures: &[&GreyPicture], mask: &mut PixelMask, out_px: &mut [f32]) {
        self.decoder.resolve_into(pictures, &self.measured, mask, out_px);
    }
}

impl Decoding {
    fn new(
        calibration: &Calibration,
        sequence: &PatternSequence,
        limits: &Limits,
        processing: &Processing,
    ) -> Result<Self, LightError> {
        if processing.unwrap == Unwrap::Auto
            && let Some(fast) = TwoFrequency::new(calibration, sequence, limits, processing)?
        {
            return Ok(Self::TwoFrequency(Box::new(fast)));
        }
        let pixels = calibration.camera.width_px as usize * calibration.camera.height_px as usize;
        let decoder = |direction| -> Result<Option<Decoder>, LightError> {
            let made = AbsoluteDecoder::with(calibration, sequence, direction, limits, processing)?;
            Ok(made.map(|decoder| Decoder { measured: decoder.room(pixels), decoder }))
        };
        match (decoder(Direction::Columns)?, decoder(Direction::Rows)?) {
            (Some(columns), Some(rows)) => Ok(Self::Both(columns, rows, vec![0.0; pixels])),
            (Some(columns), None) => {
                measures_depth(calibration, Direction::Columns, limits).map(|()| Self::Columns(columns))
            }
            (None, Some(rows)) => measures_depth(calibration, Direction::Rows, limits).map(|()| Self::Rows(rows)),
            (None, None) => Err(LightError::field("sequence.patterns", "no pattern codes columns or rows")),
        }
    }

    /// Coordinates of the first direction into `out_px`; of the second, where there are two, into the decoder's own buffer.
    fn decode(&mut self, pictures: &[&GreyPicture], mask: &mut PixelMask, out_px: &mut [f32]) {
        match self {
            Self::TwoFrequency(two) => two.decode(pictures, mask, out_px),
            Self::Columns(one) | Self::Rows(one) => {
                one.measure(pictures, mask);
                mask.erode();
                one.resolve(pictures, mask, out_px);
            }
            Self::Both(columns, rows, row_px) => {
                columns.measure(pictures, mask);
                rows.measure(pictures, mask);
                mask.erode();
                columns.resolve(pictures, mask, out_px);
                rows.resolve(pictures, mask, row_px);
            }
        }
    }

    fn coordinates<'a>(&'a self, first_px: &'a [f32]) -> ProjectorCoordinates<'a> {
        match self {
            Self::TwoFrequency(_) | Self::Columns(_) => ProjectorCoordinates::Columns(first_px),
            Self::Rows(_) => ProjectorCoordinates::Rows(first_px),
            Self::Both(_, _, row_px) => ProjectorCoordinates::Both(first_px, row_px),
        }
    }

    /// The finest fringes; `None` without fringes.
    fn finest(&self) -> Option<&WrappedPhase> {
        match self {
            Self::TwoFrequency(two) => Some(&two.high_phase),
            Self::Columns(one) | Self::Rows(one) => one.measured.bursts().last(),
            Self::Both(columns, rows, _) => columns.measured.bursts().last().or(rows.measured.bursts().last()),
        }
    }

    /// Background of the finest fringes, grey levels; `None` without fringes.
    fn background(&self) -> Option<&[f32]> {
        self.finest().map(|finest| finest.background.as_slice())
    }

    fn valid_depth(&self) -> Option<DepthRange> {
        match self {
            Self::TwoFrequency(_) => None,
            Self::Columns(one) | Self::Rows(one) | Self::Both(one, ..) => one.decoder.valid_depth(),
        }
    }
}

impl Reconstructor {
    /// Tables and buffers for a rig.
    ///
    /// # Errors
    /// [`LightError::Field`] naming what cannot work, or what does not fit together.
    pub fn new(calibration: &Calibration, sequence: &PatternSequence, limits: &Limits) -> Result<Self, LightError> {
        Self::with(calibration, sequence, limits, &Processing::default())
    }

    /// As [`Self::new`], with the rig's choices.
    ///
    /// # Errors
    /// As [`Self::new`], and naming the choice that the sequence does not allow.
    pub fn with(
        calibration: &Calibration,
        sequence: &PatternSequence,
        limits: &Limits,
        processing: &Processing,
    ) -> Result<Self, LightError> {
        super::check_rig(calibration, sequence, limits)?;
        let size_px = [calibration.camera.width_px, calibration.camera.height_px];
        let [width, height] = size_px.map(|n| n as usize);
        let decoding = Decoding::new(calibration, sequence, limits, processing)?;
        let is_columns = matches!(decoding, Decoding::TwoFrequency(_) | Decoding::Columns(_));
        Ok(Self {
            size_px,
            pattern_count: sequence.patterns.len(),
            white: sequence.patterns.iter().position(|p| p.kind == PatternKind::White),
            motion: match processing.motion {
                MotionCorrection::PhaseRate => Some(motion_corrector([width, height], sequence, &decoding)?),
                MotionCorrection::None => None,
            },
            decoding,
            points: match is_columns {
                true => Points::Columns(Triangulator::new(calibration, limits.depth)?),
                false => Points::Any(Box::new(Intersector::new(calibration, limits.depth)?)),
            },
            mesher: GridMesher::new(limits.mesh)?,
            mask: PixelMask::new(width, height),
            column_px: vec![0.0; width * height],
            grid: PointGrid::new(width, height),
        })
    }

    /// For opened devices.
    ///
    /// # Errors
    /// As [`Self::with`].
    pub fn of(rig: &Rig) -> Result<Self, LightError> {
        Self::with(&rig.calibration, &rig.sequence, &rig.limits, &rig.processing)
    }

    /// Depths between which every pixel gets its fringe order, when it is the working range that gives it to a sequence of one
    /// frequency; a surface outside comes out in a wrong place.
    pub fn valid_depth(&self) -> Option<DepthRange> {
        self.decoding.valid_depth()
    }

    /// The scan of a frame set.
    ///
    /// # Errors
    /// [`LightError::Field`] when a frame is missing or of another size than the calibration's camera.
    pub fn reconstruct(&mut self, set: &FrameSet) -> Result<Reconstruction, LightError> {
        let pictures: Vec<&GreyPicture> = set.frames.iter().map(|f| &f.picture).collect();
        self.check_pictures(&pictures)?;
        Ok(self.reconstruct_pictures(&pictures, set.tick, set.time_nanos))
    }

    /// The scan of pictures that were checked.
    pub(super) fn reconstruct_pictures(
        &mut self,
        pictures: &[&GreyPicture],
        tick: u64,
        time_nanos: u64,
    ) -> Reconstruction {
        self.mask.clear();
        self.decoding.decode(pictures, &mut self.mask, &mut self.column_px);
        if let Some(motion) = &mut self.motion {
            motion.correct(tick, &self.mask, &mut self.column_px);
        }
        match &self.points {
            Points::Columns(triangulator) => {
                triangulator.triangulate(&self.column_px, &mut self.mask, &mut self.grid);
            }
            Points::Any(intersector) => {
                intersector.intersect(self.decoding.coordinates(&self.column_px), &mut self.mask, &mut self.grid);
            }
        }
        let mesh = self.mesher.mesh(&self.grid, &mut self.mask);
        let texture = Some(self.texture(pictures));
        Reconstruction { scan: Scan { tick, time_nanos, mesh, texture }, rejected: self.mask.count() }
    }

    /// Maps of the last frame set; `None` of patterns without fringes.
    pub fn maps(&self) -> Option<PhaseMaps> {
        let finest = self.decoding.finest()?;
        let PixelMask { width_px, height_px, verdicts, .. } = &self.mask;
        Some(PhaseMaps {
            width_px: *width_px,
            height_px: *height_px,
            modulation: finest.modulation.clone(),
            wrapped_phase_rad: finest.phase_rad.clone(),
            is_kept: (0..verdicts.len()).map(|i| self.mask.is_kept(i)).collect(),
        })
    }

    /// The background of the finest fringes, else the white picture, else the mean of all.
    fn texture(&self, pictures: &[&GreyPicture]) -> GreyPicture {
        let [width, height] = self.size_px;
        match (self.decoding.background(), self.white) {
            (Some(background), _) => grid_mesh::texture(width, height, background),
            (None, Some(white)) => pictures[white].clone(),
            (None, None) => {
                let mut mean = vec![0.0f32; pictures[0].pixels.len()];
                for picture in pictures {
                    for (sum, &level) in mean.iter_mut().zip(&picture.pixels) {
                        *sum += f32::from(level) / pictures.len() as f32;
                    }
                }
                grid_mesh::texture(width, height, &mean)
            }
        }
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

/// Refuses a direction, coded alone, that hardly changes with depth.
fn measures_depth(calibration: &Calibration, direction: Direction, limits: &Limits) -> Result<(), LightError> {
    let span_px = |direction| geometric::widest_span_px(calibration, direction, limits.depth);
    let other = if direction == Direction::Columns { Direction::Rows } else { Direction::Columns };
    let (here_px, there_px) = (span_px(direction)?, span_px(other)?);
    if here_px >= MIN_SPAN * there_px {
        return Ok(());
    }
    let reason = format!(
        "code {direction:?} alone, which on this rig change by {here_px:.0} px over the working range where {other:?} change by \
         {there_px:.0} px; code {other:?}"
    );
    Err(LightError::field("sequence.patterns", reason))
}

/// A corrector for the burst that ends the columns' chain.
fn motion_corrector(
    size_px: [usize; 2],
    sequence: &PatternSequence,
    decoding: &Decoding,
) -> Result<MotionCorrector, LightError> {
    let burst = match decoding {
        Decoding::TwoFrequency(two) => Some(two.high.clone()),
        Decoding::Columns(one) | Decoding::Rows(one) => one.decoder.bursts().last(),
        Decoding::Both(..) => None,
    };
    let Some(burst) = burst else {
        let reason = "phase_rate needs fringes along one direction; leave the key out for this sequence";
        return Err(LightError::field("processing.motion", reason));
    };
    MotionCorrector::new(size_px, &sequence.patterns[burst], sequence.patterns.len())
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
    fn dark_and_clipped_sets_give_no_surface_and_say_why() {
        let (sets, mut reconstructor, _) = run(&RigConfig::simulated(), 6);
        let mut filled = |level: u8| {
            let mut set = sets[0].clone();
            set.frames.iter_mut().for_each(|f| f.picture.pixels.fill(level));
            let Reconstruction { scan, rejected } = reconstructor.reconstruct(&set).unwrap();
            assert_eq!(scan.mesh.vertex_count(), 0);
            rejected
        };
        assert_eq!((filled(0).low_modulation, filled(255).saturated), (640 * 480, 640 * 480));
        let mut short = sets[0].clone();
        short.frames.pop();
        let error = reconstructor.reconstruct(&short).unwrap_err().to_string();
        assert_eq!(error, "frames: 5, but the sequence has 6 patterns");
    }

    #[test]
    fn pictures_of_another_size_are_refused_by_name() {
        let (mut sets, mut reconstructor, _) = run(&RigConfig::simulated(), 6);
        sets[0].frames[2].picture = GreyPicture::filled(320, 240, 0);
        assert!(reconstructor.reconstruct(&sets[0]).unwrap_err().to_string().starts_with("frames[2]"));
    }
}
