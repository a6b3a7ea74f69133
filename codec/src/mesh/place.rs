//! A point of a triangle mesh, by triangle and weights.

use super::TriMesh;
use glam::Vec3;

/// A place on a mesh: triangle and barycentric coordinates (>= 0, summing to 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Triangle index.
    pub triangle: u32,
    /// Weights of its corners.
    pub barycentric: [f32; 3],
}

impl Place {
    /// Value interpolated from the corners.
    pub fn interpolate<T>(&self, triangles: &[[u32; 3]], values: &[T]) -> T
    where
        T: Copy + std::ops::Mul<f32, Output = T> + std::ops::Add<Output = T>,
    {
        let [a, b, c] = triangles[self.triangle as usize].map(|v| values[v as usize]);
        a * self.barycentric[0] + b * self.barycentric[1] + c * self.barycentric[2]
    }

    /// Position on `mesh`, mm.
    pub fn position_mm(&self, mesh: &TriMesh) -> Vec3 {
        self.interpolate(&mesh.triangles, &mesh.positions_mm)
    }
}
