//! Möbius transformations that keep the unit disk, and the one that best carries one point set to another.

use glam::DVec2;

/// Newton steps of [`Mobius::balancing`]; five do for a scan.
const MAX_BALANCING_STEPS: usize = 60;
/// Farthest that one of them moves.
const MAX_BALANCING_STEP: f64 = 0.7;
/// Distance of the centre of mass from the centre that counts as none.
const BALANCED: f64 = 1e-13;

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

    /// Carries `point` to the centre, without turning there.
    pub fn centring(point: DVec2) -> Self {
        Self { rotation: DVec2::X, centre: point }
    }

    /// First this transformation, then `next`.
    pub fn then(&self, next: &Self) -> Self {
        // Multiplied out, with r, b of this one and q, c of the next: the rotation is q r conj(k) / k, k = 1 + conj(c) r b.
        let k = DVec2::X + mul(conj(next.centre), mul(self.rotation, self.centre));
        let turn = mul(next.rotation, div(mul(self.rotation, conj(k)), k));
        Self { rotation: turn.normalize(), centre: self.inverse().apply(next.centre) }
    }

    /// This transformation, turned so that `landmark` lands in the direction `towards` from the centre; unchanged when
    /// the landmark lands in the centre.
    pub fn turned(&self, landmark: DVec2, towards: DVec2) -> Self {
        let turn = mul(towards, conj(self.apply(landmark)));
        match turn.try_normalize() {
            Some(turn) => Self { rotation: mul(turn, self.rotation), centre: self.centre },
            None => *self,
        }
    }

    /// Brings the centre of mass of weighted points to the centre of the disk, by Newton's method: near the identity M
    /// moves the mean m to m - b + conj(b) s, s the mean of z². The solution is unique unless half of the mass lies in
    /// one point of the circle (Douady and Earle 1986); the identity without mass.
    pub fn balancing(points: &[DVec2], weights: &[f64]) -> Self {
        let total: f64 = weights.iter().sum();
        let mut best = Self::IDENTITY;
        for _ in 0..MAX_BALANCING_STEPS {
            let (mut mean, mut square) = (DVec2::ZERO, DVec2::ZERO);
            for (&p, &w) in points.iter().zip(weights) {
                let z = best.apply(p);
                mean += z * (w / total);
                square += mul(z, z) * (w / total);
            }
            let step = (mean + mul(square, conj(mean))) / (1.0 - square.length_squared()).max(1e-3);
            if !step.is_finite() || mean.length() < BALANCED {
                break;
            }
            best = best.then(&Self::centring(step.clamp_length_max(MAX_BALANCING_STEP)));
        }
        best
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
        fn composition_is_that_of_the_maps_and_a_group(
            b in disk_point(), c in disk_point(), d in disk_point(), z in disk_point(),
            (e, f, g) in (-3.0..3.0f64, -3.0..3.0f64, -3.0..3.0f64)
        ) {
            let [m, n, o] = [(b, e), (c, f), (d, g)]
                .map(|(centre, angle)| Mobius { rotation: DVec2::from_angle(angle), centre });
            let same = |a: Mobius, b: Mobius| a.apply(z).distance(b.apply(z)) < 1e-9;
            prop_assert!((m.then(&n).apply(z) - n.apply(m.apply(z))).length() < 1e-9);
            prop_assert!(same(m.then(&n).then(&o), m.then(&n.then(&o))));
            prop_assert!(same(m.then(&Mobius::IDENTITY), m) && same(Mobius::IDENTITY.then(&m), m));
            prop_assert!(same(m.then(&m.inverse()), Mobius::IDENTITY));
            prop_assert!((m.then(&n).rotation.length() - 1.0).abs() < 1e-12);
        }

        #[test]
        fn turning_brings_a_landmark_to_its_direction(b in disk_point(), z in disk_point(), a in -3.0..3.0f64) {
            prop_assume!(z.distance(b) > 1e-3);
            let m = Mobius::centring(b).turned(z, DVec2::from_angle(a) * 5.0);
            prop_assert!(m.apply(b).length() < 1e-12);
            prop_assert!(m.apply(z).normalize().distance(DVec2::from_angle(a)) < 1e-9);
        }

        #[test]
        fn balancing_undoes_what_unbalances(b in disk_point(), weights in proptest::collection::vec(0.1..1.0f64, 40)) {
            let points: Vec<DVec2> = (0..40)
                .map(|k| DVec2::from_angle(f64::from(k) * 2.4) * (f64::from(k) / 42.0).sqrt())
                .map(|z| Mobius::centring(b).apply(z))
                .collect();
            let m = Mobius::balancing(&points, &weights);
            let sum: DVec2 = points.iter().zip(&weights).map(|(&z, &w)| m.apply(z) * w).sum();
            prop_assert!(sum.length() < 1e-9, "{sum}");
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
        assert_eq!(Mobius::balancing(&[], &[]), Mobius::IDENTITY);
    }
}
