//! Scans without texture: a picture of their relief, in which the same tracker follows the shape of the skin.

use super::{FloatPicture, Mask, PixelMap, high_pass, normalize};
use crate::{CodecError, GreyPicture, Result, mesh::TriMesh};

/// Longer side of a frame, margin included, at most.
const MAX_SIDE_PX: f32 = 640.0;
/// Room on each side of the first scan for the motion of a run, as a share of its larger extent.
const MARGIN: f32 = 0.12;
/// Relief is what a Gaussian of this width takes away: narrow, since the slope of the face enters where the Gaussian is cut
/// by the border of the scan.
const RELIEF_SIGMA_PX: f32 = 3.0;
/// Detail finer than this is noise, and changes with the place of the scan's vertices on the skin.
const NOISE_SIGMA_PX: f32 = 1.4;
/// The strength of the relief is made even over this width.
const CONTRAST_SIGMA_PX: f32 = 8.0;
/// Relief weaker than this stays weak, mm².
const RELIEF_FLOOR_MM2: f32 = 0.02 * 0.02;

/// The pixel grid of an orthographic view along -z of the scan frame, the same for all scans of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeatureFrame {
    /// x and y of the centre of pixel (0, 0), mm; y of the scan frame points up, rows go down.
    pub origin_mm: [f32; 2],
    /// Pixel pitch, mm.
    pub pixel_mm: f32,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
}

/// What a [`FeatureFrame`] shows of one scan.
#[derive(Debug, Clone)]
pub struct FeatureView<'m> {
    /// Locally normalised relief, 0 outside the mask, for a [`Tracker`](super::Tracker) with
    /// [`TrackerOptions::relief`](super::TrackerOptions::relief).
    pub relief: FloatPicture,
    /// Pixels that show the surface.
    pub mask: Mask,
    /// Lifts pixels of the relief to the surface.
    pub map: PixelMap<'m>,
}

impl FeatureFrame {
    /// A frame about the first scan of a run, with a margin for motion, its pixels about as large as the spacing of the
    /// vertices (larger where 640 px would not hold the scan).
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when the mesh is not valid or shows no area along z.
    pub fn about(mesh: &TriMesh) -> Result<Self> {
        // Two triangles a vertex: on a grid this is the pitch.
        Self::with_least_pixel(mesh, |seen_mm2| (2.0 * seen_mm2 / mesh.triangles.len().max(1) as f64).sqrt() as f32)
    }

    /// As [`Self::about`] with 640 px along the longer side, for textures, which are finer than the mesh.
    ///
    /// # Errors
    /// As [`Self::about`].
    pub fn for_texture(mesh: &TriMesh) -> Result<Self> {
        Self::with_least_pixel(mesh, |seen_mm2| if seen_mm2 > 0.0 { f32::MIN_POSITIVE } else { 0.0 })
    }

    /// `least_pixel_mm` gives the smallest pixel from the area seen along z, mm².
    fn with_least_pixel(mesh: &TriMesh, least_pixel_mm: impl Fn(f64) -> f32) -> Result<Self> {
        mesh.validate()?;
        let (low, high) = mesh.bounds_mm();
        let seen_mm2: f64 = (0..mesh.triangles.len()).map(|t| 0.5 * f64::from(mesh.area_normal(t).z.abs())).sum();
        let extent = (high - low).truncate();
        let spacing_mm = least_pixel_mm(seen_mm2);
        if !(spacing_mm > 0.0 && extent.max_element().is_finite()) {
            return Err(CodecError::Mesh("no area is seen along z; turn the scan towards the scanner".into()));
        }
        let margin_mm = MARGIN * extent.max_element();
        let size_mm = extent + 2.0 * margin_mm;
        let pixel_mm = spacing_mm.max(size_mm.max_element() / MAX_SIDE_PX);
        let [width_px, height_px] = [size_mm.x, size_mm.y].map(|s| (s / pixel_mm).ceil().max(1.0) as u32);
        Ok(Self { origin_mm: [low.x - margin_mm, high.y + margin_mm], pixel_mm, width_px, height_px })
    }

    /// Texture coordinates (u right, v up, 0..1 over the frame) of each vertex.
    pub fn uv(&self, mesh: &TriMesh) -> Vec<[f32; 2]> {
        let (w, h) = (self.width_px as f32, self.height_px as f32);
        self.vertices_px(mesh).iter().map(|px| [(px[0] + 0.5) / w, 1.0 - (px[1] + 0.5) / h]).collect()
    }

    /// The relief of a scan, its mask, and the way back to the surface.
    ///
    /// # Errors
    /// As [`PixelMap::new`].
    pub fn view<'m>(&self, mesh: &'m TriMesh) -> Result<FeatureView<'m>> {
        let map = self.map(mesh)?;
        let mask = map.mask();
        let depth = FloatPicture::new(self.width_px, self.height_px, map.z_mm().to_vec());
        let mut relief = high_pass(&depth, &mask, RELIEF_SIGMA_PX);
        let noise = high_pass(&relief, &mask, NOISE_SIGMA_PX);
        relief.pixels.iter_mut().zip(&noise.pixels).for_each(|(r, n)| *r -= n);
        let relief = normalize(&relief, &mask, CONTRAST_SIGMA_PX, RELIEF_FLOOR_MM2);
        Ok(FeatureView { relief, mask, map })
    }

    /// The way from this frame's pixels to the surface of a scan.
    ///
    /// # Errors
    /// As [`PixelMap::new`].
    pub fn map<'m>(&self, mesh: &'m TriMesh) -> Result<PixelMap<'m>> {
        PixelMap::with_vertices_px(mesh, self.vertices_px(mesh), self.width_px, self.height_px)
    }

    /// The texture of a scan as this frame shows it (level 0 beside the surface), and the way back to the surface: for
    /// textures that no camera took, in which neighbours on the skin may lie apart.
    ///
    /// # Errors
    /// As [`PixelMap::new`], and [`CodecError::Mesh`] for a mesh without texture coordinates or an empty picture.
    pub fn view_texture<'m>(&self, mesh: &'m TriMesh, texture: &GreyPicture) -> Result<(GreyPicture, PixelMap<'m>)> {
        let Some(uv) = mesh.uv.as_ref().filter(|_| !texture.pixels.is_empty()) else {
            return Err(CodecError::Mesh("no texture; view the relief instead".into()));
        };
        let map = self.map(mesh)?;
        let level = |pixel| {
            let Some(point) = map.seen(pixel) else { return 0 };
            let corners = mesh.triangles[point.triangle as usize].map(|v| uv[v as usize]);
            let along = |k: usize| (0..3).map(|c| corners[c][k] * point.barycentric[c]).sum::<f32>();
            texture.sample(texture.uv_to_px([along(0), along(1)])).round() as u8
        };
        let pixels = (0..map.triangles().len()).map(level).collect();
        Ok((GreyPicture::new(self.width_px, self.height_px, pixels), map))
    }

    fn vertices_px(&self, mesh: &TriMesh) -> Vec<[f32; 2]> {
        let to_px = 1.0 / self.pixel_mm;
        let place = |p: &glam::Vec3| [(p.x - self.origin_mm[0]) * to_px, (self.origin_mm[1] - p.y) * to_px];
        mesh.positions_mm.iter().map(place).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::test_texture::median;
    use crate::motion::{Tracker, TrackerOptions};
    use glam::Vec3;

    /// A dome with pores, seen on a 0.5 mm grid of 120x100 vertices, moved sideways by `shift_mm` under the scanner.
    fn dome(shift_mm: Vec3) -> TriMesh {
        let (columns, rows) = (120_u32, 100_u32);
        let position = |i: u32| {
            let (x, y) = (0.5 * (i % columns) as f32 - 30.0, 0.5 * (i / columns) as f32 - 25.0);
            let (u, v) = (x - shift_mm.x, y - shift_mm.y);
            let pores = (2.1 * u + 0.6 * v).sin()
                + (1.2 * u - 1.7 * v).cos()
                + (0.4 * u + 2.4 * v).sin()
                + (1.5 * u + 1.3 * v).cos();
            Vec3::new(x, y, shift_mm.z - 0.01 * (u * u + v * v) + 0.04 * pores)
        };
        let cell = |i: u32| {
            let v = i / (columns - 1) * columns + i % (columns - 1);
            [[v, v + 1, v + columns], [v + 1, v + columns + 1, v + columns]]
        };
        TriMesh {
            positions_mm: (0..columns * rows).map(position).collect(),
            triangles: (0..(columns - 1) * (rows - 1)).flat_map(cell).collect(),
            uv: None,
        }
    }

    #[test]
    fn relief_is_followed_and_lifts_to_the_moved_point() {
        let shift = Vec3::new(0.83, -0.41, 0.6);
        let (first, second) = (dome(Vec3::ZERO), dome(shift));
        let frame = FeatureFrame::about(&first).unwrap();
        assert!((frame.pixel_mm - 0.5).abs() < 0.01);
        let (a, b) = (frame.view(&first).unwrap(), frame.view(&second).unwrap());
        let mut tracker = Tracker::new(TrackerOptions::relief());
        tracker.feed_normalized(&a.relief, &a.mask, true);
        let before = tracker.tracks().to_vec();
        tracker.feed_normalized(&b.relief, &b.mask, true);
        let error = |t: &crate::motion::Track| {
            let from = before.iter().find(|o| o.id == t.id)?;
            let (p, q) = (a.map.lift_mm(from.px)?, b.map.lift_mm(t.px)?);
            Some(q.distance(p + shift))
        };
        let errors: Vec<f32> = tracker.tracks().iter().filter_map(error).collect();
        assert!(errors.len() * 10 >= before.len() * 9 && before.len() > 40, "{} of {}", errors.len(), before.len());
        assert!(median(&errors) < 0.05, "{} mm", median(&errors));
    }

    #[test]
    fn uv_and_map_agree_and_v_points_up() {
        let mesh = dome(Vec3::ZERO);
        let frame = FeatureFrame::about(&mesh).unwrap();
        let view = frame.view(&mesh).unwrap();
        let with_uv = TriMesh { uv: Some(frame.uv(&mesh)), ..mesh.clone() };
        let map = PixelMap::new(&with_uv, frame.width_px, frame.height_px).unwrap();
        for (p, q) in map.vertices_px().iter().zip(view.map.vertices_px()) {
            assert!((p[0] - q[0]).abs() < 1e-3 && (p[1] - q[1]).abs() < 1e-3);
        }
        let uv = with_uv.uv.unwrap();
        assert!(uv[0][1] < uv[uv.len() - 1][1] && uv.iter().flatten().all(|c| (0.0..=1.0).contains(c)));
    }

    #[test]
    fn meshes_without_a_view_are_errors_and_large_ones_get_larger_pixels() {
        assert!(FeatureFrame::about(&TriMesh::default()).is_err());
        let mut edge_on = dome(Vec3::ZERO);
        edge_on.positions_mm.iter_mut().for_each(|p| p.x = 0.0);
        assert!(FeatureFrame::about(&edge_on).is_err());
        let mut wide = dome(Vec3::ZERO);
        wide.positions_mm[0] = Vec3::new(-4000.0, -25.0, 0.0);
        let frame = FeatureFrame::about(&wide).unwrap();
        assert!(frame.width_px <= 641 && frame.height_px <= 641 && frame.pixel_mm > 5.0);
    }
}
