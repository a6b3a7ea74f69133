//! Thins a surface for a viewer: one vertex a cell of a grid in space, the one nearest to the mean of its cell.
//!
//! Vertices that stay are vertices of the surface, so that as long as its triangles stay the same the choice does too,
//! and only positions change. Vertex clustering after J. Rossignac, P. Borrel, Multi-resolution 3D approximations for
//! rendering complex scenes, 1993, with an original vertex as the representative.

use glam::{IVec3, Vec3};
use gv3_codec::mesh::TriMesh;
use std::collections::HashMap;

/// Sizes of cells that are tried.
const TRIES: usize = 12;
/// Share of the vertices allowed that is aimed at, and the share with which the search ends.
const AIM: f32 = 0.97;
const ENOUGH: f32 = 0.93;
/// Most cells along a side of the picture: beyond the pixels of cameras, smaller ones show no more.
const MOST_COLUMNS: f32 = 2048.0;

/// Which vertices of a surface a viewer is shown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Decimation {
    /// Vertex of the surface for each vertex shown.
    pub kept: Vec<u32>,
    /// Triangles between vertices shown.
    pub triangles: Vec<[u32; 3]>,
}

impl Decimation {
    /// Chooses at most `max_vertices` (at least 3) of a valid mesh.
    pub fn new(mesh: &TriMesh, max_vertices: usize) -> Self {
        let (low, high) = mesh.bounds_mm();
        let size = (high - low).max(Vec3::splat(1e-6));
        // As if all of the surface lay square to one axis; what is curved needs larger cells.
        let area_mm2 = (size.x * size.y).max(size.y * size.z).max(size.z * size.x);
        Self::with_cells(mesh, max_vertices, area_mm2.sqrt(), |cell_mm| cells(mesh, low, cell_mm))
    }

    /// The same of a scan whose texture coordinates are places in the camera's picture: cells lie in the picture, which
    /// is some ten times faster, but for surfaces in front of each other only right where each pixel has one.
    pub fn of_scan(mesh: &TriMesh, max_vertices: usize) -> Self {
        match &mesh.uv {
            Some(uv) if uv.iter().flatten().all(|c| (0.0..=1.0).contains(c)) => {
                Self::with_cells(mesh, max_vertices, 1.0, |cell| picture_cells(uv, cell))
            }
            _ => Self::new(mesh, max_vertices),
        }
    }

    /// Looks for the size of cells, of a surface as large as a square of `side`, that keeps nearly as many vertices as are
    /// allowed.
    fn with_cells(mesh: &TriMesh, max_vertices: usize, side: f32, cells: impl Fn(f32) -> Cells) -> Self {
        if mesh.vertex_count() <= max_vertices {
            return Self { kept: (0..mesh.vertex_count() as u32).collect(), triangles: mesh.triangles.clone() };
        }
        let most = max_vertices as f32;
        // As many as are allowed is best, and fewer is better than more.
        let rank = |count: usize| if count > max_vertices { -(count as i64) } else { count as i64 };
        let mut size = side / most.sqrt();
        // Of sizes known, the largest with too many cells and the smallest without.
        let (mut too_small, mut large_enough) = (0.0, f32::INFINITY);
        let mut best = cells(size);
        let mut count = best.count;
        for _ in 1..TRIES {
            if count > max_vertices {
                too_small = size;
            } else if count as f32 >= ENOUGH * most {
                break;
            } else {
                large_enough = size;
            }
            // The cells of a surface are as many as their area goes into its own.
            let guess = size * (count as f32 / (AIM * most)).sqrt();
            size = if too_small < guess && guess < large_enough { guess } else { 0.5 * (too_small + large_enough) };
            let found = cells(size);
            count = found.count;
            if rank(count) > rank(best.count) {
                best = found;
            }
        }
        best.decimation(mesh, max_vertices)
    }
}

/// Vertices by cell.
struct Cells {
    of_vertex: Vec<u32>,
    count: usize,
}

fn cells(mesh: &TriMesh, low: Vec3, cell_mm: f32) -> Cells {
    let mut numbers: HashMap<IVec3, u32> = HashMap::with_capacity(mesh.vertex_count() / 4);
    let scale = 1.0 / cell_mm;
    let of_vertex = mesh.positions_mm.iter().map(|p| {
        let next = numbers.len() as u32;
        *numbers.entry(((*p - low) * scale).as_ivec3()).or_insert(next)
    });
    Cells { of_vertex: of_vertex.collect(), count: numbers.len() }
}

/// Cells of the unit square, `cell` wide.
fn picture_cells(uv: &[[f32; 2]], cell: f32) -> Cells {
    let scale = (1.0 / cell).min(MOST_COLUMNS);
    let columns = scale as usize + 1;
    let mut numbers = vec![u32::MAX; columns * columns];
    let mut count = 0;
    let of_vertex = uv.iter().map(|[u, v]| {
        let number = &mut numbers[(v * scale) as usize * columns + (u * scale) as usize];
        if *number == u32::MAX {
            *number = count;
            count += 1;
        }
        *number
    });
    let of_vertex = of_vertex.collect();
    Cells { of_vertex, count: count as usize }
}

impl Cells {
    fn decimation(&self, mesh: &TriMesh, max_vertices: usize) -> Decimation {
        // Cells are numbered in the order in which vertices meet them; those past the limit are left out, which only a
        // surface that no cell size thins can come to.
        let count = self.count.min(max_vertices);
        let mut sums = vec![(Vec3::ZERO, 0.0f32); self.count];
        for (p, &cell) in mesh.positions_mm.iter().zip(&self.of_vertex) {
            sums[cell as usize].0 += *p;
            sums[cell as usize].1 += 1.0;
        }
        let mut kept = vec![(u32::MAX, f32::INFINITY); self.count];
        for (v, (p, &cell)) in mesh.positions_mm.iter().zip(&self.of_vertex).enumerate() {
            let (sum, n) = sums[cell as usize];
            let distance = p.distance_squared(sum / n);
            if distance < kept[cell as usize].1 {
                kept[cell as usize] = (v as u32, distance);
            }
        }
        let triangles = mesh.triangles.iter().map(|t| t.map(|v| self.of_vertex[v as usize]));
        let mut triangles: Vec<[u32; 3]> = triangles
            .filter(|[a, b, c]| a != b && b != c && c != a && [a, b, c].iter().all(|&&v| (v as usize) < count))
            .map(turned)
            .collect();
        triangles.sort_unstable();
        triangles.dedup();
        Decimation { kept: kept[..count].iter().map(|k| k.0).collect(), triangles }
    }
}

/// The same triangle beginning with its smallest corner.
fn turned([a, b, c]: [u32; 3]) -> [u32; 3] {
    if a < b && a < c {
        [a, b, c]
    } else if b < c {
        [b, c, a]
    } else {
        [c, a, b]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bowl of `n` x `n` vertices.
    fn bowl(n: u32) -> TriMesh {
        let at = |i: u32| (i as f32 / (n - 1) as f32 - 0.5) * 100.0;
        let positions_mm =
            (0..n * n).map(|i| Vec3::new(at(i % n), at(i / n), (at(i % n).powi(2) + at(i / n).powi(2)) * 0.01));
        let mut triangles = Vec::new();
        for (x, y) in (0..n - 1).flat_map(|y| (0..n - 1).map(move |x| (x, y))) {
            let a = y * n + x;
            triangles.extend([[a, a + 1, a + n], [a + 1, a + n + 1, a + n]]);
        }
        TriMesh { positions_mm: positions_mm.collect(), triangles, uv: None }
    }

    /// The same, seen by a camera in whose picture it takes up a part `share` wide and high.
    fn seen(mesh: &TriMesh, share: f32) -> TriMesh {
        let uv = mesh.positions_mm.iter().map(|p| [p.x, p.y].map(|c| (c * 0.0099 + 0.5) * share)).collect();
        TriMesh { uv: Some(uv), ..mesh.clone() }
    }

    #[test]
    fn a_large_surface_becomes_a_valid_one_of_nearly_as_many_of_its_vertices_as_are_allowed() {
        let mesh = bowl(200);
        let [wide, narrow] = [1.0, 0.3].map(|share| seen(&mesh, share));
        let all =
            |most| [Decimation::new(&mesh, most), Decimation::of_scan(&wide, most), Decimation::of_scan(&narrow, most)];
        for (most, thin) in [100, 1000, 3000, 20_000, 35_000].into_iter().flat_map(|n| all(n).map(|thin| (n, thin))) {
            // Of a surface of a hundred vertices much is rim, and cut off.
            let least_area = if most == 100 { 0.79 } else { 0.94 };
            let share = thin.kept.len() as f64 / most as f64;
            assert!((0.9..=1.0).contains(&share), "{} of {most}", thin.kept.len());
            let positions_mm = thin.kept.iter().map(|&v| mesh.positions_mm[v as usize]).collect();
            let shown = TriMesh { positions_mm, triangles: thin.triangles, uv: None };
            shown.validate().unwrap();
            let share = shown.area_mm2() / mesh.area_mm2();
            assert!((least_area..1.1).contains(&share), "{share} of the area at {most}");
        }
    }

    #[test]
    fn a_small_surface_stays_as_it_is() {
        let mesh = bowl(10);
        let same = Decimation::new(&mesh, 100);
        assert_eq!(same.triangles, mesh.triangles);
        assert_eq!(same.kept.len(), 100);
    }

    #[test]
    fn a_surface_in_one_point_does_not_hang() {
        let mesh = TriMesh { positions_mm: vec![Vec3::ONE; 50], triangles: vec![[0, 1, 2]], uv: None };
        assert_eq!(Decimation::new(&mesh, 3), Decimation { kept: vec![0], triangles: vec![] });
    }
}
