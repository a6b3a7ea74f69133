//! Scan, replay and the error between them, side by side in one picture.

use super::colour_map::{draw_bar, error_colours, full_scale_mm};
use super::render::{LIGHT_BACKGROUND, RenderStyle, Surface, ViewFrame, ViewSide, render};
use super::text::{TextSize, draw_text};
use gv3_codec::GreyPicture;
use gv3_codec::mesh::TriMesh;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, Rgb, RgbImage, imageops};

/// Height of the panels.
const PANEL_HEIGHT_PX: u32 = 760;
/// Least and greatest width of a panel.
const PANEL_WIDTH_PX: [u32; 2] = [360, 1000];
/// Strip above the panels for titles, below for the caption.
const STRIP_PX: u32 = 48;
const BAR_WIDTH_PX: u32 = 22;
/// Room right of the panels for the bar and its labels.
const LEGEND_WIDTH_PX: u32 = 140;
const INK: [u8; 3] = [40, 42, 48];

/// What a comparison shows.
#[derive(Debug, Clone, Copy)]
pub struct Comparison<'a> {
    /// The scan.
    pub scan: &'a TriMesh,
    /// Its texture; both meshes are drawn as clay when one texture is missing.
    pub scan_texture: Option<&'a GreyPicture>,
    /// The scan as decoded.
    pub replay: &'a TriMesh,
    /// Its texture.
    pub replay_texture: Option<&'a GreyPicture>,
    /// Distance of each vertex of the scan to the replay, mm; NaN where unknown.
    pub error_mm: &'a [f32],
    /// Error that gets the brightest colour; the 99th percentile, rounded up, when none.
    pub full_scale_mm: Option<f32>,
    /// Line below the panels, such as name, time and numbers.
    pub caption: &'a str,
    /// From where the meshes are seen.
    pub side: ViewSide,
}

impl Comparison<'_> {
    /// Draws the picture.
    ///
    /// # Panics
    /// When `error_mm` has not one number for each vertex of the scan.
    pub fn draw(&self) -> RgbImage {
        let frame = ViewFrame::fit(&[self.scan, self.replay], self.side);
        let wanted_px = PANEL_HEIGHT_PX as f32 * frame.aspect();
        let width_px = (wanted_px as u32).clamp(PANEL_WIDTH_PX[0], PANEL_WIDTH_PX[1]);
        let style = RenderStyle { width_px, height_px: PANEL_HEIGHT_PX, background: LIGHT_BACKGROUND };
        let full_scale = self.full_scale_mm.unwrap_or_else(|| full_scale_mm(self.error_mm));
        let colours = error_colours(self.error_mm, full_scale);
        let (scan, replay) = match (self.scan_texture, self.replay_texture) {
            (Some(a), Some(b)) => (Surface::Texture(a), Surface::Texture(b)),
            _ => (Surface::Clay, Surface::Clay),
        };
        let panels = [
            ("scan", self.scan, scan),
            ("replay", self.replay, replay),
            ("error, mm", self.scan, Surface::Colours(&colours)),
        ];
        let size = [3 * width_px + LEGEND_WIDTH_PX, PANEL_HEIGHT_PX + 2 * STRIP_PX];
        let mut image = RgbImage::from_pixel(size[0], size[1], Rgb(LIGHT_BACKGROUND));
        for (i, (title, mesh, surface)) in (0..).zip(panels) {
            let left_px = i * width_px;
            let panel = render(mesh, surface, &frame, &style);
            imageops::replace(&mut image, &panel, i64::from(left_px), i64::from(STRIP_PX));
            let title_left_px = left_px + (width_px - TextSize::Large.width_px(title)) / 2;
            draw_text(&mut image, title, [title_left_px, 14], TextSize::Large, INK);
        }
        let bar_height_px = PANEL_HEIGHT_PX * 3 / 4;
        let bar = [3 * width_px + 14, STRIP_PX + (PANEL_HEIGHT_PX - bar_height_px) / 2];
        draw_bar(&mut image, bar, [BAR_WIDTH_PX, bar_height_px], full_scale, INK);
        draw_text(&mut image, self.caption, [18, size[1] - STRIP_PX + 12], TextSize::Small, INK);
        image
    }
}

/// A picture as a PNG file.
///
/// # Panics
/// Never for pictures made here: their size is within the format's.
pub fn png_bytes(image: &RgbImage) -> Vec<u8> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(image, image.width(), image.height(), ExtendedColorType::Rgb8)
        .expect("a picture in memory, written to memory");
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::colour_map::viridis;
    use glam::Vec3;

    #[test]
    fn three_panels_and_a_bar() {
        let mesh = TriMesh {
            positions_mm: vec![Vec3::ZERO, Vec3::X, Vec3::ONE.with_z(0.0), Vec3::Y],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            uv: Some(vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        };
        let grey = GreyPicture::filled(4, 4, 100);
        let comparison = Comparison {
            scan: &mesh,
            scan_texture: Some(&grey),
            replay: &mesh,
            replay_texture: Some(&grey),
            error_mm: &[0.0, 0.0, 0.02, 0.02],
            full_scale_mm: None,
            caption: "frame 12",
            side: ViewSide::default(),
        };
        let image = comparison.draw();
        assert_eq!(image.dimensions(), (3 * 760 + 140, 760 + 96));
        let middle = |panel: u32| image.get_pixel(panel * 760 + 380, 428).0;
        assert_eq!(middle(0), middle(1));
        assert!(middle(0)[0] == middle(0)[1] && middle(2)[0] != middle(2)[1]);
        let bar = [3 * 760 + 20, 48 + 95];
        assert_eq!(image.get_pixel(bar[0], bar[1]).0, viridis(1.0));
        let png = png_bytes(&image);
        assert_eq!(image::load_from_memory(&png).unwrap().to_rgb8(), image);
    }
}
