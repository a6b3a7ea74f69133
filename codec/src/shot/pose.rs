//! A rigid pose in integers.

/// Fraction bits of a rotation matrix.
const ROTATION_BITS: u32 = 20;
/// Scalar part of the quaternion.
const SCALAR: i64 = 1 << 14;
/// Largest vector part of the quaternion: turns up to 127 degrees about an axis.
pub const MAX_TURN: i32 = 1 << 15;
/// Largest shift, units: 16 m.
pub const MAX_SHIFT: i32 = 1 << 22;

/// Rotation about the origin, then a shift.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Pose {
    /// Vector part of a quaternion whose scalar part is 2^14, each at most [`MAX_TURN`].
    pub turn: [i32; 3],
    /// Shift in units of length.
    pub shift: [i32; 3],
}

/// A pose ready to be applied.
#[derive(Debug, Clone, Copy)]
pub struct PoseMatrix {
    rows: [[i64; 3]; 3],
    shift: [i64; 3],
}

impl Pose {
    /// The rotation matrix `M(q) / |q|²`, entries rounded down to multiples of 2^-20 (Horn: Closed-form solution of absolute
    /// orientation using unit quaternions, JOSA A 1987, section 3.D).
    pub fn matrix(&self) -> PoseMatrix {
        let ([x, y, z], w) = (self.turn.map(i64::from), SCALAR);
        let norm = w * w + x * x + y * y + z * z;
        let rows = [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ];
        let rows = rows.map(|row| row.map(|m| (m << ROTATION_BITS).div_euclid(norm)));
        PoseMatrix { rows, shift: self.shift.map(i64::from) }
    }
}

impl PoseMatrix {
    /// Where a point (units) goes.
    pub fn apply(&self, p: [i32; 3]) -> [i32; 3] {
        let p = p.map(i64::from);
        let half = 1 << (ROTATION_BITS - 1);
        [0, 1, 2].map(|r| {
            let m = &self.rows[r];
            (((m[0] * p[0] + m[1] * p[1] + m[2] * p[2] + half) >> ROTATION_BITS) + self.shift[r]) as i32
        })
    }

    /// The rotation as numbers, for fitting and display.
    pub fn rotation(&self) -> [[f64; 3]; 3] {
        self.rows.map(|row| row.map(|m| m as f64 / f64::from(1 << ROTATION_BITS)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn no_turn_is_the_identity() {
        let p = Pose { turn: [0; 3], shift: [3, -4, 5] }.matrix();
        assert_eq!(p.apply([1000, -2000, 7]), [1003, -2004, 12]);
    }

    #[test]
    fn a_quarter_turn_about_z() {
        let p = Pose { turn: [0, 0, 1 << 14], shift: [0; 3] }.matrix();
        assert_eq!(p.apply([1000, 0, 50]), [0, 1000, 50]);
    }

    proptest! {
        #[test]
        fn lengths_are_kept(turn in prop::array::uniform3(-MAX_TURN..=MAX_TURN), p in prop::array::uniform3(-100_000_i32..100_000)) {
            let length = |p: [i32; 3]| p.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
            let moved = Pose { turn, shift: [0; 3] }.matrix().apply(p);
            prop_assert!((length(moved) - length(p)).abs() < 2.0);
        }
    }
}
