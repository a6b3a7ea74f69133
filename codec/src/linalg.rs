//! Sparse symmetric positive definite systems: one factorization, many right-hand sides.

mod dissection;

use crate::{CodecError, Result};
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::LltRegularization;
use faer::perm::PermRef;
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side};
use glam::Vec3;

/// Lower triangle of a symmetric matrix in compressed sparse columns, rows ascending in a column.
#[derive(Debug, Clone, Default)]
pub struct LowerCsc {
    column_start: Vec<u32>,
    rows: Vec<u32>,
    values: Vec<f64>,
}

impl LowerCsc {
    /// Assembles an `n` by `n` matrix from a diagonal and off-diagonal entries `(row, column, value)`, row and
    /// column different, either triangle, each unordered pair added up.
    pub fn assemble(diagonal: &[f64], entries: &[(u32, u32, f64)]) -> Self {
        let n = diagonal.len();
        let mut start = vec![0u32; n + 1];
        for &(i, j, _) in entries {
            start[i.min(j) as usize + 1] += 1;
        }
        for c in 0..n {
            start[c + 1] += start[c];
        }
        let mut fill = start.clone();
        let mut bucket = vec![(0u32, 0f64); entries.len()];
        for &(i, j, v) in entries {
            let at = &mut fill[i.min(j) as usize];
            bucket[*at as usize] = (i.max(j), v);
            *at += 1;
        }
        let mut m = Self { column_start: Vec::with_capacity(n + 1), rows: Vec::new(), values: Vec::new() };
        m.column_start.push(0);
        for (c, &d) in diagonal.iter().enumerate() {
            let column = &mut bucket[start[c] as usize..start[c + 1] as usize];
            column.sort_unstable_by_key(|e| e.0);
            m.rows.push(c as u32);
            m.values.push(d);
            for &(r, v) in column.iter() {
                if m.rows.last() == Some(&r) && r as usize != c {
                    if let Some(last) = m.values.last_mut() {
                        *last += v;
                    }
                } else {
                    m.rows.push(r);
                    m.values.push(v);
                }
            }
            m.column_start.push(m.rows.len() as u32);
        }
        m
    }

    /// Appends the next column, (row, value) from the diagonal down; all columns are there when there is one a row.
    pub fn push_column(&mut self, column: impl Iterator<Item = (u32, f64)>) {
        if self.column_start.is_empty() {
            self.column_start.push(0);
        }
        for (row, value) in column {
            self.rows.push(row);
            self.values.push(value);
        }
        self.column_start.push(self.rows.len() as u32);
    }

    /// Entries of the lower triangle, diagonal included: (row, column, value), column by column, rows ascending.
    pub fn entries(&self) -> impl Iterator<Item = (u32, u32, f64)> + '_ {
        (0..self.size() as u32).flat_map(move |c| {
            let range = self.column_start[c as usize] as usize..self.column_start[c as usize + 1] as usize;
            self.rows[range.clone()].iter().zip(&self.values[range]).map(move |(&r, &v)| (r, c, v))
        })
    }

    /// A x, of the whole symmetric matrix.
    ///
    /// # Panics
    /// When `x` has not one value a row.
    pub fn multiply(&self, x: &[f64]) -> Vec<f64> {
        assert_eq!(x.len(), self.size(), "vector does not fit the matrix");
        let mut y = vec![0.0; x.len()];
        for (r, c, v) in self.entries() {
            y[r as usize] += v * x[c as usize];
            if r != c {
                y[c as usize] += v * x[r as usize];
            }
        }
        y
    }

    /// `scale` A + diag(`diagonal`), its entries in the same places.
    ///
    /// # Panics
    /// When `diagonal` has not one value a row.
    pub fn shifted(&self, scale: f64, diagonal: &[f64]) -> Self {
        assert_eq!(diagonal.len(), self.size(), "one value a row");
        let mut shifted = self.clone();
        shifted.values.iter_mut().for_each(|v| *v *= scale);
        for (&first, d) in self.column_start.iter().zip(diagonal) {
            shifted.values[first as usize] += d;
        }
        shifted
    }

    /// Rows (and columns) of the matrix.
    pub fn size(&self) -> usize {
        self.column_start.len().saturating_sub(1)
    }

    fn as_faer(&self) -> SparseColMatRef<'_, u32, f64> {
        let n = self.size();
        let symbolic = SymbolicSparseColMatRef::new_checked(n, n, &self.column_start, None, &self.rows);
        SparseColMatRef::new(symbolic, &self.values)
    }
}

/// Cholesky factor of a sparse symmetric positive definite matrix.
pub struct SparseLlt {
    symbolic: SymbolicCholesky<u32>,
    values: Vec<f64>,
    /// Column starts and rows of the matrix that `symbolic` was made for.
    pattern: (Vec<u32>, Vec<u32>),
}

impl SparseLlt {
    /// Factorizes a matrix (approximate minimum degree order, supernodal).
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when the matrix is not positive definite or memory runs out.
    pub fn factorize(matrix: &LowerCsc) -> Result<Self> {
        Self::factorize_in_order(matrix, SymmetricOrdering::Amd)
    }

    /// Factorizes a matrix whose rows have places in space, mm: ordered by nested dissection, several times faster to
    /// find on a mesh than minimum degree.
    ///
    /// # Errors
    /// As [`Self::factorize`].
    ///
    /// # Panics
    /// When there is not one place a row.
    pub fn factorize_placed(matrix: &LowerCsc, places_mm: &[Vec3]) -> Result<Self> {
        let order = dissection::nested_dissection(matrix, places_mm);
        let mut inverse = vec![0u32; order.len()];
        for (k, &row) in order.iter().enumerate() {
            inverse[row as usize] = k as u32;
        }
        let order = PermRef::new_checked(&order, &inverse, matrix.size());
        Self::factorize_in_order(matrix, SymmetricOrdering::Custom(order))
    }

    fn factorize_in_order(matrix: &LowerCsc, order: SymmetricOrdering<'_, u32>) -> Result<Self> {
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
            ..Default::default()
        };
        let symbolic = factorize_symbolic_cholesky(matrix.as_faer().symbolic(), Side::Lower, order, params)
            .map_err(|e| CodecError::Mesh(format!("ordering the Laplacian failed: {e:?}")))?;
        let values = vec![0.0; symbolic.len_val()];
        let mut factor = Self { symbolic, values, pattern: (matrix.column_start.clone(), matrix.rows.clone()) };
        factor.factorize_numeric(matrix)?;
        Ok(factor)
    }

    /// Factorizes into `slot`: order and symbolic factor of the matrix before are kept when it had the same pattern,
    /// otherwise it is ordered by the places of its rows.
    ///
    /// # Errors
    /// As [`Self::factorize`].
    pub fn factorize_again<'a>(
        slot: &'a mut Option<Self>,
        matrix: &LowerCsc,
        places_mm: impl FnOnce() -> Vec<Vec3>,
    ) -> Result<&'a Self> {
        let factor = match slot.take() {
            Some(mut factor) if factor.pattern.0 == matrix.column_start && factor.pattern.1 == matrix.rows => {
                factor.factorize_numeric(matrix)?;
                factor
            }
            _ => Self::factorize_placed(matrix, &places_mm())?,
        };
        Ok(slot.insert(factor))
    }

    fn factorize_numeric(&mut self, matrix: &LowerCsc) -> Result<()> {
        let scratch = self.symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default());
        let mut buffer = MemBuffer::new(scratch);
        self.symbolic
            .factorize_numeric_llt(
                &mut self.values,
                matrix.as_faer(),
                Side::Lower,
                LltRegularization::default(),
                Par::Seq,
                MemStack::new(&mut buffer),
                Default::default(),
            )
            .map_err(|e| CodecError::Mesh(format!("the Laplacian is not positive definite: {e:?}")))?;
        Ok(())
    }

    /// Rows of the matrix.
    pub fn size(&self) -> usize {
        self.symbolic.nrows()
    }

    /// Solves in place for `columns` right-hand sides laid out one after another in `rhs`.
    ///
    /// # Panics
    /// When `rhs.len()` is not `columns` times the size of the matrix.
    pub fn solve(&self, rhs: &mut [f64], columns: usize) {
        assert_eq!(rhs.len(), self.size() * columns, "right-hand side does not fit the matrix");
        let mut buffer = MemBuffer::new(self.symbolic.solve_in_place_scratch::<f64>(columns, Par::Seq));
        let factor = LltRef::new(&self.symbolic, &self.values);
        let rhs = MatMut::from_column_major_slice_mut(rhs, self.symbolic.nrows(), columns);
        factor.solve_in_place_with_conj(Conj::No, rhs, Par::Seq, MemStack::new(&mut buffer));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_a_chain_and_adds_duplicate_entries() {
        let entries: Vec<_> = (0..9u32).flat_map(|i| [(i, i + 1, -0.5), (i + 1, i, -0.5)]).collect();
        let a = LowerCsc::assemble(&[2.0; 10], &entries);
        let llt = SparseLlt::factorize(&a).unwrap();
        let x: Vec<f64> = (0..10).map(|i| f64::from(i) - 3.0).collect();
        let product = |x: &[f64]| -> Vec<f64> {
            (0..10)
                .map(|i| 2.0 * x[i] - if i > 0 { x[i - 1] } else { 0.0 } - if i < 9 { x[i + 1] } else { 0.0 })
                .collect()
        };
        let mut rhs = product(&x);
        rhs.extend(product(&[1.0; 10]));
        llt.solve(&mut rhs, 2);
        assert!(rhs[..10].iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-10));
        assert!(rhs[10..].iter().all(|a| (a - 1.0).abs() < 1e-10));
    }

    #[test]
    fn any_order_solves_alike() {
        let mesh = crate::mesh::test_surfaces::jittered_plate(20, 3);
        let laplacian = crate::mesh::cotangent_laplacian(&mesh);
        let grounded: Vec<f64> = (0..400).map(|i| if i == 7 { 1.0 } else { 0.0 }).collect();
        let (mut diagonal, mut entries) = (grounded, Vec::new());
        for (r, c, v) in laplacian.entries() {
            if r == c { diagonal[r as usize] += v } else { entries.push((r, c, v)) }
        }
        let matrix = LowerCsc::assemble(&diagonal, &entries);
        let x: Vec<f64> = (0..400).map(|i| f64::from(i % 17)).collect();
        for llt in [SparseLlt::factorize(&matrix), SparseLlt::factorize_placed(&matrix, &mesh.positions_mm)] {
            let mut rhs = matrix.multiply(&x);
            llt.unwrap().solve(&mut rhs, 1);
            assert!(rhs.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-8));
        }
    }

    #[test]
    fn matrices_of_the_same_and_of_another_pattern_are_solved_one_after_another() {
        let chain = |weight: f64| LowerCsc::assemble(&[2.0; 5], &[0u32, 1, 2, 3].map(|i| (i, i + 1, weight)));
        let mut slot = None;
        for matrix in [chain(-0.5), chain(0.25), LowerCsc::assemble(&[1.0, 2.0, 4.0], &[]), chain(-0.9)] {
            let places = || (0..matrix.size()).map(|i| Vec3::X * i as f32).collect();
            let llt = SparseLlt::factorize_again(&mut slot, &matrix, places).unwrap();
            let x: Vec<f64> = (0..matrix.size()).map(|i| 1.0 + i as f64).collect();
            let mut rhs = matrix.multiply(&x);
            llt.solve(&mut rhs, 1);
            assert!(rhs.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-10));
        }
        assert!(SparseLlt::factorize_again(&mut slot, &chain(9.0), Vec::new).is_err());
        assert!(slot.is_none(), "a factor that failed is of no use");
    }

    #[test]
    fn refuses_an_indefinite_matrix() {
        let a = LowerCsc::assemble(&[1.0, 1.0], &[(0, 1, 2.0)]);
        assert!(SparseLlt::factorize(&a).is_err());
    }
}
