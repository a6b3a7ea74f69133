//! What the camera sees of the posed scene while the projector shows one pattern.
//!
//! Two z-buffers: the camera's picture, and the projector's view for shadows. Shading is Lambert with some specular light at
//! the vertices, albedo and projected level at the pixels; then shot and read noise and 8-bit rounding. What does not hang on
//! the pattern is looked at once an instant ([`Renderer::look`]) and serves every pattern shown while nothing moves.

use super::face::COLUMNS;
use super::lens::Lens;
use super::noise::{self, Normals};
use super::raster::{for_each_pixel, whole};
use super::scene::Scene;
use super::shown::ShownPattern;
use super::skin::Skin;
use super::{Finish, Region, SimConfig};
use crate::light::triangulate::scan_from_camera;
use crate::light::{Calibration, Direction, LightError};
use glam::{Mat3, Vec3, Vec4};
use gv3_codec::GreyPicture;
use std::ops::Range;

/// Grey levels of a white surface lit head-on at 600 mm in a nominal exposure.
const GAIN_LEVELS: f32 = 320.0;
const NOMINAL_EXPOSURE_NANOS: f32 = 5_000_000.0;
/// Light of a pixel that sees no surface.
const BACKGROUND: f32 = 0.002;
/// Strength of the specular light (exponent 16) of skin, and of a shiny region: four times a white surface.
const SPECULAR: f32 = 0.05;
const SHINY_SPECULAR: f32 = 4.0;
/// The shadow map has one cell for this many projector pixels each way, and every other vertex of the head.
const SHADOW_CELL_PX: f32 = 4.0;
const SHADOW_STEP: usize = 2;
/// Surfaces this close behind the one in the shadow map are lit, mm.
const SHADOW_BIAS_MM: f32 = 3.0;
/// Pixels that are told to see nothing at once.
const GROUP_PX: usize = 32;
/// Nothing nearer than this is seen or throws a shadow, mm.
const NEAREST_MM: f32 = 10.0;

/// A vertex as the camera's raster needs it.
#[derive(Debug, Clone, Copy, Default)]
struct Corner {
    px: [f32; 2],
    inverse_depth: f32,
    /// Place in the skin (two texel coordinates), diffuse and specular light.
    seen: Vec4,
}

/// Vertices that are shaded together.
const LANES: usize = 12;

/// Vertices with their normals (of any length), each number by itself so that the loop over them vectorizes.
#[derive(Debug, Clone, Copy, Default)]
struct Bare {
    position_mm: [[f32; LANES]; 3],
    normal: [[f32; LANES]; 3],
    strength: [f32; LANES],
}

/// What [`Bare`] vertices are to the camera.
#[derive(Debug, Clone, Copy, Default)]
struct Shaded {
    px: [[f32; LANES]; 2],
    inverse_depth: [f32; LANES],
    diffuse: [f32; LANES],
    specular: [f32; LANES],
}

/// What the camera sees at one instant, whatever the projector shows; row-major.
#[derive(Debug, Clone)]
struct View {
    /// Pixels of every row outside of which none sees a surface.
    spans: Vec<Range<usize>>,
    /// Light without the projector.
    dark: Vec<f32>,
    /// Light for a white projector pixel, 0 in its shadow.
    response: Vec<f32>,
    /// Column and row of the projector.
    projector_px: [Vec<f32>; 2],
}

/// Renders pictures; keeps its buffers.
#[derive(Debug, Clone)]
pub struct Renderer {
    camera: Lens,
    projector: Lens,
    rotation: Mat3,
    translation_mm: Vec3,
    /// The projector's centre in the scan frame.
    light_mm: Vec3,
    /// The pixels' rays in the projector's axes.
    rays: [Vec<f32>; 3],
    surface: Surface,
    corners: Vec<Corner>,
    inverse_depth: Vec<f32>,
    seen: Vec<Vec4>,
    view: View,
    /// Sum over the instants gathered, 1 for a white surface lit head-on.
    light: Vec<f32>,
    instants: u32,
    shadow_size: [usize; 2],
    shadow_corners: Vec<[f32; 3]>,
    shadow: Vec<f32>,
}

/// What of a scene does not move.
#[derive(Debug, Clone)]
struct Surface {
    triangles: Vec<[u32; 3]>,
    /// Vertices of the shadow map's mesh, and its triangles of them.
    shadow_vertices: Vec<u32>,
    shadow_triangles: Vec<[u32; 3]>,
    /// Normals of the vertices; without them those of the head's grid are taken in every posture.
    fixed_normals: Option<Vec<Vec3>>,
    texels: Vec<[f32; 2]>,
    /// Strength of the specular light of every vertex.
    strengths: Vec<f32>,
}

impl Surface {
    fn new(scene: &Scene, skin: &Skin, regions: &[Region]) -> Self {
        let (shadow_vertices, shadow_triangles) = scene.shadow_mesh(SHADOW_STEP);
        let rest_mm = scene.rest_mm();
        Self {
            triangles: scene.triangles(),
            shadow_vertices,
            shadow_triangles,
            fixed_normals: scene.fixed_normals().map(<[Vec3]>::to_vec),
            texels: match scene.uv() {
                Some(uv) => uv.iter().map(|uv| skin.texel_of_uv(*uv)).collect(),
                None => rest_mm.iter().map(|p| Skin::texel_of(p.x, p.y)).collect(),
            },
            strengths: rest_mm.iter().map(|p| specular_strength(p.x, p.y, regions)).collect(),
        }
    }
}

impl Renderer {
    /// Tables for a rig and a scene.
    ///
    /// # Errors
    /// [`LightError::Field`] for a calibration that cannot work.
    pub fn new(calibration: &Calibration, scene: &Scene, skin: &Skin, regions: &[Region]) -> Result<Self, LightError> {
        calibration.validate()?;
        let rotation = calibration.projector_from_camera.matrix();
        let rays: Vec<Vec3> =
            calibration.camera.ray_table("camera")?.iter().map(|ray| (rotation * ray.extend(1.0)).as_vec3()).collect();
        let pixels = rays.len();
        let (camera, projector) = (Lens::new(&calibration.camera), Lens::new(&calibration.projector));
        let shadow_size = projector.size_px.map(|n| n.div_ceil(SHADOW_CELL_PX as usize));
        let translation_mm = calibration.projector_from_camera.translation().as_vec3();
        let zeros = vec![0.0; pixels];
        let view = View {
            spans: vec![0..0; camera.size_px[1]],
            dark: zeros.clone(),
            response: zeros.clone(),
            projector_px: [zeros.clone(), zeros.clone()],
        };
        Ok(Self {
            camera,
            projector,
            rotation: rotation.as_mat3(),
            translation_mm,
            light_mm: scan_from_camera(-(rotation.as_mat3().transpose() * translation_mm)),
            rays: [0, 1, 2].map(|axis| rays.iter().map(|ray| ray[axis]).collect()),
            surface: Surface::new(scene, skin, regions),
            corners: Vec::new(),
            inverse_depth: zeros.clone(),
            seen: vec![Vec4::ZERO; pixels],
            view,
            light: zeros,
            instants: 0,
            shadow_size,
            shadow_corners: Vec::new(),
            shadow: vec![0.0; shadow_size[0] * shadow_size[1]],
        })
    }

    /// Puts another scene in the place of the one so far.
    pub fn set_scene(&mut self, scene: &Scene, skin: &Skin, regions: &[Region]) {
        self.surface = Surface::new(scene, skin, regions);
    }

    /// Forgets the light gathered so far.
    pub fn clear(&mut self) {
        self.light.fill(0.0);
        self.instants = 0;
    }

    /// Looks at the scene at `positions_mm` (scan frame), for every [`Self::add_light`] until the next look.
    pub fn look(&mut self, positions_mm: &[Vec3], skin: &Skin, ambient: f32) {
        self.place_corners(positions_mm);
        self.draw_shadow_map(positions_mm);
        self.draw_camera_view();
        for y in 0..self.camera.size_px[1] {
            self.look_at_row(y, skin, ambient);
        }
    }

    /// Gathers the light of one instant in which the scene is where it was last looked at; dark where the projector shows
    /// nothing.
    pub fn add_light(&mut self, pattern: Option<&ShownPattern>) {
        let view = &self.view;
        self.instants += 1;
        for (y, (light, span)) in self.light.chunks_exact_mut(self.camera.size_px[0]).zip(&view.spans).enumerate() {
            light[..span.start].iter_mut().for_each(|l| *l += BACKGROUND);
            light[span.end..].iter_mut().for_each(|l| *l += BACKGROUND);
            let first = y * self.camera.size_px[0];
            let pixels = first + span.start..first + span.end;
            let light = light[span.clone()].iter_mut().zip(&view.dark[pixels.clone()]);
            let Some(pattern) = pattern else {
                light.for_each(|(l, dark)| *l += dark);
                continue;
            };
            let axis = usize::from(pattern.direction == Direction::Rows);
            let projected = view.response[pixels.clone()].iter().zip(&view.projector_px[axis][pixels]);
            for ((l, dark), (response, u)) in light.zip(projected) {
                *l += dark + response * pattern.level(*u);
            }
        }
    }

    /// The picture of the light gathered: the mean over its instants, with noise and 8-bit rounding.
    pub fn develop(&self, exposure_nanos: u64, config: &SimConfig, picture_number: u64) -> GreyPicture {
        let [width, height] = self.camera.size_px;
        let gain = GAIN_LEVELS * exposure_nanos as f32 / NOMINAL_EXPOSURE_NANOS / self.instants.max(1) as f32;
        let (read_variance, per_electron) =
            (config.read_noise_levels * config.read_noise_levels, 1.0 / config.electrons_per_level);
        let seed = noise::hash(noise::hash(config.seed) ^ picture_number);
        let normals = Normals::table();
        let mut noise = vec![0.0; width];
        let mut pixels = vec![0u8; width * height];
        for (y, (light, out)) in self.light.chunks_exact(width).zip(pixels.chunks_exact_mut(width)).enumerate() {
            normals.fill(seed.wrapping_add((y * width.div_ceil(4)) as u64), &mut noise);
            for ((light, noise), out) in light.iter().zip(&noise).zip(out) {
                let grey = gain * light;
                let noisy = grey + (read_variance + grey * per_electron).sqrt() * noise + 0.5;
                // Below 0 and above 255 as a sensor does.
                let noisy = if noisy > 0.0 { noisy } else { 0.0 };
                *out = if noisy < 255.0 { noisy } else { 255.0 } as i32 as u8;
            }
        }
        GreyPicture::new(width as u32, height as u32, pixels)
    }

    /// Depth of every camera pixel at the last look, mm, 0 where there is no surface.
    pub fn depth_mm(&self) -> Vec<f32> {
        self.inverse_depth.iter().map(|&i| if i > 0.0 { 1.0 / i } else { 0.0 }).collect()
    }

    fn place_corners(&mut self, positions_mm: &[Vec3]) {
        self.corners.resize(positions_mm.len(), Corner::default());
        let count = positions_mm.len();
        let surface = &self.surface;
        let mut corners = std::mem::take(&mut self.corners);
        for first in (0..count).step_by(LANES) {
            let mut bare = Bare::default();
            for k in 0..LANES {
                let i = (first + k).min(count - 1);
                let normal = surface.fixed_normals.as_ref().map_or_else(|| grid_normal(positions_mm, i), |n| n[i]);
                bare.strength[k] = surface.strengths[i];
                for axis in 0..3 {
                    bare.position_mm[axis][k] = positions_mm[i][axis];
                    bare.normal[axis][k] = normal[axis];
                }
            }
            let shaded = shade(&bare, &self.camera, self.light_mm);
            let vertices = corners[first..].iter_mut().zip(&surface.texels[first..]);
            for (k, (corner, texel)) in vertices.take(LANES).enumerate() {
                corner.px = shaded.px.map(|axis| axis[k]);
                corner.inverse_depth = shaded.inverse_depth[k];
                corner.seen = Vec4::new(texel[0], texel[1], shaded.diffuse[k], shaded.specular[k]);
            }
        }
        self.corners = corners;
    }

    fn draw_shadow_map(&mut self, positions_mm: &[Vec3]) {
        let [width, height] = self.shadow_size;
        self.shadow.fill(0.0);
        self.shadow_corners.clear();
        self.shadow_corners.extend(self.surface.shadow_vertices.iter().map(|&v| {
            let q = self.rotation * scan_from_camera(positions_mm[v as usize]) + self.translation_mm;
            let inverse = if q.z > NEAREST_MM { 1.0 / q.z } else { f32::NAN };
            let [x, y] = self.projector.px(q.x * inverse, q.y * inverse);
            // Cell i holds projector pixels from i * SHADOW_CELL_PX on, so its centre is half a cell further.
            [(x + 0.5) / SHADOW_CELL_PX - 0.5, (y + 0.5) / SHADOW_CELL_PX - 0.5, inverse]
        }));
        let (shadow, corners) = (&mut self.shadow[..width * height], &self.shadow_corners[..]);
        let px = |v: u32| [corners[v as usize][0], corners[v as usize][1]];
        for_each_pixel(&self.surface.shadow_triangles, px, self.shadow_size, |triangle, i, b, c| {
            let [p, q, r] = triangle.map(|v| corners[v as usize][2]);
            let inverse = p + b * (q - p) + c * (r - p);
            shadow[i] = if inverse > shadow[i] { inverse } else { shadow[i] };
        });
    }

    fn draw_camera_view(&mut self) {
        let [width, height] = self.camera.size_px;
        self.inverse_depth.fill(0.0);
        let (depth, seen) = (&mut self.inverse_depth[..width * height], &mut self.seen[..width * height]);
        let corners = &self.corners[..];
        for_each_pixel(
            &self.surface.triangles,
            |v| corners[v as usize].px,
            self.camera.size_px,
            |triangle, i, b, c| {
                let [p, q, r] = triangle.map(|v| &corners[v as usize]);
                let inverse =
                    p.inverse_depth + b * (q.inverse_depth - p.inverse_depth) + c * (r.inverse_depth - p.inverse_depth);
                if inverse > depth[i] {
                    depth[i] = inverse;
                    seen[i] = p.seen + b * (q.seen - p.seen) + c * (r.seen - p.seen);
                }
            },
        );
    }

    /// Fills one row of the view.
    fn look_at_row(&mut self, y: usize, skin: &Skin, ambient: f32) {
        let width = self.camera.size_px[0];
        let depth = &self.inverse_depth[y * width..][..width];
        // Whole groups, since a test of every pixel by itself would cost as much as what it saves.
        let is_seen = |group: &[f32]| group.iter().fold(false, |seen, i| seen | (*i > 0.0));
        let first = depth.chunks(GROUP_PX).position(is_seen).unwrap_or(0) * GROUP_PX;
        let span = first..depth.chunks(GROUP_PX).rposition(is_seen).map_or(0, |last| (last + 1) * GROUP_PX).min(width);
        let pixels = y * width + span.start..y * width + span.end;
        self.view.spans[y] = span;
        self.find_projector_px(pixels.clone());
        let [columns, rows] = &self.view.projector_px;
        let (columns, rows) = (&columns[pixels.clone()], &rows[pixels.clone()]);
        let (depth, seen) = (&self.inverse_depth[pixels.clone()], &self.seen[pixels.clone()]);
        let (dark, response) = (&mut self.view.dark[pixels.clone()], &mut self.view.response[pixels]);
        let lights = dark.iter_mut().zip(response);
        for ((((dark, response), seen), depth), (column, row)) in
            lights.zip(seen).zip(depth).zip(columns.iter().zip(rows))
        {
            let [u, v, diffuse, specular] = seen.to_array();
            let albedo = skin.albedo([u, v]);
            // Until here the response holds the inverse of the depth before the projector.
            let is_lit = is_lit(&self.shadow, self.shadow_size, [*column, *row], *response) & (*depth > 0.0);
            *dark = if *depth > 0.0 { albedo * ambient } else { BACKGROUND };
            *response = if is_lit { albedo * diffuse + specular } else { 0.0 };
        }
    }

    /// Projector pixel of every camera pixel, and the inverse of the depth before the projector in place of the response.
    fn find_projector_px(&mut self, pixels: Range<usize>) {
        let [rx, ry, rz] = [0, 1, 2].map(|axis| &self.rays[axis][pixels.clone()]);
        let depth = &self.inverse_depth[pixels.clone()];
        let [columns, rows] = &mut self.view.projector_px;
        let (columns, rows) = (&mut columns[pixels.clone()], &mut rows[pixels.clone()]);
        let inverse_depth = &mut self.view.response[pixels];
        let n = depth.len();
        let (rx, ry, rz, columns, rows) = (&rx[..n], &ry[..n], &rz[..n], &mut columns[..n], &mut rows[..n]);
        let (inverse_depth, t) = (&mut inverse_depth[..n], self.translation_mm);
        for i in 0..n {
            // The ray's point over its depth: one division less, and the same projector pixel.
            let inverse = 1.0 / (rz[i] + t.z * depth[i]);
            let px = self.projector.px((rx[i] + t.x * depth[i]) * inverse, (ry[i] + t.y * depth[i]) * inverse);
            (columns[i], rows[i]) = (px[0], px[1]);
            inverse_depth[i] = depth[i] * inverse;
        }
    }
}

/// Normal of a vertex of the head's grid: across the differences to its neighbours.
#[inline(always)]
fn grid_normal(positions_mm: &[Vec3], i: usize) -> Vec3 {
    let (row, column) = (i / COLUMNS, i % COLUMNS);
    let [left, right] = [i - usize::from(column > 0), i + usize::from(column + 1 < COLUMNS)];
    let above = if row > 0 { i - COLUMNS } else { i };
    let below = if i + COLUMNS < positions_mm.len() { i + COLUMNS } else { i };
    (positions_mm[right] - positions_mm[left]).cross(positions_mm[above] - positions_mm[below])
}

/// Pixels, and diffuse and specular light: 1 head-on at 600 mm from the light; the camera is the origin.
///
/// Several loops, since the compiler vectorizes none that chooses between two results of this length.
fn shade(bare: &Bare, camera: &Lens, light_mm: Vec3) -> Shaded {
    let mut out = Shaded::default();
    let ([x, y, z], [nx, ny, nz]) = (bare.position_mm, bare.normal);
    // What is not in front of the camera is no number, which the raster leaves out.
    out.inverse_depth = z.map(|z| if z < -NEAREST_MM { -1.0 / z } else { f32::NAN });
    for i in 0..LANES {
        let at = camera.px(x[i] * out.inverse_depth[i], -y[i] * out.inverse_depth[i]);
        (out.px[0][i], out.px[1][i]) = (at[0], at[1]);
    }
    let (mut lambert, mut aligned, mut falloff) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
    for i in 0..LANES {
        let (p, normal) = (Vec3::new(x[i], y[i], z[i]), Vec3::new(nx[i], ny[i], nz[i]));
        let per_length = 1.0 / (normal.length_squared() + f32::MIN_POSITIVE).sqrt();
        let to_light = light_mm - p;
        let per_distance2 = 1.0 / to_light.length_squared();
        let to_light = to_light * per_distance2.sqrt();
        let half = to_light - p * (1.0 / p.length_squared().sqrt());
        lambert[i] = normal.dot(to_light) * per_length;
        aligned[i] = normal.dot(half) * per_length / half.length_squared().sqrt();
        falloff[i] = 600.0 * 600.0 * per_distance2;
    }
    for i in 0..LANES {
        let power2 = if (lambert[i] > 0.0) & (aligned[i] > 0.0) { aligned[i] * aligned[i] } else { 0.0 };
        let power4 = power2 * power2;
        let power16 = (power4 * power4) * (power4 * power4);
        out.specular[i] = bare.strength[i] * power16 * falloff[i];
        out.diffuse[i] = if lambert[i] > 0.0 { lambert[i] * falloff[i] } else { 0.0 };
    }
    out
}

/// Whether the projector reaches a surface at `px` and `inverse_depth`.
#[inline(always)]
fn is_lit(shadow: &[f32], [width, height]: [usize; 2], px: [f32; 2], inverse_depth: f32) -> bool {
    let (x, y) = ((px[0] + 0.5) * (1.0 / SHADOW_CELL_PX), (px[1] + 0.5) * (1.0 / SHADOW_CELL_PX));
    if !((x >= 0.0) & (y >= 0.0) & (x < width as f32) & (y < height as f32)) {
        return false;
    }
    let nearest = shadow[whole(y).min(height - 1) * width + whole(x).min(width - 1)];
    inverse_depth >= nearest - SHADOW_BIAS_MM * inverse_depth * inverse_depth
}

/// Strength of the specular light at a place at rest.
fn specular_strength(x_mm: f32, y_mm: f32, regions: &[Region]) -> f32 {
    let shiny = regions.iter().filter(|r| r.finish == Finish::Shiny);
    shiny.fold(SPECULAR, |strength, r| strength + r.weight(x_mm, y_mm) * (SHINY_SPECULAR - strength))
}
