//! Scans without noise: distance of scan and replay from them, and drift of points that can be followed.

use super::{Decoded, DriftReport, MeasureError, TruthReport};
use crate::files::ScanFolder;
use gv3_codec::Scan;
use gv3_codec::metrics::{Drift, TruthComparison};
use std::collections::BTreeMap;
use std::path::Path;

/// A folder of true scans with the numbers of the scans that came in.
pub struct TruthScans {
    folder: ScanFolder,
    /// Index by tick of the input.
    by_tick: BTreeMap<u64, usize>,
}

impl TruthScans {
    /// Opens the true scans of `input`.
    ///
    /// # Errors
    /// [`MeasureError`] of its files, or when none has the number of an input scan.
    pub fn open(path: &Path, input: &ScanFolder) -> Result<Self, MeasureError> {
        let folder = ScanFolder::open(path)?;
        let ticks: BTreeMap<u64, u64> = (0..input.len()).map(|i| (input.number(i), input.tick(i))).collect();
        let by_tick: BTreeMap<u64, usize> =
            (0..folder.len()).filter_map(|i| Some((*ticks.get(&folder.number(i))?, i))).collect();
        if by_tick.is_empty() {
            let reason = format!(
                "{}: no scan has the number of one in {}; give the true scans under the same names",
                path.display(),
                input.path().display()
            );
            return Err(MeasureError::Mismatch(reason));
        }
        Ok(Self { folder, by_tick })
    }

    /// The true scan of a tick, if there is one.
    ///
    /// # Errors
    /// [`MeasureError`] of its files.
    pub fn load(&self, tick: u64) -> Result<Option<Scan>, MeasureError> {
        let Some(&i) = self.by_tick.get(&tick) else { return Ok(None) };
        // The time is not asked for.
        Ok(Some(self.folder.load(i, 0)?.scan))
    }

    /// Scan and replay of a tick against the truth; none where there is no truth.
    ///
    /// # Errors
    /// [`MeasureError`] of its files.
    pub fn compare(&self, scan: &Scan, replay: &Scan) -> Result<Option<TruthComparison>, MeasureError> {
        let truth = self.load(scan.tick)?;
        Ok(truth.map(|t| TruthComparison::new(&t.mesh, &scan.mesh, &replay.mesh)))
    }

    /// Adds up comparisons of scans.
    pub fn total(comparisons: impl IntoIterator<Item = Option<TruthComparison>>) -> TruthReport {
        let (mut scans, mut total) = (0, TruthComparison::default());
        for comparison in comparisons.into_iter().flatten() {
            scans += 1;
            total.merge(&comparison);
        }
        TruthReport::new(scans, &total)
    }
}

/// Follows the vertices of true scans, which all have the same triangles, through what was decoded.
///
/// # Errors
/// [`MeasureError`] when a scan cannot be read, or when the truth changes its triangles.
pub fn measure_drift(
    decoded: &mut dyn Decoded,
    truth: &TruthScans,
    mut step: impl FnMut(),
) -> Result<DriftReport, MeasureError> {
    let (mut drift, mut scans, mut first) = (Drift::default(), 0, None);
    for stamp in decoded.stamps().to_vec() {
        step();
        let Some(true_scan) = truth.load(stamp.tick)? else { continue };
        let triangles = first.get_or_insert_with(|| true_scan.mesh.triangles.clone());
        if *triangles != true_scan.mesh.triangles {
            return Err(MeasureError::Mismatch(format!(
                "{}: the scan of tick {} has other triangles than the first; points can be followed through scans of one \
                 connectivity only",
                truth.folder.path().display(),
                stamp.tick
            )));
        }
        drift.add(&true_scan.mesh, &decoded.scan(&stamp)?.mesh);
        scans += 1;
    }
    Ok(DriftReport::new(scans, &drift))
}
