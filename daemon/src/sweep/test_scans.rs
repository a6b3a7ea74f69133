//! Small made-up scans for tests of coders.

use super::SweepInput;
use glam::Vec3;
use gv3_codec::mesh::TriMesh;
use gv3_codec::{GreyPicture, Scan};

/// Side of a pixel.
const PIXEL_MM: f32 = 0.5;

/// A smooth hill on a disk in n by n pixels, texture coordinates on the pixels' middles, moved up by `lift_mm`. Cells are
/// cut from upper left to lower right, where these corners exist.
pub fn hill(n: usize, lift_mm: f32) -> Scan {
    let middle = n as f32 / 2.0;
    let picture = GreyPicture::new(n as u32, n as u32, (0..n * n).map(|k| (60 + k * 7 % 97) as u8).collect());
    let (mut mesh, mut uv) = (TriMesh::default(), Vec::new());
    let mut vertex = vec![None; n * n];
    for (at, slot) in vertex.iter_mut().enumerate() {
        let (column, row) = ((at % n) as f32, (at / n) as f32);
        let (x, y) = (column - middle, row - middle);
        let r2 = (x * x + y * y) / (middle * middle);
        if r2 < 0.9 {
            *slot = Some(mesh.positions_mm.len() as u32);
            let z = 10.0 * (-2.0 * r2).exp() + 0.5 * (x * 0.3).sin() + lift_mm;
            mesh.positions_mm.push(Vec3::new(PIXEL_MM * column, -PIXEL_MM * row, z));
            uv.push(picture.px_to_uv([column, row]));
        }
    }
    for a in (0..n * (n - 1)).filter(|a| a % n < n - 1) {
        let [a, b, c, d] = [a, a + 1, a + n, a + n + 1].map(|at| vertex[at]);
        let cut = if a.is_some() && d.is_some() { [[a, d, b], [a, c, d]] } else { [[a, c, b], [b, c, d]] };
        let whole = |[p, q, r]: [Option<u32>; 3]| Some([p?, q?, r?]);
        mesh.triangles.extend(cut.into_iter().filter_map(whole));
    }
    mesh.uv = Some(uv);
    Scan { mesh, texture: Some(picture), ..Scan::default() }
}

/// Hills that rise by 0.2 mm a scan.
pub fn rising(n: usize, scans: usize) -> SweepInput {
    const PERIOD_NANOS: u64 = 33_333_333;
    let scan = |i: usize| Scan { tick: i as u64, time_nanos: i as u64 * PERIOD_NANOS, ..hill(n, 0.2 * i as f32) };
    let scans: Vec<Scan> = (0..scans).map(scan).collect();
    SweepInput { scans, period_nanos: PERIOD_NANOS, obj_bmp_bytes: 1, binary_bytes: 1 }
}
