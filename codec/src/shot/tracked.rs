//! The tracked mesh between scans: points of the surface on smooth paths through where decoded scans have them.

use super::UNITS_PER_MM;
use super::bisection::Connectivity;
use super::link::{KeyPicture, blended};
use super::model::Model;
use super::order::Placed;
use super::seen_scan::SeenScan;
use super::textures::TextureChain;
use crate::{GreyPicture, Result, Stamp};
use glam::Vec3;
use std::sync::Arc;

/// A decoded scan with what it takes to show it.
#[derive(Debug, Clone)]
pub struct Shown {
    /// When it was taken.
    pub stamp: Stamp,
    /// Where it is.
    pub placed: Arc<Placed>,
    /// The scan, decoded for scans alone.
    pub scan: Option<Arc<SeenScan>>,
    /// Its model.
    pub model: Arc<Model>,
    /// Index of the group in which its shot began.
    pub shot: usize,
    /// Its texture, not yet decoded between keyframes.
    pub picture: Option<Picture>,
    /// The keyframe whose texture the tracked mesh has.
    pub key: Option<Arc<KeyPicture>>,
}

/// Texture of a scan.
#[derive(Debug, Clone)]
pub enum Picture {
    /// Of a keyframe.
    Key(Arc<TextureChain>),
    /// Of a scan between: what is coded, and the keyframes that it is blended from.
    Between(Arc<[u8]>, Arc<Vec<KeyPicture>>),
}

impl Shown {
    /// The texture, of the window's size.
    ///
    /// # Errors
    /// [`crate::CodecError::Payload`] for bytes that do not fit.
    pub fn texture(&self) -> Result<Option<GreyPicture>> {
        match &self.picture {
            None => Ok(None),
            Some(Picture::Key(chain)) => Ok(Some(chain.planes.to_grey())),
            Some(Picture::Between(bytes, keys)) => {
                let Some(scan) = &self.scan else { return Ok(None) };
                blended(bytes, keys, (self.stamp.tick, scan), &self.model).map(Some)
            }
        }
    }

    /// Where the scan has grid nodes, mm.
    pub fn positions_mm(&self, nodes: &Connectivity) -> Vec<Vec3> {
        let units = self.placed.motion.positions(&self.model.base, nodes);
        units.into_iter().map(|p| Vec3::from_array(p.map(|v| v as f32)) / UNITS_PER_MM as f32).collect()
    }
}

/// Positions of grid nodes at a time between `around[at]` and `around[at + 1]`: the cubic Hermite curve whose tangents are
/// those of the parabola through each scan and its neighbours (one continuous derivative, whatever the times); the nearer
/// end before the first scan and after the last.
///
/// # Panics
/// When `around` is empty.
pub fn positions_at(around: &[&Shown], at: usize, time_nanos: u64, nodes: &Connectivity) -> Vec<Vec3> {
    let seconds = |k: usize| (around[k].stamp.time_nanos as f64 - around[at].stamp.time_nanos as f64) * 1e-9;
    let now = (time_nanos as f64 - around[at].stamp.time_nanos as f64) * 1e-9;
    let start = around[at].positions_mm(nodes);
    if at + 1 >= around.len() || now <= 0.0 {
        return start;
    }
    let end = around[at + 1].positions_mm(nodes);
    let length = seconds(at + 1);
    let chord: Vec<Vec3> = start.iter().zip(&end).map(|(a, b)| (*b - *a) / length as f32).collect();
    // The slope of a parabola at its middle knot is the mean of the chords' slopes, each weighted by the other's length.
    let tangent = |other: Option<usize>, of: &[Vec3], is_before: bool| -> Vec<Vec3> {
        let Some(k) = other else { return chord.clone() };
        let beside = around[k].positions_mm(nodes);
        let gap = if is_before { -seconds(k) } else { seconds(k) - length };
        let (w, sign) = ((length / (length + gap)) as f32, if is_before { 1.0 } else { -1.0 });
        (of.iter().zip(&beside).zip(&chord))
            .map(|((p, q), c)| (*p - *q) * (sign * w / gap as f32) + *c * (1.0 - w))
            .collect()
    };
    let first = tangent(at.checked_sub(1), &start, true);
    let last = tangent(Some(at + 2).filter(|k| *k < around.len()), &end, false);
    let s = (now / length).min(1.0) as f32;
    let (s2, s3) = (s * s, s * s * s);
    let weights = [2.0 * s3 - 3.0 * s2 + 1.0, s3 - 2.0 * s2 + s, -2.0 * s3 + 3.0 * s2, s3 - s2];
    let [h0, h1, h2, h3] = [weights[0], weights[1] * length as f32, weights[2], weights[3] * length as f32];
    (0..start.len()).map(|i| start[i] * h0 + first[i] * h1 + end[i] * h2 + last[i] * h3).collect()
}
