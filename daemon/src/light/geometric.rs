//! Absolute phase of one frequency from geometric constraints.
//!
//! A camera pixel sees only the projector columns between those at the nearest and the farthest depth. If a period is wider
//! than that interval, the phase on a virtual plane z_min fixes the fringe order: with the minimum phase Phi_min of the pixel
//! on that plane, k = ceil((Phi_min - phi) / (2 pi)) (Y. An, J.-S. Hyun, S. Zhang, "Pixel-wise absolute phase unwrapping using
//! geometric constraints of structured light system", Optics Express 24(16), 2016). Here the plane is moved away
//! from the working range by half of what the period has to spare, so that noise at either end cannot wrap; this k is then the
//! one that puts the coordinate nearest to the middle of the pixel's interval.
//!
//! Three pictures give an absolute scan. Nothing checks the order: a surface outside [`MinimumPhase::valid_depth`] comes out
//! one or more periods off, inside the working range or rejected. The noise is that of the one long period, sqrt(2/N) sigma / B
//! radians of it.

use super::{Calibration, DepthRange, Direction, LightError};
use glam::DVec2;

/// Part of a period that the working range may take; the rest is for noise at its ends.
pub const USABLE: f64 = 0.9;

/// Pixels a side at which the depth limits of the whole picture are looked for; they change smoothly over it.
const PROBES: u32 = 25;

/// Columns or rows that a pixel can see in the working range, and the order that they give a phase.
#[derive(Debug, Clone)]
pub struct MinimumPhase {
    /// Least coordinate of each pixel's period, px; the minimum phase over 2 pi times the period.
    minimum_px: Vec<f32>,
    period_px: f64,
    valid: DepthRange,
}

/// Geometry of one coded direction.
#[derive(Clone, Copy)]
struct View<'a> {
    calibration: &'a Calibration,
    direction: Direction,
}

impl View<'_> {
    /// Projector coordinate of a ray's point at a depth, px.
    fn coordinate_px(&self, ray: DVec2, z_mm: f64) -> f64 {
        let px = self.calibration.projector_px((ray * z_mm).extend(z_mm));
        if self.direction == Direction::Columns { px.x } else { px.y }
    }

    fn span_px(&self, ray: DVec2, depth: DepthRange) -> f64 {
        (self.coordinate_px(ray, depth.near_mm) - self.coordinate_px(ray, depth.far_mm)).abs()
    }

    /// Rays all over the picture, its border included.
    fn probes(&self) -> Vec<DVec2> {
        let camera = &self.calibration.camera;
        let at = |i: u32, size: u32| f64::from(i) / f64::from(PROBES - 1) * f64::from(size - 1);
        let pixel = |n: u32| DVec2::new(at(n % PROBES, camera.width_px), at(n / PROBES, camera.height_px));
        (0..PROBES * PROBES).filter_map(|n| camera.unproject(pixel(n))).collect()
    }
}

/// Widest interval of projector coordinates that a pixel sees in the working range, px.
///
/// # Errors
/// [`LightError::Field`] when the calibration's distortion folds.
pub fn widest_span_px(calibration: &Calibration, direction: Direction, depth: DepthRange) -> Result<f64, LightError> {
    let view = View { calibration, direction };
    let spans = calibration.camera.ray_table("camera")?.into_iter().map(|ray| view.span_px(ray, depth));
    // A range given wrong can also make the width no number, which must not pass for narrow.
    Ok(spans.fold(0.0, |widest: f64, span| if span.is_nan() { f64::INFINITY } else { widest.max(span) }))
}

/// Least and greatest projector coordinate of every pixel in the working range, px.
///
/// # Errors
/// [`LightError::Field`] when the calibration's distortion folds.
pub fn ranges_px(
    calibration: &Calibration,
    direction: Direction,
    depth: DepthRange,
) -> Result<Vec<[f32; 2]>, LightError> {
    let view = View { calibration, direction };
    let range = |ray: DVec2| {
        let [a, b] = [depth.near_mm, depth.far_mm].map(|z_mm| view.coordinate_px(ray, z_mm) as f32);
        [a.min(b), a.max(b)]
    };
    Ok(calibration.camera.ray_table("camera")?.into_iter().map(range).collect())
}

impl MinimumPhase {
    /// Table for a rig, a period and a working range.
    ///
    /// # Errors
    /// [`LightError::Field`] when the period is too short for the range, with the least period for this range and the longest
    /// range for this period.
    pub fn new(
        calibration: &Calibration,
        direction: Direction,
        period_px: f64,
        depth: DepthRange,
    ) -> Result<Self, LightError> {
        let view = View { calibration, direction };
        let widest_px = widest_span_px(calibration, direction, depth)?;
        if widest_px > USABLE * period_px {
            return Err(too_short(view, period_px, depth, widest_px));
        }
        let rays = calibration.camera.ray_table("camera")?;
        let minimum = |ray: &DVec2| {
            let middle = 0.5 * (view.coordinate_px(*ray, depth.near_mm) + view.coordinate_px(*ray, depth.far_mm));
            (middle - 0.5 * period_px) as f32
        };
        let minimum_px = rays.iter().map(minimum).collect();
        Ok(Self { minimum_px, period_px, valid: valid_depth(view, period_px, depth) })
    }

    /// Depths between which every pixel gets its right order; wider than the working range by what the period has to spare.
    pub fn valid_depth(&self) -> DepthRange {
        self.valid
    }

    /// Middle of each pixel's period, px: the coordinate whose nearest order is the k of the module's head.
    pub fn middle_px(&self) -> impl Iterator<Item = f32> + '_ {
        let half_px = (0.5 * self.period_px) as f32;
        self.minimum_px.iter().map(move |minimum_px| minimum_px + half_px)
    }

    /// Fringe order of pixel `i` with wrapped phase `phase_rad`.
    ///
    /// # Panics
    /// When there is no pixel `i`.
    pub fn order(&self, i: usize, phase_rad: f32) -> f32 {
        (self.minimum_px[i] / self.period_px as f32 - phase_rad / std::f32::consts::TAU).ceil()
    }
}

/// The working range, widened at both ends until the first pixel leaves its period.
fn valid_depth(view: View<'_>, period_px: f64, depth: DepthRange) -> DepthRange {
    let probes = view.probes();
    let fits = |z_mm: f64| {
        probes.iter().all(|&ray| {
            let ends = [depth.near_mm, depth.far_mm].map(|z| view.coordinate_px(ray, z));
            (view.coordinate_px(ray, z_mm) - 0.5 * (ends[0] + ends[1])).abs() <= 0.5 * period_px
        })
    };
    DepthRange {
        near_mm: last_fitting(depth.near_mm, 0.1 * depth.near_mm, fits),
        far_mm: last_fitting(depth.far_mm, 10.0 * depth.far_mm, fits),
    }
}

/// The depth nearest to `end` that fits, between `start`, which does, and `end`; bisection.
fn last_fitting(start: f64, end: f64, fits: impl Fn(f64) -> bool) -> f64 {
    if fits(end) {
        return end;
    }
    let (mut good, mut bad) = (start, end);
    for _ in 0..40 {
        let middle = 0.5 * (good + bad);
        if fits(middle) { good = middle } else { bad = middle }
    }
    good
}

fn too_short(view: View<'_>, period_px: f64, depth: DepthRange, widest_px: f64) -> LightError {
    let probes = view.probes();
    let fits = |far_mm: f64| {
        let range = DepthRange { near_mm: depth.near_mm, far_mm };
        probes.iter().all(|&ray| view.span_px(ray, range) <= USABLE * period_px)
    };
    let far_mm = last_fitting(depth.near_mm, depth.far_mm, fits);
    // Next to the lens even a millimetre is wider than the projector.
    let narrower = match far_mm.floor() {
        far_mm if far_mm > depth.near_mm + 1.0 => format!("far_mm = {far_mm:.0} in limits.depth for this period"),
        _ => "the near_mm and far_mm of the scene in limits.depth".into(),
    };
    let reason = format!(
        "the longest period or beat, {period_px:.1} px, covers neither the projector nor the working range {}..{} mm, which \
         spans {widest_px:.0} px; add a coarser pattern, or take a period of {:.0} px or more for this range, or {narrower}",
        depth.near_mm,
        depth.far_mm,
        (widest_px / USABLE).ceil()
    );
    LightError::field("sequence.patterns", reason)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;
    use proptest::prelude::*;
    use std::f64::consts::TAU;

    fn small_rig() -> Calibration {
        let mut c = rig();
        (c.camera.width_px, c.camera.height_px) = (64, 48);
        for length in [&mut c.camera.fx_px, &mut c.camera.fy_px, &mut c.camera.cx_px, &mut c.camera.cy_px] {
            *length /= 10.0;
        }
        c
    }

    proptest! {
        #[test]
        fn every_valid_depth_gets_its_order(part in 0.001f64..0.999, period_px in 270.0f64..500.0) {
            let c = small_rig();
            let minimum = MinimumPhase::new(&c, Direction::Columns, period_px, DepthRange::default()).unwrap();
            let DepthRange { near_mm, far_mm } = minimum.valid_depth();
            prop_assert!(near_mm < 510.0 && far_mm > 690.0);
            let z_mm = near_mm + part * (far_mm - near_mm);
            for (i, (ray, middle_px)) in c.camera.ray_table("camera").unwrap().iter().zip(minimum.middle_px()).enumerate() {
                let truth_px = c.projector_px((*ray * z_mm).extend(z_mm)).x;
                let turns = truth_px / period_px;
                let phase_rad = ((turns - turns.round()) * TAU) as f32;
                let found_px = (f64::from(minimum.order(i, phase_rad)) + f64::from(phase_rad) / TAU) * period_px;
                prop_assert!((found_px - truth_px).abs() < 0.01, "{found_px} for {truth_px} at {z_mm} mm");
                prop_assert!((f64::from(middle_px) - truth_px).abs() <= 0.5 * period_px + 0.5);
            }
        }
    }

    #[test]
    fn a_refusal_names_a_period_and_a_range_that_work() {
        let c = small_rig();
        let range = DepthRange::default();
        let error = MinimumPhase::new(&c, Direction::Columns, 100.0, range).unwrap_err().to_string();
        let after = |text: &str| -> f64 {
            let rest = error.split(text).nth(1).unwrap();
            rest.split(|c: char| !c.is_ascii_digit()).next().unwrap().parse().unwrap()
        };
        let (period_px, far_mm) = (after("take a period of "), after("far_mm = "));
        MinimumPhase::new(&c, Direction::Columns, period_px, range).unwrap();
        MinimumPhase::new(&c, Direction::Columns, 100.0, DepthRange { far_mm, ..range }).unwrap();
        assert!(far_mm > 560.0, "{error}");
        let more = DepthRange { far_mm: far_mm + 4.0, ..range };
        assert!(MinimumPhase::new(&c, Direction::Columns, 100.0, more).is_err());
        let unset = DepthRange { near_mm: 1.0, far_mm: 100_000.0 };
        let error = MinimumPhase::new(&c, Direction::Columns, 100.0, unset).unwrap_err().to_string();
        assert!(error.ends_with("or the near_mm and far_mm of the scene in limits.depth"), "{error}");
        let endless = DepthRange { far_mm: f64::INFINITY, ..range };
        assert!(MinimumPhase::new(&c, Direction::Columns, 100.0, endless).is_err());
    }
}
