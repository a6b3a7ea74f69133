//! The YAML that OpenCV's FileStorage writes, as far as calibrations need it.
//!
//! ```text
//! %YAML:1.0
//! ---
//! cameraMatrix1: !!opencv-matrix
//!    rows: 3
//!    cols: 3
//!    dt: d
//!    data: [ 1150., 0., 321.5, 0., 1148., 238., 0., 0., 1. ]
//! imageSize1: [ 640, 480 ]
//! ```
//! Its first line is no directive of YAML, so that general readers refuse it. Entries begin in the first column and reach
//! over the indented lines below; what is not asked for is not looked into.

use super::LightError;

/// Most numbers of an entry.
const MAX_NUMBERS: usize = 4096;

/// The entries of a text.
pub(super) struct OpencvYaml<'a> {
    entries: Vec<Entry<'a>>,
}

struct Entry<'a> {
    key: &'a str,
    /// 1-based.
    line: usize,
    /// What follows the key, over all its lines.
    body: &'a str,
}

/// Numbers of a matrix, row-major, or of a list, which is one row.
#[derive(Debug, PartialEq)]
pub(super) struct Numbers {
    pub rows: usize,
    pub columns: usize,
    pub values: Vec<f64>,
}

impl<'a> OpencvYaml<'a> {
    /// Finds the entries of a text.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the line: no entry, or a key that is there twice.
    pub fn parse(text: &'a str) -> Result<Self, LightError> {
        let mut entries: Vec<Entry> = Vec::new();
        let mut start = 0;
        for (index, line) in text.split_inclusive('\n').enumerate() {
            let end = start + line.len();
            let bare = line.trim_end();
            let goes_on = bare.is_empty() || bare.starts_with([' ', '\t']) || bare.starts_with("- ") || bare == "-";
            let is_mark = bare.starts_with(['%', '#']) || bare.starts_with("---") || bare == "...";
            if goes_on {
                if let Some(last) = entries.last_mut() {
                    let body_start = last.body.as_ptr() as usize - text.as_ptr() as usize;
                    last.body = &text[body_start..end];
                }
            } else if !is_mark {
                let (key, _) = bare.split_once(':').ok_or_else(|| {
                    let shown: String = bare.chars().take(40).collect();
                    LightError::field(format!("line {}", index + 1), format!("{shown:?}, expected a key and a colon"))
                })?;
                entries.push(Entry {
                    key: key.trim().trim_matches('"'),
                    line: index + 1,
                    body: &text[start + key.len() + 1..end],
                });
            }
            start = end;
        }
        let mut keys: Vec<(&str, usize)> = entries.iter().map(|e| (e.key, e.line)).collect();
        keys.sort_unstable();
        if let Some(pair) = keys.windows(2).find(|pair| pair[0].0 == pair[1].0) {
            let reason = format!("there twice, in line {} too; remove one", pair[0].1);
            return Err(LightError::field(place(pair[1].1, pair[1].0), reason));
        }
        Ok(Self { entries })
    }

    /// Numbers of the first of the keys that is there, with its place for errors.
    ///
    /// # Errors
    /// [`LightError::Field`] naming line and key of an entry that is no matrix, list or number of finite numbers.
    pub fn numbers(&self, keys: &[&str]) -> Result<Option<(String, Numbers)>, LightError> {
        let Some(entry) = keys.iter().find_map(|key| self.entries.iter().find(|e| e.key == *key)) else {
            return Ok(None);
        };
        let place = place(entry.line, entry.key);
        let numbers = entry.numbers().map_err(|reason| LightError::field(&place, reason))?;
        Ok(Some((place, numbers)))
    }
}

fn place(line: usize, key: &str) -> String {
    let key: String = key.chars().take(60).collect();
    format!("line {line}, {key}")
}

impl Entry<'_> {
    fn numbers(&self) -> Result<Numbers, String> {
        let body = self.body.trim();
        if body.starts_with('[') {
            let values = list(body)?;
            return Ok(Numbers { rows: 1, columns: values.len(), values });
        }
        if !body.contains("data:") {
            return Ok(Numbers { rows: 1, columns: 1, values: vec![number(body)?] });
        }
        let (head, data) = body.split_once("data:").unwrap_or((body, ""));
        let field = |name: &str| {
            let line = head.lines().find_map(|line| line.trim().strip_prefix(name)?.strip_prefix(':'));
            line.map(str::trim).ok_or_else(|| format!("no {name}; expected rows, cols, dt and data"))
        };
        let side = |name: &str| {
            let text = field(name)?;
            let side = text.parse::<usize>().ok().filter(|n| (1..=MAX_NUMBERS).contains(n));
            side.ok_or_else(|| format!("{name}: {:?} is no number of rows or columns", shown(text)))
        };
        let (rows, columns) = (side("rows")?, side("cols")?);
        let kind = field("dt")?;
        if !["u", "c", "w", "s", "i", "f", "d"].contains(&kind.trim_matches('"')) {
            return Err(format!("dt: {:?}, expected one number an element, d or f", shown(kind)));
        }
        let values = list(data.trim())?;
        if rows.checked_mul(columns) != Some(values.len()) {
            return Err(format!("{} numbers for {rows} x {columns}", values.len()));
        }
        Ok(Numbers { rows, columns, values })
    }
}

/// Numbers between brackets.
fn list(text: &str) -> Result<Vec<f64>, String> {
    let inner = text.strip_prefix('[').and_then(|t| t.strip_suffix(']'));
    let inner = inner.ok_or_else(|| format!("{:?}, expected numbers between [ and ]", shown(text)))?;
    if inner.bytes().filter(|&b| b == b',').count() >= MAX_NUMBERS {
        return Err(format!("more than {MAX_NUMBERS} numbers"));
    }
    inner.split(',').map(|part| number(part.trim())).collect()
}

fn number(text: &str) -> Result<f64, String> {
    let value = text.parse::<f64>().ok().filter(|v| v.is_finite());
    value.ok_or_else(|| format!("{:?} is no finite number", shown(text)))
}

/// The beginning of a text, for errors.
fn shown(text: &str) -> String {
    text.chars().take(40).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// As OpenCV 4 writes it: strings, numbers, maps, lists over several lines.
    const TEXT: &str = "%YAML:1.0\n---\ncalibration_time: \"Sat Nov 21 10:11:12 2026\"\nimage_width: 1280\nflags: 0\n\
        M: !!opencv-matrix\n   rows: 2\n   cols: 3\n   dt: d\n   data: [ 1., -2.5e-01, .5, 4.,\n       5., 6.0000000000000000e+00 ]\n\
        nested:\n   a: 1\n   b: [ 1, 2 ]\nimages:\n   - \"a: b.png\"\n   - c.png\nsize: [ 1280,\n    1024 ]\n# note\n...\n";

    fn error(text: &str, key: &str) -> String {
        let found = OpencvYaml::parse(text).and_then(|yaml| yaml.numbers(&[key]).map(|n| format!("{n:?}")));
        found.unwrap_err().to_string()
    }

    #[test]
    fn matrices_lists_and_numbers_are_read() {
        let yaml = OpencvYaml::parse(TEXT).unwrap();
        let values = |key: &str| yaml.numbers(&["absent", key]).unwrap().unwrap();
        let (place, m) = values("M");
        assert_eq!(place, "line 6, M");
        assert_eq!(m, Numbers { rows: 2, columns: 3, values: vec![1.0, -0.25, 0.5, 4.0, 5.0, 6.0] });
        assert_eq!(values("size").1.values, [1280.0, 1024.0]);
        assert_eq!(values("image_width").1.values, [1280.0]);
        assert_eq!(yaml.numbers(&["absent"]).unwrap(), None);
        assert_eq!(OpencvYaml::parse(&TEXT.replace('\n', "\r\n")).unwrap().numbers(&["M"]).unwrap().unwrap().1, m);
    }

    #[test]
    fn errors_name_line_and_key() {
        assert_eq!(error(&TEXT.replace("rows: 2", "rows: 3"), "M"), "line 6, M: 6 numbers for 3 x 3");
        assert!(error(&TEXT.replace("rows: 2", "rows: -2"), "M").contains("line 6, M: rows: \"-2\""));
        assert!(error(&TEXT.replace("rows: 2", ""), "M").contains("no rows"));
        assert!(error(&TEXT.replace("dt: d", "dt: 3d"), "M").contains("dt: \"3d\""));
        assert!(error(&TEXT.replace("5.,", ".Nan,"), "M").contains("\".Nan\" is no finite number"));
        assert!(error(&TEXT.replace("5.,", "inf,"), "M").contains("\"inf\" is no finite number"));
        assert!(error(&TEXT.replace("e+00 ]", "e+00"), "M").contains("between [ and ]"));
        assert!(error(TEXT, "calibration_time").starts_with("line 3, calibration_time"));
        assert_eq!(error(&format!("{TEXT}M: 3\n"), "M"), "line 22, M: there twice, in line 6 too; remove one");
        assert!(error("%YAML:1.0\n---\nno key here\n", "M").starts_with("line 3: \"no key here\""));
        let long = format!("x: [ {}1 ]\n", "1, ".repeat(MAX_NUMBERS));
        assert!(error(&long, "x").contains("more than 4096 numbers"));
    }

    proptest! {
        #[test]
        fn no_text_breaks_the_reader(text in "(%YAML:1.0\n)?([a-cM]{0,2}[:\\[\\]\\- \n.,0-9!\"é#]{0,6}){0,30}") {
            if let Ok(yaml) = OpencvYaml::parse(&text) {
                for entry in &yaml.entries {
                    let _ = yaml.numbers(&[entry.key]);
                }
            }
        }

        #[test]
        fn numbers_come_back(values in prop::collection::vec(any::<f64>().prop_filter("finite", |v| v.is_finite()), 1..20)) {
            let list: Vec<String> = values.iter().map(|v| format!("{v:?}")).collect();
            let text = format!("%YAML:1.0\n---\nv: [ {} ]\n", list.join(", "));
            let found = OpencvYaml::parse(&text).unwrap().numbers(&["v"]).unwrap().unwrap().1;
            prop_assert_eq!(found.values, values);
        }
    }
}
