//! What the camera sees of the posed scene while the projector shows one pattern.
//!
//! Two z-buffers: the camera's picture, and the projector's view for shadows. Shading is Lambert with some specular light at
//! the vertices, albedo and projected level at the pixels; then shot and read noise and 8-bit rounding.

use super::face::COLUMNS;
use super::noise;
use super::raster::for_each_pixel;
use super::scene::Scene;
use super::skin::Skin;
use super::{Finish, Region, SimConfig};
use crate::light::triangulate::scan_from_camera;
use crate::light::{Calibration, Direction, Distortion, Intrinsics, LightError, Pattern};
use glam::{Mat3, Vec3};
use gv3_codec::GreyPicture;

/// Grey levels of a white surface lit head-on at 600 mm in a nominal exposure.
const GAIN_LEVELS: f32 = 320.0;
const NOMINAL_EXPOSURE_NANOS: f32 = 5_000_000.0;
/// Light of a black projector pixel over that of a white one.
const BLACK_LEVEL: f32 = 0.01;
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

/// A lens in f32.
#[derive(Debug, Clone, Copy)]
struct Lens {
    f: [f32; 2],
    c: [f32; 2],
    k: [f32; 3],
    p: [f32; 2],
    size_px: [usize; 2],
}

impl Lens {
    fn new(intrinsics: &Intrinsics) -> Self {
        let Distortion { k1, k2, p1, p2, k3 } = intrinsics.distortion;
        Self {
            f: [intrinsics.fx_px as f32, intrinsics.fy_px as f32],
            c: [intrinsics.cx_px as f32, intrinsics.cy_px as f32],
            k: [k1 as f32, k2 as f32, k3 as f32],
            p: [p1 as f32, p2 as f32],
            size_px: [intrinsics.width_px as usize, intrinsics.height_px as usize],
        }
    }

    /// Pixel of normalized coordinates.
    #[inline]
    fn px(&self, x: f32, y: f32) -> [f32; 2] {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k[0] + r2 * (self.k[1] + r2 * self.k[2]));
        let [p1, p2] = self.p;
        let dx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let dy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        [self.f[0] * dx + self.c[0], self.f[1] * dy + self.c[1]]
    }
}

/// A vertex as the camera's raster needs it.
#[derive(Debug, Clone, Copy, Default)]
struct Corner {
    px: [f32; 2],
    inverse_depth: f32,
    texel: [f32; 2],
    diffuse: f32,
    specular: f32,
}

/// What a pixel sees.
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    texel: [f32; 2],
    diffuse: f32,
    specular: f32,
}

/// Light of one pattern along its direction.
#[derive(Debug, Clone)]
pub struct ShownPattern {
    levels: Vec<f32>,
    direction: Direction,
}

impl ShownPattern {
    /// The pattern as an 8-bit projector of `length_px` pixels along its direction shows it, its light the `gamma`-th power of
    /// its input and blurred by a Gaussian of `sigma_px`.
    ///
    /// The blur lowers the modulation of period p by exp(-2 pi^2 sigma^2 / p^2), the Gaussian's Fourier transform.
    pub fn new(pattern: &Pattern, length_px: u32, gamma: f32, sigma_px: f32) -> Self {
        let response =
            |v: u8| if gamma == 1.0 { f32::from(v) } else { 255.0 * libm::powf(f32::from(v) / 255.0, gamma) };
        let level = |v: u8| BLACK_LEVEL + (1.0 - BLACK_LEVEL) * response(v) / 255.0;
        let sharp: Vec<f32> = pattern.levels(length_px).into_iter().map(level).collect();
        let levels = if sigma_px > 0.0 { blurred(&sharp, sigma_px) } else { sharp };
        Self { levels, direction: pattern.direction }
    }

    #[inline]
    fn level(&self, px: [f32; 2]) -> f32 {
        let u = if self.direction == Direction::Columns { px[0] } else { px[1] };
        let u = u.clamp(0.0, self.levels.len() as f32 - 1.001);
        let i = u as i32;
        let pair = &self.levels[i as usize..i as usize + 2];
        pair[0] + (u - i as f32) * (pair[1] - pair[0])
    }
}

/// Levels after a Gaussian blur to five sigma; beyond the projector's edges it is dark.
fn blurred(levels: &[f32], sigma_px: f32) -> Vec<f32> {
    let reach = (5.0 * sigma_px).ceil() as isize;
    let weight = |d: isize| libm::exp(-0.5 * (d as f64 / f64::from(sigma_px)).powi(2));
    let kernel: Vec<f64> = (-reach..=reach).map(weight).collect();
    let total: f64 = kernel.iter().sum();
    let at = |u: isize| usize::try_from(u).ok().and_then(|u| levels.get(u)).map_or(0.0, |v| f64::from(*v));
    let blur = |u: isize| (-reach..=reach).zip(&kernel).map(|(d, w)| w * at(u + d)).sum::<f64>() / total;
    (0..levels.len() as isize).map(|u| blur(u) as f32).collect()
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
    rays: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    /// Vertices of the shadow map's mesh, and its triangles of them.
    shadow_vertices: Vec<u32>,
    shadow_triangles: Vec<[u32; 3]>,
    /// Normals of the vertices; without them those of the head's grid are taken in every posture.
    fixed_normals: Option<Vec<Vec3>>,
    texels: Vec<[f32; 2]>,
    /// Strength of the specular light of every vertex.
    strengths: Vec<f32>,
    corners: Vec<Corner>,
    inverse_depth: Vec<f32>,
    /// Sum over the instants gathered, 1 for a white surface lit head-on.
    light: Vec<f32>,
    instants: u32,
    seen: Vec<Seen>,
    shadow_size: [usize; 2],
    shadow_corners: Vec<[f32; 3]>,
    shadow: Vec<f32>,
}

impl Renderer {
    /// Tables for a rig and a scene.
    ///
    /// # Errors
    /// [`LightError::Field`] for a calibration that cannot work.
    pub fn new(calibration: &Calibration, scene: &Scene, regions: &[Region]) -> Result<Self, LightError> {
        calibration.validate()?;
        let rotation = calibration.projector_from_camera.matrix();
        let rays: Vec<Vec3> =
            calibration.camera.ray_table("camera")?.iter().map(|ray| (rotation * ray.extend(1.0)).as_vec3()).collect();
        let pixels = rays.len();
        let projector = Lens::new(&calibration.projector);
        let shadow_size = projector.size_px.map(|n| (n as f32 / SHADOW_CELL_PX).ceil() as usize);
        let (shadow_vertices, shadow_triangles) = scene.shadow_mesh(SHADOW_STEP);
        let translation_mm = calibration.projector_from_camera.translation().as_vec3();
        let rest_mm = scene.rest_mm();
        Ok(Self {
            camera: Lens::new(&calibration.camera),
            projector,
            rotation: rotation.as_mat3(),
            translation_mm,
            light_mm: scan_from_camera(-(rotation.as_mat3().transpose() * translation_mm)),
            rays,
            triangles: scene.triangles(),
            shadow_vertices,
            shadow_triangles,
            fixed_normals: scene.fixed_normals().map(<[Vec3]>::to_vec),
            texels: rest_mm.iter().map(|p| Skin::texel_of(p.x, p.y)).collect(),
            strengths: rest_mm.iter().map(|p| specular_strength(p.x, p.y, regions)).collect(),
            corners: vec![Corner::default(); rest_mm.len()],
            inverse_depth: vec![0.0; pixels],
            light: vec![0.0; pixels],
            instants: 0,
            seen: vec![Seen::default(); pixels],
            shadow_size,
            shadow_corners: Vec::new(),
            shadow: vec![0.0; shadow_size[0] * shadow_size[1]],
        })
    }

    /// Forgets the light gathered so far.
    pub fn clear(&mut self) {
        self.light.fill(0.0);
        self.instants = 0;
    }

    /// Gathers the light of one instant, the scene at `positions_mm` (scan frame); dark where the projector shows nothing.
    pub fn add_light(&mut self, positions_mm: &[Vec3], skin: &Skin, pattern: Option<&ShownPattern>, ambient: f32) {
        self.place_corners(positions_mm);
        self.draw_shadow_map(positions_mm);
        self.draw_camera_view();
        self.instants += 1;
        for i in 0..self.rays.len() {
            let seen = self.inverse_depth[i] > 0.0;
            self.light[i] += if seen { self.light_at(i, skin, pattern, ambient) } else { BACKGROUND };
        }
    }

    /// The picture of the light gathered: the mean over its instants, with noise and 8-bit rounding.
    pub fn develop(&self, exposure_nanos: u64, config: &SimConfig, picture_number: u64) -> GreyPicture {
        let gain = GAIN_LEVELS * exposure_nanos as f32 / NOMINAL_EXPOSURE_NANOS / self.instants.max(1) as f32;
        let seed = noise::hash(noise::hash(config.seed) ^ picture_number);
        let pixel = |(i, light): (usize, &f32)| {
            let grey = gain * light;
            let variance = config.read_noise_levels * config.read_noise_levels + grey / config.electrons_per_level;
            let noisy = grey + variance.sqrt() * noise::normal(seed.wrapping_add(i as u64));
            // The cast saturates: below 0 and above 255 as a sensor does.
            (noisy + 0.5) as u8
        };
        let pixels = self.light.iter().enumerate().map(pixel).collect();
        GreyPicture::new(self.camera.size_px[0] as u32, self.camera.size_px[1] as u32, pixels)
    }

    /// Depth of every camera pixel, mm, 0 where there is no surface.
    pub fn depth_mm(&mut self, positions_mm: &[Vec3]) -> Vec<f32> {
        self.place_corners(positions_mm);
        self.draw_camera_view();
        self.inverse_depth.iter().map(|&i| if i > 0.0 { 1.0 / i } else { 0.0 }).collect()
    }

    fn place_corners(&mut self, positions_mm: &[Vec3]) {
        if let Some(normals) = self.fixed_normals.take() {
            for (i, normal) in normals.iter().enumerate() {
                self.place_corner(i, positions_mm[i], *normal);
            }
            self.fixed_normals = Some(normals);
            return;
        }
        let rows = positions_mm.len() / COLUMNS;
        for row in 0..rows {
            let above = &positions_mm[row.saturating_sub(1) * COLUMNS..][..COLUMNS];
            let here = &positions_mm[row * COLUMNS..][..COLUMNS];
            let below = &positions_mm[(row + 1).min(rows - 1) * COLUMNS..][..COLUMNS];
            for c in 0..COLUMNS {
                let across = here[(c + 1).min(COLUMNS - 1)] - here[c.saturating_sub(1)];
                let normal = across.cross(above[c] - below[c]).normalize_or_zero();
                self.place_corner(row * COLUMNS + c, here[c], normal);
            }
        }
    }

    #[inline(always)]
    fn place_corner(&mut self, i: usize, p: Vec3, normal: Vec3) {
        let (diffuse, specular) = shade(p, normal, self.light_mm, self.strengths[i]);
        let inverse_depth = -1.0 / p.z;
        let px = self.camera.px(p.x * inverse_depth, -p.y * inverse_depth);
        self.corners[i] = Corner { px, inverse_depth, texel: self.texels[i], diffuse, specular };
    }

    fn draw_shadow_map(&mut self, positions_mm: &[Vec3]) {
        let [width, height] = self.shadow_size;
        self.shadow.fill(0.0);
        self.shadow_corners.clear();
        self.shadow_corners.extend(self.shadow_vertices.iter().map(|&v| {
            let q = self.rotation * scan_from_camera(positions_mm[v as usize]) + self.translation_mm;
            let inverse = 1.0 / q.z;
            let [x, y] = self.projector.px(q.x * inverse, q.y * inverse);
            // Cell i holds projector pixels from i * SHADOW_CELL_PX on, so its centre is half a cell further.
            [(x + 0.5) / SHADOW_CELL_PX - 0.5, (y + 0.5) / SHADOW_CELL_PX - 0.5, inverse]
        }));
        let shadow = &mut self.shadow;
        for triangle in &self.shadow_triangles {
            let t = triangle.map(|v| self.shadow_corners[v as usize]);
            for_each_pixel(t.map(|v| [v[0], v[1]]), width, height, |i, w| {
                let inverse = w[0] * t[0][2] + w[1] * t[1][2] + w[2] * t[2][2];
                shadow[i] = shadow[i].max(inverse);
            });
        }
    }

    fn draw_camera_view(&mut self) {
        self.inverse_depth.fill(0.0);
        let [width, height] = self.camera.size_px;
        let (depth, seen) = (&mut self.inverse_depth, &mut self.seen);
        for triangle in &self.triangles {
            let t = triangle.map(|v| &self.corners[v as usize]);
            for_each_pixel(t.map(|v| v.px), width, height, |i, w| {
                let mix = |f: fn(&Corner) -> f32| w[0] * f(t[0]) + w[1] * f(t[1]) + w[2] * f(t[2]);
                let inverse = mix(|v| v.inverse_depth);
                if inverse > depth[i] {
                    depth[i] = inverse;
                    seen[i] = Seen {
                        texel: [mix(|v| v.texel[0]), mix(|v| v.texel[1])],
                        diffuse: mix(|v| v.diffuse),
                        specular: mix(|v| v.specular),
                    };
                }
            });
        }
    }

    /// Light that pixel `i` receives, 1 for a white surface lit head-on.
    #[inline]
    fn light_at(&self, i: usize, skin: &Skin, pattern: Option<&ShownPattern>, ambient: f32) -> f32 {
        let seen = self.seen[i];
        let albedo = skin.albedo(seen.texel);
        let projected = match pattern {
            Some(pattern) if seen.diffuse > 0.0 => {
                let q = self.rays[i] * (1.0 / self.inverse_depth[i]) + self.translation_mm;
                let inverse = 1.0 / q.z;
                let px = self.projector.px(q.x * inverse, q.y * inverse);
                self.is_lit(px, inverse) * pattern.level(px)
            }
            _ => 0.0,
        };
        albedo * (ambient + projected * seen.diffuse) + projected * seen.specular
    }

    /// 1 where the projector reaches a surface at `px` and `inverse_depth`, else 0.
    #[inline]
    fn is_lit(&self, px: [f32; 2], inverse_depth: f32) -> f32 {
        let (x, y) = ((px[0] + 0.5) * (1.0 / SHADOW_CELL_PX), (px[1] + 0.5) * (1.0 / SHADOW_CELL_PX));
        let [width, height] = self.shadow_size;
        if !(x >= 0.0 && y >= 0.0 && x < width as f32 && y < height as f32) {
            return 0.0;
        }
        let nearest = self.shadow[y as i32 as usize * width + x as i32 as usize];
        f32::from(u8::from(inverse_depth >= nearest - SHADOW_BIAS_MM * inverse_depth * inverse_depth))
    }
}

/// Strength of the specular light at a place at rest.
fn specular_strength(x_mm: f32, y_mm: f32, regions: &[Region]) -> f32 {
    let shiny = regions.iter().filter(|r| r.finish == Finish::Shiny);
    shiny.fold(SPECULAR, |strength, r| strength + r.weight(x_mm, y_mm) * (SHINY_SPECULAR - strength))
}

/// Diffuse and specular light at a vertex, 1 head-on at 600 mm from the light; the camera is the origin.
#[inline]
fn shade(p: Vec3, normal: Vec3, light_mm: Vec3, strength: f32) -> (f32, f32) {
    let to_light = light_mm - p;
    let distance2 = to_light.length_squared();
    let to_light = to_light * (1.0 / distance2.sqrt());
    let lambert = normal.dot(to_light).max(0.0);
    let falloff = 600.0 * 600.0 / distance2;
    let half = (to_light - p * (1.0 / p.length())).normalize();
    let aligned = normal.dot(half).max(0.0);
    let power4 = (aligned * aligned) * (aligned * aligned);
    let power16 = (power4 * power4) * (power4 * power4);
    (lambert * falloff, if lambert > 0.0 { strength * power16 * falloff } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// Amplitude of the harmonic `order` of a pattern of period 24 px, away from the projector's edges.
    fn amplitude(order: f64, gamma: f32, sigma_px: f32) -> f64 {
        let pattern = Pattern::sinusoid(24.0, 0.3, Direction::Columns);
        let shown = ShownPattern::new(&pattern, 480, gamma, sigma_px);
        let (s, c) = (0..240).fold((0.0, 0.0), |(s, c), u| {
            let angle = TAU * order * f64::from(u) / 24.0;
            let level = f64::from(shown.level([120.0 + u as f32, 0.0]));
            (s + level * angle.sin(), c + level * angle.cos())
        });
        s.hypot(c) / 120.0
    }

    #[test]
    fn defocus_lowers_the_modulation_as_the_gaussian_says() {
        for sigma_px in [1.0f32, 3.0, 6.0] {
            let found = amplitude(1.0, 1.0, sigma_px) / amplitude(1.0, 1.0, 0.0);
            let expected = (-0.5 * (TAU * f64::from(sigma_px) / 24.0).powi(2)).exp();
            assert!((found / expected - 1.0).abs() < 0.01, "sigma {sigma_px} px: {found}, expected {expected}");
        }
    }

    #[test]
    fn gamma_makes_harmonics_and_defocus_takes_them_away() {
        assert!(amplitude(2.0, 1.0, 0.0) < 1e-3);
        // ((1 + cos x) / 2)^2 = 3/8 + cos(x) / 2 + cos(2x) / 8.
        let ratio = |sigma_px| amplitude(2.0, 2.0, sigma_px) / amplitude(1.0, 2.0, sigma_px);
        assert!((ratio(0.0) - 0.25).abs() < 2e-3, "{}", ratio(0.0));
        assert!(ratio(6.0) < 0.01, "{}", ratio(6.0));
    }
}
