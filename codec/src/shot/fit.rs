//! Point-to-plane normal equations of a motion lattice, level by level.
//!
//! Distances along the scan's normals are shape (Chen, Medioni: Object modelling by registration of multiple range images,
//! 1992); motion within the surface is held by tracked points and by a pull to what was predicted.

use super::UNITS_PER_MM;
use super::base::Base;
use super::lattice::{FINE_SIDE, GRID_CELLS, GRID_SIDE, LEVEL_SIDES};
use glam::{DMat3, DVec3};

/// Nodes that a node's basis function overlaps, a side.
const STENCIL: usize = 7;

/// Pairs of the four basis functions of a span, the earlier one first.
const PAIRS: [[usize; 2]; 10] = [[0, 0], [0, 1], [0, 2], [0, 3], [1, 1], [1, 2], [1, 3], [2, 2], [2, 3], [3, 3]];
/// Where a pair stands among them.
const PAIR_OF: [[usize; 4]; 4] = [[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]];
/// Six sums for each pair along a row.
const ROW_SUMS: usize = 6 * PAIRS.len();
/// Those for each pair of rows.
const CELL_SUMS: usize = ROW_SUMS * PAIRS.len();

/// One equation: the displacement at a grid node along `direction` should be `distance_mm` more.
#[derive(Debug, Clone, Copy)]
pub struct Equation {
    /// Grid position of the base point.
    pub grid: [f64; 2],
    /// Unit vector in base coordinates.
    pub direction: DVec3,
    /// What is missing along it, mm.
    pub distance_mm: f64,
    /// Weight.
    pub weight: f64,
}

/// Normal equations of one level in space coordinates, mm.
#[derive(Debug, Clone)]
pub struct LevelSystem {
    /// Nodes a side.
    pub side: usize,
    /// For each node 7x7 blocks, symmetric, their upper triangles: how a node beside pulls at it.
    blocks: Vec<[f32; 6]>,
}

impl LevelSystem {
    /// An empty system.
    pub fn new(side: usize) -> Self {
        Self { side, blocks: vec![[0.0; 6]; side * side * STENCIL * STENCIL] }
    }

    fn block(&self, node: usize, dx: usize, dy: usize) -> &[f32; 6] {
        &self.blocks[(node * STENCIL + dy) * STENCIL + dx]
    }

    /// Adds `weight * direction directionᵀ` of each equation, in the order of their rows on the grid, for all pairs of the
    /// 16 nodes around its point. Sums over the equations of a cell are taken first, row by row and then over its rows, and
    /// given to the pairs of nodes once a cell.
    fn add_all(&mut self, equations: &[Equation]) {
        let spans = self.side - 3;
        let mut cells = vec![[0.0; CELL_SUMS]; spans];
        let mut is_used = vec![false; spans];
        let mut rest = equations;
        while let Some(first) = rest.first() {
            let sy = self.span(first.grid[1]);
            let count = rest.iter().position(|e| self.span(e.grid[1]) != sy).unwrap_or(rest.len());
            self.add_to_cells(&rest[..count], &mut cells, &mut is_used);
            for sx in (0..spans).filter(|sx| is_used[*sx]) {
                self.add_cell(sy * self.side + sx, &cells[sx]);
                cells[sx].fill(0.0);
            }
            is_used.fill(false);
            rest = &rest[count..];
        }
    }

    /// Adds equations of one span of rows to the sums of its cells.
    fn add_to_cells(&self, equations: &[Equation], cells: &mut [[f32; CELL_SUMS]], is_used: &mut [bool]) {
        let mut rest = equations;
        while let Some(first) = rest.first() {
            let sx = self.span(first.grid[0]);
            let is_beside = |e: &Equation| e.grid[1] == first.grid[1] && self.span(e.grid[0]) == sx;
            let count = rest.iter().position(|e| !is_beside(e)).unwrap_or(rest.len());
            let mut along = [0.0; ROW_SUMS];
            for e in &rest[..count] {
                self.add_along(e, &mut along);
            }
            let (_, wy) = self.axis(first.grid[1]);
            for (sums, [j, jj]) in cells[sx].chunks_exact_mut(ROW_SUMS).zip(PAIRS) {
                let w = (wy[j] * wy[jj]) as f32;
                sums.iter_mut().zip(&along).for_each(|(sum, a)| *sum += a * w);
            }
            is_used[sx] = true;
            rest = &rest[count..];
        }
    }

    /// Adds an equation to the sums of a row of a cell, weighted along the row alone.
    fn add_along(&self, e: &Equation, along: &mut [f32; ROW_SUMS]) {
        let (_, wx) = self.axis(e.grid[0]);
        let (d, u) = (e.direction * e.weight, e.direction);
        let outer = [d.x * u.x, d.x * u.y, d.x * u.z, d.y * u.y, d.y * u.z, d.z * u.z].map(|v| v as f32);
        for (sums, [i, ii]) in along.chunks_exact_mut(6).zip(PAIRS) {
            let w = (wx[i] * wx[ii]) as f32;
            sums.iter_mut().zip(outer).for_each(|(sum, o)| *sum += o * w);
        }
    }

    /// Adds the sums of a cell to the blocks of its 16 nodes, the first of them `corner`; of each pair of nodes to the
    /// earlier one.
    fn add_cell(&mut self, corner: usize, sums: &[f32; CELL_SUMS]) {
        for (sums, [j, jj]) in sums.chunks_exact(ROW_SUMS).zip(PAIRS) {
            for i in 0..4 {
                let node = corner + j * self.side + i;
                let row = (node * STENCIL + jj + 3 - j) * STENCIL + 3 - i;
                for ii in if jj == j { i } else { 0 }..4 {
                    let pair = 6 * PAIR_OF[i.min(ii)][i.max(ii)];
                    let block = &mut self.blocks[row + ii];
                    block.iter_mut().zip(&sums[pair..pair + 6]).for_each(|(b, s)| *b += s);
                }
            }
        }
    }

    /// Gives each pair's later node what its earlier one has.
    fn mirror(&mut self) {
        const LAST: usize = STENCIL * STENCIL - 1;
        for node in 0..self.side * self.side {
            for k in LAST / 2 + 1..=LAST {
                let (dx, dy) = (k % STENCIL, k / STENCIL);
                // Beyond the lattice on either side there is no node; what wraps around holds zeros.
                let other = node + dy * self.side + dx - (3 * self.side + 3);
                if other < self.side * self.side {
                    self.blocks[other * STENCIL * STENCIL + LAST - k] = self.blocks[node * STENCIL * STENCIL + k];
                }
            }
        }
    }

    /// Span that a grid coordinate lies in.
    fn span(&self, grid: f64) -> usize {
        ((grid * ((self.side - 3) as f64 / GRID_CELLS as f64)) as usize).min(self.side - 4)
    }

    /// Span that a grid coordinate lies in, and the weights of its four nodes.
    fn axis(&self, grid: f64) -> (usize, [f64; 4]) {
        let span = self.span(grid);
        let t = grid * ((self.side - 3) as f64 / GRID_CELLS as f64) - span as f64;
        let q = 1.0 - t;
        (
            span,
            [q * q * q, 3.0 * t * t * t - 6.0 * t * t + 4.0, 3.0 * q * q * q - 6.0 * q * q + 4.0, t * t * t]
                .map(|w| w * (1.0 / 6.0)),
        )
    }

    /// Adds `weight` times the squared second differences of neighbouring nodes, all directions alike.
    pub fn add_bending(&mut self, weight: f32) {
        let n = self.side;
        for y in 0..n {
            for x in 1..n - 1 {
                self.add_difference([(x - 1, y), (x, y), (x + 1, y)], weight);
                self.add_difference([(y, x - 1), (y, x), (y, x + 1)], weight);
            }
        }
    }

    fn add_difference(&mut self, nodes: [(usize, usize); 3], weight: f32) {
        let w = [1.0, -2.0, 1.0];
        for (a, &(xa, ya)) in nodes.iter().enumerate() {
            for (b, &(xb, yb)) in nodes.iter().enumerate() {
                let at = ((ya * self.side + xa) * STENCIL + yb + 3 - ya) * STENCIL + xb + 3 - xa;
                for k in [0, 3, 5] {
                    self.blocks[at][k] += weight * w[a] * w[b];
                }
            }
        }
    }

    /// Adds `weight` to the diagonal.
    pub fn add_pull(&mut self, weight: f32) {
        for node in 0..self.side * self.side {
            let at = (node * STENCIL + 3) * STENCIL + 3;
            for k in [0, 3, 5] {
                self.blocks[at][k] += weight;
            }
        }
    }

    /// `vᵀ A v` of a vector at one node.
    pub fn curvature(&self, node: usize, v: DVec3) -> f64 {
        v.dot(multiply(self.block(node, 3, 3), v))
    }

    /// Subtracts `A` times a change `v` at one node from a gradient.
    pub fn subtract(&self, node: usize, v: DVec3, gradient: &mut [DVec3]) {
        let (x, y) = (node % self.side, node / self.side);
        for dy in 0..STENCIL {
            let Some(yy) = (y + dy).checked_sub(3).filter(|v| *v < self.side) else { continue };
            for dx in 0..STENCIL {
                let Some(xx) = (x + dx).checked_sub(3).filter(|v| *v < self.side) else { continue };
                gradient[yy * self.side + xx] -= multiply(self.block(node, dx, dy), v);
            }
        }
    }
}

fn multiply(b: &[f32; 6], v: DVec3) -> DVec3 {
    let b = b.map(f64::from);
    DMat3::from_cols(DVec3::new(b[0], b[1], b[2]), DVec3::new(b[1], b[3], b[4]), DVec3::new(b[2], b[4], b[5])) * v
}

/// Right side `Bᵀ W d` of the equations on the finest level.
pub fn right_side(equations: &[Equation]) -> Vec<DVec3> {
    let system = LevelSystem { side: FINE_SIDE, blocks: Vec::new() };
    let mut right = vec![DVec3::ZERO; FINE_SIDE * FINE_SIDE];
    for e in equations {
        let ((sx, wx), (sy, wy)) = (system.axis(e.grid[0]), system.axis(e.grid[1]));
        for k in 0..16 {
            right[(sy + k / 4) * FINE_SIDE + sx + k % 4] +=
                e.direction * (e.weight * e.distance_mm * wx[k % 4] * wy[k / 4]);
        }
    }
    right
}

/// Gradient of a coarse level from that of the next finer one: the transpose of knot insertion.
pub fn restrict(fine: &[DVec3], fine_side: usize) -> Vec<DVec3> {
    let side = (fine_side + 3) / 2;
    let mut wide = vec![DVec3::ZERO; side * fine_side];
    for y in 0..fine_side {
        for x in 0..fine_side {
            spread(x, |i, w| wide[y * side + i] += fine[y * fine_side + x] * w);
        }
    }
    let mut out = vec![DVec3::ZERO; side * side];
    for y in 0..fine_side {
        for x in 0..side {
            spread(y, |j, w| out[j * side + x] += wide[y * side + x] * w);
        }
    }
    out
}

fn spread(k: usize, mut f: impl FnMut(usize, f64)) {
    let i = k.div_ceil(2);
    if k % 2 == 1 {
        f(i - 1, 0.125);
        f(i, 0.75);
        f(i + 1, 0.125);
    } else {
        f(i, 0.5);
        f(i + 1, 0.5);
    }
}

/// The systems of all levels; quick when equations come in the order of their rows on the grid.
pub fn systems(equations: &[Equation], bending: f32, pull: f32) -> [LevelSystem; 3] {
    LEVEL_SIDES.map(|side| {
        let mut system = LevelSystem::new(side);
        system.add_all(equations);
        system.mirror();
        system.add_bending(bending);
        system.add_pull(pull);
        system
    })
}

/// Displacement (mm) of a lattice in 1/16 units anywhere on the grid.
pub fn displacement_at_mm(nodes: &[[i32; 3]], grid: [f64; 2]) -> DVec3 {
    let system = LevelSystem { side: FINE_SIDE, blocks: Vec::new() };
    let ((sx, wx), (sy, wy)) = (system.axis(grid[0]), system.axis(grid[1]));
    let mut sum = DVec3::ZERO;
    for k in 0..16 {
        let c = nodes[(sy + k / 4) * FINE_SIDE + sx + k % 4];
        sum += DVec3::from_array(c.map(f64::from)) * (wx[k % 4] * wy[k / 4]);
    }
    sum / f64::from(UNITS_PER_MM << super::motion::NODE_BITS)
}

/// Base point (mm) anywhere on the grid, bilinear between its nodes.
pub fn base_at_mm(base: &Base, [x, y]: [f64; 2]) -> DVec3 {
    let (i, j) = ((x as usize).min(GRID_SIDE - 2), (y as usize).min(GRID_SIDE - 2));
    let (u, v) = (x - i as f64, y - j as f64);
    let at = |i: usize, j: usize| DVec3::from_array(base.positions[j * GRID_SIDE + i].map(f64::from));
    let mixed = at(i, j).lerp(at(i + 1, j), u).lerp(at(i, j + 1).lerp(at(i + 1, j + 1), u), v);
    mixed / f64::from(UNITS_PER_MM)
}
