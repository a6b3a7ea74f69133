//! Draco at keyframes and a natural cubic spline between: for sequences of one connectivity.

use super::{draco, scan_of};
use crate::measure::{Decoded, MeasureError};
use crate::replay::ReplayStamp;
use crate::sweep::{Coded, Coder, SweepInput};
use glam::Vec3;
use gv3_codec::Scan;
use gv3_codec::mesh::TriMesh;
use gv3_codec::motion::spline::NaturalSpline;
use std::time::Instant;

const NAME: &str = "draco-spline";
const INTERVALS: [usize; 3] = [3, 5, 10];
const QP: i32 = 12;

/// Every n-th scan in Draco, the others on splines through its vertices.
pub(super) struct KeyframeSpline;

impl Coder for KeyframeSpline {
    fn name(&self) -> &'static str {
        NAME
    }
    fn about(&self) -> String {
        format!(
            "Draco (qp {QP}) at keyframes, natural cubic spline of every vertex between; sequences of one connectivity only"
        )
    }
    fn settings(&self) -> Vec<String> {
        INTERVALS.map(|n| format!("every {n}")).to_vec()
    }
    fn unavailable(&self, input: &SweepInput) -> Option<String> {
        let other = input.scans.iter().find(|s| s.mesh.triangles != input.scans[0].mesh.triangles)?;
        Some(format!(
            "the scan of tick {} has other triangles than the first; a spline needs the same vertices",
            other.tick
        ))
    }
    fn code(&self, setting: usize, input: &SweepInput) -> Result<Coded, MeasureError> {
        let fail = |reason: String| MeasureError::Coder { coder: NAME, reason };
        let last = input.scans.len() - 1;
        // The last scan is a keyframe too: nothing is extrapolated.
        let keys: Vec<usize> = (0..=last).filter(|i| i.is_multiple_of(INTERVALS[setting]) || *i == last).collect();
        let begin = Instant::now();
        let payloads: Result<Vec<Vec<u8>>, String> =
            keys.iter().map(|&k| draco::encode(&input.scans[k].mesh, QP)).collect();
        let payloads = payloads.map_err(fail)?;
        let encode_time = begin.elapsed();
        let bytes = payloads.iter().map(|p| p.len() as u64).sum();
        let keyframes: Result<Vec<TriMesh>, String> = payloads.iter().map(|p| draco::decode(p)).collect();
        let keyframes = keyframes.map_err(fail)?;
        // Draco orders vertices by the triangles alone, so the same triangles come back in the same order.
        if keyframes.iter().any(|k| k.triangles != keyframes[0].triangles) {
            return Err(fail("keyframes came back in different orders".into()));
        }
        let times: Vec<f64> = keys.iter().map(|&k| input.scans[k].tick as f64).collect();
        let decoded = Played {
            stamps: input.stamps(),
            period_nanos: input.period_nanos,
            spline: NaturalSpline::new(&times),
            keyframes,
        };
        Ok(Coded { bytes, encode_time, decoded: Box::new(decoded) })
    }
}

struct Played {
    stamps: Vec<ReplayStamp>,
    period_nanos: u64,
    spline: NaturalSpline,
    keyframes: Vec<TriMesh>,
}

impl Decoded for Played {
    fn stamps(&self) -> &[ReplayStamp] {
        &self.stamps
    }
    fn period_nanos(&self) -> u64 {
        self.period_nanos
    }
    fn scan(&mut self, stamp: &ReplayStamp) -> Result<Scan, MeasureError> {
        let weights = self.spline.weights(stamp.tick as f64);
        let place = |v: usize| -> Vec3 {
            self.keyframes.iter().zip(&weights).map(|(k, &w)| k.positions_mm[v] * w as f32).sum()
        };
        let positions_mm = (0..self.keyframes[0].vertex_count()).map(place).collect();
        scan_of(TriMesh { positions_mm, triangles: self.keyframes[0].triangles.clone(), uv: None }, stamp, NAME)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sweep::test_scans::rising;
    use gv3_codec::metrics::compare;

    #[test]
    fn an_even_rise_is_played_as_it_was() {
        let input = rising(40, 8);
        assert_eq!(KeyframeSpline.unavailable(&input), None);
        let Coded { bytes, mut decoded, .. } = KeyframeSpline.code(0, &input).unwrap();
        for (scan, stamp) in input.scans.iter().zip(input.stamps()) {
            let error = compare(scan, &decoded.scan(&stamp).unwrap()).distortion.scan_to_replay.summary();
            // A step of the 12-bit grid over 20 mm is 0.005 mm.
            assert!(error.max < 0.01, "{error:?}");
        }
        let fewer = KeyframeSpline.code(2, &input).unwrap().bytes;
        assert!(fewer < bytes);
    }

    #[test]
    fn changing_triangles_are_refused() {
        let mut input = rising(20, 2);
        input.scans[1].mesh.triangles.pop();
        assert!(KeyframeSpline.unavailable(&input).unwrap().contains("tick 1"));
    }
}
