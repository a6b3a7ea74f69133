//! From the camera's pixels to 8-bit grey, by the stride that the driver gave.
//!
//! Grey levels stay linear: of more than 8 bits the upper 8 are kept, cut off and not rounded, so that the top level still
//! means saturated. Luma of limited range is spread to 0..=255 by L = (Y - 16) 255 / 219, rounded, since fringes saturate at
//! 235 there.

use crate::device::PixelFormat;
use gv3_codec::GreyPicture;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// What the driver sends, as it was agreed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PictureFormat {
    pub pixels: PixelFormat,
    pub width_px: u32,
    pub height_px: u32,
    /// Bytes from row to row; without meaning for JPEG.
    pub stride: u32,
    /// Luma has 0..=255.
    pub is_full_range: bool,
}

impl PictureFormat {
    /// Bytes of a row that hold pixels.
    pub fn row_bytes(&self) -> usize {
        match self.pixels {
            PixelFormat::Grey => self.width_px as usize,
            PixelFormat::Mjpeg => 0,
            PixelFormat::Y10 | PixelFormat::Y12 | PixelFormat::Y16 | PixelFormat::Yuyv => 2 * self.width_px as usize,
        }
    }

    /// The picture in a buffer.
    ///
    /// # Errors
    /// What is wrong with the bytes.
    pub fn grey(&self, bytes: &[u8]) -> Result<GreyPicture, String> {
        if self.pixels == PixelFormat::Mjpeg {
            return self.jpeg(bytes);
        }
        let (stride, row, height) = (self.stride as usize, self.row_bytes(), self.height_px as usize);
        let needed = stride * (height - 1) + row;
        if bytes.len() < needed {
            return Err(format!("{} bytes, a picture has {needed}", bytes.len()));
        }
        let mut pixels = Vec::with_capacity(self.width_px as usize * height);
        let rows = bytes.chunks(stride).take(height).map(|line| &line[..row]);
        match self.pixels {
            PixelFormat::Yuyv => {
                let table = luma_table(self.is_full_range);
                rows.for_each(|line| pixels.extend(line.iter().step_by(2).map(|y| table[usize::from(*y)])));
            }
            PixelFormat::Y10 => rows.for_each(|line| push_upper(line, 10, &mut pixels)),
            PixelFormat::Y12 => rows.for_each(|line| push_upper(line, 12, &mut pixels)),
            PixelFormat::Y16 => rows.for_each(|line| push_upper(line, 16, &mut pixels)),
            PixelFormat::Grey | PixelFormat::Mjpeg => rows.for_each(|line| pixels.extend_from_slice(line)),
        }
        Ok(GreyPicture::new(self.width_px, self.height_px, pixels))
    }

    fn jpeg(&self, bytes: &[u8]) -> Result<GreyPicture, String> {
        let size = [self.width_px as usize, self.height_px as usize];
        // Cameras leave out what a file must have; size is limited before anything is allocated.
        let options = DecoderOptions::default()
            .set_strict_mode(false)
            .set_max_width(size[0])
            .set_max_height(size[1])
            .jpeg_set_max_scans(1)
            .jpeg_set_out_colorspace(ColorSpace::Luma);
        let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
        let pixels = decoder.decode().map_err(|e| format!("JPEG: {e}"))?;
        match decoder.dimensions() {
            Some((width, height)) if [width, height] == size && pixels.len() == width * height => {
                Ok(GreyPicture::new(self.width_px, self.height_px, pixels))
            }
            found => Err(format!("JPEG: size {found:?}, {size:?} was agreed")),
        }
    }
}

/// The upper 8 of `bits` bits, little-endian in 16. Bits above are not looked at twice: they saturate.
fn push_upper(line: &[u8], bits: u32, pixels: &mut Vec<u8>) {
    let (pairs, _) = line.as_chunks::<2>();
    pixels.extend(pairs.iter().map(|pair| (u16::from_le_bytes(*pair) >> (bits - 8)).min(255) as u8));
}

fn luma_table(is_full_range: bool) -> [u8; 256] {
    std::array::from_fn(|y| match is_full_range {
        true => y as u8,
        false => ((y.clamp(16, 235) - 16) * 255 + 109).div_euclid(219) as u8,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn format(pixels: PixelFormat, size_px: [u32; 2], stride: u32) -> PictureFormat {
        PictureFormat { pixels, width_px: size_px[0], height_px: size_px[1], stride, is_full_range: false }
    }

    #[test]
    fn padding_is_left_out() {
        let bytes = [1, 2, 3, 99, 4, 5, 6];
        assert_eq!(format(PixelFormat::Grey, [3, 2], 4).grey(&bytes).unwrap().pixels, [1, 2, 3, 4, 5, 6]);
        let short = format(PixelFormat::Grey, [3, 2], 4).grey(&bytes[..6]).unwrap_err();
        assert_eq!(short, "6 bytes, a picture has 7");
        assert!(format(PixelFormat::Grey, [3, 2], 4).grey(&[]).is_err());
    }

    #[test]
    fn the_upper_bits_are_kept_and_saturation_stays_saturated() {
        let words = |words: &[u16]| words.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<u8>>();
        let cases = [
            (PixelFormat::Y10, [0, 4, 1023, 0x07ff], [0, 1, 255, 255]),
            (PixelFormat::Y12, [0, 16, 4095, 15], [0, 1, 255, 0]),
            (PixelFormat::Y16, [0, 256, 65535, 255], [0, 1, 255, 0]),
        ];
        for (pixels, from, to) in cases {
            assert_eq!(format(pixels, [2, 2], 4).grey(&words(&from)).unwrap().pixels, to, "{pixels:?}");
        }
    }

    #[test]
    fn luma_is_spread_to_its_full_range() {
        let limited = format(PixelFormat::Yuyv, [4, 1], 8);
        let bytes = [16, 128, 235, 128, 0, 128, 126, 128];
        assert_eq!(limited.grey(&bytes).unwrap().pixels, [0, 255, 0, 128]);
        let full = PictureFormat { is_full_range: true, ..limited };
        assert_eq!(full.grey(&bytes).unwrap().pixels, [16, 235, 0, 126]);
    }

    fn fringes() -> Vec<u8> {
        (0..64 * 48).map(|i| (128.0 + 100.0 * (f64::from(i % 64) * 0.4).sin()) as u8).collect()
    }

    fn jpeg_of(fringes: &[u8]) -> Vec<u8> {
        let mut jpeg = Vec::new();
        let encoder = jpeg_encoder::Encoder::new(&mut jpeg, 95);
        encoder.encode(fringes, 64, 48, jpeg_encoder::ColorType::Luma).unwrap();
        jpeg
    }

    #[test]
    fn jpeg_pictures_are_read_and_foreign_ones_refused() {
        let (fringes, agreed) = (fringes(), format(PixelFormat::Mjpeg, [64, 48], 0));
        let jpeg = jpeg_of(&fringes);
        let picture = agreed.grey(&jpeg).unwrap();
        assert!(picture.pixels.iter().zip(&fringes).all(|(a, b)| a.abs_diff(*b) <= 8));
        // Bytes after the end, as cameras leave in their buffers.
        assert_eq!(agreed.grey(&[&jpeg[..], &[0; 100]].concat()).unwrap(), picture);
        for size_px in [[32, 48], [64, 49], [128, 96]] {
            assert!(format(PixelFormat::Mjpeg, size_px, 0).grey(&jpeg).is_err());
        }
        assert!(agreed.grey(&[]).is_err());
        assert!(agreed.grey(&[0xff, 0xd8, 0xff]).is_err());
    }

    proptest! {
        #[test]
        fn damaged_jpeg_is_an_error_or_a_picture_of_the_agreed_size(
            at in any::<prop::sample::Index>(), byte in any::<u8>(), end in any::<prop::sample::Index>(),
        ) {
            let mut jpeg = jpeg_of(&fringes());
            let at = at.index(jpeg.len());
            jpeg[at] = byte;
            jpeg.truncate(end.index(jpeg.len()) + 1);
            if let Ok(picture) = format(PixelFormat::Mjpeg, [64, 48], 0).grey(&jpeg) {
                prop_assert_eq!([picture.width_px, picture.height_px], [64, 48]);
            }
        }
    }
}
