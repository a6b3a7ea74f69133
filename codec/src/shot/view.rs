//! The camera of a run in integers: where a point is seen, how deep, and back.

use super::reciprocal::Reciprocal;
use crate::texture::CameraFit;
use crate::{CodecError, Result};
use glam::DVec3;

/// Fraction bits of a picture position.
pub const PX_BITS: u32 = 8;
/// Fraction bits of the depth axis.
const AXIS_BITS: u32 = 14;
/// Bits of the homogeneous divisor at the middle of the surface.
const DIVISOR_BITS: u32 = 34;

/// Largest factors of coordinates and constants of the first two rows and of the last one: no product overflows for points
/// within 2^24.3 units and pixels moved by up to 2^20 / 256.
const LIMITS: [[u64; 2]; 3] = [[1 << 33, 1 << 60], [1 << 33, 1 << 60], [1 << 22, 1 << 44]];

/// Projection `(x, y) = (row0 X / row2 X, row1 X / row2 X)` of points in units, and depth `axis X`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct View {
    /// Three rows of a 3x4 camera, times a common factor.
    pub rows: [[i64; 4]; 3],
    /// Unit vector away from the camera, times 2^14.
    pub axis: [i64; 3],
}

/// A point seen: position in 1/256 px, depth in units.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Seen {
    /// Columns from the first pixel's centre.
    pub x: i32,
    /// Rows from the first pixel's centre, downwards.
    pub y: i32,
    /// Along the viewing axis.
    pub depth: i32,
}

impl Seen {
    /// What lies behind the camera or far outside any picture: no triangle with this corner is drawn.
    pub const NOWHERE: Self = Self { x: 1 << 25, y: 1 << 25, depth: 0 };
}

impl View {
    /// The integer form of a fitted camera (mm to px) for a surface around `centre_mm` whose normals look at the camera
    /// against `facing` (mean normal of the surface).
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when the camera is out of range.
    pub fn new(camera: &CameraFit, centre_mm: DVec3, facing: DVec3) -> Result<Self> {
        let m = &camera.matrix;
        let row = |r: usize| DVec3::new(m[4 * r], m[4 * r + 1], m[4 * r + 2]);
        let divisor = row(2).dot(centre_mm) + m[11];
        let affine = row(2).length() * 1000.0 < divisor.abs() * 1e-3;
        let toward = if affine { row(0).cross(row(1)) } else { row(2) * divisor.signum() };
        let axis = toward.normalize_or_zero();
        let axis = if affine && axis.dot(facing) > 0.0 { -axis } else { axis };
        let scale = f64::from(1u32 << 17) * f64::from(1u32 << (DIVISOR_BITS - 17)) / divisor;
        let units = f64::from(super::UNITS_PER_MM);
        let mut rows = [[0; 4]; 3];
        for (r, out) in rows.iter_mut().enumerate() {
            for c in 0..4 {
                // Numbers too large saturate, and are then out of range.
                out[c] = (m[4 * r + c] * scale / if c < 3 { units } else { 1.0 }).round() as i64;
            }
        }
        let view = Self { rows, axis: axis.to_array().map(|a| (a * f64::from(1 << AXIS_BITS)).round() as i64) };
        if view.in_range() { Ok(view) } else { Err(CodecError::Mesh("the camera of the scan is out of range".into())) }
    }

    /// True when no later product overflows.
    pub fn in_range(&self) -> bool {
        let small = |(row, [slope, constant]): (&[i64; 4], [u64; 2])| {
            row[..3].iter().all(|v| v.unsigned_abs() < slope) && row[3].unsigned_abs() < constant
        };
        self.rows.iter().zip(LIMITS).all(small) && self.axis.iter().all(|a| a.unsigned_abs() <= 1 << (AXIS_BITS + 1))
    }

    /// Where a point (units) is seen; `None` behind the camera or far outside any picture.
    pub fn project(&self, p: [i32; 3]) -> Option<Seen> {
        let p = p.map(i64::from);
        let dot = |r: &[i64; 4]| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3];
        let divisor = dot(&self.rows[2]) >> PX_BITS;
        if divisor <= 0 {
            return None;
        }
        let by = Reciprocal::new(divisor);
        let [x, y] = [0, 1].map(|r| by.floor(dot(&self.rows[r]) + divisor / 2));
        if x.abs() >= 1 << 24 || y.abs() >= 1 << 24 {
            return None;
        }
        let depth = (self.axis[0] * p[0] + self.axis[1] * p[1] + self.axis[2] * p[2]) >> AXIS_BITS;
        Some(Seen { x: x as i32, y: y as i32, depth: depth as i32 })
    }

    /// The view whose pixels count from a first pixel that lies `offset` (1/256 px) before this one's.
    pub fn moved(&self, offset: [i32; 2]) -> Self {
        let mut rows = self.rows;
        for (row, by) in rows.iter_mut().zip(offset) {
            for (v, last) in row.iter_mut().zip(&self.rows[2]) {
                *v += ((i128::from(*last) * i128::from(by)) >> PX_BITS) as i64;
            }
        }
        Self { rows, axis: self.axis }
    }

    /// Turns what is seen back into points, mm.
    pub fn back_projection(&self) -> BackProjection {
        let f = |v: i64| v as f64;
        let row = |r: usize| DVec3::new(f(self.rows[r][0]), f(self.rows[r][1]), f(self.rows[r][2]));
        BackProjection {
            rows: [row(0), row(1), row(2)],
            last: [f(self.rows[0][3]), f(self.rows[1][3]), f(self.rows[2][3])],
            axis: DVec3::from_array(self.axis.map(f)) / f64::from(1 << AXIS_BITS),
        }
    }
}

/// Inverse of [`View::project`], for display.
#[derive(Debug, Clone, Copy)]
pub struct BackProjection {
    rows: [DVec3; 3],
    last: [f64; 3],
    axis: DVec3,
}

impl BackProjection {
    /// Depth (units) of a point in mm.
    pub fn depth_of(&self, point_mm: DVec3) -> f64 {
        self.axis.dot(point_mm) * f64::from(super::UNITS_PER_MM)
    }

    /// What holds for all points of a picture row, `y_px` from the first pixel's centre.
    pub fn row(&self, y_px: f64) -> BackRow {
        let [r0, r1, r2] = self.rows;
        // Of row0 - x row2, row1 - y row2 and the axis, the first alone depends on x; Cramer's rule is linear in it.
        let b = r1 - r2 * y_px;
        let beside = b.cross(self.axis);
        let right = y_px * self.last[2] - self.last[1];
        let scale = 1.0 / f64::from(super::UNITS_PER_MM);
        BackRow {
            start: [(self.axis.cross(r0) * right - beside * self.last[0]) * scale, r0.cross(b) * scale],
            slope: [(beside * self.last[2] - self.axis.cross(r2) * right) * scale, -r2.cross(b) * scale],
            divisor: [r0.dot(beside), -r2.dot(beside)],
        }
    }

    /// The point (mm) seen at (x, y) px at a depth in units.
    pub fn point_mm(&self, x_px: f64, y_px: f64, depth: f64) -> DVec3 {
        self.row(y_px).point_mm(x_px, depth)
    }
}

/// A picture row of a [`BackProjection`]: points are a ratio of terms linear in the column.
#[derive(Debug, Clone, Copy)]
pub struct BackRow {
    /// At column 0 what does not depend on depth, and what it is multiplied by.
    start: [DVec3; 2],
    /// Both a column farther.
    slope: [DVec3; 2],
    /// Divisor at column 0, and a column farther.
    divisor: [f64; 2],
}

impl BackRow {
    /// The point (mm) seen at a column (px) at a depth in units.
    pub fn point_mm(&self, x_px: f64, depth: f64) -> DVec3 {
        let sum = self.start[0] + self.slope[0] * x_px + (self.start[1] + self.slope[1] * x_px) * depth;
        sum * (1.0 / (self.divisor[0] + self.divisor[1] * x_px))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_seen_goes_back_to_where_it_was() {
        let near = View::new(
            &CameraFit {
                matrix: [900.0, 20.0, 150.0, 9e4, -10.0, -880.0, 120.0, 8e4, 0.02, -0.05, 1.0, 600.0],
                max_error_px: 0.0,
                rms_error_px: 0.0,
            },
            DVec3::ZERO,
            DVec3::NEG_Z,
        );
        let far = View::new(
            &CameraFit {
                matrix: [2.0, 0.1, 0.2, 150.0, 0.1, -2.1, 0.3, 160.0, 0.0, 0.0, 0.0, 1.0],
                max_error_px: 0.0,
                rms_error_px: 0.0,
            },
            DVec3::ZERO,
            DVec3::NEG_Z,
        );
        for view in [near.unwrap(), far.unwrap()] {
            let back = view.back_projection();
            for k in 0..200_i32 {
                let p = [k * 97 % 20_000 - 9000, k * 131 % 20_000 - 8000, k * 89 % 15_000 - 7000];
                let s = view.project(p).unwrap();
                let q = back.point_mm(f64::from(s.x) / 256.0, f64::from(s.y) / 256.0, f64::from(s.depth));
                let p = DVec3::from_array(p.map(f64::from)) / f64::from(crate::shot::UNITS_PER_MM);
                assert!((p - q).length() < 0.02, "{p} {q}");
            }
        }
    }
}

#[cfg(test)]
mod limit_tests {
    use super::*;
    use proptest::prelude::*;

    /// A pinhole camera 500 mm in front of the origin.
    fn pinhole() -> View {
        let matrix = [-800.0, 0.0, 100.0, -50_000.0, 0.0, 800.0, 80.0, -40_000.0, 0.0, 0.0, 1.0, -500.0];
        let camera = CameraFit { matrix, max_error_px: 0.0, rms_error_px: 0.0 };
        View::new(&camera, DVec3::ZERO, DVec3::Z).unwrap()
    }

    proptest! {
        #[test]
        fn what_is_seen_comes_back(p in prop::array::uniform3(-25_000_i32..25_000), offset in prop::array::uniform2(-2000_i32..2000)) {
            let view = pinhole().moved(offset);
            let seen = view.project(p).unwrap();
            let at = |v: i32| f64::from(v) / 256.0;
            let back = view.back_projection().point_mm(at(seen.x), at(seen.y), f64::from(seen.depth)) * 256.0;
            let still = pinhole().project(p).unwrap();
            prop_assert!((seen.x - still.x - offset[0]).abs() <= 1 && (seen.y - still.y - offset[1]).abs() <= 1);
            let there = DVec3::from_array(p.map(f64::from));
            prop_assert!(back.distance(there) < 4.0, "{back} for {there}");
        }
    }

    #[test]
    fn what_lies_behind_or_far_beside_is_not_seen() {
        assert!(pinhole().project([0, 0, 130_000]).is_none());
        assert!(pinhole().project([1 << 24, 0, 127_999]).is_none());
    }

    #[test]
    fn cameras_whose_products_would_overflow_are_out_of_range() {
        let with = |r: usize, c: usize, v: i64| {
            let mut view = pinhole();
            view.rows[r][c] = v;
            view.in_range()
        };
        assert!(with(0, 1, (1 << 33) - 1) && !with(0, 1, 1 << 33) && !with(1, 3, i64::MIN) && !with(2, 2, 1 << 22));
        let most = View { rows: [[(1 << 33) - 1; 4], [1 - (1 << 33); 4], [(1 << 22) - 1; 4]], axis: [1 << 15; 3] };
        assert!(most.in_range());
        // Farther than any moved base: no product overflows.
        for p in [[1 << 25; 3], [-(1 << 25); 3], [1 << 25, -(1 << 25), 0]] {
            most.moved([1 << 20, -(1 << 20)]).project(p);
        }
    }
}
