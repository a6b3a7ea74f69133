//! Scans written as numbered files that other programs open.

use super::error::{FileError, Result};
use super::gltf::GltfClip;
use super::obj::{Material, obj_bytes};
use super::picture::{PictureFormat, picture_bytes};
use super::ply::ply_bytes;
use gv3_codec::{GreyPicture, mesh::TriMesh};
use std::path::{Path, PathBuf};

/// Which files a scan becomes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportFormat {
    /// `frame_0001.obj`, `.bmp` and the `.mtl` that joins them.
    Obj,
    /// `frame_0001.ply` and its picture.
    Ply {
        /// Format of the picture.
        picture: PictureFormat,
    },
    /// `frame_0001.glb`, with its picture within.
    Gltf,
}

/// Writes numbered scans into a folder, each file whole or not at all.
#[derive(Debug)]
pub struct ExportWriter {
    folder: PathBuf,
    format: ExportFormat,
}

impl ExportWriter {
    /// Takes a folder for writing and creates it if need be. With `overwrite` the folder may hold files; those of the
    /// same names are replaced, others stay.
    ///
    /// # Errors
    /// [`FileError`]: cannot be created or read, or holds files though `overwrite` is not set.
    pub fn create(folder: &Path, format: ExportFormat, overwrite: bool) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(FileError::io(folder, "create the folder"))?;
        let mut entries = std::fs::read_dir(folder).map_err(FileError::io(folder, "open the folder"))?;
        if !overwrite && entries.next().is_some() {
            let reason = "the folder is not empty; give another one, or write into it (--force)";
            return Err(FileError::content(folder, reason));
        }
        Ok(Self { folder: folder.into(), format })
    }

    /// Which files it writes.
    pub(super) fn format(&self) -> ExportFormat {
        self.format
    }

    /// Where the mesh of a scan is written.
    pub(super) fn path(&self, number: u64) -> PathBuf {
        let extension = match self.format {
            ExportFormat::Obj => "obj",
            ExportFormat::Ply { .. } => "ply",
            ExportFormat::Gltf => "glb",
        };
        self.folder.join(format!("frame_{number:04}.{extension}"))
    }

    /// Writes one scan as `frame_NUMBER`; returns the bytes written.
    ///
    /// # Errors
    /// [`FileError`]: the mesh is not valid, or a file cannot be written.
    pub fn write(&self, number: u64, mesh: &TriMesh, texture: Option<&GreyPicture>) -> Result<u64> {
        let path = self.path(number);
        check_mesh(mesh, &path)?;
        match self.format {
            ExportFormat::Obj => write_obj(&path, mesh, texture),
            ExportFormat::Ply { picture } => write_ply(&path, mesh, texture, picture),
            ExportFormat::Gltf => write_whole(&path, &GltfClip::new(number, 0, mesh, texture).bytes(&path)?),
        }
    }
}

/// Refuses a mesh that is not valid, in the name of the file that it would be.
pub(super) fn check_mesh(mesh: &TriMesh, path: &Path) -> Result<()> {
    mesh.validate().map_err(|e| FileError::content(path, format!("not written: {e}")))
}

fn write_obj(path: &Path, mesh: &TriMesh, texture: Option<&GreyPicture>) -> Result<u64> {
    let (written, picture) = write_picture(path, texture, PictureFormat::Bmp)?;
    let library_path = path.with_extension("mtl");
    let library = file_name(&library_path);
    let material = picture.as_deref().map(|picture| Material { library: &library, picture });
    let library_bytes = match &material {
        Some(material) => write_whole(&library_path, material.library_text().as_bytes())?,
        None => 0,
    };
    // The mesh comes last: who sees it finds what it refers to.
    Ok(written + library_bytes + write_whole(path, &obj_bytes(mesh, material))?)
}

fn write_ply(path: &Path, mesh: &TriMesh, texture: Option<&GreyPicture>, format: PictureFormat) -> Result<u64> {
    let (written, picture) = write_picture(path, texture, format)?;
    Ok(written + write_whole(path, &ply_bytes(mesh, picture.as_deref()))?)
}

/// Writes the picture beside a mesh; returns the bytes and its name.
fn write_picture(mesh: &Path, texture: Option<&GreyPicture>, format: PictureFormat) -> Result<(u64, Option<String>)> {
    let Some(texture) = texture else { return Ok((0, None)) };
    let path = mesh.with_extension(format.extension());
    let written = write_whole(&path, &picture_bytes(texture, format, &path)?)?;
    Ok((written, Some(file_name(&path))))
}

fn file_name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Writes beside the file, then renames, so that no reader meets half a file.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<u64> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = PathBuf::from(part);
    let written = std::fs::write(&part, bytes).and_then(|()| std::fs::rename(&part, path));
    written.map_err(|error| {
        // The half-written file is of no use; that it may not exist is no second error.
        let _ = std::fs::remove_file(&part);
        FileError::io(path, "write")(error)
    })?;
    Ok(bytes.len() as u64)
}

#[cfg(test)]
mod tests {
    use super::super::ScanFolder;
    use super::*;
    use glam::Vec3;

    fn triangle() -> TriMesh {
        TriMesh {
            positions_mm: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2]],
            uv: Some(vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
        }
    }

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn what_is_exported_opens_as_scans() {
        let picture = GreyPicture::new(2, 2, vec![1, 2, 3, 4]);
        for format in [ExportFormat::Obj, ExportFormat::Ply { picture: PictureFormat::Png }] {
            let parent = tempfile::tempdir().unwrap();
            let folder = parent.path().join("new/folder");
            let writer = ExportWriter::create(&folder, format, false).unwrap();
            let written: u64 = [7, 9].map(|n| writer.write(n, &triangle(), Some(&picture)).unwrap()).iter().sum();
            let on_disk: u64 = names(&folder).iter().map(|n| folder.join(n).metadata().unwrap().len()).sum();
            assert_eq!(written, on_disk);
            let scans = ScanFolder::open(&folder).unwrap();
            assert_eq!((scans.len(), scans.tick(1)), (2, 2));
            let scan = scans.load(1, 1).unwrap().scan;
            assert_eq!((scan.mesh, scan.texture.as_ref()), (triangle(), Some(&picture)));
        }
    }

    #[test]
    fn a_scan_without_picture_or_with_it_inside_is_one_file() {
        let folder = tempfile::tempdir().unwrap();
        let writer = ExportWriter::create(folder.path(), ExportFormat::Obj, false).unwrap();
        writer.write(12345, &triangle(), None).unwrap();
        assert_eq!(names(folder.path()), ["frame_12345.obj"]);
        let writer = ExportWriter::create(folder.path(), ExportFormat::Gltf, true).unwrap();
        writer.write(7, &triangle(), Some(&GreyPicture::filled(2, 2, 9))).unwrap();
        assert_eq!(names(folder.path()), ["frame_0007.glb", "frame_12345.obj"]);
    }

    #[test]
    fn a_folder_with_files_is_taken_only_when_allowed() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("frame_0001.obj"), "old").unwrap();
        let error = ExportWriter::create(folder.path(), ExportFormat::Obj, false).unwrap_err().to_string();
        assert!(error.ends_with("the folder is not empty; give another one, or write into it (--force)"), "{error}");
        let writer = ExportWriter::create(folder.path(), ExportFormat::Obj, true).unwrap();
        writer.write(1, &triangle(), None).unwrap();
        assert_eq!(names(folder.path()), ["frame_0001.obj"]);
        assert!(std::fs::read(folder.path().join("frame_0001.obj")).unwrap().starts_with(b"v 0.0000"));
    }

    #[test]
    fn what_cannot_be_written_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        let error = ExportWriter::create(&file.join("sub"), ExportFormat::Obj, false).unwrap_err().to_string();
        assert!(error.contains("file/sub: cannot create the folder: "), "{error}");
        let writer = ExportWriter::create(&folder.path().join("out"), ExportFormat::Obj, false).unwrap();
        let mut bad = triangle();
        bad.positions_mm[1].x = f32::NAN;
        let error = writer.write(1, &bad, None).unwrap_err().to_string();
        assert!(error.ends_with("frame_0001.obj: not written: mesh: vertex 2 is not finite"), "{error}");
        // A folder in the file's place fails the rename; the part must not stay behind.
        std::fs::create_dir(folder.path().join("out/frame_0002.obj")).unwrap();
        let error = writer.write(2, &triangle(), None).unwrap_err().to_string();
        assert!(error.contains("frame_0002.obj: cannot write: "), "{error}");
        assert_eq!(names(&folder.path().join("out")), ["frame_0002.obj"]);
    }
}
