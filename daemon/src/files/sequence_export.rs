//! The scans of a session written as files: each its own, or as clips that move.

use super::error::Result;
use super::gltf::GltfClip;
use super::scan_export::{ExportFormat, ExportWriter, check_mesh, write_whole};
use gv3_codec::Scan;
use std::path::Path;

/// Writes scans in time order. In glTF, scans in a row that share a connectivity, as those of a shot's tracked mesh do,
/// become one file, named by the first of them; other formats have a file for each.
#[derive(Debug)]
pub struct SequenceWriter {
    writer: ExportWriter,
    clip: Option<GltfClip>,
    files: u64,
    bytes: u64,
}

impl SequenceWriter {
    /// Takes a folder as [`ExportWriter::create`] does.
    ///
    /// # Errors
    /// As there.
    pub fn create(folder: &Path, format: ExportFormat, overwrite: bool) -> Result<Self> {
        Ok(Self { writer: ExportWriter::create(folder, format, overwrite)?, clip: None, files: 0, bytes: 0 })
    }

    /// Meshes written so far.
    pub fn files(&self) -> u64 {
        self.files
    }

    /// Bytes written so far, pictures too.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Writes a scan, or keeps it for the clip that it belongs to.
    ///
    /// # Errors
    /// [`FileError`](super::FileError): the mesh is not valid, a clip would be too long, or a file cannot be written.
    pub fn write(&mut self, number: u64, scan: &Scan) -> Result<()> {
        if self.writer.format() != ExportFormat::Gltf {
            self.bytes += self.writer.write(number, &scan.mesh, scan.texture.as_ref())?;
            self.files += 1;
            return Ok(());
        }
        let path = self.writer.path(number);
        check_mesh(&scan.mesh, &path)?;
        match &mut self.clip {
            Some(clip) if clip.takes(&scan.mesh, scan.time_nanos) => {
                clip.add(number, scan.time_nanos, &scan.mesh, &self.writer.path(clip.number()))
            }
            _ => {
                self.finish()?;
                self.clip = Some(GltfClip::new(number, scan.time_nanos, &scan.mesh, scan.texture.as_ref()));
                Ok(())
            }
        }
    }

    /// Writes what is kept. Without it the last clip is lost.
    ///
    /// # Errors
    /// [`FileError`](super::FileError) when its file cannot be written.
    pub fn finish(&mut self) -> Result<()> {
        let Some(clip) = self.clip.take() else { return Ok(()) };
        let path = self.writer.path(clip.number());
        self.bytes += write_whole(&path, &clip.bytes(&path)?)?;
        self.files += 1;
        Ok(())
    }
}
