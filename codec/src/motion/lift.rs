//! From a pixel of a scan's texture to the point of the surface that it shows.

use super::Mask;
use crate::mesh::{Place, TriMesh};
use crate::{CodecError, Result};
use glam::Vec3;
use std::sync::OnceLock;

/// Side of a look-up bin, px.
const BIN_PX: usize = 4;
/// Largest picture side.
const MAX_SIDE_PX: u32 = 1 << 14;
/// A point this far outside a triangle, in barycentric units, still counts as on its edge.
const EDGE_TOLERANCE: f64 = 1e-6;

/// Which triangle each pixel shows, and the exact place under any pixel position.
///
/// Where triangles overlap in the picture the one with the larger z (towards the scanner) is seen.
#[derive(Debug, Clone)]
pub struct PixelMap<'m> {
    mesh: &'m TriMesh,
    vertices_px: Vec<[f32; 2]>,
    width: usize,
    height: usize,
    triangle_at: Vec<u32>,
    z_mm: Vec<f32>,
    /// Sorted when a pixel is first lifted: most pictures of a run are drawn for their mask alone.
    bins: OnceLock<Bins>,
}

/// The triangles that touch each bin of the picture.
#[derive(Debug, Clone)]
struct Bins {
    /// Triangles that touch bin `b` are `triangles[starts[b]..starts[b + 1]]`.
    starts: Vec<u32>,
    triangles: Vec<u32>,
}

impl<'m> PixelMap<'m> {
    /// The map of a mesh whose `uv` points into a picture of `width_px * height_px`.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when the mesh is not valid or has no uv, when the picture is larger than 16384 px a side,
    /// or when the triangles cover each other in uv many times over.
    pub fn new(mesh: &'m TriMesh, width_px: u32, height_px: u32) -> Result<Self> {
        let Some(uv) = &mesh.uv else {
            return Err(CodecError::Mesh("no texture coordinates; map it through a FeatureFrame".into()));
        };
        let (w, h) = (width_px as f32, height_px as f32);
        let vertices_px = uv.iter().map(|t| [t[0] * w - 0.5, (1.0 - t[1]) * h - 0.5]).collect();
        Self::with_vertices_px(mesh, vertices_px, width_px, height_px)
    }

    /// The map of a mesh seen with its vertices at `vertices_px`; errors as [`Self::new`].
    pub(super) fn with_vertices_px(
        mesh: &'m TriMesh,
        vertices_px: Vec<[f32; 2]>,
        width_px: u32,
        height_px: u32,
    ) -> Result<Self> {
        mesh.validate()?;
        if width_px > MAX_SIDE_PX || height_px > MAX_SIDE_PX {
            return Err(CodecError::Mesh(format!(
                "picture of {width_px}x{height_px} px, at most {MAX_SIDE_PX} a side"
            )));
        }
        let (width, height) = (width_px as usize, height_px as usize);
        let mut map = Self {
            mesh,
            vertices_px,
            width,
            height,
            triangle_at: vec![u32::MAX; width * height],
            z_mm: vec![f32::NEG_INFINITY; width * height],
            bins: OnceLock::new(),
        };
        map.draw()?;
        Ok(map)
    }

    /// Triangle seen at the centre of each pixel, row-major, `u32::MAX` where there is none.
    pub fn triangles(&self) -> &[u32] {
        &self.triangle_at
    }

    /// Depth z at the centre of each pixel, mm, negative infinity where there is no surface.
    pub fn z_mm(&self) -> &[f32] {
        &self.z_mm
    }

    /// Position of each vertex in the picture, px.
    pub fn vertices_px(&self) -> &[[f32; 2]] {
        &self.vertices_px
    }

    /// The pixels whose centre shows the surface.
    pub fn mask(&self) -> Mask {
        let inside = self.triangle_at.iter().map(|&t| t != u32::MAX).collect();
        Mask::new(self.width as u32, self.height as u32, inside)
    }

    /// The place at a pixel position (pixel centres are integers, y down), `None` beside the surface.
    pub fn lift(&self, px: [f32; 2]) -> Option<Place> {
        let (x, y) = (px[0] + 0.5, px[1] + 0.5);
        if !(x >= 0.0 && y >= 0.0 && x < self.width as f32 && y < self.height as f32) {
            return None;
        }
        let bin = (y as usize / BIN_PX) * self.width.div_ceil(BIN_PX) + x as usize / BIN_PX;
        let bins = self.bins.get_or_init(|| self.sort_into_bins());
        let range = bins.starts[bin] as usize..bins.starts[bin + 1] as usize;
        let mut best: Option<(f32, Place)> = None;
        for &triangle in &bins.triangles[range] {
            let Some(planar) = Planar::of(self.corners_px(triangle as usize)) else { continue };
            let weights = planar.barycentric(f64::from(px[0]), f64::from(px[1]));
            // Said so that weights that are not numbers (a corner at infinity) are refused.
            if !weights.iter().all(|w| *w >= -EDGE_TOLERANCE) {
                continue;
            }
            let place = place(triangle, weights);
            let z_mm = place.position_mm(self.mesh).z;
            if best.is_none_or(|(nearest_mm, _)| z_mm > nearest_mm) {
                best = Some((z_mm, place));
            }
        }
        best.map(|(_, place)| place)
    }

    /// Position of the surface at a pixel position, mm, as [`Self::lift`].
    pub fn lift_mm(&self, px: [f32; 2]) -> Option<Vec3> {
        Some(self.lift(px)?.position_mm(self.mesh))
    }

    /// The place seen at the centre of a pixel, row-major; cheaper than [`Self::lift`] where all pixels are asked for.
    pub(super) fn seen(&self, pixel: usize) -> Option<Place> {
        let triangle = *self.triangle_at.get(pixel).filter(|t| **t != u32::MAX)?;
        let planar = Planar::of(self.corners_px(triangle as usize))?;
        let weights = planar.barycentric((pixel % self.width) as f64, (pixel / self.width) as f64);
        Some(place(triangle, weights))
    }

    fn corners_px(&self, triangle: usize) -> [[f32; 2]; 3] {
        self.mesh.triangles[triangle].map(|v| self.vertices_px[v as usize])
    }

    /// Rasters all triangles.
    fn draw(&mut self) -> Result<()> {
        let bins = self.width.div_ceil(BIN_PX) * self.height.div_ceil(BIN_PX);
        let limit = 8 * self.mesh.triangles.len() + 64 * bins;
        let mut entries = 0;
        for triangle in 0..self.mesh.triangles.len() {
            let corners = self.corners_px(triangle);
            let Some([x0, x1, y0, y1]) = bin_box(corners, self.width, self.height) else { continue };
            entries += usize::from(x1 - x0 + 1) * usize::from(y1 - y0 + 1);
            // Checked before the triangle is drawn: it bounds the time as well as the memory.
            if entries > limit || u32::try_from(entries).is_err() {
                return Err(CodecError::Mesh(format!(
                    "triangle {} and those before it cover the texture many times over; give the mesh a one-to-one uv",
                    triangle + 1
                )));
            }
            self.raster(triangle, corners);
        }
        Ok(())
    }

    /// Counting sort of the triangles by bin.
    fn sort_into_bins(&self) -> Bins {
        let columns = self.width.div_ceil(BIN_PX);
        let box_of = |triangle| bin_box(self.corners_px(triangle), self.width, self.height);
        let boxes: Vec<Option<[usize; 4]>> =
            (0..self.mesh.triangles.len()).map(|t| box_of(t).map(|b| b.map(usize::from))).collect();
        let mut starts = vec![0_u32; columns * self.height.div_ceil(BIN_PX) + 1];
        for [x0, x1, y0, y1] in boxes.iter().flatten() {
            for y in *y0..=*y1 {
                starts[y * columns + x0 + 1..=y * columns + x1 + 1].iter_mut().for_each(|count| *count += 1);
            }
        }
        for b in 1..starts.len() {
            starts[b] += starts[b - 1];
        }
        let mut next = starts.clone();
        let mut triangles = vec![0; starts[starts.len() - 1] as usize];
        for (triangle, bins) in boxes.iter().enumerate() {
            let Some([x0, x1, y0, y1]) = bins else { continue };
            for y in *y0..=*y1 {
                for place in &mut next[y * columns + x0..=y * columns + x1] {
                    triangles[*place as usize] = triangle as u32;
                    *place += 1;
                }
            }
        }
        Bins { starts, triangles }
    }

    /// Draws one triangle: pixels whose centre it covers, if nothing nearer to the scanner is there.
    fn raster(&mut self, triangle: usize, corners_px: [[f32; 2]; 3]) {
        let Some(planar) = Planar::of(corners_px) else { return };
        let (low, high) = box_of(corners_px);
        let first = low.map(|c| (c + 1.0).max(0.0) as usize);
        // An upper limit below 0 has no pixel; the cast would make it pixel 0.
        if high[0] < 0.0 || high[1] < 0.0 {
            return;
        }
        let last = [(high[0] as usize).min(self.width - 1), (high[1] as usize).min(self.height - 1)];
        let z = self.mesh.corners(triangle).map(|p| f64::from(p.z));
        for y in first[1]..=last[1] {
            for x in first[0]..=last[0] {
                let [a, b, c] = planar.barycentric(x as f64, y as f64);
                if a < -EDGE_TOLERANCE || b < -EDGE_TOLERANCE || c < -EDGE_TOLERANCE {
                    continue;
                }
                let (i, depth) = (y * self.width + x, (a * z[0] + b * z[1] + c * z[2]) as f32);
                if depth > self.z_mm[i] {
                    self.z_mm[i] = depth;
                    self.triangle_at[i] = triangle as u32;
                }
            }
        }
    }
}

fn place(triangle: u32, weights: [f64; 3]) -> Place {
    Place { triangle, barycentric: weights.map(|w| w.clamp(0.0, 1.0) as f32) }
}

/// Least and largest x and y, px, a thousandth wider than the corners.
fn box_of([a, b, c]: [[f32; 2]; 3]) -> ([f32; 2], [f32; 2]) {
    ([0, 1].map(|k| a[k].min(b[k]).min(c[k]) - 1e-3), [0, 1].map(|k| a[k].max(b[k]).max(c[k]) + 1e-3))
}

/// Bins {x0, x1, y0, y1}, ends included, that the box of a triangle touches; `None` beside the picture.
fn bin_box(corners_px: [[f32; 2]; 3], width: usize, height: usize) -> Option<[u16; 4]> {
    let (low, high) = box_of(corners_px);
    let (low, high) = (low.map(|c| c + 0.5), high.map(|c| c + 0.5));
    if high[0] < 0.0 || high[1] < 0.0 || low[0].max(0.0) >= width as f32 || low[1].max(0.0) >= height as f32 {
        return None;
    }
    let bin = |c: f32, side: usize| ((c.max(0.0) as usize).min(side - 1) / BIN_PX) as u16;
    Some([bin(low[0], width), bin(high[0], width), bin(low[1], height), bin(high[1], height)])
}

/// A triangle of the picture plane, ready for barycentric coordinates.
struct Planar {
    origin: [f64; 2],
    /// Gradients of the second and third barycentric coordinate.
    second: [f64; 2],
    third: [f64; 2],
}

impl Planar {
    /// `None` for a triangle without area.
    fn of(corners_px: [[f32; 2]; 3]) -> Option<Self> {
        let [a, b, c] = corners_px.map(|p| p.map(f64::from));
        let (u, v) = ([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]]);
        let area = u[0] * v[1] - u[1] * v[0];
        let inverse = 1.0 / area;
        (area.abs() > 1e-12).then_some(Self {
            origin: a,
            second: [v[1] * inverse, -v[0] * inverse],
            third: [-u[1] * inverse, u[0] * inverse],
        })
    }

    fn barycentric(&self, x: f64, y: f64) -> [f64; 3] {
        let (dx, dy) = (x - self.origin[0], y - self.origin[1]);
        let second = self.second[0] * dx + self.second[1] * dy;
        let third = self.third[0] * dx + self.third[1] * dy;
        [1.0 - second - third, second, third]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const W: u32 = 64;
    const H: u32 = 48;

    /// A grid of vertices `pitch_px` apart on a curved surface, uv into a 64x48 picture, first vertex at pixel (6, 5).
    fn grid(pitch_px: f32, columns: u32, rows: u32) -> TriMesh {
        let px = |i: u32| [6.0 + pitch_px * (i % columns) as f32, 5.0 + pitch_px * (i / columns) as f32];
        let n = columns * rows;
        let position = |i: u32| {
            let [x, y] = px(i);
            Vec3::new(0.5 * x, -0.5 * y, 3.0 * (x * 0.2).sin() + 2.0 * (y * 0.15).cos())
        };
        let cell = |i: u32| {
            let v = i / (columns - 1) * columns + i % (columns - 1);
            [[v, v + columns, v + 1], [v + 1, v + columns, v + columns + 1]]
        };
        TriMesh {
            positions_mm: (0..n).map(position).collect(),
            triangles: (0..(columns - 1) * (rows - 1)).flat_map(cell).collect(),
            uv: Some((0..n).map(|i| [(px(i)[0] + 0.5) / W as f32, 1.0 - (px(i)[1] + 0.5) / H as f32]).collect()),
        }
    }

    #[test]
    fn vertices_lift_to_themselves_on_any_density() {
        for (pitch, columns, rows) in [(1.0, 40, 30), (0.3, 120, 90), (3.7, 12, 9)] {
            let mesh = grid(pitch, columns, rows);
            let map = PixelMap::new(&mesh, W, H).unwrap();
            for (v, p) in mesh.positions_mm.iter().enumerate() {
                let (x, y) = (v as u32 % columns, v as u32 / columns);
                if x == 0 || y == 0 || x == columns - 1 || y == rows - 1 {
                    continue;
                }
                let lifted = map.lift(map.vertices_px()[v]).unwrap();
                assert!(lifted.position_mm(&mesh).distance(*p) < 1e-3);
            }
        }
    }

    #[test]
    fn mask_is_the_covered_rectangle() {
        let mesh = grid(1.0, 40, 30);
        let map = PixelMap::new(&mesh, W, H).unwrap();
        let mask = map.mask();
        for (i, inside) in mask.inside.iter().enumerate() {
            let (x, y) = (i as u32 % W, i as u32 / W);
            // The outermost centres lie on the border itself, where rounding of the uv decides.
            let sure = (7..45).contains(&x) && (6..34).contains(&y);
            let possible = (6..=45).contains(&x) && (5..=34).contains(&y);
            assert!(if *inside { possible } else { !sure }, "{x} {y}");
            assert_eq!(*inside, map.triangles()[i] != u32::MAX);
        }
        assert!(
            map.lift([3.0, 20.0]).is_none() && map.lift([-5.0, 1e9]).is_none() && map.lift([f32::NAN, 3.0]).is_none()
        );
    }

    #[test]
    fn of_two_layers_the_one_towards_the_scanner_is_seen() {
        let mut mesh = grid(3.0, 12, 9);
        let n = mesh.vertex_count() as u32;
        let back = mesh.clone();
        mesh.positions_mm.extend(back.positions_mm.iter().map(|p| *p - Vec3::Z * 30.0));
        mesh.triangles.splice(0..0, back.triangles.iter().map(|t| t.map(|v| v + n)));
        mesh.uv.as_mut().unwrap().extend(back.uv.unwrap());
        let map = PixelMap::new(&mesh, W, H).unwrap();
        assert!(map.lift([20.3, 15.6]).unwrap().position_mm(&mesh).z > -6.0);
        assert!(map.z_mm()[16 * W as usize + 20] > -6.0);
    }

    #[test]
    fn bad_meshes_are_errors() {
        let mesh = grid(1.0, 10, 10);
        assert!(PixelMap::new(&mesh, 1 << 20, 4).is_err());
        assert!(PixelMap::new(&TriMesh { uv: None, ..mesh.clone() }, W, H).is_err());
        let mut torn = mesh.clone();
        torn.triangles[7][1] = 1000;
        assert!(PixelMap::new(&torn, W, H).is_err());
        // Every triangle over the whole picture.
        let mut heap = grid(0.2, 200, 150);
        heap.uv.as_mut().unwrap().iter_mut().enumerate().for_each(|(i, t)| *t = [(i % 2) as f32, (i / 200 % 2) as f32]);
        assert!(PixelMap::new(&heap, 2000, 2000).unwrap_err().to_string().contains("one-to-one"));
        let far = TriMesh { uv: Some(vec![[3e38, -3e38]; mesh.vertex_count()]), ..mesh.clone() };
        assert!(PixelMap::new(&far, W, H).unwrap().mask().inside.iter().all(|i| !i));
        let mut half_far = mesh.clone();
        half_far.uv.as_mut().unwrap()[15] = [3e38, 3e38];
        let map = PixelMap::new(&half_far, W, H).unwrap();
        assert!(
            (0..W * H)
                .filter_map(|i| map.lift([(i % W) as f32, (i / W) as f32]))
                .all(|p| p.position_mm(&half_far).is_finite())
        );
        assert!(PixelMap::new(&far, 0, 0).unwrap().lift([0.0, 0.0]).is_none());
    }

    proptest! {
        #[test]
        fn a_point_of_a_triangle_lifts_back_to_it(
            t in 0_usize..2 * 39 * 29,
            a in 0.0_f32..1.0,
            b in 0.0_f32..1.0,
            pitch in 0.25_f32..1.0,
        ) {
            let mesh = grid(pitch, 40, 30);
            let map = PixelMap::new(&mesh, W, H).unwrap();
            let (a, b) = if a + b > 1.0 { (1.0 - a, 1.0 - b) } else { (a, b) };
            let weights = [1.0 - a - b, a, b].map(|w| 0.94 * w + 0.02);
            let corners = map.corners_px(t);
            let px = [0, 1].map(|k| (0..3).map(|c| weights[c] * corners[c][k]).sum::<f32>());
            let lifted = map.lift(px).unwrap();
            prop_assert_eq!(lifted.triangle as usize, t);
            let [p, q, r] = mesh.corners(t);
            let want = p * weights[0] + q * weights[1] + r * weights[2];
            prop_assert!(lifted.position_mm(&mesh).distance(want) < 1e-3);
            prop_assert!((lifted.barycentric.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }
}
