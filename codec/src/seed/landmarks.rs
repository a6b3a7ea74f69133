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

/// Follows landmarks over a run and remembers where they lay on the last keyframe.
#[derive(Default)]
pub struct LandmarkTrail {
    tracker: Tracker,
    frame: Option<FeatureFrame>,
    at_key: BTreeMap<u32, (Place, Vec3)>,
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
    /// before.
    ///
    /// # Errors
    /// [`crate::CodecError::Mesh`] when the scan cannot be drawn.
    pub fn close_keyframe(&mut self, scan: &Scan, decoded: &TriMesh) -> Result<Vec<LandmarkPair>> {
        let bvh = Bvh::new(decoded);
        let placed: BTreeMap<u32, (Place, Vec3)> = (self.lift(scan)?.into_iter())
            .filter_map(|(id, at)| {
                let nearest = bvh.nearest(at, MAX_OFFSET_MM)?;
                Some((id, (Place { triangle: nearest.triangle, barycentric: nearest.barycentric }, at)))
            })
            .collect();
        let shared: Vec<(Place, Vec3, Place, Vec3)> = (placed.iter())
            .filter_map(|(id, &(here, here_mm))| {
                self.at_key.get(id).map(|&(before, before_mm)| (before, before_mm, here, here_mm))
            })
            .collect();
        self.at_key = placed;
        let (from, to): (Vec<Vec3>, Vec<Vec3>) = shared.iter().map(|s| (s.1, s.3)).unzip();
        let kept: Vec<LandmarkPair> = (consistent(&from, &to, MAX_INCONSISTENCY_MM).iter().zip(&shared))
            .filter(|(keep, _)| **keep)
            .map(|(_, s)| LandmarkPair { before: s.0, here: s.2 })
            .collect();
        // Ids run along the picture's rows, so every n-th is an even spread.
        Ok(kept.iter().copied().step_by(kept.len().div_ceil(MOST_LANDMARKS).max(1)).collect())
    }
}
