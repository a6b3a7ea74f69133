//! A folder of numbered scans, as a scanner stores a sequence: OBJ or PLY files with a picture each.

use super::assemble::{MeshFile, Repairs};
use super::error::{FileError, Result};
use super::{obj, picture, ply};
use gv3_codec::Scan;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Bytes at the start of a mesh file in which the name of its texture is looked for.
const HEAD_BYTES: u64 = 4096;
/// Largest material library read.
const MAX_LIBRARY_BYTES: u64 = 1 << 20;

/// The files of a sequence of scans, in order of their numbers; opening reads names only.
#[derive(Debug, Clone)]
pub struct ScanFolder {
    path: PathBuf,
    first_number: u64,
    scans: Vec<ScanFiles>,
}

#[derive(Debug, Clone)]
struct ScanFiles {
    mesh: PathBuf,
    picture: Option<PathBuf>,
    tick: u64,
    mesh_bytes: u64,
    picture_bytes: u64,
}

/// A scan as loaded and what had to be mended.
#[derive(Debug, Clone)]
pub struct LoadedScan {
    /// The scan.
    pub scan: Scan,
    /// What the reader of its mesh mended.
    pub repairs: Repairs,
}

/// A mesh file with the series and number that its name ends in: `frame_0012.obj` is 12 of `frame_`.
struct Numbered {
    series: String,
    number: u64,
    path: PathBuf,
}

impl ScanFolder {
    /// Finds the scans of a folder, or a single mesh file.
    ///
    /// Files `NAME0001.obj` (or `.ply`) are sorted by number; the number less the first is the tick, so missing numbers
    /// are gaps. The picture of a scan has its stem (`.bmp`, `.png`), else is the one that its material names. Other
    /// files are passed over.
    ///
    /// # Errors
    /// [`FileError`]: not readable, no scans, OBJ beside PLY, two series of names, a number twice, pictures for some
    /// scans only.
    pub fn open(path: &Path) -> Result<Self> {
        let folder = if path.is_file() { path.parent().unwrap_or(path) } else { path };
        // The parent of a bare file name is empty, which the system does not open.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let names = list(folder)?;
        let meshes = if path.is_file() {
            mesh_format(path)?;
            vec![Numbered { series: String::new(), number: 0, path: path.into() }]
        } else {
            numbered_meshes(&names, folder)?
        };
        let first = meshes[0].number;
        let mut scans = Vec::with_capacity(meshes.len());
        for mesh in meshes {
            scans.push(ScanFiles::find(mesh.path, mesh.number - first, &names)?);
        }
        check_pictures(&scans, folder)?;
        Ok(Self { path: path.into(), first_number: first, scans })
    }

    /// Number of scans, at least one.
    #[expect(clippy::len_without_is_empty, reason = "opening an empty folder is an error")]
    pub fn len(&self) -> usize {
        self.scans.len()
    }

    /// The folder or file that was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// File name of the mesh of scan `i`.
    ///
    /// # Panics
    /// When `i >= len()`.
    pub fn name(&self, i: usize) -> String {
        file_name(&self.scans[i].mesh)
    }

    /// Sensor time of scan `i` in scan periods after the first.
    ///
    /// # Panics
    /// When `i >= len()`.
    pub fn tick(&self, i: usize) -> u64 {
        self.scans[i].tick
    }

    /// Number of scan `i` in its file name, 0 for a single file.
    ///
    /// # Panics
    /// When `i >= len()`.
    pub fn number(&self, i: usize) -> u64 {
        self.first_number + self.scans[i].tick
    }

    /// Whether the scans have pictures.
    pub fn has_pictures(&self) -> bool {
        self.scans[0].picture.is_some()
    }

    /// What scan `i` takes on disk, mesh and picture, bytes.
    ///
    /// # Panics
    /// When `i >= len()`.
    pub fn scan_bytes(&self, i: usize) -> u64 {
        self.scans[i].mesh_bytes + self.scans[i].picture_bytes
    }

    /// What all scans take on disk, bytes; a picture that several scans share counts once.
    pub fn raw_bytes(&self) -> u64 {
        let mut seen = BTreeSet::new();
        self.scans.iter().map(|s| s.mesh_bytes + if seen.insert(&s.picture) { s.picture_bytes } else { 0 }).sum()
    }

    /// Loads scan `i`; its time is its tick times `period_nanos`.
    ///
    /// # Errors
    /// [`FileError`] of its mesh or picture.
    ///
    /// # Panics
    /// When `i >= len()`.
    pub fn load(&self, i: usize, period_nanos: u64) -> Result<LoadedScan> {
        let files = &self.scans[i];
        let MeshFile { mesh, repairs, .. } = match mesh_format(&files.mesh)? {
            MeshFormat::Obj => obj::read_obj(&files.mesh)?,
            MeshFormat::Ply => ply::read_ply(&files.mesh)?,
        };
        let texture = files.picture.as_deref().map(picture::read_picture).transpose()?;
        let time_nanos = files.tick.saturating_mul(period_nanos);
        Ok(LoadedScan { scan: Scan { tick: files.tick, time_nanos, mesh, texture }, repairs })
    }
}

impl ScanFiles {
    fn find(mesh: PathBuf, tick: u64, names: &BTreeMap<String, PathBuf>) -> Result<Self> {
        let picture = find_picture(&mesh, names)?;
        let size = |path: &Path| Ok(std::fs::metadata(path).map_err(FileError::io(path, "read"))?.len());
        let mesh_bytes = size(&mesh)?;
        let picture_bytes = picture.as_deref().map(size).transpose()?.unwrap_or(0);
        Ok(Self { mesh, picture, tick, mesh_bytes, picture_bytes })
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MeshFormat {
    Obj,
    Ply,
}

fn mesh_format(path: &Path) -> Result<MeshFormat> {
    match extension(path).as_str() {
        "obj" => Ok(MeshFormat::Obj),
        "ply" => Ok(MeshFormat::Ply),
        _ => Err(FileError::content(path, "neither .obj nor .ply; give a mesh file or a folder of them")),
    }
}

fn extension(path: &Path) -> String {
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// The visible files of a folder by their names in lower case.
fn list(folder: &Path) -> Result<BTreeMap<String, PathBuf>> {
    let mut names = BTreeMap::new();
    for entry in std::fs::read_dir(folder).map_err(FileError::io(folder, "open the folder"))? {
        let path = entry.map_err(FileError::io(folder, "read the folder"))?.path();
        let name = file_name(&path);
        if !name.starts_with('.') && path.is_file() {
            names.insert(name.to_lowercase(), path);
        }
    }
    Ok(names)
}

/// The mesh files of one format and one series by number.
fn numbered_meshes(names: &BTreeMap<String, PathBuf>, folder: &Path) -> Result<Vec<Numbered>> {
    let of = |wanted: &str| names.values().filter(|p| extension(p) == wanted).cloned().collect::<Vec<_>>();
    let (objs, plys) = (of("obj"), of("ply"));
    let paths = match (objs.as_slice(), plys.as_slice()) {
        ([], []) => {
            let reason = "no scans here; looked for numbered files like frame_0001.obj (with frame_0001.bmp) or \
                          frame_0001.ply";
            return Err(FileError::content(folder, reason));
        }
        (_, []) => objs,
        ([], _) => plys,
        ([a, ..], [b, ..]) => {
            let reason = format!("both OBJ ({}) and PLY ({}); keep one kind", file_name(a), file_name(b));
            return Err(FileError::content(folder, reason));
        }
    };
    if let [only] = paths.as_slice() {
        return Ok(vec![Numbered { series: String::new(), number: 0, path: only.clone() }]);
    }
    let mut meshes = Vec::with_capacity(paths.len());
    for path in &paths {
        meshes.extend(numbered(path)?);
    }
    meshes.sort_by_key(|m| m.number);
    if meshes.is_empty() {
        let reason = format!("{} mesh files without numbers; name them like frame_0001.obj", paths.len());
        return Err(FileError::content(folder, reason));
    }
    check_series(&meshes, folder)?;
    Ok(meshes)
}

fn check_series(meshes: &[Numbered], folder: &Path) -> Result<()> {
    for pair in meshes.windows(2) {
        let [a, b] = [&pair[0], &pair[1]];
        let names = format!("{} and {}", file_name(&a.path), file_name(&b.path));
        if a.series != b.series {
            return Err(FileError::content(folder, format!("two series of scans, {names}; keep one in the folder")));
        }
        if a.number == b.number {
            return Err(FileError::content(folder, format!("scan {} twice, {names}; keep one", a.number)));
        }
    }
    Ok(())
}

/// Splits the number off the end of a file's stem; none when it ends otherwise.
fn numbered(path: &Path) -> Result<Option<Numbered>> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let series = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let digits = &stem[series.len()..];
    if digits.is_empty() {
        return Ok(None);
    }
    let number = digits
        .parse()
        .map_err(|_| FileError::content(path, format!("number {digits} is too large; number scans from 0")))?;
    Ok(Some(Numbered { series: series.to_lowercase(), number, path: path.into() }))
}

/// The picture with the mesh file's stem, else the one that the mesh file or its material names and that exists.
fn find_picture(mesh: &Path, names: &BTreeMap<String, PathBuf>) -> Result<Option<PathBuf>> {
    let stem = mesh.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
    let beside = |name: &str| names.get(&name.to_lowercase()).cloned();
    if let Some(picture) = ["bmp", "png"].iter().find_map(|e| beside(&format!("{stem}.{e}"))) {
        return Ok(Some(picture));
    }
    let head = head_lines(mesh)?;
    let named = match mesh_format(mesh)? {
        MeshFormat::Ply => after(&head, "comment TextureFile"),
        MeshFormat::Obj => {
            let named = after(&head, "mtllib").and_then(|name| beside(base_name(&name)));
            match named.or_else(|| beside(&format!("{stem}.mtl"))) {
                Some(library) => diffuse_map(&library)?,
                None => None,
            }
        }
    };
    // A name with folders in it is looked for beside the mesh: material libraries often carry paths of other machines.
    Ok(named.and_then(|name| beside(base_name(&name))))
}

fn base_name(name: &str) -> &str {
    name.rsplit(['/', '\\']).next().unwrap_or(name)
}

fn head_lines(path: &Path) -> Result<String> {
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(FileError::io(path, "open"))?;
    file.take(HEAD_BYTES).read_to_end(&mut head).map_err(FileError::io(path, "read"))?;
    Ok(String::from_utf8_lossy(&head).into_owned())
}

/// What follows `keyword` on the first line that begins with it.
fn after(text: &str, keyword: &str) -> Option<String> {
    text.lines().find_map(|line| {
        let rest = line.trim().strip_prefix(keyword)?;
        (rest.starts_with(char::is_whitespace) && !rest.trim().is_empty()).then(|| rest.trim().to_owned())
    })
}

/// File name of the diffuse map of a material library. Options such as `-s 1 1 1` stand before the name.
fn diffuse_map(library: &Path) -> Result<Option<String>> {
    let text = super::error::read_limited(library, MAX_LIBRARY_BYTES)?;
    let map = after(&String::from_utf8_lossy(&text), "map_Kd");
    Ok(map.map(|map| match map.strip_prefix('-') {
        Some(options) => options.split_whitespace().next_back().unwrap_or_default().to_owned(),
        None => map,
    }))
}

/// Either all scans have a picture or none.
fn check_pictures(scans: &[ScanFiles], folder: &Path) -> Result<()> {
    let with = scans.iter().filter(|s| s.picture.is_some()).count();
    let Some(without) = scans.iter().find(|s| s.picture.is_none()).filter(|_| with > 0) else { return Ok(()) };
    let missing = without.mesh.with_extension("bmp");
    let lacking = scans.len() - with;
    let reason = format!(
        "{} is missing: {with} scans have a picture, {lacking} have none; add the missing ones or move the {} away",
        missing.file_name().unwrap_or(OsStr::new("picture")).to_string_lossy(),
        if with < lacking { "pictures" } else { "scans without" },
    );
    Err(FileError::content(folder, reason))
}

#[cfg(test)]
mod tests {
    use super::*;
    use gv3_codec::GreyPicture;

    const TRIANGLE: &str = "mtllib look.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n";

    /// A folder of files; pictures get 4 x 4 grey pixels, meshes one triangle.
    fn folder(names: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let grey = GreyPicture::filled(4, 4, 9);
        for name in names {
            let bytes = match *name {
                n if n.ends_with("obj") || n.ends_with("OBJ") => TRIANGLE.into(),
                n if n.ends_with("ply") => {
                    let mesh = obj::parse_obj(TRIANGLE.as_bytes(), Path::new("t")).unwrap().mesh;
                    ply::ply_bytes(&mesh, Some("C:\\pictures\\skin.png"))
                }
                n if n.ends_with("png") => {
                    picture::picture_bytes(&grey, picture::PictureFormat::Png, Path::new(n)).unwrap()
                }
                n if n.ends_with("bmp") || n.ends_with("BMP") => {
                    picture::picture_bytes(&grey, picture::PictureFormat::Bmp, Path::new(n)).unwrap()
                }
                n if n.ends_with("mtl") => b"newmtl a\nKa 1 1\nmap_Kd -s 1 1 1 ../textures/Skin.bmp\n".to_vec(),
                _ => b"other".to_vec(),
            };
            std::fs::write(folder.path().join(name), bytes).unwrap();
        }
        folder
    }

    fn error(names: &[&str]) -> String {
        let folder = folder(names);
        let text = ScanFolder::open(folder.path()).unwrap_err().to_string();
        text.replace(&folder.path().display().to_string(), "D")
    }

    #[test]
    fn numbers_sort_naturally_and_gaps_are_gaps() {
        let f = folder(&["s9.obj", "s9.bmp", "S11.OBJ", "s11.BMP", "s10.obj", "s10.png", "landmarks.csv", "mean.obj"]);
        let scans = ScanFolder::open(f.path()).unwrap();
        assert_eq!(
            (0..scans.len()).map(|i| (scans.name(i), scans.tick(i))).collect::<Vec<_>>(),
            [("s9.obj".to_owned(), 0), ("s10.obj".to_owned(), 1), ("S11.OBJ".to_owned(), 2)]
        );
        assert_eq!((scans.number(0), scans.number(2)), (9, 11));
        let f = folder(&["a_003.ply", "a_010.ply", "a_007.ply"]);
        let scans = ScanFolder::open(f.path()).unwrap();
        assert_eq!((0..3).map(|i| scans.tick(i)).collect::<Vec<_>>(), [0, 4, 7]);
        assert!(!scans.has_pictures());
        let loaded = scans.load(1, 50_000_000).unwrap();
        assert_eq!((loaded.scan.tick, loaded.scan.time_nanos), (4, 200_000_000));
        assert!(loaded.repairs.is_clean() && loaded.scan.texture.is_none());
    }

    #[test]
    fn pictures_by_stem_and_bytes_on_disk() {
        let f = folder(&["a1.obj", "a1.bmp", "a2.obj", "a2.bmp"]);
        let scans = ScanFolder::open(f.path()).unwrap();
        assert!(scans.has_pictures());
        assert_eq!(scans.scan_bytes(0), (TRIANGLE.len() + 1078 + 16) as u64);
        assert_eq!(scans.raw_bytes(), 2 * scans.scan_bytes(0));
        let scan = scans.load(0, 1).unwrap().scan;
        assert_eq!(scan.texture.unwrap(), GreyPicture::filled(4, 4, 9));
        scan.mesh.validate().unwrap();
    }

    #[test]
    fn a_shared_picture_is_found_by_material_and_counts_once() {
        let f = folder(&["a1.obj", "a2.obj", "look.mtl", "skin.bmp"]);
        let scans = ScanFolder::open(f.path()).unwrap();
        assert!(scans.has_pictures());
        assert_eq!(scans.raw_bytes(), (2 * TRIANGLE.len() + 1078 + 16) as u64);
        let f = folder(&["a1.obj", "a1.mtl", "skin.bmp"]);
        assert!(ScanFolder::open(f.path()).unwrap().has_pictures());
        let f = folder(&["a1.ply", "skin.png"]);
        assert!(ScanFolder::open(f.path()).unwrap().has_pictures());
        let f = folder(&["a1.obj", "look.mtl"]);
        assert!(!ScanFolder::open(f.path()).unwrap().has_pictures());
    }

    #[test]
    fn a_single_file_is_a_sequence_of_one() {
        let f = folder(&["face.obj", "face.bmp", "other.obj", "other.ply"]);
        let scans = ScanFolder::open(&f.path().join("face.obj")).unwrap();
        assert_eq!((scans.len(), scans.tick(0), scans.has_pictures()), (1, 0, true));
        let f = folder(&["face.obj"]);
        assert_eq!(ScanFolder::open(f.path()).unwrap().len(), 1);
        let f = folder(&["a.csv"]);
        let error = ScanFolder::open(&f.path().join("a.csv")).unwrap_err().to_string();
        assert!(error.contains("a.csv: neither .obj nor .ply; give a mesh file"), "{error}");
    }

    #[test]
    fn what_cannot_be_used_is_named() {
        assert_eq!(
            error(&["landmarks.csv", "a1.bmp", ".a1.obj"]),
            "D: no scans here; looked for numbered files like frame_0001.obj (with frame_0001.bmp) or frame_0001.ply"
        );
        assert_eq!(error(&["a1.obj", "a1.ply"]), "D: both OBJ (a1.obj) and PLY (a1.ply); keep one kind");
        assert_eq!(error(&["a1.obj", "b2.obj"]), "D: two series of scans, a1.obj and b2.obj; keep one in the folder");
        assert!(error(&["a1.obj", "a01.obj"]).starts_with("D: scan 1 twice, "));
        assert_eq!(error(&["a.obj", "b.obj"]), "D: 2 mesh files without numbers; name them like frame_0001.obj");
        assert!(error(&["a1.obj", "a99999999999999999999.obj"]).contains("99999999999999999999 is too large"));
        assert_eq!(
            error(&["a1.obj", "a1.bmp", "a2.obj", "a3.obj", "a3.bmp"]),
            "D: a2.bmp is missing: 2 scans have a picture, 1 have none; add the missing ones or move the scans without \
             away"
        );
        let error = ScanFolder::open(Path::new("/no/such")).unwrap_err().to_string();
        assert!(error.starts_with("/no/such: cannot open the folder: "), "{error}");
    }
}
