//! Landmarks that live over many scans: followed from picture to picture, replaced where they die.

use super::{
    CornerOptions, FloatPicture, FlowOptions, GREY_SIGMA_PX, GREY_VARIANCE_FLOOR, Mask, Pyramid, affine_flow::Aligner,
    find_corners, normalize, optical_flow::follow_from,
};
use crate::GreyPicture;
use std::sync::Arc;

/// A landmark that its affine alignment would move further than this was following something else.
const MAX_DRIFT_PX: f32 = 1.5;

/// How landmarks are found and followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerOptions {
    /// Following from one picture to the next.
    pub flow: FlowOptions,
    /// New landmarks.
    pub corners: CornerOptions,
    /// Least correlation from key picture to key picture, after affine alignment.
    pub min_key_zncc: f32,
}

impl Default for TrackerOptions {
    fn default() -> Self {
        // Over ten scans 13 px loses 0.5 % more landmarks than 15 and takes a fifth less time; 9 px loses 3 % more.
        let flow = FlowOptions { window_px: 13, ..FlowOptions::default() };
        Self { flow, corners: CornerOptions::default(), min_key_zncc: 0.8 }
    }
}

impl TrackerOptions {
    /// For the relief of scans without texture, which is smoother than grey skin and needs a larger window.
    pub fn relief() -> Self {
        Self { flow: FlowOptions { window_px: 21, ..FlowOptions::default() }, ..Self::default() }
    }
}

/// A landmark in the present picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// Never used twice in a run; later landmarks have larger ids.
    pub id: u32,
    /// Position, px (pixel centres are integers, y down).
    pub px: [f32; 2],
    /// Position in the last key picture, if the landmark lived there.
    pub key_px: Option<[f32; 2]>,
    /// Its last step, px, which the next is expected to repeat.
    step_px: Option<[f32; 2]>,
}

/// Follows landmarks through the pictures of a run, one picture a scan in the order of time.
#[derive(Debug, Default)]
pub struct Tracker {
    options: TrackerOptions,
    present: Option<Arc<Pyramid>>,
    key: Option<Arc<Pyramid>>,
    tracks: Vec<Track>,
    next_id: u32,
}

impl Tracker {
    /// A tracker that has seen nothing.
    pub fn new(options: TrackerOptions) -> Self {
        Self { options, ..Self::default() }
    }

    /// Landmarks alive in the picture fed last, ascending ids.
    pub fn tracks(&self) -> &[Track] {
        &self.tracks
    }

    /// Feeds the texture of the next scan; `mask` holds the pixels that show the surface.
    /// At a key picture landmarks are also aligned with the key picture before, must look as they did there, and are
    /// remembered for the next.
    ///
    /// # Panics
    /// When picture and mask differ in size. Pictures of different scans may.
    pub fn feed(&mut self, picture: &GreyPicture, mask: &Mask, is_key: bool) {
        self.feed_normalized(&normalize(&picture.into(), mask, GREY_SIGMA_PX, GREY_VARIANCE_FLOOR), mask, is_key);
    }

    /// As [`Self::feed`], for a picture that is normalised already (0 outside the mask), as of
    /// [`FeatureFrame`](super::FeatureFrame).
    ///
    /// # Panics
    /// When picture and mask differ in size.
    pub fn feed_normalized(&mut self, picture: &FloatPicture, mask: &Mask, is_key: bool) {
        let next = Arc::new(Pyramid::new(picture, self.options.flow.levels));
        if let Some(previous) = self.present.take() {
            self.advance(&previous, &next, mask);
        }
        if is_key && let Some(key) = self.key.take() {
            self.realign(&key, &next, mask);
        }
        self.refill(&next, mask);
        if is_key {
            self.tracks.iter_mut().for_each(|t| t.key_px = Some(t.px));
            self.key = Some(next.clone());
        }
        self.present = Some(next);
    }

    /// Moves the landmarks to the next picture and drops those that are lost or leave the mask.
    fn advance(&mut self, previous: &Pyramid, next: &Pyramid, mask: &Mask) {
        let points: Vec<_> = self.tracks.iter().map(|t| (t.px, t.step_px)).collect();
        let ends = follow_from(previous, next, &points, &self.options.flow);
        let mut ends = ends.into_iter();
        self.tracks.retain_mut(|t| match ends.next().flatten() {
            Some(px) if mask.contains(px) => {
                t.step_px = Some([px[0] - t.px[0], px[1] - t.px[1]]);
                t.px = px;
                true
            }
            _ => false,
        });
    }

    /// Aligns the landmarks with the key picture before, which takes back what drift they gathered since, and drops those
    /// that no longer look as they did there.
    fn realign(&mut self, key: &Pyramid, next: &Pyramid, mask: &Mask) {
        let mut aligner = Aligner::new(self.options.flow.window_px);
        self.tracks.retain_mut(|t| {
            let Some(key_px) = t.key_px else { return true };
            let Some(found) = aligner.align(key.finest(), key_px, next.finest(), t.px) else { return false };
            let moved_px = libm::hypotf(found.px[0] - t.px[0], found.px[1] - t.px[1]);
            t.px = found.px;
            moved_px <= MAX_DRIFT_PX && found.zncc >= self.options.min_key_zncc && mask.contains(found.px)
        });
    }

    /// New landmarks in the cells that hold none. Windows of new landmarks lie wholly on the surface.
    fn refill(&mut self, next: &Pyramid, mask: &Mask) {
        let allowed = mask.eroded(self.options.flow.window_px / 2);
        let occupied: Vec<[f32; 2]> = self.tracks.iter().map(|t| t.px).collect();
        for px in find_corners(next.finest(), allowed, &occupied, &self.options.corners) {
            // Ids are not reused: a run that has spent them all gets no new landmarks.
            let Some(following) = self.next_id.checked_add(1) else { return };
            self.tracks.push(Track { id: self.next_id, px, key_px: None, step_px: None });
            self.next_id = following;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::test_texture::{Warp, median, render};

    /// The texture, shifted, in grey levels under a shading that stays where it is.
    fn grey(warp: &Warp) -> GreyPicture {
        let p = render(warp, 200, 150);
        let level = |(i, v): (usize, &f32)| (120.0 + 18.0 * v + 0.2 * (i % 200) as f32).clamp(0.0, 255.0).round() as u8;
        GreyPicture::new(200, 150, p.pixels.iter().enumerate().map(level).collect())
    }

    fn left_part(columns: u32) -> Mask {
        Mask::new(200, 150, (0..200 * 150).map(|i| i % 200 < columns).collect())
    }

    #[test]
    fn landmarks_keep_their_ids_and_follow_the_texture() {
        let mut tracker = Tracker::new(TrackerOptions::default());
        let mask = Mask::full(200, 150);
        let warp = |k: u32| Warp::shift(1.3 * k as f32, -0.7 * k as f32);
        tracker.feed(&grey(&warp(0)), &mask, true);
        let first = tracker.tracks().to_vec();
        assert!(first.len() > 120);
        for k in 1..=10 {
            tracker.feed(&grey(&warp(k)), &mask, k == 10);
        }
        let survivors: Vec<_> = tracker.tracks().iter().filter(|t| (t.id as usize) < first.len()).collect();
        // The texture moves 13 px right and 7 px up: one column and a row of cells leave.
        assert!(survivors.len() * 100 > first.len() * 80, "{} of {}", survivors.len(), first.len());
        let error = |t: &&Track| {
            let want = warp(10).apply(first[t.id as usize].px);
            (t.px[0] - want[0]).hypot(t.px[1] - want[1])
        };
        assert!(median(&survivors.iter().map(error).collect::<Vec<_>>()) < 0.05);
        assert!(tracker.tracks().windows(2).all(|w| w[0].id < w[1].id));
        assert!(tracker.tracks().iter().all(|t| t.key_px == Some(t.px)));
    }

    #[test]
    fn leaving_the_mask_kills_and_coming_back_gives_new_ids() {
        let mut tracker = Tracker::new(TrackerOptions::default());
        let picture = grey(&Warp::still());
        tracker.feed(&picture, &left_part(200), false);
        let before = tracker.tracks().len();
        let last = tracker.tracks()[before - 1].id;
        tracker.feed(&picture, &left_part(100), false);
        assert!(tracker.tracks().iter().all(|t| t.px[0] < 100.0));
        assert!(tracker.tracks().len() < before * 6 / 10);
        tracker.feed(&picture, &left_part(200), false);
        assert!(tracker.tracks().iter().filter(|t| t.px[0] > 108.0).all(|t| t.id > last));
        assert!(tracker.tracks().len() > before * 9 / 10);
    }

    #[test]
    fn a_key_picture_that_looks_different_keeps_hardly_any_landmark() {
        let mut tracker = Tracker::new(TrackerOptions::default());
        let mask = Mask::full(200, 150);
        let (a, b) = (render(&Warp::still(), 200, 150), render(&Warp::shift(4000.0, 900.0), 200, 150));
        let mixed = |share: f32| {
            let pixels = a.pixels.iter().zip(&b.pixels).map(|(p, q)| p * (1.0 - share) + q * share);
            FloatPicture::new(200, 150, pixels.collect())
        };
        tracker.feed_normalized(&mixed(0.0), &mask, true);
        let old = tracker.tracks().len() as u32;
        for k in 1..10 {
            tracker.feed_normalized(&mixed(k as f32 * 0.1), &mask, false);
        }
        let crept = tracker.tracks().iter().filter(|t| t.id < old).count();
        tracker.feed_normalized(&mixed(1.0), &mask, true);
        let kept = tracker.tracks().iter().filter(|t| t.id < old).count();
        assert!(crept * 2 > old as usize, "a slow cross-fade must fool picture-to-picture tracking: {crept} of {old}");
        assert!(kept * 20 <= old as usize, "{kept} of {old}");
    }

    #[test]
    fn an_empty_scan_ends_all_and_the_next_begins_anew() {
        let mut tracker = Tracker::new(TrackerOptions::default());
        let picture = grey(&Warp::still());
        tracker.feed(&picture, &Mask::full(200, 150), true);
        tracker.feed(&GreyPicture::default(), &Mask::default(), true);
        assert!(tracker.tracks().is_empty());
        tracker.feed(&picture, &Mask::full(200, 150), true);
        assert!(tracker.tracks().len() > 120);
    }
}
