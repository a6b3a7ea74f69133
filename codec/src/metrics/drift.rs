//! Whether a tracked mesh keeps to the same points of the surface: drift against a truth with fixed connectivity.

use super::{ErrorHistogram, Share};
use crate::mesh::{Bvh, TriMesh};

/// Points of the truth farther than this from the replay when a shot begins are not followed, millimetres.
pub const ANCHOR_LIMIT_MM: f32 = 1.0;

/// Errors of followed points, scan by scan.
///
/// When a shot begins, each vertex of the truth is anchored to the nearest point of the replay: a triangle and weights.
/// As long as the replay keeps its triangles, the same triangle and weights say where the replay believes that vertex to
/// be; its error is the distance to where the truth has it. A face is folded when it looks away from the truth's face
/// that was nearest to it when the shot began and had its direction then.
#[derive(Debug, Clone, Default)]
pub struct Drift {
    shot: Option<Shot>,
    /// Shots so far.
    pub shots: u64,
    /// Element n: errors n scans after a shot began.
    pub by_age: Vec<ErrorHistogram>,
    /// Folded faces of the replay, over all scans but the first of each shot.
    pub folded: Share,
}

/// What holds from the first scan of a shot to its last.
#[derive(Debug, Clone)]
struct Shot {
    triangles: Vec<[u32; 3]>,
    anchors: Vec<Anchor>,
    /// Faces of the replay with the truth's face under them.
    faces: Vec<[u32; 2]>,
    age: usize,
}

/// A vertex of the truth on a face of the replay.
#[derive(Debug, Clone, Copy)]
struct Anchor {
    vertex: u32,
    face: u32,
    barycentric: [f32; 3],
}

impl Drift {
    /// Adds a scan, valid on both sides ([`TriMesh::validate`]); scans come in time order, and the truth has the same
    /// triangles in all of them.
    pub fn add(&mut self, truth: &TriMesh, replay: &TriMesh) {
        match &mut self.shot {
            Some(shot) if shot.triangles == replay.triangles => {
                shot.age += 1;
                for &[face, under] in &shot.faces {
                    self.folded.add(faces_away(replay, face, truth, under));
                }
            }
            _ => {
                self.shot = Some(Shot::begin(truth, replay));
                self.shots += 1;
            }
        }
        let Some(shot) = &self.shot else { return };
        if self.by_age.len() <= shot.age {
            self.by_age.resize_with(shot.age + 1, ErrorHistogram::default);
        }
        for anchor in &shot.anchors {
            let corners = replay.corners(anchor.face as usize);
            let point = corners[0] * anchor.barycentric[0]
                + corners[1] * anchor.barycentric[1]
                + corners[2] * anchor.barycentric[2];
            self.by_age[shot.age].add(f64::from(point.distance(truth.positions_mm[anchor.vertex as usize])));
        }
    }

    /// Errors of all scans but the first of each shot, where a point is where it was put.
    pub fn total(&self) -> ErrorHistogram {
        let mut total = ErrorHistogram::default();
        self.by_age.iter().skip(1).for_each(|h| total.merge(h));
        total
    }
}

impl Shot {
    fn begin(truth: &TriMesh, replay: &TriMesh) -> Self {
        let (surface, true_surface) = (Bvh::new(replay), Bvh::new(truth));
        let anchor = |(vertex, &p): (usize, &glam::Vec3)| {
            let nearest = surface.nearest(p, ANCHOR_LIMIT_MM)?;
            Some(Anchor { vertex: vertex as u32, face: nearest.triangle, barycentric: nearest.barycentric })
        };
        let under = |face: usize| {
            let centre = replay.corners(face).iter().sum::<glam::Vec3>() / 3.0;
            let nearest = true_surface.nearest(centre, ANCHOR_LIMIT_MM)?;
            let pair = [face as u32, nearest.triangle];
            (!faces_away(replay, pair[0], truth, pair[1])).then_some(pair)
        };
        Self {
            triangles: replay.triangles.clone(),
            anchors: truth.positions_mm.iter().enumerate().filter_map(anchor).collect(),
            faces: (0..replay.triangles.len()).filter_map(under).collect(),
            age: 0,
        }
    }
}

/// Whether two faces look to opposite sides.
fn faces_away(a: &TriMesh, face_a: u32, b: &TriMesh, face_b: u32) -> bool {
    a.area_normal(face_a as usize).dot(b.area_normal(face_b as usize)) < 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// A grid of n by n quads over the square of 30 mm.
    fn grid(n: u32) -> TriMesh {
        let at = |k: u32| 30.0 / n as f32 * k as f32;
        let quads = (0..n).flat_map(|j| (0..n).map(move |i| j * (n + 1) + i));
        TriMesh {
            positions_mm: (0..=n).flat_map(|j| (0..=n).map(move |i| Vec3::new(at(i), at(j), 0.0))).collect(),
            triangles: quads.flat_map(|a| [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]).collect(),
            uv: None,
        }
    }

    fn moved(mesh: &TriMesh, by: Vec3) -> TriMesh {
        TriMesh { positions_mm: mesh.positions_mm.iter().map(|&p| p + by).collect(), ..mesh.clone() }
    }

    #[test]
    fn sliding_along_the_surface_is_seen_and_a_new_connectivity_begins_anew() {
        let (truth, tracked) = (grid(20), grid(7));
        let mut drift = Drift::default();
        for n in 0..4 {
            drift.add(&truth, &moved(&tracked, Vec3::X * 0.25 * n as f32));
        }
        drift.add(&truth, &grid(6));
        assert_eq!((drift.shots, drift.by_age.len()), (2, 4));
        assert_eq!(drift.by_age[0].count(), 2 * 21 * 21);
        assert!(drift.by_age[0].summary().max < 1e-5);
        for n in 1..4 {
            let s = drift.by_age[n].summary();
            assert!((s.p95 - 0.25 * n as f64).abs() < 1e-3 && (s.rms - 0.25 * n as f64).abs() < 1e-4, "{s:?}");
        }
        assert_eq!(drift.folded, Share { count: 0, total: 3 * 2 * 49 });
        assert_eq!(drift.total().count(), 3 * 21 * 21);
    }

    #[test]
    fn a_true_motion_that_is_followed_is_no_drift() {
        let (truth, tracked) = (grid(12), grid(5));
        let turn = glam::Quat::from_rotation_y(1.2);
        let turned =
            |m: &TriMesh| TriMesh { positions_mm: m.positions_mm.iter().map(|&p| turn * p).collect(), ..m.clone() };
        let mut drift = Drift::default();
        drift.add(&truth, &tracked);
        drift.add(&turned(&truth), &turned(&tracked));
        assert!(drift.total().summary().max < 1e-4);
        assert_eq!(drift.folded.count, 0);
    }

    #[test]
    fn a_vertex_pulled_across_its_neighbours_folds_faces() {
        let (truth, tracked) = (grid(10), grid(10));
        let mut pulled = tracked.clone();
        // Vertex (5, 5) moved one and a half cells to the right, out of the ring of its six faces.
        pulled.positions_mm[5 * 11 + 5].x += 4.5;
        let mut drift = Drift::default();
        drift.add(&truth, &tracked);
        drift.add(&truth, &pulled);
        let folded = (0..200).filter(|&t| pulled.area_normal(t).z < 0.0).count() as u64;
        assert!(folded > 0);
        assert_eq!(drift.folded, Share { count: folded, total: 200 });
        assert_eq!(drift.total().summary().max, 4.5);
    }
}
