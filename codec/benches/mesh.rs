//! Mesh and disk-map stages on generated scans of about 120,000 and 60,000 vertices with holes and a staircase border, and a
//! keyframe's whole geometry. `cargo bench -p gv3-codec --bench mesh -- "disk map"` prints the disk map's times.

use criterion::{Criterion, criterion_group, criterion_main};
use glam::{DVec2, Vec3};
use gv3_codec::{
    GreyPicture, Scan,
    mesh::{
        Bvh, DiskMesh, HalfEdges, TriMesh, cotangent_laplacian, mean_curvature,
        repair::{RepairOptions, to_disk},
        simplify::{SimplifyOptions, simplify},
    },
    param::{
        disk::{DiskMap, DiskMapper},
        matching::{DiskMatch, SourceDisk, WarpKind},
    },
};
use std::hint::black_box;

/// Pixels a side that see about 120,000 and 60,000 vertices, and the width they cover.
const SIDES: [u32; 2] = [398, 282];
const WIDTH_MM: f32 = 161.0;
/// No mouth, no eyes.
const SHUT: [f32; 2] = [0.0; 2];

/// Deterministic noise in -1..1 from a pixel (integer hash).
fn noise(x: u32, y: u32) -> f32 {
    let mut h = (x.wrapping_mul(0x9E37_79B1)) ^ y.wrapping_mul(0x85EB_CA77);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    (h ^ (h >> 12)) as f32 / u32::MAX as f32 * 2.0 - 1.0
}

/// A dome with a nose, wrinkles and camera noise, seen on a grid of `side` pixels a side; a mouth of
/// `[width, height]` and two eyes are cut where it is open.
fn face(side: u32, [width_mm, height_mm]: [f32; 2]) -> Scan {
    let centred = |i: u32| (i as f32 / side as f32 - 0.5) * WIDTH_MM;
    let seen = |x: u32, y: u32| {
        let (px, py) = (centred(x), centred(y));
        let eye = (px.abs() - 30.0).hypot((py - 15.0) * 2.0) < 10.0;
        let mouth = (px / width_mm).hypot((py + 40.0) / height_mm) < 0.5;
        px.hypot(py) < 79.0 && !(width_mm > 0.0 && (eye || mouth))
    };
    let position = |x: u32, y: u32| {
        let (px, py) = (centred(x), centred(y));
        let nose = 25.0 * (-(px * px + py * py) / 200.0).exp();
        let dome = (100f32 * 100.0 - px * px - py * py).max(0.0).sqrt();
        Vec3::new(px, py, dome + nose + 0.3 * (px * 0.8).sin() * (py * 0.7).cos() + 0.05 * noise(x, y))
    };
    let pixels = (0..side * side).map(|i| (i % side, i / side));
    let picture =
        GreyPicture::new(side, side, pixels.clone().map(|(x, y)| (128.0 + 60.0 * noise(x / 8, y / 8)) as u8).collect());
    let mut triangles = Vec::new();
    for (x, y) in pixels.clone().filter(|&(x, y)| x + 1 < side && y + 1 < side) {
        let a = y * side + x;
        if [(0, 0), (1, 0), (0, 1), (1, 1)].iter().all(|(dx, dy)| seen(x + dx, y + dy)) {
            triangles.extend([[a, a + 1, a + side + 1], [a, a + side + 1, a + side]]);
        }
    }
    let whole = TriMesh {
        positions_mm: pixels.clone().map(|(x, y)| position(x, y)).collect(),
        triangles,
        uv: Some(pixels.map(|(x, y)| picture.px_to_uv([x as f32, y as f32])).collect()),
    };
    Scan { mesh: whole.submesh(|_| true).0, texture: Some(picture), ..Default::default() }
}

/// Matches a disk to itself with 68 landmarks moved a little.
fn matched(mesh: &TriMesh, map: &DiskMap) -> DiskMatch {
    let step = map.points.len() / 68;
    let from: Vec<DVec2> = map.points.iter().step_by(step).take(68).map(|z| *z * 0.95).collect();
    let shake = |p: &DVec2| *p + DVec2::new((7.0 * p.y).sin(), (5.0 * p.x).cos()) * 0.03 * (1.0 - p.length());
    let to: Vec<DVec2> = from.iter().map(shake).collect();
    let source = SourceDisk { points: &map.points, triangles: &mesh.triangles };
    DiskMatch::fit(&from, &to, source, &WarpKind::ThinPlate)
}

/// The disk map alone.
fn mapped(disk: &DiskMesh) -> gv3_codec::Result<DiskMap> {
    DiskMapper::default().map(disk, &mut |_| ())
}

/// The geometry of one keyframe: a raw scan becomes a disk of `vertices`, laid flat and matched.
fn keyframe(scan: &TriMesh, vertices: usize) -> gv3_codec::Result<DiskMatch> {
    let (disk, _) = to_disk(black_box(scan), &RepairOptions::default())?;
    let (small, _) = simplify(&disk, vertices, &SimplifyOptions::default());
    Ok(matched(&small, &mapped(&small)?))
}

fn bench(c: &mut Criterion) {
    let scan = face(SIDES[0], SHUT);
    let holed = face(SIDES[0], [26.0, 8.0]);
    let (disk, _) = to_disk(&scan.mesh, &RepairOptions::default()).expect("the generated scan can be repaired");
    let (small, _) = simplify(&disk, 20_000, &SimplifyOptions::default());
    let (half, _) = to_disk(&face(SIDES[1], SHUT).mesh, &RepairOptions::default()).expect("as the large one");
    let replay = Scan { mesh: small.clone().into_mesh(), ..scan.clone() };
    let bvh = Bvh::new(&scan.mesh);
    let mut group = c.benchmark_group(format!("mesh of {} vertices", scan.mesh.vertex_count()));
    group.sample_size(10);
    group.bench_function("half_edges", |b| {
        b.iter(|| HalfEdges::build(scan.mesh.vertex_count(), black_box(&scan.mesh.triangles)));
    });
    group.bench_function("bvh build", |b| b.iter(|| Bvh::new(black_box(&scan.mesh))));
    group.bench_function("bvh 20,000 nearest", |b| {
        b.iter(|| replay.mesh.positions_mm.iter().filter_map(|&p| bvh.nearest(p, 10.0)).count());
    });
    group.bench_function("to_disk", |b| b.iter(|| to_disk(black_box(&holed.mesh), &RepairOptions::default())));
    let wide = face(SIDES[0], [40.0, 16.0]);
    group.bench_function("to_disk, a mouth of 40 mm, 3,000 vertices filled", |b| {
        b.iter(|| to_disk(black_box(&wide.mesh), &RepairOptions::default()));
    });
    group.bench_function("simplify to 20,000", |b| {
        b.iter(|| simplify(black_box(&disk), 20_000, &SimplifyOptions::default()));
    });
    for vertices in [10_000, 20_000] {
        let name = format!("keyframe: to_disk, simplify to {vertices}, disk map, match of 68 landmarks");
        group.bench_function(name, |b| b.iter(|| keyframe(&holed.mesh, vertices)));
    }
    let flat = mapped(&small).expect("it is a disk");
    group.bench_function("match of 20,000 by 68 landmarks", |b| b.iter(|| matched(black_box(&replay.mesh), &flat)));
    group.bench_function("disk map of 20,000", |b| b.iter(|| mapped(black_box(&small))));
    group.bench_function("disk map of a grid scan of 60,000", |b| b.iter(|| mapped(black_box(&half))));
    group.bench_function("disk map of a grid scan of 120,000", |b| b.iter(|| mapped(black_box(&disk))));
    let mut mapper = DiskMapper::default();
    group.bench_function("disk map of 120,000, same connectivity again", |b| {
        b.iter(|| mapper.map(black_box(&disk), &mut |_| ()));
    });
    group.bench_function("cotangent Laplacian", |b| b.iter(|| cotangent_laplacian(black_box(&disk))));
    group.bench_function("mean curvature", |b| b.iter(|| mean_curvature(black_box(&disk))));
    group.bench_function("bvh 20,000 rays", |b| {
        b.iter(|| {
            let hit = |p: &Vec3| bvh.first_hit(*p + Vec3::Z * 50.0, Vec3::NEG_Z, 100.0);
            replay.mesh.positions_mm.iter().filter_map(hit).count()
        });
    });
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
