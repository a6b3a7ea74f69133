//! Integer attributes of vertices: predicted over the connectivity, residuals in byte planes.

use super::bytes::{ByteReader, put_varint, unzigzag, zigzag};
use super::connectivity::Parent;
use crate::{CodecError, Result};
use zstd::zstd_safe;

/// zstd level of every section: the encoder has a third of a second a keyframe, the decoder does not care.
const ZSTD_LEVEL: i32 = 19;

/// Prediction of vertex attributes from parents, all arithmetic wrapping in 32 bits.
fn predict<const N: usize>(parent: Parent, values: &[[i32; N]]) -> [i32; N] {
    let at = |v: u32| values[v as usize];
    let combine = |f: &dyn Fn(usize) -> i32| std::array::from_fn(f);
    match parent {
        Parent::None => [0; N],
        Parent::Along(a) => at(a),
        Parent::Middle(a, b) => combine(&|k| ((i64::from(at(a)[k]) + i64::from(at(b)[k])) >> 1) as i32),
        Parent::Parallelogram(a, b, c) => combine(&|k| at(a)[k].wrapping_add(at(b)[k]).wrapping_sub(at(c)[k])),
    }
}

/// Codes `N` integers a vertex, in decoding order: for each channel the byte planes of the zigzagged residuals, low
/// plane first; a leading byte says how many planes there are.
pub fn encode<const N: usize>(values: &[[i32; N]], parents: &[Parent]) -> Vec<u8> {
    let residuals: Vec<[u32; N]> = values
        .iter()
        .zip(parents)
        .map(|(v, &p)| {
            let guess = predict(p, values);
            std::array::from_fn(|k| zigzag(v[k].wrapping_sub(guess[k])))
        })
        .collect();
    let largest = residuals.iter().flatten().copied().max().unwrap_or(0);
    let planes = (4 - largest.leading_zeros() as usize / 8).max(1);
    let mut out = vec![planes as u8];
    for k in 0..N {
        for plane in 0..planes {
            out.extend(residuals.iter().map(|r| (r[k] >> (8 * plane)) as u8));
        }
    }
    out
}

/// Inverse of [`encode`].
///
/// # Errors
/// [`CodecError::Payload`] when the length does not fit `parents.len()` vertices, or fewer planes would have done.
pub fn decode<const N: usize>(bytes: &[u8], parents: &[Parent], section: &'static str) -> Result<Vec<[i32; N]>> {
    let mut reader = ByteReader::new(bytes, section);
    let planes = usize::from(reader.u8()?);
    if !(1..=4).contains(&planes) {
        return Err(reader.error(format!("{planes} byte planes, 1 to 4 are defined")));
    }
    let n = parents.len();
    let body = reader.take(n * planes * N)?;
    let top = |k: usize| &body[(k * planes + planes - 1) * n..(k * planes + planes) * n];
    if planes > 1 && (0..N).all(|k| top(k).iter().all(|&b| b == 0)) {
        return Err(reader.error(format!("{planes} byte planes where fewer hold every residual")));
    }
    reader.finish()?;
    let mut values: Vec<[i32; N]> = Vec::with_capacity(n);
    for (v, &parent) in parents.iter().enumerate() {
        let guess = predict(parent, &values);
        values.push(std::array::from_fn(|k| {
            let byte = |plane: usize| u32::from(body[(k * planes + plane) * n + v]) << (8 * plane);
            guess[k].wrapping_add(unzigzag((0..planes).map(byte).sum()))
        }));
    }
    Ok(values)
}

/// Appends a section: its length, its coded length, then zstd.
///
/// # Errors
/// [`CodecError::Stream`] when the compressor fails (out of memory).
pub fn put_section(out: &mut Vec<u8>, bytes: &[u8]) -> Result<()> {
    let coded = zstd::bulk::compress(bytes, ZSTD_LEVEL).map_err(|e| CodecError::Stream(format!("zstd: {e}")))?;
    put_varint(out, bytes.len() as u64);
    put_varint(out, coded.len() as u64);
    out.extend_from_slice(&coded);
    Ok(())
}

/// Reads a section of at most `most` bytes.
///
/// # Errors
/// [`CodecError::Payload`] when it is longer, is not exactly one zstd frame that states the announced length, or does not
/// decompress to it.
pub fn take_section(reader: &mut ByteReader<'_>, most: usize, name: &str) -> Result<Vec<u8>> {
    let length = reader.varint_up_to(most as u64, name)? as usize;
    let coded = reader.varint()?;
    let at = reader.clone();
    let coded = reader.take(usize::try_from(coded).unwrap_or(usize::MAX))?;
    let stated = zstd_safe::get_frame_content_size(coded).ok().flatten();
    if stated != Some(length as u64) {
        return Err(at.error(format!("{name}: no zstd frame of {length} bytes")));
    }
    if zstd_safe::find_frame_compressed_size(coded) != Ok(coded.len()) {
        return Err(at.error(format!("{name}: {} coded bytes are not one whole zstd frame", coded.len())));
    }
    let bytes = zstd::bulk::decompress(coded, length).map_err(|e| at.error(format!("{name}: zstd: {e}")))?;
    if bytes.len() != length {
        return Err(at.error(format!("{name} holds {} bytes, {length} announced", bytes.len())));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::super::connectivity;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn round_trip(choices in prop::collection::vec(any::<u16>(), 1..100), scale in 0u32..31, seed: u32) {
            let mesh = connectivity::tests::random_disk(&choices);
            let coded = connectivity::encode(&mesh).unwrap();
            let decoded = connectivity::decode(&coded.letters, coded.border_count, mesh.vertex_count()).unwrap();
            let values: Vec<[i32; 3]> = (0..mesh.vertex_count() as u32)
                .map(|v| std::array::from_fn(|k| (v.wrapping_mul(seed | 1).wrapping_add(k as u32) as i32) >> scale))
                .collect();
            let bytes = encode(&values, &decoded.parents);
            prop_assert_eq!(super::decode::<3>(&bytes, &decoded.parents, "t").unwrap(), values);
            prop_assert!(super::decode::<3>(&bytes[..bytes.len() - 1], &decoded.parents, "t").is_err());
            prop_assert!(super::decode::<3>(&[&bytes[..], &[0]].concat(), &decoded.parents, "t").is_err());
        }
    }

    #[test]
    fn golden_bytes_of_a_parallelogram() {
        use connectivity::Parent;
        let parents = [Parent::None, Parent::Along(0), Parent::Along(1), Parent::Parallelogram(0, 2, 1)];
        let values = [[10], [12], [9], [8]];
        // 10; +2; -3; 8 - (10 + 9 - 12) = 1: zigzag 20, 4, 5, 2 in one plane.
        assert_eq!(encode(&values, &parents), vec![1, 20, 4, 5, 2]);
    }

    #[test]
    fn the_fewest_planes_are_the_only_form() {
        use connectivity::Parent;
        let parents = [Parent::None, Parent::Along(0)];
        assert_eq!(super::decode::<1>(&[2, 20, 4, 0, 1], &parents, "t").unwrap(), [[10], [140]]);
        let error = super::decode::<1>(&[2, 20, 4, 0, 0], &parents, "t").unwrap_err().to_string();
        assert!(error.contains("fewer"), "{error}");
        assert!(super::decode::<1>(&[0], &parents, "t").is_err());
        assert!(super::decode::<1>(&[5; 11], &parents, "t").is_err());
    }

    #[test]
    fn predictions_wrap_and_middles_round_down() {
        use connectivity::Parent;
        let far = i32::MAX;
        let values = [[far], [far], [-far], [-3]];
        assert_eq!(predict(Parent::Parallelogram(0, 1, 2), &values), [far.wrapping_add(far).wrapping_add(far)]);
        assert_eq!(predict(Parent::Middle(0, 1), &values), [far]);
        assert_eq!(predict(Parent::Middle(3, 3), &values), [-3]);
        assert_eq!(predict(Parent::Middle(3, 2), &[[0], [0], [0], [-3]]), [-2]);
    }

    #[test]
    fn a_section_is_one_frame_that_states_its_length() {
        let body = zstd::bulk::compress(b"letters", 1).unwrap();
        let section = |length: usize, coded: &[u8]| {
            let mut out = vec![length as u8, coded.len() as u8];
            out.extend_from_slice(coded);
            take_section(&mut ByteReader::new(&out, "s"), 100, "x")
        };
        assert_eq!(section(7, &body).unwrap(), b"letters");
        assert!(section(8, &body).unwrap_err().to_string().contains("no zstd frame of 8 bytes"));
        assert!(section(7, b"letters").unwrap_err().to_string().contains("no zstd frame"));
        let skippable = [0x50, 0x2a, 0x4d, 0x18, 0, 0, 0, 0];
        for more in [&[0][..], &skippable, &zstd::bulk::compress(b"", 1).unwrap()] {
            let coded = [&body, more].concat();
            assert!(section(7, &coded).unwrap_err().to_string().contains("one whole"), "{more:?}");
        }
        let mut unsized_frame = zstd::Encoder::new(Vec::new(), 1).unwrap();
        std::io::Write::write_all(&mut unsized_frame, b"letters").unwrap();
        assert!(section(7, &unsized_frame.finish().unwrap()).unwrap_err().to_string().contains("no zstd frame"));
    }

    #[test]
    fn sections_are_bounded_before_they_are_unpacked() {
        let mut out = Vec::new();
        put_section(&mut out, &[7; 100_000]).unwrap();
        assert!(out.len() < 100);
        assert_eq!(take_section(&mut ByteReader::new(&out, "s"), 100_000, "x").unwrap(), vec![7; 100_000]);
        let error = take_section(&mut ByteReader::new(&out, "s"), 99_999, "x").unwrap_err().to_string();
        assert!(error.contains("at most 99999"), "{error}");
        let last = out.len() - 6;
        out[last] ^= 0x55;
        assert!(take_section(&mut ByteReader::new(&out, "s"), 100_000, "x").is_err());
    }
}
