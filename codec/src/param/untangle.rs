//! Turns back triangles that a disk map turns over, and moves nothing but what lies around them.
//!
//! The map has no triangle turned over in the intrinsic triangulation; in the embedded mesh blunt triangles may be, whose
//! longest edge the intrinsic one has flipped away: the straight line between its ends on the disk is not where the surface
//! has that edge. On scans these are depth steps and flanks seen at grazing light, of angles up to 170 degrees and edges ten
//! times as long as their neighbours'. Their corners are laid out afresh inside the ring around them, as a harmonic map with
//! positive weights, which is bijective where that ring is convex (Tutte 1963); where it is not, a larger ring is taken.

use super::dirichlet::Dirichlet;
use super::disk::signed_area;
use crate::Result;
use crate::mesh::{TriMesh, cotangents};
use glam::DVec2;

/// Most passes; each takes one ring more around what is left.
const MOST_PASSES: usize = 8;

/// Cotangent weights of one triangle are held within this.
const WEIGHTS: (f64, f64) = (0.05, 1.5);

/// Turns flipped triangles of the map `points` of `mesh` upright; vertices on the border stay on the circle. Returns the
/// number that are left.
///
/// # Errors
/// [`crate::CodecError::Mesh`] when a ring's system cannot be solved.
pub(super) fn untangle(mesh: &TriMesh, points: &mut [DVec2], border: &[u32]) -> Result<usize> {
    for rings in 0..=MOST_PASSES {
        let flipped: Vec<u32> = (0..mesh.triangles.len() as u32)
            .filter(|&t| signed_area(points, mesh.triangles[t as usize]) <= 0.0)
            .collect();
        if flipped.is_empty() || rings == MOST_PASSES {
            return Ok(flipped.len());
        }
        let mut held = vec![true; points.len()];
        let release = |held: &mut [bool], t: &[u32; 3]| t.iter().for_each(|&v| held[v as usize] = false);
        flipped.iter().for_each(|&t| release(&mut held, &mesh.triangles[t as usize]));
        for _ in 0..rings {
            let inside = held.clone();
            for t in mesh.triangles.iter().filter(|t| t.iter().any(|&v| !inside[v as usize])) {
                release(&mut held, t);
            }
        }
        border.iter().for_each(|&v| held[v as usize] = true);
        lay_out(mesh, points, &held)?;
    }
    Ok(0)
}

/// Harmonic with clamped weights where not `held`.
fn lay_out(mesh: &TriMesh, points: &mut [DVec2], held: &[bool]) -> Result<()> {
    let touched = mesh.triangles.iter().filter(|t| t.iter().any(|&v| !held[v as usize]));
    let edges = touched.flat_map(|t| {
        let opposite = cotangents(t.map(|v| mesh.positions_mm[v as usize].as_dvec3()));
        let weight = |k: usize| (0.5 * opposite[k]).clamp(WEIGHTS.0, WEIGHTS.1);
        [(t[1], t[2], weight(0)), (t[2], t[0], weight(1)), (t[0], t[1], weight(2))]
    });
    let mut values: Vec<[f64; 2]> = points.iter().map(|z| z.to_array()).collect();
    // All corners of a flipped triangle may lie on the border: nothing is free then.
    if held.contains(&false) {
        Dirichlet::new(held, edges)?.solve(&mut values, &vec![[0.0; 2]; points.len()]);
    }
    points.iter_mut().zip(values).for_each(|(z, value)| *z = value.into());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::disk::{DiskMap, disk_map};
    use super::*;
    use crate::mesh::test_surfaces::{jittered_plate, polar_disk};
    use glam::Vec3;

    fn flips(mesh: &TriMesh, points: &[DVec2]) -> usize {
        mesh.triangles.iter().filter(|t| signed_area(points, **t) <= 0.0).count()
    }

    #[test]
    fn vertices_thrown_across_their_rings_come_back_and_the_rest_stays() {
        let (z, triangles) = polar_disk(12);
        let positions_mm = z.iter().map(|z| Vec3::new(z.x as f32, z.y as f32, 0.0) * 100.0).collect();
        let mesh = TriMesh { positions_mm, triangles, uv: None };
        let border: Vec<u32> = (z.len() as u32 - 72..z.len() as u32).collect();
        let mut points = z.clone();
        for v in [40, 150, 300] {
            points[v] += DVec2::new(0.2, -0.1);
        }
        assert!(flips(&mesh, &points) > 5);
        assert_eq!(untangle(&mesh, &mut points, &border).unwrap(), 0);
        assert_eq!(flips(&mesh, &points), 0);
        let moved = points.iter().zip(&z).filter(|(p, q)| p.distance(**q) > 1e-12).count();
        assert!((3..200).contains(&moved), "{moved} of {}", z.len());
        let farthest = points.iter().zip(&z).map(|(p, q)| p.distance(*q)).fold(0.0, f64::max);
        assert!(farthest < 0.1, "{farthest}");
    }

    #[test]
    fn a_map_without_flips_is_left_alone_and_hopeless_ones_are_counted() {
        let mesh = jittered_plate(12, 5);
        let DiskMap { mut points, border, .. } = disk_map(&mesh).unwrap();
        let before = points.clone();
        assert_eq!(untangle(&mesh, &mut points, &border).unwrap(), 0);
        assert_eq!(points, before);
        // The mirrored circle admits no upright triangle.
        points.iter_mut().for_each(|z| z.x = -z.x);
        assert!(untangle(&mesh, &mut points, &border).unwrap() > mesh.triangles.len() / 2);
    }

    #[test]
    fn steep_steps_across_a_surface_are_laid_without_flips() {
        let mut mesh = jittered_plate(40, 9);
        for p in &mut mesh.positions_mm {
            let step = |at: f32| ((at - 20.0 + 3.0 * (p.y * 0.4).sin()) * 4.0).clamp(-1.0, 1.0);
            p.z += 12.0 * step(p.x);
        }
        let map = disk_map(&mesh).unwrap();
        assert_eq!((map.flips, flips(&mesh, &map.points)), (0, 0));
    }
}
