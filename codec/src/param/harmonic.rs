//! Harmonic functions on a surface with given values on its border: one factorization, many solves.

use crate::Result;
use crate::linalg::{LowerCsc, SparseLlt};
use crate::mesh::half_edge::NONE;
use crate::mesh::intrinsic::IntrinsicMesh;
use glam::{DVec2, Vec3};

/// The interior block of the Laplacian and its coupling to the border.
pub(crate) struct HarmonicSystem {
    /// Interior row of a vertex, `u32::MAX` on the border.
    row: Vec<u32>,
    /// (interior row, border vertex, weight)
    coupling: Vec<(u32, u32, f64)>,
    matrix: LowerCsc,
}

impl HarmonicSystem {
    pub(crate) fn assemble(m: &IntrinsicMesh, border: &[u32]) -> Self {
        let mut row = vec![0u32; m.vertex_count];
        for &b in border {
            row[b as usize] = u32::MAX;
        }
        let mut rows = 0;
        for r in row.iter_mut().filter(|r| **r == 0) {
            *r = rows;
            rows += 1;
        }
        let mut diagonal = vec![0.0; rows as usize];
        let (mut entries, mut coupling) = (Vec::with_capacity(m.twin.len() / 2), Vec::new());
        let cotangents = m.cotangents();
        for h in 0..m.twin.len() as u32 {
            let other = m.twin[h as usize];
            let (i, j) = (m.origin[h as usize], m.target(h));
            if other == NONE || h > other || i == j {
                continue;
            }
            let weight = 0.5 * (cotangents[h as usize] + cotangents[other as usize]);
            let w = weight.max(0.0);
            let (ri, rj) = (row[i as usize], row[j as usize]);
            for r in [ri, rj] {
                if r != u32::MAX {
                    diagonal[r as usize] += w;
                }
            }
            match (ri, rj) {
                (u32::MAX, u32::MAX) => {}
                (u32::MAX, r) => coupling.push((r, i, w)),
                (r, u32::MAX) => coupling.push((r, j, w)),
                (a, b) => entries.push((a, b, -w)),
            }
        }
        Self { row, coupling, matrix: LowerCsc::assemble(&diagonal, &entries) }
    }

    /// Factorizes into `slot`, whose order is kept when its matrix had the same pattern. `positions_mm` are those of the
    /// mesh, as far as its vertices go.
    pub(crate) fn factorize<'a>(
        &self,
        slot: &'a mut Option<SparseLlt>,
        positions_mm: &[Vec3],
    ) -> Result<&'a SparseLlt> {
        SparseLlt::factorize_again(slot, &self.matrix, || self.places_mm(positions_mm))
    }

    /// Place of each row; rows of vertices that are not in the mesh lie where the border is that they are coupled to.
    fn places_mm(&self, positions_mm: &[Vec3]) -> Vec<Vec3> {
        let mut places = vec![Vec3::ZERO; self.matrix.size()];
        for &(r, b, _) in &self.coupling {
            places[r as usize] = positions_mm[b as usize];
        }
        for (&r, &p) in self.row.iter().zip(positions_mm).filter(|(r, _)| **r != u32::MAX) {
            places[r as usize] = p;
        }
        places
    }

    /// Flux through each vertex of the border from a source of strength one at vertex `pole`: its harmonic measure.
    /// Zero off the border.
    pub(crate) fn harmonic_measure(&self, factor: &SparseLlt, pole: u32) -> Vec<f64> {
        let mut green = vec![0.0; self.matrix.size()];
        green[self.row[pole as usize] as usize] = 1.0;
        factor.solve(&mut green, 1);
        let mut flux = vec![0.0; self.row.len()];
        for &(r, b, w) in &self.coupling {
            flux[b as usize] += w * green[r as usize];
        }
        flux
    }

    /// Harmonic functions with the given border values; points of all vertices.
    pub(crate) fn extend(&self, factor: &SparseLlt, border: &[u32], values: &[DVec2]) -> Vec<DVec2> {
        let rows = self.matrix.size();
        let mut points = vec![DVec2::ZERO; self.row.len()];
        for (&b, &z) in border.iter().zip(values) {
            points[b as usize] = z;
        }
        let mut rhs = vec![0.0; 2 * rows];
        for &(r, b, w) in &self.coupling {
            rhs[r as usize] += w * points[b as usize].x;
            rhs[rows + r as usize] += w * points[b as usize].y;
        }
        factor.solve(&mut rhs, 2);
        for (z, &r) in points.iter_mut().zip(&self.row).filter(|(_, r)| **r != u32::MAX) {
            *z = DVec2::new(rhs[r as usize], rhs[rows + r as usize]);
        }
        points
    }
}
