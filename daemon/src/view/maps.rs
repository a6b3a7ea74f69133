//! Maps over the camera's pixels with a colour scale each, side by side in one picture.

use super::colour_map::{draw_bar, full_scale_mm, viridis};
use super::render::LIGHT_BACKGROUND;
use super::text::{TextSize, draw_text};
use image::{Rgb, RgbImage};

const STRIP_PX: u32 = 48;
const MARGIN_PX: u32 = 18;
const BAR_WIDTH_PX: u32 = 22;
const LEGEND_WIDTH_PX: u32 = 130;
const INK: [u8; 3] = [40, 42, 48];

/// Values of every pixel of a camera.
#[derive(Debug, Clone)]
pub struct PixelMap<'a> {
    /// What is shown, with its unit.
    pub title: &'a str,
    /// Values from 0 row by row; NaN where there is none.
    pub values: &'a [f32],
}

/// Draws maps of `width_px` columns beside each other, with a caption below. The brightest colour is the 99th percentile
/// rounded up.
///
/// # Panics
/// When a map is not whole rows of `width_px`, or maps differ in size.
pub fn draw_maps(maps: &[PixelMap<'_>], width_px: u32, caption: &str) -> RgbImage {
    let pixels = maps.first().map_or(0, |m| m.values.len());
    assert!(maps.iter().all(|m| m.values.len() == pixels) && pixels.is_multiple_of(width_px as usize), "whole rows");
    let height_px = pixels as u32 / width_px;
    let panel_px = MARGIN_PX + width_px + LEGEND_WIDTH_PX;
    let size = [panel_px * maps.len() as u32, height_px + 2 * STRIP_PX];
    let mut image = RgbImage::from_pixel(size[0], size[1], Rgb(LIGHT_BACKGROUND));
    for (i, map) in (0..).zip(maps) {
        let left_px = i * panel_px + MARGIN_PX;
        let full_scale = full_scale_mm(map.values);
        for (k, value) in (0..).zip(map.values) {
            let colour = if value.is_finite() { viridis(value / full_scale) } else { [255; 3] };
            image.put_pixel(left_px + k % width_px, STRIP_PX + k / width_px, Rgb(colour));
        }
        draw_text(&mut image, map.title, [left_px, 14], TextSize::Large, INK);
        let bar_height_px = height_px * 3 / 4;
        let bar = [left_px + width_px + 14, STRIP_PX + (height_px - bar_height_px) / 2];
        draw_bar(&mut image, bar, [BAR_WIDTH_PX, bar_height_px.max(2)], full_scale, INK);
    }
    draw_text(&mut image, caption, [MARGIN_PX, size[1] - STRIP_PX + 12], TextSize::Small, INK);
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_have_their_colours_and_holes_are_white() {
        let values = [0.0, 1.0, f32::NAN, 0.5];
        let maps = [PixelMap { title: "a", values: &values }, PixelMap { title: "b", values: &values }];
        let image = draw_maps(&maps, 2, "caption");
        assert_eq!(image.width(), 2 * (MARGIN_PX + 2 + LEGEND_WIDTH_PX));
        for left in [MARGIN_PX, MARGIN_PX + image.width() / 2] {
            let at = |x, y| image.get_pixel(left + x, STRIP_PX + y).0;
            assert_eq!([at(0, 0), at(1, 0), at(0, 1)], [viridis(0.0), viridis(1.0), [255; 3]]);
        }
    }
}
