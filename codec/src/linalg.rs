//! Sparse symmetric positive definite systems: one factorization, many right-hand sides.

use crate::{CodecError, Result};
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::LltRegularization;
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side};

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

    /// Rows (and columns) of the matrix.
    pub fn size(&self) -> usize {
        self.column_start.len() - 1
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
    size: usize,
}

impl SparseLlt {
    /// Factorizes a matrix (approximate minimum degree order, supernodal).
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when the matrix is not positive definite or memory runs out.
    pub fn factorize(matrix: &LowerCsc) -> Result<Self> {
        let a = matrix.as_faer();
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
            ..Default::default()
        };
        let symbolic = factorize_symbolic_cholesky(a.symbolic(), Side::Lower, SymmetricOrdering::Amd, params)
            .map_err(|e| CodecError::Mesh(format!("ordering the Laplacian failed: {e:?}")))?;
        let mut values = vec![0.0; symbolic.len_val()];
        let scratch = symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default());
        let mut buffer = MemBuffer::new(scratch);
        symbolic
            .factorize_numeric_llt(
                &mut values,
                a,
                Side::Lower,
                LltRegularization::default(),
                Par::Seq,
                MemStack::new(&mut buffer),
                Default::default(),
            )
            .map_err(|e| CodecError::Mesh(format!("the Laplacian is not positive definite: {e:?}")))?;
        Ok(Self { symbolic, values, size: matrix.size() })
    }

    /// Solves in place for `columns` right-hand sides laid out one after another in `rhs`.
    ///
    /// # Panics
    /// When `rhs.len()` is not `columns` times the size of the matrix.
    pub fn solve(&self, rhs: &mut [f64], columns: usize) {
        assert_eq!(rhs.len(), self.size * columns, "right-hand side does not fit the matrix");
        let mut buffer = MemBuffer::new(self.symbolic.solve_in_place_scratch::<f64>(columns, Par::Seq));
        let factor = LltRef::new(&self.symbolic, &self.values);
        let rhs = MatMut::from_column_major_slice_mut(rhs, self.size, columns);
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
    fn refuses_an_indefinite_matrix() {
        let a = LowerCsc::assemble(&[1.0, 1.0], &[(0, 1, 2.0)]);
        assert!(SparseLlt::factorize(&a).is_err());
    }
}
