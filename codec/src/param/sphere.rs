//! Conformal map of a closed surface without handles to the unit sphere by harmonic energy flow, and the disk map that
//! follows from it by double cover. Off-line references for [`super::disk`], which is some hundred times faster.
//!
//! Quasi-implicit Euler method (Huang, Gu, Huang, Lin, Lin and Yau 2014; Lin and Yueh 2015): each step solves
//! (I + dt (K - D)) phi' = phi, D_ii = <(K phi)_i, phi_i>, K the cotangent Laplacian, and puts phi' back on the sphere.
//! The papers start from the Gauss map, which diverged on scans; here a harmonic map to the plane is put on the sphere.

use super::disk::{DiskMap, border_on_circle, signed_area};
use super::harmonic::HarmonicSystem;
use crate::linalg::{LowerCsc, SparseLlt};
use crate::mesh::intrinsic::IntrinsicMesh;
use crate::mesh::{HalfEdges, TriMesh, barycentric_areas_mm2, cotangent_laplacian};
use crate::{CodecError, Result};
use glam::{DQuat, DVec2, DVec3, Vec3};
use std::f64::consts::PI;

/// Step and end of the flow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlowOptions {
    /// Step dt in units of n / (8 pi), n the number of vertices. D sums to 8 pi where phi is conformal, so that from 1 on
    /// the matrix loses its definiteness to constants and phi collapses into a point. Halved where it is lost earlier.
    pub step: f64,
    /// Most steps.
    pub max_steps: usize,
    /// The flow ends when a step lowers the energy by less than this share.
    pub tolerance: f64,
}

impl Default for FlowOptions {
    fn default() -> Self {
        Self { step: 0.5, max_steps: 200, tolerance: 1e-8 }
    }
}

/// How the flow went.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowReport {
    /// Harmonic energy at the start and after each step; 4 pi is the least, of a conformal map.
    pub energy: Vec<f64>,
    /// Step dt at the end.
    pub step: f64,
    /// Whether it ended by its tolerance.
    pub converged: bool,
}

/// A closed surface on the unit sphere.
#[derive(Debug, Clone)]
pub struct SphereMap {
    /// One point a vertex, of length one.
    pub points: Vec<DVec3>,
    /// Triangles that the map turns inside out.
    pub flips: usize,
    /// How it was found.
    pub flow: FlowReport,
}

/// Maps a closed surface without handles to the unit sphere, its centre of mass in the origin.
///
/// # Errors
/// [`CodecError::Mesh`] when `mesh` is not closed, has handles, is in pieces, or is too degenerate for its Laplacian to
/// factorize.
pub fn sphere_map(mesh: &TriMesh, options: &FlowOptions) -> Result<SphereMap> {
    let half_edges = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    let (chi, pieces) = (half_edges.euler_characteristic(), half_edges.triangle_components().1);
    if let Some(h) = half_edges.twin.iter().position(|&twin| twin == crate::mesh::half_edge::NONE) {
        let (a, b) = (half_edges.from(h as u32) + 1, half_edges.to(h as u32) + 1);
        return Err(CodecError::Mesh(format!("not closed: edge {a}-{b} has one triangle; a sphere has no border")));
    }
    if chi != 2 || pieces != 1 {
        return Err(CodecError::Mesh(format!(
            "not a sphere: Euler characteristic {chi}, {pieces} pieces (2 and 1 wanted)"
        )));
    }
    let mut points = punctured_start(mesh)?;
    let flow = flow(mesh, &mut points, options)?;
    let flips = mesh.triangles.iter().filter(|t| is_inside_out(&points, **t)).count();
    Ok(SphereMap { points, flips, flow })
}

/// Maps a disk to the unit disk by its double cover: the surface and its mirror image, glued at the border, on the
/// sphere; the border comes to lie on the equator, nearly.
///
/// # Errors
/// As [`super::disk::disk_map`].
pub fn double_cover_disk_map(mesh: &TriMesh, options: &FlowOptions) -> Result<(DiskMap, FlowReport)> {
    let (disk, border) = border_on_circle(mesh)?;
    let (double, twin_of) = mirror_glued(mesh, &border);
    let mut points: Vec<DVec3> = disk.iter().map(|&z| to_sphere(z)).collect();
    points.extend(twin_of.iter().map(|&v| points[v as usize] * DVec3::new(1.0, 1.0, -1.0)).collect::<Vec<_>>());
    let flow = flow(&double, &mut points, options)?;
    let equator: DVec3 = (0..border.len())
        .map(|i| points[border[i] as usize].cross(points[border[(i + 1) % border.len()] as usize]))
        .sum();
    let upright = DQuat::from_rotation_arc(equator.normalize_or(DVec3::Z), DVec3::Z);
    let points: Vec<DVec2> = points[..mesh.vertex_count()].iter().map(|&p| to_plane(upright * p)).collect();
    if !points.iter().all(|z| z.is_finite()) {
        return Err(CodecError::Mesh("the flow of the double cover did not stay on the sphere".into()));
    }
    let nearest = (0..points.len()).min_by(|&a, &b| points[a].length_squared().total_cmp(&points[b].length_squared()));
    let flips = mesh.triangles.iter().filter(|t| signed_area(&points, **t) <= 0.0).count();
    Ok((DiskMap { points, centre: nearest.unwrap_or(0) as u32, border, flips }, flow))
}

/// The surface and its mirror image without the border; also the vertex that each vertex of the image mirrors.
fn mirror_glued(mesh: &TriMesh, border: &[u32]) -> (TriMesh, Vec<u32>) {
    let mut image = vec![0u32; mesh.vertex_count()];
    border.iter().for_each(|&b| image[b as usize] = b + 1);
    let mut twin_of = Vec::new();
    for (v, image) in image.iter_mut().enumerate().filter(|(_, image)| **image == 0) {
        *image = (mesh.vertex_count() + twin_of.len() + 1) as u32;
        twin_of.push(v as u32);
    }
    let mut double = TriMesh { uv: None, ..mesh.clone() };
    double.positions_mm.extend(twin_of.iter().map(|&v| mesh.positions_mm[v as usize]));
    double.triangles.extend(mesh.triangles.iter().map(|&[a, b, c]| [a, c, b].map(|v| image[v as usize] - 1)));
    (double, twin_of)
}

/// Harmonic map of the surface without its first triangle to the plane, that triangle fixed, then to the sphere at the
/// scale at which half of the vertices lie on either hemisphere (after Haker et al. 2000).
fn punctured_start(mesh: &TriMesh) -> Result<Vec<DVec3>> {
    let open = &mesh.triangles[1..];
    let half_edges = HalfEdges::build(mesh.vertex_count(), open)?;
    let Some(border) = half_edges.boundary_loops().pop() else { unreachable!("one triangle was taken away") };
    let punctured = TriMesh { triangles: open.to_vec(), uv: None, positions_mm: mesh.positions_mm.clone() };
    let mut intrinsic = IntrinsicMesh::new(&punctured, &half_edges.twin);
    intrinsic.mollify()?;
    intrinsic.make_delaunay();
    let system = HarmonicSystem::assemble(&intrinsic, &border);
    let mut factor = None;
    let factor = system.factorize(&mut factor, &mesh.positions_mm)?;
    let corners: Vec<DVec2> =
        (0..border.len()).map(|k| DVec2::from_angle(2.0 * PI * k as f64 / border.len() as f64)).collect();
    let mut plane = system.extend(factor, &border, &corners);
    plane.truncate(mesh.vertex_count());
    let centre = median(plane.iter().map(|z| z.x)).zip(median(plane.iter().map(|z| z.y)));
    let centre = centre.map_or(DVec2::ZERO, |(x, y)| DVec2::new(x, y));
    let radius = median(plane.iter().map(|z| z.distance(centre))).unwrap_or(1.0).max(f64::MIN_POSITIVE);
    Ok(plane.iter().map(|&z| to_sphere((z - centre) / radius)).collect())
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Stereographic projection from the south pole: the unit disk becomes the northern hemisphere, seen from outside as it
/// was.
fn to_sphere(z: DVec2) -> DVec3 {
    let s = z.length_squared();
    DVec3::new(2.0 * z.x, 2.0 * z.y, 1.0 - s) / (1.0 + s)
}

fn to_plane(p: DVec3) -> DVec2 {
    p.truncate() / (1.0 + p.z)
}

fn is_inside_out(points: &[DVec3], t: [u32; 3]) -> bool {
    let [a, b, c] = t.map(|v| points[v as usize]);
    (b - a).cross(c - a).dot(a + b + c) <= 0.0
}

/// Lowers the harmonic energy of `points` step by step.
fn flow(mesh: &TriMesh, points: &mut [DVec3], options: &FlowOptions) -> Result<FlowReport> {
    let n = points.len();
    let laplacian = cotangent_laplacian(mesh);
    let areas = barycentric_areas_mm2(mesh);
    let places: Vec<Vec3> = points.iter().map(|p| p.as_vec3()).collect();
    let mut factor = None;
    let mut step = options.step * n as f64 / (8.0 * PI);
    let mut density = energy_density(&laplacian, points);
    let mut report = FlowReport { energy: vec![0.5 * density.iter().sum::<f64>()], step, converged: false };
    while report.energy.len() <= options.max_steps && !report.converged {
        let solved = implicit_step(&laplacian, &density, step, &mut factor, &places, points);
        let moved = match solved {
            Ok(moved) => moved,
            Err(error) if step < 1e-3 => return Err(error),
            Err(_) => {
                step *= 0.5;
                continue;
            }
        };
        points.copy_from_slice(&moved);
        balance(points, &areas);
        density = energy_density(&laplacian, points);
        let energy = 0.5 * density.iter().sum::<f64>();
        let before = report.energy[report.energy.len() - 1];
        report.converged = (before - energy).abs() < options.tolerance * energy;
        report.energy.push(energy);
    }
    report.step = step;
    Ok(report)
}

/// <(K phi)_i, phi_i> at each vertex.
fn energy_density(laplacian: &LowerCsc, points: &[DVec3]) -> Vec<f64> {
    let along = |k: usize| laplacian.multiply(&points.iter().map(|p| p[k]).collect::<Vec<_>>());
    let [x, y, z] = [0, 1, 2].map(along);
    points.iter().enumerate().map(|(i, p)| p.x * x[i] + p.y * y[i] + p.z * z[i]).collect()
}

/// Solves (I + dt (K - D)) phi' = phi and puts phi' on the sphere.
fn implicit_step(
    laplacian: &LowerCsc,
    density: &[f64],
    step: f64,
    factor: &mut Option<SparseLlt>,
    places: &[Vec3],
    points: &[DVec3],
) -> Result<Vec<DVec3>> {
    let n = points.len();
    let diagonal: Vec<f64> = density.iter().map(|d| 1.0 - step * d).collect();
    let matrix = laplacian.shifted(step, &diagonal);
    let factor = SparseLlt::factorize_again(factor, &matrix, || places.to_vec())?;
    let mut rhs: Vec<f64> = (0..3).flat_map(|k| points.iter().map(move |p| p[k])).collect();
    factor.solve(&mut rhs, 3);
    let solved = |i: usize| DVec3::new(rhs[i], rhs[n + i], rhs[2 * n + i]);
    (0..n)
        .map(|i| solved(i).try_normalize().ok_or_else(|| CodecError::Mesh("the flow left the sphere".into())))
        .collect()
}

/// Moves the area-weighted centre of mass towards the origin: to first order a conformal map of the sphere. Without it
/// constants grow from step to step, until all points meet in one.
fn balance(points: &mut [DVec3], areas: &[f64]) {
    let total: f64 = areas.iter().sum();
    let mean = points.iter().zip(areas).map(|(&p, &a)| p * a).sum::<DVec3>() / total.max(f64::MIN_POSITIVE);
    points.iter_mut().for_each(|p| *p = (*p - mean).normalize_or(*p));
}

#[cfg(test)]
mod tests {
    use super::super::disk::disk_map;
    use super::super::mobius::Mobius;
    use super::*;
    use crate::mesh::test_surfaces::{polar_disk, sphere, torus};
    use crate::param::AngleErrors;

    #[test]
    fn an_ellipsoid_becomes_a_sphere_with_its_angles() {
        let mut mesh = sphere(16, 50.0);
        mesh.positions_mm.iter_mut().for_each(|p| *p *= Vec3::new(1.0, 1.4, 0.8));
        let map = sphere_map(&mesh, &FlowOptions::default()).unwrap();
        assert!(map.flow.converged && map.flips == 0, "{:?}", map.flow);
        assert!(map.points.iter().all(|p| (p.length() - 1.0).abs() < 1e-12));
        let energy = map.flow.energy[map.flow.energy.len() - 1];
        assert!((energy / (4.0 * PI) - 1.0).abs() < 0.01, "{energy}");
        let at = |v: u32| mesh.positions_mm[v as usize].as_dvec3();
        let errors = AngleErrors::between(&mesh.triangles, at, |v| map.points[v as usize]);
        assert!(errors.mean_deg < 1.5, "{errors:?}");
    }

    #[test]
    fn the_energy_falls_from_step_to_step() {
        let mut mesh = sphere(10, 30.0);
        mesh.positions_mm.iter_mut().for_each(|p| *p *= Vec3::new(1.0, 0.6, 1.2));
        let map = sphere_map(&mesh, &FlowOptions { step: 0.1, ..Default::default() }).unwrap();
        assert!(map.flow.energy.is_sorted_by(|a, b| *a >= b - 1e-6 * b), "{:?}", map.flow.energy);
    }

    /// The double cover and Green's function must find the same map up to a Möbius transformation.
    #[test]
    fn the_double_cover_agrees_with_greens_function() {
        let (z, triangles) = polar_disk(16);
        let bump =
            |z: &DVec2| Vec3::new(80.0 * z.x as f32, 110.0 * z.y as f32, 60.0 * (1.0 - z.length_squared()) as f32);
        let mesh = TriMesh { positions_mm: z.iter().map(bump).collect(), triangles, uv: None };
        let (map, flow) = double_cover_disk_map(&mesh, &FlowOptions::default()).unwrap();
        assert!(flow.converged && map.flips == 0, "{flow:?}");
        let green = disk_map(&mesh).unwrap();
        let m = Mobius::fit(&map.points, &green.points);
        let apart = map.points.iter().zip(&green.points).map(|(&a, &b)| m.apply(a).distance(b)).fold(0.0, f64::max);
        assert!(apart < 0.01, "{apart}");
        assert!(map.border.iter().all(|&b| (map.points[b as usize].length() - 1.0).abs() < 1e-3));
    }

    #[test]
    fn what_is_no_sphere_is_refused() {
        let error = |mesh: &TriMesh| sphere_map(mesh, &FlowOptions::default()).unwrap_err().to_string();
        assert!(error(&torus(12, 8, 5.0, 2.0)).contains("Euler characteristic 0"));
        let mut open = sphere(3, 1.0);
        open.triangles.pop();
        assert!(error(&open).contains("not closed: edge"));
        assert!(error(&TriMesh::default()).contains("not a sphere"));
    }
}
