//! A still scan: the pictures of one sequence, taken by hand as often as not, so that each is looked at before the
//! [`super::Reconstructor`] gets them; and what pictures of a flat board tell of the projector.

use super::{Reconstruction, Reconstructor};
use crate::light::gamma::{BoardFigures, BoardPhase};
use crate::light::{
    AbsoluteDecoder, Calibration, Direction, GammaTable, LightError, Limits, MaskLimits, MotionCorrection, Pattern,
    PatternKind, PatternSequence, PixelMask, Processing,
};
use gv3_codec::GreyPicture;

/// Turns the pictures of one sequence into a scan.
#[derive(Debug, Clone)]
pub struct StillReconstructor {
    calibration: Calibration,
    sequence: PatternSequence,
    limits: Limits,
    processing: Processing,
    reconstructor: Reconstructor,
}

impl StillReconstructor {
    /// Checks that calibration, sequence and limits fit together.
    ///
    /// # Errors
    /// [`LightError::Field`] naming what does not.
    pub fn new(calibration: &Calibration, sequence: &PatternSequence, limits: &Limits) -> Result<Self, LightError> {
        Self::with(calibration, sequence, limits, &Processing::default())
    }

    /// As [`Self::new`], with other choices than the default.
    ///
    /// # Errors
    /// As [`Self::new`], and naming the choice that cannot work.
    pub fn with(
        calibration: &Calibration,
        sequence: &PatternSequence,
        limits: &Limits,
        processing: &Processing,
    ) -> Result<Self, LightError> {
        if processing.motion != MotionCorrection::None {
            let reason = "a single scan has no frame set before it to see motion with; leave the key out";
            return Err(LightError::field("processing.motion", reason));
        }
        let reconstructor = Reconstructor::with(calibration, sequence, limits, processing)?;
        let (calibration, sequence, limits) = (*calibration, sequence.clone(), *limits);
        Ok(Self { calibration, sequence, limits, processing: processing.clone(), reconstructor })
    }

    /// Phase errors of the projector's response from pictures of a flat board, for every burst.
    ///
    /// # Errors
    /// As [`Self::reconstruct`] and [`GammaTable::measure`].
    pub fn measure_gamma(&self, pictures: &[GreyPicture]) -> Result<(GammaTable, BoardFigures), LightError> {
        self.check_pictures(pictures)?;
        let refs: Vec<&GreyPicture> = pictures.iter().collect();
        let camera = &self.calibration.camera;
        let (mut whole, mut first) = (GammaTable::default(), None);
        for direction in [Direction::Columns, Direction::Rows] {
            let (calibration, limits) = (&self.calibration, &self.limits);
            let made = AbsoluteDecoder::with(calibration, &self.sequence, direction, limits, &self.processing)?;
            let Some(decoder) = made.filter(|d| d.bursts().next().is_some()) else { continue };
            let mut mask = PixelMask::new(camera.width_px as usize, camera.height_px as usize);
            let measured = decoder.measure(&refs, &mut mask);
            mask.erode();
            let coordinate_px = decoder.resolve(&refs, &measured, &mut mask);
            let bursts: Vec<BoardPhase<'_>> = decoder
                .bursts()
                .zip(measured.bursts())
                .map(|(b, p)| BoardPhase { patterns: &self.sequence.patterns[b], phase_rad: &p.phase_rad })
                .collect();
            let (table, figures) = GammaTable::measure(&bursts, &coordinate_px, &mask)?;
            whole.bursts.extend(table.bursts);
            first = first.or(Some(figures));
        }
        let figures =
            first.ok_or_else(|| LightError::field("sequence.patterns", "no fringes, so no gamma to measure"))?;
        Ok((whole, figures))
    }

    /// The scan, at tick 0.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the picture, 0-based: too few, of another size, all dark, all saturated.
    pub fn reconstruct(&mut self, pictures: &[GreyPicture]) -> Result<Reconstruction, LightError> {
        self.check_pictures(pictures)?;
        Ok(self.reconstructor.reconstruct_pictures(&pictures.iter().collect::<Vec<_>>(), 0, 0))
    }

    fn check_pictures(&self, pictures: &[GreyPicture]) -> Result<(), LightError> {
        let patterns = &self.sequence.patterns;
        if pictures.len() != patterns.len() {
            let reason = format!("{}, but the sequence has {} patterns", pictures.len(), patterns.len());
            return Err(LightError::field("pictures", reason));
        }
        let [width, height] = [self.calibration.camera.width_px, self.calibration.camera.height_px];
        for (i, (picture, pattern)) in pictures.iter().zip(patterns).enumerate() {
            let field = format!("pictures[{i}]");
            if (picture.width_px, picture.height_px) != (width, height) {
                let (w, h) = (picture.width_px, picture.height_px);
                let reason = format!("{w} x {h} pixels, but the calibration's camera has {width} x {height}");
                return Err(LightError::field(field, reason));
            }
            check_levels(picture, pattern, self.limits.mask).map_err(|reason| LightError::field(field, reason))?;
        }
        self.check_white_black(pictures)
    }

    /// White darker than black means that the two, or the whole order, are swapped.
    fn check_white_black(&self, pictures: &[GreyPicture]) -> Result<(), LightError> {
        let find = |wanted: PatternKind| self.sequence.patterns.iter().position(|p| p.kind == wanted);
        let Some((white, black)) = find(PatternKind::White).zip(find(PatternKind::Black)) else { return Ok(()) };
        let sum = |i: usize| pictures[i].pixels.iter().map(|&level| u64::from(level)).sum::<u64>();
        if sum(white) > sum(black) {
            return Ok(());
        }
        let reason = format!("white, but no brighter than black, pictures[{black}]; check the order of the pictures");
        Err(LightError::field(format!("pictures[{white}]"), reason))
    }
}

/// What makes a whole picture useless.
fn check_levels(picture: &GreyPicture, pattern: &Pattern, limits: MaskLimits) -> Result<(), String> {
    let (least, most) = picture.pixels.iter().fold((255, 0), |(least, most), &v| (v.min(least), v.max(most)));
    if least >= limits.saturated_level {
        return Err(format!("all saturated, {least} levels or more; lower exposure or gain"));
    }
    if pattern.kind != PatternKind::Black && f32::from(most) < limits.min_modulation {
        return Err(format!("all black, {most} levels at most; is the projector on and the lens open?"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::{Distortion, Intrinsics, Rigid, Unwrap};
    use glam::{DMat3, DVec2, DVec3};

    fn rig() -> Calibration {
        let lens = |width_px, height_px, f_px: f64, k1| Intrinsics {
            width_px,
            height_px,
            fx_px: f_px,
            fy_px: f_px,
            cx_px: 0.5 * f64::from(width_px),
            cy_px: 0.5 * f64::from(height_px),
            distortion: Distortion { k1, ..Distortion::default() },
        };
        let rotation = DMat3::from_rotation_y(0.2) * DMat3::from_rotation_x(-0.05);
        let centre = DVec3::new(120.0, 30.0, 0.0);
        Calibration {
            camera: lens(160, 120, 300.0, -0.1),
            projector: lens(320, 240, 600.0, -0.05),
            projector_from_camera: Rigid::new(rotation, -(rotation * centre)),
        }
    }

    /// Pictures of the plane z = 600 + 0.2 x, camera frame.
    fn pictures(sequence: &PatternSequence) -> Vec<GreyPicture> {
        let c = rig();
        let render = |i: usize| {
            let shown = sequence.render(i);
            let pixel = |n: u32| {
                let ray = c.camera.unproject(DVec2::new(f64::from(n % 160), f64::from(n / 160))).unwrap();
                let px = c.projector_px(ray.extend(1.0) * (600.0 / (1.0 - 0.2 * ray.x)));
                let is_lit = px.x >= 0.0 && px.y >= 0.0 && px.x <= 319.0 && px.y <= 239.0;
                (if is_lit { 15.0 + 0.7 * shown.sample([px.x as f32, px.y as f32]) } else { 15.0 }).round() as u8
            };
            GreyPicture::new(160, 120, (0..160 * 120).map(pixel).collect())
        };
        (0..sequence.patterns.len()).map(render).collect()
    }

    fn limits() -> Limits {
        let mut limits = Limits::default();
        (limits.depth.near_mm, limits.depth.far_mm) = (400.0, 900.0);
        (limits.mesh.min_piece_px, limits.mesh.max_depth_step_mm) = (0, 20.0);
        limits
    }

    #[test]
    fn every_scheme_gives_the_plane() {
        let (size, both) = ([320, 240], [Direction::Columns, Direction::Rows]);
        for (sequence, bound_mm) in [
            // A camera pixel is two projector pixels wide, so no edge refines the code: 4.9 mm a pixel / sqrt(12).
            (PatternSequence::gray_code(size, &both), 1.6),
            (PatternSequence::gray_phase(size, both[0], 16.0, 4), 0.2),
            (PatternSequence::hierarchical(size, both[0], 16.0, 5.0, 3), 0.2),
            (PatternSequence::heterodyne(size, both[0], 20.0, 4), 0.2),
            (PatternSequence::two_frequency(size, 160.0, 20.0, 3), 0.2),
        ] {
            let mut reconstructor = StillReconstructor::new(&rig(), &sequence, &limits()).unwrap();
            let Reconstruction { scan, rejected } = reconstructor.reconstruct(&pictures(&sequence)).unwrap();
            scan.mesh.validate().unwrap();
            assert_eq!(scan.mesh.vertex_count() as u64 + rejected.total(), 160 * 120);
            assert!(scan.mesh.vertex_count() > 9_000, "{} vertices, {rejected:?}", scan.mesh.vertex_count());
            let distance = |p: &glam::Vec3| f64::from(-p.z - 600.0 - 0.2 * p.x) / 1.04f64.sqrt();
            let sum: f64 = scan.mesh.positions_mm.iter().map(|p| distance(p).powi(2)).sum();
            let rms_mm = (sum / scan.mesh.vertex_count() as f64).sqrt();
            assert!(rms_mm < bound_mm, "{} pictures: {rms_mm} mm", sequence.patterns.len());
        }
    }

    #[test]
    fn one_burst_is_placed_by_a_narrow_range_or_left_out_by_name() {
        let sequence = PatternSequence::n_step([320, 240], Direction::Columns, 16.0, 4);
        let processing = Processing { unwrap: Unwrap::Spatial, ..Processing::default() };
        let scan = |near_mm: f64, far_mm: f64| {
            let mut limits = limits();
            (limits.depth.near_mm, limits.depth.far_mm) = (near_mm, far_mm);
            let mut reconstructor = StillReconstructor::with(&rig(), &sequence, &limits, &processing).unwrap();
            reconstructor.reconstruct(&pictures(&sequence)).unwrap()
        };
        // A period is 80 mm of depth, so that the plane's 60 mm fit into 90 mm one way only, and into 500 mm six ways.
        let Reconstruction { scan: placed, rejected } = scan(555.0, 645.0);
        assert!(placed.mesh.vertex_count() > 9_000, "{} vertices, {rejected:?}", placed.mesh.vertex_count());
        assert_eq!(placed.mesh.vertex_count() as u64 + rejected.total(), 160 * 120);
        let worst = placed.mesh.positions_mm.iter().map(|p| (-p.z - 600.0 - 0.2 * p.x).abs()).fold(0.0, f32::max);
        assert!(worst < 1.0, "{worst} mm");
        let Reconstruction { scan: unplaced, rejected } = scan(400.0, 900.0);
        assert_eq!(unplaced.mesh.vertex_count(), 0);
        assert!(rejected.unanchored > 9_000, "{rejected:?}");
    }

    #[test]
    fn useless_input_is_named() {
        let sequence = PatternSequence::gray_code([320, 240], &[Direction::Columns]);
        let good = pictures(&sequence);
        let mut reconstructor = StillReconstructor::new(&rig(), &sequence, &limits()).unwrap();
        let mut error = |change: fn(&mut Vec<GreyPicture>)| {
            let mut pictures = good.clone();
            change(&mut pictures);
            reconstructor.reconstruct(&pictures).unwrap_err().to_string()
        };
        assert!(error(|p| drop(p.pop())).starts_with("pictures: 19, but the sequence has 20"));
        assert!(error(|p| p[3] = GreyPicture::filled(10, 120, 9)).starts_with("pictures[3]: 10 x 120 pixels"));
        assert!(error(|p| p[4].pixels.fill(0)).starts_with("pictures[4]: all black"));
        assert!(error(|p| p[18].pixels.fill(255)).starts_with("pictures[18]: all saturated"));
        assert!(error(|p| p.swap(18, 19)).starts_with("pictures[18]: white, but no brighter than black"));
        let other = PatternSequence::gray_code([320, 241], &[Direction::Columns]);
        let error = StillReconstructor::new(&rig(), &other, &limits()).unwrap_err().to_string();
        assert_eq!(error, "sequence.width_px: 320 x 241, but the calibration's projector has 320 x 240");
        let mut broken = rig();
        broken.camera.fx_px = f64::NAN;
        assert!(StillReconstructor::new(&broken, &sequence, &limits()).is_err());
    }
}
