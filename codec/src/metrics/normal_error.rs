//! Angles between the normals of two surfaces.

use glam::Vec3;

/// Angles between the unit normals of two surfaces at corresponding points: totals over one scan or many.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct NormalError {
    /// Sum of the squared angles, rad².
    pub squared_sum_rad2: f64,
    /// Pairs compared.
    pub count: u64,
}

impl NormalError {
    /// Counts one pair of unit normals; pairs in which one is zero, as at a vertex without triangles, do not count.
    #[inline]
    pub fn add(&mut self, a: Vec3, b: Vec3) {
        if a == Vec3::ZERO || b == Vec3::ZERO {
            return;
        }
        let angle_rad = f64::from(angle_rad(a.dot(b)));
        self.squared_sum_rad2 += angle_rad * angle_rad;
        self.count += 1;
    }

    /// Counts everything that `other` counted.
    pub fn merge(&mut self, other: Self) {
        self.squared_sum_rad2 += other.squared_sum_rad2;
        self.count += other.count;
    }

    /// Root mean square of the angles, degrees, to 0.004; `None` when nothing was compared.
    pub fn rms_deg(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.squared_sum_rad2 / self.count as f64).sqrt().to_degrees())
    }
}

/// Arc cosine to 7e-5 rad: M. Abramowitz and I. Stegun, "Handbook of mathematical functions", 1964, 4.4.45.
fn angle_rad(cosine: f32) -> f32 {
    let x = cosine.abs().min(1.0);
    let below_right = (1.0 - x).sqrt() * (1.570_728_8 + x * (-0.212_114_4 + x * (0.074_261_0 - x * 0.018_729_3)));
    if cosine < 0.0 { std::f32::consts::PI - below_right } else { below_right }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_are_those_of_the_library() {
        for k in -1000..=1000 {
            let x = k as f32 / 1000.0;
            assert!((angle_rad(x) - x.acos()).abs() < 7e-5, "{x}");
        }
        assert_eq!((angle_rad(1.0), angle_rad(1.000_001)), (0.0, 0.0));
    }

    #[test]
    fn rms_of_known_angles() {
        let mut e = NormalError::default();
        assert_eq!(e.rms_deg(), None);
        e.add(Vec3::Z, Vec3::ZERO);
        assert_eq!(e.count, 0);
        for deg in [30f32, 40.0] {
            e.add(Vec3::Z, Vec3::new(deg.to_radians().sin(), 0.0, deg.to_radians().cos()));
        }
        assert!((e.rms_deg().unwrap() - 1250f64.sqrt()).abs() < 4e-3);
        let mut twice = e;
        twice.merge(e);
        assert_eq!((twice.count, twice.rms_deg()), (4, e.rms_deg()));
    }
}
