//! Metadata records of a session: named groups of text pairs, each with a checksum (SESSION.md, "Metadata").

use std::collections::BTreeMap;
use std::collections::btree_map::Iter;
use std::fmt::Display;
use std::str::FromStr;

use super::bytes::Bytes;
use super::error::Fault;
use super::{FORMAT_VERSION, METADATA_LIMIT, Result, SessionError};

/// Names of the groups and keys that SESSION.md fixes.
pub mod key {
    /// Group: version, time, mode and producer.
    pub const SESSION: &str = "gv3.session";
    /// Group: the rig's calibration, key [`TOML`].
    pub const CALIBRATION: &str = "gv3.calibration";
    /// Group: the configuration the session was made with, key [`TOML`].
    pub const CONFIGURATION: &str = "gv3.configuration";
    /// Group written at the end: counts and sizes.
    pub const STATISTICS: &str = "gv3.statistics";
    /// Group added by recovery: what was lost.
    pub const RECOVERY: &str = "gv3.recovery";
    /// In every group: CRC-32 of its name and pairs; set and checked by this crate.
    pub const CHECKSUM: &str = "checksum";
    /// In [`SESSION`]: version of SESSION.md.
    pub const FORMAT_VERSION: &str = "format_version";
    /// In [`SESSION`]: start, nanoseconds since 1970-01-01 UTC.
    pub const CREATED_UNIX_NANOS: &str = "created_unix_nanos";
    /// In [`SESSION`]: coding mode.
    pub const MODE: &str = "mode";
    /// In [`SESSION`]: error that the coding was told is worth correcting, millimetres; not of every mode.
    pub const TOLERANCE_MM: &str = "tolerance_mm";
    /// In [`SESSION`]: program and version that wrote the file.
    pub const PRODUCER: &str = "producer";
    /// In [`CALIBRATION`] and [`CONFIGURATION`]: a TOML document.
    pub const TOML: &str = "toml";
    /// In [`STATISTICS`]: scans coded.
    pub const SCANS: &str = "scans";
    /// In [`STATISTICS`]: keyframes coded.
    pub const KEYFRAMES: &str = "keyframes";
    /// In [`STATISTICS`]: mean coding time of a scan, milliseconds.
    pub const ENCODE_MS_PER_SCAN: &str = "encode_ms_per_scan";
    /// In [`STATISTICS`]: size of the input as OBJ and BMP files, bytes.
    pub const RAW_OBJ_BMP_BYTES: &str = "raw_obj_bmp_bytes";
    /// In [`STATISTICS`]: size of the input as float32 vertices, u32 triangles and 8-bit texture, bytes.
    pub const RAW_BINARY_BYTES: &str = "raw_binary_bytes";
    /// In [`STATISTICS`]: size of the input as 8-bit fringe pictures, bytes.
    pub const RAW_FRINGE_BYTES: &str = "raw_fringe_bytes";
}

/// Pairs of one metadata record, in the order of their keys.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MetadataGroup(BTreeMap<String, String>);

impl MetadataGroup {
    /// An empty group.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets one pair; numbers are written so that they parse back to the same value.
    pub fn set(&mut self, key: &str, value: impl Display) {
        self.0.insert(key.to_owned(), value.to_string());
    }

    /// [`set`](Self::set) in a chain.
    #[must_use]
    pub fn with(mut self, key: &str, value: impl Display) -> Self {
        self.set(key, value);
        self
    }

    /// Value of a key.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key).map(String::as_str)
    }

    /// Value of a key as a number; `None` if it is missing or does not parse.
    #[must_use]
    pub fn number<T: FromStr>(&self, key: &str) -> Option<T> {
        self.get(key)?.parse().ok()
    }

    /// Pairs in the order of their keys.
    pub fn iter(&self) -> Iter<'_, String, String> {
        self.0.iter()
    }

    /// CRC-32 over name and pairs, each text as a `u32` length and its bytes.
    fn checksum(&self, name: &str) -> String {
        let mut hasher = crc32fast::Hasher::new();
        let pairs = self.0.iter().filter(|(key, _)| *key != key::CHECKSUM);
        for text in std::iter::once(name).chain(pairs.flat_map(|(key, value)| [key.as_str(), value.as_str()])) {
            hasher.update(&(text.len() as u32).to_le_bytes());
            hasher.update(text.as_bytes());
        }
        format!("{:08x}", hasher.finalize())
    }

    /// The MCAP record of this group, with its checksum.
    ///
    /// # Errors
    /// The reserved key is used, or the record would be longer than [`METADATA_LIMIT`].
    pub(crate) fn to_record(&self, name: &str) -> Result<mcap::records::Metadata> {
        if self.0.contains_key(key::CHECKSUM) {
            return Err(SessionError::Usage(format!("metadata {name}: the key `checksum` is reserved")));
        }
        let bytes: u64 = self.0.iter().map(|(key, value)| (8 + key.len() + value.len()) as u64).sum();
        if bytes + name.len() as u64 + 64 > METADATA_LIMIT {
            return Err(SessionError::Usage(format!("metadata {name}: {bytes} bytes, the limit is {METADATA_LIMIT}")));
        }
        let mut metadata = self.0.clone();
        metadata.insert(key::CHECKSUM.to_owned(), self.checksum(name));
        Ok(mcap::records::Metadata { name: name.to_owned(), metadata })
    }

    /// Name and pairs of a metadata record's body at `offset` in the file, the checksum checked and taken out.
    /// `Ok(None)` is a record of another program: not named `gv3.`, without a checksum.
    pub(crate) fn parse(body: &[u8], offset: u64) -> std::result::Result<Option<(String, Self)>, Fault> {
        let broken = || Fault::damaged(offset, "metadata record does not parse");
        let mut fields = Bytes(body);
        let name = fields.text().ok_or_else(broken)?;
        let mut pairs = Bytes(fields.counted().ok_or_else(broken)?);
        let mut group = MetadataGroup::new();
        while !pairs.0.is_empty() {
            let key = pairs.text().ok_or_else(broken)?;
            let value = pairs.text().ok_or_else(broken)?;
            if group.0.insert(key.to_owned(), value.to_owned()).is_some() {
                return Err(Fault::damaged(offset, format!("metadata {name}: key {key} twice")));
            }
        }
        match group.0.remove(key::CHECKSUM) {
            Some(found) if found == group.checksum(name) => Ok(Some((name.to_owned(), group))),
            None if !name.starts_with("gv3.") => Ok(None),
            _ => Err(Fault::damaged(offset, format!("metadata {name}: checksum missing or wrong"))),
        }
    }
}

/// All metadata of a session, by group name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SessionMetadata {
    groups: BTreeMap<String, MetadataGroup>,
}

impl SessionMetadata {
    /// Metadata of a new session: `mode` is the coding mode, `producer` the writing program and its version,
    /// `created_unix_nanos` the start in nanoseconds since 1970-01-01 UTC.
    #[must_use]
    pub fn new(mode: &str, producer: &str, created_unix_nanos: u64) -> Self {
        let session = MetadataGroup::new()
            .with(key::FORMAT_VERSION, FORMAT_VERSION)
            .with(key::CREATED_UNIX_NANOS, created_unix_nanos)
            .with(key::MODE, mode)
            .with(key::PRODUCER, producer);
        SessionMetadata { groups: BTreeMap::from([(key::SESSION.to_owned(), session)]) }
    }

    /// Adds the error that the coding was told is worth correcting, millimetres.
    #[must_use]
    pub fn with_tolerance_mm(mut self, tolerance_mm: f64) -> Self {
        self.groups.entry(key::SESSION.to_owned()).or_default().set(key::TOLERANCE_MM, tolerance_mm);
        self
    }

    /// Adds the rig's calibration, a TOML document.
    #[must_use]
    pub fn with_calibration(mut self, toml: &str) -> Self {
        self.set_group(key::CALIBRATION, MetadataGroup::new().with(key::TOML, toml));
        self
    }

    /// Adds the configuration, a TOML document.
    #[must_use]
    pub fn with_configuration(mut self, toml: &str) -> Self {
        self.set_group(key::CONFIGURATION, MetadataGroup::new().with(key::TOML, toml));
        self
    }

    /// Sets a whole group; names of other programs should not start with `gv3.`.
    pub fn set_group(&mut self, name: &str, group: MetadataGroup) {
        self.groups.insert(name.to_owned(), group);
    }

    /// A group by name.
    #[must_use]
    pub fn group(&self, name: &str) -> Option<&MetadataGroup> {
        self.groups.get(name)
    }

    /// Groups in the order of their names.
    pub fn iter(&self) -> Iter<'_, String, MetadataGroup> {
        self.groups.iter()
    }

    /// One value, by group and key.
    #[must_use]
    pub fn get(&self, group: &str, key: &str) -> Option<&str> {
        self.group(group)?.get(key)
    }

    /// The calibration's TOML document.
    #[must_use]
    pub fn calibration(&self) -> Option<&str> {
        self.get(key::CALIBRATION, key::TOML)
    }

    /// The configuration's TOML document.
    #[must_use]
    pub fn configuration(&self) -> Option<&str> {
        self.get(key::CONFIGURATION, key::TOML)
    }

    /// Counts and sizes written at the end; `None` in an unfinished session.
    #[must_use]
    pub fn statistics(&self) -> Option<&MetadataGroup> {
        self.group(key::STATISTICS)
    }

    /// Version of SESSION.md the file follows; `None` without a `gv3.session` group.
    #[must_use]
    pub fn format_version(&self) -> Option<u32> {
        self.group(key::SESSION)?.number(key::FORMAT_VERSION)
    }

    /// Adds a group read at `offset` and refuses a session of a newer version as soon as it is known.
    pub(crate) fn read_group(
        &mut self,
        name: String,
        group: MetadataGroup,
        offset: u64,
    ) -> std::result::Result<(), Fault> {
        if name == key::SESSION {
            match group.number::<u32>(key::FORMAT_VERSION) {
                Some(1..=FORMAT_VERSION) => {}
                Some(found) if found > FORMAT_VERSION => {
                    return Err(Fault::Newer { found, supported: FORMAT_VERSION });
                }
                _ => return Err(Fault::damaged(offset, "gv3.session: format_version is not a version")),
            }
        }
        if self.groups.contains_key(&name) {
            return Err(Fault::damaged(offset, format!("metadata {name} twice")));
        }
        self.groups.insert(name, group);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn body(record: &mcap::records::Metadata) -> Vec<u8> {
        let text = |out: &mut Vec<u8>, text: &str| {
            out.extend_from_slice(&(text.len() as u32).to_le_bytes());
            out.extend_from_slice(text.as_bytes());
        };
        let (mut out, mut pairs) = (Vec::new(), Vec::new());
        for (key, value) in &record.metadata {
            text(&mut pairs, key);
            text(&mut pairs, value);
        }
        text(&mut out, &record.name);
        out.extend_from_slice(&(pairs.len() as u32).to_le_bytes());
        out.extend_from_slice(&pairs);
        out
    }

    #[test]
    fn numbers_survive() {
        let group = MetadataGroup::new().with("a", 0.1 + 0.2).with("b", u64::MAX);
        assert_eq!(group.number("a"), Some(0.1 + 0.2));
        assert_eq!(group.number("b"), Some(u64::MAX));
        assert_eq!(group.number::<u64>("a"), None);
    }

    #[test]
    fn every_bit_flip_is_found() {
        let group = MetadataGroup::new().with("toml", "x = 1").with("note", "ü");
        let bytes = body(&group.to_record("gv3.calibration").unwrap());
        assert_eq!(MetadataGroup::parse(&bytes, 0).unwrap(), Some(("gv3.calibration".to_owned(), group)));
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(MetadataGroup::parse(&flipped, 0).is_err(), "bit {bit}");
        }
        for end in 0..bytes.len() {
            assert!(MetadataGroup::parse(&bytes[..end], 0).is_err(), "prefix of {end} bytes");
        }
    }

    #[test]
    fn the_checksum_key_is_reserved() {
        assert!(MetadataGroup::new().with("checksum", 1).to_record("mine").is_err());
    }

    #[test]
    fn records_of_other_programs_are_passed_over() {
        let record = mcap::records::Metadata { name: "camera".into(), metadata: BTreeMap::new() };
        assert_eq!(MetadataGroup::parse(&body(&record), 0).unwrap(), None);
    }
}
