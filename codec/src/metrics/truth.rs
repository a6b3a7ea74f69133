//! Scan and replay against the surface that both are pictures of.

use super::{AreaSamples, COVERAGE_LIMIT_MM, ErrorHistogram, Share};
use crate::mesh::{Bvh, TriMesh};

/// How far scans and replays are from the truth: totals over one scan or over many.
///
/// A scan carries the scanner's noise, so a replay that averages over time or space can be nearer to the truth than the
/// scan it was made from.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TruthComparison {
    /// From points spread evenly over the scan to the truth.
    pub scan_to_truth: ErrorHistogram,
    /// From points spread evenly over the replay to the truth.
    pub replay_to_truth: ErrorHistogram,
    /// Vertices of the truth, where the scan reaches them, to which the replay is nearer than the scan.
    pub closer: Share,
}

impl TruthComparison {
    /// Compares one scan; all meshes are valid ([`TriMesh::validate`]). As many samples are taken of the scan and of the
    /// replay as the truth has vertices.
    ///
    /// The scan reaches a vertex that is no farther than [`COVERAGE_LIMIT_MM`] from it.
    pub fn new(truth: &TriMesh, scan: &TriMesh, replay: &TriMesh) -> Self {
        let surface = Bvh::new(truth);
        let samples = truth.vertex_count() as u32;
        let (scan_surface, replay_surface) = (Bvh::new(scan), Bvh::new(replay));
        let mut closer = Share::default();
        for &p in &truth.positions_mm {
            let Some(of_scan) = scan_surface.nearest(p, COVERAGE_LIMIT_MM) else { continue };
            // Nearer than the scan, or none.
            closer.add(replay_surface.nearest(p, of_scan.distance2_mm2.sqrt()).is_some());
        }
        Self {
            scan_to_truth: distances(scan, &surface, samples),
            replay_to_truth: distances(replay, &surface, samples),
            closer,
        }
    }

    /// Adds what `other` measured.
    pub fn merge(&mut self, other: &Self) {
        self.scan_to_truth.merge(&other.scan_to_truth);
        self.replay_to_truth.merge(&other.replay_to_truth);
        self.closer.merge(other.closer);
    }
}

/// Distances of `samples` points spread over a mesh.
fn distances(mesh: &TriMesh, truth: &Bvh, samples: u32) -> ErrorHistogram {
    let mut histogram = ErrorHistogram::default();
    for sample in AreaSamples::new(mesh, samples) {
        if let Some(nearest) = truth.nearest(sample.point_mm, f32::INFINITY) {
            histogram.add(f64::from(nearest.distance2_mm2).sqrt());
        }
    }
    histogram
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// A grid of n by n quads over the square of 40 mm at a height.
    fn plane(n: u32, height_mm: impl Fn(f32) -> f32) -> TriMesh {
        let at = |k: u32| 40.0 / n as f32 * k as f32;
        let quads = (0..n).flat_map(|j| (0..n).map(move |i| j * (n + 1) + i));
        TriMesh {
            positions_mm: (0..=n)
                .flat_map(|j| (0..=n).map(move |i| (i, j)))
                .map(|(i, j)| Vec3::new(at(i), at(j), height_mm(at(i))))
                .collect(),
            triangles: quads.flat_map(|a| [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]).collect(),
            uv: None,
        }
    }

    #[test]
    fn offsets_are_found_and_the_nearer_side_counts() {
        let truth = plane(40, |_| 0.0);
        let t = TruthComparison::new(&truth, &plane(30, |_| 0.5), &plane(9, |_| 0.25));
        assert_eq!((t.scan_to_truth.summary().rms, t.scan_to_truth.summary().max), (0.5, 0.5));
        assert_eq!((t.replay_to_truth.summary().rms, t.replay_to_truth.count()), (0.25, 41 * 41));
        assert_eq!(t.closer, Share { count: 41 * 41, total: 41 * 41 });
        // Nearer than the scan on the left half only: |x/20 mm| < 0.5 mm before 10 mm, a quarter of the columns.
        let wedge = TruthComparison::new(&truth, &plane(40, |_| 0.5), &plane(40, |x| 0.05 * x));
        assert!((wedge.closer.fraction() - 10.0 / 40.0).abs() < 0.03, "{:?}", wedge.closer);
        let mut both = t.clone();
        both.merge(&wedge);
        assert_eq!(both.closer.total, 2 * 41 * 41);
        assert_eq!(both.scan_to_truth.summary().rms, 0.5);
    }

    #[test]
    fn what_the_scan_did_not_see_does_not_count_and_a_hole_in_the_replay_is_not_closer() {
        let (truth, far, none) = (plane(10, |_| 0.0), plane(10, |_| 3.0), TriMesh::default());
        assert_eq!(TruthComparison::new(&truth, &far, &truth).closer.total, 0);
        assert_eq!(TruthComparison::new(&truth, &truth, &none).closer, Share { count: 0, total: 121 });
    }
}
