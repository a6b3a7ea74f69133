//! Points spread evenly over a surface.

use crate::mesh::TriMesh;
use glam::Vec3;

/// Steps of the two-dimensional R sequence, 2^32/p and 2^32/p² with p³ = p + 1: M. Roberts, "The unreasonable
/// effectiveness of quasirandom sequences", 2018.
const R2_STEPS: [u32; 2] = [3_242_174_889, 2_447_445_414];

/// One point of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AreaSample {
    /// Index into `TriMesh::triangles`.
    pub triangle: u32,
    /// Point on that triangle, millimetres.
    pub point_mm: Vec3,
}

/// Points spread evenly over the area of a mesh, in the order of its triangles; the same mesh gives the same points.
///
/// Systematic sampling: laid end to end, the triangles cover the interval of the mesh's area, which has a sample in
/// the middle of each of its `count` equal parts. So a triangle gets its share of the samples rounded up or down, what
/// it got too few the next ones get, and triangles much smaller than a part are visited in turn. Inside the triangles
/// the points follow a low-discrepancy sequence.
#[derive(Debug, Clone)]
pub struct AreaSamples<'a> {
    mesh: &'a TriMesh,
    /// Area of one part, mm².
    part_mm2: f64,
    /// The triangle at hand.
    triangle: usize,
    /// Area of the triangles up to and with the one at hand, mm².
    area_mm2: f64,
    /// Samples given so far.
    given: u32,
    count: u32,
}

impl<'a> AreaSamples<'a> {
    /// `count` samples; none for a mesh without area.
    pub fn new(mesh: &'a TriMesh, count: u32) -> Self {
        let area_mm2: f64 = (0..mesh.triangles.len()).map(|t| triangle_area_mm2(mesh, t)).sum();
        let first = if mesh.triangles.is_empty() { 0.0 } else { triangle_area_mm2(mesh, 0) };
        let count = if area_mm2 > 0.0 { count } else { 0 };
        Self { mesh, part_mm2: area_mm2 / f64::from(count), triangle: 0, area_mm2: first, given: 0, count }
    }
}

impl Iterator for AreaSamples<'_> {
    type Item = AreaSample;

    fn next(&mut self) -> Option<AreaSample> {
        if self.given == self.count {
            return None;
        }
        let at_mm2 = (f64::from(self.given) + 0.5) * self.part_mm2;
        // Ends at the last triangle: its sum is the whole area to the last bit, half a part beyond the last sample.
        while self.area_mm2 <= at_mm2 {
            self.triangle += 1;
            self.area_mm2 += triangle_area_mm2(self.mesh, self.triangle);
        }
        let [mut v, mut w] = R2_STEPS.map(|step| unit(self.given.wrapping_mul(step)));
        if v + w > 1.0 {
            (v, w) = (1.0 - v, 1.0 - w);
        }
        self.given += 1;
        let [a, b, c] = self.mesh.corners(self.triangle);
        Some(AreaSample { triangle: self.triangle as u32, point_mm: a + (b - a) * v + (c - a) * w })
    }
}

/// Area of triangle `t`; 0 when it is too large for a number.
fn triangle_area_mm2(mesh: &TriMesh, t: usize) -> f64 {
    let twice = f64::from(mesh.area_normal(t).length());
    if twice.is_finite() { 0.5 * twice } else { 0.0 }
}

/// The upper 24 bits as a fraction, in the middle of its step: never 0 nor 1.
fn unit(x: u32) -> f32 {
    ((x >> 8) as f32 + 0.5) / (1 << 24) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Three unit squares in the shape of an L, each cut into triangles of its own size.
    fn l_shape() -> TriMesh {
        let mut mesh = TriMesh::default();
        for (x0, y0, n) in [(0.0, 0.0, 1u32), (1.0, 0.0, 7), (0.0, 1.0, 40)] {
            let first = mesh.positions_mm.len() as u32;
            for k in 0..(n + 1) * (n + 1) {
                let at = Vec3::new((k % (n + 1)) as f32, (k / (n + 1)) as f32, 0.0) / n as f32;
                mesh.positions_mm.push(at + Vec3::new(x0, y0, 0.0));
            }
            for k in (0..n * (n + 1)).filter(|k| k % (n + 1) < n) {
                let (a, c) = (first + k, first + k + n + 1);
                mesh.triangles.extend([[a, a + 1, c + 1], [a, c + 1, c]]);
            }
        }
        mesh
    }

    #[test]
    fn mean_and_spread_are_those_of_the_area() {
        let points: Vec<Vec3> = AreaSamples::new(&l_shape(), 10_000).map(|s| s.point_mm).collect();
        assert_eq!(points.len(), 10_000);
        let mean = points.iter().sum::<Vec3>() / 1e4;
        assert!((mean - Vec3::new(5.0 / 6.0, 5.0 / 6.0, 0.0)).length() < 1e-3, "{mean}");
        let second = points.iter().map(|p| p * p).sum::<Vec3>() / 1e4;
        assert!((second - Vec3::new(1.0, 1.0, 0.0)).length() < 3e-3, "{second}");
    }

    #[test]
    fn samples_lie_in_their_triangles() {
        let mesh = l_shape();
        for sample in AreaSamples::new(&mesh, 5000) {
            let [a, b, c] = mesh.corners(sample.triangle as usize);
            for (from, to) in [(a, b), (b, c), (c, a)] {
                assert!((to - from).cross(sample.point_mm - from).z > -1e-6);
            }
        }
    }

    #[test]
    fn a_mesh_without_area_has_no_samples() {
        assert_eq!(AreaSamples::new(&TriMesh::default(), 10).count(), 0);
        let flat = TriMesh { positions_mm: vec![Vec3::ONE; 3], triangles: vec![[0, 1, 2]], uv: None };
        assert_eq!(AreaSamples::new(&flat, 10).count(), 0);
    }

    proptest! {
        #[test]
        fn a_triangle_gets_its_share_up_to_one(
            points in proptest::collection::vec(prop::array::uniform3(-10f32..10.0), 3..200),
            count in 1u32..3000,
        ) {
            let triangles = (0..points.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
            let mesh = TriMesh { positions_mm: points.into_iter().map(Vec3::from).collect(), triangles, uv: None };
            let mut counts = vec![0u32; mesh.triangles.len()];
            AreaSamples::new(&mesh, count).for_each(|s| counts[s.triangle as usize] += 1);
            prop_assert_eq!(counts.iter().sum::<u32>(), count);
            let area = mesh.area_mm2();
            for (t, &n) in counts.iter().enumerate() {
                let share = 0.5 * f64::from(mesh.area_normal(t).length()) / area * f64::from(count);
                prop_assert!((f64::from(n) - share).abs() < 1.0 + 1e-6, "triangle {} got {} of {}", t, n, share);
            }
        }
    }
}
