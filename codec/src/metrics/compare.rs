//! One scan against its replay.

use super::{AreaSamples, COVERAGE_LIMIT_MM, Distortion};
use crate::mesh::{Bvh, TriMesh};
use crate::{GreyPicture, Scan};
use glam::Vec3;

/// Samples on the replay, however few vertices the scan has.
const MIN_SAMPLES: usize = 1000;

/// What one replayed scan differs in from the scan that came in.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScanComparison {
    /// Distances, coverage and texture of this scan.
    pub distortion: Distortion,
    /// Distance of each vertex of the scan from the replayed surface, millimetres; infinite when there is none.
    pub vertex_error_mm: Vec<f32>,
}

/// Compares a scan with its replay, both valid ([`TriMesh::validate`]).
///
/// All vertices of the scan count, and as many points of the replay's area (1000 at least). Distances are true
/// distances, however large. Where the other side has no surface at all there is no distance: the histograms stay
/// empty, and everything counts as missing or invented. Textures are compared at the vertices of the scan that are not
/// missing, when both sides have a picture and texture coordinates: the scan's picture at the vertex, bilinear, against
/// the replay's at the nearest point.
///
/// # Panics
/// When a mesh names vertices it has not or has texture coordinates for some vertices only.
pub fn compare(scan: &Scan, replay: &Scan) -> ScanComparison {
    let normals = scan.mesh.vertex_normals();
    let (lo, hi) = scan.mesh.bounds_mm();
    let mut distortion = Distortion { scans: 1, diagonal_mm: f64::from((hi - lo).length()), ..Distortion::default() };
    let vertex_error_mm = measure_scan(scan, replay, &normals, &mut distortion);
    measure_replay(&scan.mesh, &replay.mesh, &normals, &mut distortion);
    ScanComparison { distortion, vertex_error_mm }
}

/// From the vertices of the scan to the replay; returns the distance of each.
fn measure_scan(scan: &Scan, replay: &Scan, normals: &[Vec3], into: &mut Distortion) -> Vec<f32> {
    let textures = textured(scan).zip(textured(replay));
    let surface = Bvh::new(&replay.mesh);
    let replayed_normals = replay.mesh.vertex_normals();
    let measure = |(v, &p): (usize, &Vec3)| {
        let Some(nearest) = surface.nearest(p, f32::INFINITY) else {
            into.missing.add(true);
            return f32::INFINITY;
        };
        let distance_mm = nearest.distance2_mm2.sqrt();
        into.scan_to_replay.add(f64::from(distance_mm));
        into.scan_to_replay_plane.add(along_normal2_mm2(nearest.point_mm - p, normals[v]));
        into.missing.add(distance_mm > COVERAGE_LIMIT_MM);
        if distance_mm > COVERAGE_LIMIT_MM {
            return distance_mm;
        }
        let normal = nearest.interpolate(&replay.mesh.triangles, bytemuck::cast_slice(&replayed_normals));
        into.normals.add(normals[v], Vec3::from(normal).normalize_or_zero());
        if let Some(((picture, uv), (replayed, replayed_uv))) = textures {
            let at = nearest.interpolate(&replay.mesh.triangles, replayed_uv);
            let levels = (picture.sample(picture.uv_to_px(uv[v])), replayed.sample(replayed.uv_to_px(at)));
            into.texture.add(f64::from(levels.0 - levels.1));
        }
        distance_mm
    };
    scan.mesh.positions_mm.iter().enumerate().map(measure).collect()
}

/// From points spread over the replay to the scan.
fn measure_replay(scan: &TriMesh, replay: &TriMesh, normals: &[Vec3], into: &mut Distortion) {
    let surface = Bvh::new(scan);
    let count = scan.vertex_count().max(MIN_SAMPLES) as u32;
    for sample in AreaSamples::new(replay, count) {
        let Some(nearest) = surface.nearest(sample.point_mm, f32::INFINITY) else {
            into.invented.add(true);
            continue;
        };
        let distance_mm = nearest.distance2_mm2.sqrt();
        into.replay_to_scan.add(f64::from(distance_mm));
        let normal = nearest.interpolate(&scan.triangles, bytemuck::cast_slice(normals));
        let offset_mm = nearest.point_mm - sample.point_mm;
        into.replay_to_scan_plane.add(along_normal2_mm2(offset_mm, Vec3::from(normal).normalize_or_zero()));
        into.invented.add(distance_mm > COVERAGE_LIMIT_MM);
    }
}

/// Squared length of an offset along a normal, mm²; of the whole offset when there is no normal.
fn along_normal2_mm2(offset_mm: Vec3, normal: Vec3) -> f64 {
    if normal == Vec3::ZERO {
        return f64::from(offset_mm.length_squared());
    }
    let along_mm = f64::from(offset_mm.dot(normal));
    along_mm * along_mm
}

/// Picture and texture coordinates of a scan that has both.
fn textured(scan: &Scan) -> Option<(&GreyPicture, &[[f32; 2]])> {
    let picture = scan.texture.as_ref().filter(|picture| !picture.pixels.is_empty())?;
    Some((picture, scan.mesh.uv.as_deref()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::Share;

    /// A grid of n by n quads over the square of `side_mm`, lifted by `height`, texture stretched over it.
    fn grid(n: u32, side_mm: f32, height: impl Fn(f32, f32) -> f32) -> Scan {
        let nodes = || (0..=n).flat_map(|j| (0..=n).map(move |i| [i as f32 / n as f32, j as f32 / n as f32]));
        let lift = |[x, y]: [f32; 2]| Vec3::new(x * side_mm, y * side_mm, height(x * side_mm, y * side_mm));
        let row = n + 1;
        let quads = (0..n).flat_map(|j| (0..n).map(move |i| j * row + i));
        let mesh = TriMesh {
            positions_mm: nodes().map(lift).collect(),
            triangles: quads.flat_map(|a| [[a, a + 1, a + row + 1], [a, a + row + 1, a + row]]).collect(),
            uv: Some(nodes().collect()),
        };
        Scan { mesh, texture: Some(GreyPicture::filled(16, 16, 100)), ..Scan::default() }
    }

    /// A sphere of n by 2n quads.
    fn sphere(n: u32, radius_mm: f32) -> Scan {
        use std::f32::consts::PI;
        let angles = |k: u32| (PI * (k / (2 * n)) as f32 / n as f32, PI * (k % (2 * n)) as f32 / n as f32);
        let point = |(theta, phi): (f32, f32)| {
            radius_mm * Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos())
        };
        let next = move |k: u32| if k % (2 * n) == 2 * n - 1 { k + 1 - 2 * n } else { k + 1 };
        let mesh = TriMesh {
            positions_mm: (0..2 * n * (n + 1)).map(|k| point(angles(k))).collect(),
            triangles: (0..2 * n * n)
                .flat_map(|k| [[k, k + 2 * n, next(k) + 2 * n], [k, next(k) + 2 * n, next(k)]])
                .collect(),
            uv: None,
        };
        Scan { mesh, ..Scan::default() }
    }

    #[test]
    fn a_scan_equals_itself() {
        let scan = grid(40, 100.0, |x, y| (x * 0.1).sin() * 5.0 + y * y * 0.001);
        let c = compare(&scan, &scan);
        assert_eq!(c.distortion.scan_to_replay.summary().max, 0.0);
        assert!(c.distortion.replay_to_scan.summary().max < 1e-5);
        assert_eq!(c.vertex_error_mm, vec![0.0; 41 * 41]);
        assert_eq!((c.distortion.missing, c.distortion.invented.count), (Share { count: 0, total: 1681 }, 0));
        assert_eq!(c.distortion.texture.psnr_db(), Some(f64::INFINITY));
        assert_eq!(c.distortion.scan_to_replay_plane.squared_sum_mm2, 0.0);
        assert!(c.distortion.normals.rms_deg().unwrap() < 0.05);
        assert!(c.distortion.d1_psnr_db().unwrap() > 140.0);
    }

    #[test]
    fn an_offset_plane_is_its_offset_away_both_ways() {
        let offset_mm = 0.375;
        let c = compare(&grid(50, 90.0, |_, _| 0.0), &grid(7, 90.0, |_, _| offset_mm));
        for histogram in [&c.distortion.scan_to_replay, &c.distortion.replay_to_scan] {
            let s = histogram.summary();
            assert_eq!([s.rms, s.p95, s.p99, s.max], [f64::from(offset_mm); 4]);
            assert_eq!(s.count, 51 * 51);
        }
        let db = 10.0 * (2.0 * 90.0 * 90.0 / (0.375f64 * 0.375)).log10();
        assert!((c.distortion.d1_psnr_db().unwrap() - db).abs() < 1e-5);
        assert!((c.distortion.d2_psnr_db().unwrap() - db).abs() < 1e-5);
        assert!(c.vertex_error_mm.iter().all(|&e| e == offset_mm));
    }

    #[test]
    fn d2_does_not_see_what_slides_along_the_surface() {
        let scan = grid(20, 40.0, |_, _| 0.0);
        let mut replay = scan.clone();
        replay.mesh.positions_mm.iter_mut().for_each(|p| p.x += 1.0);
        let d = compare(&scan, &replay).distortion;
        assert_eq!(d.scan_to_replay.summary().max, 1.0);
        assert!((d.replay_to_scan.summary().max - 1.0).abs() < 1e-2);
        assert_eq!(d.d2_psnr_db(), Some(f64::INFINITY));
        assert!(d.d1_psnr_db().unwrap() < 60.0);
    }

    #[test]
    fn a_tilted_plane_has_its_tilt_as_normal_error() {
        let tilt = 10f32.to_radians();
        let d = compare(&grid(20, 10.0, |_, _| 0.0), &grid(9, 10.0, |x, _| (x - 5.0) * tilt.tan())).distortion;
        assert_eq!(d.normals.count, 21 * 21);
        assert!((d.normals.rms_deg().unwrap() - 10.0).abs() < 5e-3, "{:?}", d.normals.rms_deg());
    }

    #[test]
    fn spheres_are_apart_by_their_radii() {
        let (radius_mm, apart_mm) = (50.0, 0.8);
        let d = compare(&sphere(120, radius_mm), &sphere(90, radius_mm + apart_mm)).distortion;
        // Flat cells lie at most r (1 - cos(diagonal / 2)) inside their sphere: 16 µm for the coarser one.
        for s in [d.scan_to_replay.summary(), d.replay_to_scan.summary()] {
            for figure in [s.rms, s.p95, s.p99, s.max] {
                assert!((figure - f64::from(apart_mm)).abs() < 0.017, "{s:?}");
            }
        }
    }

    #[test]
    fn half_a_plane_is_missing_or_invented() {
        let (whole, mut half) = (grid(100, 100.0, |_, _| 0.0), grid(100, 100.0, |_, _| 0.0));
        half.mesh = half.mesh.submesh(|t| (t / 2) % 100 < 50).0;
        let missing = compare(&whole, &half).distortion;
        // Columns 53 to 100 of 101 lie more than 2 mm beyond the edge at 50 mm.
        assert_eq!(missing.missing, Share { count: 48 * 101, total: 101 * 101 });
        assert_eq!(missing.invented.count, 0);
        assert_eq!(missing.scan_to_replay.summary().max, 50.0);
        assert_eq!((missing.texture.count, missing.normals.count), (53 * 101, 53 * 101));
        let invented = compare(&half, &whole).distortion;
        assert_eq!((invented.missing.count, invented.invented.total), (0, 51 * 101));
        assert!((invented.invented.fraction() - 0.48).abs() < 2e-3);
    }

    #[test]
    fn without_a_surface_everything_is_missing_or_invented() {
        let (scan, empty) = (grid(4, 10.0, |_, _| 0.0), Scan::default());
        let c = compare(&scan, &empty);
        assert_eq!(c.distortion.missing, Share { count: 25, total: 25 });
        assert_eq!((c.distortion.scan_to_replay.count(), c.distortion.invented.total), (0, 0));
        assert_eq!(c.vertex_error_mm, vec![f32::INFINITY; 25]);
        assert_eq!((c.distortion.d1_psnr_db(), c.distortion.texture.psnr_db()), (None, None));
        let d = compare(&empty, &scan).distortion;
        assert_eq!((d.invented.count, d.invented.total), (MIN_SAMPLES as u64, MIN_SAMPLES as u64));
        assert_eq!((d.missing.total, d.replay_to_scan.count()), (0, 0));
    }

    #[test]
    fn texture_psnr_of_a_constant_difference() {
        let ramp =
            |add: u8| GreyPicture::new(32, 32, (0..32 * 32).map(|k| (k % 32 * 4 + k / 32) as u8 + add).collect());
        let (mut scan, mut replay) = (grid(40, 60.0, |_, _| 0.0), grid(9, 60.0, |_, _| 0.5));
        scan.texture = Some(ramp(0));
        replay.texture = Some(ramp(5));
        let texture = compare(&scan, &replay).distortion.texture;
        assert_eq!(texture.count, 41 * 41);
        assert!((texture.psnr_db().unwrap() - 20.0 * 51f64.log10()).abs() < 1e-3);
        replay.texture = None;
        assert_eq!(compare(&scan, &replay).distortion.texture.count, 0);
        replay.texture = Some(GreyPicture::default());
        assert_eq!(compare(&scan, &replay).distortion.texture.psnr_db(), None);
    }
}
