//! Clamped-plate warp of the unit disk: interpolates landmarks and leaves the circle where it is. For surfaces whose
//! border is a material line.

use super::kernel_sum::add_kernels;
use super::log::ln_ratio;
use crate::{CodecError, Result};
use faer::prelude::*;
use glam::DVec2;

/// Landmarks nearer to the circle than this cannot be moved by a warp that keeps it; they are left out.
const RIM: f64 = 1e-6;

/// Arguments of the logarithm stay normal numbers; the factor before it is as small then.
const LEAST: f64 = 1e-300;

/// f(z) = z + sum_k c_k G(z, p_k) with Boggio's Green's function of the clamped plate on the disk (Boggio 1905),
/// G(z, w) = |z-w|^2 ln(|z-w|^2 / |1 - z conj(w)|^2) + (1-|z|^2)(1-|w|^2): of all maps that keep the circle and its
/// normals and carry the landmarks, the one of least bending energy (Marsland, Twining 2004, "Constructing
/// diffeomorphic representations for the groupwise analysis of nonrigid registrations of medical images").
#[derive(Debug, Clone)]
pub struct ClampedPlate {
    /// Landmark p and 1 - |p|^2.
    centres: Vec<(DVec2, f64)>,
    weights: Vec<DVec2>,
}

impl ClampedPlate {
    /// The warp that carries `from` exactly to `to`; landmarks on the circle are left out.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when two landmarks coincide, one is not finite, or the lists differ in length.
    pub fn fit(from: &[DVec2], to: &[DVec2]) -> Result<Self> {
        if from.len() != to.len() {
            return Err(CodecError::Mesh(format!("{} landmarks here and {} there", from.len(), to.len())));
        }
        let movable = |p: &DVec2| p.length_squared() < 1.0 - 2.0 * RIM || !p.is_finite();
        let pairs: Vec<(DVec2, DVec2)> =
            from.iter().copied().zip(to.iter().copied()).filter(|p| movable(&p.0)).collect();
        let centres: Vec<(DVec2, f64)> = pairs.iter().map(|&(p, _)| (p, 1.0 - p.length_squared())).collect();
        // Scaled to a unit diagonal: landmarks near the circle have small entries, not a bad condition.
        let scale: Vec<f64> = centres.iter().map(|c| 1.0 / c.1).collect();
        let entry = |i: usize, j: usize| {
            let ((p, room_p), (q, room_q)) = (centres[i], centres[j]);
            kernel(p.distance_squared(q), room_p * room_q) * scale[i] * scale[j]
        };
        let a = Mat::from_fn(pairs.len(), pairs.len(), entry);
        let rhs = Mat::from_fn(pairs.len(), 2, |i, k| (pairs[i].1 - pairs[i].0)[k] * scale[i]);
        let factor = a.llt(faer::Side::Lower).map_err(|_| CodecError::Mesh("two landmarks coincide".into()))?;
        let x = factor.solve(&rhs);
        let weights: Vec<DVec2> = (0..pairs.len()).map(|i| DVec2::new(x[(i, 0)], x[(i, 1)]) * scale[i]).collect();
        if weights.iter().any(|w| !w.is_finite()) {
            return Err(CodecError::Mesh("two landmarks coincide or one is not finite".into()));
        }
        Ok(Self { centres, weights })
    }

    /// Image of `z`; points outside the disk stay.
    pub fn apply(&self, z: DVec2) -> DVec2 {
        let room = (1.0 - z.length_squared()).max(0.0);
        let mut sum = z;
        for (&(p, room_p), &w) in self.centres.iter().zip(&self.weights) {
            sum += w * kernel(z.distance_squared(p), room * room_p);
        }
        sum
    }

    /// Images of many points, as [`Self::apply`] gives them, in half the time.
    pub fn images(&self, points: &[DVec2]) -> Vec<DVec2> {
        let term = |(&(p, room_p), &w): (&(DVec2, f64), &DVec2)| {
            (p, w, move |distance2, room: f64| kernel(distance2, room.max(0.0) * room_p))
        };
        let mut images = points.to_vec();
        add_kernels(points, &mut images, self.centres.iter().zip(&self.weights).map(term));
        images
    }
}

/// G from |z-w|^2 and (1-|z|^2)(1-|w|^2), whose sum is |1 - z conj(w)|^2. Zero on the circle, where the second is.
#[inline(always)]
fn kernel(distance2: f64, room: f64) -> f64 {
    distance2 * ln_ratio(distance2.max(LEAST), (distance2 + room).max(LEAST)) + room
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::param::mobius::{conj, mul};
    use proptest::prelude::*;

    fn spiral(n: u32) -> Vec<DVec2> {
        (0..n).map(|k| DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / f64::from(n)).sqrt() * 0.98).collect()
    }

    fn shaken(points: &[DVec2], phase: f64) -> Vec<DVec2> {
        let shake = |(i, p): (usize, &DVec2)| {
            let t = i as f64 + phase;
            *p + DVec2::new((t * 1.1).sin(), (t * 1.7).cos()) * 0.05 * (1.0 - p.length())
        };
        points.iter().enumerate().map(shake).collect()
    }

    proptest! {
        #[test]
        fn interpolates_landmarks_and_keeps_the_circle(n in 1u32..80, phase in 0.0..99.0f64) {
            let from = spiral(n);
            let to = shaken(&from, phase);
            let plate = ClampedPlate::fit(&from, &to).unwrap();
            for (p, q) in from.iter().zip(&to) {
                prop_assert!(plate.apply(*p).distance(*q) < 1e-10);
            }
            for k in 0..50 {
                let z = DVec2::from_angle(phase + f64::from(k));
                prop_assert!(plate.apply(z).distance(z) < 1e-12);
            }
            let images = plate.images(&from);
            prop_assert!(from.iter().zip(images).all(|(&p, image)| plate.apply(p) == image));
        }

        #[test]
        fn kernel_is_the_formula(x in 0.0..0.99f64, y in 0.0..0.99f64, a in 0.0..6.0f64, b in 0.0..6.0f64) {
            let (z, w) = (DVec2::from_angle(a) * x, DVec2::from_angle(b) * y);
            let distance2 = z.distance_squared(w);
            let room = (1.0 - z.length_squared()) * (1.0 - w.length_squared());
            let outer = (DVec2::X - mul(z, conj(w))).length_squared();
            let want = if distance2 > 0.0 { distance2 * (distance2 / outer).ln() + room } else { room };
            prop_assert!((kernel(distance2, room) - want).abs() < 1e-9);
            prop_assert!(kernel(distance2, room) > -1e-12, "Boggio: positive on the disk");
        }
    }

    #[test]
    fn the_kernel_is_biharmonic_away_from_its_pole() {
        // Boggio's function solves lap lap G = 0 off the pole: the 13-point stencil vanishes with h^2.
        let w = DVec2::new(0.3, -0.2);
        let g = |z: DVec2| kernel(z.distance_squared(w), (1.0 - z.length_squared()) * (1.0 - w.length_squared()));
        let (z, h) = (DVec2::new(-0.4, 0.1), 0.02);
        let laplacian = |z: DVec2| {
            let ring: f64 = [DVec2::X, -DVec2::X, DVec2::Y, -DVec2::Y].iter().map(|d| g(z + *d * h)).sum();
            (ring - 4.0 * g(z)) / (h * h)
        };
        let ring: f64 = [DVec2::X, -DVec2::X, DVec2::Y, -DVec2::Y].iter().map(|d| laplacian(z + *d * h)).sum();
        let bilaplacian = (ring - 4.0 * laplacian(z)) / (h * h);
        assert!(laplacian(z).abs() > 0.1 && bilaplacian.abs() < 0.02, "{} {bilaplacian}", laplacian(z));
    }

    #[test]
    fn landmarks_on_the_circle_stay_and_bad_ones_are_refused() {
        let from = [DVec2::X, DVec2::new(0.2, 0.1)];
        let to = [DVec2::Y, DVec2::new(0.3, 0.1)];
        let plate = ClampedPlate::fit(&from, &to).unwrap();
        assert!(plate.apply(DVec2::X).distance(DVec2::X) < 1e-12);
        assert!(plate.apply(from[1]).distance(to[1]) < 1e-12);
        assert!(ClampedPlate::fit(&[from[1], from[1]], &to).is_err());
        assert!(ClampedPlate::fit(&[DVec2::NAN], &to[..1]).is_err());
        assert!(ClampedPlate::fit(&from[1..], &[DVec2::INFINITY]).is_err());
        assert!(ClampedPlate::fit(&from, &to[..1]).is_err());
        assert_eq!(ClampedPlate::fit(&[], &[]).unwrap().apply(DVec2::NEG_X), DVec2::NEG_X);
    }
}
