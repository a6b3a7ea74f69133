//! From a file's polygons with texture coordinates at their corners to a triangle mesh with one a vertex.

use super::error::{FileError, Result};
use glam::Vec3;
use gv3_codec::mesh::TriMesh;
use std::fmt;
use std::path::Path;

/// A mesh as read from a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeshFile {
    /// The mesh: vertex `i` of the file is vertex `i` here, unreferenced ones too.
    pub mesh: TriMesh,
    /// What had to be mended.
    pub repairs: Repairs,
    /// Where the file says its texture is: an OBJ its material library, a PLY its `TextureFile` picture.
    pub texture_reference: Option<String>,
}

/// What a reader mended, as counts; all zero for a clean file.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Repairs {
    /// Faces with fewer than three corners, left out.
    pub incomplete_faces: usize,
    /// Triangles that repeat a vertex, left out.
    pub degenerate_triangles: usize,
    /// Vertices at which faces name different texture coordinates; the first is kept.
    pub vertices_with_several_uv: usize,
    /// Vertices of a textured mesh whose faces name no texture coordinate; they get (0, 0).
    pub vertices_without_uv: usize,
}

impl Repairs {
    /// Whether nothing had to be mended.
    pub fn is_clean(&self) -> bool {
        *self == Self::default()
    }
}

impl fmt::Display for Repairs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parts = [
            (self.incomplete_faces, "faces with fewer than three corners left out"),
            (self.degenerate_triangles, "triangles that repeat a vertex left out"),
            (self.vertices_with_several_uv, "vertices with several texture coordinates, the first kept"),
            (self.vertices_without_uv, "vertices without a texture coordinate set to (0, 0)"),
        ];
        let mut separator = "";
        for (count, what) in parts.iter().filter(|(count, _)| *count > 0) {
            write!(f, "{separator}{count} {what}")?;
            separator = "; ";
        }
        if separator.is_empty() { f.write_str("no repairs") } else { Ok(()) }
    }
}

/// Collects triangles and texture coordinates corner by corner.
pub(super) struct Assembler {
    mesh: TriMesh,
    /// NaN until a face names one.
    uv: Vec<[f32; 2]>,
    is_used: Vec<bool>,
    has_several_uv: Vec<bool>,
    repairs: Repairs,
}

impl Assembler {
    pub(super) fn new(positions_mm: Vec<Vec3>, faces: usize, repairs: Repairs) -> Self {
        let n = positions_mm.len();
        let mesh = TriMesh { positions_mm, triangles: Vec::with_capacity(faces), uv: None };
        Self { mesh, uv: vec![[f32::NAN; 2]; n], is_used: vec![false; n], has_several_uv: vec![false; n], repairs }
    }

    /// Adds one polygon as a fan around its first corner. The indices must be in range.
    pub(super) fn polygon(&mut self, vertices: &[u32]) {
        if vertices.len() < 3 {
            self.repairs.incomplete_faces += 1;
            return;
        }
        for &v in vertices {
            self.is_used[v as usize] = true;
        }
        for pair in vertices[1..].windows(2) {
            let [a, b, c] = [vertices[0], pair[0], pair[1]];
            if a == b || b == c || c == a {
                self.repairs.degenerate_triangles += 1;
            } else {
                self.mesh.triangles.push([a, b, c]);
            }
        }
    }

    /// Notes the texture coordinate that a face names at `vertex`.
    pub(super) fn corner_uv(&mut self, vertex: u32, uv: [f32; 2]) {
        let v = vertex as usize;
        if self.uv[v][0].is_nan() {
            self.uv[v] = uv;
        } else if self.uv[v] != uv {
            self.has_several_uv[v] = true;
        }
    }

    /// Sets texture coordinates of vertices that no face uses, so that they survive a round trip.
    pub(super) fn unused_uv(&mut self, uv_of: impl Fn(usize) -> [f32; 2]) {
        for v in (0..self.uv.len()).filter(|&v| !self.is_used[v]) {
            self.uv[v] = uv_of(v);
        }
    }

    /// # Errors
    /// No triangle is left.
    pub(super) fn finish(mut self, texture_reference: Option<String>, path: &Path) -> Result<MeshFile> {
        if self.mesh.triangles.is_empty() {
            let (n, repairs) = (self.uv.len(), self.repairs);
            let reason = format!("no triangles, {n} vertices ({repairs}); export the scan as a mesh, not as points");
            return Err(FileError::content(path, reason));
        }
        let is_textured = (0..self.uv.len()).any(|v| self.is_used[v] && !self.uv[v][0].is_nan());
        if is_textured {
            self.repairs.vertices_with_several_uv = self.has_several_uv.iter().filter(|&&s| s).count();
            for (uv, is_used) in self.uv.iter_mut().zip(&self.is_used).filter(|(uv, _)| uv[0].is_nan()) {
                self.repairs.vertices_without_uv += usize::from(*is_used);
                *uv = [0.0; 2];
            }
            self.mesh.uv = Some(self.uv);
        }
        Ok(MeshFile { mesh: self.mesh, repairs: self.repairs, texture_reference })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fans_drop_degenerate_triangles_and_count() {
        let mut a = Assembler::new(vec![Vec3::ZERO; 5], 0, Repairs::default());
        a.polygon(&[0, 1, 2, 3]);
        a.polygon(&[0, 1, 1, 2]);
        a.polygon(&[4, 4]);
        let file = a.finish(None, Path::new("a.obj")).unwrap();
        assert_eq!(file.mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
        assert_eq!((file.repairs.degenerate_triangles, file.repairs.incomplete_faces), (1, 1));
        assert_eq!(file.mesh.uv, None);
        assert_eq!(
            file.repairs.to_string(),
            "1 faces with fewer than three corners left out; 1 triangles that repeat a vertex left out"
        );
        assert!(!file.repairs.is_clean());
        assert_eq!(Repairs::default().to_string(), "no repairs");
    }

    #[test]
    fn a_mesh_without_triangles_is_refused() {
        let error = Assembler::new(vec![Vec3::ZERO; 5], 0, Repairs::default()).finish(None, Path::new("a.obj"));
        assert!(error.unwrap_err().to_string().starts_with("a.obj: no triangles, 5 vertices (no repairs); export"));
    }

    #[test]
    fn first_uv_wins_and_missing_ones_are_counted() {
        let mut a = Assembler::new(vec![Vec3::ZERO; 4], 0, Repairs::default());
        a.polygon(&[0, 1, 2]);
        a.corner_uv(0, [0.1, 0.2]);
        a.corner_uv(1, [0.3, 0.4]);
        a.corner_uv(0, [0.5, 0.6]);
        a.corner_uv(0, [0.7, 0.8]);
        a.unused_uv(|v| [v as f32, 1.0]);
        let file = a.finish(None, Path::new("a.obj")).unwrap();
        assert_eq!(file.mesh.uv.unwrap(), [[0.1, 0.2], [0.3, 0.4], [0.0, 0.0], [3.0, 1.0]]);
        assert_eq!((file.repairs.vertices_with_several_uv, file.repairs.vertices_without_uv), (1, 1));
    }
}
