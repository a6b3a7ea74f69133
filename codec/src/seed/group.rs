//! Group payload: the scans between two keyframes and the keyframe that closes them.

use super::surface;
use crate::bits::attributes::{put_section, take_section};
use crate::bits::bytes::{ByteReader, put_varint};
use crate::mesh::TriMesh;
use crate::param::locate::Place;
use crate::stamps::{MAX_TICK, Stamp, check_stamps, put_stamps, take_stamps};
use crate::{CodecError, Result, StreamHeader};

/// Most landmarks a keyframe carries.
pub const MAX_LANDMARKS: u64 = 1024;

/// Longest landmarks section: a count, and two places of a four-byte triangle and two weights a pair.
const MAX_LANDMARK_BYTES: usize = 2 + 12 * MAX_LANDMARKS as usize;

/// The same point of the surface on the keyframe before and on this one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkPair {
    /// Place on the keyframe before.
    pub before: Place,
    /// Place on this keyframe.
    pub here: Place,
}

/// A decoded group.
#[derive(Debug, Clone)]
pub struct Group {
    /// Scans of the group in time order; the last is the keyframe.
    pub stamps: Vec<Stamp>,
    /// Tick of the keyframe that the landmarks refer to; none in the first group of a run.
    pub before_tick: Option<u64>,
    /// Surface of the keyframe.
    pub mesh: TriMesh,
    /// Landmarks shared with the keyframe before.
    pub landmarks: Vec<LandmarkPair>,
}

impl Group {
    /// Stamp of the keyframe.
    pub fn key(&self) -> Stamp {
        self.stamps[self.stamps.len() - 1]
    }
}

/// Writes a group around a coded surface; `before_tick` is the keyframe that `landmarks` refer to.
///
/// # Errors
/// [`CodecError::Stream`] when stamps are missing, too many, out of range, or do not increase; when there are too many
/// landmarks, or landmarks without a keyframe before.
pub fn encode(
    header: &StreamHeader,
    stamps: &[Stamp],
    surface: &[u8],
    (before_tick, landmarks): (Option<u64>, &[LandmarkPair]),
) -> Result<Vec<u8>> {
    check_stamps(stamps)?;
    if before_tick.is_some_and(|t| t >= stamps[0].tick) || (before_tick.is_none() && !landmarks.is_empty()) {
        return Err(CodecError::Stream("landmarks need a keyframe before the group".into()));
    }
    if landmarks.len() as u64 > MAX_LANDMARKS {
        return Err(CodecError::Stream(format!("{} landmarks; {MAX_LANDMARKS} can be coded", landmarks.len())));
    }
    let mut out = Vec::new();
    put_stamps(&mut out, stamps, header.scan_period_nanos)?;
    put_varint(&mut out, before_tick.map_or(0, |t| t + 1));
    out.extend_from_slice(surface);
    let mut pairs = Vec::new();
    put_varint(&mut pairs, landmarks.len() as u64);
    for pair in landmarks {
        put_place(&mut pairs, pair.before);
        put_place(&mut pairs, pair.here);
    }
    put_section(&mut out, &pairs)?;
    Ok(out)
}

/// Reads a group.
///
/// # Errors
/// [`CodecError::Payload`] at the first byte that does not follow FORMAT.md, "Group".
pub fn decode(header: &StreamHeader, bytes: &[u8]) -> Result<Group> {
    let mut reader = ByteReader::new(bytes, "group");
    let stamps = take_stamps(&mut reader, header.scan_period_nanos)?;
    let before_tick = reader.varint_up_to(MAX_TICK + 1, "tick of the keyframe before")?.checked_sub(1);
    if before_tick.is_some_and(|t| t >= stamps[0].tick) {
        return Err(reader.error("the keyframe before does not lie before"));
    }
    let mesh = surface::decode(&mut reader, header.position_step_mm()?)?;
    let pairs = take_section(&mut reader, MAX_LANDMARK_BYTES, "landmarks")?;
    reader.finish()?;
    let landmarks = decode_landmarks(&pairs, mesh.triangles.len() as u64, before_tick)?;
    Ok(Group { stamps, before_tick, mesh, landmarks })
}

fn decode_landmarks(bytes: &[u8], triangles: u64, before_tick: Option<u64>) -> Result<Vec<LandmarkPair>> {
    let mut reader = ByteReader::new(bytes, "landmarks");
    let count = reader.varint_up_to(MAX_LANDMARKS, "landmark count")?;
    if count > 0 && before_tick.is_none() {
        return Err(reader.error("landmarks without a keyframe before"));
    }
    let mut pairs = Vec::new();
    for _ in 0..count {
        let before = take_place(&mut reader, 2 * surface::MAX_VERTICES)?;
        pairs.push(LandmarkPair { before, here: take_place(&mut reader, triangles)? });
    }
    reader.finish()?;
    Ok(pairs)
}

/// Triangle, then the weights of its first two corners in 255ths.
fn put_place(out: &mut Vec<u8>, place: Place) {
    put_varint(out, place.triangle.into());
    let first = (place.barycentric[0].clamp(0.0, 1.0) * 255.0).round() as u8;
    let second = (place.barycentric[1].clamp(0.0, 1.0) * 255.0).round() as u8;
    out.extend([first, second.min(255 - first)]);
}

fn take_place(reader: &mut ByteReader<'_>, triangles: u64) -> Result<Place> {
    let triangle = reader.varint_up_to(triangles.saturating_sub(1), "triangle")? as u32;
    let (first, second) = (reader.u8()?, reader.u8()?);
    if u16::from(first) + u16::from(second) > 255 {
        return Err(reader.error("weights of a place add up to more than one"));
    }
    let barycentric = [first, second, 255 - first - second].map(|w| f32::from(w) / 255.0);
    Ok(Place { triangle, barycentric })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Mode;
    use crate::bits::connectivity::tests::random_disk;

    const HEADER: StreamHeader = StreamHeader {
        mode: Mode::Seed { position_step_mm: 0.05 },
        keyframe_interval: 10,
        scan_period_nanos: 33_333_333,
    };

    fn example() -> Vec<u8> {
        let mesh = random_disk(&(0..30).map(|i: u16| i.wrapping_mul(7919)).collect::<Vec<u16>>());
        let surface = surface::encode(&mesh, 0.05, None).unwrap();
        let place = |t| Place { triangle: t, barycentric: [0.2, 0.4, 0.4] };
        let pairs = [LandmarkPair { before: place(70_000), here: place(3) }];
        let stamps = [Stamp { tick: 3, time_nanos: 100_000_123 }, Stamp { tick: 10, time_nanos: 333_333_333 }];
        encode(&HEADER, &stamps, &surface.bytes, (Some(2), &pairs)).unwrap()
    }

    #[test]
    fn round_trip() {
        let group = decode(&HEADER, &example()).unwrap();
        assert_eq!(group.stamps[0], Stamp { tick: 3, time_nanos: 100_000_123 });
        assert_eq!(group.key(), Stamp { tick: 10, time_nanos: 333_333_333 });
        assert_eq!(group.before_tick, Some(2));
        assert_eq!(group.landmarks[0].before.triangle, 70_000);
        assert!((group.landmarks[0].here.barycentric[1] - 0.4).abs() < 1e-6);
    }

    #[test]
    fn every_prefix_fails_and_one_more_byte_fails_and_no_flip_panics() {
        let bytes = example();
        for n in 0..bytes.len() {
            assert!(decode(&HEADER, &bytes[..n]).is_err(), "{n}");
        }
        assert!(decode(&HEADER, &[&bytes[..], &[0]].concat()).is_err());
        for i in 0..bytes.len() * 8 {
            let mut bad = bytes.clone();
            bad[i / 8] ^= 1 << (i % 8);
            let _ = decode(&HEADER, &bad);
        }
    }

    #[test]
    fn ticks_must_increase() {
        let s = Stamp { tick: 1, time_nanos: 0 };
        assert!(encode(&HEADER, &[s, s], &[], (None, &[])).is_err());
        assert!(encode(&HEADER, &[s, Stamp { tick: 2, time_nanos: 0 }], &[], (None, &[])).is_err());
        assert!(encode(&HEADER, &[s, Stamp { tick: 2, time_nanos: 1 }], &[], (None, &[])).is_ok());
        assert!(encode(&HEADER, &[], &[], (None, &[])).is_err());
    }

    #[test]
    fn what_cannot_be_read_is_not_written() {
        let place = Place { triangle: 0, barycentric: [1.0, 0.0, 0.0] };
        let pair = LandmarkPair { before: place, here: place };
        let s = [Stamp { tick: 5, time_nanos: 0 }];
        assert!(encode(&HEADER, &s, &[], (Some(4), &[pair])).is_ok());
        assert!(encode(&HEADER, &s, &[], (Some(5), &[pair])).is_err());
        assert!(encode(&HEADER, &s, &[], (None, &[pair])).is_err());
        let many = vec![pair; MAX_LANDMARKS as usize + 1];
        assert!(encode(&HEADER, &s, &[], (Some(4), &many)).is_err());
        let slow = StreamHeader { scan_period_nanos: 1_000_000_000_000, ..HEADER };
        let far = [Stamp { tick: MAX_TICK, time_nanos: 0 }];
        assert!(encode(&slow, &far, &[], (None, &[])).unwrap_err().to_string().contains("centuries"));
    }
}
