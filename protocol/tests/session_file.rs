//! Sessions as files and as MCAP: round trip, what other tools see, errors that name the file.

mod common;

use std::fs;
use std::io::Cursor;
use std::os::unix::fs::FileExt;

use common::*;
use gv3_protocol::session::{
    GroupRecord, MetadataGroup, SessionError, SessionFile, SessionMetadata, SessionReader, SessionState, SessionWriter,
    key, recover, verify,
};

#[test]
fn round_trip_through_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gv3");
    write_small(SessionFile::create(&path, false).unwrap()).unwrap();
    let mut reader = SessionReader::open(&path).unwrap();
    assert_eq!(*reader.state(), SessionState::Clean);
    assert_eq!(reader.metadata().calibration(), Some("camera = 1"));
    assert_eq!(reader.metadata().get(key::SESSION, key::MODE), Some("default"));
    assert_eq!(reader.metadata().statistics().unwrap().number(key::ENCODE_MS_PER_SCAN), Some(12.5));
    assert_eq!(reader.groups().len(), groups().len());
    for (index, group) in groups().iter().enumerate() {
        let stored = reader.read_group(index).unwrap();
        assert_eq!(stored.entry, reader.groups()[index]);
        assert_eq!((stored.entry.first_tick, stored.entry.key_tick), (group.first_tick, group.key_tick));
        assert_eq!((&stored.geometry, &stored.texture), (&group.geometry, &group.texture));
        assert_eq!(stored.events, group.events);
    }
    assert_eq!(reader.streams()[0].first_group, 0);
    assert_eq!(reader.read_stream(0).unwrap(), STREAM);
    assert_eq!(reader.events().unwrap(), [drop_event(4), fault()]);
    assert_eq!(reader.telemetry().unwrap(), [telemetry()]);
    assert!(matches!(reader.read_group(3), Err(SessionError::Usage(_))));
    assert!(verify(&path).unwrap().ok());
}

#[test]
fn the_tolerance_of_the_coding_is_told_where_there_is_one() {
    let of = |metadata: &SessionMetadata| metadata.group(key::SESSION).unwrap().number::<f64>(key::TOLERANCE_MM);
    let metadata = SessionMetadata::new("default", "gv3", 1);
    assert_eq!(of(&metadata), None);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gv3");
    let writer = SessionWriter::create(SessionFile::create(&path, false).unwrap(), &metadata.with_tolerance_mm(0.06));
    writer.unwrap().finish(&MetadataGroup::new()).unwrap();
    assert_eq!(of(SessionReader::open(&path).unwrap().metadata()), Some(0.06));
}

#[test]
fn totals_add_up() {
    let bytes = small();
    let reader = open(&bytes).unwrap();
    let totals = reader.totals();
    let geometry: usize = groups().iter().map(|group| group.geometry.len()).sum();
    let texture: usize = groups().iter().filter_map(|group| group.texture.as_ref()).map(Vec::len).sum();
    assert_eq!((totals.geometry, totals.texture), (geometry as u64, texture as u64));
    assert_eq!(totals.session, bytes.len() as u64);
    assert_eq!(totals.geometry + totals.texture + totals.container, totals.session);
}

#[test]
fn a_file_that_grows_is_read_on_as_if_it_were_opened_anew() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("growing.gv3");
    let bytes = small();
    // From the first cut that opens, in steps that end inside of records and at their ends.
    let opened = (0..bytes.len()).find(|&cut| {
        fs::write(&path, &bytes[..cut]).unwrap();
        SessionReader::open(&path).is_ok()
    });
    let mut reader = SessionReader::open(&path).unwrap();
    let mut events = Vec::new();
    for cut in (opened.unwrap()..bytes.len()).step_by(29).chain([bytes.len(), bytes.len()]) {
        let SessionState::Unfinished { valid_bytes, .. } = *reader.state() else { panic!("it was opened unfinished") };
        fs::OpenOptions::new().write(true).open(&path).unwrap().write_all_at(&bytes[..cut], 0).unwrap();
        reader.read_on().unwrap();
        let mut fresh = SessionReader::open(&path).unwrap();
        assert_eq!((reader.groups(), reader.streams()), (fresh.groups(), fresh.streams()), "{cut} bytes");
        assert_eq!(reader.metadata(), fresh.metadata(), "{cut} bytes");
        events.extend(reader.events_from(valid_bytes).unwrap());
        assert_eq!(events, fresh.events().unwrap(), "{cut} bytes");
    }
    assert_eq!(reader.groups().len(), groups().len());
    assert_eq!(reader.read_group(2).unwrap().geometry, groups()[2].geometry);
}

#[test]
fn a_tick_finds_its_group() {
    let bytes = small();
    let reader = open(&bytes).unwrap();
    let found: Vec<_> = [0, 1, 10, 11, 21, 22].into_iter().map(|tick| reader.group_at(tick)).collect();
    assert_eq!(found, [Some(0), Some(1), Some(1), Some(2), Some(2), None]);
}

#[test]
fn two_runs_keep_their_headers() {
    let mut writer = SessionWriter::create(Cursor::new(Vec::new()), &metadata()).unwrap();
    for (tick, header) in [(0, b"one"), (5, b"two")] {
        writer.write_stream(header).unwrap();
        let record =
            GroupRecord { first_tick: tick, key_tick: tick, time_nanos: 0, geometry: b"g", texture: None, events: &[] };
        writer.write_group(record).unwrap();
    }
    let bytes = writer.finish(&MetadataGroup::new()).unwrap().into_inner();
    let mut reader = open(&bytes).unwrap();
    assert_eq!(reader.streams().iter().map(|stream| stream.first_group).collect::<Vec<_>>(), [0, 1]);
    assert_eq!(reader.read_stream(1).unwrap(), b"two");
}

/// The container must be an MCAP file for everybody, not only for this crate.
#[test]
fn other_mcap_readers_accept_it() {
    let bytes = small();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    // The stream header, three groups, one event between them.
    assert_eq!(summary.chunk_indexes.len(), 5);
    let messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().collect::<Result<_, _>>().unwrap();
    let topics: Vec<_> = messages.iter().map(|message| message.channel.topic.as_str()).collect();
    let expected = [
        "/gv3/stream",
        "/gv3/group",
        "/gv3/texture",
        "/gv3/telemetry",
        "/gv3/group",
        "/gv3/event",
        "/gv3/event",
        "/gv3/group",
        "/gv3/texture",
    ];
    assert_eq!(topics, expected);
    assert_eq!(messages[1].channel.message_encoding, "gv3");
    assert_eq!(messages[1].channel.schema.as_ref().unwrap().name, "gv3.Group");
    assert_eq!(messages[6].channel.message_encoding, "json");
    assert_eq!(messages[4].log_time, groups()[1].time_nanos);

    let options = mcap::sans_io::LinearReaderOptions::default()
        .with_prevalidate_chunk_crcs(true)
        .with_validate_data_section_crc(true)
        .with_validate_summary_section_crc(true)
        .with_check_finishes_after_end_magic(true);
    let mut linear = mcap::sans_io::LinearReader::new_with_options(options);
    let mut rest = bytes.as_slice();
    while let Some(event) = linear.next_event() {
        if let mcap::sans_io::LinearReadEvent::ReadRequest(need) = event.unwrap() {
            let take = need.min(rest.len());
            linear.insert(need)[..take].copy_from_slice(&rest[..take]);
            linear.notify_read(take);
            rest = &rest[take..];
        }
    }
}

/// 22 bytes a scan at ten scans a group.
#[test]
fn a_group_costs_little() {
    let size = |count: u64| {
        let mut writer = SessionWriter::create(Cursor::new(Vec::new()), &metadata()).unwrap();
        for index in 0..count {
            let record = GroupRecord {
                first_tick: index * 10 + 1,
                key_tick: index * 10 + 10,
                time_nanos: index,
                geometry: &[7; 1000],
                texture: None,
                events: &[],
            };
            writer.write_group(record).unwrap();
        }
        let bytes = writer.finish(&MetadataGroup::new()).unwrap().into_inner();
        assert!(open(&bytes).is_ok());
        bytes.len() as u64 - 1000 * count
    };
    let each = size(20) - size(19);
    assert!(each <= 230, "{each} bytes a group");
}

#[test]
fn the_opening_metadata_is_on_disk_before_the_first_group() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gv3");
    let mut writer = SessionWriter::create(SessionFile::create(&path, false).unwrap(), &metadata()).unwrap();
    let reader = SessionReader::open(&path).unwrap();
    assert_eq!(reader.metadata(), &metadata());
    assert!(matches!(reader.state(), SessionState::Unfinished { complete_groups: 0, .. }));
    for (index, group) in groups().iter().enumerate() {
        write_group(&mut writer, group).unwrap();
        assert_eq!(SessionReader::open(&path).unwrap().groups().len(), index + 1);
    }
    drop(writer);
    let state = SessionReader::open(&path).unwrap().state().clone();
    let bytes = fs::metadata(&path).unwrap().len();
    let SessionState::Unfinished { complete_groups: 3, valid_bytes, reason } = state else { panic!("{state:?}") };
    assert_eq!(valid_bytes, bytes);
    assert!(reason.contains("not finished"), "{reason}");
}

#[test]
fn what_is_not_a_session_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let check = |name: &str, content: Option<&[u8]>, expected: &str| {
        let path = folder.path().join(name);
        if let Some(content) = content {
            fs::write(&path, content).unwrap();
        }
        for error in [
            SessionReader::open(&path).err().unwrap(),
            verify(&path).err().unwrap(),
            recover(&path, folder.path().join("out.gv3"), false).err().unwrap(),
        ] {
            let text = error.to_string();
            assert!(text.contains(name) && text.contains(expected), "{text}");
        }
        assert!(!folder.path().join("out.gv3").exists() && !folder.path().join("out.gv3.part").exists());
    };
    check("missing.gv3", None, "cannot open");
    check("empty.gv3", Some(b""), "the file is empty");
    check("picture.gv3", Some(b"BM picture"), "does not begin as an MCAP file");
    check("short.gv3", Some(&mcap::MAGIC[..5]), "does not begin as an MCAP file");
    check("magic.gv3", Some(mcap::MAGIC), "header is incomplete");
    let foreign = mcap::WriteOptions::new().profile("ros2").create(Cursor::new(Vec::new())).unwrap().into_inner();
    check("foreign.gv3", Some(&foreign.into_inner()), "profile \"ros2\"");
    fs::create_dir(folder.path().join("folder.gv3")).unwrap();
    check("folder.gv3", None, "it is a folder");
}

#[test]
fn a_newer_session_is_refused() {
    let mut newer = metadata();
    newer.set_group(key::SESSION, MetadataGroup::new().with(key::FORMAT_VERSION, 9));
    assert!(matches!(SessionWriter::create(Cursor::new(Vec::new()), &newer), Err(SessionError::Usage(_))));

    let mut bytes = small();
    let session = "format_version";
    let at = bytes.windows(session.len()).position(|window| window == session.as_bytes()).unwrap() + session.len() + 4;
    assert_eq!(bytes[at], b'1');
    bytes[at] = b'9';
    let record_checksum = checksum_of_session_group("9");
    let old = checksum_of_session_group("1");
    let place = bytes.windows(8).position(|window| window == old.as_bytes()).unwrap();
    bytes[place..place + 8].copy_from_slice(record_checksum.as_bytes());
    let newer = |error: SessionError| matches!(error, SessionError::NewerVersion { found: 9, supported: 1, .. });
    let text = open(&bytes).err().unwrap().to_string();
    assert!(text.contains("written by a newer version of gv3 (format 9"), "{text}");
    assert!(newer(open(&bytes).err().unwrap()));
    // Unfinished ones too, and nobody verifies or rewrites what they cannot read.
    assert!(newer(open(&bytes[..bytes.len() - 1]).err().unwrap()));
    assert!(newer(gv3_protocol::session::verify_source(Cursor::new(&bytes), NAME).err().unwrap()));
    let recovered = gv3_protocol::session::recover_source(Cursor::new(&bytes), NAME, Cursor::new(Vec::new()));
    assert!(newer(recovered.err().unwrap()));
}

/// SESSION.md's checksum, computed independently for the small session's `gv3.session`.
fn checksum_of_session_group(version: &str) -> String {
    let texts = [
        "gv3.session",
        "created_unix_nanos",
        "1700000000000000000",
        "format_version",
        version,
        "mode",
        "default",
        "producer",
        "gv3 test",
    ];
    let bytes: Vec<u8> =
        texts.iter().flat_map(|text| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()).collect();
    format!("{:08x}", crc32fast::hash(&bytes))
}

#[test]
fn the_writer_keeps_order_and_goes_on() {
    let mut writer = SessionWriter::create(Cursor::new(Vec::new()), &metadata()).unwrap();
    let record = GroupRecord { first_tick: 3, key_tick: 5, time_nanos: 0, geometry: b"g", texture: None, events: &[] };
    writer.write_group(record).unwrap();
    for bad in [
        GroupRecord { first_tick: 5, key_tick: 6, ..record },
        GroupRecord { first_tick: 8, key_tick: 7, ..record },
        GroupRecord { first_tick: 6, key_tick: 6, geometry: b"", ..record },
        GroupRecord { first_tick: 6, key_tick: 6, texture: Some(b""), ..record },
    ] {
        assert!(matches!(writer.write_group(bad), Err(SessionError::Usage(_))), "{bad:?}");
    }
    let infinite = gv3_protocol::session::Telemetry { time_nanos: 0, values: [("x".to_owned(), f64::NAN)].into() };
    assert!(matches!(writer.write_telemetry(&infinite), Err(SessionError::Usage(_))));
    assert!(writer.write_stream(b"").is_err());
    writer.write_group(GroupRecord { first_tick: 6, key_tick: 6, ..record }).unwrap();
    let bytes = writer.finish(&MetadataGroup::new()).unwrap().into_inner();
    assert_eq!(open(&bytes).unwrap().groups().len(), 2);
}

#[test]
fn metadata_of_the_end_is_refused_at_the_start() {
    let mut metadata = metadata();
    metadata.set_group(key::STATISTICS, MetadataGroup::new());
    assert!(SessionWriter::create(Cursor::new(Vec::new()), &metadata).is_err());
    assert!(SessionWriter::create(Cursor::new(Vec::new()), &SessionMetadata::default()).is_err());
}

#[test]
fn an_existing_file_is_kept_unless_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gv3");
    fs::write(&path, b"precious").unwrap();
    assert!(matches!(SessionFile::create(&path, false), Err(SessionError::Exists { .. })));
    assert_eq!(fs::read(&path).unwrap(), b"precious");
    write_small(SessionFile::create(&path, true).unwrap()).unwrap();
    assert!(matches!(recover(&path, &path, false), Err(SessionError::Exists { .. })));
    fs::write(&path, &small()[..small().len() - 100]).unwrap();
    assert_eq!(recover(&path, &path, true).unwrap().groups, 3);
    assert!(verify(&path).unwrap().ok());
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn a_damaged_chunk_says_where_and_what_to_do() {
    let mut bytes = small();
    let offset = open(&bytes).unwrap().groups()[1].chunk_offset;
    let geometry = b"geometry of 10";
    let at = bytes.windows(geometry.len()).position(|window| window == geometry).unwrap();
    bytes[at] ^= 1;
    let mut reader = open(&bytes).unwrap();
    let text = reader.read_group(1).unwrap_err().to_string();
    assert!(text.contains(&format!("{NAME}, byte {offset}: chunk checksum")) && text.contains("gv3 recover"), "{text}");
    assert_eq!(read(&mut reader, 0).unwrap(), groups()[0]);
    assert_eq!(read(&mut reader, 2).unwrap(), groups()[2]);
}
