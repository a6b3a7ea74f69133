//! Expressions of the simulator's talking head, whose vertices correspond: flattened and matched by some of them, nothing
//! folds and the warp brings the others nearer than Möbius alone.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use glam::DVec2;
use gv3::device::RigConfig;
use gv3::device::sim::SimWorld;
use gv3_codec::mesh::TriMesh;
use gv3_codec::param::disk::{DiskMap, disk_map};
use gv3_codec::param::locate::DiskLocator;
use gv3_codec::param::match_energies::{MappedSurface, MatchEnergies};
use gv3_codec::param::matching::{DiskMatch, SourceDisk, WarpKind};

const MILLISECOND_NANOS: u64 = 1_000_000;

/// A face at one time, laid flat.
struct Flat {
    mesh: TriMesh,
    map: DiskMap,
    locator: DiskLocator,
}

impl Flat {
    fn new(mesh: TriMesh) -> Self {
        let map = disk_map(&mesh).unwrap();
        let locator = DiskLocator::new(&map.points, &mesh.triangles);
        Self { mesh, map, locator }
    }

    fn surface(&self) -> MappedSurface<'_> {
        MappedSurface { mesh: &self.mesh, points: &self.map.points, locator: &self.locator }
    }

    fn pick(&self, vertices: &[usize]) -> Vec<DVec2> {
        vertices.iter().map(|&v| self.map.points[v]).collect()
    }
}

/// Vertices nearest to a lattice of 11 x 11 places over the picture of the skin, those within its oval.
fn landmarks(mesh: &TriMesh) -> Vec<usize> {
    let uv: Vec<DVec2> =
        mesh.uv.as_ref().unwrap().iter().map(|t| DVec2::new(f64::from(t[0]), f64::from(t[1]))).collect();
    let (low, high) = uv.iter().fold((uv[0], uv[0]), |(low, high), t| (low.min(*t), high.max(*t)));
    let lattice = (0..121).map(|i| DVec2::new(f64::from(i % 11), f64::from(i / 11)) / 5.0 - DVec2::ONE);
    let wanted = lattice.filter(|p| p.length() < 0.9).map(|p| low + (high - low) * (p + 1.0) / 2.0);
    let nearest = |t: DVec2| (0..uv.len()).min_by(|&a, &b| uv[a].distance(t).total_cmp(&uv[b].distance(t))).unwrap();
    wanted.map(nearest).collect()
}

#[test]
fn expressions_match_without_folds_and_nearer_than_by_mobius_alone() {
    let world = SimWorld::new(&RigConfig::simulated()).unwrap();
    let at = |milliseconds: u64| Flat::new(world.truth_mesh(milliseconds * MILLISECOND_NANOS));
    let rest = at(0);
    let vertices = landmarks(&rest.mesh);
    assert!(vertices.len() > 60, "{}", vertices.len());
    let from = rest.pick(&vertices);
    // Landmarks are met by the fit itself: the energy is that of vertices it does not know.
    let judged: Vec<usize> = (0..rest.map.points.len()).step_by(97).filter(|v| !vertices.contains(v)).collect();
    let source = SourceDisk { points: &rest.map.points, triangles: &rest.mesh.triangles };
    for milliseconds in [500, 1100] {
        let other = at(milliseconds);
        let to = other.pick(&vertices);
        let pairs: Vec<(DVec2, DVec2)> = rest.pick(&judged).into_iter().zip(other.pick(&judged)).collect();
        let left_mm2 = |kind: WarpKind| {
            let matching = DiskMatch::fit(&from, &to, source, &kind);
            assert_eq!(matching.folds, 0, "{kind:?} at {milliseconds} ms");
            MatchEnergies::of(|z| matching.apply(z), rest.surface(), other.surface(), &pairs).local_mm2
        };
        let mobius = left_mm2(WarpKind::Mobius);
        let [thin, clamped] = [WarpKind::ThinPlate, WarpKind::ClampedPlate].map(left_mm2);
        println!(
            "{milliseconds} ms: E_loc {mobius:.1} mm² by Möbius, {thin:.1} thin plate, {clamped:.1} clamped plate"
        );
        assert!(mobius > 1.0, "{milliseconds} ms: the expressions hardly differ, E_loc {mobius} mm²");
        assert!(thin < 0.5 * mobius && clamped < 0.5 * mobius, "{milliseconds} ms: {mobius} -> {thin}, {clamped}");
    }
}
