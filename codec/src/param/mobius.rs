//! Möbius transformations that keep the unit disk, and the one that best carries one point set to another.

use glam::DVec2;

/// Complex product.
pub fn mul(a: DVec2, b: DVec2) -> DVec2 {
    DVec2::new(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x)
}

/// Complex conjugate.
pub fn conj(a: DVec2) -> DVec2 {
    DVec2::new(a.x, -a.y)
}

/// Complex quotient.
pub fn div(a: DVec2, b: DVec2) -> DVec2 {
    mul(a, conj(b)) / b.length_squared()
}

/// M(z) = e^{i a} (z - b) / (1 - conj(b) z) with |b| < 1: the conformal automorphisms of the unit disk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mobius {
    /// e^{i a}, of length one.
    pub rotation: DVec2,
    /// The point that goes to the centre.
    pub centre: DVec2,
}

impl Mobius {
    /// The identity.
    pub const IDENTITY: Self = Self { rotation: DVec2::X, centre: DVec2::ZERO };

    /// Image of `z`.
    pub fn apply(&self, z: DVec2) -> DVec2 {
        mul(self.rotation, div(z - self.centre, DVec2::X - mul(conj(self.centre), z)))
    }

    /// The transformation that undoes this one: M^-1(w) = e^{-ia} (w + e^{ia} b) / (1 + conj(e^{ia} b) w).
    pub fn inverse(&self) -> Self {
        Self { rotation: conj(self.rotation), centre: -mul(self.rotation, self.centre) }
    }

    /// The automorphism that carries the points `from` to `to` with the least squared distance,
    /// by Levenberg-Marquardt on (a, Re b, Im b) started from the best rotation.
    pub fn fit(from: &[DVec2], to: &[DVec2]) -> Self {
        Self::fit_counting(from, to).0
    }

    /// The fit and how often it evaluated the transformation.
    fn fit_counting(from: &[DVec2], to: &[DVec2]) -> (Self, usize) {
        let turn: DVec2 = from.iter().zip(to).map(|(&p, &q)| mul(q, conj(p))).sum();
        if turn.length_squared() < 1e-24 {
            return (Self::IDENTITY, 0);
        }
        let mut best = Self { rotation: turn.normalize(), centre: DVec2::ZERO };
        let mut best_cost = best.cost(from, to);
        let mut damping = 1e-3;
        let mut evaluations = 1;
        for _ in 0..50 {
            evaluations += 1;
            let step = best.normal_step(from, to, damping);
            let next = best.moved(step);
            let cost = next.cost(from, to);
            if cost.is_finite() && cost < best_cost {
                let gain = best_cost - cost;
                (best, best_cost, damping) = (next, cost, damping * 0.2);
                // Relative to the squared distances that landmarks have at most, and to those that remain.
                if gain <= 1e-12 * best_cost + 1e-28 * from.len() as f64 {
                    break;
                }
            } else if damping > 1e8 {
                break;
            } else {
                damping *= 8.0;
            }
        }
        (best, evaluations)
    }

    fn cost(&self, from: &[DVec2], to: &[DVec2]) -> f64 {
        from.iter().zip(to).map(|(&p, &q)| (self.apply(p) - q).length_squared()).sum()
    }

    fn moved(&self, step: [f64; 3]) -> Self {
        let (s, c) = (libm::sin(step[0]), libm::cos(step[0]));
        let centre = self.centre + DVec2::new(step[1], step[2]);
        let limit = 0.999;
        let centre = if centre.length() > limit { centre * (limit / centre.length()) } else { centre };
        Self { rotation: mul(self.rotation, DVec2::new(c, s)), centre }
    }

    /// Damped Gauss-Newton step on (a, Re b, Im b).
    fn normal_step(&self, from: &[DVec2], to: &[DVec2], damping: f64) -> [f64; 3] {
        let mut n = glam::DMat3::ZERO;
        let mut g = glam::DVec3::ZERO;
        for (&p, &q) in from.iter().zip(to) {
            let denominator = DVec2::X - mul(conj(self.centre), p);
            let image = self.apply(p);
            let r = image - q;
            // d/da = i M; d/db_x and d/db_y from M = e^{ia} (z - b) / (1 - conj(b) z).
            let by_a = DVec2::new(-image.y, image.x);
            let scale = div(self.rotation, denominator);
            let zm = mul(p, image);
            let by_bx = -scale + div(zm, denominator);
            let by_by = -mul(scale, DVec2::Y) - div(mul(DVec2::Y, zm), denominator);
            let j = [by_a, by_bx, by_by];
            for (k, &jk) in j.iter().enumerate() {
                for (l, &jl) in j.iter().enumerate() {
                    n.col_mut(l)[k] += jk.dot(jl);
                }
                g[k] -= jk.dot(r);
            }
        }
        for k in 0..3 {
            n.col_mut(k)[k] *= 1.0 + damping;
            n.col_mut(k)[k] += 1e-12;
        }
        let step = n.inverse() * g;
        step.to_array()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn disk_point() -> impl Strategy<Value = DVec2> {
        (0.0..0.95f64, 0.0..std::f64::consts::TAU).prop_map(|(r, t)| DVec2::from_angle(t) * r)
    }

    proptest! {
        #[test]
        fn keeps_the_circle_and_inverts(b in disk_point(), z in disk_point(), a in -3.0..3.0f64) {
            let m = Mobius { rotation: DVec2::from_angle(a), centre: b };
            let on_circle = m.apply(DVec2::from_angle(a * 1.7));
            prop_assert!((on_circle.length() - 1.0).abs() < 1e-12);
            prop_assert!((m.inverse().apply(m.apply(z)) - z).length() < 1e-9);
            prop_assert!(m.apply(b).length() < 1e-12);
        }

        #[test]
        fn fit_finds_a_known_transformation(b in disk_point(), a in -3.0..3.0f64) {
            let m = Mobius { rotation: DVec2::from_angle(a), centre: b * 0.7 };
            let from: Vec<DVec2> = (0..40).map(|k| DVec2::from_angle(f64::from(k) * 2.4) * (f64::from(k) / 42.0).sqrt()).collect();
            let to: Vec<DVec2> = from.iter().map(|&z| m.apply(z)).collect();
            let found = Mobius::fit(&from, &to);
            prop_assert!(from.iter().zip(&to).all(|(&z, &w)| (found.apply(z) - w).length() < 1e-6));
        }
    }

    #[test]
    fn few_evaluations_suffice() {
        let m = Mobius { rotation: DVec2::from_angle(0.4), centre: DVec2::new(0.3, -0.2) };
        let from: Vec<DVec2> =
            (0..68).map(|k| DVec2::from_angle(f64::from(k) * 2.4) * (f64::from(k) / 70.0).sqrt()).collect();
        let noise = |k: usize| DVec2::from_angle(k as f64 * 1.9) * 0.02;
        let to: Vec<DVec2> = from.iter().enumerate().map(|(k, &z)| m.apply(z) + noise(k)).collect();
        let (found, evaluations) = Mobius::fit_counting(&from, &to);
        println!("{evaluations} evaluations");
        assert!(evaluations <= 12, "{evaluations}");
        assert!(found.centre.distance(m.centre) < 0.01);
    }

    #[test]
    fn fit_of_nothing_is_the_identity() {
        assert_eq!(Mobius::fit(&[], &[]), Mobius::IDENTITY);
    }
}
