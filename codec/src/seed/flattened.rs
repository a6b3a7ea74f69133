//! A keyframe laid on its disk, ready to be matched and looked up.

use super::group::{Group, LandmarkPair};
use crate::mesh::Bvh;
use crate::param::disk::{DiskMap, disk_map};
use crate::param::locate::{DiskLocator, Place};
use crate::param::matching::{DiskMatch, SourceDisk, WarpKind};
use crate::{GreyPicture, Result};
use glam::DVec2;

/// A decoded keyframe with its conformal map.
pub struct Flattened {
    /// Surface, stamps and landmarks.
    pub group: Group,
    /// Texture, if the session has one.
    pub texture: Option<GreyPicture>,
    /// Conformal map of the surface.
    pub disk: DiskMap,
    locator: DiskLocator,
}

impl Flattened {
    /// Maps the keyframe of a group to the disk.
    ///
    /// # Errors
    /// As [`disk_map`].
    pub fn new(group: Group, texture: Option<GreyPicture>) -> Result<Self> {
        let disk = disk_map(&group.mesh)?;
        let locator = DiskLocator::new(&disk.points, &group.mesh.triangles);
        Ok(Self { group, texture, disk, locator })
    }

    /// Place on the surface at a point of the disk, the nearest one outside it.
    pub fn locate(&self, z: DVec2) -> Option<Place> {
        self.locator.locate(&self.disk.points, &self.group.mesh.triangles, z)
    }

    fn source(&self) -> SourceDisk<'_> {
        SourceDisk { points: &self.disk.points, triangles: &self.group.mesh.triangles }
    }

    /// Point of the disk at a place.
    pub fn disk_point(&self, place: Place) -> DVec2 {
        let corners = self.group.mesh.triangles[place.triangle as usize];
        corners.iter().zip(place.barycentric).map(|(&v, w)| self.disk.points[v as usize] * f64::from(w)).sum()
    }
}

/// Matching functions between two neighbouring keyframes, there and back, through the landmarks stored with the later.
pub struct Neighbours {
    /// From the earlier disk to the later.
    pub forward: DiskMatch,
    /// From the later disk to the earlier.
    pub backward: DiskMatch,
}

impl Neighbours {
    /// Matches two keyframes that follow each other.
    pub fn new(earlier: &Flattened, later: &Flattened) -> Self {
        // After a loss the keyframe before may not be the one that the landmarks were placed on.
        let follows = later.group.before_tick == Some(earlier.group.key().tick);
        let known = |p: &&LandmarkPair| follows && (p.before.triangle as usize) < earlier.group.mesh.triangles.len();
        let mut pairs: Vec<(DVec2, DVec2)> = (later.group.landmarks.iter().filter(known))
            .map(|p| (earlier.disk_point(p.before), later.disk_point(p.here)))
            .collect();
        if pairs.len() < MIN_LANDMARKS {
            pairs = nearest_pairs(earlier, later);
        }
        let (from, to): (Vec<DVec2>, Vec<DVec2>) = pairs.into_iter().unzip();
        Self {
            forward: DiskMatch::fit(&from, &to, earlier.source(), &WarpKind::ThinPlate),
            backward: DiskMatch::fit(&to, &from, later.source(), &WarpKind::ThinPlate),
        }
    }
}

/// With fewer tracked landmarks the matching rests on points that lie nearest in the frontal view.
const MIN_LANDMARKS: usize = 12;

/// Vertices of the earlier surface and the points of the later one nearest to them: what remains when nothing could be
/// tracked, right for slow motion only.
fn nearest_pairs(earlier: &Flattened, later: &Flattened) -> Vec<(DVec2, DVec2)> {
    const SAMPLES: usize = 128;
    const REACH_MM: f32 = 10.0;
    // The border is where a surface was cut off, not a line of it.
    const INSIDE: f64 = 0.95;
    let bvh = Bvh::new(&later.group.mesh);
    let points = &earlier.group.mesh.positions_mm;
    let inside: Vec<usize> = (0..points.len()).filter(|&v| earlier.disk.points[v].length() < INSIDE).collect();
    (inside.iter().step_by(inside.len().div_ceil(SAMPLES).max(1)))
        .filter_map(|&v| {
            let nearest = bvh.nearest(points[v], REACH_MM)?;
            let place = Place { triangle: nearest.triangle, barycentric: nearest.barycentric };
            Some((earlier.disk.points[v], later.disk_point(place)))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Stamp;
    use crate::bits::connectivity::tests::random_disk;
    use glam::Vec3;
    use proptest::prelude::*;

    proptest! {
        /// Decoded positions are whole steps: coincident and collinear vertices are what a coarse step makes.
        #[test]
        fn coarse_surfaces_give_a_finite_map_or_an_error(
            choices in prop::collection::vec(any::<u16>(), 4..120), extent in 1i32..6, seed: u32, far: bool,
        ) {
            let mut mesh = random_disk(&choices);
            let mut state = seed | 1;
            let step_mm = if far { 1e9 } else { 0.05 };
            mesh.positions_mm.fill_with(|| {
                Vec3::from_array(std::array::from_fn(|_| {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    ((state >> 16) as i32 % extent) as f32 * step_mm
                }))
            });
            let stamps = vec![Stamp { tick: 0, time_nanos: 0 }];
            let group = Group { stamps, before_tick: None, mesh, landmarks: Vec::new() };
            if let Ok(flat) = Flattened::new(group, None) {
                prop_assert!(flat.disk.points.iter().all(|z| z.is_finite()));
                if let Some(place) = flat.locate(DVec2::new(0.1, 0.2)) {
                    prop_assert!(place.barycentric.iter().all(|w| w.is_finite()));
                }
            }
        }
    }
}
