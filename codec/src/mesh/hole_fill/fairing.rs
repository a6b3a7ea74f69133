//! Thin-plate fairing of a patch (M. Botsch, L. Kobbelt, An Intuitive Framework for Real-Time Freeform Modeling, 2004).
//!
//! Least sum of |L x|² / area over the new vertices and the rim, L the cotangent Laplacian of the patch and the ring of
//! triangles around it. That the rim's own Laplacians count makes the patch leave the rim in the surface's tangent plane.

use super::{Patch, add_scaled};
use crate::Result;
use crate::linalg::{LowerCsc, SparseLlt};
use crate::mesh::{HalfEdges, TriMesh};
use glam::DVec3;

/// Patches of more new vertices stay membranes: the factor of a bi-Laplacian is several times that of a Laplacian.
const MAX_FAIRED_VERTICES: usize = 20_000;
/// Times that the plate is bent, each with the metric of the surface before: the first knows only the flat membrane.
const BEND_ROUNDS: usize = 3;
/// A bend that changes the area by less than this share is the last.
const SETTLED: f64 = 1e-3;
/// A plate of more than this many times the membrane's area overshoots: the slopes around the hole are noise.
const MAX_AREA_GROWTH: f64 = 2.0;
/// Cotangents are held within this: 1.1 degrees.
const MAX_COTANGENT: f64 = 50.0;

/// Laplacians of the new vertices and the rim: for each its area and its coefficients (vertex, weight), itself among them.
/// The places of the coefficients stay from bend to bend, their weights follow the metric.
struct Rows {
    area_mm2: Vec<f64>,
    start: Vec<u32>,
    coefficients: Vec<(u32, f64)>,
    /// Triangles of the patch, then those around it.
    triangles: Vec<[u32; 3]>,
}

impl Patch<'_> {
    /// Bends the membrane to a thin plate; leaves it where it is large, or where the plate overshoots.
    pub(super) fn make_fair(&mut self, mesh: &TriMesh) {
        let new = self.values.len() - self.rim.len();
        if new == 0 || new > MAX_FAIRED_VERTICES {
            return;
        }
        let (membrane, area) = (self.values.clone(), self.area_mm2());
        let (around, triangles) = self.surroundings(mesh);
        let all = self.origin.as_chunks::<3>().0.iter().copied().chain(triangles).collect();
        let mut rows = Rows::new(self.values.len(), all);
        let mut factor = None;
        let mut last = area;
        for _ in 0..BEND_ROUNDS {
            let bent = self.bend(&around, &mut rows, &mut factor);
            let grown = self.area_mm2();
            if bent.is_err() || overshoots(grown, area) {
                self.values = membrane;
                return;
            }
            if (grown - last).abs() < SETTLED * last {
                return;
            }
            last = grown;
        }
    }

    fn area_mm2(&self) -> f64 {
        let at = |v: u32| point(&self.values[v as usize]);
        self.origin.chunks_exact(3).map(|t| 0.5 * (at(t[1]) - at(t[0])).cross(at(t[2]) - at(t[0])).length()).sum()
    }

    /// Vertices next to the rim, which number on from the patch's, and the triangles between them and the rim.
    fn surroundings(&self, mesh: &TriMesh) -> (Vec<[f64; 5]>, Vec<[u32; 3]>) {
        let mut near: Vec<u32> = self.rim.iter().flat_map(|&v| self.half_edges.fan(v)).map(|h| h / 3).collect();
        near.sort_unstable();
        near.dedup();
        let corners = |t: u32, h: &HalfEdges| [0, 1, 2].map(|k| h.from(3 * t + k));
        let mut local: std::collections::BTreeMap<u32, u32> =
            self.rim.iter().enumerate().map(|(i, &v)| (v, i as u32)).collect();
        let mut around = Vec::new();
        let mut triangles = Vec::with_capacity(near.len());
        for t in near {
            triangles.push(corners(t, self.half_edges).map(|v| {
                *local.entry(v).or_insert_with(|| {
                    around.push(super::vertex_values(mesh, v));
                    (self.values.len() + around.len() - 1) as u32
                })
            }));
        }
        (around, triangles)
    }

    /// One linear solve for the new vertices, the metric that of the surface as it is. `factor` keeps its order.
    fn bend(&mut self, around: &[[f64; 5]], rows: &mut Rows, factor: &mut Option<SparseLlt>) -> Result<()> {
        let rim = self.rim.len();
        let new = self.values.len() - rim;
        let values: Vec<[f64; 5]> = self.values.iter().chain(around).copied().collect();
        rows.weigh(&values);
        let mut matrix = LowerCsc::default();
        let mut rhs = vec![0.0; 5 * new];
        let (mut sum, mut entered, mut column) = (vec![0.0; new], vec![u32::MAX; new], Vec::new());
        for i in 0..new {
            column.clear();
            let mut pull = [0.0; 5];
            // Weights are the same there and back: the rows that hold vertex i are those of the vertices in its own row.
            for &(row, back) in rows.of(rim + i) {
                let share = back / rows.area_mm2[row as usize];
                for &(k, weight) in rows.of(row as usize) {
                    match (k as usize).checked_sub(rim).filter(|&k| k < new) {
                        None => add_scaled(&mut pull, &values[k as usize], [-share * weight; 5]),
                        Some(k) if k < i => {}
                        Some(k) => {
                            if std::mem::replace(&mut entered[k], i as u32) != i as u32 {
                                column.push(k as u32);
                                sum[k] = 0.0;
                            }
                            sum[k] += share * weight;
                        }
                    }
                }
            }
            column.sort_unstable();
            matrix.push_column(column.iter().map(|&k| (k, sum[k as usize])));
            (0..5).for_each(|c| rhs[c * new + i] = pull[c]);
        }
        let places = || (rim..rim + new).map(|v| self.position(v as u32)).collect();
        SparseLlt::factorize_again(factor, &matrix, places)?.solve(&mut rhs, 5);
        for (i, value) in self.values[rim..].iter_mut().enumerate() {
            *value = std::array::from_fn(|c| rhs[c * new + i]);
        }
        Ok(())
    }
}
impl Rows {
    /// Rows of the first `count` vertices, all weights 0.
    fn new(count: usize, triangles: Vec<[u32; 3]>) -> Self {
        let inside = |v: &u32| (*v as usize) < count;
        let mut pairs: Vec<(u32, u32)> = (0..count as u32).map(|v| (v, v)).collect();
        pairs.extend(triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, a), (b, c), (c, b), (c, a), (a, c)]));
        pairs.retain(|(v, _)| inside(v));
        pairs.sort_unstable();
        pairs.dedup();
        let mut start = vec![0; count + 1];
        (1..).zip(&pairs).for_each(|(end, pair)| start[pair.0 as usize + 1] = end);
        Self { area_mm2: vec![0.0; count], start, coefficients: pairs.iter().map(|p| (p.1, 0.0)).collect(), triangles }
    }

    fn of(&self, row: usize) -> &[(u32, f64)] {
        &self.coefficients[self.start[row] as usize..self.start[row + 1] as usize]
    }

    fn add(&mut self, row: u32, column: u32, weight: f64) {
        let Some(range) = self.start.get(row as usize..row as usize + 2) else { return };
        let coefficients = &mut self.coefficients[range[0] as usize..range[1] as usize];
        coefficients.iter_mut().filter(|c| c.0 == column).for_each(|c| c.1 += weight);
    }

    /// Areas and cotangent weights in the metric of `values`.
    fn weigh(&mut self, values: &[[f64; 5]]) {
        self.area_mm2.fill(0.0);
        self.coefficients.iter_mut().for_each(|c| c.1 = 0.0);
        for t in 0..self.triangles.len() {
            let t = self.triangles[t];
            let p = t.map(|v| point(&values[v as usize]));
            let doubled = (p[1] - p[0]).cross(p[2] - p[0]).length();
            for k in 0..3 {
                let (a, b, c) = (k, (k + 1) % 3, (k + 2) % 3);
                if let Some(area) = self.area_mm2.get_mut(t[a] as usize) {
                    *area += doubled / 6.0;
                }
                let cotangent = (p[a] - p[c]).dot(p[b] - p[c]) / doubled.max(f64::MIN_POSITIVE);
                let weight = 0.5 * cotangent.clamp(-MAX_COTANGENT, MAX_COTANGENT);
                for (i, j, w) in [(a, b, weight), (b, a, weight), (a, a, -weight), (b, b, -weight)] {
                    self.add(t[i], t[j], w);
                }
            }
        }
        let floor = 1e-3 * self.area_mm2.iter().sum::<f64>() / self.area_mm2.len() as f64;
        self.area_mm2.iter_mut().for_each(|area| *area = area.max(floor).max(f64::MIN_POSITIVE));
    }
}

/// Whether a plate overshoots its membrane; one whose area is no number does.
fn overshoots(plate_mm2: f64, membrane_mm2: f64) -> bool {
    plate_mm2.is_nan() || plate_mm2 > MAX_AREA_GROWTH * membrane_mm2
}

fn point(value: &[f64; 5]) -> DVec3 {
    DVec3::new(value[0], value[1], value[2])
}

#[cfg(test)]
mod tests {
    use super::super::fill_hole_as;
    use super::*;
    use crate::mesh::test_surfaces::{plate, polar_disk};
    use glam::{DVec2, Vec2};

    /// Rms distance in height of the new vertices from the surface that the hole was cut from, as membrane and faired.
    fn errors(height: impl Fn(Vec2) -> f32, radius_mm: f32) -> [f64; 2] {
        [false, true].map(|fair| {
            let mut mesh = plate(61, &height, |p| p.distance(Vec2::splat(30.0)) < radius_mm);
            let kept = mesh.vertex_count();
            let mut half_edges = HalfEdges::build(kept, &mesh.triangles).unwrap();
            let rings = half_edges.boundary_loops();
            fill_hole_as(&mut mesh, &mut half_edges, &rings[1], fair);
            assert!(HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap().is_disk());
            let new = &mesh.positions_mm[kept..];
            let square: f64 = new.iter().map(|p| f64::from(p.z - height(p.truncate())).powi(2)).sum();
            (square / new.len() as f64).sqrt()
        })
    }

    /// Area of the patch over that of the membrane, in the round mouth of a funnel that rises to it by `slope`.
    fn growth(slope: f32) -> f64 {
        let [membrane, fair] = [false, true].map(|fair| {
            let (z, triangles) = polar_disk(20);
            let place = |z: &DVec2| z.as_vec2().extend(-slope * z.length() as f32) * 30.0;
            let whole = TriMesh { positions_mm: z.iter().map(place).collect(), triangles, uv: None };
            let (mut mesh, _) = whole.submesh(|t| whole.triangles[t].iter().all(|&v| z[v as usize].length() > 0.41));
            let mut half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles).unwrap();
            let rings = half_edges.boundary_loops();
            let inner = rings.iter().min_by_key(|ring| ring.len()).unwrap();
            let before = mesh.area_mm2();
            fill_hole_as(&mut mesh, &mut half_edges, inner, fair);
            mesh.area_mm2() - before
        });
        fair / membrane
    }

    #[test]
    fn a_plate_bulges_with_the_slope_around_it_and_never_to_twice_the_membrane() {
        let gentle = growth(1.0);
        assert!(gentle > 1.05, "{gentle}");
        assert!([0.0, 1.0, 2.0, 4.0, 8.0].into_iter().all(|slope| growth(slope) <= MAX_AREA_GROWTH));
        assert!(overshoots(2.01, 1.0) && overshoots(f64::NAN, 1.0) && !overshoots(1.99, 1.0));
    }

    #[test]
    fn a_cap_and_a_saddle_are_met_several_times_closer_than_by_the_membrane() {
        let centred = |p: Vec2| p - Vec2::splat(30.0);
        for radius_mm in [5.0, 12.0, 20.0] {
            let cap = |p: Vec2| (60f32.powi(2) - centred(p).length_squared()).sqrt();
            let [membrane, fair] = errors(cap, radius_mm);
            assert!(fair < 0.2 * membrane, "cap, {radius_mm} mm: {fair} of {membrane}");
            let saddle = |p: Vec2| (centred(p).x.powi(2) - 0.5 * centred(p).y.powi(2)) / 60.0;
            let [membrane, fair] = errors(saddle, radius_mm);
            assert!(fair < 0.2 * membrane, "saddle, {radius_mm} mm: {fair} of {membrane}");
        }
    }
}
