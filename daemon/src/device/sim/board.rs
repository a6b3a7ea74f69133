//! A calibration board before the simulated scanner: a printed chessboard with a white margin, in any pose.

use super::noise;
use super::skin::{Skin, TEXEL_MM};
use crate::device::DeviceError;
use crate::light::{Board, Calibration, Intrinsics, Rigid};
use glam::{DMat3, DVec2, DVec3, Vec3};
use gv3_codec::mesh::TriMesh;
use serde::{Deserialize, Serialize};

/// Albedo of paper and of print.
const LIGHT: f64 = 0.55;
const DARK: f64 = 0.05;
/// White margin around the printed squares, squares.
const MARGIN: f64 = 1.0;
/// Largest side of a cell of the mesh, mm: perspective and lenses are straight within it.
const CELL_MM: f64 = 2.0;
/// Middle of the working range, where the board stands unless it is moved, camera frame.
const CENTRE_MM: DVec3 = DVec3::new(0.0, 0.0, 600.0);

/// Tilts drawn for calibration, degrees: less tells little of the focal length, more blurs in depth.
const TILTS_DEG: [f64; 2] = [10.0, 35.0];
/// Least distance of the outermost corners from the pictures' borders, pixels.
const BORDER_PX: f64 = 12.0;

/// A chessboard and its pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoardScene {
    /// Inner corners along a row; the square before the first corner is dark.
    pub columns: u32,
    /// Inner corners along a column.
    pub rows: u32,
    /// Side of a square, mm.
    pub square_mm: f64,
    /// Turns about the camera's axes x (right), y (down) and z (forward), in this order, degrees.
    #[serde(default)]
    pub turns_deg: [f64; 3],
    /// Where the board's middle is: right, down and forward of the point 600 mm before the camera, mm.
    #[serde(default)]
    pub shift_mm: [f64; 3],
}

impl BoardScene {
    /// A board upright in the middle of the working range.
    pub fn new(board: Board) -> Self {
        let Board { columns, rows, square_mm } = board;
        Self { columns, rows, square_mm, turns_deg: [0.0; 3], shift_mm: [0.0; 3] }
    }

    /// The board without its pose.
    pub fn board(&self) -> Board {
        Board { columns: self.columns, rows: self.rows, square_mm: self.square_mm }
    }

    /// Poses for a calibration: tilted by up to 35 degrees every way, turned, and all over the field and the depth that camera
    /// and projector share. The same seed draws the same poses.
    ///
    /// # Errors
    /// [`DeviceError::Config`] for a board that cannot be, or that hardly fits the pictures.
    pub fn draw(board: Board, rig: &Calibration, seed: u64, count: usize) -> Result<Vec<Self>, DeviceError> {
        const MAX_DRAWS: u64 = 2000;
        Self::new(board).validate()?;
        let mut poses = Vec::new();
        for n in 0..MAX_DRAWS * count as u64 {
            if poses.len() == count {
                break;
            }
            // 24 bits are exact in f64.
            let mut at = noise::hash(noise::hash(seed) ^ n);
            let mut uniform = || {
                at = noise::hash(at);
                (at >> 40) as f64 / 16_777_216.0
            };
            let tilt_deg = TILTS_DEG[0] + (TILTS_DEG[1] - TILTS_DEG[0]) * uniform();
            let (s, c) = libm::sincos(std::f64::consts::TAU * uniform());
            let mut within = |reach: f64| reach * (2.0 * uniform() - 1.0);
            let pose = Self {
                turns_deg: [c * tilt_deg, s * tilt_deg, within(25.0)],
                shift_mm: [within(90.0), within(70.0), within(60.0)],
                ..Self::new(board)
            };
            if pose.is_in_view(rig) {
                poses.push(pose);
            }
        }
        if poses.len() == count {
            return Ok(poses);
        }
        let reason = format!(
            "{} mm: the board hardly fits the pictures of camera and projector; take smaller squares or fewer",
            board.square_mm
        );
        Err(DeviceError::config("board.square_mm", reason))
    }

    /// Whether camera and projector see all corners.
    fn is_in_view(&self, rig: &Calibration) -> bool {
        let (board, pose) = (self.board(), self.camera_from_board());
        let is_inside = |px: DVec2, lens: &Intrinsics| {
            let size = DVec2::new(f64::from(lens.width_px), f64::from(lens.height_px));
            px.min_element() > BORDER_PX && (size - 1.0 - px).min_element() > BORDER_PX
        };
        (0..board.corner_count()).all(|i| {
            let corner = pose.apply(DVec2::from(board.corner_mm(i)).extend(0.0));
            is_inside(rig.camera.project(corner), &rig.camera) && is_inside(rig.projector_px(corner), &rig.projector)
        })
    }

    /// Checks the board, that it fits the simulator's print, and that it stands before the lenses.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field.
    pub fn validate(&self) -> Result<(), DeviceError> {
        self.board().validate()?;
        let (size, most) = (2.0 * self.half_mm(), 2.0 * Skin::HALF_SIZE_MM.as_dvec2());
        if size.cmpgt(most).any() {
            let reason = format!(
                "the board with its margin is {:.0} x {:.0} mm, and at most {:.0} x {:.0} mm can be simulated; \
                 take smaller squares",
                size.x, size.y, most.x, most.y
            );
            return Err(DeviceError::config("sim.scene.board.square_mm", reason));
        }
        let is_turned = self.turns_deg[..2].iter().all(|a| a.abs() <= 80.0) && self.turns_deg[2].abs() <= 360.0;
        if !is_turned {
            let reason = "expected up to 80 degrees about x and y, 360 about z";
            return Err(DeviceError::config("sim.scene.board.turns_deg", reason));
        }
        if !self.shift_mm.iter().all(|s| s.abs() <= 200.0) {
            return Err(DeviceError::config("sim.scene.board.shift_mm", "expected up to 200 mm each way"));
        }
        Ok(())
    }

    /// Half the size of the sheet, mm.
    fn half_mm(&self) -> DVec2 {
        let squares = DVec2::new(f64::from(self.columns), f64::from(self.rows)) + 1.0 + 2.0 * MARGIN;
        0.5 * self.square_mm * squares
    }

    /// The board's middle from corner 0, mm.
    fn middle_mm(&self) -> DVec2 {
        0.5 * self.square_mm * (DVec2::new(f64::from(self.columns), f64::from(self.rows)) - 1.0)
    }

    /// True pose: a point in the camera's frame from one of the board's, whose origin is corner 0, x along the rows, y along the
    /// columns. For tests and reports.
    pub fn camera_from_board(&self) -> Rigid {
        let [x, y, z] = self.turns_deg.map(f64::to_radians);
        let rotation = DMat3::from_rotation_z(z) * DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x);
        let middle = CENTRE_MM + DVec3::from(self.shift_mm);
        Rigid::new(rotation, middle - rotation * self.middle_mm().extend(0.0))
    }

    /// The sheet in its pose, scan frame, and the places of its vertices on the print: right and up of the middle, mm.
    pub(super) fn mesh(&self) -> (TriMesh, Vec<Vec3>) {
        let half = self.half_mm();
        let [columns, rows] = [half.x, half.y].map(|h| (2.0 * h / CELL_MM).ceil() as usize + 1);
        let pose = self.camera_from_board();
        let place = |i: usize| {
            let at = |k: usize, n: usize| 2.0 * k as f64 / (n - 1) as f64 - 1.0;
            half * DVec2::new(at(i % columns, columns), at(i / columns, rows))
        };
        let places: Vec<DVec2> = (0..columns * rows).map(place).collect();
        let posed = |p: &DVec2| {
            let q = pose.apply((*p + self.middle_mm()).extend(0.0));
            DVec3::new(q.x, -q.y, -q.z).as_vec3()
        };
        let mesh = TriMesh {
            positions_mm: places.iter().map(posed).collect(),
            triangles: super::scene::grid_triangles(columns, rows),
            uv: None,
        };
        (mesh, places.iter().map(|p| Vec3::new(p.x as f32, -p.y as f32, 0.0)).collect())
    }

    /// Mean albedo of the texel around a place on the print: right and up of the middle, mm. Exact areas keep the edges where
    /// they are to a small fraction of a texel.
    pub(super) fn albedo(&self, x_mm: f32, y_mm: f32) -> f32 {
        // From the outer corner of the first square, in squares.
        let first = self.middle_mm() / self.square_mm + 1.0;
        let (x, y) = (f64::from(x_mm) / self.square_mm + first.x, first.y - f64::from(y_mm) / self.square_mm);
        let width = f64::from(TEXEL_MM) / self.square_mm;
        let [columns, rows] = [self.columns, self.rows].map(|n| f64::from(n) + 1.0);
        // With sign +1 or -1 by square, 0 beyond, a chessboard is a product: dark is (inside + sign sign) / 2.
        let (inside_x, sign_x) = stripes(x, width, columns);
        let (inside_y, sign_y) = stripes(y, width, rows);
        let dark = 0.5 * (inside_x * inside_y + sign_x * sign_y);
        (LIGHT + dark * (DARK - LIGHT)) as f32
    }
}

/// Over the window of a width around `x`: the part within 0..=count, and the mean of +1 in even and -1 in odd cells there.
fn stripes(x: f64, width: f64, count: f64) -> (f64, f64) {
    // Integrals from 0 to v.
    let inside = |v: f64| v.clamp(0.0, count);
    let sign = |v: f64| {
        let part = inside(v).rem_euclid(2.0);
        1.0 - (1.0 - part).abs()
    };
    let (a, b) = (x - 0.5 * width, x + 0.5 * width);
    ((inside(b) - inside(a)) / width, (sign(b) - sign(a)) / width)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::RigConfig;
    use crate::device::sim::{SceneConfig, SimWorld};
    use crate::light::find_chessboard;

    const BOARD: Board = Board { columns: 8, rows: 5, square_mm: 14.0 };

    #[test]
    fn a_print_has_even_squares_and_a_margin() {
        let scene = BoardScene::new(BOARD);
        let at = |column: f64, row: f64| {
            // Places in squares from the outer corner of the first one.
            let mm = (DVec2::new(column, row) - 1.0) * BOARD.square_mm - scene.middle_mm();
            f64::from(scene.albedo(mm.x as f32, -mm.y as f32))
        };
        let near = |a: f64, b: f64| (a - b).abs() < 1e-4;
        assert!(near(at(0.5, 0.5), DARK) && near(at(1.5, 0.5), LIGHT) && near(at(1.5, 1.5), DARK));
        assert!(near(at(-0.5, 0.5), LIGHT) && near(at(9.5, 1.5), LIGHT) && near(at(8.5, 5.5), LIGHT));
        let middle = 0.5 * (LIGHT + DARK);
        assert!(near(at(3.0, 3.0), middle) && near(at(0.0, 0.5), middle) && near(at(0.0, 0.0), LIGHT - 0.125));
    }

    #[test]
    fn corners_in_the_simulated_picture_are_where_the_truth_has_them() {
        let mut config = RigConfig::simulated();
        let rig = config.calibration().unwrap();
        let poses = BoardScene::draw(BOARD, &rig, 3, 3).unwrap();
        assert_eq!(poses, BoardScene::draw(BOARD, &rig, 3, 3).unwrap());
        assert!(poses.iter().all(|p| p.is_in_view(&rig)));
        for scene in poses {
            config.sim.scene = SceneConfig::Board(scene);
            config.sim.ambient = 1.0;
            let found =
                find_chessboard(&SimWorld::new(&config).unwrap().expose(0, None, 5_000_000, 0), &BOARD).unwrap();
            let pose = scene.camera_from_board();
            let truth = |i: usize| rig.camera.project(pose.apply(DVec2::from(BOARD.corner_mm(i)).extend(0.0)));
            let errors: Vec<f64> = (0..40).map(|i| DVec2::from(found[i]).distance(truth(i))).collect();
            let rms_px = (errors.iter().map(|e| e * e).sum::<f64>() / 40.0).sqrt();
            println!("rms {rms_px:.4} px");
            assert!(rms_px < 0.08, "{rms_px} px: {scene:?}");
        }
    }

    #[test]
    fn boards_that_cannot_be_simulated_are_named() {
        let error = |change: fn(&mut BoardScene)| {
            let mut scene = BoardScene::new(BOARD);
            change(&mut scene);
            let mut config = RigConfig::simulated();
            config.sim.scene = SceneConfig::Board(scene);
            SimWorld::new(&config).err().unwrap().to_string()
        };
        assert!(error(|s| s.columns = 1).starts_with("board.columns"));
        assert!(error(|s| s.square_mm = 30.0).contains("at most 192 x 248 mm"));
        assert!(error(|s| s.turns_deg[1] = f64::NAN).starts_with("sim.scene.board.turns_deg"));
        assert!(error(|s| s.shift_mm[2] = -500.0).starts_with("sim.scene.board.shift_mm"));
        let large = Board { columns: 12, rows: 12, square_mm: 12.5 };
        let mut rig = RigConfig::simulated().calibration().unwrap();
        rig.camera.fx_px *= 4.0;
        assert!(BoardScene::draw(large, &rig, 1, 2).unwrap_err().to_string().contains("hardly fits"));
    }
}
