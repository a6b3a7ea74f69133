//! Uniform cubic B-spline lattices over the square [-1, 1]² that holds the disk, three integer channels a node.
//!
//! Levels of 11, 19 and 35 nodes a side have 8, 16 and 32 spans: a coarse level is a fine one by knot insertion, so that
//! their sum is evaluated once (Forsey, Bartels: Hierarchical B-spline refinement, SIGGRAPH 1988).

/// Nodes a side of the levels, coarse to fine.
pub const LEVEL_SIDES: [usize; 3] = [11, 19, 35];
/// Nodes a side of the finest level.
pub const FINE_SIDE: usize = LEVEL_SIDES[2];
/// Cells a side of the domain grid.
pub const GRID_CELLS: usize = 256;
/// Nodes a side of the domain grid.
pub const GRID_SIDE: usize = GRID_CELLS + 1;
/// Grid cells a span of the finest level.
pub const CELLS_PER_SPAN: usize = GRID_CELLS / (FINE_SIDE - 3);
/// Weights of one axis sum to this.
const WEIGHT_SUM: i64 = 3072;

/// The four B-spline weights at `phase` eighths of a span, times 3072.
pub const WEIGHTS: [[i32; 4]; CELLS_PER_SPAN + 1] = weights();

const fn weights() -> [[i32; 4]; CELLS_PER_SPAN + 1] {
    let mut table = [[0; 4]; CELLS_PER_SPAN + 1];
    let mut phase = 0;
    while phase <= CELLS_PER_SPAN {
        let p = phase as i32;
        let q = 8 - p;
        table[phase] = [q * q * q, 3 * p * p * p - 48 * p * p + 2048, 3 * q * q * q - 48 * q * q + 2048, p * p * p];
        phase += 1;
    }
    table
}

/// Span and phase of a grid coordinate; the last node is the end of the last span.
pub const fn span_of(grid: usize) -> (usize, usize) {
    if grid == GRID_CELLS {
        (GRID_CELLS / CELLS_PER_SPAN - 1, CELLS_PER_SPAN)
    } else {
        (grid / CELLS_PER_SPAN, grid % CELLS_PER_SPAN)
    }
}

/// Control points of one level, row-major.
pub type Nodes = Vec<[i32; 3]>;

/// The same function on the next finer level, `2 side - 3` nodes a side; rounded to the nearest, halves up.
///
/// # Panics
/// When `nodes` is not `side` by `side`.
pub fn refine(nodes: &[[i32; 3]], side: usize) -> Nodes {
    assert_eq!(nodes.len(), side * side, "a square lattice");
    let fine = 2 * side - 3;
    let wide: Nodes = nodes.chunks_exact(side).flat_map(|row| (0..fine).map(|k| refined(k, |i| row[i]))).collect();
    let column = |x: usize, k: usize| refined(k, |i| wide[i * fine + x]);
    (0..fine).flat_map(|y| (0..fine).map(move |x| (x, y))).map(|(x, y)| column(x, y)).collect()
}

fn refined(k: usize, at: impl Fn(usize) -> [i32; 3]) -> [i32; 3] {
    let i = k.div_ceil(2);
    if k % 2 == 1 {
        let (a, b, c) = (at(i - 1), at(i), at(i + 1));
        [0, 1, 2].map(|j| (a[j] + 6 * b[j] + c[j] + 4) >> 3)
    } else {
        let (a, b) = (at(i), at(i + 1));
        [0, 1, 2].map(|j| (a[j] + b[j] + 1) >> 1)
    }
}

/// Values of the finest level on the whole domain grid, row-major, rounded to the nearest.
///
/// # Panics
/// When `nodes` is not [`FINE_SIDE`] squared.
pub fn evaluate(nodes: &[[i32; 3]]) -> Vec<[i32; 3]> {
    let across = Across::new(nodes);
    (0..GRID_SIDE).flat_map(|y| (0..GRID_SIDE).map(move |x| [x, y])).map(|[x, y]| across.at(x, y)).collect()
}

/// The finest level evaluated along its rows: what is left to do for a value is one column of four.
#[derive(Debug)]
pub struct Across {
    rows: Vec<[i32; 3]>,
    /// No weighted sum leaves 32 bits.
    is_narrow: bool,
}

/// Values up to this have weighted sums within 32 bits.
const NARROW: u32 = (i32::MAX as u32 - WEIGHT_SUM as u32) / WEIGHT_SUM as u32;

impl Across {
    /// # Panics
    /// When `nodes` is not [`FINE_SIDE`] squared.
    pub fn new(nodes: &[[i32; 3]]) -> Self {
        assert_eq!(nodes.len(), FINE_SIDE * FINE_SIDE, "the finest level");
        let is_narrow = nodes.iter().flatten().all(|v| v.unsigned_abs() <= NARROW);
        let mut rows = Vec::with_capacity(FINE_SIDE * GRID_SIDE);
        for row in nodes.chunks_exact(FINE_SIDE) {
            for x in 0..GRID_SIDE {
                let (span, phase) = span_of(x);
                rows.push(blend(
                    &WEIGHTS[phase],
                    [&row[span], &row[span + 1], &row[span + 2], &row[span + 3]],
                    is_narrow,
                ));
            }
        }
        Self { rows, is_narrow }
    }

    /// Value at a grid node, rounded to the nearest.
    pub fn at(&self, x: usize, y: usize) -> [i32; 3] {
        let (span, phase) = span_of(y);
        let row = |i: usize| &self.rows[(span + i) * GRID_SIDE + x];
        blend(&WEIGHTS[phase], [row(0), row(1), row(2), row(3)], self.is_narrow)
    }
}

fn blend(w: &[i32; 4], [a, b, c, d]: [&[i32; 3]; 4], is_narrow: bool) -> [i32; 3] {
    if is_narrow {
        let value = |j: usize| {
            let sum = w[0] * a[j] + w[1] * b[j] + w[2] * c[j] + w[3] * d[j];
            (sum + WEIGHT_SUM as i32 / 2).div_euclid(WEIGHT_SUM as i32)
        };
        return [value(0), value(1), value(2)];
    }
    [0, 1, 2].map(|j| {
        let terms = [a, b, c, d].into_iter().zip(w).map(|(c, w)| i64::from(*w) * i64::from(c[j]));
        (terms.sum::<i64>() + WEIGHT_SUM / 2).div_euclid(WEIGHT_SUM) as i32
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_sum_to_one_and_reproduce_lines() {
        for (phase, w) in WEIGHTS.iter().enumerate() {
            assert_eq!(w.iter().sum::<i32>(), 3072);
            let line: i32 = w.iter().zip([-1, 0, 1, 2]).map(|(w, x)| w * x * 8).sum();
            assert_eq!(line, 3072 * phase as i32);
        }
    }

    #[test]
    fn refining_keeps_the_function() {
        let nodes: Nodes = (0..19 * 19).map(|i| [(i * 7919 % 4001 - 2000) * 64, i * i % 977 * 64, -i * 640]).collect();
        let fine = refine(&nodes, 19);
        assert_eq!(fine.len(), FINE_SIDE * FINE_SIDE);
        let values = evaluate(&fine);
        for y in (0..=GRID_CELLS).step_by(16) {
            for x in (0..=GRID_CELLS).step_by(16) {
                // On knots of the coarse level the weights are 1/6, 4/6, 1/6.
                let (i, j) = (x / 16, y / 16);
                for c in 0..3 {
                    let at = |dx: usize, dy: usize| f64::from(nodes[(j + dy) * 19 + i + dx][c]);
                    let w = [1.0, 4.0, 1.0];
                    let sum: f64 =
                        (0..3).flat_map(|a| (0..3).map(move |b| (a, b))).map(|(a, b)| w[a] * w[b] * at(a, b)).sum();
                    assert!((sum / 36.0 - f64::from(values[y * GRID_SIDE + x][c])).abs() < 3.0);
                }
            }
        }
    }

    #[test]
    fn a_constant_and_a_line_are_exact() {
        let nodes: Nodes =
            (0..FINE_SIDE * FINE_SIDE).map(|i| [5, (i % FINE_SIDE) as i32 * 8, (i / FINE_SIDE) as i32 * -16]).collect();
        let values = evaluate(&nodes);
        for (i, v) in values.iter().enumerate() {
            assert_eq!(*v, [5, 8 + (i % GRID_SIDE) as i32, -16 - 2 * (i / GRID_SIDE) as i32]);
        }
    }

    #[test]
    fn wide_and_narrow_sums_agree() {
        let nodes: Nodes =
            (0..(FINE_SIDE * FINE_SIDE) as i32).map(|i| [i * 7919 % 600_001 - 300_000, -i, i * 97 - 9000]).collect();
        let narrow = Across::new(&nodes);
        assert!(narrow.is_narrow);
        let wide = Across { rows: narrow.rows.clone(), is_narrow: false };
        assert!(
            (0..GRID_SIDE * GRID_SIDE)
                .all(|i| narrow.at(i % GRID_SIDE, i / GRID_SIDE) == wide.at(i % GRID_SIDE, i / GRID_SIDE))
        );
        let far: Nodes = nodes.iter().map(|n| n.map(|v| v * 100)).collect();
        assert!(!Across::new(&far).is_narrow);
    }
}
