//! Acceptance in the manner of VDI/VDE 2634 part 2 (optical 3D measuring systems based on area scanning): probing error,
//! sphere-distance error and flatness-measurement error, and a map of the depth noise.
//!
//! Of every object up to 3 per mille of the points, those farthest from the fitted form, are left out, as the guideline
//! allows; the form is fitted again to the rest. Radii are free in every fit.

pub mod fit;
pub mod noise;
pub mod simulate;

use fit::{Plane, Sphere, find_plane, find_sphere, range_mm, without_worst};
use glam::DVec3;
use gv3_codec::Scan;
use serde::Serialize;

pub use noise::{NoiseMap, NoiseSummary};

/// Share of the gate from which on a deviation is taken to reach it.
const REACH: f64 = 0.9;

/// Why an object could not be measured.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum AccuracyError {
    /// The form is not in the scan.
    #[error("{scan}: {reason}")]
    NotFound {
        /// The scan.
        scan: String,
        /// What was looked for.
        reason: String,
    },
}

/// What is known of the objects, and which points belong to them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Standard {
    /// Calibrated diameter of the spheres, mm.
    pub diameter_mm: f64,
    /// Calibrated distance of their centres, mm; none for a single sphere.
    pub distance_mm: Option<f64>,
    /// Points farther than this from the fitted form belong to something else, mm.
    pub gate_mm: f64,
}

/// A sphere as measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Probing {
    /// Name of the position.
    pub position: String,
    /// Probing error of form PF: the range of the radial distances, mm.
    pub form_mm: f64,
    /// Probing error of size PS: measured less calibrated diameter, mm.
    pub size_mm: f64,
    /// Standard deviation of the radial distances, mm.
    pub sigma_mm: f64,
    /// Points that were used.
    pub points: usize,
    /// Points left out of the 3 per mille.
    pub rejected: usize,
    /// Deviations reach the gate, so it may cut them: a larger one is needed.
    pub reaches_gate: bool,
}

/// A distance of two spheres as measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Spacing {
    /// Name of the position.
    pub position: String,
    /// Distance of the centres, mm.
    pub distance_mm: f64,
    /// Sphere-distance error SD: measured less calibrated distance, mm.
    pub error_mm: f64,
}

/// A plane as measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Flatness {
    /// Name of the position.
    pub position: String,
    /// Flatness-measurement error RF: the range of the distances from the plane, mm.
    pub range_mm: f64,
    /// Standard deviation of the distances, mm.
    pub sigma_mm: f64,
    /// Points that were used.
    pub points: usize,
    /// Points left out of the 3 per mille.
    pub rejected: usize,
    /// Deviations reach the gate, so it may cut them: a larger one is needed.
    pub reaches_gate: bool,
}

/// What was measured; a figure of merit is the largest of its kind over the positions.
#[derive(Debug, Clone, Default, Serialize)]
pub struct AccuracyReport {
    /// Spheres.
    pub probing: Vec<Probing>,
    /// Distances of spheres.
    pub spacing: Vec<Spacing>,
    /// Planes.
    pub flatness: Vec<Flatness>,
    /// Noise of the depth.
    pub noise: Option<NoiseSummary>,
    /// Largest PF, PS, SD and RF by amount, mm.
    pub worst: Worst,
}

/// The largest errors by amount, mm; none where nothing of the kind was measured.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Worst {
    /// Probing error of form.
    pub form_mm: Option<f64>,
    /// Probing error of size.
    pub size_mm: Option<f64>,
    /// Sphere-distance error.
    pub distance_mm: Option<f64>,
    /// Flatness-measurement error.
    pub flatness_mm: Option<f64>,
}

impl AccuracyReport {
    /// Fills in [`AccuracyReport::worst`].
    #[must_use]
    pub fn summed_up(mut self) -> Self {
        fn largest(values: impl Iterator<Item = f64>) -> Option<f64> {
            values.map(f64::abs).max_by(f64::total_cmp)
        }
        self.worst = Worst {
            form_mm: largest(self.probing.iter().map(|p| p.form_mm)),
            size_mm: largest(self.probing.iter().map(|p| p.size_mm)),
            distance_mm: largest(self.spacing.iter().map(|s| s.error_mm)),
            flatness_mm: largest(self.flatness.iter().map(|f| f.range_mm)),
        };
        self
    }

    /// Measures the one or two spheres of a scan.
    ///
    /// # Errors
    /// [`AccuracyError::NotFound`] when there are fewer than the standard has.
    pub fn add_spheres(&mut self, position: &str, scan: &Scan, standard: &Standard) -> Result<(), AccuracyError> {
        let mut points = points(scan);
        let count = if standard.distance_mm.is_some() { 2 } else { 1 };
        let mut found: Vec<(Sphere, Probing)> = Vec::new();
        for _ in 0..count {
            let Some(inliers) = find_sphere(&points, 0.5 * standard.diameter_mm, standard.gate_mm) else { break };
            let Some((sphere, probing)) = probe(position, &inliers, standard) else { break };
            // Twice the gate, so that no fringe of this sphere is left for the next.
            points.retain(|p| sphere.distance_mm(*p).abs() > 2.0 * standard.gate_mm);
            found.push((sphere, probing));
        }
        if found.len() < count {
            let of = if count == 2 { "two spheres" } else { "a sphere" };
            let reason = format!("{of} of {} mm not found, {} of {count} are there", standard.diameter_mm, found.len());
            return Err(AccuracyError::NotFound { scan: position.into(), reason });
        }
        if let (Some(calibrated), [(a, _), (b, _)]) = (standard.distance_mm, &found[..]) {
            let distance_mm = a.centre_mm.distance(b.centre_mm);
            let error_mm = distance_mm - calibrated;
            self.spacing.push(Spacing { position: position.into(), distance_mm, error_mm });
        }
        self.probing.extend(found.into_iter().map(|(_, probing)| probing));
        Ok(())
    }

    /// Measures the plane of a scan; returns it for pictures of the deviations.
    ///
    /// # Errors
    /// [`AccuracyError::NotFound`] when there is none.
    pub fn add_plane(&mut self, position: &str, scan: &Scan, gate_mm: f64) -> Result<Plane, AccuracyError> {
        let missing = || AccuracyError::NotFound { scan: position.into(), reason: "no plane found".into() };
        let inliers = find_plane(&points(scan), gate_mm).ok_or_else(missing)?;
        let first = Plane::fit(&inliers).ok_or_else(missing)?;
        let (kept, rejected) = without_worst(&inliers, |p| first.distance_mm(p));
        let plane = Plane::fit(&kept).ok_or_else(missing)?;
        let [low, high] = range_mm(kept.iter().map(|p| plane.distance_mm(*p)));
        let squares: f64 = kept.iter().map(|p| plane.distance_mm(*p).powi(2)).sum();
        self.flatness.push(Flatness {
            position: position.into(),
            range_mm: high - low,
            sigma_mm: (squares / (kept.len() - 3) as f64).sqrt(),
            points: kept.len(),
            rejected,
            reaches_gate: low.abs().max(high) > REACH * gate_mm,
        });
        Ok(plane)
    }
}

fn points(scan: &Scan) -> Vec<DVec3> {
    scan.mesh.positions_mm.iter().map(|p| p.as_dvec3()).collect()
}

fn probe(position: &str, inliers: &[DVec3], standard: &Standard) -> Option<(Sphere, Probing)> {
    let first = Sphere::fit(inliers)?.sphere;
    let (kept, rejected) = without_worst(inliers, |p| first.distance_mm(p));
    let fit = Sphere::fit(&kept)?;
    let [low, high] = range_mm(kept.iter().map(|p| fit.sphere.distance_mm(*p)));
    let probing = Probing {
        position: position.into(),
        form_mm: high - low,
        size_mm: 2.0 * fit.sphere.radius_mm - standard.diameter_mm,
        sigma_mm: fit.sigma_mm,
        points: kept.len(),
        rejected,
        reaches_gate: low.abs().max(high) > REACH * standard.gate_mm,
    };
    Some((fit.sphere, probing))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use gv3_codec::mesh::TriMesh;

    fn scan(points: impl Iterator<Item = DVec3>) -> Scan {
        let mesh =
            TriMesh { positions_mm: points.map(|p| p.as_vec3()).collect::<Vec<Vec3>>(), triangles: vec![], uv: None };
        Scan { tick: 0, time_nanos: 0, mesh, texture: None }
    }

    /// The front of a ball with its left side swollen by `swell_mm`.
    fn ball(centre: DVec3, radius_mm: f64, swell_mm: f64) -> impl Iterator<Item = DVec3> {
        (0..4000).map(move |i| {
            let z = 1.0 - 0.6 * (f64::from(i) + 0.5) / 4000.0;
            let (ring, turn) = ((1.0 - z * z).sqrt(), f64::from(i) * 2.399_963_229_728_653);
            let normal = DVec3::new(ring * turn.cos(), ring * turn.sin(), z);
            centre + normal * (radius_mm + if normal.x < 0.0 { swell_mm } else { 0.0 })
        })
    }

    #[test]
    fn known_spheres_give_their_errors() {
        let standard = Standard { diameter_mm: 50.0, distance_mm: Some(100.0), gate_mm: 1.0 };
        let [a, b] = [DVec3::new(-50.0, 3.0, -600.0), DVec3::new(50.2, 3.0, -600.0)];
        let mut report = AccuracyReport::default();
        report.add_spheres("middle", &scan(ball(a, 25.05, 0.0).chain(ball(b, 25.0, 0.0))), &standard).unwrap();
        let report = report.summed_up();
        assert!((report.spacing[0].error_mm - 0.2).abs() < 1e-3, "{report:?}");
        let mut sizes: Vec<f64> = report.probing.iter().map(|p| p.size_mm).collect();
        sizes.sort_by(f64::total_cmp);
        assert!(sizes[0].abs() < 1e-3 && (sizes[1] - 0.1).abs() < 1e-3, "{sizes:?}");
        assert!((report.worst.size_mm.unwrap() - 0.1).abs() < 1e-3 && report.worst.form_mm.unwrap() < 1e-3);
        assert!(report.probing.iter().all(|p| p.rejected == 12 && p.points == 3988));
        let one = Standard { distance_mm: None, ..standard };
        let mut report = AccuracyReport::default();
        report.add_spheres("swollen", &scan(ball(a, 25.0, 0.1)), &one).unwrap();
        // A step of 0.1 mm: its mean is fitted away, the jump remains.
        assert!((0.07..0.13).contains(&report.probing[0].form_mm), "{report:?}");
        let error = report.add_spheres("lonely", &scan(ball(a, 25.0, 0.0)), &standard).unwrap_err();
        assert_eq!(error.to_string(), "lonely: two spheres of 50 mm not found, 1 of 2 are there");
    }

    #[test]
    fn a_known_plane_gives_its_error() {
        let points = (0..100 * 100).map(|i| {
            let (x, y) = (f64::from(i % 100), f64::from(i / 100));
            let bump = if i == 5050 { 2.0 } else { 0.015 * (x * std::f64::consts::PI * 0.5).sin() };
            DVec3::new(x, y, -600.0 + 0.1 * x - 0.05 * y + bump)
        });
        let mut report = AccuracyReport::default();
        let plane = report.add_plane("tilted", &scan(points), 1.0).unwrap();
        let expected = DVec3::new(-0.1, 0.05, 1.0).normalize();
        assert!(plane.normal.dot(expected) > 1.0 - 1e-9);
        // The lone spike is beyond the gate; the waves stay.
        let range = report.flatness[0].range_mm;
        assert!((range - 0.03 / (1.0f64 + 0.01 + 0.0025).sqrt()).abs() < 2.5e-3, "{range}");
        assert!(!report.flatness[0].reaches_gate);
        let wide = (0..100).map(|i| DVec3::new(f64::from(i % 10), f64::from(i / 10), 0.01 * f64::from(i % 3)));
        report.add_plane("cut", &scan(wide), 0.0105).unwrap();
        assert!(report.flatness[1].reaches_gate, "{report:?}");
        assert!(report.add_plane("nothing", &scan(std::iter::empty()), 1.0).is_err());
    }
}
