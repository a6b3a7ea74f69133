//! A folder of pattern pictures and the TOML that says what they show.
//!
//! ```toml
//! pictures = "graycode_##.png"   # or a list of names; # is a digit
//! first = 0                      # number of the first picture
//! [sequence]                     # as in a rig's file
//! width_px = 1024
//! height_px = 768
//! [[sequence.patterns]]
//! kind = "gray"
//! bits = 10
//! pairs = true
//! [[sequence.patterns]]
//! kind = "white"
//! [limits.depth]                 # optional
//! near_mm = 3000.0
//! far_mm = 4000.0
//! ```

use super::error::{FileError, Result, read_limited};
use super::picture::read_picture;
use super::processing_config::ProcessingConfig;
use crate::light::{Limits, PatternSequence};
use gv3_codec::GreyPicture;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Largest description read.
const MAX_TEXT_BYTES: u64 = 1 << 20;
/// Most memory that the pictures of a folder may take.
const MAX_FOLDER_BYTES: u64 = 4 << 30;

/// What the pictures of a folder show.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawFolder {
    /// Names of the pictures, in the order of the patterns.
    pub pictures: PictureNames,
    /// Number of the first picture when the names are numbered.
    #[serde(default)]
    pub first: u32,
    /// What was projected.
    pub sequence: PatternSequence,
    /// Limits of the reconstruction; defaults when left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limits: Option<Limits>,
    /// How fringe orders are found, and the projector's phase errors.
    #[serde(default, skip_serializing_if = "ProcessingConfig::is_default")]
    pub processing: ProcessingConfig,
}

/// Names of pictures.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum PictureNames {
    /// One name with a run of `#` for the digits of the number.
    Numbered(String),
    /// A name each.
    Listed(Vec<String>),
}

impl RawFolder {
    /// Reads and checks a description.
    ///
    /// # Errors
    /// [`FileError`]: not readable, no TOML of this kind, a sequence or limits that cannot work, names that do not fit.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = read_limited(path, MAX_TEXT_BYTES)?;
        let text = String::from_utf8(bytes).map_err(|e| FileError::content(path, format!("no text: {e}")))?;
        let content = |reason: String| FileError::content(path, reason);
        let mut folder: Self = toml::from_str(&text).map_err(|e| content(e.to_string().trim_end().into()))?;
        folder.sequence.validate().map_err(|e| content(e.to_string()))?;
        folder.limits.unwrap_or_default().validate().map_err(|e| content(e.to_string()))?;
        folder.names().map_err(|e| content(e.to_string()))?;
        folder.processing.start_at(path);
        Ok(folder)
    }

    /// The description as TOML; [`Self::read`] gives back the same.
    ///
    /// # Errors
    /// [`FileError::Content`] when a number has no TOML form.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self).map_err(|e| FileError::content(Path::new("sequence.toml"), e.to_string()))
    }

    /// Name of the picture of every pattern.
    ///
    /// # Errors
    /// [`FileError::Content`] when names and patterns differ in number, or a numbered name has no `#`.
    pub fn names(&self) -> Result<Vec<String>> {
        let wrong = |reason: String| FileError::content(Path::new("pictures"), reason);
        let count = self.sequence.patterns.len();
        match &self.pictures {
            PictureNames::Listed(names) if names.len() != count => {
                Err(wrong(format!("{} names for {count} patterns; give one a pattern, in order", names.len())))
            }
            PictureNames::Listed(names) => Ok(names.clone()),
            PictureNames::Numbered(name) => {
                let start = name.find('#').ok_or_else(|| {
                    wrong(format!("{name:?} has no # where the number stands; write it like picture_##.png"))
                })?;
                let digits = name[start..].bytes().take_while(|&b| b == b'#').count();
                let (head, tail) = (&name[..start], &name[start + digits..]);
                let first = u64::from(self.first);
                Ok((first..first + count as u64).map(|n| format!("{head}{n:0digits$}{tail}")).collect())
            }
        }
    }

    /// Reads every picture from `folder`; all must be of `size_px`, the calibration's camera.
    ///
    /// # Errors
    /// [`FileError`] naming the picture and its pattern: missing, damaged, of another size.
    pub fn load(&self, folder: &Path, size_px: [u32; 2]) -> Result<Vec<GreyPicture>> {
        let names = self.names()?;
        let [width_px, height_px] = size_px;
        let bytes = u64::from(width_px) * u64::from(height_px) * names.len() as u64;
        if bytes > MAX_FOLDER_BYTES {
            let reason = format!("{} pictures of {width_px} x {height_px} pixels take more than 4 GiB", names.len());
            return Err(FileError::content(folder, reason));
        }
        let mut pictures: Vec<GreyPicture> = Vec::with_capacity(names.len());
        for (index, name) in names.iter().enumerate() {
            let path = folder.join(name);
            if !path.is_file() {
                let reason = format!("missing; the sequence has it as picture {} of {}", index + 1, names.len());
                return Err(FileError::content(&path, reason));
            }
            let picture = read_picture(&path)?;
            if (picture.width_px, picture.height_px) != (width_px, height_px) {
                let found = format!("{} x {} pixels", picture.width_px, picture.height_px);
                let reason = match pictures.first() {
                    Some(_) => format!("{found}, but the pictures before it have {width_px} x {height_px}"),
                    None => format!("{found}, but the calibration is for a camera of {width_px} x {height_px}"),
                };
                return Err(FileError::content(&path, reason));
            }
            pictures.push(picture);
        }
        Ok(pictures)
    }
}

#[cfg(test)]
mod tests {
    use super::super::picture::{PictureFormat, picture_bytes};
    use super::*;

    const TEXT: &str = "pictures = \"p_##.png\"\nfirst = 7\n[sequence]\nwidth_px = 64\nheight_px = 32\n\
                        [[sequence.patterns]]\nperiod_px = 16.0\nsteps = 3\n";

    fn read(text: &str) -> std::result::Result<RawFolder, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.toml");
        std::fs::write(&path, text).unwrap();
        RawFolder::read(&path).map_err(|e| e.to_string())
    }

    #[test]
    fn names_are_numbered_or_listed() {
        assert_eq!(read(TEXT).unwrap().names().unwrap(), ["p_07.png", "p_08.png", "p_09.png"]);
        let listed = TEXT.replace("\"p_##.png\"", "[\"a.bmp\", \"b.bmp\", \"c.bmp\"]");
        assert_eq!(read(&listed).unwrap().names().unwrap(), ["a.bmp", "b.bmp", "c.bmp"]);
        assert!(read(&TEXT.replace("\"p_##.png\"", "[\"a.bmp\"]")).unwrap_err().contains("1 names for 3 patterns"));
        assert!(read(&TEXT.replace("p_##", "p")).unwrap_err().contains("has no #"));
        assert!(read(&TEXT.replace("16.0", "nan")).unwrap_err().contains("sequence.patterns[0].period_px"));
        assert!(read(&TEXT.replace("first", "fist")).unwrap_err().contains("fist"));
    }

    #[test]
    fn a_picture_that_does_not_fit_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let raw = read(TEXT).unwrap();
        let write = |name: &str, w| {
            let path = folder.path().join(name);
            let bytes = picture_bytes(&GreyPicture::filled(w, 4, 9), PictureFormat::Png, &path).unwrap();
            std::fs::write(path, bytes).unwrap();
        };
        write("p_07.png", 5);
        write("p_09.png", 6);
        let error = |size| raw.load(folder.path(), size).unwrap_err().to_string();
        assert!(error([5, 4]).ends_with("p_08.png: missing; the sequence has it as picture 2 of 3"));
        assert!(error([8, 4]).ends_with("p_07.png: 5 x 4 pixels, but the calibration is for a camera of 8 x 4"));
        write("p_08.png", 5);
        assert!(error([5, 4]).ends_with("p_09.png: 6 x 4 pixels, but the pictures before it have 5 x 4"));
        assert!(error([16_384, 100_000]).contains("more than 4 GiB"));
        write("p_09.png", 5);
        assert_eq!(raw.load(folder.path(), [5, 4]).unwrap().len(), 3);
    }
}
