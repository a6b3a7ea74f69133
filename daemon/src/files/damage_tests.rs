//! Readers of foreign files meet every truncation and every flipped bit of the fuzzing corpora: an error or a valid
//! result, never a panic.

use super::{MeshFile, Result, obj::parse_obj, picture::parse_picture, ply::parse_ply};
use crate::light::{Calibration, LightError};
use std::path::Path;

/// Calls `check` with every file of a corpus.
fn for_each_file(corpus: &str, check: impl Fn(&[u8], &Path)) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(corpus);
    let mut files = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        check(&std::fs::read(&path).unwrap(), &path);
        files += 1;
    }
    assert!(files >= 2, "the corpus {corpus} is missing");
}

/// Calls `check` with the bytes cut short anywhere and with any one bit flipped.
fn for_each_damage(bytes: &[u8], check: impl Fn(&[u8])) {
    for length in 0..bytes.len() {
        check(&bytes[..length]);
    }
    let mut damaged = bytes.to_vec();
    for bit in 0..bytes.len() * 8 {
        damaged[bit / 8] ^= 1 << (bit % 8);
        check(&damaged);
        damaged[bit / 8] ^= 1 << (bit % 8);
    }
}

fn check_mesh(parse: fn(&[u8], &Path) -> Result<MeshFile>, corpus: &str) {
    for_each_file(corpus, |bytes, path| {
        parse(bytes, path).unwrap().mesh.validate().unwrap();
        for_each_damage(bytes, |damaged| match parse(damaged, path) {
            Ok(file) => file.mesh.validate().unwrap(),
            Err(error) => assert!(error.to_string().len() < 600, "{error}"),
        });
    });
}

#[test]
fn obj() {
    check_mesh(parse_obj, "obj");
}

#[test]
fn ply() {
    check_mesh(parse_ply, "ply");
}

#[test]
fn pictures() {
    for_each_file("picture", |bytes, path| {
        let picture = parse_picture(bytes, path).unwrap();
        assert_eq!((picture.width_px, picture.height_px), (3, 2), "{}", path.display());
        for_each_damage(bytes, |damaged| drop(parse_picture(damaged, path)));
    });
}

#[test]
fn calibrations() {
    let parse = |bytes: &[u8]| {
        let text = String::from_utf8_lossy(bytes);
        Calibration::from_text::<LightError>(&text, || Ok([[640, 480], [912, 1140]]))
    };
    for_each_file("calibration", |bytes, path| {
        let calibration = parse(bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert_eq!(calibration.camera.width_px, 640, "{}", path.display());
        for_each_damage(bytes, |damaged| match parse(damaged) {
            Ok(calibration) => calibration.validate().unwrap(),
            Err(error) => assert!(error.to_string().len() < 2 * bytes.len() + 600, "{error}"),
        });
    });
}
