//! A folder of scans that moves before the scanner as it did before the one that took it.
//!
//! Scans of one connectivity are interpolated in time; of others the nearest in time stands there. Before the first and after
//! the last scan the scene stands still.

use super::scene::{CENTRE_MM, MAX_REACH_MM, unreadable};
use super::skin::Skin;
use crate::device::DeviceError;
use crate::files::ScanFolder;
use glam::Vec3;
use gv3_codec::mesh::TriMesh;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Most memory that the scans of a sequence may take.
const MAX_BYTES: usize = 2 << 30;

/// A folder of numbered scans (OBJ or PLY with the picture of the same name, if there are pictures), millimetres. Dark
/// regions are not painted over pictures.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SequenceScene {
    /// The folder; a relative path starts at the rig's file. The first scan is moved so that the middle of its bounds is at
    /// 600 mm, and the others with it.
    pub folder: PathBuf,
    /// Time from one number to the next, nanoseconds.
    pub period_nanos: u64,
}

/// The scans of a sequence.
pub struct Sequence {
    scans: Vec<MovingScan>,
    is_one_connectivity: bool,
}

struct MovingScan {
    time_nanos: u64,
    mesh: TriMesh,
    normals: Vec<Vec3>,
    skin: Option<Skin>,
}

/// Where in a sequence: at a scan, or some part of the way to the next.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Place {
    scan: usize,
    fraction: f32,
}

impl Sequence {
    /// Reads all scans.
    ///
    /// # Errors
    /// [`DeviceError::File`] for a folder or file that cannot be read, [`DeviceError::Config`] for a sequence too large.
    pub fn read(config: &SequenceScene) -> Result<Self, DeviceError> {
        if config.period_nanos == 0 {
            return Err(DeviceError::config("sim.scene.sequence.period_nanos", "expected nanoseconds above 0"));
        }
        let folder = ScanFolder::open(&config.folder).map_err(|e| unreadable(&config.folder, &e))?;
        let (mut scans, mut bytes): (Vec<MovingScan>, usize) = (Vec::with_capacity(folder.len()), 0);
        let mut shift_mm = None;
        for i in 0..folder.len() {
            let scan = folder.load(i, config.period_nanos).map_err(|e| unreadable(&config.folder, &e))?.scan;
            let mut mesh = scan.mesh;
            let (low, high) = mesh.bounds_mm();
            let shift_mm = *shift_mm.get_or_insert(CENTRE_MM - 0.5 * (low + high));
            let reach_mm = [low, high].map(|p| (p + shift_mm - CENTRE_MM).abs().max_element());
            bytes += mesh.positions_mm.len() * 36 + mesh.triangles.len() * 12;
            bytes += scan.texture.as_ref().map_or(0, |t| t.pixels.len() * 4);
            check(&folder.name(i), reach_mm[0].max(reach_mm[1]), bytes)?;
            mesh.positions_mm.iter_mut().for_each(|p| *p += shift_mm);
            if scan.texture.is_none() {
                mesh.uv = None;
            }
            let (normals, skin) = (mesh.vertex_normals(), scan.texture.as_ref().map(Skin::of_picture));
            scans.push(MovingScan { time_nanos: scan.time_nanos, mesh, normals, skin });
        }
        let is_same = |pair: &[MovingScan]| {
            let [a, b] = [&pair[0].mesh, &pair[1].mesh];
            a.positions_mm.len() == b.positions_mm.len() && a.triangles == b.triangles
        };
        Ok(Self { is_one_connectivity: scans.windows(2).all(is_same), scans })
    }

    /// The place at a time; scans that cannot be interpolated are whole places.
    pub fn place(&self, time_nanos: i64) -> Place {
        let time_nanos = u64::try_from(time_nanos).unwrap_or(0);
        let after = self.scans.partition_point(|s| s.time_nanos <= time_nanos);
        let scan = after.saturating_sub(1);
        let (Some(from), Some(to)) = (self.scans.get(scan), self.scans.get(scan + 1)) else {
            return Place { scan, fraction: 0.0 };
        };
        let fraction = (time_nanos.saturating_sub(from.time_nanos)) as f32 / (to.time_nanos - from.time_nanos) as f32;
        match self.is_one_connectivity {
            true => Place { scan, fraction },
            false => Place { scan: scan + usize::from(fraction >= 0.5), fraction: 0.0 },
        }
    }

    /// Surface and normals at a place; the texture coordinates are those of [`Self::skin`], if there is one.
    pub fn surface(&self, place: Place) -> (TriMesh, Vec<Vec3>) {
        let from = &self.scans[place.scan];
        let (mut mesh, mut normals) = (from.mesh.clone(), from.normals.clone());
        if let Some(to) = self.scans.get(place.scan + 1).filter(|_| place.fraction > 0.0) {
            let mix = |a: &mut Vec3, b: &Vec3| *a += place.fraction * (*b - *a);
            mesh.positions_mm.iter_mut().zip(&to.mesh.positions_mm).for_each(|(a, b)| mix(a, b));
            normals.iter_mut().zip(&to.normals).for_each(|(a, b)| mix(a, b));
        }
        (mesh, normals)
    }

    /// The skin at a place, from the picture of the scan before it.
    pub fn skin(&self, place: Place) -> Option<&Skin> {
        self.scans[place.scan].skin.as_ref()
    }
}

fn check(name: &str, reach_mm: f32, bytes: usize) -> Result<(), DeviceError> {
    let field = "sim.scene.sequence.folder";
    if reach_mm > MAX_REACH_MM || reach_mm.is_nan() {
        let reason =
            format!("{name} reaches {reach_mm:.0} mm from the middle of the first, the room is {MAX_REACH_MM} mm");
        return Err(DeviceError::config(field, reason));
    }
    if bytes > MAX_BYTES {
        let reason =
            format!("the scans up to {name} take more than {} MB; take fewer or smaller ones", MAX_BYTES >> 20);
        return Err(DeviceError::config(field, reason));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::RigConfig;
    use crate::device::sim::{SceneConfig, SimWorld};
    use crate::files::picture::{PictureFormat, picture_bytes};
    use gv3_codec::GreyPicture;
    use std::path::Path;

    const PERIOD_NANOS: u64 = 10_000_000;

    /// A square of 80 mm at a height, its diagonal either way.
    fn write(folder: &Path, number: u32, x_mm: f32, z_mm: f32, faces: &str) {
        let corner = |dx: f32, dy: f32| format!("v {} {dy} {z_mm}\n", x_mm + dx);
        let corners = [(-40.0, -40.0), (40.0, -40.0), (40.0, 40.0), (-40.0, 40.0)].map(|(x, y)| corner(x, y)).concat();
        let text = format!("{corners}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n{faces}");
        std::fs::write(folder.join(format!("scan{number:03}.obj")), text).unwrap();
    }

    const RISING: &str = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n";
    const FALLING: &str = "f 1/1 2/2 4/4\nf 2/2 3/3 4/4\n";

    fn rig(folder: &Path) -> RigConfig {
        let mut config = RigConfig::simulated();
        let scene = SequenceScene { folder: folder.into(), period_nanos: PERIOD_NANOS };
        config.sim.scene = SceneConfig::Sequence(scene);
        config
    }

    /// Depth at the middle of the picture at a time, mm.
    fn depth_mm(world: &mut SimWorld, time_nanos: u64) -> f32 {
        world.truth_depth_mm(time_nanos)[240 * 640 + 320]
    }

    #[test]
    fn scans_of_one_connectivity_are_interpolated_over_gaps_and_stand_still_at_the_ends() {
        let folder = tempfile::tempdir().unwrap();
        for (number, z_mm) in [(3, 0.0), (4, 10.0), (6, 30.0)] {
            write(folder.path(), number, 0.0, z_mm, RISING);
        }
        let mut world = SimWorld::new(&rig(folder.path())).unwrap();
        for (periods, expected) in [(0.0, 600.0), (0.5, 595.0), (1.0, 590.0), (2.0, 580.0), (2.5, 575.0), (9.0, 570.0)]
        {
            let time_nanos = (periods * PERIOD_NANOS as f64) as u64;
            let found = depth_mm(&mut world, time_nanos);
            assert!((found - expected).abs() < 0.01, "{found} mm after {periods} periods");
            let truth = world.truth_mesh(time_nanos);
            assert!(truth.positions_mm.iter().all(|p| (p.z + expected).abs() < 0.01) && truth.triangles.len() == 2);
        }
        let toml = toml::to_string(&rig(folder.path()).sim).unwrap();
        assert_eq!(toml::from_str::<crate::device::sim::SimConfig>(&toml).unwrap(), rig(folder.path()).sim);
    }

    #[test]
    fn of_other_scans_the_nearest_is_seen_in_the_light_of_its_own_picture() {
        let folder = tempfile::tempdir().unwrap();
        for (number, z_mm, faces, level) in [(0, 0.0, RISING, 40), (1, 20.0, FALLING, 200)] {
            write(folder.path(), number, 0.0, z_mm, faces);
            let path = folder.path().join(format!("scan{number:03}.png"));
            let bytes = picture_bytes(&GreyPicture::filled(16, 16, level), PictureFormat::Png, &path).unwrap();
            std::fs::write(&path, bytes).unwrap();
        }
        let mut config = rig(folder.path());
        config.sim.ambient = 0.5;
        let mut world = SimWorld::new(&config).unwrap();
        let seen = [0.4, 0.6].map(|periods| {
            let time_nanos = (periods * PERIOD_NANOS as f64) as u64;
            let picture = world.expose(time_nanos, None, 5_000_000, 0);
            let middle = (0..20).map(|k| f32::from(picture.pixels[240 * 640 + 310 + k])).sum::<f32>() / 20.0;
            (depth_mm(&mut world, time_nanos), middle)
        });
        assert!((seen[0].0 - 600.0).abs() < 0.01 && (seen[1].0 - 580.0).abs() < 0.01, "{seen:?}");
        // Ambient light of a half, of which a surface of 255 would give back 160 grey levels.
        assert!((seen[0].1 / 25.1 - 1.0).abs() < 0.05 && (seen[1].1 / 125.5 - 1.0).abs() < 0.05, "{seen:?}");
    }

    #[test]
    fn sequences_that_cannot_be_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let error = |config: &RigConfig| SimWorld::new(config).err().unwrap().to_string();
        assert!(error(&rig(folder.path())).contains(folder.path().to_str().unwrap()));
        write(folder.path(), 0, 0.0, 0.0, RISING);
        write(folder.path(), 1, 500.0, 0.0, RISING);
        let far = error(&rig(folder.path()));
        assert!(far.starts_with("sim.scene.sequence.folder") && far.contains("scan001.obj"), "{far}");
        let mut config = rig(folder.path());
        config.sim.scene = SceneConfig::Sequence(SequenceScene { folder: folder.path().into(), period_nanos: 0 });
        assert!(error(&config).starts_with("sim.scene.sequence.period_nanos"));
        std::fs::write(folder.path().join("scan001.obj"), "v 0 0 x\n").unwrap();
        assert!(error(&rig(folder.path())).contains("scan001.obj"));
    }
}
