//! Matching function from disk to disk: the best Möbius transformation, then a warp through the landmarks.

use super::beltrami::{self, Tie};
use super::clamped_plate::ClampedPlate;
use super::disk::signed_area;
use super::grid_plate::{GridPlate, GridPlateOptions};
use super::locate::DiskLocator;
use super::mobius::Mobius;
use super::thin_plate::ThinPlate;
use crate::mesh::HalfEdges;
use crate::{CodecError, Result};
use glam::DVec2;

/// Smoothing of the thin plate: landmarks carry a few hundredths of a radius of noise, borders slip.
const SMOOTHING: f64 = 1e-3;

/// Each retry on folds smooths this much more.
const STIFFER: f64 = 30.0;

/// Most steps in which landmarks are carried along.
const MOST_STEPS: usize = 64;

/// What warps the disk after Möbius.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum WarpKind {
    /// Nothing.
    Mobius,
    /// For scans, whose border slips: smoothed thin plate, border free. On folds it is smoothed more, in the end left out.
    #[default]
    ThinPlate,
    /// For borders that are material lines: landmarks met exactly, circle kept. On folds landmarks are carried along in
    /// steps, then a linear Beltrami solver takes over.
    ClampedPlate,
    /// The published warp, for reference: folds are counted and left.
    GridPlate(GridPlateOptions),
}

/// A disk to be matched: one point a vertex, |z| <= 1, and the triangles of its mesh.
#[derive(Debug, Clone, Copy)]
pub struct SourceDisk<'a> {
    /// Points.
    pub points: &'a [DVec2],
    /// Triangles.
    pub triangles: &'a [[u32; 3]],
}

#[derive(Debug, Clone)]
enum Warp {
    Identity,
    Thin(ThinPlate),
    /// One after another.
    Clamped(Vec<ClampedPlate>),
    Grid(GridPlate),
    Linear(Box<PiecewiseLinear>),
}

impl Warp {
    fn apply(&self, z: DVec2) -> DVec2 {
        match self {
            Self::Identity => z,
            Self::Thin(plate) => plate.apply(z),
            Self::Clamped(steps) => steps.iter().fold(z, |z, plate| plate.apply(z)),
            Self::Grid(plate) => plate.apply(z),
            Self::Linear(map) => map.apply(z),
        }
    }

    fn images(&self, points: &[DVec2]) -> Vec<DVec2> {
        match self {
            Self::Thin(plate) => plate.images(points),
            Self::Clamped(steps) => steps.iter().fold(points.to_vec(), |points, plate| plate.images(&points)),
            Self::Identity | Self::Grid(_) | Self::Linear(_) => points.iter().map(|&z| self.apply(z)).collect(),
        }
    }
}

/// A map given at the vertices of a triangulation.
#[derive(Debug, Clone)]
struct PiecewiseLinear {
    points: Vec<DVec2>,
    images: Vec<DVec2>,
    triangles: Vec<[u32; 3]>,
    locator: DiskLocator,
}

impl PiecewiseLinear {
    fn apply(&self, z: DVec2) -> DVec2 {
        let Some(place) = self.locator.locate(&self.points, &self.triangles, z) else { return z };
        let corners = self.triangles[place.triangle as usize];
        let at = |values: &[DVec2]| -> DVec2 {
            corners.iter().zip(place.barycentric).map(|(&v, w)| values[v as usize] * f64::from(w)).sum()
        };
        // Displaced rather than replaced: slivers between chords and circle keep their width.
        z + at(&self.images) - at(&self.points)
    }
}

/// f = warp o M from one disk to another.
#[derive(Debug, Clone)]
pub struct DiskMatch {
    mobius: Mobius,
    warp: Warp,
    /// Triangles of the source disk that f turns over.
    pub folds: usize,
}

impl DiskMatch {
    /// Matches `from` landmarks to `to` landmarks; landmarks that a warp cannot be fitted to (too few, coincident) are
    /// matched by Möbius alone. The points of `source` serve to find folds.
    pub fn fit(from: &[DVec2], to: &[DVec2], source: SourceDisk<'_>, kind: &WarpKind) -> Self {
        let mobius = Mobius::fit(from, to);
        let problem = Problem {
            from: from.iter().map(|&z| mobius.apply(z)).collect(),
            to: to.to_vec(),
            points: source.points.iter().map(|&z| mobius.apply(z)).collect(),
            source,
        };
        let allowed = problem.folds(&problem.points);
        let warp = match kind {
            WarpKind::Mobius => None,
            WarpKind::ThinPlate => problem.thin_plate(allowed),
            WarpKind::ClampedPlate => problem.clamped_plate(allowed),
            WarpKind::GridPlate(options) => GridPlate::fit(&problem.from, to, options).ok().map(|plate| {
                let warp = Warp::Grid(plate);
                let folds = problem.folds_of(&warp);
                (warp, folds)
            }),
        };
        let (warp, folds) = warp.unwrap_or((Warp::Identity, allowed));
        Self { mobius, warp, folds }
    }

    /// Image of a point of the source disk; may lie outside the unit disk, where the other scan saw nothing.
    pub fn apply(&self, z: DVec2) -> DVec2 {
        self.warp.apply(self.mobius.apply(z))
    }

    /// Images of many points, as [`Self::apply`] gives them, in half the time.
    pub fn images(&self, points: &[DVec2]) -> Vec<DVec2> {
        let points: Vec<DVec2> = points.iter().map(|&z| self.mobius.apply(z)).collect();
        self.warp.images(&points)
    }

    /// The transformation before the warp.
    pub fn mobius(&self) -> Mobius {
        self.mobius
    }
}

/// Landmarks and source disk after Möbius.
struct Problem<'a> {
    from: Vec<DVec2>,
    to: Vec<DVec2>,
    points: Vec<DVec2>,
    source: SourceDisk<'a>,
}

impl Problem<'_> {
    /// Triangles upright in the source that are not so in `images`.
    fn folds(&self, images: &[DVec2]) -> usize {
        let SourceDisk { points, triangles } = self.source;
        triangles.iter().filter(|t| signed_area(images, **t) <= 0.0 && signed_area(points, **t) > 0.0).count()
    }

    fn folds_of(&self, warp: &Warp) -> usize {
        self.folds(&warp.images(&self.points))
    }

    fn thin_plate(&self, allowed: usize) -> Option<(Warp, usize)> {
        let mut smoothing = SMOOTHING;
        for _ in 0..4 {
            let warp = Warp::Thin(ThinPlate::fit(&self.from, &self.to, smoothing).ok()?);
            let folds = self.folds_of(&warp);
            if folds <= allowed {
                return Some((warp, folds));
            }
            smoothing *= STIFFER;
        }
        None
    }

    fn clamped_plate(&self, allowed: usize) -> Option<(Warp, usize)> {
        let once = Warp::Clamped(vec![ClampedPlate::fit(&self.from, &self.to).ok()?]);
        let images = once.images(&self.points);
        let folds = self.folds(&images);
        if folds <= allowed {
            return Some((once, folds));
        }
        let mut steps = 2;
        while steps <= MOST_STEPS {
            let Ok(plates) = self.carried(steps) else { break };
            let flow = Warp::Clamped(plates);
            let folds = self.folds_of(&flow);
            if folds <= allowed {
                return Some((flow, folds));
            }
            steps *= 2;
        }
        let linear = self.unfolded(images).ok()??;
        let folds = self.folds(&linear.images);
        (folds <= allowed).then(|| (Warp::Linear(Box::new(linear)), folds))
    }

    /// Carries the landmarks along straight paths in equal steps, a plate for each.
    fn carried(&self, steps: usize) -> Result<Vec<ClampedPlate>> {
        let at = |k: usize| -> Vec<DVec2> {
            let share = k as f64 / steps as f64;
            self.from.iter().zip(&self.to).map(|(p, q)| p.lerp(*q, share)).collect()
        };
        (0..steps).map(|k| ClampedPlate::fit(&at(k), &at(k + 1))).collect()
    }

    /// The map that folds, with its Beltrami coefficient cut, the border held and the landmarks tied to their images.
    fn unfolded(&self, images: Vec<DVec2>) -> Result<Option<PiecewiseLinear>> {
        let triangles = self.source.triangles;
        let edges = HalfEdges::build(self.points.len(), triangles)?;
        // A vertex without triangles belongs to no equation.
        let held: Vec<bool> = (0..self.points.len() as u32)
            .map(|v| edges.is_boundary_vertex(v) || edges.neighbours(v).next().is_none())
            .collect();
        let locator = DiskLocator::new(&self.points, triangles);
        let tie = |(p, q): (&DVec2, &DVec2)| {
            let place = locator.locate(&self.points, triangles, *p)?;
            Some(Tie { place, image: *q })
        };
        let Some(ties) = self.from.iter().zip(&self.to).map(tie).collect::<Option<Vec<Tie>>>() else {
            return Err(CodecError::Mesh("the source disk has no upright triangle".into()));
        };
        let unfolded = beltrami::unfold(&self.points, triangles, &images, &held, &ties)?;
        Ok(unfolded.map(|images| PiecewiseLinear {
            points: self.points.clone(),
            images,
            triangles: triangles.to_vec(),
            locator,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const NOTHING: SourceDisk<'static> = SourceDisk { points: &[], triangles: &[] };

    fn spiral(n: u32) -> Vec<DVec2> {
        (0..n).map(|k| DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / f64::from(n)).sqrt() * 0.95).collect()
    }

    /// Rings of `k` times 8 points and the triangles between them.
    fn rings(count: u32) -> (Vec<DVec2>, Vec<[u32; 3]>) {
        let around = 8 * count;
        let mut points = vec![DVec2::ZERO];
        for k in 1..=count {
            let at = |j: u32| DVec2::from_angle(std::f64::consts::TAU * f64::from(j) / f64::from(around));
            points.extend((0..around).map(|j| at(j) * f64::from(k) / f64::from(count)));
        }
        let vertex = |k: u32, j: u32| 1 + (k - 1) * around + j % around;
        let mut triangles: Vec<[u32; 3]> = (0..around).map(|j| [0, vertex(1, j), vertex(1, j + 1)]).collect();
        for k in 1..count {
            for j in 0..around {
                let [a, b, c, d] = [vertex(k, j), vertex(k + 1, j), vertex(k + 1, j + 1), vertex(k, j + 1)];
                triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        (points, triangles)
    }

    #[test]
    fn recovers_a_smooth_map_between_landmarks() {
        let m = Mobius { rotation: DVec2::from_angle(0.1), centre: DVec2::new(0.1, -0.05) };
        let f = |z: DVec2| m.apply(z) + DVec2::new((2.0 * z.y).sin(), (1.5 * z.x).cos()) * 0.03;
        let from = spiral(120);
        let to: Vec<DVec2> = from.iter().map(|&z| f(z)).collect();
        let source = SourceDisk { points: &from, triangles: &[] };
        let matching = DiskMatch::fit(&from, &to, source, &WarpKind::ThinPlate);
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
        let source = SourceDisk { points: &points, triangles: &triangles };
        let matching = DiskMatch::fit(&points, &to, source, &WarpKind::ThinPlate);
        assert!(before > 0);
        assert_eq!(matching.folds, 0);
    }

    #[test]
    fn without_landmarks_every_warp_but_the_published_is_the_identity() {
        let z = DVec2::new(0.3, 0.4);
        for kind in [WarpKind::Mobius, WarpKind::ThinPlate, WarpKind::ClampedPlate] {
            assert_eq!(DiskMatch::fit(&[], &[], NOTHING, &kind).apply(z), z);
        }
    }

    #[test]
    fn large_moves_fold_one_plate_and_are_carried_along_in_steps() {
        let (points, triangles) = rings(16);
        // One plate moves its pole by d and folds for d > e/4, where its steepest slope 4/e reaches 1/d.
        let (from, to) = (vec![DVec2::ZERO, DVec2::NEG_X * 0.7], vec![DVec2::X * 0.75, DVec2::NEG_X * 0.7]);
        let problem = Problem {
            from: from.clone(),
            to: to.clone(),
            points: points.clone(),
            source: SourceDisk { points: &points, triangles: &triangles },
        };
        let once = Warp::Clamped(vec![ClampedPlate::fit(&from, &to).unwrap()]);
        assert!(problem.folds_of(&once) > 0, "the case is too easy");
        let (warp, folds) = problem.clamped_plate(0).unwrap();
        assert!(matches!(&warp, Warp::Clamped(steps) if steps.len() > 1));
        assert_eq!(folds, 0);
        for (p, q) in from.iter().zip(&to) {
            assert!(warp.apply(*p).distance(*q) < 1e-9);
        }
    }

    #[test]
    fn landmarks_that_cross_are_left_to_the_beltrami_solver_or_to_mobius() {
        let (points, triangles) = rings(16);
        let mut from = spiral(24);
        from.extend([DVec2::new(0.30, 0.3), DVec2::new(0.36, 0.3)]);
        let mut to = from.clone();
        // Two neighbours pass through each other: no straight path avoids the meeting.
        to.swap(24, 25);
        let source = SourceDisk { points: &points, triangles: &triangles };
        let matching = DiskMatch::fit(&from, &to, source, &WarpKind::ClampedPlate);
        assert_eq!(matching.folds, 0);
        let circle = (0..40).map(|k| DVec2::from_angle(f64::from(k)));
        assert!(circle.into_iter().all(|z| (matching.apply(z).length() - 1.0).abs() < 1e-2));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        /// Whatever the landmarks, the clamped plate never folds the source and never leaves the disk.
        #[test]
        fn clamped_plate_is_always_a_homeomorphism(shift in prop::collection::vec((-0.2..0.2f64, -0.2..0.2f64), 12)) {
            let (points, triangles) = rings(12);
            let from: Vec<DVec2> = spiral(12).iter().map(|z| *z * 0.8).collect();
            let to: Vec<DVec2> = from.iter().zip(&shift).map(|(p, d)| *p + DVec2::new(d.0, d.1)).collect();
            let source = SourceDisk { points: &points, triangles: &triangles };
            let matching = DiskMatch::fit(&from, &to, source, &WarpKind::ClampedPlate);
            prop_assert_eq!(matching.folds, 0);
            prop_assert!(points.iter().all(|&z| matching.apply(z).length() < 1.0 + 1e-9));
        }
    }
}
