//! Linear Beltrami solver: the last resort against folds.
//!
//! A map of the plane folds where its Beltrami coefficient mu = f_zbar / f_z reaches 1. Cutting mu and solving for the map
//! that has it gives a map near by without folds (Lui, Lam, Yau, Gu 2014, "Teichmüller mapping (T-map) and its applications
//! to landmark matching registration"; Lam, Lui 2014, "Landmark- and intensity-based registration with large deformations
//! via quasi-conformal maps").

use super::dirichlet::Dirichlet;
use super::disk::signed_area;
use super::locate::Place;
use super::mobius::{div, mul};
use crate::{CodecError, Result};
use glam::DVec2;

/// |mu| is cut to this: angles change by a factor of (1 + |mu|) / (1 - |mu|) < 6.
const MOST: f64 = 0.7;

/// Rounds of cutting, smoothing and solving before giving up.
const ROUNDS: usize = 12;

/// Triangles of smaller area (twice, disk units) take no part.
const LEAST_AREA: f64 = 1e-16;

/// Stiffness of a [`Tie`] against that of the map: landmarks are met to about its inverse, in disk units.
const TIE: f64 = 1e6;

/// A point inside a triangle that is to go to `image`.
#[derive(Debug, Clone, Copy)]
pub struct Tie {
    /// Where the point lies.
    pub place: Place,
    /// Where it goes.
    pub image: DVec2,
}

/// A map without folds near `images` (the images of `points`), with `held` vertices where they are and tied points where
/// they belong. `None` when the rounds do not suffice.
///
/// # Errors
/// [`CodecError::Mesh`] when arrays differ in length or the system cannot be solved (nothing held, loose vertices).
pub fn unfold(
    points: &[DVec2],
    triangles: &[[u32; 3]],
    images: &[DVec2],
    held: &[bool],
    ties: &[Tie],
) -> Result<Option<Vec<DVec2>>> {
    if points.len() != images.len() || points.len() != held.len() {
        return Err(CodecError::Mesh(format!("{} points, {} images, {} held", points.len(), images.len(), held.len())));
    }
    let mut now = images.to_vec();
    for _ in 0..ROUNDS {
        let folds = |t: &&[u32; 3]| signed_area(&now, **t) <= 0.0 && signed_area(points, **t) > 0.0;
        if triangles.iter().filter(folds).count() == 0 {
            return Ok(Some(now));
        }
        let mu: Vec<DVec2> = coefficients(points, triangles, &now).into_iter().map(cut).collect();
        let mu: Vec<DVec2> = smooth(points.len(), triangles, &mu).into_iter().map(cut).collect();
        now = solve(points, triangles, &mu, images, held, ties)?;
    }
    Ok(None)
}

/// The Beltrami coefficient of a piecewise linear map on each triangle; infinite where it reverses without stretch.
pub fn coefficients(points: &[DVec2], triangles: &[[u32; 3]], images: &[DVec2]) -> Vec<DVec2> {
    let of = |t: &[u32; 3]| {
        let mut by = [DVec2::ZERO; 2];
        for (g, &v) in gradients(points, *t).iter().zip(t) {
            let f = images[v as usize];
            by[0] += f * g.x;
            by[1] += f * g.y;
        }
        let i_by_y = mul(DVec2::Y, by[1]);
        div(by[0] + i_by_y, by[0] - i_by_y)
    };
    triangles.iter().map(of).collect()
}

/// The map with the coefficient `mu` (|mu| < 1) on each triangle that takes the held vertices to their `images` and the
/// tied points to theirs:
/// div(A grad f) = 0 by linear elements, A = [[(r-1)^2 + s^2, -2 s], [-2 s, (1+r)^2 + s^2]] / (1 - |mu|^2), mu = r + i s.
///
/// # Errors
/// [`CodecError::Mesh`] when the system cannot be solved.
pub fn solve(
    points: &[DVec2],
    triangles: &[[u32; 3]],
    mu: &[DVec2],
    images: &[DVec2],
    held: &[bool],
    ties: &[Tie],
) -> Result<Vec<DVec2>> {
    let edges = triangles.iter().zip(mu).flat_map(|(t, mu)| {
        let area = 0.5 * signed_area(points, *t);
        let g = gradients(points, *t);
        let (r, s) = (mu.x, mu.y);
        let scale = if area > LEAST_AREA { area / (1.0 - mu.length_squared()) } else { 0.0 };
        let a = [(r - 1.0).powi(2) + s * s, -2.0 * s, (1.0 + r).powi(2) + s * s];
        let weight =
            move |p: DVec2, q: DVec2| -scale * (p.x * (a[0] * q.x + a[1] * q.y) + p.y * (a[1] * q.x + a[2] * q.y));
        [0, 1, 2].map(|k| (t[k], t[(k + 1) % 3], weight(g[k], g[(k + 1) % 3])))
    });
    let mut values: Vec<[f64; 2]> = images.iter().chain(ties.iter().map(|t| &t.image)).map(|z| z.to_array()).collect();
    let held: Vec<bool> = held.iter().copied().chain(ties.iter().map(|_| true)).collect();
    let edges =
        edges.chain((points.len() as u32..).zip(ties).flat_map(|(image, tie)| tie_edges(triangles, image, tie)));
    Dirichlet::new(&held, edges)?.solve(&mut values, &vec![[0.0; 2]; held.len()]);
    values.truncate(points.len());
    Ok(values.into_iter().map(DVec2::from).collect())
}

/// The penalty |sum b_i x_i - q|^2 as edges between the corners and to a held vertex at q: with weights b_i that sum to 1 it is
/// sum b_i |x_i - q|^2 - sum_{i<j} b_i b_j |x_i - x_j|^2.
fn tie_edges(triangles: &[[u32; 3]], image: u32, tie: &Tie) -> [(u32, u32, f64); 6] {
    let corners = triangles[tie.place.triangle as usize];
    let b = tie.place.barycentric.map(f64::from);
    let sum = b[0] + b[1] + b[2];
    let [b0, b1, b2] = b.map(|b| b / sum);
    let [x0, x1, x2] = corners;
    [
        (x0, image, TIE * b0),
        (x1, image, TIE * b1),
        (x2, image, TIE * b2),
        (x0, x1, -TIE * b0 * b1),
        (x1, x2, -TIE * b1 * b2),
        (x2, x0, -TIE * b2 * b0),
    ]
}

/// Gradients of the three hat functions on a triangle; zero where it has no area.
fn gradients(points: &[DVec2], t: [u32; 3]) -> [DVec2; 3] {
    let [a, b, c] = t.map(|v| points[v as usize]);
    let area2 = signed_area(points, t);
    if area2.abs() < LEAST_AREA {
        return [DVec2::ZERO; 3];
    }
    [c - b, a - c, b - a].map(|edge| edge.perp() / area2)
}

/// Folded triangles have |mu| > 1 and carry no direction worth keeping.
fn cut(mu: DVec2) -> DVec2 {
    if mu.is_finite() { mu.clamp_length_max(MOST) } else { DVec2::ZERO }
}

/// Mean over the triangles around each vertex, then over the corners of each triangle.
fn smooth(vertex_count: usize, triangles: &[[u32; 3]], mu: &[DVec2]) -> Vec<DVec2> {
    let mut sum = vec![(DVec2::ZERO, 0.0); vertex_count];
    for (t, mu) in triangles.iter().zip(mu) {
        for &v in t {
            sum[v as usize].0 += *mu;
            sum[v as usize].1 += 1.0;
        }
    }
    let mean = |v: u32| sum[v as usize].0 / f64::max(sum[v as usize].1, 1.0);
    triangles.iter().map(|t| (mean(t[0]) + mean(t[1]) + mean(t[2])) / 3.0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grid of (n + 1)^2 points over the square that fits the unit disk.
    fn square(n: u32) -> (Vec<DVec2>, Vec<[u32; 3]>, Vec<bool>) {
        let side = n + 1;
        let at = |i: u32| DVec2::new(f64::from(i % side), f64::from(i / side));
        let points = (0..side * side).map(|i| (at(i) * 2.0 / f64::from(n) - 1.0) * 0.7).collect();
        let held = (0..side * side).map(|i| i % side == 0 || i % side == n || i / side == 0 || i / side == n).collect();
        let cell = |c: u32| {
            let v = c / n * side + c % n;
            [[v, v + 1, v + side], [v + 1, v + side + 1, v + side]]
        };
        (points, (0..n * n).flat_map(cell).collect(), held)
    }

    #[test]
    fn coefficient_of_a_linear_map_is_that_of_its_matrix() {
        let (points, triangles, _) = square(3);
        // f = z + 0.4 i conj(z): mu = 0.4 i everywhere.
        let images: Vec<DVec2> = points.iter().map(|&z| z + mul(DVec2::Y * 0.4, DVec2::new(z.x, -z.y))).collect();
        assert!(coefficients(&points, &triangles, &images).iter().all(|m| m.distance(DVec2::Y * 0.4) < 1e-12));
    }

    #[test]
    fn a_piecewise_linear_map_comes_back_from_its_coefficients_and_border() {
        let (points, triangles, held) = square(12);
        let f = |z: DVec2| z + DVec2::new((3.0 * z.y).sin() * 0.15, (2.0 * z.x * z.y).cos() * 0.2);
        let images: Vec<DVec2> = points.iter().map(|&z| f(z)).collect();
        let mu = coefficients(&points, &triangles, &images);
        assert!(mu.iter().any(|m| m.length() > 0.1));
        let found = solve(&points, &triangles, &mu, &images, &held, &[]).unwrap();
        assert!(found.iter().zip(&images).all(|(p, q)| p.distance(*q) < 1e-9));
    }

    #[test]
    fn folds_are_taken_out_and_held_vertices_stay() {
        let (points, triangles, mut held) = square(16);
        let mut images = points.clone();
        let middle = points.iter().position(|z| z.length() < 1e-9).unwrap();
        images[middle] += DVec2::new(0.15, 0.05);
        held[middle] = true;
        let folds = |images: &[DVec2]| triangles.iter().filter(|t| signed_area(images, **t) <= 0.0).count();
        assert!(folds(&images) > 0);
        let found = unfold(&points, &triangles, &images, &held, &[]).unwrap().unwrap();
        assert_eq!(folds(&found), 0);
        assert!(held.iter().enumerate().all(|(v, h)| !h || found[v] == images[v]));
    }

    #[test]
    fn points_inside_triangles_are_tied_to_their_images() {
        let (points, triangles, held) = square(16);
        let tie = |triangle: u32, barycentric: [f32; 3], by: DVec2| {
            let place = Place { triangle, barycentric };
            let at: DVec2 = triangles[triangle as usize]
                .iter()
                .zip(barycentric)
                .map(|(&v, w)| points[v as usize] * f64::from(w))
                .sum();
            Tie { place, image: at + by }
        };
        let ties = [
            tie(100, [0.2, 0.3, 0.5], DVec2::new(0.02, 0.01)),
            tie(100, [0.6, 0.2, 0.2], DVec2::new(0.02, 0.01)),
            tie(291, [0.0, 0.5, 0.5], DVec2::new(-0.04, 0.03)),
            tie(350, [1.0, 0.0, 0.0], DVec2::new(0.0, -0.05)),
        ];
        let mut images = points.clone();
        images[8 * 17 + 8] += DVec2::new(0.15, 0.05);
        let found = unfold(&points, &triangles, &images, &held, &ties).unwrap().unwrap();
        assert!(triangles.iter().all(|t| signed_area(&found, *t) > 0.0));
        for tie in ties {
            let corners = triangles[tie.place.triangle as usize];
            let at: DVec2 =
                corners.iter().zip(tie.place.barycentric).map(|(&v, w)| found[v as usize] * f64::from(w)).sum();
            assert!(at.distance(tie.image) < 1e-5, "{at} for {}", tie.image);
        }
    }

    #[test]
    fn what_cannot_be_unfolded_is_said_so() {
        let (points, triangles, held) = square(4);
        let mirrored: Vec<DVec2> = points.iter().map(|z| DVec2::new(-z.x, z.y)).collect();
        assert_eq!(unfold(&points, &triangles, &mirrored, &held, &[]).unwrap(), None);
        assert!(unfold(&points, &triangles, &mirrored, &held[1..], &[]).is_err());
        let free = vec![false; points.len()];
        assert!(unfold(&points, &triangles, &mirrored, &free, &[]).is_err());
    }
}
