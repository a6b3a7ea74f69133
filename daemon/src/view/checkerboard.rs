//! A checkerboard on the disk, pulled back onto the surface: squares stay square where the map is conformal.

use super::render::{LIGHT_BACKGROUND, RenderStyle, Surface, ViewFrame, ViewSide, render};
use glam::DVec2;
use gv3_codec::GreyPicture;
use gv3_codec::mesh::TriMesh;
use image::RgbImage;

/// Squares across the disk.
const SQUARES: u32 = 48;
/// Picture pixels a square.
const SQUARE_PX: u32 = 32;
const HEIGHT_PX: u32 = 1000;
const WIDTH_PX: [u32; 2] = [400, 1600];
const LEVELS: [u8; 2] = [70, 235];

/// Draws `mesh` with the checkerboard that its disk map carries to it.
///
/// # Panics
/// When `disk` has not one point a vertex.
pub fn checkerboard(mesh: &TriMesh, disk: &[DVec2], side: ViewSide) -> RgbImage {
    assert_eq!(disk.len(), mesh.vertex_count(), "one point of the disk a vertex");
    let covered = TriMesh { uv: Some(disk_uv(disk)), ..mesh.clone() };
    let frame = ViewFrame::fit(&[mesh], side);
    let width_px = ((HEIGHT_PX as f32 * frame.aspect()) as u32).clamp(WIDTH_PX[0], WIDTH_PX[1]);
    let style = RenderStyle { width_px, height_px: HEIGHT_PX, background: LIGHT_BACKGROUND };
    render(&covered, Surface::Texture(&board()), &frame, &style)
}

/// Texture coordinates of points of the disk: the square around it is 0..1.
pub fn disk_uv(disk: &[DVec2]) -> Vec<[f32; 2]> {
    disk.iter().map(|z| (z.as_vec2() * 0.5 + 0.5).to_array()).collect()
}

fn board() -> GreyPicture {
    let side_px = SQUARES * SQUARE_PX;
    let level = |i: u32| LEVELS[((i % side_px / SQUARE_PX + i / side_px / SQUARE_PX) % 2) as usize];
    GreyPicture::new(side_px, side_px, (0..side_px * side_px).map(level).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn a_flat_square_shows_as_many_squares_as_the_disk_has() {
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        let mesh = TriMesh {
            positions_mm: corners.map(|[x, y]: [f32; 2]| Vec3::new(x, y, 0.0) * 50.0).to_vec(),
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            uv: None,
        };
        let picture = checkerboard(&mesh, &corners.map(|[x, y]| DVec2::new(x.into(), y.into())), ViewSide::default());
        let row = picture.height() / 2 + 3;
        let dark = |x: u32| picture.get_pixel(x, row).0[0] < 128;
        let changes = (1..picture.width()).filter(|&x| dark(x) != dark(x - 1)).count() as u32;
        // Between neighbours, and one more where the first or last square is a dark one on the light ground.
        assert!((SQUARES - 1..=SQUARES + 1).contains(&changes), "{changes}");
        let columns =
            (0..picture.height()).filter(|&y| picture.get_pixel(picture.width() / 2 + 3, y).0[0] < 128).count();
        assert!(columns as u32 * 5 > picture.height() * 2);
    }
}
