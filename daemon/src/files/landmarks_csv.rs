//! Landmarks of scans as CSV, placed by a person or another program:
//! ```csv
//! scan,name,vertex,x,y,z
//! 12,nose tip,,0.4,-12.25,61
//! ,chin,4711,,,
//! ```
//! `scan` is the number in the scan's file name, empty for all scans. The position is `x,y,z` (mm), and where these are empty
//! that of `vertex`, the mesh file's vertex counted from 1. A landmark of one scan goes before the one of the same name for
//! all scans. Lines may come in any order. The header `frame,landmark,vertex,x,y,z` means the same.

use super::error::{FileError, Result, read_limited};
use glam::Vec3;
use gv3_codec::mesh::TriMesh;
use gv3_codec::seed::GivenLandmark;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Largest file read.
const MAX_BYTES: u64 = 64 << 20;
/// Most lines.
const MAX_LANDMARKS: usize = 1 << 20;
/// Most different names: about what a keyframe can use.
const MAX_NAMES: usize = 1024;
/// Longest name, bytes.
const MAX_NAME_BYTES: usize = 64;
/// Farthest from the origin along an axis, mm.
const MAX_MM: f32 = 1e6;
/// First line as written.
const HEADER: &str = "scan,name,vertex,x,y,z";
/// First line as synthetic sequences have it.
const FRAME_HEADER: &str = "frame,landmark,vertex,x,y,z";

/// One line of the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Landmark {
    /// Number of the scan, `None` for all.
    pub scan: Option<u64>,
    /// Stands for the same point of the skin in all scans.
    pub name: String,
    /// Vertex of the mesh file, counted from 1.
    pub vertex: Option<u32>,
    /// Position; where there is none it is that of `vertex`.
    pub position_mm: Option<Vec3>,
}

/// The landmarks of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct LandmarkTable {
    path: PathBuf,
    landmarks: Vec<Landmark>,
    /// By scan; the indices of its landmarks by the name's place among all names.
    by_scan: BTreeMap<Option<u64>, BTreeMap<u32, usize>>,
}

impl LandmarkTable {
    /// Reads a file of landmarks; see [`Self::parse`].
    ///
    /// # Errors
    /// [`FileError`]: not readable, or as [`Self::parse`].
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(&read_limited(path, MAX_BYTES)?, path)
    }

    /// The landmarks of a file's bytes, in the order of its lines. `path` only names the bytes in errors.
    ///
    /// # Errors
    /// [`FileError::Line`] naming line and field: another header, a field missing or too many, no number, neither vertex nor
    /// position, a name twice in a scan, too many; [`FileError`] for bytes that are no text and a file without landmarks.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self> {
        let text = std::str::from_utf8(bytes).map_err(|e| {
            FileError::byte(path, e.valid_up_to(), "no UTF-8 text; export the landmarks as CSV in UTF-8")
        })?;
        let mut lines = text.trim_start_matches('\u{feff}').lines().enumerate();
        let first = lines.next().map_or("", |(_, line)| line.trim());
        if first != HEADER && first != FRAME_HEADER {
            let found: String = first.chars().take(60).collect();
            let reason = format!("found {found:?}, expected the header {HEADER}; put it above the landmarks");
            return Err(FileError::line(path, 1, reason));
        }
        let mut landmarks = Vec::new();
        for (index, line) in lines.filter(|(_, line)| !line.trim().is_empty()) {
            if landmarks.len() == MAX_LANDMARKS {
                return Err(FileError::line(path, index + 1, format!("more than {MAX_LANDMARKS} landmarks; split it")));
            }
            let landmark = parse_line(line).map_err(|reason| FileError::line(path, index + 1, reason))?;
            landmarks.push((index + 1, landmark));
        }
        if landmarks.is_empty() {
            return Err(FileError::content(path, "no landmarks below the header; add one a line"));
        }
        let by_scan = index(&landmarks).map_err(|(line, reason)| FileError::line(path, line, reason))?;
        let landmarks = landmarks.into_iter().map(|(_, landmark)| landmark).collect();
        Ok(Self { path: path.into(), landmarks, by_scan })
    }

    /// The landmarks in the order of the file's lines.
    pub fn landmarks(&self) -> &[Landmark] {
        &self.landmarks
    }

    /// Whether some landmark is one of this scan.
    pub fn has_scan(&self, number: u64) -> bool {
        self.by_scan.contains_key(&Some(number)) || self.by_scan.contains_key(&None)
    }

    /// The landmarks of a scan, ids ascending; an id is one name in all scans.
    ///
    /// # Errors
    /// [`FileError::Content`] naming a landmark whose vertex the mesh has not.
    pub fn of_scan(&self, number: u64, mesh: &TriMesh) -> Result<Vec<GivenLandmark>> {
        let mut chosen: BTreeMap<u32, usize> = BTreeMap::new();
        for scan in [None, Some(number)] {
            chosen.extend(self.by_scan.get(&scan).into_iter().flatten());
        }
        let place = |(id, i): (u32, usize)| {
            let landmark = &self.landmarks[i];
            let of_vertex = || mesh.positions_mm.get(landmark.vertex?.checked_sub(1)? as usize).copied();
            let position_mm = landmark.position_mm.or_else(of_vertex).ok_or_else(|| {
                let (name, vertex, count) = (&landmark.name, landmark.vertex.unwrap_or(0), mesh.vertex_count());
                let reason = format!(
                    "landmark {name:?}, vertex: {vertex}, but scan {number} has vertices 1 to {count}; correct the vertex \
                     or give x, y and z"
                );
                FileError::content(&self.path, reason)
            })?;
            Ok(GivenLandmark { id, position_mm })
        };
        chosen.into_iter().map(place).collect()
    }
}

type Index = BTreeMap<Option<u64>, BTreeMap<u32, usize>>;

/// Names by their place among all, and lines by scan and name; the error is a line and what is wrong with it.
fn index(landmarks: &[(usize, Landmark)]) -> std::result::Result<Index, (usize, String)> {
    let mut names = BTreeSet::new();
    for (line, landmark) in landmarks {
        names.insert(landmark.name.as_str());
        if names.len() > MAX_NAMES {
            return Err((*line, format!("name: more than {MAX_NAMES} different names; keep fewer")));
        }
    }
    let ids: BTreeMap<&str, u32> = names.into_iter().zip(0..).collect();
    let mut by_scan = Index::new();
    for (i, (line, landmark)) in landmarks.iter().enumerate() {
        if by_scan.entry(landmark.scan).or_default().insert(ids[landmark.name.as_str()], i).is_some() {
            let scan = landmark.scan.map_or("all scans".to_owned(), |n| format!("scan {n}"));
            return Err((*line, format!("name: {:?} is there twice for {scan}; keep one", landmark.name)));
        }
    }
    Ok(by_scan)
}

fn parse_line(line: &str) -> std::result::Result<Landmark, String> {
    let fields: Vec<&str> = line.split(',').map(str::trim).collect();
    let [scan, name, vertex, x, y, z] = fields[..] else {
        return Err(format!("{} fields, expected 6: {HEADER}", fields.len()));
    };
    let scan = match scan {
        "" => None,
        _ => Some(scan.parse().map_err(|_| {
            format!("scan: {scan:?}, expected the number in a scan's file name, or nothing for all scans")
        })?),
    };
    if !is_name(name) {
        return Err(format!("name: 1 to {MAX_NAME_BYTES} bytes without quotes and control characters are needed"));
    }
    let vertex = match vertex {
        "" => None,
        _ => Some(vertex.parse().ok().filter(|v| *v > 0).ok_or_else(|| {
            format!("vertex: {vertex:?}, expected a whole number, the first vertex being 1, or nothing")
        })?),
    };
    let position_mm = match [x, y, z] {
        ["", "", ""] if vertex.is_some() => None,
        ["", "", ""] => return Err("vertex, x, y, z: all empty; give a vertex or a position".into()),
        _ => Some(Vec3::new(coordinate("x", x)?, coordinate("y", y)?, coordinate("z", z)?)),
    };
    Ok(Landmark { scan, name: name.into(), vertex, position_mm })
}

fn coordinate(field: &str, text: &str) -> std::result::Result<f32, String> {
    let value = text.parse::<f32>().ok().filter(|v| v.abs() <= MAX_MM);
    value.ok_or_else(|| format!("{field}: {text:?}, expected millimetres from -{MAX_MM} to {MAX_MM}"))
}

fn is_name(name: &str) -> bool {
    let is_plain = |c: char| !c.is_control() && c != ',' && c != '"';
    name.trim() == name && !name.is_empty() && name.len() <= MAX_NAME_BYTES && name.chars().all(is_plain)
}

/// Landmarks as [`LandmarkTable::parse`] reads them; numbers come back to the bit.
///
/// # Errors
/// [`FileError::Content`] for a landmark that the format cannot hold.
pub fn landmarks_csv(landmarks: &[Landmark], path: &Path) -> Result<String> {
    use std::fmt::Write;
    let mut text = format!("{HEADER}\n");
    for Landmark { scan, name, vertex, position_mm } in landmarks {
        let is_position = position_mm.is_none_or(|p| p.is_finite() && p.abs().max_element() <= MAX_MM);
        if !is_name(name) || !is_position || vertex.map_or(position_mm.is_none(), |v| v == 0) {
            let reason = format!("landmark {name:?} cannot be written; give a plain name and a vertex or a position");
            return Err(FileError::content(path, reason));
        }
        let scan = scan.map_or(String::new(), |n| n.to_string());
        let vertex = vertex.map_or(String::new(), |v| v.to_string());
        let position = position_mm.map_or(",,".to_owned(), |p| format!("{},{},{}", p.x, p.y, p.z));
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{scan},{name},{vertex},{position}");
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse(text: &str) -> std::result::Result<LandmarkTable, String> {
        LandmarkTable::parse(text.as_bytes(), Path::new("l.csv")).map_err(|e| e.to_string())
    }

    fn mesh() -> TriMesh {
        TriMesh { positions_mm: vec![Vec3::X, Vec3::Y], ..TriMesh::default() }
    }

    #[test]
    fn a_scan_goes_before_all_and_a_position_before_a_vertex() {
        let table = parse("scan,name,vertex,x,y,z\r\n,nose,2,,,\n7, nose ,1,4,5e0,-6\n\n7,chin,1,,,\n").unwrap();
        let given = |scan| table.of_scan(scan, &mesh()).unwrap();
        let landmark = |id, position_mm| GivenLandmark { id, position_mm };
        assert_eq!(given(7), [landmark(0, Vec3::X), landmark(1, Vec3::new(4.0, 5.0, -6.0))]);
        assert_eq!(given(8), [landmark(1, Vec3::Y)]);
        assert!(table.has_scan(8));
        let error = table.of_scan(8, &TriMesh::default()).unwrap_err().to_string();
        assert!(error.starts_with("l.csv: landmark \"nose\", vertex: 2, but scan 8 has"), "{error}");
    }

    #[test]
    fn the_header_of_synthetic_sequences_is_read() {
        let table = parse("frame,landmark,vertex,x,y,z\n0,0,74460,-76.1634,38.9631,-38.7113\n0,1,5,1,2,3\n").unwrap();
        assert_eq!(table.landmarks()[0].name, "0");
        assert_eq!(table.landmarks()[0].position_mm, Some(Vec3::new(-76.1634, 38.9631, -38.7113)));
        assert!(table.has_scan(0) && !table.has_scan(1));
    }

    #[test]
    fn errors_name_file_line_and_field() {
        let error = |line: &str| parse(&format!("{HEADER}\n1,a,,1,1,1\n{line}\n")).unwrap_err();
        assert_eq!(error("1,a,,2,2,2"), "l.csv, line 3: name: \"a\" is there twice for scan 1; keep one");
        assert_eq!(error("1,b,2"), "l.csv, line 3: 3 fields, expected 6: scan,name,vertex,x,y,z");
        assert!(error("-1,b,,1,1,1").contains("line 3: scan: \"-1\""));
        assert!(error("1,,,1,1,1").contains("name: 1 to 64"));
        assert!(error("1,b,0,1,1,1").contains("vertex: \"0\""));
        assert!(error("1,b,,,,").contains("all empty"));
        assert!(error("1,b,3,1,,1").contains("y: \"\""));
        assert!(error("1,b,,NaN,1,1").contains("x: \"NaN\"") && error("1,b,,1,1,1e7").contains("z: \"1e7\""));
        assert!(parse("").unwrap_err().contains("line 1") && parse("1,a,,1,1,1").unwrap_err().contains("header"));
        assert!(parse("scan,name,vertex,x,y,z\n").unwrap_err().contains("no landmarks"));
        let many: String = (0..=MAX_NAMES).map(|i| format!(",n{i},1,,,\n")).collect();
        assert!(parse(&format!("{HEADER}\n{many}")).unwrap_err().contains("line 1026: name: more than 1024"));
    }

    fn landmark() -> impl Strategy<Value = Landmark> {
        let position = prop::array::uniform3(-MAX_MM..MAX_MM).prop_map(Vec3::from);
        let scan = prop::option::of(any::<u64>());
        (scan, "[a-zé0-9]([a-z _.]{0,8}[a-z])?", prop::option::of(1..u32::MAX), prop::option::of(position)).prop_map(
            |(scan, name, vertex, position_mm)| {
                let vertex = vertex.or(position_mm.is_none().then_some(1));
                Landmark { scan, name, vertex, position_mm }
            },
        )
    }

    proptest! {
        #[test]
        fn what_is_written_reads_back_and_damage_never_panics(
            landmarks in prop::collection::vec(landmark(), 1..5),
            flip in any::<u8>(),
        ) {
            let mut seen = BTreeSet::new();
            let mut landmarks = landmarks;
            landmarks.retain(|l| seen.insert((l.scan, l.name.clone())));
            let text = landmarks_csv(&landmarks, Path::new("l.csv")).unwrap();
            let table = parse(&text).unwrap();
            prop_assert_eq!(table.landmarks(), &landmarks[..]);
            for n in 0..text.len() {
                let _ = LandmarkTable::parse(&text.as_bytes()[..n], Path::new("l.csv"));
                let mut bad = text.clone().into_bytes();
                bad[n] ^= flip;
                let _ = LandmarkTable::parse(&bad, Path::new("l.csv"));
            }
        }
    }
}
