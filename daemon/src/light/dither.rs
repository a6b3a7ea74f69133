//! Error-diffusion dithering.

use gv3_codec::GreyPicture;

/// Levels 0..=1 of `level(x, y)` as a picture of 0 and 255 (R. W. Floyd, L. Steinberg, "An adaptive algorithm for spatial
/// grey scale", Proc. SID 17(2), 1976; rows in alternating direction, which leaves no slanted texture).
pub fn floyd_steinberg(width_px: u32, height_px: u32, level: impl Fn(u32, u32) -> f64) -> GreyPicture {
    let w = width_px as usize;
    let mut pixels = vec![0; w * height_px as usize];
    // One more on either side takes what diffuses out of the picture.
    let (mut here, mut below) = (vec![0.0; w + 2], vec![0.0; w + 2]);
    for (y, row) in (0..).zip(pixels.chunks_exact_mut(w.max(1))) {
        let is_forward = y % 2 == 0;
        for k in 0..w {
            let x = if is_forward { k } else { w - 1 - k };
            let wanted = level(x as u32, y) + here[x + 1];
            let is_bright = wanted >= 0.5;
            row[x] = if is_bright { 255 } else { 0 };
            let error = wanted - f64::from(u8::from(is_bright));
            let (ahead, behind) = if is_forward { (x + 2, x) } else { (x, x + 2) };
            here[ahead] += error * (7.0 / 16.0);
            below[behind] += error * (3.0 / 16.0);
            below[x + 1] += error * (5.0 / 16.0);
            below[ahead] += error * (1.0 / 16.0);
        }
        std::mem::swap(&mut here, &mut below);
        below.fill(0.0);
    }
    GreyPicture::new(width_px, height_px, pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_of_every_block_is_the_level() {
        let picture = floyd_steinberg(256, 64, |x, _| f64::from(x) / 255.0);
        for block in 0..16 {
            let sum: u32 =
                (0..64 * 16).map(|i| u32::from(picture.pixels[i / 16 * 256 + block * 16 + i % 16] / 255)).sum();
            let expected = (block as f64 * 16.0 + 7.5) / 255.0;
            assert!((f64::from(sum) / 1024.0 - expected).abs() < 0.02, "block {block}");
        }
        assert!(floyd_steinberg(9, 9, |_, _| 1.0).pixels.iter().all(|&v| v == 255));
    }
}
