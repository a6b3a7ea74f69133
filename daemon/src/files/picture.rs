//! 8-bit grey pictures as BMP or PNG.

use super::error::{FileError, Result, check_size, read_limited};
use gv3_codec::GreyPicture;
use image::codecs::bmp::{BmpDecoder, BmpEncoder};
use image::codecs::png::{PngDecoder, PngEncoder};
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageError, Limits};
use std::io::Cursor;
use std::path::Path;

/// Largest picture file read.
pub const MAX_PICTURE_BYTES: u64 = 256 << 20;
/// Most columns and rows.
pub const MAX_SIDE_PX: u32 = 16_384;
/// Most bytes a picture may take decoded.
const MAX_DECODED_BYTES: u64 = 256 << 20;

/// File formats of pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PictureFormat {
    /// Windows bitmap, 8 bits with a grey palette, as scanners store it.
    Bmp,
    /// PNG, 8-bit grey.
    Png,
}

impl PictureFormat {
    /// Ending of file names.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Bmp => "bmp",
            Self::Png => "png",
        }
    }
}

/// Reads a BMP or PNG file; see [`parse_picture`].
///
/// # Errors
/// [`FileError`]: not readable, or as [`parse_picture`].
pub fn read_picture(path: &Path) -> Result<GreyPicture> {
    parse_picture(&read_limited(path, MAX_PICTURE_BYTES)?, path)
}

/// Decodes BMP or PNG bytes, told apart by their first bytes; colour becomes grey (Rec. 709 luma). `path` only names
/// the bytes in errors.
///
/// # Errors
/// [`FileError`]: neither format, damaged, larger than [`MAX_SIDE_PX`] or 256 MiB.
pub fn parse_picture(bytes: &[u8], path: &Path) -> Result<GreyPicture> {
    check_size(bytes.len() as u64, MAX_PICTURE_BYTES, path)?;
    let damaged = |e: ImageError| FileError::content(path, format!("damaged picture ({e}); save it again"));
    if bytes.starts_with(b"BM") {
        decode(BmpDecoder::new(Cursor::new(bytes)).map_err(damaged)?, path)
    } else if bytes.starts_with(b"\x89PNG") {
        let mut limits = Limits::no_limits();
        limits.max_alloc = Some(MAX_DECODED_BYTES);
        decode(PngDecoder::with_limits(Cursor::new(bytes), limits).map_err(damaged)?, path)
    } else {
        Err(FileError::byte(path, 0, "neither BMP nor PNG; save the picture as 8-bit grey BMP"))
    }
}

fn decode(decoder: impl ImageDecoder, path: &Path) -> Result<GreyPicture> {
    let (width_px, height_px) = decoder.dimensions();
    let is_large = width_px.max(height_px) > MAX_SIDE_PX || decoder.total_bytes() > MAX_DECODED_BYTES;
    if is_large || width_px.min(height_px) == 0 {
        let reason = format!(
            "{width_px} x {height_px} pixels; pictures of 1 to {MAX_SIDE_PX} pixels a side and up to 256 MiB are read"
        );
        return Err(FileError::content(path, reason));
    }
    let image = DynamicImage::from_decoder(decoder)
        .map_err(|e| FileError::content(path, format!("damaged picture ({e}); is the file cut short?")))?;
    Ok(GreyPicture::new(width_px, height_px, image.into_luma8().into_raw()))
}

/// The picture as a file of `format`.
///
/// # Errors
/// [`FileError`] naming `path` when the picture is empty or too large for the format.
pub fn picture_bytes(picture: &GreyPicture, format: PictureFormat, path: &Path) -> Result<Vec<u8>> {
    encode(&picture.pixels, [picture.width_px, picture.height_px], ExtendedColorType::L8, format, path)
}

/// Bytes of a picture as an uncompressed BMP file: two heads, a palette of grey, and rows of whole words.
pub fn bmp_byte_count([width_px, height_px]: [u32; 2]) -> u64 {
    14 + 40 + 4 * 256 + u64::from(width_px.next_multiple_of(4)) * u64::from(height_px)
}

/// An image of 8-bit red, green and blue, row by row, as a file of `format`.
///
/// # Errors
/// As [`picture_bytes`].
pub fn rgb_bytes(rgb: &[u8], size_px: [u32; 2], format: PictureFormat, path: &Path) -> Result<Vec<u8>> {
    encode(rgb, size_px, ExtendedColorType::Rgb8, format, path)
}

fn encode(
    pixels: &[u8],
    [width_px, height_px]: [u32; 2],
    colour: ExtendedColorType,
    format: PictureFormat,
    path: &Path,
) -> Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(pixels.len() + 1078);
    let written = match format {
        PictureFormat::Bmp => BmpEncoder::new(&mut bytes).encode(pixels, width_px, height_px, colour),
        PictureFormat::Png => PngEncoder::new(&mut bytes).write_image(pixels, width_px, height_px, colour),
    };
    written.map_err(|e| FileError::content(path, format!("a picture of {width_px} x {height_px}: {e}")))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn name() -> &'static Path {
        Path::new("a.bmp")
    }

    fn bytes_of(picture: &GreyPicture, format: PictureFormat) -> Vec<u8> {
        picture_bytes(picture, format, name()).unwrap()
    }

    fn error(bytes: &[u8]) -> String {
        parse_picture(bytes, name()).unwrap_err().to_string()
    }

    #[test]
    fn golden_bmp_is_8_bit_with_a_grey_palette_bottom_row_first() {
        let bytes = bytes_of(&GreyPicture::new(3, 2, vec![1, 2, 3, 250, 251, 252]), PictureFormat::Bmp);
        let mut expected = b"BM".to_vec();
        for word in [1086_u32, 0, 1078, 40, 3, 2] {
            expected.extend_from_slice(&word.to_le_bytes());
        }
        expected.extend_from_slice(&[1, 0, 8, 0]);
        for word in [0_u32, 8, 0, 0, 256, 0] {
            expected.extend_from_slice(&word.to_le_bytes());
        }
        expected.extend((0..=255_u8).flat_map(|level| [level, level, level, 0]));
        expected.extend_from_slice(&[250, 251, 252, 0, 1, 2, 3, 0]);
        assert_eq!(bytes, expected);
    }

    #[test]
    fn the_size_of_a_bmp_is_known_before_it_is_written() {
        for size_px in [[1, 1], [3, 2], [4, 7], [33, 20]] {
            let picture = GreyPicture::filled(size_px[0], size_px[1], 5);
            assert_eq!(bmp_byte_count(size_px), bytes_of(&picture, PictureFormat::Bmp).len() as u64);
        }
    }

    #[test]
    fn colour_becomes_grey_by_luma() {
        let rgb = [255, 0, 0, 0, 255, 0, 0, 0, 255, 90, 90, 90];
        let mut bytes = Vec::new();
        PngEncoder::new(&mut bytes).write_image(&rgb, 2, 2, ExtendedColorType::Rgb8).unwrap();
        assert_eq!(parse_picture(&bytes, name()).unwrap().pixels, [54, 182, 18, 90]);
        let mut bytes = Vec::new();
        BmpEncoder::new(&mut bytes).encode(&rgb, 2, 2, ExtendedColorType::Rgb8).unwrap();
        assert_eq!(parse_picture(&bytes, name()).unwrap().pixels, [54, 182, 18, 90]);
    }

    #[test]
    fn bad_pictures_are_named() {
        assert_eq!(error(b"\xff\xd8\xff"), "a.bmp, byte 0: neither BMP nor PNG; save the picture as 8-bit grey BMP");
        let bmp = bytes_of(&GreyPicture::filled(9, 9, 7), PictureFormat::Bmp);
        assert!(error(&bmp[..bmp.len() - 1]).starts_with("a.bmp: damaged picture ("));
        let png = bytes_of(&GreyPicture::filled(9, 9, 7), PictureFormat::Png);
        assert!(error(&png[..png.len() / 2]).starts_with("a.bmp: damaged picture ("));
        assert!(picture_bytes(&GreyPicture::filled(0, 0, 0), PictureFormat::Png, name()).is_err());
    }

    #[test]
    fn sizes_are_checked_before_decoding() {
        let mut bmp = bytes_of(&GreyPicture::filled(9, 9, 7), PictureFormat::Bmp);
        bmp[18..22].copy_from_slice(&20_000_u32.to_le_bytes());
        assert_eq!(
            error(&bmp),
            "a.bmp: 20000 x 9 pixels; pictures of 1 to 16384 pixels a side and up to 256 MiB are read"
        );
    }

    proptest! {
        #[test]
        fn round_trips_are_exact((w, h, pixels) in (1_u32..20, 1_u32..20).prop_flat_map(|(w, h)| {
            (Just(w), Just(h), prop::collection::vec(any::<u8>(), (w * h) as usize))
        })) {
            let picture = GreyPicture::new(w, h, pixels);
            for format in [PictureFormat::Bmp, PictureFormat::Png] {
                prop_assert_eq!(&parse_picture(&bytes_of(&picture, format), name()).unwrap(), &picture);
            }
        }
    }
}
