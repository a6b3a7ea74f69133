//! Boards rendered with known corners: every pixel is the mean of 64 samples of the printed board behind a distorting lens.

use super::*;
use crate::light::{Distortion, Intrinsics, Rigid};
use glam::{DMat3, DVec3};
use proptest::prelude::*;

/// What is photographed.
#[derive(Debug, Clone)]
pub(crate) struct Shot {
    pub board: Board,
    /// Whether the square before corner 0 is dark.
    pub is_first_dark: bool,
    pub camera: Intrinsics,
    /// Turns about x, y, z, radians, about the board's middle, and that middle in the camera's frame, mm.
    pub turns_rad: [f64; 3],
    pub middle_mm: DVec3,
    /// Standard deviations.
    pub blur_px: f64,
    pub noise_levels: f64,
    /// Light at the left border, of that at the right.
    pub left_light: f64,
    /// Whether the wall behind is full of rectangles.
    pub is_cluttered: bool,
    pub seed: u64,
}

fn lens(size_px: [u32; 2], f_px: f64) -> Intrinsics {
    Intrinsics {
        width_px: size_px[0],
        height_px: size_px[1],
        fx_px: f_px,
        fy_px: 1.002 * f_px,
        cx_px: 0.5 * f64::from(size_px[0]) + 3.2,
        cy_px: 0.5 * f64::from(size_px[1]) - 2.7,
        distortion: Distortion { k1: -0.12, k2: 0.08, p1: 4e-4, p2: -3e-4, k3: 0.0 },
    }
}

impl Default for Shot {
    fn default() -> Self {
        Self {
            board: Board { columns: 9, rows: 6, square_mm: 20.0 },
            is_first_dark: true,
            camera: lens([640, 480], 1000.0),
            turns_rad: [0.0; 3],
            middle_mm: DVec3::new(3.0, -2.0, 600.0),
            blur_px: 0.0,
            noise_levels: 0.0,
            left_light: 1.0,
            is_cluttered: false,
            seed: 1,
        }
    }
}

/// Uniform numbers 0..1.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as f64 / 2f64.powi(31)
    }

    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.next()).sum::<f64>() - 6.0
    }
}

impl Shot {
    fn middle_of_board_mm(&self) -> DVec3 {
        let Board { columns, rows, square_mm } = self.board;
        0.5 * square_mm * DVec3::new(f64::from(columns) - 1.0, f64::from(rows) - 1.0, 0.0)
    }

    pub fn camera_from_board(&self) -> Rigid {
        let [x, y, z] = self.turns_rad;
        let rotation = DMat3::from_rotation_z(z) * DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x);
        Rigid::new(rotation, self.middle_mm - rotation * self.middle_of_board_mm())
    }

    /// True places of the corners, pixels.
    pub fn truth(&self) -> Vec<DVec2> {
        let pose = self.camera_from_board();
        let corner = |i| self.camera.project(pose.apply(DVec2::from(self.board.corner_mm(i)).extend(0.0)));
        (0..self.board.corner_count()).map(corner).collect()
    }

    /// Distances of neighbours along rows and columns, the least and the largest, pixels.
    fn spacings_px(&self) -> (f64, f64) {
        let (truth, columns) = (self.truth(), self.board.columns as usize);
        let along = (0..truth.len()).filter(|i| i % columns > 0).map(|i| truth[i].distance(truth[i - 1]));
        let down = (columns..truth.len()).map(|i| truth[i].distance(truth[i - columns]));
        along.chain(down).fold((f64::MAX, 0.0), |(a, b), d| (a.min(d), b.max(d)))
    }

    fn is_in_view(&self, margin_px: f64) -> bool {
        let size = DVec2::new(f64::from(self.camera.width_px), f64::from(self.camera.height_px));
        self.truth().iter().all(|p| p.min_element() > margin_px && (size - *p).min_element() > margin_px)
    }

    /// Level of the board's plane at a place in squares, `None` beyond the white margin of one square.
    fn print(&self, square: DVec2) -> Option<f64> {
        const LIGHT: f64 = 190.0;
        const DARK: f64 = 30.0;
        let cell = square.floor() + 1.0;
        let count = DVec2::new(f64::from(self.board.columns), f64::from(self.board.rows)) + 1.0;
        if cell.min_element() < -1.0 || (count - cell).min_element() < 0.0 {
            return None;
        }
        let is_square = cell.min_element() >= 0.0 && (count - cell).min_element() >= 1.0;
        let is_even = (cell.x + cell.y).rem_euclid(2.0) < 0.5;
        Some(if is_square && is_even == self.is_first_dark { DARK } else { LIGHT })
    }

    pub fn picture(&self) -> GreyPicture {
        const SIDE: usize = 8;
        let (w, h) = (self.camera.width_px as usize, self.camera.height_px as usize);
        let board_from_camera = {
            let pose = self.camera_from_board();
            let (m, t) = (pose.matrix(), pose.translation());
            DMat3::from_cols(m.x_axis, m.y_axis, t).inverse()
        };
        // Board places at the corners of the pixels; within a pixel they are bilinear.
        let place = |x: usize, y: usize| {
            let ray = self.camera.unproject(DVec2::new(x as f64 - 0.5, y as f64 - 0.5)).unwrap();
            let p = board_from_camera * ray.extend(1.0);
            p.truncate() / p.z / self.board.square_mm
        };
        let places: Vec<DVec2> = (0..(w + 1) * (h + 1)).map(|i| place(i % (w + 1), i / (w + 1))).collect();
        let wall = self.wall();
        let level = |i: usize| {
            let (x, y) = (i % w, i / w);
            let at = |dx: usize, dy: usize| places[(y + dy) * (w + 1) + x + dx];
            let [a, b, c, d] = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
            let cells = [a, b, c, d].map(DVec2::floor);
            let sample = |n: usize| {
                let s = |k: usize| (k as f64 + 0.5) / SIDE as f64;
                let (u, v) = (s(n % SIDE), s(n / SIDE));
                self.print(a.lerp(b, u).lerp(c.lerp(d, u), v)).unwrap_or(wall[i])
            };
            let is_flat = cells.iter().all(|cell| *cell == cells[0]);
            if is_flat { sample(0) } else { (0..SIDE * SIDE).map(sample).sum::<f64>() / (SIDE * SIDE) as f64 }
        };
        let light = |i: usize| self.left_light + (1.0 - self.left_light) * (i % w) as f64 / w as f64;
        let values = (0..w * h).map(|i| (level(i) * light(i)) as f32).collect();
        let sharp = Field { width: w, height: h, values };
        let seen = if self.blur_px > 0.0 { sharp.blurred(self.blur_px) } else { sharp };
        let mut random = Random(self.seed);
        let pixel = |v: &f32| (f64::from(*v) + self.noise_levels * random.normal()).round() as u8;
        GreyPicture::new(w as u32, h as u32, seen.values.iter().map(pixel).collect())
    }

    /// Levels behind the board: even, or rectangles over rectangles.
    fn wall(&self) -> Vec<f64> {
        let (w, h) = (self.camera.width_px as usize, self.camera.height_px as usize);
        let mut wall = vec![110.0; w * h];
        if self.is_cluttered {
            let mut random = Random(self.seed ^ 0x5151);
            for _ in 0..400 {
                let mut part = |n: usize, most: f64| (random.next() * most * n as f64) as usize;
                let (x, y, dx, dy) = (part(w, 1.0), part(h, 1.0), part(w, 0.15), part(h, 0.15));
                let level = 20.0 + 200.0 * random.next();
                for row in y..(y + dy).min(h) {
                    wall[row * w..][x..(x + dx).min(w)].fill(level);
                }
            }
        }
        wall
    }

    /// Distances of the found corners from the true ones, pixels, whichever of the orders they are in.
    fn errors_px(&self) -> Vec<f64> {
        let found = find_chessboard(&self.picture(), &self.board).unwrap_or_else(|e| panic!("{e}: {self:?}"));
        let errors = |truth: &[DVec2]| -> Vec<f64> {
            found.iter().zip(truth).map(|(f, t)| DVec2::from(*f).distance(*t)).collect()
        };
        let mut truth = self.truth();
        let forward = errors(&truth);
        truth.reverse();
        let backward = errors(&truth);
        if forward[0] < backward[0] { forward } else { backward }
    }
}

fn rms(values: impl IntoIterator<Item = f64>) -> f64 {
    let (sum, count) = values.into_iter().fold((0.0, 0.0), |(s, n), v| (s + v * v, n + 1.0));
    (sum / count as f64).sqrt()
}

/// Shots over tilts, turns and distances.
fn shots() -> Vec<Shot> {
    let mut random = Random(7);
    let mut shots = Vec::new();
    while shots.len() < 12 {
        let mut part = |most: f64| most * (2.0 * random.next() - 1.0);
        let shot = Shot {
            turns_rad: [part(0.6), part(0.6), part(0.5)],
            middle_mm: DVec3::new(part(60.0), part(40.0), 700.0 + part(100.0)),
            seed: shots.len() as u64,
            ..Shot::default()
        };
        if shot.is_in_view(15.0) {
            shots.push(shot);
        }
    }
    shots
}

#[test]
fn corners_are_found_to_a_fraction_of_a_pixel() {
    for (noise_levels, blur_px, bound_px) in [(0.0, 0.0, 0.03), (0.0, 0.7, 0.03), (2.0, 0.7, 0.08), (4.0, 2.0, 0.2)] {
        let errors = shots().into_iter().flat_map(|s| Shot { noise_levels, blur_px, ..s }.errors_px());
        let rms_px = rms(errors);
        println!("noise {noise_levels} levels, blur {blur_px} px: rms {rms_px:.4} px");
        assert!(rms_px < bound_px, "noise {noise_levels}, blur {blur_px}: {rms_px} px");
    }
}
