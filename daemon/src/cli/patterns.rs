//! `gv3 patterns`: the pictures that a projector shows.

use super::Outcome;
use crate::device::dlpc350::{PackedImage, pack_images};
use crate::files::ProcessingConfig;
use crate::files::picture::{PictureFormat, picture_bytes, rgb_bytes};
use crate::files::raw_folder::{PictureNames, RawFolder};
use crate::light::pattern::MAX_SIDE_PX;
use crate::light::{Direction, PatternSequence};
use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use gv3_protocol::dlpc350::BitDepth;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Write the pictures of a pattern sequence for any projector, and the sequence.toml that `gv3 reconstruct` reads.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 patterns two-frequency --size 912x1140 -o patterns\n  gv3 patterns gray --size 1920x1080 --both -o patterns\n  gv3 patterns two-frequency --size 912x1140 --pack 7 --format bmp -o flash-images\n  gv3 patterns gray-phase --size 1024x768 --period 24 --steps 4 --dither -o patterns"
)]
pub struct Patterns {
    /// Kind of sequence.
    #[arg(value_enum)]
    kind: Kind,
    /// Projector pixels, columns x rows.
    #[arg(long, value_parser = size, value_name = "WxH")]
    size: [u32; 2],
    /// Folder to write.
    #[arg(short, long)]
    out: PathBuf,
    /// Code rows instead of columns.
    #[arg(long)]
    rows: bool,
    /// Code columns, then rows (Gray code only).
    #[arg(long, conflicts_with = "rows")]
    both: bool,
    /// Finest fringe period, projector pixels.
    #[arg(long, default_value_t = 22.0)]
    period: f64,
    /// Longest fringe period of two-frequency, projector pixels.
    #[arg(long, default_value_t = 264.0)]
    long_period: f64,
    /// Ratio of neighbouring periods of multi-frequency.
    #[arg(long, default_value_t = 6.0)]
    ratio: f64,
    /// Pictures a fringe period.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(3..=64))]
    steps: u32,
    /// One bit a pixel, black and white, by Floyd-Steinberg dithering.
    #[arg(long)]
    dither: bool,
    /// Pack the patterns at 1, 4, 7 or 8 bits into 24-bit images, as a LightCrafter 4500 takes them in flash or by video.
    #[arg(long, value_name = "BITS", value_parser = ["1", "4", "7", "8"], conflicts_with = "dither")]
    pack: Option<String>,
    /// Files to write.
    #[arg(long, value_enum, default_value_t = Format::Png)]
    format: Format,
    /// Write into a folder that holds files.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// One period in N steps.
    NStep,
    /// Two sinusoids a quarter period apart and the half level.
    TwoPlusOne,
    /// Two bursts of three steps 60 degrees apart, which cancel each other's error under a projector's gamma.
    DoubleThreeStep,
    /// Two periods in N steps each, columns: what the live scanner uses.
    TwoFrequency,
    /// Periods by a fixed ratio up to the whole projector.
    MultiFrequency,
    /// Three periods whose beats cover the projector.
    Heterodyne,
    /// Gray code with inverses, white and black.
    Gray,
    /// Gray code down to half a period, white, black, and N steps.
    GrayPhase,
    /// All white and all black.
    WhiteBlack,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// 8-bit grey PNG.
    Png,
    /// 8-bit grey BMP.
    Bmp,
}

pub(super) fn size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    match sides {
        Some(sides) if sides.iter().all(|n| (1..=MAX_SIDE_PX).contains(n)) => Ok(sides),
        _ => Err(format!("give columns x rows like 912x1140, each from 1 to {MAX_SIDE_PX}")),
    }
}

#[derive(Debug, Serialize)]
struct PatternsReport {
    pictures: usize,
    width_px: u32,
    height_px: u32,
    bits: u8,
    sequence: PathBuf,
}

impl Patterns {
    pub(super) fn run(self) -> Result<Outcome> {
        let sequence = self.sequence()?;
        sequence.validate()?;
        self.prepare_folder()?;
        let format = match self.format {
            Format::Png => PictureFormat::Png,
            Format::Bmp => PictureFormat::Bmp,
        };
        let names = PictureNames::Numbered(format!("pattern_###.{}", format.extension()));
        let folder =
            RawFolder { pictures: names, first: 0, sequence, limits: None, processing: ProcessingConfig::default() };
        let depth = self.pack.as_ref().and_then(|bits| BitDepth::new(bits.parse().ok()?));
        let pictures = match depth {
            Some(depth) => self.write_packed(&folder.sequence, depth, format)?,
            None => self.write_pictures(&folder, format)?,
        };
        let path = self.out.join("sequence.toml");
        write(&path, folder.to_toml()?.as_bytes())?;
        let report = PatternsReport {
            pictures,
            width_px: folder.sequence.width_px,
            height_px: folder.sequence.height_px,
            bits: depth.map_or(if self.dither { 1 } else { 8 }, BitDepth::bits),
            sequence: path,
        };
        Outcome::of(self.json, &report, || {
            let PatternsReport { pictures, width_px, height_px, bits, sequence } = &report;
            format!("{}: {pictures} pictures of {width_px} x {height_px} pixels, {bits} bit", sequence.display())
        })
    }

    /// One picture a pattern; how many.
    fn write_pictures(&self, folder: &RawFolder, format: PictureFormat) -> Result<usize> {
        let names = folder.names()?;
        for (index, name) in names.iter().enumerate() {
            let path = self.out.join(name);
            let picture =
                if self.dither { folder.sequence.render_dithered(index) } else { folder.sequence.render(index) };
            write(&path, &picture_bytes(&picture, format, &path)?)?;
        }
        Ok(names.len())
    }

    /// Several patterns a picture; how many pictures.
    fn write_packed(&self, sequence: &PatternSequence, depth: BitDepth, format: PictureFormat) -> Result<usize> {
        let images = pack_images(sequence, depth);
        for (index, PackedImage { width_px, height_px, rgb }) in images.iter().enumerate() {
            let path = self.out.join(format!("image_{index:02}.{}", format.extension()));
            write(&path, &rgb_bytes(rgb, [*width_px, *height_px], format, &path)?)?;
        }
        Ok(images.len())
    }

    fn sequence(&self) -> Result<PatternSequence> {
        self.check_usage()?;
        let direction = if self.rows { Direction::Rows } else { Direction::Columns };
        let (size, period, steps) = (self.size, self.period, self.steps);
        Ok(match self.kind {
            Kind::NStep => PatternSequence::n_step(size, direction, period, steps),
            Kind::TwoPlusOne => PatternSequence::two_plus_one(size, direction, period),
            Kind::DoubleThreeStep => PatternSequence::double_three_step(size, direction, period),
            Kind::TwoFrequency => PatternSequence::two_frequency(size, self.long_period, period, steps),
            Kind::MultiFrequency => PatternSequence::hierarchical(size, direction, period, self.ratio, steps),
            Kind::Heterodyne => PatternSequence::heterodyne(size, direction, period, steps),
            Kind::Gray if self.both => PatternSequence::gray_code(size, &[Direction::Columns, Direction::Rows]),
            Kind::Gray => PatternSequence::gray_code(size, &[direction]),
            Kind::GrayPhase => PatternSequence::gray_phase(size, direction, period, steps),
            Kind::WhiteBlack => PatternSequence::gray_code(size, &[]),
        })
    }

    fn check_usage(&self) -> Result<()> {
        if !(2.0..=f64::from(MAX_SIDE_PX)).contains(&self.period) {
            bail!("--period {}: expected 2 to {MAX_SIDE_PX} projector pixels", self.period);
        }
        if !(1.5..=100.0).contains(&self.ratio) {
            bail!("--ratio {}: expected 1.5 to 100", self.ratio);
        }
        if self.rows && self.kind == Kind::TwoFrequency {
            bail!("--rows: the live sequence codes columns; use multi-frequency");
        }
        if self.both && self.kind != Kind::Gray {
            bail!("--both: only the Gray code has both directions in one sequence");
        }
        if self.kind == Kind::Heterodyne && self.period * 4.0 > f64::from(self.size[0].min(self.size[1])) {
            bail!("--period {}: heterodyne needs four fringes or more on the projector", self.period);
        }
        Ok(())
    }

    fn prepare_folder(&self) -> Result<()> {
        let folder = &self.out;
        let show = || folder.display().to_string();
        std::fs::create_dir_all(folder).with_context(|| format!("{}: cannot create the folder", show()))?;
        let mut entries = std::fs::read_dir(folder).with_context(|| format!("{}: cannot open", show()))?;
        if !self.force && entries.next().is_some() {
            bail!("{}: the folder is not empty; give another one, or --force", show());
        }
        Ok(())
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    std::fs::write(path, bytes).with_context(|| format!("{}: cannot write", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::picture::read_picture;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        patterns: Patterns,
    }

    fn run(folder: &Path, arguments: &[&str]) -> Result<Outcome> {
        let fixed = ["gv3", "-o", folder.to_str().unwrap()];
        Line::try_parse_from(fixed.iter().chain(arguments))?.patterns.run()
    }

    #[test]
    fn what_is_written_reads_back_as_the_sequence() {
        for kind in Kind::value_variants() {
            let folder = tempfile::tempdir().unwrap();
            let name = kind.to_possible_value().unwrap().get_name().to_owned();
            run(folder.path(), &[&name, "--size", "160x120", "--period", "12", "--long-period", "72"]).unwrap();
            let back = RawFolder::read(&folder.path().join("sequence.toml")).unwrap();
            for (index, name) in back.names().unwrap().iter().enumerate() {
                let picture = read_picture(&folder.path().join(name)).unwrap();
                assert_eq!(picture, back.sequence.render(index), "{name}");
            }
        }
    }

    #[test]
    fn packed_patterns_share_images() {
        let folder = tempfile::tempdir().unwrap();
        let size = ["two-frequency", "--size", "48x20", "--period", "8", "--long-period", "48"];
        let json = run(folder.path(), &[&size[..], &["--pack", "7", "--format", "bmp", "--json"]].concat()).unwrap();
        assert!(json.report.contains(r#""pictures": 2"#) && json.report.contains(r#""bits": 7"#), "{}", json.report);
        let sequence = RawFolder::read(&folder.path().join("sequence.toml")).unwrap().sequence;
        let image = image::open(folder.path().join("image_01.bmp")).unwrap().into_rgb8();
        // The first pattern of an image is its green.
        let green: Vec<u8> = image.pixels().map(|p| p.0[1]).collect();
        assert!(green.iter().zip(&sequence.render(3).pixels).all(|(a, b)| a.abs_diff(*b) <= 2));
        assert!(!folder.path().join("pattern_000.bmp").exists());
        assert!(run(folder.path(), &[&size[..], &["--pack", "5"]].concat()).is_err());
    }

    #[test]
    fn wrong_usage_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let error = |arguments: &[&str]| run(folder.path(), arguments).unwrap_err().to_string();
        assert!(error(&["gray", "--size", "0x5"]).contains("give columns x rows"));
        assert!(error(&["n-step", "--size", "64x64", "--period", "nan"]).contains("--period NaN"));
        assert!(error(&["n-step", "--size", "64x64", "--both"]).contains("--both"));
        std::fs::write(folder.path().join("x"), "").unwrap();
        assert!(error(&["gray", "--size", "64x64"]).contains("not empty"));
    }
}
