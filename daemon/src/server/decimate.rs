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
        if mesh.vertex_count() <= max_vertices {
            return Self { kept: (0..mesh.vertex_count() as u32).collect(), triangles: mesh.triangles.clone() };
        }
        let (low, high) = mesh.bounds_mm();
        let size = (high - low).max(Vec3::splat(1e-6));
        // As if all of the surface lay square to one axis; what is curved needs larger cells.
        let mut cell_mm = ((size.x * size.y).max(size.y * size.z).max(size.z * size.x) / max_vertices as f32).sqrt();
        let mut cells = cells(mesh, low, cell_mm);
        for _ in 0..TRIES {
            if cells.count <= max_vertices {
                break;
            }
            cell_mm *= (cells.count as f32 / max_vertices as f32).sqrt().max(1.02);
            cells = self::cells(mesh, low, cell_mm);
        }
        cells.decimation(mesh, max_vertices)
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
    pub fn bowl(n: u32) -> TriMesh {
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

    #[test]
    fn a_large_surface_becomes_a_valid_small_one_of_its_own_vertices() {
        let mesh = bowl(200);
        for most in [100, 1000, 20_000] {
            let thin = Decimation::new(&mesh, most);
            assert!(thin.kept.len() <= most && thin.kept.len() > most / 3, "{} of {most}", thin.kept.len());
            let positions_mm = thin.kept.iter().map(|&v| mesh.positions_mm[v as usize]).collect();
            let shown = TriMesh { positions_mm, triangles: thin.triangles, uv: None };
            shown.validate().unwrap();
            let share = shown.area_mm2() / mesh.area_mm2();
            assert!((0.8..1.1).contains(&share), "{share} of the area at {most}");
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
