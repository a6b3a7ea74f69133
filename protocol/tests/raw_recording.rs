//! Raw recordings: round trips, golden bytes, every prefix and every bit flip.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

#[path = "../fuzz/fuzz_targets/raw_exercise.rs"]
mod raw_exercise;

use gv3_protocol::raw::{
    FaultCode, RawError, RawItem, RawPicture, RawReader, RawStamp, RawTotals, RawWriter, SEGMENT_PICTURES, Segment,
    SegmentHeader, verify_raw,
};
use proptest::prelude::*;
use std::fs;
use std::path::{Path, PathBuf};

const CREATED: u64 = 1_700_000_000_000_000_000;
const CONFIGURATION: &str = "name = \"rig\"\n";

/// Picture `k` of a run: a slope with noise, compressible or not.
fn picture(k: u64, width_px: u32, height_px: u32) -> RawPicture {
    let mut state = k.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mut noise = |levels: u64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 40) % levels) as u32
    };
    let levels = if k % 3 == 2 { 256 } else { 4 };
    let pixels = (0..width_px * height_px).map(|i| (i % width_px * 2 + noise(levels)) as u8).collect();
    let stamp = RawStamp {
        sequence: k,
        pattern: (k % 6) as u16,
        device_time_nanos: k.wrapping_mul(5_555_556),
        host_time_nanos: k.wrapping_mul(5_555_556).wrapping_add(6_500_000),
        exposure_nanos: 5_000_000,
    };
    RawPicture { stamp, width_px, height_px, pixels }
}

fn write(writer: &mut RawWriter, p: &RawPicture) {
    writer.picture(&p.stamp, [p.width_px, p.height_px], &p.pixels).unwrap();
}

/// Three pictures, a fault between them, and the end.
fn small(folder: &Path) -> PathBuf {
    let mut writer = RawWriter::create(folder, CONFIGURATION, CREATED).unwrap();
    write(&mut writer, &picture(0, 8, 5));
    write(&mut writer, &picture(1, 64, 2));
    writer.fault(FaultCode::Timeout, 77, "no picture").unwrap();
    write(&mut writer, &picture(2, 8, 5));
    assert_eq!(writer.finish(4).unwrap(), RawTotals { pictures: 3, dropped_by_queue: 4 });
    folder.join("pictures_000000.gv3raw")
}

fn items(folder: &Path) -> Vec<RawItem> {
    let mut reader = RawReader::open(folder).unwrap();
    let mut items = Vec::new();
    while let Some((_, item)) = reader.next(true).unwrap() {
        items.push(item);
    }
    items
}

fn whole() -> Vec<RawItem> {
    vec![
        RawItem::Picture(picture(0, 8, 5)),
        RawItem::Picture(picture(1, 64, 2)),
        RawItem::Fault { code: FaultCode::Timeout, host_time_nanos: 77, message: "no picture".into() },
        RawItem::Picture(picture(2, 8, 5)),
        RawItem::End(RawTotals { pictures: 3, dropped_by_queue: 4 }),
    ]
}

#[test]
fn what_is_written_is_read() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("raw");
    small(&folder);
    assert!(RawReader::is_recording(&folder) && !RawReader::is_recording(parent.path()));
    let reader = RawReader::open(&folder).unwrap();
    assert_eq!((reader.configuration(), reader.created_unix_nanos()), (CONFIGURATION, CREATED));
    assert_eq!(items(&folder), whole());
    let report = verify_raw(&folder, true).unwrap();
    assert!(report.ok(), "{report:?}");
    assert_eq!((report.pictures, report.faults, report.missing_pictures), (3, 1, 0));
    assert!(matches!(RawWriter::create(&folder, "", 0), Err(RawError::Exists { .. })));
}

#[test]
fn segments_follow_each_other_and_a_missing_one_is_told() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("raw");
    let mut writer = RawWriter::create(&folder, CONFIGURATION, CREATED).unwrap();
    let count = 2 * u64::from(SEGMENT_PICTURES) + 1;
    (0..count).for_each(|k| write(&mut writer, &picture(k, 6, 4)));
    let bytes = writer.bytes();
    writer.finish(0).unwrap();
    let report = verify_raw(&folder, true).unwrap();
    assert!(report.ok() && report.segments == 3 && report.pictures == count, "{report:?}");
    assert_eq!(report.bytes, bytes + 72, "the end block comes on top");
    fs::remove_file(folder.join("pictures_000001.gv3raw")).unwrap();
    let report = verify_raw(&folder, true).unwrap();
    assert!(!report.ok() && report.problems[0].reason.contains("segments 1 to 1 are missing"), "{report:?}");
    assert_eq!(report.missing_pictures, u64::from(SEGMENT_PICTURES));
    // A segment of another recording in its place.
    let other = parent.path().join("other");
    let mut writer = RawWriter::create(&other, CONFIGURATION, CREATED + 1).unwrap();
    write(&mut writer, &picture(0, 6, 4));
    writer.finish(0).unwrap();
    fs::copy(other.join("pictures_000000.gv3raw"), folder.join("pictures_000001.gv3raw")).unwrap();
    let report = verify_raw(&folder, true).unwrap();
    assert!(report.problems[0].reason.contains("belongs elsewhere"), "{report:?}");
}

#[test]
fn golden_bytes() {
    let header = SegmentHeader { number: 3, created_unix_nanos: 0x0102_0304_0506_0708, configuration: "a=1".into() };
    let hex = |bytes: &[u8]| bytes.iter().map(|b| format!("{b:02x}")).collect::<String>();
    let encoded = header.encode();
    assert_eq!(
        hex(&encoded[..28]),
        "89677633726177".to_owned() + "0a" + "01000000" + "03000000" + "0807060504030201" + "03000000"
    );
    assert_eq!(hex(&encoded[28..]), GOLDEN_HEADER_END);
    assert_eq!(SegmentHeader::decode(&encoded).unwrap(), (header, encoded.len()));
    // A picture of noise is stored as it is, so its block is the same whatever the compressor does.
    let folder = tempfile::tempdir().unwrap();
    let stamp = RawStamp { sequence: 1, pattern: 2, device_time_nanos: 3, host_time_nanos: 4, exposure_nanos: 5 };
    let mut writer = RawWriter::create(folder.path(), "", 0).unwrap();
    writer.picture(&stamp, [2, 2], &[9, 200, 30, 77]).unwrap();
    writer.finish(0).unwrap();
    let bytes = fs::read(folder.path().join("pictures_000000.gv3raw")).unwrap();
    assert_eq!(hex(&bytes[36..96]), GOLDEN_BLOCK);
    // A compressed picture made by hand from RAW.md and RFC 8878: 32 x 2 pixels of 7 are a raw block of one 7 and a run of
    // 63 zeros.
    let mut compressed = SegmentHeader { number: 0, created_unix_nanos: 0, configuration: String::new() }.encode();
    compressed.extend(
        (0..GOLDEN_COMPRESSED.len()).step_by(2).map(|i| u8::from_str_radix(&GOLDEN_COMPRESSED[i..i + 2], 16).unwrap()),
    );
    let mut segment = Segment::new(compressed).unwrap();
    let Some(RawItem::Picture(found)) = segment.next(true) else { panic!("no picture") };
    assert_eq!((found.width_px, found.height_px, found.pixels), (32, 2, vec![7; 64]));
}

const GOLDEN_HEADER_END: &str = "8130628d88d8a013613d31";
const GOLDEN_BLOCK: &str = "6776335004000000010000000000000003000000000000000400000000000000050000000000000002000200020000009c55dc1fe2efa2ff09c81e4d";
const GOLDEN_COMPRESSED: &str = "677633500e000000000000000000000000000000000000000000000000000000000000000000000000002000020001000336e71d44a56bc028b52ffd204008000007fb010000";

#[test]
fn every_prefix_keeps_what_is_before_it() {
    let parent = tempfile::tempdir().unwrap();
    let path = small(&parent.path().join("raw"));
    let bytes = fs::read(&path).unwrap();
    let mut kept = 0;
    for end in 0..bytes.len() {
        let Ok(mut segment) = Segment::new(bytes[..end].to_vec()) else {
            assert_eq!(kept, 0);
            continue;
        };
        let found: Vec<RawItem> = std::iter::from_fn(|| segment.next(true)).collect();
        let intact = found.iter().take_while(|item| !matches!(item, RawItem::Damage { .. })).count();
        assert_eq!(found[..intact], whole()[..intact], "prefix of {end} bytes");
        assert!(found.len() <= intact + 1 && intact >= kept && intact < 5);
        kept = intact;
    }
    assert_eq!(kept, 4);
    fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
    let report = verify_raw(path.parent().unwrap(), true).unwrap();
    assert!(!report.ok() && report.end.is_none() && report.pictures == 3, "{report:?}");
}

#[test]
fn every_flip_is_found_and_costs_one_block() {
    let parent = tempfile::tempdir().unwrap();
    let bytes = fs::read(small(&parent.path().join("raw"))).unwrap();
    for bit in 0..bytes.len() * 8 {
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        raw_exercise::segment(&flipped);
        let Ok(mut segment) = Segment::new(flipped) else { continue };
        let found: Vec<RawItem> = std::iter::from_fn(|| segment.next(true)).collect();
        let (damaged, intact): (Vec<_>, Vec<_>) = found.into_iter().partition(|i| matches!(i, RawItem::Damage { .. }));
        assert_eq!((damaged.len(), intact.len()), (1, 4), "bit {bit}");
        assert!(intact.iter().all(|item| whole().contains(item)), "bit {bit}");
    }
}

#[test]
fn what_cannot_be_is_refused_by_name() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("raw");
    let error = RawReader::open(parent.path()).err().unwrap().to_string();
    assert!(error.ends_with("not a raw recording: no pictures_000000.gv3raw in it"), "{error}");
    assert!(RawReader::open(&folder).is_err());
    let mut writer = RawWriter::create(&folder, CONFIGURATION, CREATED).unwrap();
    let error = |r: Result<(), RawError>| r.unwrap_err().to_string();
    assert!(error(writer.picture(&RawStamp::default(), [0, 2], &[])).contains("0 x 2 pixels"));
    assert!(error(writer.picture(&RawStamp::default(), [20_000, 1], &[0; 20_000])).contains("sides go to 16384"));
    assert!(error(writer.picture(&RawStamp::default(), [3, 2], &[0; 5])).contains("5 pixels for 3 x 2"));
    assert!(RawWriter::create(&parent.path().join("long"), &"x".repeat((1 << 20) + 1), 0).is_err());
    drop(writer);
    let path = folder.join("pictures_000000.gv3raw");
    let mut bytes = fs::read(&path).unwrap();
    bytes[8] = 2;
    fs::write(&path, &bytes).unwrap();
    let error = RawReader::open(&folder).err().unwrap().to_string();
    assert!(error.contains("raw format 2; this program reads up to 1"), "{error}");
    fs::write(&path, "hello").unwrap();
    let error = RawReader::open(&folder).err().unwrap().to_string();
    assert!(error.contains("does not begin as a segment does"), "{error}");
}

/// The corpus of the fuzz target, replayed by every test run.
#[test]
fn the_fuzz_corpus_never_panics() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/raw_segment");
    let mut count = 0;
    for entry in fs::read_dir(folder).unwrap() {
        raw_exercise::segment(&fs::read(entry.unwrap().path()).unwrap());
        count += 1;
    }
    assert!(count >= 4, "the corpus is missing");
}

/// Writes the corpus of the fuzz target: a whole segment, a torn one, one with a broken block, an empty one.
#[test]
#[ignore = "writes into the source tree"]
fn make_the_fuzz_corpus() {
    let parent = tempfile::tempdir().unwrap();
    let bytes = fs::read(small(&parent.path().join("raw"))).unwrap();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/raw_segment");
    fs::create_dir_all(&folder).unwrap();
    let mut broken = bytes.clone();
    broken[60] ^= 1;
    fs::write(folder.join("whole"), &bytes).unwrap();
    fs::write(folder.join("torn"), &bytes[..bytes.len() - 100]).unwrap();
    fs::write(folder.join("broken"), &broken).unwrap();
    fs::write(
        folder.join("empty"),
        SegmentHeader { number: 0, created_unix_nanos: 0, configuration: String::new() }.encode(),
    )
    .unwrap();
}

proptest! {
    #[test]
    fn any_picture_comes_back(width in 1u32..40, height in 1u32..20, k in any::<u64>(), seed in any::<u64>()) {
        let folder = tempfile::tempdir().unwrap();
        let picture = RawPicture { stamp: RawStamp { sequence: k, ..picture(seed % 100, 1, 1).stamp }, ..picture(seed, width, height) };
        let mut writer = RawWriter::create(folder.path(), "", 0).unwrap();
        write(&mut writer, &picture);
        writer.finish(0).unwrap();
        prop_assert_eq!(&items(folder.path())[0], &RawItem::Picture(picture));
    }

    #[test]
    fn scrambled_segments_never_panic(
        edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..12),
    ) {
        let parent = tempfile::tempdir().unwrap();
        let mut bytes = fs::read(small(&parent.path().join("raw"))).unwrap();
        for (at, value) in &edits {
            let at = at.index(bytes.len());
            bytes[at] = *value;
        }
        raw_exercise::segment(&bytes);
    }
}
