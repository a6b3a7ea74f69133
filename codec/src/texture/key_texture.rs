//! Texture of a keyframe in `--mode seed`: the picture cropped to the surface, as a baseline JPEG (ITU-T T.81).

use super::jpeg_frame;
use crate::bits::bytes::ByteReader;
use crate::{CodecError, GreyPicture, Result};
use jpeg_encoder::{ColorType, Encoder};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Largest picture side that a payload may announce.
pub const MAX_SIDE_PX: u32 = 8192;

/// Side of a JPEG block.
const BLOCK: usize = 8;

/// Codes the pixels where `mask` holds (row-major, one a pixel); the others come back as a smooth continuation.
///
/// # Errors
/// [`CodecError::Texture`] when the picture is empty or larger than [`MAX_SIDE_PX`].
///
/// # Panics
/// When the mask has another size than the picture.
pub fn encode(picture: &GreyPicture, mask: &[bool], quality: u8) -> Result<Vec<u8>> {
    assert_eq!(mask.len(), picture.pixels.len(), "mask and picture differ in size");
    let (w, h) = (picture.width_px, picture.height_px);
    if w == 0 || h == 0 || w > MAX_SIDE_PX || h > MAX_SIDE_PX {
        return Err(CodecError::Texture(format!("{w}x{h} pixels; 1 to {MAX_SIDE_PX} a side can be coded")));
    }
    let [x0, y0, x1, y1] = mask_bounds(mask, w as usize).unwrap_or([0, 0, 1, 1]);
    let (cw, ch) = (x1 - x0, y1 - y0);
    let mut crop = Vec::with_capacity(cw * ch);
    let mut inside = Vec::with_capacity(cw * ch);
    for y in y0..y1 {
        let row = y * w as usize;
        crop.extend_from_slice(&picture.pixels[row + x0..row + x1]);
        inside.extend_from_slice(&mask[row + x0..row + x1]);
    }
    smooth_outside(&mut crop, &inside, cw);
    let mut out = Vec::new();
    for v in [w, h, x0 as u32, y0 as u32] {
        out.extend_from_slice(&(v as u16).to_le_bytes());
    }
    let mut encoder = Encoder::new(&mut out, quality);
    encoder.set_optimized_huffman_tables(true);
    encoder
        .encode(&crop, cw as u16, ch as u16, ColorType::Luma)
        .map_err(|e| CodecError::Texture(format!("JPEG encoder: {e}")))?;
    Ok(out)
}

/// Bounds [x0, y0, x1, y1) of the set pixels.
fn mask_bounds(mask: &[bool], width: usize) -> Option<[usize; 4]> {
    let mut rows = mask.chunks_exact(width).enumerate().filter(|(_, row)| row.contains(&true)).map(|(y, _)| y);
    let y0 = rows.next()?;
    let y1 = rows.next_back().unwrap_or(y0) + 1;
    let (mut x0, mut x1) = (width, 0);
    for row in mask.chunks_exact(width) {
        if let Some(first) = row.iter().position(|&m| m) {
            x0 = x0.min(first);
            x1 = x1.max(row.iter().rposition(|&m| m).unwrap_or(first) + 1);
        }
    }
    Some([x0, y0, x1, y1])
}

/// Outside the mask a block takes the mean of its inside pixels, or of the block before it: edges at the border of the
/// surface cost bits and ring into it.
fn smooth_outside(pixels: &mut [u8], inside: &[bool], width: usize) {
    let height = pixels.len() / width;
    let mut fill = 128u8;
    for by in (0..height).step_by(BLOCK) {
        for bx in (0..width).step_by(BLOCK) {
            let places =
                (by..(by + BLOCK).min(height)).flat_map(|y| (bx..(bx + BLOCK).min(width)).map(move |x| y * width + x));
            let (mut sum, mut count) = (0u32, 0u32);
            for i in places.clone().filter(|&i| inside[i]) {
                sum += u32::from(pixels[i]);
                count += 1;
            }
            if let Some(mean) = (sum + count / 2).checked_div(count) {
                fill = mean as u8;
            }
            for i in places.filter(|&i| !inside[i]) {
                pixels[i] = fill;
            }
        }
    }
}

/// Decodes a texture payload to the picture's full size; outside the crop it is 0.
///
/// # Errors
/// [`CodecError::Payload`] at the first byte that does not follow FORMAT.md, "Texture".
pub fn decode(bytes: &[u8]) -> Result<GreyPicture> {
    let mut reader = ByteReader::new(bytes, "texture");
    let [w, h, x0, y0] = [reader.u16()?, reader.u16()?, reader.u16()?, reader.u16()?].map(usize::from);
    if w == 0 || h == 0 || w > MAX_SIDE_PX as usize || h > MAX_SIDE_PX as usize {
        return Err(reader.error(format!("{w}x{h} pixels; 1 to {MAX_SIDE_PX} a side are allowed")));
    }
    let mut at = reader.clone();
    let jpeg = reader.take(reader.remaining())?;
    let [cw, ch] = jpeg_frame::size_px(&mut at)?.map(usize::from);
    if cw == 0 || ch == 0 || x0 + cw > w || y0 + ch > h {
        return Err(at.error(format!("a crop of {cw}x{ch} at {x0},{y0} does not fit {w}x{h} pixels")));
    }
    let options = DecoderOptions::default().jpeg_set_out_colorspace(ColorSpace::Luma).set_strict_mode(true);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(jpeg), options);
    let crop = decoder.decode().map_err(|e| at.error(format!("JPEG: {e:?}")))?;
    if crop.len() != cw * ch {
        return Err(at.error(format!("JPEG: {} pixels for {cw}x{ch}", crop.len())));
    }
    let mut picture = GreyPicture::filled(w as u32, h as u32, 0);
    for (y, row) in crop.chunks_exact(cw).enumerate() {
        let start = (y0 + y) * w + x0;
        picture.pixels[start..start + cw].copy_from_slice(row);
    }
    Ok(picture)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> (GreyPicture, Vec<bool>) {
        let (w, h) = (120u32, 90u32);
        let at = |i: u32| (f64::from(i % w), f64::from(i / w));
        let inside = |x: f64, y: f64| ((x - 60.0) / 40.0).powi(2) + ((y - 40.0) / 30.0).powi(2) < 1.0;
        let mask: Vec<bool> = (0..w * h).map(|i| inside(at(i).0, at(i).1)).collect();
        let level = |x: f64, y: f64| 128.0 + 60.0 * (x * 0.13).sin() * (y * 0.09).cos();
        let pixels = (0..w * h).map(|i| if mask[i as usize] { level(at(i).0, at(i).1) as u8 } else { 0 }).collect();
        (GreyPicture::new(w, h, pixels), mask)
    }

    #[test]
    fn inside_the_mask_the_picture_comes_back() {
        let (picture, mask) = scene();
        let bytes = encode(&picture, &mask, 90).unwrap();
        let back = decode(&bytes).unwrap();
        assert_eq!((back.width_px, back.height_px), (120, 90));
        let squares: Vec<f64> = (0..mask.len())
            .filter(|&i| mask[i])
            .map(|i| (f64::from(picture.pixels[i]) - f64::from(back.pixels[i])).powi(2))
            .collect();
        let mse = squares.iter().sum::<f64>() / squares.len() as f64;
        assert!(10.0 * (255.0f64 * 255.0 / mse).log10() > 40.0, "mse {mse}");
    }

    #[test]
    fn an_empty_mask_still_codes() {
        let picture = GreyPicture::filled(16, 16, 9);
        let back = decode(&encode(&picture, &[false; 256], 80).unwrap()).unwrap();
        assert_eq!(back.width_px, 16);
    }

    #[test]
    fn only_baseline_grey_is_taken() {
        let coded = |color: ColorType, progressive: bool| {
            let mut out = [16u16, 16, 0, 0].iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
            let mut encoder = Encoder::new(&mut out, 80);
            encoder.set_progressive(progressive);
            let channels = if color == ColorType::Rgb { 3 } else { 1 };
            encoder.encode(&vec![77; 256 * channels], 16, 16, color).unwrap();
            decode(&out)
        };
        assert!(coded(ColorType::Luma, false).unwrap().pixels.iter().all(|&p| p.abs_diff(77) < 2));
        assert!(coded(ColorType::Rgb, false).unwrap_err().to_string().contains("not one grey"));
        assert!(coded(ColorType::Luma, true).unwrap_err().to_string().contains("marker 0xc2"));
    }

    #[test]
    fn truncations_and_flips_never_panic() {
        let (picture, mask) = scene();
        let bytes = encode(&picture, &mask, 60).unwrap();
        for n in 0..bytes.len() {
            assert!(decode(&bytes[..n]).is_err(), "{n}");
        }
        assert!(decode(&[&bytes[..], &[0]].concat()).unwrap_err().to_string().contains("too many"));
        for i in 0..bytes.len() {
            let mut bad = bytes.clone();
            bad[i] ^= 1 << (i % 8);
            if let Ok(p) = decode(&bad) {
                assert!(p.pixels.len() <= (MAX_SIDE_PX * MAX_SIDE_PX) as usize);
            }
        }
        for n in 0..bytes.len() - 400 {
            assert!(decode(&[&bytes[..n], &bytes[n + 400..]].concat()).is_err(), "400 bytes left out at {n}");
        }
        assert!(decode(&[0, 0, 1, 0, 0, 0, 0, 0]).unwrap_err().to_string().contains("texture, byte 8"));
    }
}
