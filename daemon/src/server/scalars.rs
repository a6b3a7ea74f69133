//! One number for each vertex that a viewer is shown, and the range that colours span.

use gv3_codec::Scan;
use serde::Deserialize;

/// Share of the vertices whose value lies within the range, at either end of it.
const SHARE: f32 = 0.98;

/// What the numbers are; as a byte in messages, in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ScalarKind {
    /// None.
    #[default]
    None,
    /// Distance from the scanner along its axis, mm.
    Depth,
    /// Distance from the session's other output, mm: what tracking costs.
    Error,
    /// Distance from the place one scan earlier, mm; of the tracked mesh.
    Motion,
}

/// One number a vertex of a surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Scalars {
    /// What they are.
    pub kind: ScalarKind,
    /// Values, one a vertex shown.
    pub values: Vec<f32>,
    /// Value shown as 0.
    pub low: f32,
    /// Value shown as 255.
    pub high: f32,
}

impl Scalars {
    /// Numbers that begin at 0, as distances do; the largest ones share the end of the range.
    pub fn from_zero(kind: ScalarKind, values: Vec<f32>) -> Self {
        let (_, high) = ends(&values);
        Self { kind, values, low: 0.0, high }
    }

    /// Distances of the vertices `kept` from the scanner along its axis, mm: scans have z towards it.
    pub fn depths(scan: &Scan, kept: &[u32]) -> Self {
        let values: Vec<f32> = kept.iter().map(|&v| -scan.mesh.positions_mm[v as usize].z).collect();
        let (low, high) = ends(&values);
        Self { kind: ScalarKind::Depth, values, low, high }
    }
}

/// The values that this share lies above and below.
fn ends(values: &[f32]) -> (f32, f32) {
    let mut values = values.to_vec();
    let last = values.len().saturating_sub(1) as f32;
    let mut at = |share: f32| match values.is_empty() {
        true => 0.0,
        false => *values.select_nth_unstable_by((last * share).round() as usize, f32::total_cmp).1,
    };
    (at(1.0 - SHARE), at(SHARE))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use gv3_codec::mesh::TriMesh;

    #[test]
    fn depth_grows_away_from_the_scanner() {
        let positions_mm = (0..101).map(|i| Vec3::new(i as f32, 0.0, -500.0 - i as f32)).collect();
        let scan = Scan { mesh: TriMesh { positions_mm, ..TriMesh::default() }, ..Scan::default() };
        let near = Scalars::depths(&scan, &[0, 10, 100]);
        assert_eq!(near.values, [500.0, 510.0, 600.0]);
        let all: Vec<u32> = (0..101).collect();
        let depths = Scalars::depths(&scan, &all);
        assert_eq!((depths.low, depths.high), (502.0, 598.0));
    }

    #[test]
    fn the_range_leaves_out_the_few_largest() {
        let scalars = Scalars::from_zero(ScalarKind::Error, (0..=100).rev().map(|i| (i * i) as f32).collect());
        assert_eq!((scalars.low, scalars.high), (0.0, 98.0 * 98.0));
        let empty = Scalars::from_zero(ScalarKind::Error, Vec::new());
        assert_eq!((empty.low, empty.high), (0.0, 0.0));
    }
}
