//! Text in pictures: Noto Sans Mono (SIL Open Font License 1.1) as pre-rasterized grey letters.

use image::{Rgb, RgbImage};
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};

/// Height of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TextSize {
    /// 20 pixels.
    Small,
    /// 24 pixels.
    Large,
}

impl TextSize {
    fn raster(self) -> RasterHeight {
        match self {
            Self::Small => RasterHeight::Size20,
            Self::Large => RasterHeight::Size24,
        }
    }

    pub(super) fn height_px(self) -> u32 {
        self.raster().val() as u32
    }

    pub(super) fn width_px(self, text: &str) -> u32 {
        (text.chars().count() * get_raster_width(FontWeight::Regular, self.raster())) as u32
    }
}

/// Draws a line of text with its upper left corner at (`left_px`, `top_px`); what falls outside is cut off. Characters
/// beyond printable ASCII become `?`.
pub(super) fn draw_text(image: &mut RgbImage, text: &str, [left_px, top_px]: [u32; 2], size: TextSize, ink: [u8; 3]) {
    let advance_px = get_raster_width(FontWeight::Regular, size.raster()) as u32;
    for (i, letter) in text.chars().enumerate() {
        let glyph = |c| get_raster(c, FontWeight::Regular, size.raster());
        let Some(glyph) = glyph(letter).or_else(|| glyph('?')) else { continue };
        for (row, coverages) in glyph.rows().enumerate() {
            for (column, &coverage) in coverages.iter().enumerate() {
                let (x, y) = (left_px + i as u32 * advance_px + column as u32, top_px + row as u32);
                if x < image.width() && y < image.height() {
                    let Rgb(ground) = *image.get_pixel(x, y);
                    image.put_pixel(x, y, Rgb(std::array::from_fn(|k| blend(ground[k], ink[k], coverage))));
                }
            }
        }
    }
}

fn blend(ground: u8, ink: u8, coverage: u8) -> u8 {
    let (ground, ink, coverage) = (u32::from(ground), u32::from(ink), u32::from(coverage));
    ((ground * (255 - coverage) + ink * coverage + 127) / 255) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn letters_stay_in_their_box_and_outside_is_cut_off() {
        let mut image = RgbImage::from_pixel(60, 34, Rgb([255; 3]));
        draw_text(&mut image, "Hi", [10, 5], TextSize::Small, [0; 3]);
        let inked = |image: &RgbImage| {
            image.enumerate_pixels().filter(|p| p.2.0 != [255; 3]).map(|p| (p.0, p.1)).collect::<Vec<_>>()
        };
        let end = 10 + TextSize::Small.width_px("Hi");
        assert!(inked(&image).len() > 20);
        assert!(inked(&image).iter().all(|&(x, y)| (10..end).contains(&x) && (5..25).contains(&y)));
        draw_text(&mut image, "far too long for this picture", [50, 25], TextSize::Large, [9; 3]);
    }

    #[test]
    fn unknown_characters_become_question_marks() {
        let drawn = |text| {
            let mut image = RgbImage::new(24, 24);
            draw_text(&mut image, text, [0, 0], TextSize::Large, [255; 3]);
            image
        };
        assert_eq!(drawn("\u{4e2d}"), drawn("?"));
        assert_ne!(drawn("?"), RgbImage::new(24, 24));
    }
}
