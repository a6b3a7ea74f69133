//! The part of the camera's picture that a run needs: pixels that never see the surface cost time and memory.

use crate::{GreyPicture, Scan};

/// Room around the first scan for the motion of the run, px.
const MARGIN_PX: f32 = 48.0;
/// A cut that leaves more than this of the picture is not worth it.
const WORTH: f64 = 0.85;

/// A rectangle of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Rectangle {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
}

/// Cuts the pictures of a run; the rectangle stays until a scan leaves it, so that tracked points do not jump.
#[derive(Debug, Clone, Copy, Default)]
pub struct Crop {
    rectangle: Option<Rectangle>,
}

impl Crop {
    /// The scan with its picture cut, texture coordinates with it; as it is where there is little to cut.
    pub fn apply(&mut self, mut scan: Scan) -> Scan {
        let (Some(picture), Some(uv)) = (&scan.texture, &scan.mesh.uv) else { return scan };
        let Some(bounds) = bounds(uv.iter().map(|t| picture.uv_to_px(*t))) else { return scan };
        let rectangle =
            self.rectangle.filter(|r| r.holds(bounds, picture)).unwrap_or_else(|| Rectangle::about(bounds, picture));
        self.rectangle = Some(rectangle);
        let area = |w: u32, h: u32| f64::from(w) * f64::from(h);
        if area(rectangle.width, rectangle.height) > WORTH * area(picture.width_px, picture.height_px) {
            return scan;
        }
        let cut = rectangle.cut(picture);
        let offset = [rectangle.x as f32, rectangle.y as f32];
        let uv = uv.iter().map(|t| {
            let px = picture.uv_to_px(*t);
            cut.px_to_uv([px[0] - offset[0], px[1] - offset[1]])
        });
        scan.mesh.uv = Some(uv.collect());
        scan.texture = Some(cut);
        scan
    }
}

/// Smallest and largest coordinates.
fn bounds(px: impl Iterator<Item = [f32; 2]>) -> Option<[[f32; 2]; 2]> {
    let start = [[f32::INFINITY; 2], [f32::NEG_INFINITY; 2]];
    let [low, high] =
        px.fold(start, |[low, high], p| [[low[0].min(p[0]), low[1].min(p[1])], [high[0].max(p[0]), high[1].max(p[1])]]);
    (low[0] <= high[0] && low[1] <= high[1]).then_some([low, high])
}

impl Rectangle {
    fn about([low, high]: [[f32; 2]; 2], picture: &GreyPicture) -> Self {
        let size = [picture.width_px, picture.height_px];
        let from = [0, 1].map(|k| ((low[k] - MARGIN_PX).max(0.0) as u32).min(size[k] - 1));
        let to = [0, 1].map(|k| ((high[k] + MARGIN_PX).max(0.0).ceil() as u32 + 1).clamp(from[k] + 1, size[k]));
        Self { x: from[0], y: from[1], width: to[0] - from[0], height: to[1] - from[1] }
    }

    /// True when the bounds lie inside, or outside the picture itself.
    fn holds(&self, [low, high]: [[f32; 2]; 2], picture: &GreyPicture) -> bool {
        let inside = |k: usize, from: u32, length: u32, size: u32| {
            let last = (from + length - 1) as f32;
            from + length <= size && low[k].max(0.0) >= from as f32 && high[k].min((size - 1) as f32) <= last
        };
        inside(0, self.x, self.width, picture.width_px) && inside(1, self.y, self.height, picture.height_px)
    }

    fn cut(&self, picture: &GreyPicture) -> GreyPicture {
        let row = |y: u32| {
            let start = ((self.y + y) * picture.width_px + self.x) as usize;
            &picture.pixels[start..start + self.width as usize]
        };
        let pixels = (0..self.height).flat_map(|y| row(y).iter().copied()).collect();
        GreyPicture::new(self.width, self.height, pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::TriMesh;
    use glam::Vec3;

    fn scan(at: [f32; 2]) -> Scan {
        let picture = GreyPicture::new(640, 480, (0..640 * 480).map(|i| (i * 7 / 5) as u8).collect());
        let px = [at, [at[0] + 90.0, at[1]], [at[0], at[1] + 60.0]];
        let uv = Some(px.iter().map(|p| picture.px_to_uv(*p)).collect());
        let mesh = TriMesh { positions_mm: vec![Vec3::ZERO, Vec3::X, Vec3::Y], triangles: vec![[0, 1, 2]], uv };
        Scan { mesh, texture: Some(picture), ..Scan::default() }
    }

    #[test]
    fn vertices_keep_their_grey_levels_and_the_cut_stays_until_it_is_left() {
        let mut crop = Crop::default();
        let mut sizes = Vec::new();
        for at in [[200.0, 150.0], [220.0, 140.0], [400.0, 150.0]] {
            let whole = scan(at);
            let cut = crop.apply(whole.clone());
            let (a, b) = (whole.texture.unwrap(), cut.texture.unwrap());
            for (s, t) in whole.mesh.uv.unwrap().iter().zip(cut.mesh.uv.unwrap()) {
                assert!((a.sample(a.uv_to_px(*s)) - b.sample(b.uv_to_px(t))).abs() < 0.1);
            }
            sizes.push([b.width_px, b.height_px, crop.rectangle.unwrap().x]);
        }
        assert_eq!(sizes[0], [187, 157, 152]);
        assert_eq!(sizes[1], sizes[0]);
        assert_eq!(sizes[2][2], 352);
    }

    #[test]
    fn a_scan_that_fills_its_picture_stays() {
        let mut whole = scan([0.0, 0.0]);
        whole.mesh.uv = Some(vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]);
        let kept = Crop::default().apply(whole.clone());
        assert_eq!(kept.texture, whole.texture);
    }
}
