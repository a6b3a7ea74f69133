//! Patterns packed into 24-bit images, as the projector's flash or video input carries them.

use crate::light::PatternSequence;
use gv3_codec::GreyPicture;
use gv3_protocol::dlpc350::BitDepth;

/// Bytes of an RGB pixel in the order of the bit planes: green, red, blue.
const CHANNELS: [usize; 3] = [1, 0, 2];

/// An image of 8-bit red, green and blue, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PackedImage {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Red, green, blue of every pixel.
    pub rgb: Vec<u8>,
}

/// The sequence's patterns at `depth`, as many in an image as it holds, in their order; 1-bit patterns are dithered.
pub fn pack_images(sequence: &PatternSequence, depth: BitDepth) -> Vec<PackedImage> {
    let (width_px, height_px) = (sequence.width_px, sequence.height_px);
    let indices: Vec<usize> = (0..sequence.patterns.len()).collect();
    let pack = |patterns: &[usize]| {
        let mut rgb = vec![0; 3 * width_px as usize * height_px as usize];
        for (k, &index) in patterns.iter().enumerate() {
            let is_dithered = depth.bits() == 1;
            let picture = if is_dithered { sequence.render_dithered(index) } else { sequence.render(index) };
            add(&mut rgb, &picture, k, depth);
        }
        PackedImage { width_px, height_px, rgb }
    };
    indices.chunks(depth.patterns_per_image()).map(pack).collect()
}

/// Writes pattern number `k` into its planes: 8 and 7 bits are the upper bits of a channel, fewer share one from its least
/// bit on.
fn add(rgb: &mut [u8], picture: &GreyPicture, k: usize, depth: BitDepth) {
    let bits = u32::from(depth.bits());
    let a_channel = (8 / bits) as usize;
    let channel = CHANNELS[k / a_channel];
    let shift = if a_channel == 1 { 8 - bits } else { bits * (k % a_channel) as u32 };
    let most = (1u32 << bits) - 1;
    for (pixel, &level) in rgb.chunks_exact_mut(3).zip(&picture.pixels) {
        let value = (u32::from(level) * most + 127) / 255;
        pixel[channel] |= (value << shift) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gv3_protocol::dlpc350::LutEntry;

    /// What the projector shows of an image: the planes of one pattern, by the table of the programmer's guide.
    fn shown(image: &PackedImage, entry: &LutEntry) -> Vec<u8> {
        let bits = usize::from(entry.depth.bits());
        let planes: Vec<(usize, usize)> = CHANNELS.iter().flat_map(|&c| (0..8).map(move |bit| (c, bit))).collect();
        let first = match bits {
            7 => 8 * usize::from(entry.pattern) + 1,
            _ => bits * usize::from(entry.pattern),
        };
        let level = |pixel: &[u8]| {
            let set = planes[first..first + bits].iter().enumerate();
            set.map(|(i, &(c, bit))| u32::from(pixel[c] >> bit & 1) << i).sum::<u32>()
        };
        image.rgb.chunks_exact(3).map(|p| (level(p) * 255 / ((1 << bits) - 1)) as u8).collect()
    }

    #[test]
    fn every_pattern_comes_out_of_its_planes() {
        let sequence = PatternSequence::two_frequency([24, 3], 24.0, 8.0, 5);
        for bits in [1, 4, 7, 8] {
            let depth = BitDepth::new(bits).unwrap();
            let images = pack_images(&sequence, depth);
            let config = super::super::Dlpc350Config::flash(bits, images.len() as u8);
            let timing =
                crate::device::SequenceTiming { picture_period_nanos: 300_000_000, exposure_nanos: 300_000_000 };
            let program = super::super::Program::sequence(&config, 10, &timing).unwrap();
            assert_eq!(program.images.len(), images.len());
            let mut image = 0;
            for (index, entry) in program.patterns.iter().enumerate() {
                image += usize::from(index > 0 && entry.swaps_buffer);
                let wanted = if bits == 1 { sequence.render_dithered(index) } else { sequence.render(index) };
                let found = shown(&images[image], entry);
                let worst = found.iter().zip(&wanted.pixels).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
                let half_a_step = 127 / ((1u16 << bits) - 1) as u8 + 1;
                assert!(worst <= if bits == 1 { 0 } else { half_a_step }, "{bits} bits, pattern {index}: {worst}");
            }
        }
    }
}
