//! Matching function from disk to disk: the best Möbius transformation, then a thin plate through the landmarks.

use super::disk::signed_area;
use super::mobius::Mobius;
use super::thin_plate::ThinPlate;
use glam::DVec2;

/// Smoothing of the thin plate: landmarks carry a few hundredths of a radius of noise, borders slip.
const SMOOTHING: f64 = 1e-3;

/// Each retry on folds smooths this much more.
const STIFFER: f64 = 30.0;

/// f = plate o M from one disk to another.
#[derive(Debug, Clone)]
pub struct DiskMatch {
    mobius: Mobius,
    plate: Option<ThinPlate>,
    /// Triangles of the source disk that f turns over.
    pub folds: usize,
}

impl DiskMatch {
    /// Matches `from` landmarks to `to` landmarks. `points`, `triangles` are the source disk: when the warp folds it,
    /// it is smoothed more, and in the end left out.
    pub fn fit(from: &[DVec2], to: &[DVec2], points: &[DVec2], triangles: &[[u32; 3]]) -> Self {
        let mobius = Mobius::fit(from, to);
        let moved: Vec<DVec2> = from.iter().map(|&z| mobius.apply(z)).collect();
        let mut best = Self { mobius, plate: None, folds: 0 };
        best.folds = best.count_folds(points, triangles);
        let allowed = best.folds;
        let mut smoothing = SMOOTHING;
        for _ in 0..4 {
            let Ok(plate) = ThinPlate::fit(&moved, to, smoothing) else { break };
            let mut candidate = Self { mobius, plate: Some(plate), folds: 0 };
            candidate.folds = candidate.count_folds(points, triangles);
            if candidate.folds <= allowed {
                return candidate;
            }
            smoothing *= STIFFER;
        }
        best
    }

    /// Image of a point of the source disk; may lie outside the unit disk, where the other scan saw nothing.
    pub fn apply(&self, z: DVec2) -> DVec2 {
        let z = self.mobius.apply(z);
        self.plate.as_ref().map_or(z, |p| p.apply(z))
    }

    fn count_folds(&self, points: &[DVec2], triangles: &[[u32; 3]]) -> usize {
        let image: Vec<DVec2> = points.iter().map(|&z| self.apply(z)).collect();
        triangles.iter().filter(|t| signed_area(&image, **t) <= 0.0 && signed_area(points, **t) > 0.0).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spiral(n: u32) -> Vec<DVec2> {
        (0..n).map(|k| DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / f64::from(n)).sqrt() * 0.95).collect()
    }

    #[test]
    fn recovers_a_smooth_map_between_landmarks() {
        let m = Mobius { rotation: DVec2::from_angle(0.1), centre: DVec2::new(0.1, -0.05) };
        let f = |z: DVec2| m.apply(z) + DVec2::new((2.0 * z.y).sin(), (1.5 * z.x).cos()) * 0.03;
        let from = spiral(120);
        let to: Vec<DVec2> = from.iter().map(|&z| f(z)).collect();
        let matching = DiskMatch::fit(&from, &to, &from, &[]);
        let worst = spiral(77).iter().map(|&z| matching.apply(z).distance(f(z))).fold(0.0, f64::max);
        assert!(worst < 5e-3, "{worst}");
    }

    #[test]
    fn contradicting_landmarks_do_not_fold() {
        let points = spiral(40);
        let triangles = [[1, 4, 2], [5, 9, 7]];
        let mut to = points.clone();
        to.swap(3, 30);
        to.swap(8, 22);
        let before = triangles.iter().filter(|t| signed_area(&points, **t) > 0.0).count();
        let matching = DiskMatch::fit(&points, &to, &points, &triangles);
        assert!(before > 0);
        assert_eq!(matching.folds, 0);
    }

    #[test]
    fn without_landmarks_it_is_the_identity() {
        let z = DVec2::new(0.3, 0.4);
        assert_eq!(DiskMatch::fit(&[], &[], &[], &[]).apply(z), z);
    }
}
