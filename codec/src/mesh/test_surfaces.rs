//! Surfaces of known shape for tests.

use super::TriMesh;
use glam::{DVec2, Vec2, Vec3};
use std::f32::consts::TAU;

/// Sphere around the origin: an octahedron whose faces are cut into n² triangles, normals outward.
pub(crate) fn sphere(n: u32, radius_mm: f32) -> TriMesh {
    let faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
    let ends = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
    let mut index = std::collections::BTreeMap::new();
    let mut mesh = TriMesh::default();
    for face in faces {
        let [a, b, c] = face.map(|v: usize| ends[v].as_ivec3());
        let mut at = |i: u32, j: u32| {
            let p = a * (n - i - j) as i32 + b * i as i32 + c * j as i32;
            *index.entry(p.to_array()).or_insert_with(|| {
                // Tangents spread the vertices evenly over the sphere.
                let spread = p.as_vec3().map(|x| (x / n as f32 * std::f32::consts::FRAC_PI_4).tan());
                mesh.positions_mm.push(spread.normalize() * radius_mm);
                mesh.positions_mm.len() as u32 - 1
            })
        };
        for (i, j) in (0..n).flat_map(|i| (0..n - i).map(move |j| (i, j))) {
            mesh.triangles.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
            if i + j + 1 < n {
                mesh.triangles.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
    }
    mesh
}

/// Grid of `columns` x `rows` quads, closed round in x and/or y, placed by `place` (x, y from 0 to 1).
fn sheet(columns: u32, rows: u32, wrap: [bool; 2], place: impl Fn(f32, f32) -> Vec3) -> TriMesh {
    let (width, height) = (columns + u32::from(!wrap[0]), rows + u32::from(!wrap[1]));
    let at = |x: u32, y: u32| y % height * width + x % width;
    let grid = (0..width * height).map(|i| (i % width, i / width));
    let quads = (0..columns * rows).map(|i| (i % columns, i / columns));
    TriMesh {
        positions_mm: grid.map(|(x, y)| place(x as f32 / columns as f32, y as f32 / rows as f32)).collect(),
        triangles: quads
            .flat_map(|(x, y)| [[at(x, y), at(x + 1, y), at(x + 1, y + 1)], [at(x, y), at(x + 1, y + 1), at(x, y + 1)]])
            .collect(),
        uv: None,
    }
}

/// Torus around z, normals outward.
pub(crate) fn torus(around: u32, across: u32, ring_mm: f32, radius_mm: f32) -> TriMesh {
    sheet(around, across, [true, true], |u, v| {
        let (u, v) = (u * TAU, v * TAU);
        let reach = ring_mm + radius_mm * v.cos();
        Vec3::new(reach * u.cos(), reach * u.sin(), radius_mm * v.sin())
    })
}

/// Open cylinder around z, normals outward: an annulus.
pub(crate) fn tube(around: u32, along: u32, radius_mm: f32, length_mm: f32) -> TriMesh {
    sheet(around, along, [true, false], |u, v| {
        Vec3::new(radius_mm * (u * TAU).cos(), radius_mm * (u * TAU).sin(), v * length_mm)
    })
}

/// Deterministic noise, -0.5..0.5.
pub(crate) fn noise(seed: u64) -> impl FnMut() -> f32 {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5
    }
}

/// Flat plate of `side` x `side` vertices about 1 mm apart, shaken so that many angles are obtuse but none is turned
/// over.
pub(crate) fn jittered_plate(side: u32, seed: u64) -> TriMesh {
    let mut noise = noise(seed);
    let mut mesh = sheet(side - 1, side - 1, [false, false], |u, v| Vec3::new(u, v, 0.0) * (side - 1) as f32);
    for p in &mut mesh.positions_mm {
        *p += Vec3::new(noise(), noise(), 0.0) * 0.45;
    }
    mesh
}

/// Rings of points on the unit disk and the triangulation between them; the border comes last, counter-clockwise.
pub(crate) fn polar_disk(rings: u32) -> (Vec<DVec2>, Vec<[u32; 3]>) {
    let mut points = vec![DVec2::ZERO];
    let mut triangles = Vec::new();
    let at = |k: u32, j: u32| if k == 0 { 0 } else { 1 + 3 * k * (k - 1) + j % (6 * k) };
    for k in 1..=rings {
        for j in 0..6 * k {
            let angle = std::f64::consts::TAU * f64::from(j) / f64::from(6 * k);
            points.push(DVec2::from_angle(angle) * f64::from(k) / f64::from(rings));
        }
        for (side, j) in (0..6).flat_map(|side| (0..k).map(move |j| (side, j))) {
            let (outer, inner) = (side * k + j, side * (k - 1) + j);
            triangles.push([at(k, outer), at(k, outer + 1), at(k - 1, inner)]);
            if j + 1 < k {
                triangles.push([at(k - 1, inner), at(k, outer + 1), at(k - 1, inner + 1)]);
            }
        }
    }
    (points, triangles)
}

/// Height field on a `side` x `side` vertex grid of 1 mm, without the quads whose centre is in `hole`.
pub(crate) fn plate(side: u32, height: impl Fn(Vec2) -> f32, hole: impl Fn(Vec2) -> bool) -> TriMesh {
    let at = |x: u32, y: u32| Vec2::new(x as f32, y as f32);
    let grid = (0..side * side).map(|i| at(i % side, i / side));
    let mut mesh = TriMesh {
        positions_mm: grid.clone().map(|p| p.extend(height(p))).collect(),
        triangles: Vec::new(),
        uv: Some(grid.map(|p| (p / side as f32).to_array()).collect()),
    };
    for (x, y) in (0..side - 1).flat_map(|y| (0..side - 1).map(move |x| (x, y))) {
        if !hole(at(x, y) + 0.5) {
            let a = y * side + x;
            mesh.triangles.extend([[a, a + 1, a + side + 1], [a, a + side + 1, a + side]]);
        }
    }
    mesh.submesh(|_| true).0
}
