//! Depth as 12-bit HEVC video (x265 through the command ffmpeg): the background filled by push-pull, the mask coded
//! losslessly apart.

use super::depth::{DepthGrid, SIDE_BYTES, push_pull};
use super::{mask, missing_command, run, scan_of};
use crate::measure::{Decoded, MeasureError};
use crate::replay::ReplayStamp;
use crate::sweep::{Coded, Coder, SweepInput};
use gv3_codec::Scan;
use std::path::Path;
use std::process::Command;
use std::time::Instant;
use tempfile::TempDir;

const CRF: [u32; 5] = [0, 4, 10, 16, 22];
const MAX_LEVEL: f32 = 4095.0;
/// Pictures are made multiples of this wide and high.
const BLOCK: usize = 8;
/// One thread, and no advertisement in the stream.
const X265: &str = "log-level=none:pools=none:frame-threads=1:info=0";
const ADVICE: &str = "install ffmpeg with x265, such as the package ffmpeg";

/// 12-bit HEVC at one preset of x265.
pub(super) struct Hevc {
    name: &'static str,
    preset: &'static str,
}

/// Depth range of a session as 12 bits.
#[derive(Clone, Copy)]
struct Levels {
    low_mm: f32,
    step_mm: f32,
}

impl Hevc {
    pub(super) fn medium() -> Self {
        Self { name: "hevc-medium", preset: "medium" }
    }
    pub(super) fn ultrafast() -> Self {
        Self { name: "hevc-ultrafast", preset: "ultrafast" }
    }

    fn encode(&self, crf: u32, grid: &DepthGrid, levels: Levels, input: &SweepInput) -> Result<Video, String> {
        let folder = TempDir::new().map_err(|e| e.to_string())?;
        let (raw, coded) = (folder.path().join("in.raw"), folder.path().join("depth.hevc"));
        let size = [grid.width.next_multiple_of(BLOCK), grid.height.next_multiple_of(BLOCK)];
        let (mut pictures, mut masks) = (Vec::new(), Vec::new());
        for scan in &input.scans {
            let depths = grid.depths_mm(scan)?;
            masks.push(depths.iter().map(|z| z.is_finite()).collect::<Vec<bool>>());
            pictures.extend(picture(&depths, grid.width, size, levels));
        }
        std::fs::write(&raw, pictures).map_err(|e| e.to_string())?;
        let size_text = format!("{}x{}", size[0], size[1]);
        let input_format = ["-f", "rawvideo", "-pix_fmt", "gray12le", "-framerate", "30", "-video_size", &size_text];
        let mut ffmpeg = Command::new("ffmpeg");
        ffmpeg.args(["-v", "error", "-nostdin", "-y"]).args(input_format).arg("-i").arg(&raw);
        ffmpeg.args(["-c:v", "libx265", "-preset", self.preset, "-crf", &crf.to_string(), "-x265-params", X265]);
        run(ffmpeg.args(["-pix_fmt", "gray12le", "-f", "hevc"]).arg(&coded))?;
        let mask_bytes = mask::encode(&masks, grid.width);
        let video_bytes = std::fs::metadata(&coded).map_err(|e| e.to_string())?.len();
        Ok(Video {
            bytes: video_bytes + mask_bytes.len() as u64 + SIDE_BYTES + 8 + 8 * input.scans.len() as u64,
            rests_px: input.scans.iter().map(|scan| grid.rest_px(scan)).collect(),
            coder: self.name,
            stamps: input.stamps(),
            period_nanos: input.period_nanos,
            grid: grid.clone(),
            levels,
            size,
            mask_bytes,
            pictures: None,
            folder,
        })
    }
}

impl Coder for Hevc {
    fn name(&self) -> &'static str {
        self.name
    }
    fn about(&self) -> String {
        format!(
            "depth as 12-bit HEVC video (x265 {}, one thread), background filled by push-pull, mask coded apart and counted",
            self.preset
        )
    }
    fn settings(&self) -> Vec<String> {
        CRF.map(|crf| format!("crf {crf}")).to_vec()
    }
    fn unavailable(&self, input: &SweepInput) -> Option<String> {
        let missing = missing_command("ffmpeg", "-version", ADVICE);
        missing.or_else(|| DepthGrid::fit(input).err())
    }
    fn code(&self, setting: usize, input: &SweepInput) -> Result<Coded, MeasureError> {
        let fail = |reason: String| MeasureError::Coder { coder: self.name, reason };
        let grid = DepthGrid::fit(input).map_err(fail)?;
        let bounds = || input.scans.iter().map(|s| s.mesh.bounds_mm());
        let low_mm = bounds().map(|b| b.0.z).fold(f32::INFINITY, f32::min);
        let high_mm = bounds().map(|b| b.1.z).fold(f32::NEG_INFINITY, f32::max);
        let levels = Levels { low_mm, step_mm: ((high_mm - low_mm) / MAX_LEVEL).max(f32::MIN_POSITIVE) };
        let begin = Instant::now();
        let video = self.encode(CRF[setting], &grid, levels, input).map_err(fail)?;
        Ok(Coded { bytes: video.bytes, encode_time: begin.elapsed(), decoded: Box::new(video) })
    }
}

/// Levels of a picture as bytes, filled to `size`.
fn picture(depths_mm: &[f32], width: usize, [w, h]: [usize; 2], levels: Levels) -> Vec<u8> {
    let mut filled = vec![f32::NAN; w * h];
    for (row, depths) in filled.chunks_mut(w).zip(depths_mm.chunks(width)) {
        row[..width].copy_from_slice(depths);
    }
    push_pull(&mut filled, w, h);
    let level = |z: &f32| ((z - levels.low_mm) / levels.step_mm).round().clamp(0.0, MAX_LEVEL) as u16;
    filled.iter().flat_map(|z| level(z).to_le_bytes()).collect()
}

/// A coded session, its pictures decoded when the first is asked for.
struct Video {
    bytes: u64,
    coder: &'static str,
    stamps: Vec<ReplayStamp>,
    period_nanos: u64,
    grid: DepthGrid,
    levels: Levels,
    size: [usize; 2],
    mask_bytes: Vec<u8>,
    /// Of every scan.
    rests_px: Vec<[f32; 2]>,
    pictures: Option<Pictures>,
    folder: TempDir,
}

struct Pictures {
    raw: Vec<u8>,
    masks: Vec<Vec<bool>>,
}

impl Video {
    fn decode(&self) -> Result<Pictures, String> {
        let raw = self.folder.path().join("out.raw");
        decode_video(&self.folder.path().join("depth.hevc"), &raw)?;
        let raw = std::fs::read(&raw).map_err(|e| e.to_string())?;
        let wanted = self.stamps.len() * self.size[0] * self.size[1] * 2;
        if raw.len() != wanted {
            return Err(format!("ffmpeg gave {} bytes of pictures instead of {wanted}", raw.len()));
        }
        let masks = mask::decode(&self.mask_bytes, self.stamps.len(), self.grid.width, self.grid.height);
        Ok(Pictures { raw, masks })
    }
}

fn decode_video(coded: &Path, raw: &Path) -> Result<(), String> {
    let mut ffmpeg = Command::new("ffmpeg");
    ffmpeg.args(["-v", "error", "-nostdin", "-y", "-threads", "1", "-i"]).arg(coded);
    run(ffmpeg.args(["-f", "rawvideo", "-pix_fmt", "gray12le"]).arg(raw))
}

impl Decoded for Video {
    fn stamps(&self) -> &[ReplayStamp] {
        &self.stamps
    }
    fn period_nanos(&self) -> u64 {
        self.period_nanos
    }
    fn scan(&mut self, stamp: &ReplayStamp) -> Result<Scan, MeasureError> {
        let coder = self.coder;
        let fail = |reason: String| MeasureError::Coder { coder, reason };
        if self.pictures.is_none() {
            self.pictures = Some(self.decode().map_err(fail)?);
        }
        let at = self.stamps.iter().position(|s| s == stamp).ok_or_else(|| fail("no such scan".into()))?;
        let Some(Pictures { raw, masks }) = &self.pictures else { return Err(fail("no pictures".into())) };
        let [w, h] = self.size;
        let picture = &raw[at * w * h * 2..(at + 1) * w * h * 2];
        let depth = |(k, &inside): (usize, &bool)| {
            let place = 2 * (k / self.grid.width * w + k % self.grid.width);
            let level = f32::from(u16::from_le_bytes([picture[place], picture[place + 1]]));
            if inside { self.levels.low_mm + level * self.levels.step_mm } else { f32::NAN }
        };
        let depths: Vec<f32> = masks[at].iter().enumerate().map(depth).collect();
        scan_of(self.grid.mesh(&depths, self.levels.step_mm, self.rests_px[at]), stamp, coder)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sweep::test_scans::rising;
    use gv3_codec::metrics::compare;

    #[test]
    fn better_settings_take_more_and_err_less() {
        let (input, hevc) = (rising(64, 4), Hevc::ultrafast());
        if let Some(reason) = hevc.unavailable(&input) {
            println!("skipped: {reason}");
            return;
        }
        let mut found = Vec::new();
        for setting in [0, 4] {
            let Coded { bytes, mut decoded, .. } = hevc.code(setting, &input).unwrap();
            let mut worst = 0.0f64;
            for (scan, stamp) in input.scans.iter().zip(input.stamps()) {
                let back = decoded.scan(&stamp).unwrap();
                assert_eq!(back.mesh.vertex_count(), scan.mesh.vertex_count(), "the mask is lossless");
                worst = worst.max(compare(scan, &back).distortion.scan_to_replay.summary().rms);
            }
            found.push((bytes, worst));
        }
        assert!(found[0].0 > found[1].0 && found[0].1 < found[1].1 && found[1].1 < 0.5, "{found:?}");
    }
}
