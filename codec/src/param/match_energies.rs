//! What a matching function leaves: the energies of the published scheme, before and after the warp.

use super::conformal_factors;
use super::disk::signed_area;
use super::locate::{DiskLocator, Place};
use crate::mesh::TriMesh;
use glam::{DVec2, DVec3};

/// A surface with its disk map.
#[derive(Debug, Clone, Copy)]
pub struct MappedSurface<'a> {
    /// The surface.
    pub mesh: &'a TriMesh,
    /// Its disk map, one point a vertex.
    pub points: &'a [DVec2],
    /// Point location on that map.
    pub locator: &'a DiskLocator,
}

impl MappedSurface<'_> {
    /// Point of the surface at a point of the disk, mm; the nearest one outside. `None` for a map without upright triangle.
    pub fn at(&self, z: DVec2) -> Option<DVec3> {
        let place = self.locator.locate(self.points, &self.mesh.triangles, z)?;
        Some(self.mean(place, |v| self.mesh.positions_mm[v].as_dvec3()))
    }

    fn mean<T>(&self, place: Place, value: impl Fn(usize) -> T) -> T
    where
        T: std::ops::Mul<f64, Output = T> + std::ops::Add<Output = T>,
    {
        let [a, b, c] = self.mesh.triangles[place.triangle as usize].map(|v| value(v as usize));
        let [x, y, z] = place.barycentric.map(f64::from);
        a * x + b * y + c * z
    }
}

/// Energies of a matching function f from disk a to disk b with landmarks p_i -> q_i (Yueh, Gu, Lin, Wu, Yau).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchEnergies {
    /// E_D = sum_i (lambda_b(q_i) / lambda_a(p_i)) |f(p_i) - q_i|^2 on the disk, no unit.
    pub conformal: f64,
    /// E_loc = sum_i |S_b(f(p_i)) - S_b(q_i)|^2 in space, mm^2.
    pub local_mm2: f64,
    /// E = integral over the unit disk of |S_a(x) - S_b(f(x))|^2 dx, mm^2 (the disk has no unit).
    pub global_mm2: f64,
}

impl MatchEnergies {
    /// Energies of `f`; the integral by the trapezoid rule on the triangles of `a`. Landmarks that lie on no triangle count
    /// nothing.
    pub fn of(
        f: impl Fn(DVec2) -> DVec2,
        a: MappedSurface<'_>,
        b: MappedSurface<'_>,
        landmarks: &[(DVec2, DVec2)],
    ) -> Self {
        let (mut conformal, mut local_mm2) = (0.0, 0.0);
        let (factor_a, factor_b) = (conformal_factors(a.mesh, a.points), conformal_factors(b.mesh, b.points));
        for &(p, q) in landmarks {
            let image = f(p);
            let factor = |s: MappedSurface<'_>, factors: &[f64], z: DVec2| {
                s.locator.locate(s.points, &s.mesh.triangles, z).map(|place| s.mean(place, |v| factors[v]))
            };
            if let (Some(here), Some(there)) = (factor(a, &factor_a, p), factor(b, &factor_b, q)) {
                conformal += there / here * image.distance_squared(q);
            }
            if let (Some(found), Some(wanted)) = (b.at(image), b.at(q)) {
                local_mm2 += found.distance_squared(wanted);
            }
        }
        let apart = |v: usize| {
            let here = a.mesh.positions_mm[v].as_dvec3();
            b.at(f(a.points[v])).map_or(0.0, |there| there.distance_squared(here))
        };
        let apart_mm2: Vec<f64> = (0..a.points.len()).map(apart).collect();
        let over = |t: &[u32; 3]| {
            let sum: f64 = t.iter().map(|&v| apart_mm2[v as usize]).sum();
            signed_area(a.points, *t).max(0.0) * sum / 6.0
        };
        Self { conformal, local_mm2, global_mm2: a.mesh.triangles.iter().map(over).sum() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::test_surfaces::polar_disk;
    use std::f64::consts::PI;

    #[test]
    fn energies_of_shifted_and_scaled_plates_are_known() {
        let (points, triangles) = polar_disk(40);
        let plate = |scale: f64, lift: f64| TriMesh {
            positions_mm: points.iter().map(|z| (*z * scale).extend(lift).as_vec3()).collect(),
            triangles: triangles.clone(),
            uv: None,
        };
        let (one, two) = (plate(50.0, 0.0), plate(100.0, 3.0));
        let locator = DiskLocator::new(&points, &triangles);
        let surface = |mesh| MappedSurface { mesh, points: &points, locator: &locator };
        let pairs = [(DVec2::new(0.1, 0.2), DVec2::new(0.4, 0.2)), (DVec2::ZERO, DVec2::ZERO)];
        let energies = MatchEnergies::of(|z| z, surface(&one), surface(&two), &pairs);
        assert!((energies.conformal - 2.0 * 0.09).abs() < 1e-4, "{energies:?}");
        assert!((energies.local_mm2 - 900.0).abs() < 0.1, "{energies:?}");
        // |50 z|^2 + 9 over the disk.
        let wanted = 2500.0 * PI / 2.0 + 9.0 * PI;
        assert!((energies.global_mm2 / wanted - 1.0).abs() < 5e-3, "{energies:?} {wanted}");
        let none = MatchEnergies::of(|z| z, surface(&one), surface(&one), &[]);
        assert!(none.conformal == 0.0 && none.local_mm2 == 0.0 && none.global_mm2 < 1e-6);
    }
}
