//! A temporary store for scans on disk, lossless, so that a long run need not stay in memory until it is measured.

use super::error::{FileError, Result};
use gv3_codec::mesh::TriMesh;
use gv3_codec::{GreyPicture, Scan};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Fast: the spool lives seconds.
const ZSTD_LEVEL: i32 = 1;

/// Where a scan lies in the spool.
#[derive(Debug, Clone, Copy)]
struct Entry {
    tick: u64,
    time_nanos: u64,
    offset: u64,
    coded_bytes: usize,
    plain_bytes: usize,
    vertices: usize,
    triangles: usize,
    has_uv: bool,
    texture_px: Option<[u32; 2]>,
}

/// Scans on disk in the order they were added; the file goes with the value.
#[derive(Debug)]
pub struct ScanSpool {
    folder: PathBuf,
    file: File,
    end: u64,
    entries: Vec<Entry>,
}

impl ScanSpool {
    /// An empty spool in a nameless file of `folder`.
    ///
    /// # Errors
    /// [`FileError::Io`] when the folder cannot be written.
    pub fn create(folder: &Path) -> Result<Self> {
        let file = tempfile::tempfile_in(folder).map_err(FileError::io(folder, "create a temporary file in"))?;
        Ok(Self { folder: folder.into(), file, end: 0, entries: Vec::new() })
    }

    /// Number of scans.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Tick of scan `i`.
    ///
    /// # Panics
    /// When `i >= len()`.
    pub fn tick(&self, i: usize) -> u64 {
        self.entries[i].tick
    }

    /// Adds a scan.
    ///
    /// # Errors
    /// [`FileError::Io`] when the disk is full.
    pub fn push(&mut self, scan: &Scan) -> Result<()> {
        let plain = plain_bytes(scan);
        let coded = zstd::bulk::compress(&plain, ZSTD_LEVEL).map_err(FileError::io(&self.folder, "compress for"))?;
        self.file.write_all(&coded).map_err(FileError::io(&self.folder, "write a temporary file in"))?;
        self.entries.push(Entry {
            tick: scan.tick,
            time_nanos: scan.time_nanos,
            offset: self.end,
            coded_bytes: coded.len(),
            plain_bytes: plain.len(),
            vertices: scan.mesh.vertex_count(),
            triangles: scan.mesh.triangles.len(),
            has_uv: scan.mesh.uv.is_some(),
            texture_px: scan.texture.as_ref().map(|t| [t.width_px, t.height_px]),
        });
        self.end += coded.len() as u64;
        Ok(())
    }

    /// Reads scan `i` back, bit for bit.
    ///
    /// # Errors
    /// [`FileError::Io`] when the disk fails.
    ///
    /// # Panics
    /// When `i >= len()`.
    pub fn load(&mut self, i: usize) -> Result<Scan> {
        let entry = self.entries[i];
        let mut coded = vec![0; entry.coded_bytes];
        let plain = (self.file.seek(SeekFrom::Start(entry.offset)))
            .and_then(|_| self.file.read_exact(&mut coded))
            .and_then(|()| self.file.seek(SeekFrom::Start(self.end)))
            .and_then(|_| zstd::bulk::decompress(&coded, entry.plain_bytes))
            .map_err(FileError::io(&self.folder, "read a temporary file in"))?;
        Ok(entry.scan(&plain))
    }
}

/// Positions, triangles as differences to the triangle before, texture coordinates, texture.
fn plain_bytes(scan: &Scan) -> Vec<u8> {
    let mut out = bytemuck::cast_slice(&scan.mesh.positions_mm).to_vec();
    let mut before = [0u32; 3];
    for t in &scan.mesh.triangles {
        for k in 0..3 {
            out.extend_from_slice(&t[k].wrapping_sub(before[k]).to_le_bytes());
        }
        before = *t;
    }
    if let Some(uv) = &scan.mesh.uv {
        out.extend_from_slice(bytemuck::cast_slice(uv));
    }
    if let Some(texture) = &scan.texture {
        out.extend_from_slice(&texture.pixels);
    }
    out
}

impl Entry {
    fn scan(&self, plain: &[u8]) -> Scan {
        let (positions, rest) = plain.split_at(12 * self.vertices);
        let (triangles, rest) = rest.split_at(12 * self.triangles);
        let (uv, pixels) = rest.split_at(if self.has_uv { 8 * self.vertices } else { 0 });
        let mut last = [0u32; 3];
        let triangles = (bytemuck::pod_collect_to_vec::<u8, [u32; 3]>(triangles).iter())
            .map(|step| {
                last = std::array::from_fn(|k| last[k].wrapping_add(step[k]));
                last
            })
            .collect();
        let mesh = TriMesh {
            positions_mm: bytemuck::pod_collect_to_vec(positions),
            triangles,
            uv: self.has_uv.then(|| bytemuck::pod_collect_to_vec(uv)),
        };
        let texture = self.texture_px.map(|[w, h]| GreyPicture::new(w, h, pixels.to_vec()));
        Scan { tick: self.tick, time_nanos: self.time_nanos, mesh, texture }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn scans_come_back_bit_for_bit_in_any_order() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = ScanSpool::create(folder.path()).unwrap();
        let scan = |k: u32| Scan {
            tick: u64::from(k) * 3,
            time_nanos: 7 + u64::from(k),
            mesh: TriMesh {
                positions_mm: (0..4 + k).map(|i| Vec3::new(i as f32 * 0.1, k as f32, -0.0)).collect(),
                triangles: vec![[0, 1, 2], [2, 1, 3 + k]],
                uv: k.is_multiple_of(2).then(|| vec![[0.25, 0.5]; 4 + k as usize]),
            },
            texture: (k > 0).then(|| GreyPicture::filled(3, 2, k as u8)),
        };
        for k in 0..3 {
            spool.push(&scan(k)).unwrap();
        }
        assert_eq!((spool.len(), spool.tick(2)), (3, 6));
        for k in [2, 0, 1] {
            let (back, want) = (spool.load(k as usize).unwrap(), scan(k));
            assert_eq!((back.tick, back.time_nanos, &back.mesh), (want.tick, want.time_nanos, &want.mesh));
            assert_eq!(back.texture, want.texture);
        }
        spool.push(&scan(3)).unwrap();
        assert_eq!(spool.load(3).unwrap().mesh, scan(3).mesh);
    }
}
