//! Scans that a decoded output is measured against.

use crate::files::obj::{Material, obj_byte_count};
use crate::files::picture::bmp_byte_count;
use crate::files::{FileError, ScanFolder, ScanSpool};
use gv3_codec::Scan;

/// Scans that came in.
pub trait Reference: Send {
    /// Number of scans.
    fn count(&self) -> usize;
    /// Tick of scan `i`.
    fn tick(&self, i: usize) -> u64;
    /// Loads scan `i`; what it takes on disk as OBJ and BMP, if its files say so.
    ///
    /// # Errors
    /// [`FileError`] of its files.
    fn load(&mut self, i: usize, period_nanos: u64) -> Result<(Scan, Option<u64>), FileError>;
}

impl Reference for ScanFolder {
    fn count(&self) -> usize {
        self.len()
    }
    fn tick(&self, i: usize) -> u64 {
        ScanFolder::tick(self, i)
    }
    fn load(&mut self, i: usize, period_nanos: u64) -> Result<(Scan, Option<u64>), FileError> {
        Ok((ScanFolder::load(self, i, period_nanos)?.scan, Some(self.scan_bytes(i))))
    }
}

impl Reference for ScanSpool {
    fn count(&self) -> usize {
        self.len()
    }
    fn tick(&self, i: usize) -> u64 {
        ScanSpool::tick(self, i)
    }
    fn load(&mut self, i: usize, _: u64) -> Result<(Scan, Option<u64>), FileError> {
        Ok((ScanSpool::load(self, i)?, None))
    }
}

/// What a scan takes as OBJ and BMP files.
pub fn obj_bmp_bytes(scan: &Scan) -> u64 {
    let material = scan.texture.as_ref().map(|_| Material { library: "frame_0000.mtl", picture: "frame_0000.bmp" });
    let picture = scan.texture.as_ref().map_or(0, |t| bmp_byte_count([t.width_px, t.height_px]));
    obj_byte_count(&scan.mesh, material) + picture
}

/// A scan as float32 vertices, u32 triangles and 8-bit texture.
pub fn binary_bytes(scan: &Scan) -> u64 {
    let texture = scan.texture.as_ref().map_or(0, |t| t.pixels.len());
    (12 * scan.mesh.vertex_count() + 12 * scan.mesh.triangles.len() + texture) as u64
}
