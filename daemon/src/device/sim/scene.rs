//! What stands before the scanner: the talking head, or a solid of known form that only the configured velocity moves.

use super::board::BoardScene;
use super::face::{COLUMNS, Face};
use super::motion::Posture;
use super::sequence::{Place, Sequence, SequenceScene};
use super::skin::Skin;
use super::{Region, SimConfig};
use crate::device::DeviceError;
use crate::files::FileError;
use crate::files::obj::read_obj;
use glam::{Mat3, Vec3};
use gv3_codec::mesh::TriMesh;
use serde::{Deserialize, Serialize};
use std::f32::consts::{PI, TAU};
use std::path::{Path, PathBuf};

/// Middle of the working range, where solids stand, scan frame.
pub const CENTRE_MM: Vec3 = Vec3::new(0.0, 0.0, -600.0);
/// Half the width and height of the plane and the step, mm.
const HALF_SIZE_MM: [f32; 2] = [110.0, 80.0];
/// Turn of the plane about the vertical axis: its tangent, towards the projector.
const PLANE_SLOPE: f32 = 0.15;
/// Height of the step: its right half is nearer.
const STEP_MM: f32 = 10.0;
/// Radius of both spheres, and half the distance of their centres.
const SPHERE_RADIUS_MM: f32 = 40.0;
const SPHERE_X_MM: f32 = 55.0;
/// Largest distance of an OBJ's vertices from the middle of its bounds, which keeps it before the lenses.
pub const MAX_REACH_MM: f32 = 400.0;

/// Which scene.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SceneConfig {
    /// The talking head.
    #[default]
    Head,
    /// A plane of 220 x 160 mm, sloping 15 %, its middle at 600 mm.
    Plane,
    /// Two spheres of radius 40 mm, their centres 110 mm apart at 600 mm.
    Spheres,
    /// Two half planes, the left one at 600 mm and the right one 10 mm nearer.
    Step,
    /// A mesh in a file, millimetres, moved so that the middle of its bounds is at 600 mm. A relative path starts at the rig's
    /// file.
    Obj(PathBuf),
    /// A folder of scans, one after the other.
    Sequence(SequenceScene),
    /// A calibration board.
    Board(BoardScene),
}

/// Where a solid stands.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Placement {
    /// Shift from the middle of the working range, scan frame, mm.
    pub offset_mm: [f32; 3],
    /// Turns about the scan frame's x, then y, then z, through the middle of the working range, before the shift, degrees.
    pub turn_deg: [f32; 3],
}

impl Placement {
    fn apply(&self, p: Vec3) -> Vec3 {
        // Not the standard library's: the same place on every machine.
        let [x, y, z] = self.turn_deg.map(|deg| libm::sincosf(deg * (PI / 180.0)));
        let about_x = Mat3::from_cols_array(&[1.0, 0.0, 0.0, 0.0, x.1, x.0, 0.0, -x.0, x.1]);
        let about_y = Mat3::from_cols_array(&[y.1, 0.0, -y.0, 0.0, 1.0, 0.0, y.0, 0.0, y.1]);
        let about_z = Mat3::from_cols_array(&[z.1, z.0, 0.0, -z.0, z.1, 0.0, 0.0, 0.0, 1.0]);
        let turn = about_z * about_y * about_x;
        CENTRE_MM + Vec3::from(self.offset_mm) + turn * (p - CENTRE_MM)
    }
}

/// A scene with what is known of each of its vertices.
pub enum Scene {
    /// The talking head.
    Head(Box<Face>),
    /// A rigid mesh.
    Solid {
        /// The mesh in its place at time 0, scan frame.
        mesh: TriMesh,
        /// Normals of its vertices.
        normals: Vec<Vec3>,
        /// What is printed on it, and the places of its vertices on the print.
        print: Option<(BoardScene, Vec<Vec3>)>,
    },
}

impl Scene {
    /// Builds or reads a scene; of a sequence, its first scan.
    ///
    /// # Errors
    /// [`DeviceError::File`] for an OBJ that cannot be read, [`DeviceError::Config`] for one too large.
    pub fn new(config: &SceneConfig, placement: &Placement) -> Result<Self, DeviceError> {
        let mut mesh = match config {
            SceneConfig::Head => return Ok(Self::Head(Box::new(Face::new()))),
            SceneConfig::Plane => plate(-HALF_SIZE_MM[0], HALF_SIZE_MM[0], PLANE_SLOPE, 0.0),
            SceneConfig::Spheres => joined([sphere(-SPHERE_X_MM), sphere(SPHERE_X_MM)]),
            SceneConfig::Step => {
                joined([plate(-HALF_SIZE_MM[0], 0.0, 0.0, 0.0), plate(0.0, HALF_SIZE_MM[0], 0.0, STEP_MM)])
            }
            SceneConfig::Obj(path) => obj(path)?,
            SceneConfig::Sequence(sequence) => {
                return Ok(Self::of_sequence(&Sequence::read(sequence)?, Place::default()));
            }
            SceneConfig::Board(board) => {
                board.validate()?;
                let (mesh, places_mm) = board.mesh();
                return Ok(Self::Solid { normals: mesh.vertex_normals(), mesh, print: Some((*board, places_mm)) });
            }
        };
        mesh.positions_mm.iter_mut().for_each(|p| *p = placement.apply(*p));
        Ok(Self::Solid { normals: mesh.vertex_normals(), mesh, print: None })
    }

    /// What of a sequence stands there at a place.
    pub fn of_sequence(sequence: &Sequence, place: Place) -> Self {
        let (mesh, normals) = sequence.surface(place);
        Self::Solid { mesh, normals, print: None }
    }

    /// Positions in the scan frame at a posture, mm; a solid takes only the shift.
    pub fn pose(&self, posture: &Posture, shift_mm: Vec3, out: &mut Vec<Vec3>) {
        match self {
            Self::Head(face) => face.pose(&Posture { centre_mm: posture.centre_mm + shift_mm, ..*posture }, out),
            Self::Solid { mesh, .. } => {
                out.clear();
                out.extend(mesh.positions_mm.iter().map(|p| *p + shift_mm));
            }
        }
    }

    /// Places of the vertices at rest, on which regions and skin are laid: x right, y up, mm.
    pub fn rest_mm(&self) -> &[Vec3] {
        match self {
            Self::Head(face) => &face.rest_mm,
            Self::Solid { print: Some((_, places_mm)), .. } => places_mm,
            Self::Solid { mesh, .. } => &mesh.positions_mm,
        }
    }

    /// Texture coordinates of the vertices, where they are not laid on by their places at rest.
    pub fn uv(&self) -> Option<&[[f32; 2]]> {
        match self {
            Self::Head(_) => None,
            Self::Solid { mesh, .. } => mesh.uv.as_deref(),
        }
    }

    /// Triangles, counter-clockwise seen from outside.
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        match self {
            Self::Head(face) => face.triangles(),
            Self::Solid { mesh, .. } => mesh.triangles.clone(),
        }
    }

    /// Vertices that throw shadows, and triangles of them: of the head every `step`-th each way.
    pub fn shadow_mesh(&self, step: usize) -> (Vec<u32>, Vec<[u32; 3]>) {
        match self {
            Self::Head(face) => {
                let (rows, columns) = (face.rows().div_ceil(step), COLUMNS / step);
                let vertex = |i| ((i / columns) * step * COLUMNS + (i % columns) * step) as u32;
                ((0..rows * columns).map(vertex).collect(), grid_triangles(columns, rows))
            }
            Self::Solid { mesh, .. } => ((0..mesh.vertex_count() as u32).collect(), mesh.triangles.clone()),
        }
    }

    /// Normals, when no movement changes them.
    pub fn fixed_normals(&self) -> Option<&[Vec3]> {
        match self {
            Self::Head(_) => None,
            Self::Solid { normals, .. } => Some(normals),
        }
    }

    /// The albedo: skin on the head, its print on a board, an even grey on solids.
    pub fn skin(&self, config: &SimConfig) -> Skin {
        let regions: &[Region] = &config.regions;
        match self {
            Self::Head(_) => Skin::new(config.seed, regions),
            Self::Solid { print: Some((board, _)), .. } => Skin::printed(regions, |x, y| board.albedo(x, y)),
            Self::Solid { .. } => Skin::even(regions),
        }
    }
}

/// Triangles of a grid of vertices, rows from the top down, counter-clockwise seen from the front.
pub fn grid_triangles(columns: usize, rows: usize) -> Vec<[u32; 3]> {
    let mut triangles = Vec::with_capacity(2 * columns * rows);
    for row in 0..rows - 1 {
        for column in 0..columns - 1 {
            let a = (row * columns + column) as u32;
            let (b, c, d) = (a + 1, a + columns as u32, a + columns as u32 + 1);
            triangles.extend([[a, c, b], [b, c, d]]);
        }
    }
    triangles
}

/// A grid over `place(u, v)`, u from 0 at the left to 1, v from 0 at the top to 1.
fn grid(columns: usize, rows: usize, place: impl Fn(f32, f32) -> Vec3) -> TriMesh {
    let at = |i: usize, n: usize| i as f32 / (n - 1) as f32;
    let vertex = |i: usize| CENTRE_MM + place(at(i % columns, columns), at(i / columns, rows));
    let positions_mm = (0..rows * columns).map(vertex).collect();
    TriMesh { positions_mm, triangles: grid_triangles(columns, rows), uv: None }
}

/// An upright plate, fine enough that lens and light are straight within a triangle.
fn plate(left_mm: f32, right_mm: f32, slope: f32, height_mm: f32) -> TriMesh {
    grid(111, 81, |u, v| {
        let x = left_mm + u * (right_mm - left_mm);
        Vec3::new(x, HALF_SIZE_MM[1] * (1.0 - 2.0 * v), height_mm + slope * x)
    })
}

/// Chords of a 240th of a turn are within 7 micrometres of the sphere.
fn sphere(x_mm: f32) -> TriMesh {
    grid(241, 121, |u, v| {
        let (longitude, from_top) = (TAU * (u - 0.5), PI * v);
        let ring = libm::sinf(from_top);
        let normal = Vec3::new(ring * libm::sinf(longitude), libm::cosf(from_top), ring * libm::cosf(longitude));
        SPHERE_RADIUS_MM * normal + Vec3::new(x_mm, 0.0, 0.0)
    })
}

fn joined([mut a, b]: [TriMesh; 2]) -> TriMesh {
    let first = a.vertex_count() as u32;
    a.positions_mm.extend(b.positions_mm);
    a.triangles.extend(b.triangles.iter().map(|t| t.map(|v| v + first)));
    a
}

/// An error of the file or folder at `path`, which is not named twice.
pub fn unreadable(path: &Path, error: &FileError) -> DeviceError {
    let text = error.to_string();
    let reason = text.strip_prefix(&format!("{}: ", path.display())).unwrap_or(&text);
    DeviceError::File { path: path.to_path_buf(), reason: reason.into() }
}

fn obj(path: &Path) -> Result<TriMesh, DeviceError> {
    let mut mesh = read_obj(path).map_err(|e| unreadable(path, &e))?.mesh;
    let (low, high) = mesh.bounds_mm();
    let middle = 0.5 * (low + high);
    let reach = 0.5 * (high - low).length();
    if !reach.is_finite() || reach > MAX_REACH_MM {
        let reason = format!("{} reaches {reach:.0} mm from its middle, the room is {MAX_REACH_MM} mm", path.display());
        return Err(DeviceError::config("sim.scene.obj", reason));
    }
    mesh.positions_mm.iter_mut().for_each(|p| *p += CENTRE_MM - middle);
    mesh.uv = None;
    Ok(mesh)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::sim::SimWorld;
    use crate::device::{self, PatternIndex, RigConfig};
    use crate::pipeline::{FrameSetAssembler, Reconstructor};
    use glam::{DMat4, DVec3, DVec4};
    use std::time::Instant;

    /// Points of the first scan, mm from the middle of the working range, and its time.
    fn scanned_with(config: &RigConfig) -> (Vec<DVec3>, u64) {
        let mut rig = device::open(config).unwrap();
        rig.camera.configure(&config.camera_settings()).unwrap();
        rig.projector.load(&rig.sequence).unwrap();
        rig.camera.start().unwrap();
        rig.projector.play(&rig.timing).unwrap();
        let mut assembler = FrameSetAssembler::new(&rig.sequence, &rig.timing);
        let mut next = || rig.camera.next_frame(Instant::now()).unwrap();
        let set = (0..12).find_map(|_| assembler.push(next())).unwrap();
        let mut reconstructor = Reconstructor::new(&rig.calibration, &rig.sequence, &rig.limits).unwrap();
        let scan = reconstructor.reconstruct(&set).unwrap().scan;
        (scan.mesh.positions_mm.iter().map(|p| p.as_dvec3() - CENTRE_MM.as_dvec3()).collect(), scan.time_nanos)
    }

    fn scanned(scene: SceneConfig) -> Vec<DVec3> {
        let mut config = RigConfig::simulated();
        config.sim.scene = scene;
        scanned_with(&config).0
    }

    fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
        let n = values.len() as f64;
        values.sum::<f64>() / n
    }

    #[test]
    fn a_scanned_plane_is_flat_within_noise() {
        let points = scanned(SceneConfig::Plane);
        let slope = f64::from(PLANE_SLOPE);
        let height = |p: &DVec3| (p.z - slope * p.x) / slope.hypot(1.0);
        let offset_mm = mean(points.iter().map(height));
        let rms_mm = mean(points.iter().map(|p| height(p).powi(2))).sqrt();
        assert!(points.len() > 80_000, "{} points", points.len());
        assert!(offset_mm.abs() < 0.02 && rms_mm < 0.1, "offset {offset_mm} mm, rms {rms_mm} mm");
    }

    /// Root mean square of a scanned plane about its true place, mm, at a velocity; and its speed along its normal, mm/s.
    fn moving_plane(velocity_mm_s: [f32; 3]) -> (f64, f64) {
        let mut config = RigConfig::simulated();
        config.sim.scene = SceneConfig::Plane;
        config.sim.velocity_mm_s = velocity_mm_s;
        config.sim.motion_samples = 4;
        let (points, time_nanos) = scanned_with(&config);
        let normal = DVec3::new(-f64::from(PLANE_SLOPE), 0.0, 1.0).normalize();
        let speed_mm_s = Vec3::from(velocity_mm_s).as_dvec3().dot(normal);
        let place_mm = speed_mm_s * time_nanos as f64 * 1e-9;
        // Along the outline a pixel sees the plane in some of the pictures only, which is another error.
        let inner = points.iter().filter(|p| p.x.abs() < f64::from(HALF_SIZE_MM[0]) - 10.0);
        let squares: Vec<f64> = inner.map(|p| (p.dot(normal) - place_mm).powi(2)).collect();
        (mean(squares.into_iter()).sqrt(), speed_mm_s)
    }

    /// A drift of e_n in picture n turns the phase of three steps by sum e_n (1 - cos(2 phi + 4 pi n / 3)) / 3. A constant speed
    /// is e = (-d, 0, d) about the scan's time: a ripple of amplitude d / sqrt 3, which on the surface is rms v dt / sqrt 6,
    /// whatever the fringe's period.
    #[test]
    fn motion_within_a_frame_set_ripples_the_surface_as_theory_says() {
        let (still_mm, _) = moving_plane([0.0; 3]);
        println!(
            "six pictures at 180 a second, plane sloping 15 %\nmm/s            rms mm   theory mm\nat rest         {still_mm:.3}"
        );
        let period_s = RigConfig::simulated().timing.picture_period_nanos as f64 * 1e-9;
        for (axis, name) in [(0, "across"), (2, "in depth")] {
            for speed in [50.0f32, 100.0, 200.0] {
                let mut velocity_mm_s = [0.0; 3];
                velocity_mm_s[axis] = speed;
                let (rms_mm, normal_mm_s) = moving_plane(velocity_mm_s);
                let theory_mm = (normal_mm_s * period_s / 6.0f64.sqrt()).hypot(still_mm);
                println!("{speed:>4} {name:<10} {rms_mm:.3}    {theory_mm:.3}");
                assert!(
                    (rms_mm / theory_mm - 1.0).abs() < 0.15,
                    "{speed} mm/s {name}: {rms_mm}, theory {theory_mm} mm"
                );
            }
        }
    }

    /// Least-squares sphere: |p|^2 = 2 c p + (r^2 - |c|^2) is linear in c and the bracket.
    fn fitted_sphere(points: &[DVec3]) -> (DVec3, f64) {
        let rows = points.iter().map(|p| ((2.0 * *p).extend(1.0), p.length_squared()));
        let (normal, right) = rows.fold((DMat4::ZERO, DVec4::ZERO), |(m, b), (row, value)| {
            (m + DMat4::from_cols(row * row.x, row * row.y, row * row.z, row * row.w), b + row * value)
        });
        let solution = normal.inverse() * right;
        let centre = solution.truncate();
        (centre, (solution.w + centre.length_squared()).sqrt())
    }

    #[test]
    fn scanned_spheres_have_their_radius_and_distance() {
        let points = scanned(SceneConfig::Spheres);
        let (left, right): (Vec<DVec3>, Vec<DVec3>) = points.iter().partition(|p| p.x < 0.0);
        let fits = [left, right].map(|half| {
            let (centre, radius_mm) = fitted_sphere(&half);
            assert!(half.len() > 8_000, "{} points", half.len());
            assert!((radius_mm - f64::from(SPHERE_RADIUS_MM)).abs() < 0.1, "radius {radius_mm} mm at {centre}");
            centre
        });
        let distance_mm = fits[0].distance(fits[1]);
        assert!((distance_mm - 2.0 * f64::from(SPHERE_X_MM)).abs() < 0.1, "{distance_mm} mm apart");
    }

    #[test]
    fn a_scanned_step_has_its_height() {
        let points = scanned(SceneConfig::Step);
        let level = |inside: fn(f64) -> bool| {
            let z: Vec<f64> = points.iter().filter(|p| inside(p.x)).map(|p| p.z).collect();
            mean(z.into_iter())
        };
        let height_mm = level(|x| x > 10.0) - level(|x| x < -10.0);
        assert!((height_mm - f64::from(STEP_MM)).abs() < 0.02, "{height_mm} mm");
    }

    /// Whether the plate stands between a place of the wall and the camera or lamp, by exact geometry; `None` within 3 mm of the
    /// plate's edge.
    fn is_hidden(from: DVec3, wall: DVec3) -> Option<bool> {
        let at_plate = wall + (from - wall) * ((-560.0 - wall.z) / (from.z - wall.z));
        let beyond_mm = at_plate.x.abs().max(at_plate.y.abs()) - 20.0;
        (beyond_mm.abs() > 3.0).then_some(beyond_mm < 0.0)
    }

    #[test]
    fn a_plate_before_a_wall_hides_it_from_the_camera_and_shades_it_from_the_projector() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plate.obj");
        let square =
            |x: f32, y: f32, z: f32| format!("v -{x} -{y} {z}\nv {x} -{y} {z}\nv {x} {y} {z}\nv -{x} {y} {z}\n");
        let faces = "f 1 2 3\nf 1 3 4\nf 5 6 7\nf 5 7 8\n";
        std::fs::write(&path, square(100.0, 75.0, 0.0) + &square(20.0, 20.0, 80.0) + faces).unwrap();
        let mut config = RigConfig::simulated();
        config.sim.scene = SceneConfig::Obj(path);
        let calibration = config.calibration().unwrap();
        let from_camera = &calibration.projector_from_camera;
        let light_in_camera = -(from_camera.matrix().transpose() * from_camera.translation());
        let lamp_mm = DVec3::new(light_in_camera.x, -light_in_camera.y, -light_in_camera.z);
        let mut world = SimWorld::new(&config).unwrap();
        world.load(&config.sequence);
        let pictures = [0u16, 1, 2, 3, 4, 5]
            .map(|n| world.expose(0, Some(PatternIndex(n)), config.timing.exposure_nanos, u64::from(n)));
        let depth_mm = world.truth_depth_mm(0);
        let mut has_vertex = vec![false; depth_mm.len()];
        let place =
            |p: DVec3| calibration.camera.project(DVec3::new(p.x, -p.y, -p.z)).to_array().map(|v| v.round() as usize);
        for p in scanned_with(&config).0 {
            let [x, y] = place(p + CENTRE_MM.as_dvec3());
            has_vertex[y * 640 + x] = true;
        }
        let (mut in_shadow, mut lit, mut measured) = (0, 0, 0);
        for (i, ray) in calibration.camera.ray_table("camera").unwrap().iter().enumerate() {
            let wall_mm = DVec3::new(ray.x, -ray.y, -1.0) * 640.0;
            // A margin for the mask's erosion at the wall's own edges.
            if wall_mm.x.abs() > 95.0 || wall_mm.y.abs() > 70.0 {
                continue;
            }
            let levels = pictures.each_ref().map(|p| p.pixels[i]);
            let swing = levels.iter().max().unwrap() - levels.iter().min().unwrap();
            match (is_hidden(DVec3::ZERO, wall_mm), is_hidden(lamp_mm, wall_mm)) {
                (Some(true), _) => assert!((depth_mm[i] - 560.0).abs() < 0.1, "the plate at {wall_mm}"),
                (Some(false), Some(true)) => {
                    in_shadow += 1;
                    assert!((depth_mm[i] - 640.0).abs() < 0.1 && swing < 15, "{levels:?} at {wall_mm}");
                    assert!(!has_vertex[i], "a vertex in the shadow at {wall_mm}");
                }
                (Some(false), Some(false)) => {
                    lit += 1;
                    measured += u32::from(swing > 30 && has_vertex[i]);
                    assert!((depth_mm[i] - 640.0).abs() < 0.1, "the wall at {wall_mm}");
                }
                _ => {}
            }
        }
        assert!(in_shadow > 300 && lit > 20_000, "{in_shadow} in the shadow, {lit} lit");
        // Noise may take a dark pixel here and there.
        assert!(measured * 100 > lit * 97, "{measured} of {lit} lit pixels measured");
    }

    #[test]
    fn an_obj_stands_in_the_working_range_or_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("solid.obj");
        std::fs::write(&path, "v 0 0 0\nv 60 0 0\nv 0 60 20\nf 1 2 3\n").unwrap();
        let scene = SceneConfig::Obj(path.clone());
        let Scene::Solid { mesh, .. } = Scene::new(&scene, &Placement::default()).unwrap() else { panic!("no solid") };
        assert_eq!(mesh.bounds_mm(), (Vec3::new(-30.0, -30.0, -610.0), Vec3::new(30.0, 30.0, -590.0)));
        let toml = toml::to_string(&SimConfig { scene: scene.clone(), ..SimConfig::default() }).unwrap();
        assert_eq!(toml::from_str::<SimConfig>(&toml).unwrap().scene, scene);
        std::fs::write(&path, "v 0 0 0\nv 6000 0 0\nv 0 60 20\nf 1 2 3\n").unwrap();
        assert!(Scene::new(&scene, &Placement::default()).err().unwrap().to_string().starts_with("sim.scene.obj"));
        let missing =
            Scene::new(&SceneConfig::Obj("nowhere.obj".into()), &Placement::default()).err().unwrap().to_string();
        assert!(missing.contains("nowhere.obj"), "{missing}");
    }
}
