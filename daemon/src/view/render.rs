//! A small software renderer: one mesh, one light, a depth buffer, four samples a pixel.

use glam::{Mat3, Vec3};
use gv3_codec::GreyPicture;
use gv3_codec::mesh::TriMesh;
use image::{Rgb, RgbImage};

/// Samples a pixel along each axis.
const SAMPLES: usize = 2;
/// Share of the picture that the fitted meshes span.
const FILL: f32 = 0.94;
/// Light direction in view axes: a headlight, a little up and to the left so that relief reads.
const LIGHT: Vec3 = Vec3::new(-0.25, 0.35, 0.9);

/// Where the camera stands and how much it sees; shared by meshes whose pictures are to register.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewFrame {
    /// Rows: right, up, towards the eye.
    view_from_mesh: Mat3,
    centre_mm: Vec3,
    half_width_mm: f32,
    half_height_mm: f32,
    /// Distance from the centre; infinite for an orthographic view.
    eye_mm: f32,
}

/// From which side a view is taken.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ViewSide {
    /// Turn to the mesh's left, radians; zero is the front.
    pub yaw_rad: f32,
    /// Rise above it, radians.
    pub pitch_rad: f32,
    /// Perspective instead of an orthographic view, from three times the meshes' size.
    pub is_perspective: bool,
}

impl ViewFrame {
    /// The view that fits all of `meshes`.
    ///
    /// The front is the side that most of the surface faces: a scan in camera axes (y down, z forward) is seen upright
    /// from its camera, one in model axes (y up) from +z.
    pub fn fit(meshes: &[&TriMesh], side: ViewSide) -> Self {
        let view_from_mesh =
            Mat3::from_rotation_x(side.pitch_rad) * Mat3::from_rotation_y(-side.yaw_rad) * front(meshes);
        let points = || meshes.iter().flat_map(|m| &m.positions_mm).map(|&p| view_from_mesh * p);
        let (low, high) =
            points().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
        let (low, high) = if low.x <= high.x { (low, high) } else { (Vec3::NEG_ONE, Vec3::ONE) };
        let centre = (low + high) / 2.0;
        let size = (high - low).max_element().max(1e-6);
        let eye_mm = if side.is_perspective { 3.0 * size } else { f32::INFINITY };
        let half = points().fold(Vec3::splat(size * 1e-3), |half, p| {
            let p = p - centre;
            half.max(p.abs() / (1.0 - p.z / eye_mm))
        });
        let centre_mm = view_from_mesh.transpose() * centre;
        Self { view_from_mesh, centre_mm, half_width_mm: half.x, half_height_mm: half.y, eye_mm }
    }

    /// Width over height of what the view shows.
    pub fn aspect(&self) -> f32 {
        self.half_width_mm / self.half_height_mm
    }

    /// Position on the picture (x, y in samples) and height towards the eye.
    pub(super) fn project(&self, p: Vec3, width: usize, height: usize) -> Vec3 {
        let scale = FILL * (width as f32 / self.half_width_mm).min(height as f32 / self.half_height_mm) / 2.0;
        let p = self.view_from_mesh * (p - self.centre_mm);
        let scale = scale / (1.0 - p.z / self.eye_mm);
        Vec3::new(width as f32 / 2.0 + p.x * scale, height as f32 / 2.0 - p.y * scale, p.z)
    }
}

fn front(meshes: &[&TriMesh]) -> Mat3 {
    let facing: f64 =
        meshes.iter().map(|m| (0..m.triangles.len()).map(|t| f64::from(m.area_normal(t).z)).sum::<f64>()).sum();
    if facing < 0.0 { Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0)) } else { Mat3::IDENTITY }
}

/// What covers a mesh.
#[derive(Debug, Clone, Copy)]
pub enum Surface<'a> {
    /// Plain shaded clay.
    Clay,
    /// One colour a vertex, lightly shaded.
    Colours(&'a [[u8; 3]]),
    /// A grey picture through the mesh's texture coordinates, lightly shaded; clay where it has none.
    Texture(&'a GreyPicture),
}

/// Size and ground of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RenderStyle {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Colour behind the mesh.
    pub background: [u8; 3],
}

/// Neutral light ground.
pub const LIGHT_BACKGROUND: [u8; 3] = [246, 246, 248];
/// Neutral dark ground.
pub const DARK_BACKGROUND: [u8; 3] = [32, 33, 36];

/// Draws one mesh. Both sides of the surface are lit.
///
/// # Panics
/// When `surface` is colours, and not one a vertex.
pub fn render(mesh: &TriMesh, surface: Surface<'_>, frame: &ViewFrame, style: &RenderStyle) -> RgbImage {
    let (width, height) = (style.width_px as usize * SAMPLES, style.height_px as usize * SAMPLES);
    let mut canvas = Canvas {
        width,
        height,
        depth: vec![f32::NEG_INFINITY; width * height],
        colour: vec![style.background; width * height],
    };
    let points: Vec<Vec3> = mesh.positions_mm.iter().map(|&p| frame.project(p, width, height)).collect();
    let shades = mesh.vertex_normals().into_iter().map(|n| lambert(frame.view_from_mesh * n));
    match (surface, &mesh.uv) {
        (Surface::Texture(picture), Some(uv)) => {
            let values: Vec<Vec3> =
                uv.iter().zip(shades).map(|(t, s)| Vec3::new(t[0], t[1], 0.85 + 0.15 * s)).collect();
            canvas.draw(mesh, &points, &values, |value| {
                let grey = picture.sample(picture.uv_to_px([value.x, value.y])) * value.z;
                [grey as u8; 3]
            });
        }
        (Surface::Colours(colours), _) => {
            assert_eq!(colours.len(), mesh.vertex_count(), "one colour a vertex");
            let rgb = |c: &[u8; 3]| Vec3::from_array(c.map(f32::from));
            let values: Vec<Vec3> = colours.iter().zip(shades).map(|(c, s)| rgb(c) * (0.72 + 0.28 * s)).collect();
            canvas.draw(mesh, &points, &values, |value| value.to_array().map(|x| x as u8));
        }
        _ => {
            let values: Vec<Vec3> = shades.map(|s| Vec3::new(226.0, 221.0, 212.0) * (0.16 + 0.84 * s)).collect();
            canvas.draw(mesh, &points, &values, |value| value.to_array().map(|x| x as u8));
        }
    }
    canvas.picture(style)
}

/// Lambert's law for a surface that may be seen from either side.
fn lambert(normal: Vec3) -> f32 {
    let facing = if normal.z < 0.0 { -normal } else { normal };
    facing.dot(LIGHT.normalize()).max(0.0)
}

struct Canvas {
    width: usize,
    height: usize,
    depth: Vec<f32>,
    colour: Vec<[u8; 3]>,
}

impl Canvas {
    fn draw(&mut self, mesh: &TriMesh, points: &[Vec3], values: &[Vec3], colour: impl Fn(Vec3) -> [u8; 3]) {
        for triangle in &mesh.triangles {
            let corners = triangle.map(|v| points[v as usize]);
            self.triangle(corners, triangle.map(|v| values[v as usize]), &colour);
        }
    }

    /// Fills the samples whose centres lie in a triangle and in front of what is there.
    fn triangle(&mut self, [a, b, c]: [Vec3; 3], values: [Vec3; 3], colour: &impl Fn(Vec3) -> [u8; 3]) {
        let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        if area == 0.0 || !area.is_finite() {
            return;
        }
        let columns = clamp(low.x, self.width)..clamp(high.x + 1.0, self.width);
        for y in clamp(low.y, self.height)..clamp(high.y + 1.0, self.height) {
            let sample_y = y as f32 + 0.5;
            for x in columns.clone() {
                let sample_x = x as f32 + 0.5;
                let weight_b = ((sample_x - a.x) * (c.y - a.y) - (sample_y - a.y) * (c.x - a.x)) / area;
                let weight_c = ((b.x - a.x) * (sample_y - a.y) - (b.y - a.y) * (sample_x - a.x)) / area;
                let weight_a = 1.0 - weight_b - weight_c;
                if weight_a.min(weight_b).min(weight_c) < 0.0 {
                    continue;
                }
                let depth = a.z * weight_a + b.z * weight_b + c.z * weight_c;
                let i = y * self.width + x;
                if depth > self.depth[i] {
                    self.depth[i] = depth;
                    self.colour[i] = colour(values[0] * weight_a + values[1] * weight_b + values[2] * weight_c);
                }
            }
        }
    }

    /// Averages the samples of each pixel.
    fn picture(&self, style: &RenderStyle) -> RgbImage {
        RgbImage::from_fn(style.width_px, style.height_px, |x, y| {
            let mut sum = [0_u32; 3];
            for sample in 0..SAMPLES * SAMPLES {
                let (dx, dy) = (sample % SAMPLES, sample / SAMPLES);
                let i = (y as usize * SAMPLES + dy) * self.width + x as usize * SAMPLES + dx;
                for (sum, &level) in sum.iter_mut().zip(&self.colour[i]) {
                    *sum += u32::from(level);
                }
            }
            let samples = (SAMPLES * SAMPLES) as u32;
            Rgb(sum.map(|s| ((s + samples / 2) / samples) as u8))
        })
    }
}

/// A coordinate as an index from 0 to `end`.
fn clamp(x: f32, end: usize) -> usize {
    x.clamp(0.0, end as f32) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    const STYLE: RenderStyle = RenderStyle { width_px: 40, height_px: 40, background: [1, 2, 3] };

    /// A square of 2 mm in the plane z = `z`, facing +z.
    fn square(z: f32) -> TriMesh {
        TriMesh {
            positions_mm: [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
                .map(|[x, y]| Vec3::new(x, y, z))
                .to_vec(),
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            uv: Some(vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        }
    }

    #[test]
    fn a_square_fills_its_share_and_leaves_the_background() {
        let mesh = square(0.0);
        let frame = ViewFrame::fit(&[&mesh], ViewSide::default());
        assert!((frame.aspect() - 1.0).abs() < 1e-6);
        let colours = [[200, 100, 50]; 4];
        let image = render(&mesh, Surface::Colours(&colours), &frame, &STYLE);
        assert_eq!(image.get_pixel(0, 20).0, STYLE.background);
        let covered = image.pixels().filter(|p| p.0 != STYLE.background).count() as f32;
        assert!((covered / 1600.0 - FILL * FILL).abs() < 0.06, "{covered}");
        let middle = image.get_pixel(20, 20).0;
        assert!(middle[0] > middle[1] && middle[1] > middle[2]);
    }

    #[test]
    fn the_nearer_surface_hides_the_farther_in_either_order() {
        let (near, far) = (square(1.0), square(-1.0));
        let mut both = near.clone();
        both.positions_mm.extend(&far.positions_mm);
        both.triangles.extend([[4, 5, 6], [4, 6, 7]]);
        both.uv = None;
        let frame = ViewFrame::fit(&[&both], ViewSide { is_perspective: true, ..ViewSide::default() });
        let colours: Vec<_> = (0..8).map(|i| if i < 4 { [250, 0, 0] } else { [0, 0, 250] }).collect();
        for _ in 0..2 {
            let image = render(&both, Surface::Colours(&colours), &frame, &STYLE);
            assert_eq!(image.get_pixel(20, 20).0[2], 0);
            both.triangles.reverse();
        }
    }

    #[test]
    fn texture_is_upright_and_not_mirrored_from_both_conventions() {
        let picture = GreyPicture::new(2, 2, vec![250, 170, 90, 10]);
        // The same square in camera axes: y down, z forward, so it faces -z.
        let mut camera_axes = square(0.0);
        for p in &mut camera_axes.positions_mm {
            *p = Vec3::new(p.x, -p.y, 50.0);
        }
        for mesh in [square(0.0), camera_axes] {
            let frame = ViewFrame::fit(&[&mesh], ViewSide::default());
            let image = render(&mesh, Surface::Texture(&picture), &frame, &STYLE);
            let corners = [[6, 6], [33, 6], [6, 33], [33, 33]].map(|[x, y]| image.get_pixel(x, y).0[0]);
            assert!(corners.is_sorted_by(|a, b| a > b), "{corners:?}");
        }
    }

    #[test]
    fn meshes_that_share_a_view_register() {
        let (mesh, mut moved) = (square(0.0), square(0.0));
        for p in &mut moved.positions_mm {
            p.x += 2.0;
        }
        let frame = ViewFrame::fit(&[&mesh, &moved], ViewSide::default());
        assert!((frame.aspect() - 2.0).abs() < 1e-5);
        let filled =
            |m: &TriMesh, x: u32| render(m, Surface::Clay, &frame, &STYLE).get_pixel(x, 20).0 != STYLE.background;
        assert!(filled(&mesh, 10) && !filled(&mesh, 30));
        assert!(!filled(&moved, 10) && filled(&moved, 30));
    }

    #[test]
    fn degenerate_input_draws_the_background() {
        let empty = TriMesh::default();
        let frame = ViewFrame::fit(&[&empty], ViewSide::default());
        assert!(render(&empty, Surface::Clay, &frame, &STYLE).pixels().all(|p| p.0 == STYLE.background));
        let point = TriMesh { positions_mm: vec![Vec3::ONE; 3], triangles: vec![[0, 1, 2]], uv: None };
        let frame = ViewFrame::fit(&[&point], ViewSide::default());
        assert!(render(&point, Surface::Clay, &frame, &STYLE).pixels().all(|p| p.0 == STYLE.background));
    }
}
