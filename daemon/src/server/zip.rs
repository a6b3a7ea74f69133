//! A ZIP archive written from front to back, its entries stored as they are (APPNOTE.TXT 6.3.10, with ZIP64 fields
//! where sizes need them).
//!
//! Entries are pictures and meshes that a job has in memory one at a time; compressing them would take the processor
//! away from the scanner.

use std::io::{self, Write};

const LOCAL: u32 = 0x0403_4b50;
const CENTRAL: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
const END64: u32 = 0x0606_4b50;
const LOCATOR64: u32 = 0x0706_4b50;
const VERSION: u16 = 45;
/// 1980-01-01, the first day the format has: the same content is the same archive.
const DATE: u16 = 0x21;
/// Names are UTF-8.
const FLAGS: u16 = 1 << 11;

/// An archive being written.
pub struct ZipWriter<W> {
    out: W,
    at: u64,
    entries: Vec<Entry>,
}

struct Entry {
    name: String,
    crc: u32,
    bytes: u32,
    offset: u64,
}

impl<W: Write> ZipWriter<W> {
    /// An archive that begins here.
    pub fn new(out: W) -> Self {
        Self { out, at: 0, entries: Vec::new() }
    }

    /// Adds a file of less than 4 GiB.
    ///
    /// # Errors
    /// What the writer says; `InvalidInput` for a file or a name that is too long.
    pub fn add(&mut self, name: &str, content: &[u8]) -> io::Result<()> {
        let bytes = u32::try_from(content.len()).ok().filter(|&b| b < u32::MAX && name.len() < 1 << 15);
        let bytes = bytes.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "too long for an archive"))?;
        let entry = Entry { name: name.into(), crc: crc32fast::hash(content), bytes, offset: self.at };
        let mut head = Vec::with_capacity(64);
        head.extend(LOCAL.to_le_bytes());
        entry.put_common(&mut head);
        head.extend(0u16.to_le_bytes());
        head.extend(name.as_bytes());
        self.put(&head)?;
        self.put(content)?;
        self.entries.push(entry);
        Ok(())
    }

    /// Writes the directory and returns the writer and the archive's length.
    ///
    /// # Errors
    /// What the writer says.
    pub fn finish(mut self) -> io::Result<(W, u64)> {
        let start = self.at;
        let entries = std::mem::take(&mut self.entries);
        for entry in &entries {
            self.put(&entry.directory())?;
        }
        let (count, length) = (entries.len() as u64, self.at - start);
        let end64_at = self.at;
        let mut end = Vec::with_capacity(98);
        end.extend(END64.to_le_bytes());
        end.extend(44u64.to_le_bytes());
        end.extend([VERSION, VERSION].map(u16::to_le_bytes).concat());
        end.extend([0u8; 8]);
        end.extend([count, count, length, start].map(u64::to_le_bytes).concat());
        end.extend(LOCATOR64.to_le_bytes());
        end.extend(0u32.to_le_bytes());
        end.extend(end64_at.to_le_bytes());
        end.extend(1u32.to_le_bytes());
        end.extend(END.to_le_bytes());
        end.extend([0u8; 4]);
        end.extend([count.min(0xffff) as u16; 2].map(u16::to_le_bytes).concat());
        end.extend([length, start].map(|v| (v.min(0xffff_ffff) as u32).to_le_bytes()).concat());
        end.extend(0u16.to_le_bytes());
        self.put(&end)?;
        self.out.flush()?;
        Ok((self.out, self.at))
    }

    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.out.write_all(bytes)?;
        self.at += bytes.len() as u64;
        Ok(())
    }
}

impl Entry {
    /// Fields that local head and directory share: from the version to the length of the name.
    fn put_common(&self, out: &mut Vec<u8>) {
        out.extend([VERSION, FLAGS, 0, 0, DATE].map(u16::to_le_bytes).concat());
        out.extend([self.crc, self.bytes, self.bytes].map(u32::to_le_bytes).concat());
        out.extend((self.name.len() as u16).to_le_bytes());
    }

    fn directory(&self) -> Vec<u8> {
        let is_far = self.offset >= u64::from(u32::MAX);
        let mut out = Vec::with_capacity(64 + self.name.len());
        out.extend(CENTRAL.to_le_bytes());
        out.extend(VERSION.to_le_bytes());
        self.put_common(&mut out);
        out.extend((if is_far { 12u16 } else { 0 }).to_le_bytes());
        // Comment, disk and attributes: none.
        out.extend([0u8; 10]);
        out.extend((self.offset.min(u64::from(u32::MAX)) as u32).to_le_bytes());
        out.extend(self.name.as_bytes());
        if is_far {
            out.extend([1u16, 8].map(u16::to_le_bytes).concat());
            out.extend(self.offset.to_le_bytes());
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_archive_has_the_layout_that_readers_follow() {
        let mut zip = ZipWriter::new(Vec::new());
        zip.add("a.txt", b"hello").unwrap();
        zip.add("folder/b.bin", &[7; 1000]).unwrap();
        let (bytes, length) = zip.finish().unwrap();
        assert_eq!(bytes.len() as u64, length);
        let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let u16_at = |at: usize| u16::from_le_bytes(bytes[at..at + 2].try_into().unwrap());
        let end = bytes.len() - 22;
        assert_eq!((u32_at(end), u16_at(end + 10)), (END, 2));
        let mut at = u32_at(end + 16) as usize;
        for (name, content) in [("a.txt", &b"hello"[..]), ("folder/b.bin", &[7; 1000][..])] {
            assert_eq!((u32_at(at), u16_at(at + 28) as usize), (CENTRAL, name.len()));
            assert_eq!(&bytes[at + 46..at + 46 + name.len()], name.as_bytes());
            assert_eq!((u32_at(at + 16), u32_at(at + 24) as usize), (crc32fast::hash(content), content.len()));
            let local = u32_at(at + 42) as usize;
            assert_eq!((u32_at(local), u16_at(local + 26) as usize), (LOCAL, name.len()));
            let start = local + 30 + name.len();
            assert_eq!(&bytes[start..start + content.len()], content);
            at += 46 + name.len();
        }
        assert_eq!(u32_at(at), END64);
    }
}
