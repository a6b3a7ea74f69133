//! The simulated rig recorded with pictures lost, doubled and late: what is dropped, what is told, what remains.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3::device::sim::{Fault, FaultKind, SimWorld};
use gv3::device::{self, RigConfig};
use gv3::pipeline::record::ScanObserver;
use gv3::pipeline::{RecordSettings, Recorded, record};
use gv3_codec::EncoderConfig;
use gv3_codec::decode_stamps;
use gv3_codec::mesh::Bvh;
use gv3_codec::metrics::ErrorHistogram;
use gv3_codec::{Scan, StreamHeader};
use gv3_protocol::session::{Event, EventKind, SessionFile, SessionMetadata, SessionReader, SessionWriter};
use std::path::Path;
use std::sync::{Arc, Mutex};

/// Records scan periods of a rig into a session.
fn record_to(path: &Path, config: &RigConfig, periods: u64, observer: ScanObserver) -> Recorded {
    let rig = device::open(config).unwrap();
    let encoder = EncoderConfig::new(rig.timing.set_period_nanos(rig.sequence.patterns.len()));
    let metadata = SessionMetadata::new(encoder.header().mode.name(), "gv3-tests", 0);
    let writer = SessionWriter::create(SessionFile::create(path, false).unwrap(), &metadata).unwrap();
    let settings = RecordSettings {
        scan_periods: Some(periods),
        encoder,
        observer,
        stop: Arc::default(),
        progress: Arc::default(),
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(record(rig, settings, writer)).unwrap()
}

fn geometry(path: &Path) -> Vec<Vec<u8>> {
    let mut reader = SessionReader::open(path).unwrap();
    (0..reader.groups().len()).map(|i| reader.read_group(i).unwrap().geometry).collect()
}

const SETS: u64 = 21;
const FAULTS: [(FaultKind, u64, u32); 4] =
    [(FaultKind::Lost, 3, 4), (FaultKind::Doubled, 7, 1), (FaultKind::Late, 10, 2), (FaultKind::Lost, 11, 0)];

#[test]
fn faults_are_counted_by_cause_and_told_and_no_scan_is_made_of_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("faults.gv3");
    let mut config = RigConfig::simulated();
    config.sim.faults = FAULTS.map(|(kind, set, picture)| Fault { kind, set, picture }).to_vec();
    let scans: Arc<Mutex<Vec<Scan>>> = Arc::default();
    let seen = Arc::clone(&scans);
    let keep: ScanObserver = Box::new(move |scan| {
        seen.lock().unwrap().push(scan.clone());
        Ok(())
    });
    let recorded = record_to(&path, &config, SETS, keep);
    let drops = recorded.drops;
    assert_eq!((drops.lost, drops.doubled, drops.late, drops.disordered), (2, 1, 1, 0), "{drops:?}");
    assert_eq!((recorded.frame_sets, recorded.scans, recorded.unusable_scans), (SETS - 4, SETS - 4, 0));
    let ticks: Vec<u64> = (0..SETS).filter(|t| FAULTS.iter().all(|f| f.1 != *t)).collect();
    check_session(&path, &ticks);
    let scans = scans.lock().unwrap();
    assert_eq!(scans.iter().map(|s| s.tick).collect::<Vec<_>>(), ticks);
    check_truth(&scans, &SimWorld::new(&config).unwrap());
}

/// Stamps, keyframe schedule and events of the session.
fn check_session(path: &Path, ticks: &[u64]) {
    let mut reader = SessionReader::open(path).unwrap();
    let header = StreamHeader::decode(&reader.read_stream(0).unwrap()).unwrap();
    let keys: Vec<u64> = reader.groups().iter().map(|g| g.key_tick).collect();
    assert_eq!(keys, [0, 12, 20]);
    let stamps = (0..keys.len()).flat_map(|i| decode_stamps(&header, &reader.read_group(i).unwrap().geometry).unwrap());
    assert_eq!(stamps.map(|s| s.tick).collect::<Vec<_>>(), ticks);
    let events = reader.events().unwrap();
    let gap = |e: &Event| match e.kind {
        EventKind::Gap { ticks } => Some((e.tick, ticks)),
        _ => None,
    };
    assert_eq!(events.iter().filter_map(gap).collect::<Vec<_>>(), [(3, 1), (7, 1), (10, 2)]);
    let drop = |e: &Event| match &e.kind {
        EventKind::Drop { cause, count } if cause != "picture_stray" => Some((e.tick, cause.clone(), *count)),
        _ => None,
    };
    let drops: Vec<_> = events.iter().filter_map(drop).collect();
    let causes: Vec<&str> = drops.iter().map(|d| d.1.as_str()).collect();
    assert_eq!(causes, ["picture_lost", "picture_doubled", "picture_late", "picture_lost"]);
    for ((tick, _, count), (_, set, _)) in drops.iter().zip(FAULTS) {
        // A loss shows when the next picture comes, which may belong to the next set.
        assert!(*count == 1 && (set..=set + 1).contains(tick), "{drops:?}");
    }
}

/// A scan of mixed frame sets has wrong phases; the head moves, and a wrong fringe order is off by centimetres.
fn check_truth(scans: &[Scan], world: &SimWorld) {
    for scan in scans {
        let truth = Bvh::new(&world.truth_mesh(scan.time_nanos));
        let mut distances = ErrorHistogram::default();
        for &p in &scan.mesh.positions_mm {
            distances.add(f64::from(truth.nearest(p, f32::INFINITY).unwrap().distance2_mm2).sqrt());
        }
        assert!(distances.count() > 10_000, "{} vertices at tick {}", distances.count(), scan.tick);
        let p95_mm = distances.percentile_mm(95);
        assert!(p95_mm < 0.3, "tick {}: {p95_mm} mm", scan.tick);
    }
}

#[test]
fn the_seed_decides_every_byte() {
    let folder = tempfile::tempdir().unwrap();
    let coded = |name: &str, seed| {
        let path = folder.path().join(name);
        let mut config = RigConfig::simulated();
        config.sim.seed = seed;
        record_to(&path, &config, 4, Box::new(|_| Ok(())));
        geometry(&path)
    };
    let [first, again, other] = [("first", 5), ("again", 5), ("other", 6)].map(|(name, seed)| coded(name, seed));
    assert_eq!(first.len(), 2);
    assert!(first == again, "same seed, other bytes");
    assert!(first != other, "the seed has no effect");
}
