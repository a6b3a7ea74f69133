//! Indexed triangle mesh: plain arrays, no topology.

use crate::{CodecError, Result};
use glam::{DVec3, Vec3};

/// Indexed triangle mesh, counter-clockwise seen from outside.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TriMesh {
    /// Vertex positions, millimetres.
    pub positions_mm: Vec<Vec3>,
    /// Three vertex indices a triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates a vertex (u right, v up, 0..1), as OBJ `vt`.
    pub uv: Option<Vec<[f32; 2]>>,
}

impl TriMesh {
    /// Number of vertices.
    pub fn vertex_count(&self) -> usize {
        self.positions_mm.len()
    }

    /// Checks that arrays agree: indices in range, three different corners a triangle, finite numbers, one uv a vertex.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] naming the first element that is wrong (1-based, as OBJ counts).
    pub fn validate(&self) -> Result<()> {
        let n = self.positions_mm.len();
        if let Some(i) = self.positions_mm.iter().position(|p| !p.is_finite()) {
            return Err(CodecError::Mesh(format!("vertex {} is not finite", i + 1)));
        }
        for (i, t) in self.triangles.iter().enumerate() {
            if let Some(v) = t.iter().find(|&&v| v as usize >= n) {
                return Err(CodecError::Mesh(format!("triangle {} names vertex {}, of {n}", i + 1, u64::from(*v) + 1)));
            }
            if t[0] == t[1] || t[1] == t[2] || t[2] == t[0] {
                return Err(CodecError::Mesh(format!("triangle {} repeats a vertex", i + 1)));
            }
        }
        match &self.uv {
            Some(uv) if uv.len() != n => {
                Err(CodecError::Mesh(format!("{} texture coordinates for {n} vertices", uv.len())))
            }
            Some(uv) => match uv.iter().position(|t| !(t[0].is_finite() && t[1].is_finite())) {
                Some(i) => Err(CodecError::Mesh(format!("texture coordinate {} is not finite", i + 1))),
                None => Ok(()),
            },
            None => Ok(()),
        }
    }

    /// Corner positions of triangle `t`.
    pub fn corners(&self, t: usize) -> [Vec3; 3] {
        self.triangles[t].map(|v| self.positions_mm[v as usize])
    }

    /// Normal of triangle `t`, its length twice the area (mm²).
    pub fn area_normal(&self, t: usize) -> Vec3 {
        let [a, b, c] = self.corners(t);
        (b - a).cross(c - a)
    }

    /// Surface area, mm².
    pub fn area_mm2(&self) -> f64 {
        (0..self.triangles.len()).map(|t| f64::from(self.area_normal(t).length()) * 0.5).sum()
    }

    /// Smallest and largest coordinates; zeros for an empty mesh.
    pub fn bounds_mm(&self) -> (Vec3, Vec3) {
        let mut points = self.positions_mm.iter();
        let Some(&first) = points.next() else { return (Vec3::ZERO, Vec3::ZERO) };
        points.fold((first, first), |(lo, hi), &p| (lo.min(p), hi.max(p)))
    }

    /// Mean of the vertices, mm.
    pub fn centroid_mm(&self) -> Vec3 {
        let sum: DVec3 = self.positions_mm.iter().map(|p| p.as_dvec3()).sum();
        (sum / self.positions_mm.len().max(1) as f64).as_vec3()
    }

    /// The mesh made of the triangles for which `keep` holds, without unused vertices; order is kept.
    /// Returns also, for each new vertex, its old index.
    pub fn submesh(&self, keep: impl Fn(usize) -> bool) -> (TriMesh, Vec<u32>) {
        let mut new_of = vec![u32::MAX; self.positions_mm.len()];
        let kept: Vec<[u32; 3]> =
            self.triangles.iter().enumerate().filter(|(t, _)| keep(*t)).map(|(_, tri)| *tri).collect();
        for &v in kept.iter().flatten() {
            new_of[v as usize] = 0;
        }
        let mut old_of = Vec::new();
        for (old, new) in new_of.iter_mut().enumerate().filter(|(_, n)| **n == 0) {
            *new = old_of.len() as u32;
            old_of.push(old as u32);
        }
        let mesh = TriMesh {
            positions_mm: old_of.iter().map(|&v| self.positions_mm[v as usize]).collect(),
            triangles: kept.iter().map(|t| t.map(|v| new_of[v as usize])).collect(),
            uv: self.uv.as_ref().map(|uv| old_of.iter().map(|&v| uv[v as usize]).collect()),
        };
        (mesh, old_of)
    }
}

/// Shape of a triangle: 4 sqrt(3) area / sum of squared edges; 1 equilateral, 0 degenerate.
pub(crate) fn quality([a, b, c]: [Vec3; 3]) -> f32 {
    let squares = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
    2.0 * 3f32.sqrt() * (b - a).cross(c - a).length() / squares.max(f32::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> TriMesh {
        TriMesh {
            positions_mm: vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            uv: Some(vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        }
    }

    #[test]
    fn area_normals_and_bounds_of_a_square() {
        let m = square();
        m.validate().unwrap();
        assert!((m.area_mm2() - 1.0).abs() < 1e-12);
        assert!(m.vertex_normals().iter().all(|n| (*n - Vec3::Z).length() < 1e-6));
        assert_eq!(m.bounds_mm(), (Vec3::ZERO, Vec3::new(1.0, 1.0, 0.0)));
    }

    #[test]
    fn submesh_drops_unused_vertices_and_keeps_order() {
        let (m, old) = square().submesh(|t| t == 1);
        assert_eq!(old, vec![0, 2, 3]);
        assert_eq!(m.triangles, vec![[0, 1, 2]]);
        assert_eq!(m.uv.unwrap()[1], [1.0, 1.0]);
    }

    #[test]
    fn validate_names_the_element() {
        let mut m = square();
        m.positions_mm[2].y = f32::NAN;
        assert!(m.validate().unwrap_err().to_string().contains("vertex 3"));
        let mut m = square();
        m.triangles[1][2] = 9;
        assert!(m.validate().unwrap_err().to_string().contains("triangle 2"));
        let mut m = square();
        m.triangles[0] = [1, 1, 2];
        assert!(m.validate().is_err());
    }
}
