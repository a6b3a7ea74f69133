//! Noise of the depth: the standard deviation of every pixel over repeated scans of something at rest, and what noise of the
//! camera must make of it.

use crate::light::{Calibration, MaskLimits, PatternSequence, PhaseExtractor, PixelMask, WrappedPhase};
use glam::{DVec2, DVec3};
use gv3_codec::{GreyPicture, Scan};
use serde::Serialize;
use std::f64::consts::TAU;

/// Standard deviation of the depth of every camera pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct NoiseMap {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Standard deviation row by row, mm; NaN where not every scan has a point.
    pub sigma_mm: Vec<f32>,
    /// Mean depth, scan frame's -z, mm; NaN as above.
    pub depth_mm: Vec<f32>,
}

/// A noise map in numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct NoiseSummary {
    /// Scans.
    pub scans: usize,
    /// Pixels that all scans have.
    pub pixels: usize,
    /// Median standard deviation of the depth, mm.
    pub median_sigma_mm: f64,
    /// 95th percentile, mm.
    pub p95_sigma_mm: f64,
    /// Median that the camera's noise must give, mm; known for simulated cameras.
    pub expected_median_sigma_mm: Option<f64>,
}

/// Collects depths, scan by scan, by Welford's recurrence.
#[derive(Debug, Clone, Default)]
pub struct NoiseCollector {
    size_px: Option<[u32; 2]>,
    count: Vec<u32>,
    mean: Vec<f64>,
    squares: Vec<f64>,
    scans: u32,
}

impl NoiseCollector {
    /// Adds a scan whose texture coordinates are its camera pixels, as those made here are.
    ///
    /// # Errors
    /// What is wrong with the scan: no texture, another size.
    pub fn add(&mut self, scan: &Scan) -> Result<(), String> {
        let (Some(texture), Some(uv)) = (&scan.texture, &scan.mesh.uv) else {
            return Err("has no texture, which tells the pixel of each point".into());
        };
        let size = [texture.width_px, texture.height_px];
        let pixels = texture.pixels.len();
        if *self.size_px.get_or_insert(size) != size {
            return Err(format!("{} x {} pixels, the scans before it have others", size[0], size[1]));
        }
        (self.count).resize(pixels, 0);
        self.mean.resize(pixels, 0.0);
        self.squares.resize(pixels, 0.0);
        self.scans += 1;
        for (p, uv) in scan.mesh.positions_mm.iter().zip(uv) {
            let [x, y] = texture.uv_to_px(*uv).map(|v| v.round());
            if !(x >= 0.0 && y >= 0.0 && x < size[0] as f32 && y < size[1] as f32) {
                continue;
            }
            let i = y as usize * size[0] as usize + x as usize;
            // A pixel has one point a scan; what comes twice is no grid scan's.
            if self.count[i] + 1 != self.scans {
                continue;
            }
            self.count[i] += 1;
            let depth = -f64::from(p.z);
            let step = depth - self.mean[i];
            self.mean[i] += step / f64::from(self.count[i]);
            self.squares[i] += step * (depth - self.mean[i]);
        }
        Ok(())
    }

    /// The map; `None` before the second scan.
    pub fn map(&self) -> Option<NoiseMap> {
        let [width_px, height_px] = self.size_px.filter(|_| self.scans > 1)?;
        let whole = |i: usize| self.count[i] == self.scans;
        let sigma = |i: usize| (self.squares[i] / f64::from(self.scans - 1)).sqrt() as f32;
        let of = |value: &dyn Fn(usize) -> f32| {
            (0..self.count.len()).map(|i| if whole(i) { value(i) } else { f32::NAN }).collect()
        };
        Some(NoiseMap { width_px, height_px, sigma_mm: of(&sigma), depth_mm: of(&|i| self.mean[i] as f32) })
    }
}

/// The value that a share `percent` of the finite ones do not exceed.
pub fn percentile(values: &[f32], percent: usize) -> Option<f64> {
    let mut finite: Vec<f32> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let last = finite.len().checked_sub(1)?;
    Some(f64::from(*finite.select_nth_unstable_by(last * percent / 100, f32::total_cmp).1))
}

impl NoiseMap {
    /// The map in numbers; `None` when it is empty.
    pub fn summary(&self, scans: usize, expected_mm: Option<&[f32]>) -> Option<NoiseSummary> {
        Some(NoiseSummary {
            scans,
            pixels: self.sigma_mm.iter().filter(|s| s.is_finite()).count(),
            median_sigma_mm: percentile(&self.sigma_mm, 50)?,
            p95_sigma_mm: percentile(&self.sigma_mm, 95)?,
            expected_median_sigma_mm: expected_mm.and_then(|e| percentile(e, 50)),
        })
    }
}

/// Noise of a camera: read noise and quantization, and shot noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraNoise {
    /// Standard deviation of the read noise, grey levels.
    pub read_levels: f64,
    /// Photoelectrons a grey level.
    pub electrons_per_level: f64,
}

/// Standard deviation of the depth of every pixel of a map, mm, propagated from the camera's noise to first order:
/// sigma_phi^2 = 2 sigma_I^2 / (N B^2) for N equal steps with sigma_I^2 = read^2 + 1/12 + A/electrons (background A,
/// modulation B; the shot noise at A stands for that of the N pictures), sigma_u = sigma_phi period / 2 pi, and sigma_z =
/// sigma_u / (du/dz along the pixel's ray). NaN where the map is.
pub fn expected_sigma_mm(
    map: &NoiseMap,
    pictures: &[GreyPicture],
    sequence: &PatternSequence,
    calibration: &Calibration,
    noise: CameraNoise,
) -> Option<Vec<f32>> {
    let burst = sequence.finest_burst();
    let period_px = sequence.patterns[burst.start].period_px()?;
    let steps = burst.len() as f64;
    let extractor = PhaseExtractor::new(&sequence.patterns[burst.clone()], MaskLimits::default()).ok()?;
    let mut mask = PixelMask::new(map.width_px as usize, map.height_px as usize);
    let mut phase = WrappedPhase::new(map.sigma_mm.len());
    let refs: Vec<&GreyPicture> = pictures.get(burst)?.iter().collect();
    extractor.extract(&refs, &mut mask, &mut phase);
    let expected = |i: usize| {
        let depth = f64::from(map.depth_mm[i]);
        let px = DVec2::new((i % map.width_px as usize) as f64, (i / map.width_px as usize) as f64);
        let ray = calibration.camera.unproject(px)?;
        let column = |z: f64| calibration.projector_px(DVec3::new(ray.x * z, ray.y * z, z)).x;
        let slope = column(depth + 0.5) - column(depth - 0.5);
        let (background, modulation) = (f64::from(phase.background[i]), f64::from(phase.modulation[i]));
        let variance = noise.read_levels.powi(2) + 1.0 / 12.0 + background / noise.electrons_per_level;
        let sigma_phase = (2.0 * variance / steps).sqrt() / modulation;
        Some((sigma_phase * period_px / TAU / slope.abs()) as f32)
    };
    let at = |i: usize| if map.depth_mm[i].is_finite() { expected(i).unwrap_or(f32::NAN) } else { f32::NAN };
    Some((0..map.sigma_mm.len()).map(at).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use gv3_codec::mesh::TriMesh;

    fn scan(depths: &[(usize, f32)]) -> Scan {
        let texture = GreyPicture::filled(4, 3, 9);
        let at = |i: usize| [(i % 4) as f32, (i / 4) as f32];
        let mesh = TriMesh {
            positions_mm: depths.iter().map(|(i, z)| Vec3::new(at(*i)[0], at(*i)[1], -z)).collect(),
            triangles: vec![],
            uv: Some(depths.iter().map(|(i, _)| texture.px_to_uv(at(*i))).collect()),
        };
        Scan { tick: 0, time_nanos: 0, mesh, texture: Some(texture) }
    }

    #[test]
    fn a_map_has_the_deviations_of_pixels_that_every_scan_has() {
        let mut collector = NoiseCollector::default();
        for (a, b) in [(600.0, 700.0), (601.0, 700.0), (602.0, 700.0)] {
            assert!(collector.map().is_none() || collector.scans > 1);
            let depths = [(2, a), (7, b), (8, 500.0)];
            collector.add(&scan(if a == 601.0 { &depths[..2] } else { &depths })).unwrap();
        }
        let map = collector.map().unwrap();
        assert_eq!((map.sigma_mm[2], map.sigma_mm[7], map.depth_mm[2]), (1.0, 0.0, 601.0));
        assert!(map.sigma_mm[8].is_nan() && map.sigma_mm[0].is_nan());
        let summary = map.summary(3, None).unwrap();
        assert_eq!((summary.pixels, summary.median_sigma_mm), (2, 0.0));
        let bare = Scan { texture: None, ..scan(&[]) };
        assert!(collector.add(&bare).unwrap_err().contains("no texture"));
    }
}
