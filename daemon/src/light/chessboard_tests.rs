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
        const SAMPLES: u8 = 64;
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
            // Hammersley's points: all columns and rows differ, so upright edges are placed to a 64th of a pixel too.
            let sample = |n: u8| {
                let [u, v] = [n, n.reverse_bits() >> 2].map(|k| (f64::from(k) + 0.5) / f64::from(SAMPLES));
                self.print(a.lerp(b, u).lerp(c.lerp(d, u), v)).unwrap_or(wall[i])
            };
            let is_flat = cells.iter().all(|cell| *cell == cells[0]);
            if is_flat { sample(0) } else { (0..SAMPLES).map(sample).sum::<f64>() / f64::from(SAMPLES) }
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
    (sum / count).sqrt()
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

/// Puts a rectangle of one level over a picture.
fn cover(picture: &mut GreyPicture, [x, y]: [u32; 2], [dx, dy]: [u32; 2], level: u8) {
    let w = picture.width_px as usize;
    for row in y..(y + dy).min(picture.height_px) {
        let end = ((x + dx) as usize).min(w);
        picture.pixels[row as usize * w..][x as usize..end].fill(level);
    }
}

#[test]
fn small_large_tilted_blurred_unlit_and_cluttered_boards_are_found() {
    let tilt = 50f64.to_radians();
    let case = |name: &str, bound_px: f64, shot: Shot| (name.to_owned(), bound_px, shot);
    let far = |z_mm: f64| DVec3::new(12.0, -9.0, z_mm);
    let hard = Shot { noise_levels: 4.0, blur_px: 2.0, middle_mm: far(500.0), ..Shot::default() };
    let large = Board { columns: 5, rows: 3, square_mm: 60.0 };
    let mut cases = vec![
        case("10 px", 0.1, Shot { middle_mm: far(2000.0), blur_px: 0.7, noise_levels: 2.0, ..Shot::default() }),
        case("100 px", 0.05, Shot { board: large, blur_px: 0.7, noise_levels: 2.0, ..Shot::default() }),
        case("100 px, hard", 0.2, Shot { board: large, ..hard.clone() }),
        case("a quarter of the light", 0.2, Shot { left_light: 0.25, ..hard.clone() }),
        case("clutter", 0.2, Shot { is_cluttered: true, ..hard.clone() }),
        case("square", 0.2, Shot { board: Board { columns: 6, rows: 6, square_mm: 20.0 }, ..hard.clone() }),
    ];
    for turn in [0.0, 0.4, std::f64::consts::FRAC_PI_4, 2.0] {
        for (x, y) in [(tilt, 0.0), (0.0, -tilt), (0.6, 0.6)] {
            let turns_rad = [x, y, turn];
            let shot = Shot { turns_rad, middle_mm: far(650.0), blur_px: 1.0, noise_levels: 4.0, ..Shot::default() };
            cases.push(case(&format!("turned {turns_rad:.2?}"), 0.12, shot));
        }
    }
    for (name, bound_px, shot) in cases {
        let rms_px = rms(shot.errors_px());
        println!("{name}: rms {rms_px:.3} px");
        assert!(rms_px < bound_px, "{name}: {rms_px} px");
    }
}

#[test]
fn the_order_is_the_stated_one_however_the_board_is_turned() {
    for (columns, rows) in [(7, 4), (5, 4), (5, 3), (4, 4), (5, 5)] {
        for step in 0..12 {
            let shot = Shot {
                board: Board { columns, rows, square_mm: 20.0 },
                // Off the diagonals, where two orders are nearly alike.
                turns_rad: [0.3, -0.2, 0.1 + std::f64::consts::TAU * f64::from(step) / 12.0],
                is_first_dark: step % 2 == 0,
                ..Shot::default()
            };
            let found = find_chessboard(&shot.picture(), &shot.board).unwrap();
            let found: Vec<DVec2> = found.into_iter().map(DVec2::from).collect();
            let (truth, n) = (shot.truth(), found.len());
            let name = format!("{columns} x {rows}, step {step}");
            // A set of places, and no mirror image.
            for p in &truth {
                assert!(found.iter().any(|f| f.distance(*p) < 0.1), "{name}");
            }
            let (along, down) = (found[1] - found[0], found[columns as usize] - found[0]);
            assert!(along.perp_dot(down) > 0.0, "{name} is mirrored");
            let reversed: Vec<DVec2> = truth.iter().rev().copied().collect();
            let is_like = |order: &[DVec2]| order.iter().zip(&found).all(|(a, b)| a.distance(*b) < 0.1);
            if (columns + rows) % 2 == 1 {
                assert!(is_like(if shot.is_first_dark { &truth } else { &reversed }), "{name}");
            } else {
                let diagonal = found[n - 1] - found[0];
                assert!(diagonal.x + diagonal.y > 0.0, "{name}");
                assert!(columns == rows || is_like(&truth) || is_like(&reversed), "{name}");
                // Squares before both ends of a diagonal are alike, and of an odd board's diagonals one has dark ones.
                let is_along = is_like(&truth) || is_like(&reversed);
                assert!((columns, rows) != (5, 5) || is_along == shot.is_first_dark, "{name}");
            }
        }
    }
}

#[test]
fn what_is_no_whole_board_is_an_error_that_says_what_was_found() {
    let shot = Shot { is_cluttered: true, noise_levels: 2.0, blur_px: 0.7, ..Shot::default() };
    let board = shot.board;
    let error = |picture: &GreyPicture, board: Board| find_chessboard(picture, &board).unwrap_err();
    let empty = Shot { middle_mm: DVec3::new(5000.0, 0.0, 600.0), ..shot.clone() }.picture();
    let none = error(&empty, board);
    assert!(matches!(none, ChessboardError::NotFound { corners: 0..12, wanted: [9, 6], .. }), "{none}");
    let whole = shot.picture();
    let ChessboardError::NotFound { corners, found, .. } = error(&whole, Board { columns: 8, ..board }) else {
        panic!()
    };
    assert_eq!((corners, found), (54, [9, 6]));
    // The last column under a sheet of any grey.
    for level in [0, 30, 110, 190, 255] {
        let mut picture = whole.clone();
        let last = shot.truth()[8].x as u32;
        cover(&mut picture, [last - 6, 0], [200, 480], level);
        let ChessboardError::NotFound { corners, found, .. } = error(&picture, board) else { panic!() };
        assert_eq!((corners, found), (48, [8, 6]), "level {level}");
    }
    let text = none.to_string();
    assert!(text.contains("not the board's 9 x 6") && text.contains("show the whole board"), "{text}");
    let bad = error(&whole, Board { rows: 1, ..board }).to_string();
    assert!(bad.starts_with("board.rows: 1 inner corners"), "{bad}");
    for (w, h) in [(0, 0), (1, 1), (3, 200), (200, 2), (12, 12)] {
        assert!(find_chessboard(&GreyPicture::filled(w, h, 7), &board).is_err());
    }
}

#[test]
fn two_boards_are_an_error_unless_only_one_has_the_size() {
    let small = Board { columns: 5, rows: 4, square_mm: 14.0 };
    let at = |x_mm: f64, board: Board| Shot {
        board,
        middle_mm: DVec3::new(x_mm, 0.0, 600.0),
        noise_levels: 2.0,
        ..Shot::default()
    };
    let beside = |left: &Shot, right: &Shot| {
        let (mut picture, other) = (left.picture(), right.picture());
        for (row, from) in picture.pixels.chunks_exact_mut(640).zip(other.pixels.chunks_exact(640)) {
            row[320..].copy_from_slice(&from[320..]);
        }
        picture
    };
    let two = beside(&at(-90.0, small), &at(90.0, small));
    let error = find_chessboard(&two, &small).unwrap_err();
    assert_eq!(error, ChessboardError::Several { count: 2, wanted: [5, 4] });
    let other = Board { rows: 3, ..small };
    let right = at(90.0, other);
    let found = find_chessboard(&beside(&at(-90.0, small), &right), &other).unwrap();
    assert!(rms(found.iter().zip(right.truth()).map(|(f, t)| DVec2::from(*f).distance(t))) < 0.1);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn an_answer_is_right_or_an_error(
        turns in prop::array::uniform3(-0.8f64..0.8), z_mm in 450.0f64..1800.0, seed in any::<u64>(),
        blur_px in 0.0f64..2.0, noise_levels in 0.0f64..4.0, left_light in 0.4f64..1.0,
        (x, y, dx, dy, level) in (0u32..640, 0u32..480, 0u32..120, 0u32..120, any::<u8>()), is_covered in any::<bool>()
    ) {
        // What is left of a corner under a sheet's border shows up against noise no larger than it.
        let clear = if is_covered { 0.4 } else { 1.0 };
        let shot = Shot {
            turns_rad: turns,
            middle_mm: DVec3::new(0.0, 0.0, z_mm),
            seed,
            blur_px: clear * blur_px,
            noise_levels: clear * noise_levels,
            left_light,
            is_cluttered: true,
            ..Shot::default()
        };
        prop_assume!(shot.is_in_view(25.0));
        let mut picture = shot.picture();
        if is_covered {
            cover(&mut picture, [x, y], [dx, dy], level);
        }
        let truth = shot.truth();
        let (low, high) = (DVec2::new(f64::from(x), f64::from(y)), DVec2::new(f64::from(x + dx), f64::from(y + dy)));
        let is_hidden = |p: &DVec2| is_covered && (*p - low).min_element() > 3.0 && (high - *p).min_element() > 4.0;
        match find_chessboard(&picture, &shot.board) {
            Ok(found) => {
                prop_assert!(!truth.iter().any(is_hidden));
                let reversed = DVec2::from(found[0]).distance(truth[0]) > DVec2::from(found[0]).distance(truth[53]);
                for (i, f) in found.iter().enumerate() {
                    let t = truth[if reversed { 53 - i } else { i }];
                    let bound_px = 1.0 + 0.02 * shot.spacings_px().1;
                    prop_assert!(DVec2::from(*f).distance(t) < bound_px, "{} px at {t}", DVec2::from(*f).distance(t));
                }
            }
            Err(e) => {
                let is_small = shot.spacings_px().0 < 9.0;
                prop_assert!(is_covered || is_small, "{e}");
            }
        }
    }
}
