//! The talking head: a sheet over the face with movements added to it.
//!
//! Face frame: x to the picture's right, y up, z out of the face, millimetres, origin between the eyes and the nose's root.
//! Every vertex keeps its rest position (x, y) as its place in the skin ([`super::skin`]), so texture moves with the material.

use super::motion::Posture;
use super::scene::grid_triangles;
use glam::{Vec2, Vec3};

/// Vertices along a row.
pub const COLUMNS: usize = 204;
/// Lowest and highest row, mm.
const BOTTOM_MM: f32 = -113.0;
const TOP_MM: f32 = 117.0;
/// Height of the mouth's corners, mm.
pub const MOUTH_Y_MM: f32 = -50.0;
/// Centres of the eyes, mm.
pub const EYE_X_MM: f32 = 31.0;
/// Height of the eyes, mm.
pub const EYE_Y_MM: f32 = 23.0;
/// Axis about which the jaw turns: height and depth, mm.
const HINGE_MM: [f32; 2] = [2.0, -88.0];

/// Smooth step from 0 at `from` to 1 at `to` (in either order).
pub fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let s = ((x - from) / (to - from)).clamp(0.0, 1.0);
    s * s * (3.0 - 2.0 * s)
}

/// The square.
pub fn squared(x: f32) -> f32 {
    x * x
}

/// Gaussian of height 1 and deviation 1, the same on every machine.
pub fn gauss(x: f32) -> f32 {
    libm::expf(-0.5 * x * x)
}

/// Elliptic Gaussian of height 1.
pub fn bump(x: f32, y: f32, centre: [f32; 2], sigma: [f32; 2]) -> f32 {
    libm::expf(-0.5 * (squared((x - centre[0]) / sigma[0]) + squared((y - centre[1]) / sigma[1])))
}

/// Lower and upper edge of the open eye at `dx` from its centre, mm.
pub fn lid_edges(dx: f32) -> [f32; 2] {
    let arc = (1.0 - squared(dx / 14.0)).max(0.0);
    [EYE_Y_MM - 4.0 * arc, EYE_Y_MM + 5.5 * arc]
}

/// How far (0..=1) a place is inside the open eye, x taken as its distance from the middle of the face.
pub fn inside_eye(x: f32, y: f32) -> f32 {
    let dx = x.abs() - EYE_X_MM;
    let [low, high] = lid_edges(dx);
    smoothstep(-0.2, 0.9, (y - low).min(high - y)) * smoothstep(14.0, 12.5, dx.abs())
}

/// Height of the line between the lips at rest: the corners a little lower than the middle.
pub fn mouth_line_mm(x: f32) -> f32 {
    MOUTH_Y_MM + 1.2 * gauss(x / 9.0) - 0.5 * gauss(x / 3.0)
}

/// Half the width of the visible face at height `y`, mm.
fn half_width_mm(y: f32) -> f32 {
    let q = ((y - 8.0) / if y > 8.0 { 113.5 } else { 125.0 }).abs();
    let power = if y > 8.0 { 2.5 } else { 2.2 };
    87.0 * libm::powf((1.0 - libm::powf(q, power)).max(0.0), 1.0 / 2.2) * (1.0 - 0.16 * smoothstep(-10.0, -90.0, y))
}

/// Larger of two numbers, rounded off over a width of about 2 mm.
fn soft_max(a: f32, b: f32) -> f32 {
    0.5 * (a + b + ((a - b) * (a - b) + 2.0).sqrt())
}

/// Depth of the face at rest, mm; with lids down where `eyes_open` is false.
fn depth_mm(x: f32, y: f32, eyes_open: bool) -> f32 {
    let ax = x.abs();
    let q = libm::powf(ax / 106.0, 2.4) + libm::powf(((y - 10.0) / if y > 10.0 { 150.0 } else { 168.0 }).abs(), 2.4);
    let mut z = 85.0 * (libm::powf((1.0 - q).max(0.0), 1.0 / 2.4) - 1.0);
    let at = |cx: f32, cy: f32, sx: f32, sy: f32| bump(ax, y, [cx, cy], [sx, sy]);
    z += 5.0 * gauss((y - 45.0 + 0.004 * x * x) / 8.5) * smoothstep(72.0, 30.0, ax);
    z += 4.0 * at(0.0, 82.0, 45.0, 25.0) - 4.0 * at(80.0, 45.0, 14.0, 28.0);
    z -= 10.0 * at(EYE_X_MM, EYE_Y_MM + 1.0, 15.0, 10.5) + 5.0 * at(13.0, EYE_Y_MM + 3.0, 6.0, 9.0);
    z += 5.0 * at(47.0, -8.0, 19.0, 20.0) - 3.0 * at(52.0, -52.0, 15.0, 20.0);
    z += nose_mm(x, y) + mouth_mm(x, y);
    let fold = (ax - 18.0) / 15.0;
    let fold_y = -24.0 - 26.0 * fold;
    z -= 1.3 * gauss((y - fold_y) / 4.5) * smoothstep(-0.2, 0.3, fold) * smoothstep(1.3, 0.7, fold);
    z += 11.0 * at(0.0, -89.0, 17.0, 13.0);
    with_eyeball(ax, y, z, eyes_open)
}

fn nose_mm(x: f32, y: f32) -> f32 {
    let ax = x.abs();
    let along = ((36.0 - y) / 52.0).clamp(0.0, 1.0);
    let width = 6.5 + 4.0 * along;
    let ridge = 21.0 * libm::powf(along, 1.15) * smoothstep(-33.0, -15.0, y) * gauss(x / width);
    let tip = 5.0 * bump(x, y, [0.0, -15.0], [8.5, 8.0]);
    let wings = 8.0 * bump(ax, y, [12.5, -20.0], [5.0, 6.5]);
    let nostrils = 3.0 * bump(ax, y, [6.5, -28.0], [3.0, 2.4]);
    ridge + tip + wings - nostrils
}

fn mouth_mm(x: f32, y: f32) -> f32 {
    let ax = x.abs();
    let from_line = y - mouth_line_mm(x);
    let lip = |height: f32, sigma: f32| gauss((from_line - height) / sigma);
    let upper_height = 5.2 - 0.8 * bump(x, 0.0, [0.0, 0.0], [3.0, 1.0]);
    let upper = 4.6 * lip(upper_height, 3.0) * smoothstep(28.0, 12.0, ax);
    let lower = 5.8 * lip(-6.0, 3.8) * smoothstep(25.0, 10.0, ax);
    let line = 3.0 * lip(0.0, 1.6) * smoothstep(29.0, 22.0, ax);
    let muzzle = 7.0 * bump(x, y, [0.0, -50.0], [28.0, 19.0]);
    let philtrum = bump(ax, y, [4.5, -37.0], [2.2, 6.0]) - 1.3 * bump(x, y, [0.0, -37.0], [2.4, 6.0]);
    let chin_fold = 4.0 * bump(x, y, [0.0, -69.0], [16.0, 5.0]);
    muzzle + upper + lower - line + philtrum - chin_fold
}

fn with_eyeball(ax: f32, y: f32, z: f32, eyes_open: bool) -> f32 {
    let r2 = squared(ax - EYE_X_MM) + squared(y - EYE_Y_MM);
    // Beside the ball a cone falls away, so that the larger of the two stays the face.
    let front = |radius: f32| {
        let rest = radius * radius - r2;
        if rest > 0.0 { -19.0 + rest.sqrt() } else { -19.0 - 4.0 * (r2.sqrt() - radius) }
    };
    let lids = soft_max(z, front(13.6));
    if !eyes_open {
        return lids;
    }
    let inside = inside_eye(ax, y);
    lids * (1.0 - inside) + front(12.4).max(z) * inside
}

/// Movement of every vertex for one movement's full amount, for the rows it touches.
#[derive(Debug, Clone)]
struct Movement {
    first: usize,
    shift_mm: Vec<Vec3>,
}

impl Movement {
    /// Keeps the rows in which anything moves.
    fn new(shift_mm: Vec<Vec3>) -> Self {
        let moves = |row: &[Vec3]| row.iter().any(|s| s.length_squared() > 1e-8);
        let mut rows = shift_mm.chunks_exact(COLUMNS);
        let first = rows.clone().position(moves).unwrap_or(0) * COLUMNS;
        let last = rows.rposition(moves).map_or(first, |row| (row + 1) * COLUMNS);
        Self { first, shift_mm: shift_mm[first..last].to_vec() }
    }

    fn add(&self, amount: f32, positions_mm: &mut [Vec3]) {
        if amount == 0.0 {
            return;
        }
        let touched: &mut [f32] =
            bytemuck::cast_slice_mut(&mut positions_mm[self.first..self.first + self.shift_mm.len()]);
        for (p, s) in touched.iter_mut().zip(bytemuck::cast_slice::<Vec3, f32>(&self.shift_mm)) {
            *p += amount * s;
        }
    }
}

/// The face: a grid of [`COLUMNS`] vertices a row, rows from the forehead down.
#[derive(Debug, Clone)]
pub struct Face {
    /// Rest positions in the face frame, mm.
    pub rest_mm: Vec<Vec3>,
    jaw_sine: Movement,
    jaw_versine: Movement,
    mouth_pocket: Movement,
    smile: Movement,
    pucker: Movement,
    blink: Movement,
    brow: Movement,
}

impl Face {
    /// Builds the sheet and its movements.
    pub fn new() -> Self {
        let mut places = Vec::new();
        for y in row_heights_mm() {
            let half = half_width_mm(y);
            places.extend((0..COLUMNS).map(|c| Vec2::new(half * (2.0 * c as f32 / (COLUMNS - 1) as f32 - 1.0), y)));
        }
        let rest_mm: Vec<Vec3> = places.iter().map(|p| p.extend(depth_mm(p.x, p.y, true))).collect();
        let movement = |shift: fn(Vec3) -> Vec3| Movement::new(rest_mm.iter().map(|&p| shift(p)).collect());
        Self {
            jaw_sine: movement(|p| jaw_weight(p) * Vec3::new(0.0, HINGE_MM[1] - p.z, p.y - HINGE_MM[0])),
            jaw_versine: movement(|p| jaw_weight(p) * Vec3::new(0.0, HINGE_MM[0] - p.y, HINGE_MM[1] - p.z)),
            mouth_pocket: movement(|p| Vec3::NEG_Z * bump(p.x, p.y, [0.0, mouth_line_mm(p.x)], [13.0, 1.1])),
            smile: movement(smile_shift),
            pucker: movement(pucker_shift),
            blink: movement(blink_shift),
            brow: movement(brow_shift),
            rest_mm,
        }
    }

    /// Rows of the grid.
    pub fn rows(&self) -> usize {
        self.rest_mm.len() / COLUMNS
    }

    /// Positions in the scan frame for a posture, mm.
    pub fn pose(&self, posture: &Posture, out: &mut Vec<Vec3>) {
        out.clear();
        out.extend_from_slice(&self.rest_mm);
        self.jaw_sine.add(libm::sinf(posture.jaw_rad), out);
        self.jaw_versine.add(1.0 - libm::cosf(posture.jaw_rad), out);
        self.mouth_pocket.add(130.0 * posture.jaw_rad, out);
        self.smile.add(posture.smile, out);
        self.pucker.add(posture.pucker, out);
        self.blink.add(posture.blink, out);
        self.brow.add(posture.brow, out);
        for p in out.iter_mut() {
            *p = posture.rotation * *p + posture.centre_mm;
        }
    }

    /// Triangles of the sheet, counter-clockwise seen from outside.
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        grid_triangles(COLUMNS, self.rows())
    }
}

/// Heights of the rows from the top down: closer together at the mouth and the eyes.
fn row_heights_mm() -> Vec<f32> {
    let mut heights = Vec::new();
    let mut y = TOP_MM;
    while y > BOTTOM_MM {
        heights.push(y);
        let at = |centre: f32, sigma: f32| gauss((y - centre) / sigma);
        y -= 0.95 * (1.0 - 0.62 * at(MOUTH_Y_MM, 3.5) - 0.35 * at(EYE_Y_MM, 7.0));
    }
    heights
}

/// Part of the jaw's turn a place takes: none above the line between the lips, all below, a soft change in the cheeks.
fn jaw_weight(p: Vec3) -> f32 {
    let softness = 0.9 + 34.0 * smoothstep(19.0, 62.0, p.x.abs());
    smoothstep(mouth_line_mm(p.x) + softness, mouth_line_mm(p.x) - softness, p.y)
        * (1.0 - 0.5 * smoothstep(50.0, 90.0, p.x.abs()))
}

fn smile_shift(p: Vec3) -> Vec3 {
    let ax = p.x.abs();
    let corner = bump(ax, p.y, [28.0, -50.0], [15.0, 14.0]);
    let cheek = bump(ax, p.y, [44.0, -14.0], [20.0, 18.0]);
    Vec3::new(
        p.x.signum() * 6.0 * corner * smoothstep(0.0, 20.0, ax),
        4.5 * corner + 2.5 * cheek,
        2.5 * cheek - 2.0 * corner,
    )
}

fn pucker_shift(p: Vec3) -> Vec3 {
    let lips = bump(p.x, p.y, [0.0, -50.0], [19.0, 11.0]);
    Vec3::new(-0.28 * p.x * bump(p.x, p.y, [0.0, -50.0], [26.0, 14.0]), 0.0, 5.0 * lips)
}

fn brow_shift(p: Vec3) -> Vec3 {
    let lift = bump(p.x.abs(), p.y, [28.0, 47.0], [22.0, 13.0]) + 0.6 * bump(p.x, p.y, [0.0, 50.0], [20.0, 12.0]);
    Vec3::new(0.0, 4.5 * lift, 0.0)
}

/// The upper lid comes down over the eye, which folds into a thin line behind it.
fn blink_shift(p: Vec3) -> Vec3 {
    let [low, high] = lid_edges(p.x.abs() - EYE_X_MM);
    let open = 0.93 * (high - low);
    let above = ((p.y - high) / 15.0).clamp(0.0, 1.0);
    let drop = if p.y <= low {
        0.0
    } else if p.y < high {
        0.93 * (p.y - low)
    } else {
        open * squared(1.0 - above) * (1.0 + 2.0 * above)
    };
    let closed = depth_mm(p.x, p.y - drop, false);
    let near_eye = (p.x.abs() - EYE_X_MM).abs() < 14.5 && drop > 0.0;
    Vec3::new(0.0, -drop, if near_eye { closed - p.z } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sheet_is_a_face_in_size_and_triangle_count() {
        let face = Face::new();
        assert!((90_000..120_000).contains(&face.triangles().len()), "{}", face.triangles().len());
        let (lo, hi) =
            face.rest_mm.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
        let size = hi - lo;
        assert!((160.0..185.0).contains(&size.x) && (220.0..240.0).contains(&size.y), "{size}");
        let nose = face.rest_mm.iter().max_by(|a, b| a.z.total_cmp(&b.z)).unwrap();
        assert!(nose.x.abs() < 2.0 && (-20.0..-8.0).contains(&nose.y), "the tip of the nose is foremost: {nose}");
    }

    #[test]
    fn no_posture_folds_the_outside_in() {
        let face = Face::new();
        let triangles = face.triangles();
        let mut positions = Vec::new();
        for millis in (0..8000i64).step_by(100) {
            face.pose(&Posture::at(millis * 1_000_000, 1, 1.0), &mut positions);
            let folded = triangles
                .iter()
                .filter(|t| {
                    let [a, b, c] = t.map(|v| positions[v as usize]);
                    (b - a).cross(c - a).z < 0.0
                })
                .count();
            // Behind the lips the sheet may fold: no camera sees it.
            assert!(folded < triangles.len() / 100, "{folded} at {millis} ms");
        }
    }
}
