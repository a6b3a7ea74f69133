//! Albedo of the face, fixed to the material: skin with speckle and pores, brows, lips, eyes.

use super::face::{self, EYE_X_MM, EYE_Y_MM, bump, smoothstep, squared};
use super::noise::{self, Normals};
use super::raster::whole;
use super::{Finish, Region};
use glam::Vec2;
use gv3_codec::GreyPicture;

/// Size of a texel, mm.
pub const TEXEL_MM: f32 = 0.4;
/// The map covers -HALF_WIDTH_MM..HALF_WIDTH_MM and -HALF_HEIGHT_MM..HALF_HEIGHT_MM of rest positions.
const HALF_WIDTH_MM: f32 = 96.0;
const HALF_HEIGHT_MM: f32 = 124.0;
const WIDTH: usize = 480;
const HEIGHT: usize = 620;
/// Albedo of bare skin.
const SKIN: f32 = 0.6;
/// Albedo of a dark region.
const DARK: f32 = 0.02;

/// Albedo 0..1 over rest positions, row-major, first row lowest.
#[derive(Debug, Clone)]
pub struct Skin {
    width: usize,
    height: usize,
    texels: Vec<f32>,
}

impl Skin {
    /// Half the width and height that the map covers, mm.
    pub const HALF_SIZE_MM: Vec2 = Vec2::new(HALF_WIDTH_MM, HALF_HEIGHT_MM);

    /// The skin grown from a seed, with the dark ones of `regions` painted over it.
    pub fn new(seed: u64, regions: &[Region]) -> Self {
        // Grain of 0.5 to 4.5 mm: from one to eight camera pixels.
        let grains: Vec<(f32, Vec<f32>)> = [(1usize, 0.045f32), (2, 0.045), (5, 0.04), (11, 0.035)]
            .iter()
            .enumerate()
            .map(|(layer, &(radius, amplitude))| (amplitude, grain(seed.wrapping_add(layer as u64 * 7919), radius)))
            .collect();
        let mut texels = Vec::with_capacity(WIDTH * HEIGHT);
        for i in 0..WIDTH * HEIGHT {
            let [x, y] = place_mm(i);
            let speckle: f32 = grains.iter().map(|(amplitude, layer)| amplitude * layer[i]).sum();
            let pore = smoothstep(1.5, 2.6, grains[1].1[i]) * pore_density(x, y);
            let skin = SKIN * tint(x, y) * (1.0 + speckle) * (1.0 - 0.22 * pore);
            let bare = with_features(x, y, skin, grains[0].1[i]).clamp(0.04, 0.95);
            texels.push(painted(regions, [x, y], bare));
        }
        Self { width: WIDTH, height: HEIGHT, texels }
    }

    /// An even grey as bright as skin, with the dark ones of `regions` painted over it.
    pub fn even(regions: &[Region]) -> Self {
        Self::printed(regions, |_, _| SKIN)
    }

    /// What `print(x, y)` gives for the texels around rest positions, with the dark ones of `regions` painted over it.
    pub fn printed(regions: &[Region], print: impl Fn(f32, f32) -> f32) -> Self {
        let texel = |i: usize| {
            let [x, y] = place_mm(i);
            painted(regions, [x, y], print(x, y))
        };
        Self { width: WIDTH, height: HEIGHT, texels: (0..WIDTH * HEIGHT).map(texel).collect() }
    }

    /// The albedo that a picture shows, 255 for a white surface; a picture of one row or column is doubled.
    pub fn of_picture(picture: &GreyPicture) -> Self {
        let (w, h) = (picture.width_px as usize, picture.height_px as usize);
        let (width, height) = (w.max(2), h.max(2));
        let level = |i: usize| picture.pixels[(h - 1 - (i / width).min(h - 1)) * w + (i % width).min(w - 1)];
        Self { width, height, texels: (0..width * height).map(|i| f32::from(level(i)) / 255.0).collect() }
    }

    /// Place of a texture coordinate in the map, texels.
    pub fn texel_of_uv(&self, [u, v]: [f32; 2]) -> [f32; 2] {
        [u * self.width as f32 - 0.5, v * self.height as f32 - 0.5]
    }

    /// Place of a rest position in the map, texels.
    pub fn texel_of(x_mm: f32, y_mm: f32) -> [f32; 2] {
        [(x_mm + HALF_WIDTH_MM) / TEXEL_MM, (y_mm + HALF_HEIGHT_MM) / TEXEL_MM]
    }

    /// The same as texture coordinates of [`Self::picture`].
    pub fn uv_of(x_mm: f32, y_mm: f32) -> [f32; 2] {
        let [x, y] = Self::texel_of(x_mm, y_mm);
        [(x + 0.5) / WIDTH as f32, (y + 0.5) / HEIGHT as f32]
    }

    /// The map as a picture, first row on top, 255 for albedo 1.
    pub fn picture(&self) -> GreyPicture {
        let rows = self.texels.chunks_exact(self.width).rev().flatten();
        GreyPicture::new(self.width as u32, self.height as u32, rows.map(|a| (a * 255.0 + 0.5) as u8).collect())
    }

    /// Albedo at a place in the map, bilinear.
    #[inline]
    pub fn albedo(&self, texel: [f32; 2]) -> f32 {
        let within = |v: f32, last: usize| {
            let v = if v > 0.0 { v } else { 0.0 };
            if v < last as f32 { v } else { last as f32 }
        };
        let (x, y) = (within(texel[0], self.width - 2), within(texel[1], self.height - 2));
        let (column, row) = (whole(x), whole(y));
        let (fx, fy) = (x - column as u32 as i32 as f32, y - row as u32 as i32 as f32);
        let at = row * self.width + column;
        let t = &self.texels[at..at + self.width + 2];
        let low = t[0] + fx * (t[1] - t[0]);
        let above = &t[self.width..];
        let high = above[0] + fx * (above[1] - above[0]);
        low + fy * (high - low)
    }
}

/// Rest position of texel `i`.
fn place_mm(i: usize) -> [f32; 2] {
    [(i % WIDTH) as f32 * TEXEL_MM - HALF_WIDTH_MM, (i / WIDTH) as f32 * TEXEL_MM - HALF_HEIGHT_MM]
}

/// Albedo `bare` with the dark regions over it.
fn painted(regions: &[Region], [x, y]: [f32; 2], bare: f32) -> f32 {
    let dark = regions.iter().filter(|r| r.finish == Finish::Dark);
    dark.fold(bare, |albedo, r| albedo + r.weight(x, y) * (DARK - albedo))
}

fn pore_density(x: f32, y: f32) -> f32 {
    0.25 + 0.75 * (bump(x, y, [0.0, -10.0], [14.0, 20.0]) + bump(x.abs(), y, [38.0, -10.0], [22.0, 18.0])).min(1.0)
}

/// Slow changes of tone: rosy cheeks and nose, shaded sockets.
fn tint(x: f32, y: f32) -> f32 {
    let ax = x.abs();
    1.0 - 0.08 * bump(ax, y, [45.0, -12.0], [20.0, 18.0])
        - 0.06 * bump(x, y, [0.0, -16.0], [12.0, 10.0])
        - 0.12 * bump(ax, y, [EYE_X_MM, EYE_Y_MM - 2.0], [17.0, 10.0])
        + 0.04 * bump(x, y, [0.0, 80.0], [40.0, 25.0])
}

fn with_features(x: f32, y: f32, skin: f32, hair: f32) -> f32 {
    let ax = x.abs();
    let mut albedo = skin;
    let mut paint = |amount: f32, value: f32| albedo += amount.clamp(0.0, 1.0) * (value - albedo);
    let brow_line = 43.0 + 4.0 * smoothstep(10.0, 34.0, ax) - 7.0 * smoothstep(36.0, 56.0, ax);
    let brow = smoothstep(4.6, 2.0, (y - brow_line).abs()) * smoothstep(11.0, 16.0, ax) * smoothstep(55.0, 44.0, ax);
    paint(brow * (0.72 + 0.2 * hair), 0.24);
    let from_line = y - face::mouth_line_mm(x);
    let upper_edge = 7.2 * (1.0 - squared(ax / 27.0)) - 1.2 * bump(x, 0.0, [0.0, 0.0], [3.0, 1.0]);
    let lower_edge = 9.5 * (1.0 - squared(ax / 26.0));
    let edge = if from_line > 0.0 { upper_edge } else { lower_edge };
    paint(0.9 * smoothstep(0.8, -0.8, from_line.abs() - edge), 0.68 * skin);
    paint(smoothstep(1.2, 0.5, from_line.abs()) * smoothstep(28.0, 24.0, ax), 0.22);
    paint(0.9 * bump(ax, y, [6.5, -28.5], [2.6, 1.7]), 0.12);
    let eye = face::inside_eye(x, y);
    let r = (squared(ax - EYE_X_MM) + squared(y - EYE_Y_MM)).sqrt();
    let ball = if r < 2.4 { 0.1 } else { 0.28 + 0.42 * smoothstep(5.4, 6.4, r) };
    paint(eye, ball);
    let [low, high] = face::lid_edges(ax - EYE_X_MM);
    let lashes = smoothstep(1.5, 0.5, (y - high - 0.3).abs()) + 0.4 * smoothstep(1.0, 0.3, (y - low).abs());
    paint(0.6 * lashes * smoothstep(15.0, 13.0, (ax - EYE_X_MM).abs()), 0.15);
    albedo
}

/// Smooth noise of unit variance: white noise after three box means of the given radius in texels.
fn grain(seed: u64, radius: usize) -> Vec<f32> {
    let (base, normals) = (noise::hash(seed), Normals::table());
    let mut field: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| normals.at(base.wrapping_add(i as u64))).collect();
    for _ in 0..3 {
        field = box_mean_transposed(&field, WIDTH, HEIGHT, radius);
        field = box_mean_transposed(&field, HEIGHT, WIDTH, radius);
    }
    let variance = field.iter().map(|v| f64::from(v * v)).sum::<f64>() / field.len() as f64;
    let scale = (1.0 / variance.sqrt()) as f32;
    field.iter_mut().for_each(|v| *v *= scale);
    field
}

/// Box mean along rows, wrapping around; the result is transposed.
fn box_mean_transposed(field: &[f32], width: usize, height: usize, radius: usize) -> Vec<f32> {
    let mut out = vec![0.0; field.len()];
    for (y, row) in field.chunks_exact(width).enumerate() {
        let mut sum: f32 = row[width - radius..].iter().sum::<f32>() + row[..=radius].iter().sum::<f32>();
        for x in 0..width {
            out[x * height + y] = sum / (2 * radius + 1) as f32;
            sum += row[(x + radius + 1) % width] - row[(x + width - radius) % width];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bare_skin_has_the_contrast_that_tracking_needs() {
        let skin = Skin::new(1, &[]);
        let sample = |x: f32, y: f32| skin.albedo(Skin::texel_of(x, y));
        let forehead: Vec<f32> = (0..4000).map(|i| sample((i % 80) as f32 - 40.0, 60.0 + (i / 80) as f32)).collect();
        let mean = forehead.iter().sum::<f32>() / 4000.0;
        let sd = (forehead.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 4000.0).sqrt() / mean;
        assert!((0.06..0.14).contains(&sd), "contrast {sd}");
        assert!(sample(EYE_X_MM, EYE_Y_MM) < 0.2 && sample(30.0, 46.0) < 0.45, "pupil and brow are dark");
    }

    #[test]
    fn seeds_differ_and_repeat() {
        assert_eq!(Skin::new(4, &[]).texels, Skin::new(4, &[]).texels);
        assert_ne!(Skin::new(4, &[]).texels, Skin::new(5, &[]).texels);
    }
}
