//! Landmarks of the encoder: tracked from scan to scan, placed on the keyframes as the decoder will see them.

use super::group::LandmarkPair;
use crate::mesh::{Bvh, TriMesh};
use crate::motion::{FeatureFrame, PixelMap, Tracker, TrackerOptions, consistent};
use crate::param::locate::Place;
use crate::texture::fit_camera;
use crate::{GreyPicture, Result, Scan};
use glam::Vec3;
use std::collections::BTreeMap;

/// Landmarks kept a keyframe: more do not improve the matching, and the thin plate costs their cube.
const MOST_LANDMARKS: usize = 256;

/// A landmark farther than this from the decimated surface is not on it, mm.
const MAX_OFFSET_MM: f32 = 1.0;

/// Matches that their neighbours contradict by more than this are dropped, mm.
const MAX_INCONSISTENCY_MM: f32 = 1.0;

/// A texture whose coordinates a camera misses by less than this share of its longer side, root mean square, is a picture of
/// the surface: the lens may bend it, but neighbours on the skin are neighbours in it.
const MAX_CAMERA_ERROR: f64 = 0.02;

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

/// The pictures in which the landmarks of a run are followed.
#[derive(Debug, Clone, Copy, PartialEq)]
enum View {
    /// Textures as the camera took them.
    Camera,
    /// Textures of any layout, resampled.
    Resampled(FeatureFrame),
    /// Relief of scans without texture.
    Relief(FeatureFrame),
}

/// Follows landmarks over a run and remembers where they lay on the last keyframe.
#[derive(Default)]
pub struct LandmarkTrail {
    tracker: Tracker,
    view: Option<View>,
    at_key: Placed,
    given_at_key: Placed,
}

fn texture_of(scan: &Scan) -> Option<(&GreyPicture, &[[f32; 2]])> {
    Some((scan.texture.as_ref().filter(|p| !p.pixels.is_empty())?, scan.mesh.uv.as_deref()?))
}

impl View {
    fn of(scan: &Scan) -> Result<Self> {
        let Some((picture, uv)) = texture_of(scan) else { return Ok(Self::Relief(FeatureFrame::about(&scan.mesh)?)) };
        let uv_px: Vec<[f32; 2]> = uv.iter().map(|&t| picture.uv_to_px(t)).collect();
        let limit_px = MAX_CAMERA_ERROR * f64::from(picture.width_px.max(picture.height_px));
        let fit = fit_camera(&scan.mesh.positions_mm, &uv_px);
        if fit.is_some_and(|f| f.rms_error_px <= limit_px) {
            return Ok(Self::Camera);
        }
        Ok(Self::Resampled(FeatureFrame::for_texture(&scan.mesh)?))
    }
}

impl LandmarkTrail {
    /// Follows the landmarks into the next scan.
    ///
    /// # Errors
    /// [`crate::CodecError::Mesh`] when the scan cannot be drawn.
    pub fn feed(&mut self, scan: &Scan, is_key: bool) -> Result<()> {
        match (self.view(scan)?, &scan.texture) {
            (View::Camera, Some(picture)) => {
                let map = PixelMap::new(&scan.mesh, picture.width_px, picture.height_px)?;
                self.tracker.feed(picture, &map.mask(), is_key);
            }
            (View::Resampled(frame), Some(picture)) => {
                let (seen, map) = frame.view_texture(&scan.mesh, picture)?;
                self.tracker.feed(&seen, &map.mask(), is_key);
            }
            (View::Relief(frame), _) => {
                let view = frame.view(&scan.mesh)?;
                self.tracker.feed_normalized(&view.relief, &view.mask, is_key);
            }
            (View::Camera | View::Resampled(_), None) => {
                unreachable!("views of textures are chosen for scans with one")
            }
        }
        Ok(())
    }

    /// The same view for the whole run, so that pictures of different scans compare; chosen again, with new landmarks,
    /// where textures begin or end.
    fn view(&mut self, scan: &Scan) -> Result<View> {
        let is_relief = texture_of(scan).is_none();
        if let Some(view) = self.view.filter(|v| matches!(v, View::Relief(_)) == is_relief) {
            return Ok(view);
        }
        let view = View::of(scan)?;
        let options = if is_relief { TrackerOptions::relief() } else { TrackerOptions::default() };
        self.tracker = Tracker::new(options);
        self.at_key.clear();
        Ok(*self.view.insert(view))
    }

    /// Where the landmarks lie on the scan fed last, in space.
    fn lift(&mut self, scan: &Scan) -> Result<Vec<(u32, Vec3)>> {
        let map = match (self.view(scan)?, &scan.texture) {
            (View::Camera, Some(p)) => PixelMap::new(&scan.mesh, p.width_px, p.height_px)?,
            (View::Resampled(frame) | View::Relief(frame), _) => frame.map(&scan.mesh)?,
            (View::Camera, None) => unreachable!("a view of textures is chosen for scans with one"),
        };
        Ok(self.tracker.tracks().iter().filter_map(|t| Some((t.id, map.lift_mm(t.px)?))).collect())
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

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec2;

    /// A dome of 60x50 vertices, 1 mm apart, moved; its texture laid out by `uv_of` and painted on the skin.
    fn scan(shift_mm: Vec3, uv_of: impl Fn(Vec2) -> Vec2) -> Scan {
        let flat = |i: u32| Vec2::new((i % 60) as f32 - 29.5, (i / 60) as f32 - 24.5);
        let raised = |p: Vec2| p.extend(-0.01 * p.length_squared());
        let cell = |i: u32| {
            let v = i / 59 * 60 + i % 59;
            [[v, v + 1, v + 60], [v + 1, v + 61, v + 60]]
        };
        let mesh = TriMesh {
            positions_mm: (0..3000).map(|i| raised(flat(i)) + shift_mm).collect(),
            triangles: (0..59 * 49).flat_map(cell).collect(),
            uv: Some((0..3000).map(|i| uv_of(flat(i)).to_array()).collect()),
        };
        let paint = |i: u32| {
            let (x, y) = ((i % 400) as f32, (i / 400) as f32);
            let waves = (0.9 * x + 0.3 * y).sin() + (0.4 * x - 0.8 * y).cos() + (0.5 * x + 0.6 * y).sin();
            (120.0 + 25.0 * waves) as u8
        };
        let texture = Some(GreyPicture::new(400, 400, (0..400 * 400).map(paint).collect()));
        Scan { mesh, texture, ..Scan::default() }
    }

    fn as_seen(p: Vec2) -> Vec2 {
        p / 80.0 + 0.5
    }

    /// Turned about the middle, the further out the more: no camera sees it so.
    fn swirled(p: Vec2) -> Vec2 {
        Vec2::from_angle(p.length() / 15.0).rotate(p) / 90.0 + 0.5
    }

    #[test]
    fn a_texture_that_no_camera_took_is_followed_on_the_surface() {
        // Less than half a wave of the paint.
        let shift = Vec3::new(0.4, -0.3, 0.5);
        let (first, second) = (scan(Vec3::ZERO, swirled), scan(shift, swirled));
        let mut trail = LandmarkTrail::default();
        trail.feed(&first, true).unwrap();
        assert!(matches!(trail.view, Some(View::Resampled(_))));
        let before: BTreeMap<u32, Vec3> = trail.lift(&first).unwrap().into_iter().collect();
        trail.feed(&second, true).unwrap();
        let after = trail.lift(&second).unwrap();
        let mut errors: Vec<f32> =
            after.iter().filter_map(|(id, q)| Some(q.distance(*before.get(id)? + shift))).collect();
        errors.sort_by(f32::total_cmp);
        assert!(before.len() > 100 && errors.len() * 10 > before.len() * 8, "{} of {}", errors.len(), before.len());
        assert!(errors[errors.len() / 2] < 0.05, "{} mm", errors[errors.len() / 2]);
    }

    #[test]
    fn a_camera_picture_is_followed_as_it_is_and_a_new_view_begins_anew() {
        let mut trail = LandmarkTrail::default();
        let seen = scan(Vec3::ZERO, as_seen);
        trail.feed(&seen, true).unwrap();
        assert_eq!(trail.view, Some(View::Camera));
        assert!(trail.close_keyframe(&seen, &[], &seen.mesh).unwrap().0.is_empty());
        let bare = Scan { texture: None, ..seen.clone() };
        trail.feed(&bare, true).unwrap();
        assert!(matches!(trail.view, Some(View::Relief(_))) && trail.at_key.is_empty());
    }

    #[test]
    fn given_landmarks_come_first_and_stand_in_for_tracked_ones_nearby() {
        let mut trail = LandmarkTrail::default();
        let seen = scan(Vec3::ZERO, as_seen);
        let given = |id: u32, position_mm| GivenLandmark { id, position_mm };
        let some = [given(4, Vec3::ZERO), given(9, Vec3::new(0.0, 0.0, 90.0)), given(11, Vec3::NAN)];
        trail.feed(&seen, true).unwrap();
        let (none, first) = trail.close_keyframe(&seen, &some, &seen.mesh).unwrap();
        assert_eq!((none.len(), first), (0, GivenCounts { given: 3, off_surface: 2, paired: 0 }));
        trail.feed(&seen, true).unwrap();
        let (pairs, counts) = trail.close_keyframe(&seen, &some[..1], &seen.mesh).unwrap();
        assert_eq!(counts, GivenCounts { given: 1, off_surface: 0, paired: 1 });
        let at = |p: &LandmarkPair| p.here.interpolate::<Vec3>(&seen.mesh.triangles, &seen.mesh.positions_mm);
        assert!(at(&pairs[0]).length() < 0.02 && pairs.len() > 50, "{}", pairs.len());
        assert!(pairs[1..].iter().all(|p| at(p).length() > GIVEN_REACH_MM - 0.1));
    }
}
