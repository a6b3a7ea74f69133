//! Rate against distortion: the same scans coded in several ways at several qualities, all judged by the same metrics.

pub mod bd_rate;
mod html;
mod input;
mod own_modes;
mod report;
#[cfg(test)]
pub(crate) mod test_scans;

pub use html::{ErrorMapFile, Page, html};
pub use input::SweepInput;
pub use own_modes::ModeCoder;
pub use report::{BdRate, Curve, Point, SweepReport, bd_rates, csv};

use crate::measure::{Decoded, MeasureError, measure};
use crate::view::error_map::ErrorMap;
use gv3_codec::Scan;
use image::RgbImage;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// A way to code a sequence of scans, at several qualities.
pub trait Coder {
    /// Name in reports and on the command line.
    fn name(&self) -> &'static str;
    /// What it does, in one line.
    fn about(&self) -> String;
    /// Its qualities, from the best to the coarsest.
    fn settings(&self) -> Vec<String>;
    /// Why it cannot code this input here, and what to do: a tool is missing, the scans do not suit it.
    fn unavailable(&self, _input: &SweepInput) -> Option<String> {
        None
    }
    /// Codes all scans at a quality, an index into [`Self::settings`].
    ///
    /// # Errors
    /// [`MeasureError`] naming the coder and what it said.
    fn code(&self, setting: usize, input: &SweepInput) -> Result<Coded, MeasureError>;
}

/// What a coder made.
pub struct Coded {
    /// All bytes needed to decode the surfaces of all scans, textures left out.
    pub bytes: u64,
    /// Time of coding.
    pub encode_time: Duration,
    /// Its decoder.
    pub decoded: Box<dyn Decoded>,
}

/// Codes the input at one quality, judges every scan, and draws where the errors are.
///
/// # Errors
/// [`MeasureError`] of the coder.
pub fn run_point(
    coder: &dyn Coder,
    setting: usize,
    input: &SweepInput,
    step: impl FnMut(),
) -> Result<(Point, RgbImage), MeasureError> {
    let Coded { bytes, encode_time, mut decoded } = coder.code(setting, input)?;
    let map = Mutex::new(ErrorMap::new(&input.scans[0].mesh));
    let gather = |scan: &Scan, _: &Scan, error_mm: &[f32]| {
        map.lock().unwrap_or_else(PoisonError::into_inner).add(&scan.mesh, error_mm);
        Ok(())
    };
    let (measurement, _) = measure(decoded.as_mut(), &mut input.reference(), gather, step)?;
    let label = coder.settings().swap_remove(setting);
    let point = Point::new(label, bytes, encode_time, &measurement);
    let caption = format!(
        "{} {}: {:.0} bytes a scan, rms {:.3} mm",
        coder.name(),
        point.setting,
        point.bytes_per_scan,
        point.rms_mm
    );
    let picture = map.into_inner().unwrap_or_else(PoisonError::into_inner).draw(&caption);
    Ok((point, picture))
}
