//! Landmarks of the encoder: tracked from scan to scan, placed on the keyframes as the decoder will see them.

use super::group::LandmarkPair;
use crate::mesh::{Bvh, TriMesh};
use crate::motion::{FeatureFrame, PixelMap, Tracker, TrackerOptions, consistent};
use crate::param::locate::Place;
use crate::{Result, Scan};
use glam::Vec3;
use std::collections::BTreeMap;

/// Landmarks kept a keyframe: more do not improve the matching, and the thin plate costs their cube.
const MOST_LANDMARKS: usize = 256;

/// A landmark farther than this from the decimated surface is not on it, mm.
const MAX_OFFSET_MM: f32 = 1.0;

/// Matches that their neighbours contradict by more than this are dropped, mm.
const MAX_INCONSISTENCY_MM: f32 = 1.0;

/// A given landmark farther than this from the decoded keyframe is not on it, mm: hand placement and decimation together.
pub const MAX_GIVEN_OFFSET_MM: f32 = 5.0;

/// A given landmark speaks for the skin this near to it, mm; tracked ones there are left out.
const GIVEN_REACH_MM: f32 = 5.0;

/// A landmark of a scan that a person or another program placed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GivenLandmark {
    /// Stands for the same point of the skin in all scans of a run.
    pub id: u32,
    /// Where it lies in the scan's frame.
    pub position_mm: Vec3,
}

/// What became of the landmarks given for a keyframe.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GivenCounts {
    /// Given for its scan.
    pub given: usize,
    /// Of these, left out: farther than [`MAX_GIVEN_OFFSET_MM`] from the decoded surface, or not finite.
    pub off_surface: usize,
    /// Of these, used: on the keyframe before as well.
    pub paired: usize,
}

/// Landmarks on a keyframe: their place, and the position that was placed there.
type Placed = BTreeMap<u32, (Place, Vec3)>;

/// Pairs with the positions (mm) before and here.
type Shared = Vec<(LandmarkPair, Vec3, Vec3)>;

/// Follows landmarks over a run and remembers where they lay on the last keyframe.
#[derive(Default)]
pub struct LandmarkTrail {
    tracker: Tracker,
    frame: Option<FeatureFrame>,
    at_key: Placed,
    given_at_key: Placed,
}

impl LandmarkTrail {
    /// Follows the landmarks into the next scan.
    ///
    /// # Errors
    /// [`crate::CodecError::Mesh`] when the scan cannot be drawn.
    pub fn feed(&mut self, scan: &Scan, is_key: bool) -> Result<()> {
        match (&scan.texture, &scan.mesh.uv) {
            (Some(picture), Some(_)) => {
                let map = PixelMap::new(&scan.mesh, picture.width_px, picture.height_px)?;
                self.tracker.feed(picture, &map.mask(), is_key);
            }
            _ => {
                let view = self.feature_frame(scan)?.view(&scan.mesh)?;
                self.tracker.feed_normalized(&view.relief, &view.mask, is_key);
            }
        }
        Ok(())
    }

    /// The same frame for the whole run, so that relief pictures of different scans compare.
    fn feature_frame(&mut self, scan: &Scan) -> Result<FeatureFrame> {
        match &self.frame {
            Some(frame) => Ok(*frame),
            None => {
                self.tracker = Tracker::new(TrackerOptions::relief());
                Ok(*self.frame.insert(FeatureFrame::about(&scan.mesh)?))
            }
        }
    }

    /// Where the landmarks lie on the scan fed last, in space.
    fn lift(&mut self, scan: &Scan) -> Result<Vec<(u32, Vec3)>> {
        let lift_all = |tracker: &Tracker, map: &PixelMap<'_>| -> Vec<(u32, Vec3)> {
            tracker.tracks().iter().filter_map(|t| Some((t.id, map.lift(t.px)?.position_mm))).collect()
        };
        match (&scan.texture, &scan.mesh.uv) {
            (Some(p), Some(_)) => Ok(lift_all(&self.tracker, &PixelMap::new(&scan.mesh, p.width_px, p.height_px)?)),
            _ => {
                let frame = self.feature_frame(scan)?;
                Ok(lift_all(&self.tracker, &frame.view(&scan.mesh)?.map))
            }
        }
    }

    /// Places the landmarks on the decoded keyframe of `scan` (the one fed last); returns those shared with the keyframe
    /// before, the `given` ones first, and what became of these.
    ///
    /// # Errors
    /// [`crate::CodecError::Mesh`] when the scan cannot be drawn.
    pub fn close_keyframe(
        &mut self,
        scan: &Scan,
        given: &[GivenLandmark],
        decoded: &TriMesh,
    ) -> Result<(Vec<LandmarkPair>, GivenCounts)> {
        let bvh = Bvh::new(decoded);
        let given_here = place(&bvh, given.iter().map(|g| (g.id, g.position_mm)), MAX_GIVEN_OFFSET_MM);
        let tracked_here = place(&bvh, self.lift(scan)?, MAX_OFFSET_MM);
        let chosen = shared(&self.given_at_key, &given_here);
        let mut tracked = shared(&self.at_key, &tracked_here);
        let near = |p: Vec3, q: Vec3| p.distance_squared(q) <= GIVEN_REACH_MM * GIVEN_REACH_MM;
        tracked.retain(|t| !chosen.iter().any(|g| near(t.1, g.1) || near(t.2, g.2)));
        let (from, to): (Vec<Vec3>, Vec<Vec3>) = tracked.iter().map(|t| (t.1, t.2)).unzip();
        let mut keep = consistent(&from, &to, MAX_INCONSISTENCY_MM).into_iter();
        tracked.retain(|_| keep.next() == Some(true));
        let mut pairs = spread(&chosen, MOST_LANDMARKS);
        let counts =
            GivenCounts { given: given.len(), off_surface: given.len() - given_here.len(), paired: pairs.len() };
        pairs.extend(spread(&tracked, MOST_LANDMARKS - pairs.len()));
        self.at_key = tracked_here;
        self.given_at_key = given_here;
        Ok((pairs, counts))
    }
}

/// The landmarks that lie on a surface, a reach apart from it at most.
fn place(bvh: &Bvh, landmarks: impl IntoIterator<Item = (u32, Vec3)>, reach_mm: f32) -> Placed {
    let on_surface = |(id, at): (u32, Vec3)| {
        let nearest = at.is_finite().then(|| bvh.nearest(at, reach_mm)).flatten()?;
        Some((id, (Place { triangle: nearest.triangle, barycentric: nearest.barycentric }, at)))
    };
    landmarks.into_iter().filter_map(on_surface).collect()
}

fn shared(before: &Placed, here: &Placed) -> Shared {
    let pair = |(id, &(there, there_mm)): (&u32, &(Place, Vec3))| {
        let &(place, at_mm) = before.get(id)?;
        Some((LandmarkPair { before: place, here: there }, at_mm, there_mm))
    };
    here.iter().filter_map(pair).collect()
}

/// At most `most` of the pairs. Ids run along the picture's rows, so every n-th is an even spread.
fn spread(pairs: &Shared, most: usize) -> Vec<LandmarkPair> {
    let step = pairs.len().div_ceil(most.max(1)).max(1);
    pairs.iter().step_by(step).take(most).map(|p| p.0).collect()
}
