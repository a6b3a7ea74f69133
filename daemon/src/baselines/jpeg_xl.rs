//! Depth pictures in lossless JPEG XL (the commands cjxl and djxl), every scan by itself.

use super::depth::{DepthGrid, SIDE_BYTES};
use super::{code_each, missing_command, run};
use crate::measure::MeasureError;
use crate::sweep::{Coded, Coder, SweepInput};
use gv3_codec::Scan;
use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

const NAME: &str = "jpeg-xl";
const STEPS_MM: [f32; 3] = [0.05, 0.1, 0.2];
const EFFORT: &str = "7";
const ADVICE: &str = "install libjxl's tools, such as the package libjxl-tools";

/// Depth rounded to a step; zero where there is no surface, so that the mask is in the picture.
pub(super) struct JpegXl;

impl Coder for JpegXl {
    fn name(&self) -> &'static str {
        NAME
    }
    fn about(&self) -> String {
        format!("depth pictures rounded to a step, lossless JPEG XL (cjxl, effort {EFFORT}), every scan by itself")
    }
    fn settings(&self) -> Vec<String> {
        STEPS_MM.map(|step| format!("{step} mm")).to_vec()
    }
    fn unavailable(&self, input: &SweepInput) -> Option<String> {
        let tools =
            missing_command("cjxl", "--version", ADVICE).or_else(|| missing_command("djxl", "--version", ADVICE));
        tools.or_else(|| DepthGrid::fit(input).err())
    }
    fn code(&self, setting: usize, input: &SweepInput) -> Result<Coded, MeasureError> {
        let fail = |reason: String| MeasureError::Coder { coder: NAME, reason };
        let grid = DepthGrid::fit(input).map_err(fail)?;
        let step_mm = STEPS_MM[setting];
        let low_mm = input.scans.iter().map(|s| s.mesh.bounds_mm().0.z).fold(f32::INFINITY, f32::min);
        let folder = TempDir::new().map_err(|e| fail(format!("no temporary folder: {e}")))?;
        let of_encoder = grid.clone();
        let encode = |scan: &Scan| {
            let levels =
                of_encoder.depths_mm(scan)?.into_iter().map(|z| level(z, low_mm, step_mm)).collect::<Vec<u16>>();
            let path = folder.path().join(format!("{}.pgm", scan.tick));
            std::fs::write(&path, pgm(&levels, of_encoder.width)).map_err(|e| e.to_string())?;
            let coded = path.with_extension("jxl");
            run(Command::new("cjxl").arg(&path).arg(&coded).args(["-d", "0", "-e", EFFORT, "--num_threads=0"]))?;
            let mut bytes = bytemuck::bytes_of(&of_encoder.rest_px(scan)).to_vec();
            bytes.extend(std::fs::read(&coded).map_err(|e| e.to_string())?);
            Ok(bytes)
        };
        // The decoder's folder lives as long as the decoder.
        let place = TempDir::new().map_err(|e| fail(format!("no temporary folder: {e}")))?;
        let decode = Box::new(move |bytes: &[u8]| {
            let (rest, bytes) = bytes.split_at_checked(8).ok_or("too short")?;
            let levels = decode_levels(bytes, place.path(), grid.width * grid.height)?;
            let depth = |&q: &u16| if q == 0 { f32::NAN } else { low_mm + f32::from(q - 1) * step_mm };
            Ok(grid.mesh(&levels.iter().map(depth).collect::<Vec<f32>>(), step_mm, bytemuck::pod_read_unaligned(rest)))
        });
        let coded = code_each(NAME, input, encode, decode)?;
        Ok(Coded { bytes: coded.bytes + SIDE_BYTES + 8, ..coded })
    }
}

fn level(z: f32, low_mm: f32, step_mm: f32) -> u16 {
    if z.is_finite() { 1 + ((z - low_mm) / step_mm).round() as u16 } else { 0 }
}

/// A picture of 16 bits as cjxl reads it.
fn pgm(levels: &[u16], width: usize) -> Vec<u8> {
    let mut bytes = format!("P5\n{width} {}\n65535\n", levels.len() / width).into_bytes();
    bytes.extend(levels.iter().flat_map(|q| q.to_be_bytes()));
    bytes
}

fn decode_levels(bytes: &[u8], folder: &Path, pixels: usize) -> Result<Vec<u16>, String> {
    let (coded, plain) = (folder.join("a.jxl"), folder.join("a.pgm"));
    std::fs::write(&coded, bytes).map_err(|e| e.to_string())?;
    run(Command::new("djxl").arg(&coded).arg(&plain).arg("--num_threads=0"))?;
    let picture = std::fs::read(&plain).map_err(|e| e.to_string())?;
    // The levels are what follows the head, whatever its spaces.
    let at = picture.len().checked_sub(2 * pixels).ok_or("djxl gave a smaller picture")?;
    Ok(picture[at..].chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sweep::test_scans::rising;
    use gv3_codec::metrics::compare;

    #[test]
    fn depths_come_back_to_half_a_step() {
        let input = rising(48, 3);
        if let Some(reason) = JpegXl.unavailable(&input) {
            println!("skipped: {reason}");
            return;
        }
        let Coded { bytes, mut decoded, .. } = JpegXl.code(1, &input).unwrap();
        assert!(bytes > 3 * 100 && bytes < 3 * 48 * 48 * 2);
        for (scan, stamp) in input.scans.iter().zip(input.stamps()) {
            let back = decoded.scan(&stamp).unwrap();
            assert!(back.mesh.triangles == scan.mesh.triangles, "the mask and the steps are kept");
            let off = back.mesh.positions_mm.iter().zip(&scan.mesh.positions_mm).map(|(a, b)| (a.z - b.z).abs());
            assert!(off.fold(0.0, f32::max) <= 0.5001 * STEPS_MM[1]);
            assert!(compare(scan, &back).distortion.scan_to_replay.summary().rms > 0.01);
        }
    }
}
