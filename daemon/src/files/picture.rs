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
    let mut bytes = Vec::with_capacity(picture.pixels.len() + 1078);
    let (width_px, height_px) = (picture.width_px, picture.height_px);
    let written = match format {
        PictureFormat::Bmp => {
            BmpEncoder::new(&mut bytes).encode(&picture.pixels, width_px, height_px, ExtendedColorType::L8)
        }
        PictureFormat::Png => {
            PngEncoder::new(&mut bytes).write_image(&picture.pixels, width_px, height_px, ExtendedColorType::L8)
        }
    };
    written.map_err(|e| FileError::content(path, format!("a picture of {width_px} x {height_px}: {e}")))?;
    Ok(bytes)
}
