//! Little-endian integers, LEB128 variable-length integers and zigzag, with offsets in every error.

use crate::{CodecError, Result};

/// Zigzag: small magnitudes of either sign become small unsigned integers.
pub fn zigzag(v: i32) -> u32 {
    ((v << 1) ^ (v >> 31)) as u32
}

/// Inverse of [`zigzag`].
pub fn unzigzag(v: u32) -> i32 {
    ((v >> 1) as i32) ^ -((v & 1) as i32)
}

/// Zigzag of 64-bit integers.
pub fn zigzag64(v: i64) -> u64 {
    ((v << 1) ^ (v >> 63)) as u64
}

/// Inverse of [`zigzag64`].
pub fn unzigzag64(v: u64) -> i64 {
    ((v >> 1) as i64) ^ -((v & 1) as i64)
}

/// Appends an unsigned integer in LEB128.
pub fn put_varint(out: &mut Vec<u8>, mut v: u64) {
    while v >= 0x80 {
        out.push(v as u8 | 0x80);
        v >>= 7;
    }
    out.push(v as u8);
}

/// Reads a section of a payload; errors name the section and the offset in it.
#[derive(Debug, Clone)]
pub struct ByteReader<'a> {
    bytes: &'a [u8],
    at: usize,
    section: &'static str,
}

impl<'a> ByteReader<'a> {
    /// A reader over a whole section.
    pub fn new(bytes: &'a [u8], section: &'static str) -> Self {
        Self { bytes, at: 0, section }
    }

    /// An error at the present offset.
    pub fn error(&self, reason: impl Into<String>) -> CodecError {
        CodecError::Payload { section: self.section, offset: self.at, reason: reason.into() }
    }

    /// An error at another offset.
    pub fn error_at(&self, offset: usize, reason: impl Into<String>) -> CodecError {
        CodecError::Payload { section: self.section, offset, reason: reason.into() }
    }

    /// Bytes not read yet.
    pub fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// The next `n` bytes.
    ///
    /// # Errors
    /// When fewer are left.
    pub fn take(&mut self, n: usize) -> Result<&'a [u8]> {
        if n > self.remaining() {
            return Err(self.error(format!("{n} bytes wanted, {} left", self.remaining())));
        }
        let part = &self.bytes[self.at..self.at + n];
        self.at += n;
        Ok(part)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut a = [0; N];
        a.copy_from_slice(self.take(N)?);
        Ok(a)
    }

    /// One byte.
    ///
    /// # Errors
    /// At the end of the section.
    pub fn u8(&mut self) -> Result<u8> {
        Ok(self.array::<1>()?[0])
    }

    /// Little-endian 16-bit integer.
    ///
    /// # Errors
    /// At the end of the section.
    pub fn u16(&mut self) -> Result<u16> {
        Ok(u16::from_le_bytes(self.array()?))
    }

    /// Little-endian 32-bit integer.
    ///
    /// # Errors
    /// At the end of the section.
    pub fn u32(&mut self) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    /// Little-endian 64-bit integer.
    ///
    /// # Errors
    /// At the end of the section.
    pub fn u64(&mut self) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    /// Finite little-endian IEEE 754 single.
    ///
    /// # Errors
    /// At the end of the section, or for infinities and NaN.
    pub fn f32(&mut self) -> Result<f32> {
        let v = f32::from_le_bytes(self.array()?);
        if v.is_finite() { Ok(v) } else { Err(self.error("a number that is not finite")) }
    }

    /// LEB128 integer of at most 64 bits, in its shortest form.
    ///
    /// # Errors
    /// At the end of the section, for more than ten bytes or 64 bits, or when a shorter form exists.
    pub fn varint(&mut self) -> Result<u64> {
        let mut value = 0u64;
        for shift in (0..70).step_by(7) {
            let byte = self.u8()?;
            let part = u64::from(byte & 0x7f);
            if shift == 63 && part > 1 {
                break;
            }
            value |= part << shift;
            if byte == 0 && shift > 0 {
                return Err(self.error("a variable-length integer longer than it need be"));
            }
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(self.error("a variable-length integer of more than 64 bits"))
    }

    /// LEB128 integer that must not exceed `most`.
    ///
    /// # Errors
    /// As [`Self::varint`], or when it is larger; `name` says which field.
    pub fn varint_up_to(&mut self, most: u64, name: &str) -> Result<u64> {
        let at = self.clone();
        let v = self.varint()?;
        if v > most { Err(at.error(format!("{name} is {v}, at most {most} is allowed"))) } else { Ok(v) }
    }

    /// Checks that nothing is left.
    ///
    /// # Errors
    /// When bytes remain.
    pub fn finish(self) -> Result<()> {
        if self.remaining() == 0 { Ok(()) } else { Err(self.error(format!("{} bytes too many", self.remaining()))) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn varints_round_trip(v: u64) {
            let mut out = Vec::new();
            put_varint(&mut out, v);
            let mut r = ByteReader::new(&out, "test");
            prop_assert_eq!(r.varint().unwrap(), v);
            r.finish().unwrap();
            prop_assert!(ByteReader::new(&out[..out.len() - 1], "test").varint().is_err());
        }

        #[test]
        fn zigzags_round_trip(v: i32, w: i64) {
            prop_assert_eq!(unzigzag(zigzag(v)), v);
            prop_assert_eq!(unzigzag64(zigzag64(w)), w);
        }
    }

    #[test]
    fn an_integer_has_one_form() {
        for (bytes, value) in [(&[0x00][..], 0), (&[0x7f], 127), (&[0x80, 0x01], 128), (&[0xac, 0x02], 300)] {
            assert_eq!(ByteReader::new(bytes, "x").varint().unwrap(), value);
        }
        for bytes in [&[0x80, 0x00][..], &[0xff, 0x80, 0x00]] {
            assert!(ByteReader::new(bytes, "x").varint().unwrap_err().to_string().contains("longer than it need be"));
        }
        let mut most = vec![0xff; 9];
        most.push(1);
        assert_eq!(ByteReader::new(&most, "x").varint().unwrap(), u64::MAX);
        most[9] = 2;
        assert!(ByteReader::new(&most, "x").varint().unwrap_err().to_string().contains("64 bits"));
    }

    #[test]
    fn errors_name_section_and_offset() {
        let mut r = ByteReader::new(&[1, 2, 3], "group");
        r.u16().unwrap();
        let text = r.u32().unwrap_err().to_string();
        assert!(text.contains("group, byte 2"), "{text}");
        assert!(ByteReader::new(&[0xff; 11], "x").varint().is_err());
        assert!(ByteReader::new(&[5], "x").varint_up_to(4, "count").unwrap_err().to_string().contains("count is 5"));
    }
}
