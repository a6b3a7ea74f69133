//! Torn, flipped and forged sessions, full disks: never a panic, never a wrong payload, as much kept as is intact.

mod common;

use std::fs;
use std::io::Cursor;
use std::path::Path;

use common::*;
use gv3_protocol::session::{
    MetadataGroup, RecoverReport, SessionError, SessionState, SessionWriter, recover_source, verify_source,
};
use proptest::prelude::*;

/// Recovers into memory.
fn recovered(bytes: &[u8]) -> gv3_protocol::session::Result<(Vec<u8>, RecoverReport)> {
    let (sink, report) = recover_source(Cursor::new(bytes), NAME, Cursor::new(Vec::new()))?;
    Ok((sink.into_inner(), report))
}

/// Every group that can be read, each checked against the original.
fn intact(bytes: &[u8]) -> gv3_protocol::session::Result<Vec<u64>> {
    let originals = groups();
    let mut reader = open(bytes)?;
    let mut ticks = Vec::new();
    for index in 0..reader.groups().len() {
        let Ok(group) = read(&mut reader, index) else { continue };
        assert!(originals.contains(&group), "a wrong payload at tick {}", group.key_tick);
        ticks.push(group.key_tick);
    }
    for index in 0..reader.streams().len() {
        assert!(reader.read_stream(index).is_ok_and(|payload| payload == STREAM) || reader.read_stream(index).is_err());
    }
    let _ = (reader.events(), reader.telemetry());
    Ok(ticks)
}

#[test]
fn every_truncation_keeps_the_complete_groups() {
    let bytes = small();
    let whole = open(&bytes).unwrap();
    let ends: Vec<_> = whole.groups().iter().map(|group| (group.chunk_offset + group.chunk_bytes) as usize).collect();
    let mut least = 0;
    for length in 0..bytes.len() {
        let torn = &bytes[..length];
        let complete = ends.iter().filter(|end| **end <= length).count();
        let Ok(reader) = open(torn) else {
            assert_eq!(complete, 0, "{length} bytes");
            assert!(least == 0, "opens with fewer bytes but not with {length}");
            assert!(recovered(torn).is_err());
            continue;
        };
        least = least.max(1);
        let SessionState::Unfinished { complete_groups, valid_bytes, .. } = *reader.state() else {
            panic!("{length} bytes are called clean")
        };
        assert_eq!(complete_groups, complete, "{length} bytes");
        assert!(valid_bytes as usize <= length);
        assert_eq!(intact(torn).unwrap().len(), complete);
        assert!(!verify_source(Cursor::new(torn), NAME).unwrap().ok());
        if complete == 0 {
            assert!(matches!(recovered(torn), Err(SessionError::NothingToRecover { .. })));
            continue;
        }
        let (rebuilt, report) = recovered(torn).unwrap();
        assert_eq!(report.groups, complete);
        assert!(report.metadata_kept);
        let verified = verify_source(Cursor::new(&rebuilt), NAME).unwrap();
        assert!(verified.ok(), "{length} bytes: {:?}", verified.problems);
        assert_eq!(intact(&rebuilt).unwrap().len(), complete);
    }
    assert_eq!(least, 1);
}

#[test]
fn every_bit_flip_is_found_and_costs_at_most_one_group() {
    let bytes = small();
    let whole = open(&bytes).unwrap().metadata().clone();
    for bit in 0..bytes.len() * 8 {
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        // What opens must be right, metadata included.
        if intact(&flipped).is_ok() {
            for (name, group) in open(&flipped).unwrap().metadata().iter() {
                assert_eq!(whole.group(name), Some(group), "bit {bit}");
            }
        }
        match verify_source(Cursor::new(&flipped), NAME) {
            Ok(report) => assert!(!report.ok(), "bit {bit} of byte {} goes unnoticed", bit / 8),
            Err(SessionError::NotASession { .. } | SessionError::NewerVersion { .. }) => {}
            Err(error) => panic!("bit {bit}: {error}"),
        }
        // One bit a byte is enough for the slower half: recovery looks at bytes.
        if bit % 8 != (bit / 8) % 8 {
            continue;
        }
        let Ok((rebuilt, report)) = recovered(&flipped) else { continue };
        assert!(report.groups + 1 >= groups().len(), "bit {bit} costs more than one group: {report:?}");
        assert!(report.groups == groups().len() || report.lost_bytes > 0, "bit {bit}: an unreported loss");
        assert_eq!(intact(&rebuilt).unwrap().len(), report.groups, "bit {bit}");
        assert!(verify_source(Cursor::new(&rebuilt), NAME).unwrap().ok(), "bit {bit}");
    }
}

#[test]
fn recovery_passes_over_a_damaged_group_and_says_which() {
    let mut bytes = small();
    let entry = open(&bytes).unwrap().groups()[1];
    bytes[entry.chunk_offset as usize + 60] ^= 0x10;
    let (rebuilt, report) = recovered(&bytes).unwrap();
    assert_eq!(intact(&rebuilt).unwrap(), [0, 21]);
    assert_eq!(report.lost.len(), 1);
    let lost = &report.lost[0];
    assert_eq!((lost.offset, lost.bytes), (entry.chunk_offset, entry.chunk_bytes));
    assert_eq!((lost.after_tick, lost.before_tick), (Some(0), Some(11)));
    let mut reader = open(&rebuilt).unwrap();
    assert_eq!(reader.read_stream(0).unwrap(), STREAM);
    assert_eq!(reader.events().unwrap(), [fault()]);
    assert_eq!(reader.metadata().get("gv3.recovery", "lost_spans"), Some("1"));
    assert_eq!(reader.metadata().statistics(), Some(&statistics()));
}

#[test]
fn recovery_finds_the_next_chunk_behind_broken_framing() {
    let mut bytes = small();
    let entry = open(&bytes).unwrap().groups()[1];
    // The record's length: what follows can only be found by searching.
    bytes[entry.chunk_offset as usize + 4] ^= 0xff;
    let (rebuilt, report) = recovered(&bytes).unwrap();
    assert_eq!(intact(&rebuilt).unwrap(), [0, 21]);
    assert_eq!(report.lost.len(), 1);
    assert!(report.lost_bytes >= entry.chunk_bytes);
}

#[test]
fn recovery_of_a_whole_session_changes_nothing_but_the_note() {
    let (rebuilt, report) = recovered(&small()).unwrap();
    assert_eq!((report.lost_bytes, report.groups), (0, 3));
    let bytes = small();
    let (mut old, mut new) = (open(&bytes).unwrap(), open(&rebuilt).unwrap());
    for index in 0..3 {
        assert_eq!(read(&mut old, index).unwrap(), read(&mut new, index).unwrap());
    }
    assert_eq!(old.events().unwrap(), new.events().unwrap());
    assert_eq!(old.telemetry().unwrap(), new.telemetry().unwrap());
    for (name, group) in old.metadata().iter() {
        assert_eq!(new.metadata().group(name), Some(group));
    }
}

#[test]
fn a_run_without_groups_left_gives_way_to_the_next() {
    let mut writer = SessionWriter::create(Cursor::new(Vec::new()), &metadata()).unwrap();
    for (header, group) in [b"one", b"two"].iter().zip(groups()) {
        writer.write_stream(*header).unwrap();
        write_group(&mut writer, &group).unwrap();
    }
    let mut bytes = writer.finish(&statistics()).unwrap().into_inner();
    let entry = open(&bytes).unwrap().groups()[0];
    bytes[entry.chunk_offset as usize + 60] ^= 1;
    let (rebuilt, report) = recovered(&bytes).unwrap();
    assert_eq!(report.groups, 1);
    let mut reader = open(&rebuilt).unwrap();
    assert_eq!(reader.streams().len(), 1);
    assert_eq!(reader.read_stream(0).unwrap(), b"two");
}

#[test]
fn lost_opening_metadata_does_not_cost_the_groups() {
    let mut bytes = small();
    let at = bytes.windows(11).position(|window| window == b"gv3.session").unwrap();
    bytes[at] ^= 1;
    let (rebuilt, report) = recovered(&bytes).unwrap();
    assert!(!report.metadata_kept);
    assert_eq!(intact(&rebuilt).unwrap().len(), 3);
    assert_eq!(open(&rebuilt).unwrap().metadata().calibration(), Some("camera = 1"));
}

#[test]
fn a_full_disk_surfaces_and_leaves_what_was_written() {
    let whole = small();
    for room in 0..whole.len() {
        let mut disk = Vec::new();
        match write_small(FullDisk::new(&mut disk, room)) {
            Err(SessionError::Write(source)) => assert_eq!(source.kind(), std::io::ErrorKind::StorageFull),
            Err(other) => panic!("room for {room}: {other}"),
            Ok(_) => panic!("room for {room} of {} bytes was enough", whole.len()),
        }
        // A prefix of the whole session: what the truncations above cover.
        assert_eq!(disk, whole[..room]);
    }
}

#[test]
fn a_failed_fsync_surfaces_and_closes_the_writer() {
    // Opening metadata, stream header, first group.
    for good in 0..3 {
        let disk = BadDisk { written: Cursor::new(Vec::new()), good };
        let Ok(mut writer) = SessionWriter::create(disk, &metadata()) else {
            assert_eq!(good, 0);
            continue;
        };
        writer.write_stream(STREAM).unwrap();
        let groups = groups();
        for group in &groups[..2] {
            assert!(matches!(write_group(&mut writer, group), Err(SessionError::Write(_))));
        }
        assert!(matches!(writer.finish(&MetadataGroup::new()), Err(SessionError::Write(_))));
    }
}

/// A record that claims 2^62 bytes, and one that claims more than the file has, must not be allocated for.
#[test]
fn forged_lengths_allocate_nothing() {
    let bytes = small();
    let entry = open(&bytes).unwrap().groups()[1];
    for claim in [1_u64 << 62, u64::MAX, 200 << 20] {
        for field in [1, 9 + 16, 9 + 32] {
            let mut forged = bytes.clone();
            let at = entry.chunk_offset as usize + field;
            forged[at..at + 8].copy_from_slice(&claim.to_le_bytes());
            let _ = intact(&forged);
            assert_eq!(recovered(&forged).unwrap().1.groups, 2);
        }
    }
    // The header's profile: a text of 4 GiB in a record of a few bytes.
    let mut forged = bytes.clone();
    forged[17..21].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(matches!(open(&forged).err(), Some(SessionError::NotASession { .. })));
}

#[test]
fn swapped_chunks_are_out_of_order() {
    let mut bytes = small();
    let groups = open(&bytes).unwrap().groups().to_vec();
    // Groups 0 and 2 have the same shape but for digits; make room exactly by moving the later one over the first.
    let (first, last) = (groups[1], groups[2]);
    let moved = bytes[last.chunk_offset as usize..(last.chunk_offset + last.chunk_bytes) as usize].to_vec();
    let at = first.chunk_offset as usize;
    bytes.splice(at..at, moved);
    let report = verify_source(Cursor::new(&bytes), NAME).unwrap();
    assert!(report.problems.iter().any(|problem| problem.reason.contains("after tick")), "{:?}", report.problems);
}

/// The corpus of the fuzz target, replayed by every test run.
#[test]
fn the_fuzz_corpus_never_panics() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/session_reader");
    let mut count = 0;
    for entry in fs::read_dir(folder).unwrap() {
        exercise(&fs::read(entry.unwrap().path()).unwrap());
        count += 1;
    }
    assert!(count >= 5, "the corpus is missing");
}

/// What the fuzz target does with arbitrary bytes.
fn exercise(bytes: &[u8]) {
    if let Ok(mut reader) = open(bytes) {
        for index in 0..reader.groups().len() {
            let _ = reader.read_group(index);
        }
        let _ = (reader.events(), reader.telemetry(), reader.totals());
    }
    let _ = verify_source(Cursor::new(bytes), NAME);
    if let Ok((rebuilt, _)) = recovered(bytes) {
        assert!(verify_source(Cursor::new(&rebuilt), NAME).is_ok_and(|report| report.ok()));
    }
}

proptest! {
    #[test]
    fn scrambled_sessions_never_panic(
        edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..12),
        cut in any::<prop::sample::Index>(),
        cuts in any::<bool>(),
    ) {
        let mut bytes = small();
        for (at, value) in &edits {
            let at = at.index(bytes.len());
            bytes[at] = *value;
        }
        if cuts {
            bytes.truncate(cut.index(bytes.len()));
        }
        let _ = intact(&bytes);
        exercise(&bytes);
    }
}
