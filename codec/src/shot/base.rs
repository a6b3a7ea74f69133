//! The base surface of a shot: a control lattice over the disk and a displacement along its normals.
//!
//! Displacements are coded from coarse to fine, each predicted from its decoded neighbours by four-point interpolation
//! (Deslauriers, Dubuc: Symmetric iterative interpolation processes, Constructive Approximation 1989).

use super::lattice::{GRID_CELLS, GRID_SIDE, LEVEL_SIDES, Nodes, evaluate, refine};
use crate::Result;
use crate::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};

/// Nodes a side of the base's control lattice.
pub const CONTROL_SIDE: usize = LEVEL_SIDES[1];
/// Fraction bits of a direction.
pub const DIRECTION_BITS: u32 = 14;
/// Coarsest spacing of displacement nodes, grid cells.
const COARSEST: usize = 64;

/// What is sent for a base.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CodedBase {
    /// Step of the control lattice, units.
    pub control_step: i32,
    /// Control points in steps.
    pub control: Nodes,
    /// Step of the displacement, units.
    pub displacement_step: i32,
    /// Residuals of the displacement in steps, by grid node; zero off the disk.
    pub residuals: Vec<i32>,
}

/// A base as every decoder has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Base {
    /// Position of each grid node, units.
    pub positions: Vec<[i32; 3]>,
    /// Unit normal of the surface at each node, times 2^14.
    pub normals: Vec<[i32; 3]>,
}

/// True for grid nodes on the disk that the square holds.
pub fn on_disk(x: usize, y: usize) -> bool {
    let (dx, dy) = (x as i32 - GRID_CELLS as i32 / 2, y as i32 - GRID_CELLS as i32 / 2);
    dx * dx + dy * dy <= (GRID_CELLS as i32 / 2) * (GRID_CELLS as i32 / 2)
}

/// The control surface on the grid, units, with its normals.
pub fn control_surface(control: &[[i32; 3]], step: i32) -> (Vec<[i32; 3]>, Vec<[i32; 3]>) {
    let units: Nodes = control.iter().map(|c| c.map(|v| v * step)).collect();
    let positions = evaluate(&refine(&units, CONTROL_SIDE));
    let normals = normals(&positions);
    (positions, normals)
}

/// Unit normals times 2^14 by central differences over two cells.
pub fn normals(positions: &[[i32; 3]]) -> Vec<[i32; 3]> {
    let last = GRID_CELLS;
    let at = |x: usize, y: usize| positions[y * GRID_SIDE + x];
    let mut out = Vec::with_capacity(positions.len());
    for y in 0..=last {
        for x in 0..=last {
            let u = difference(at((x + 2).min(last), y), at(x.saturating_sub(2), y));
            let v = difference(at(x, (y + 2).min(last)), at(x, y.saturating_sub(2)));
            out.push(unit(cross(u, v)));
        }
    }
    out
}

fn difference(a: [i32; 3], b: [i32; 3]) -> [i64; 3] {
    [0, 1, 2].map(|i| i64::from(a[i]) - i64::from(b[i]))
}

/// Cross product of vectors of less than 2^30.
pub fn cross(a: [i64; 3], b: [i64; 3]) -> [i64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The vector scaled to 2^14, rounded towards zero; +z where it has no length.
pub fn unit(v: [i64; 3]) -> [i32; 3] {
    let largest = v.iter().map(|c| c.unsigned_abs()).max().unwrap_or(0);
    if largest == 0 {
        return [0, 0, 1 << DIRECTION_BITS];
    }
    // Scaled so that squares keep 30 bits each.
    let shift = 64 - largest.leading_zeros() as i32 - 30;
    let v = v.map(|c| if shift > 0 { c >> shift } else { c << -shift });
    let length = (v.iter().map(|c| (c * c) as u64).sum::<u64>()).isqrt() as i64;
    v.map(|c| ((c << DIRECTION_BITS) / length) as i32)
}

impl CodedBase {
    /// The base that follows.
    pub fn build(&self) -> Base {
        let (mut positions, normals_of_control) = control_surface(&self.control, self.control_step);
        let displacement = self.displacement();
        for ((p, n), d) in positions.iter_mut().zip(&normals_of_control).zip(&displacement) {
            for i in 0..3 {
                // Displacements of several levels may add up to more than 17 bits.
                p[i] += ((i64::from(n[i]) * i64::from(*d)) >> DIRECTION_BITS) as i32;
            }
        }
        let normals = normals(&positions);
        Base { positions, normals }
    }

    fn displacement(&self) -> Vec<i32> {
        let mut values = vec![0; GRID_SIDE * GRID_SIDE];
        visit(|node| {
            let q = self.residuals[node.index()];
            values[node.index()] = node.predict(&values) + q * self.displacement_step;
        });
        values
    }

    /// Codes the base.
    pub fn encode(&self, out: &mut RangeEncoder) {
        let mut control = ControlModels::default();
        for (i, c) in self.control.iter().enumerate() {
            let predicted = predict_control(&self.control, i);
            for channel in 0..3 {
                let m = &mut control.0[channel];
                out.signed(&mut m.magnitude, &mut m.sign, c[channel] - predicted[channel]);
            }
        }
        let mut models = DisplacementModels::default();
        visit(|node| {
            let m = models.of(node, &self.residuals);
            out.signed(&mut m.magnitude, &mut m.sign, self.residuals[node.index()]);
        });
    }

    /// Reads a base.
    ///
    /// # Errors
    /// [`crate::CodecError::Payload`] for numbers out of range.
    pub fn decode(reader: &mut RangeDecoder<'_>, control_step: i32, displacement_step: i32) -> Result<Self> {
        let mut models = ControlModels::default();
        let mut control: Nodes = Vec::with_capacity(CONTROL_SIDE * CONTROL_SIDE);
        for i in 0..CONTROL_SIDE * CONTROL_SIDE {
            let mut c = predict_control(&control, i);
            for (c, m) in c.iter_mut().zip(&mut models.0) {
                // The sum of a prediction and 31 bits: saturated, it is out of range all the same.
                *c = c.saturating_add(reader.signed(&mut m.magnitude, &mut m.sign)?);
                if c.unsigned_abs() > (1 << 22) / control_step as u32 {
                    return Err(reader.error("a control point beyond 16 m"));
                }
            }
            control.push(c);
        }
        let mut models = DisplacementModels::default();
        let mut residuals = vec![0; GRID_SIDE * GRID_SIDE];
        let mut result = Ok(());
        visit(|node| {
            if result.is_err() {
                return;
            }
            let m = models.of(node, &residuals);
            match reader.signed(&mut m.magnitude, &mut m.sign) {
                Ok(q) if q.abs() <= (1 << 16) / displacement_step => residuals[node.index()] = q,
                Ok(_) => result = Err(reader.error("a displacement beyond 256 mm")),
                Err(error) => result = Err(error),
            }
        });
        result.map(|()| Self { control_step, control, displacement_step, residuals })
    }
}

/// Prediction of a control point from those before it: left + up - left-up, and linear along the first row and column.
fn predict_control(control: &[[i32; 3]], i: usize) -> [i32; 3] {
    let (x, y) = (i % CONTROL_SIDE, i / CONTROL_SIDE);
    let at = |x: usize, y: usize| control[y * CONTROL_SIDE + x];
    let line = |a: [i32; 3], b: [i32; 3]| [0, 1, 2].map(|c| 2 * a[c] - b[c]);
    match (x, y) {
        (0, 0) => [0; 3],
        (1, 0) => at(0, 0),
        (_, 0) => line(at(x - 1, 0), at(x - 2, 0)),
        (0, 1) => at(0, 0),
        (0, _) => line(at(0, y - 1), at(0, y - 2)),
        _ => [0, 1, 2].map(|c| at(x - 1, y)[c] + at(x, y - 1)[c] - at(x - 1, y - 1)[c]),
    }
}

struct SignedModels<const N: usize> {
    magnitude: [BitModel; N],
    sign: BitModel,
}

impl<const N: usize> Default for SignedModels<N> {
    fn default() -> Self {
        Self { magnitude: [BitModel::default(); N], sign: BitModel::default() }
    }
}

#[derive(Default)]
struct ControlModels([SignedModels<15>; 3]);

/// Levels of spacing 64, 32, ... 1.
const LEVELS: usize = 7;
/// Classes of neighbouring magnitudes.
const CLASSES: usize = 6;

#[derive(Default)]
struct DisplacementModels([[SignedModels<6>; CLASSES]; LEVELS]);

impl DisplacementModels {
    /// By the spacing, and by how large the residuals around are that a decoder already has.
    fn of(&mut self, node: Node, residuals: &[i32]) -> &mut SignedModels<6> {
        let s = node.spacing;
        let at = |dx: isize, dy: isize| node.beside(dx, dy).map_or(0, |i| residuals[i].unsigned_abs().min(8));
        let s2 = 2 * s as isize;
        let s = s as isize;
        let same = at(-s2, 0) + at(0, -s2);
        let coarse = match node {
            Node { coarsest: true, .. } => at(-s, 0) + at(0, -s),
            Node { vertical: true, .. } => at(0, -s) + at(0, s) + at(-s, 0),
            _ => at(-s, 0) + at(s, 0),
        };
        let class = match 2 * same + coarse {
            0 => 0,
            1 => 1,
            2 => 2,
            3..=4 => 3,
            5..=8 => 4,
            _ => 5,
        };
        &mut self.0[node.spacing.ilog2() as usize][class]
    }
}

/// A displacement node in coding order.
#[derive(Debug, Clone, Copy)]
pub struct Node {
    x: usize,
    y: usize,
    spacing: usize,
    /// Predicted along y rather than along x.
    vertical: bool,
    coarsest: bool,
}

impl Node {
    /// Index on the grid.
    pub fn index(self) -> usize {
        self.y * GRID_SIDE + self.x
    }

    fn beside(self, dx: isize, dy: isize) -> Option<usize> {
        let (x, y) = (self.x as isize + dx, self.y as isize + dy);
        let inside = |v: isize| (0..=GRID_CELLS as isize).contains(&v);
        (inside(x) && inside(y) && on_disk(x as usize, y as usize)).then(|| y as usize * GRID_SIDE + x as usize)
    }

    /// Four-point interpolation of the decoded neighbours on the disk; linear or constant towards its rim.
    pub fn predict(self, values: &[i32]) -> i32 {
        if self.coarsest {
            return 0;
        }
        let s = self.spacing as isize;
        let at =
            |k: isize| if self.vertical { self.beside(0, k * s) } else { self.beside(k * s, 0) }.map(|i| values[i]);
        match (at(-3), at(-1), at(1), at(3)) {
            (Some(a), Some(b), Some(c), Some(d)) => (9 * (b + c) - a - d + 8) >> 4,
            (_, Some(b), Some(c), _) => (b + c + 1) >> 1,
            (_, Some(b), None, _) => b,
            (_, None, Some(c), _) => c,
            _ => 0,
        }
    }
}

/// Calls `f` for each node on the disk from coarse to fine: on each level first the nodes between others of a row, then
/// those between rows.
pub fn visit(mut f: impl FnMut(Node)) {
    let mut call = |x: usize, y: usize, spacing: usize, vertical: bool, coarsest: bool| {
        if on_disk(x, y) {
            f(Node { x, y, spacing, vertical, coarsest });
        }
    };
    for y in (0..GRID_SIDE).step_by(COARSEST) {
        for x in (0..GRID_SIDE).step_by(COARSEST) {
            call(x, y, COARSEST, false, true);
        }
    }
    let mut s = COARSEST / 2;
    while s >= 1 {
        for y in (0..GRID_SIDE).step_by(2 * s) {
            for x in (s..GRID_SIDE).step_by(2 * s) {
                call(x, y, s, false, false);
            }
        }
        for y in (s..GRID_SIDE).step_by(2 * s) {
            for x in (0..GRID_SIDE).step_by(s) {
                call(x, y, s, true, false);
            }
        }
        s /= 2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_node_on_the_disk_is_visited_once_after_those_it_is_predicted_from() {
        let mut seen = vec![false; GRID_SIDE * GRID_SIDE];
        visit(|node| {
            assert!(!seen[node.index()]);
            if !node.coarsest {
                let s = node.spacing as isize;
                for k in [-3, -1, 1, 3] {
                    let beside = if node.vertical { node.beside(0, k * s) } else { node.beside(k * s, 0) };
                    assert!(beside.is_none_or(|i| seen[i]));
                }
            }
            seen[node.index()] = true;
        });
        let wanted = (0..GRID_SIDE * GRID_SIDE).filter(|i| on_disk(i % GRID_SIDE, i / GRID_SIDE)).count();
        assert_eq!(seen.iter().filter(|s| **s).count(), wanted);
    }

    #[test]
    fn unit_vectors_have_unit_length() {
        for v in [[3, 4, 0], [1 << 40, -(1 << 41), 5], [0, 0, -1], [1, 1, 1]] {
            let u = unit(v);
            let length = u.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt();
            assert!((length / 16384.0 - 1.0).abs() < 2e-4, "{v:?}: {length}");
        }
    }

    #[test]
    fn coded_bases_come_back() {
        let control = (0..CONTROL_SIDE * CONTROL_SIDE)
            .map(|i| [(i % CONTROL_SIDE) as i32 * 40, (i / CONTROL_SIDE) as i32 * -41, (i * i % 17) as i32])
            .collect();
        let residuals = (0..GRID_SIDE * GRID_SIDE)
            .map(|i| {
                if on_disk(i % GRID_SIDE, i / GRID_SIDE) && (i % 61 == 0 || i % 64 == i / GRID_SIDE % 64) {
                    (i % 9) as i32 - 4
                } else {
                    0
                }
            })
            .collect();
        let base = CodedBase { control_step: 64, control, displacement_step: 38, residuals };
        let mut out = RangeEncoder::default();
        base.encode(&mut out);
        let bytes = out.finish();
        let mut reader = RangeDecoder::new(&bytes, "base");
        assert_eq!(CodedBase::decode(&mut reader, 64, 38).unwrap(), base);
        reader.finish().unwrap();
        assert_eq!(base.build().positions.len(), GRID_SIDE * GRID_SIDE);
    }

    fn coded(symbols: impl Fn(&mut RangeEncoder, &mut ControlModels)) -> Vec<u8> {
        let mut out = RangeEncoder::default();
        symbols(&mut out, &mut ControlModels::default());
        out.finish()
    }

    #[test]
    fn a_control_point_that_would_wrap_round_is_refused() {
        let bytes = coded(|out, models| {
            // (0, 0) at -10, then (1, 0) at -10 - (2^31 - 2).
            for (k, v) in [-10, 0, 0, 2 - i32::MAX].into_iter().enumerate() {
                let m = &mut models.0[k % 3];
                out.signed(&mut m.magnitude, &mut m.sign, v);
            }
        });
        let error = CodedBase::decode(&mut RangeDecoder::new(&bytes, "base"), 64, 38).unwrap_err().to_string();
        assert!(error.contains("beyond 16 m"), "{error}");
    }

    #[test]
    fn the_largest_displacements_of_all_levels_add_up_without_overflow() {
        for step in [1, 64] {
            let most = (1 << 16) / step;
            let base = CodedBase {
                control_step: step,
                control: (0..CONTROL_SIDE * CONTROL_SIDE)
                    .map(|i| [[1, -1], [-1, 1]][i % 2][i / 19 % 2])
                    .map(|s| [s * (1 << 22) / step; 3])
                    .collect(),
                displacement_step: step,
                residuals: vec![most; GRID_SIDE * GRID_SIDE],
            };
            let built = base.build();
            assert!(built.positions.iter().flatten().all(|v| v.abs() < 1 << 24));
        }
    }
}
