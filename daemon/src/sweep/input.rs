//! Scans to code, held in memory so that every coder is given the same.

use crate::files::{FileError, ScanFolder};
use crate::measure::{Reference, binary_bytes};
use crate::replay::ReplayStamp;
use gv3_codec::Scan;

/// The scans of a sweep.
pub struct SweepInput {
    /// At least one, in time order.
    pub scans: Vec<Scan>,
    /// Nanoseconds of one tick.
    pub period_nanos: u64,
    /// Size as OBJ and BMP.
    pub obj_bmp_bytes: u64,
    /// Size as float32, u32 and 8-bit texture.
    pub binary_bytes: u64,
}

impl SweepInput {
    /// Loads the first `count` scans of a folder, about 6 MB a scan of 120,000 vertices.
    ///
    /// # Errors
    /// [`FileError`] of its files.
    pub fn load(
        folder: &ScanFolder,
        count: usize,
        period_nanos: u64,
        mut step: impl FnMut(),
    ) -> Result<Self, FileError> {
        let count = count.min(folder.len());
        let mut scans = Vec::with_capacity(count);
        for i in 0..count {
            scans.push(folder.load(i, period_nanos)?.scan);
            step();
        }
        let obj_bmp_bytes = (0..count).map(|i| folder.scan_bytes(i)).sum();
        let binary_bytes = scans.iter().map(binary_bytes).sum();
        Ok(Self { scans, period_nanos, obj_bmp_bytes, binary_bytes })
    }

    /// Stamps of the scans; every tenth is called a keyframe, which those of other coders may not be.
    pub fn stamps(&self) -> Vec<ReplayStamp> {
        let stamp =
            |s: &Scan| ReplayStamp { tick: s.tick, time_nanos: s.time_nanos, is_key: s.tick.is_multiple_of(10) };
        self.scans.iter().map(stamp).collect()
    }

    /// The scans as what is measured against.
    pub fn reference(&self) -> impl Reference + '_ {
        InMemory(&self.scans)
    }
}

struct InMemory<'a>(&'a [Scan]);

impl Reference for InMemory<'_> {
    fn count(&self) -> usize {
        self.0.len()
    }
    fn tick(&self, i: usize) -> u64 {
        self.0[i].tick
    }
    fn load(&mut self, i: usize, _: u64) -> Result<(Scan, Option<u64>), FileError> {
        // The size of the files is known, and is not to be found by writing them again.
        Ok((self.0[i].clone(), Some(0)))
    }
}
