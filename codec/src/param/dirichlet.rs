//! Linear systems of an edge-weighted mesh with some vertices held: sum_j w_ij (x_i - x_j) = s_i elsewhere.

use crate::linalg::{LowerCsc, SparseLlt};
use crate::{CodecError, Result};

/// Row of a vertex that is held.
const HELD: u32 = u32::MAX;

/// The factorized system; one factorization serves any held values and sources.
pub struct Dirichlet {
    /// Row of each free vertex.
    row: Vec<u32>,
    /// Row, held vertex, weight.
    coupling: Vec<(u32, u32, f64)>,
    factor: SparseLlt,
    rows: usize,
}

impl Dirichlet {
    /// Of edges (vertex, vertex, weight), the same edge any number of times; weights may be negative as long as the
    /// matrix stays positive definite.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when it does not (a piece without any held vertex, for instance).
    pub fn new(held: &[bool], edges: impl Iterator<Item = (u32, u32, f64)>) -> Result<Self> {
        let mut rows = 0;
        let mut row = vec![HELD; held.len()];
        for (r, _) in row.iter_mut().zip(held).filter(|(_, held)| !**held) {
            *r = rows;
            rows += 1;
        }
        let mut diagonal = vec![0.0; rows as usize];
        let (mut entries, mut coupling) = (Vec::with_capacity(3 * held.len()), Vec::new());
        for (i, j, w) in edges.filter(|(i, j, _)| i != j) {
            let ends = [row[i as usize], row[j as usize]];
            for r in ends.into_iter().filter(|r| *r != HELD) {
                diagonal[r as usize] += w;
            }
            match ends {
                [HELD, HELD] => {}
                [HELD, r] => coupling.push((r, i, w)),
                [r, HELD] => coupling.push((r, j, w)),
                [a, b] => entries.push((a, b, -w)),
            }
        }
        // Rounding may hide the singularity of a system without any.
        if rows > 0 && coupling.is_empty() {
            return Err(CodecError::Mesh("no vertex is held".into()));
        }
        let factor = SparseLlt::factorize(&LowerCsc::assemble(&diagonal, &entries))?;
        Ok(Self { row, coupling, factor, rows: rows as usize })
    }

    /// Replaces the values of the free vertices by the solution for the held ones and the `sources` (one a vertex, those
    /// of held vertices are not used).
    ///
    /// # Panics
    /// When `values` or `sources` do not have one entry a vertex.
    pub fn solve<const K: usize>(&self, values: &mut [[f64; K]], sources: &[[f64; K]]) {
        assert!(values.len() == self.row.len() && sources.len() == self.row.len(), "one entry a vertex");
        let mut x = vec![0.0; K * self.rows];
        for (&r, s) in self.row.iter().zip(sources).filter(|(r, _)| **r != HELD) {
            for (k, s) in s.iter().enumerate() {
                x[k * self.rows + r as usize] = *s;
            }
        }
        for &(r, b, w) in &self.coupling {
            for (k, v) in values[b as usize].iter().enumerate() {
                x[k * self.rows + r as usize] += w * v;
            }
        }
        self.factor.solve(&mut x, K);
        for (&r, v) in self.row.iter().zip(values).filter(|(r, _)| **r != HELD) {
            *v = std::array::from_fn(|k| x[k * self.rows + r as usize]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chain_between_two_held_ends_is_a_straight_line_and_a_source_bends_it() {
        let edges = || (0..10u32).map(|i| (i, i + 1, 2.0));
        let held: Vec<bool> = (0..11).map(|i| i == 0 || i == 10).collect();
        let system = Dirichlet::new(&held, edges().chain([(3, 3, 9.0)])).unwrap();
        let mut values = vec![[0.0; 2]; 11];
        values[10] = [5.0, -5.0];
        system.solve(&mut values, &[[0.0; 2]; 11]);
        assert!((0..11).all(|i| (values[i][0] - 0.5 * i as f64).abs() < 1e-12 && values[i][0] == -values[i][1]));
        let mut bent = vec![[0.0]; 11];
        system.solve(&mut bent, &[[4.0]; 11]);
        assert!((0..11).all(|i| (bent[i][0] - (i * (10 - i)) as f64).abs() < 1e-9));
    }

    #[test]
    fn a_piece_without_a_held_vertex_is_refused() {
        assert!(Dirichlet::new(&[false; 3], [(0, 1, 1.0)].into_iter()).is_err());
        assert!(Dirichlet::new(&[true, false, false], [(0, 1, 1.0)].into_iter()).is_err());
    }
}
