//! Totals of what was measured on one scan or on many.

use super::{ErrorHistogram, NormalError};

/// How replayed surfaces and textures differ from the scans: totals over one scan or over many.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Distortion {
    /// Scans compared.
    pub scans: u64,
    /// From every vertex of a scan to the replayed surface.
    pub scan_to_replay: ErrorHistogram,
    /// From points spread evenly over the replayed surface to the scan's.
    pub replay_to_scan: ErrorHistogram,
    /// As `scan_to_replay`, along the scan's normals.
    pub scan_to_replay_plane: PlaneError,
    /// As `replay_to_scan`, along the scan's normals.
    pub replay_to_scan_plane: PlaneError,
    /// Between the normals of the scan's vertices that are not missing and the replay's at the nearest points.
    pub normals: NormalError,
    /// Vertices of the scan farther than [`super::COVERAGE_LIMIT_MM`] from the replay.
    pub missing: Share,
    /// Points of the replay farther than [`super::COVERAGE_LIMIT_MM`] from the scan: its share of the replayed area.
    pub invented: Share,
    /// Grey levels at the vertices of a scan that are not missing.
    pub texture: TextureError,
    /// Diagonal of the scan's bounding box, of the largest scan if there are several, millimetres.
    pub diagonal_mm: f64,
}

/// A part of a whole, both counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Share {
    /// Elements that have the property.
    pub count: u64,
    /// All elements.
    pub total: u64,
}

/// Differences of grey levels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TextureError {
    /// Sum of the squared differences, squared grey levels.
    pub squared_sum: f64,
    /// Pixels compared.
    pub count: u64,
}

/// Point-to-plane distances: components of the offsets to the nearest points along the scan's normals.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PlaneError {
    /// Sum of the squared distances, mm².
    pub squared_sum_mm2: f64,
    /// Points compared.
    pub count: u64,
}

impl Distortion {
    /// Adds what `other` measured.
    pub fn merge(&mut self, other: &Self) {
        self.scans += other.scans;
        self.scan_to_replay.merge(&other.scan_to_replay);
        self.replay_to_scan.merge(&other.replay_to_scan);
        self.scan_to_replay_plane.merge(other.scan_to_replay_plane);
        self.replay_to_scan_plane.merge(other.replay_to_scan_plane);
        self.normals.merge(other.normals);
        self.missing.merge(other.missing);
        self.invented.merge(other.invented);
        self.texture.merge(other.texture);
        self.diagonal_mm = self.diagonal_mm.max(other.diagonal_mm);
    }

    /// D1, dB: PSNR of the distances to the nearest point, the worse of the two directions, with the diagonal of the
    /// scan's bounding box as peak. `None` when nothing was measured in one direction; infinite without any error.
    ///
    /// D. Tian et al., "Geometric distortion metrics for point cloud compression", ICIP 2017, with distances to the
    /// surface in place of distances to the points of a sampling, as both sides are meshes. On a coordinate cube of
    /// side p, their 3p² is the squared diagonal.
    pub fn d1_psnr_db(&self) -> Option<f64> {
        let worse = self.scan_to_replay.mean_square_mm2()?.max(self.replay_to_scan.mean_square_mm2()?);
        Some(psnr_db(self.diagonal_mm, worse))
    }

    /// D2, dB: as [`Self::d1_psnr_db`], of the distances along the scan's normals.
    pub fn d2_psnr_db(&self) -> Option<f64> {
        let worse = self.scan_to_replay_plane.mean_square_mm2()?.max(self.replay_to_scan_plane.mean_square_mm2()?);
        Some(psnr_db(self.diagonal_mm, worse))
    }
}

impl Share {
    /// Counts one element.
    #[inline]
    pub fn add(&mut self, has_property: bool) {
        self.count += u64::from(has_property);
        self.total += 1;
    }

    /// Counts everything that `other` counted.
    pub fn merge(&mut self, other: Self) {
        self.count += other.count;
        self.total += other.total;
    }

    /// The part of the whole, 0..=1; 0 of nothing.
    pub fn fraction(&self) -> f64 {
        self.count as f64 / self.total.max(1) as f64
    }
}

impl TextureError {
    /// Counts one difference, grey levels.
    #[inline]
    pub fn add(&mut self, difference: f64) {
        self.squared_sum += difference * difference;
        self.count += 1;
    }

    /// Counts everything that `other` counted.
    pub fn merge(&mut self, other: Self) {
        self.squared_sum += other.squared_sum;
        self.count += other.count;
    }

    /// Peak signal-to-noise ratio, dB, of 8-bit grey levels (peak 255): `None` when nothing was compared, infinite
    /// without any difference.
    pub fn psnr_db(&self) -> Option<f64> {
        (self.count > 0).then(|| psnr_db(255.0, self.squared_sum / self.count as f64))
    }
}

impl PlaneError {
    /// Counts one squared distance, mm².
    #[inline]
    pub fn add(&mut self, squared_mm2: f64) {
        self.squared_sum_mm2 += squared_mm2;
        self.count += 1;
    }

    /// Counts everything that `other` counted.
    pub fn merge(&mut self, other: Self) {
        self.squared_sum_mm2 += other.squared_sum_mm2;
        self.count += other.count;
    }

    /// Mean of the squared distances, mm²; `None` when there are none.
    pub fn mean_square_mm2(&self) -> Option<f64> {
        (self.count > 0).then(|| self.squared_sum_mm2 / self.count as f64)
    }
}

/// Peak signal-to-noise ratio, dB; infinite without error.
fn psnr_db(peak: f64, mean_square: f64) -> f64 {
    if mean_square > 0.0 { 10.0 * libm::log10(peak * peak / mean_square) } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_of_known_differences() {
        let mut texture = TextureError::default();
        assert_eq!(texture.psnr_db(), None);
        texture.add(0.0);
        assert_eq!(texture.psnr_db(), Some(f64::INFINITY));
        texture.add(255.0 * 2f64.sqrt());
        assert!(texture.psnr_db().unwrap().abs() < 1e-9);
    }

    #[test]
    fn d1_and_d2_take_the_worse_direction() {
        let mut d = Distortion { diagonal_mm: 100.0, ..Distortion::default() };
        d.scan_to_replay.add(1.0);
        d.scan_to_replay_plane.add(0.01);
        assert_eq!((d.d1_psnr_db(), d.d2_psnr_db()), (None, None));
        d.replay_to_scan.add(0.5);
        d.replay_to_scan_plane.add(0.0001);
        assert!((d.d1_psnr_db().unwrap() - 40.0).abs() < 1e-9);
        assert!((d.d2_psnr_db().unwrap() - 60.0).abs() < 1e-9);
    }

    #[test]
    fn a_share_of_nothing_is_zero() {
        let mut share = Share::default();
        assert_eq!(share.fraction(), 0.0);
        [true, false, false, false].into_iter().for_each(|x| share.add(x));
        assert_eq!(share.fraction(), 0.25);
    }
}
