//! Envelope of every binary payload: what it is, its ticks, and a checksum of our own beside MCAP's (SESSION.md,
//! "Envelope").
//!
//! The head has a checksum of its own, so an index can be built from heads alone without trusting a flipped tick.

use super::bytes::Bytes;

/// Bytes in front of every payload.
pub const HEAD_BYTES: usize = 32;
/// Newest envelope this build opens, and the one it seals.
pub const VERSION: u8 = 1;
/// Longest payload, bytes.
pub const PAYLOAD_LIMIT: usize = super::CHUNK_LIMIT as usize;

/// What a payload is; the discriminant is the first byte of the envelope.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// Stream header of the codec, opening a run.
    Stream = b'S',
    /// Geometry of a group.
    Group = b'G',
    /// Texture of a group's keyframe.
    Texture = b'T',
}

/// The first [`HEAD_BYTES`] bytes of an envelope.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Head {
    /// What the payload is.
    pub kind: Kind,
    /// Length of the payload, bytes, 1 to [`PAYLOAD_LIMIT`].
    pub payload_bytes: u32,
    /// Tick of the first scan the payload holds.
    pub first_tick: u64,
    /// Tick of the keyframe; equal to `first_tick` for streams and textures.
    pub key_tick: u64,
    /// CRC-32 (ISO-HDLC) of the payload.
    pub payload_crc: u32,
}

/// Why an envelope does not open.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EnvelopeError {
    /// The bytes break the layout or a checksum.
    #[error("envelope, byte {offset}: {reason}")]
    Invalid {
        /// Offset from the start of the envelope.
        offset: usize,
        /// What was found and what was expected.
        reason: String,
    },
    /// Sealed by a newer version.
    #[error("envelope version {found} is newer than {supported}, which this program reads; update gv3")]
    NewerVersion {
        /// Version in the envelope.
        found: u8,
        /// Newest version this build opens.
        supported: u8,
    },
}

fn invalid(offset: usize, reason: impl Into<String>) -> EnvelopeError {
    EnvelopeError::Invalid { offset, reason: reason.into() }
}

/// Puts a payload into an envelope: head, then the payload as it is.
///
/// # Errors
/// An empty or too long payload, or ticks out of order for the kind.
pub fn seal(kind: Kind, first_tick: u64, key_tick: u64, payload: &[u8]) -> Result<Vec<u8>, EnvelopeError> {
    let payload_bytes = u32::try_from(payload.len()).unwrap_or(u32::MAX);
    let head = Head { kind, payload_bytes, first_tick, key_tick, payload_crc: crc32fast::hash(payload) };
    check_fields(&head)?;
    let mut bytes = Vec::with_capacity(HEAD_BYTES + payload.len());
    bytes.extend_from_slice(&[kind as u8, VERSION, 0, 0]);
    bytes.extend_from_slice(&payload_bytes.to_le_bytes());
    bytes.extend_from_slice(&first_tick.to_le_bytes());
    bytes.extend_from_slice(&key_tick.to_le_bytes());
    bytes.extend_from_slice(&head.payload_crc.to_le_bytes());
    let head_crc = crc32fast::hash(&bytes);
    bytes.extend_from_slice(&head_crc.to_le_bytes());
    bytes.extend_from_slice(payload);
    Ok(bytes)
}

/// Opens an envelope that fills `bytes` exactly.
///
/// # Errors
/// Anything in SESSION.md's "an envelope is invalid if" list, or a newer version.
pub fn open(bytes: &[u8]) -> Result<(Head, &[u8]), EnvelopeError> {
    let head = open_head(bytes)?;
    let payload = &bytes[HEAD_BYTES..];
    if payload.len() as u64 != u64::from(head.payload_bytes) {
        return Err(invalid(4, format!("{} payload bytes claimed, {} present", head.payload_bytes, payload.len())));
    }
    let found = crc32fast::hash(payload);
    if found != head.payload_crc {
        return Err(invalid(24, format!("payload checksum {found:08x}, {:08x} expected", head.payload_crc)));
    }
    Ok((head, payload))
}

/// Opens the head alone; the payload may be missing.
///
/// # Errors
/// As [`open`], except what concerns the payload's bytes.
pub fn open_head(bytes: &[u8]) -> Result<Head, EnvelopeError> {
    let short = || invalid(0, format!("{} bytes, an envelope has at least {HEAD_BYTES}", bytes.len()));
    let bytes = bytes.get(..HEAD_BYTES).ok_or_else(short)?;
    let mut fields = Bytes(bytes);
    let kind = match fields.u8().ok_or_else(short)? {
        b'S' => Kind::Stream,
        b'G' => Kind::Group,
        b'T' => Kind::Texture,
        other => return Err(invalid(0, format!("kind 0x{other:02x} is not one of S, G, T"))),
    };
    match fields.u8().ok_or_else(short)? {
        0 => return Err(invalid(1, "version 0 does not exist")),
        VERSION => {}
        found => return Err(EnvelopeError::NewerVersion { found, supported: VERSION }),
    }
    let found = crc32fast::hash(&bytes[..HEAD_BYTES - 4]);
    let reserved = fields.u16().ok_or_else(short)?;
    let head = Head {
        kind,
        payload_bytes: fields.u32().ok_or_else(short)?,
        first_tick: fields.u64().ok_or_else(short)?,
        key_tick: fields.u64().ok_or_else(short)?,
        payload_crc: fields.u32().ok_or_else(short)?,
    };
    let expected = fields.u32().ok_or_else(short)?;
    if found != expected {
        return Err(invalid(28, format!("head checksum {found:08x}, {expected:08x} expected")));
    }
    if reserved != 0 {
        return Err(invalid(2, "reserved bytes are not zero"));
    }
    check_fields(&head)?;
    Ok(head)
}

fn check_fields(head: &Head) -> Result<(), EnvelopeError> {
    if head.payload_bytes == 0 || head.payload_bytes as usize > PAYLOAD_LIMIT {
        return Err(invalid(4, format!("payload of {} bytes, 1 to {PAYLOAD_LIMIT} are allowed", head.payload_bytes)));
    }
    let ordered = match head.kind {
        Kind::Group => head.first_tick <= head.key_tick,
        Kind::Stream | Kind::Texture => head.first_tick == head.key_tick,
    };
    if !ordered {
        return Err(invalid(8, format!("ticks {} to {} do not fit the kind", head.first_tick, head.key_tick)));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The worked example of SESSION.md.
    const GOLDEN: &str = "4701000005000000 0b00000000000000 1400000000000000 86a61036 c5217ac2 68656c6c6f";

    fn hex(bytes: &[u8]) -> String {
        bytes.iter().map(|b| format!("{b:02x}")).collect()
    }

    #[test]
    fn golden_bytes() {
        let sealed = seal(Kind::Group, 11, 20, b"hello").unwrap();
        assert_eq!(hex(&sealed), GOLDEN.replace(' ', ""));
        let (head, payload) = open(&sealed).unwrap();
        assert_eq!((head.kind, head.first_tick, head.key_tick), (Kind::Group, 11, 20));
        assert_eq!(payload, b"hello");
    }

    #[test]
    fn every_prefix_and_one_extra_byte_fail() {
        let mut sealed = seal(Kind::Texture, 7, 7, &[1, 2, 3]).unwrap();
        for end in 0..sealed.len() {
            assert!(matches!(open(&sealed[..end]), Err(EnvelopeError::Invalid { .. })), "prefix of {end} bytes");
        }
        sealed.push(0);
        assert!(open(&sealed).is_err());
    }

    #[test]
    fn every_bit_flip_fails() {
        let sealed = seal(Kind::Stream, 3, 3, b"header").unwrap();
        for bit in 0..sealed.len() * 8 {
            let mut flipped = sealed.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(open(&flipped).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn fields_out_of_range_fail_even_with_a_right_checksum() {
        let rewrite = |at: usize, value: &[u8]| {
            let mut bytes = seal(Kind::Group, 1, 2, b"x").unwrap();
            bytes[at..at + value.len()].copy_from_slice(value);
            let crc = crc32fast::hash(&bytes[..HEAD_BYTES - 4]);
            bytes[HEAD_BYTES - 4..HEAD_BYTES].copy_from_slice(&crc.to_le_bytes());
            open(&bytes).unwrap_err()
        };
        let offset_of = |error| match error {
            EnvelopeError::Invalid { offset, .. } => offset,
            EnvelopeError::NewerVersion { .. } => usize::MAX,
        };
        assert_eq!(offset_of(rewrite(0, b"X")), 0);
        assert_eq!(offset_of(rewrite(1, &[0])), 1);
        assert_eq!(rewrite(1, &[2]), EnvelopeError::NewerVersion { found: 2, supported: 1 });
        assert_eq!(offset_of(rewrite(2, &[1])), 2);
        assert_eq!(offset_of(rewrite(4, &0_u32.to_le_bytes())), 4);
        assert_eq!(offset_of(rewrite(4, &u32::MAX.to_le_bytes())), 4);
        assert_eq!(offset_of(rewrite(8, &3_u64.to_le_bytes())), 8);
        assert_eq!(offset_of(rewrite(0, b"T")), 8);
    }

    #[test]
    fn refuses_to_seal_what_it_would_not_open() {
        assert!(seal(Kind::Group, 1, 1, b"").is_err());
        assert!(seal(Kind::Group, 2, 1, b"x").is_err());
        assert!(seal(Kind::Texture, 1, 2, b"x").is_err());
    }
}
