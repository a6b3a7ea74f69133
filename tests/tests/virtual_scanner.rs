//! The virtual scanner from a host's side: descriptors, streams, faults, and pictures equal to the simulator's.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

#[path = "../../daemon/fuzz/fuzz_targets/usb_exercise.rs"]
mod usb_exercise;

use gv3::device::{self, RigConfig};
use gv3::usb_device::connection::SharedDevice;
use gv3::usb_device::{Bus, Completion, Outcome, Request, Setup};
use gv3::virtual_scanner::{DeviceKind, RigClock, VirtualConfig, VirtualScanner};
use gv3_protocol::gv3::{Axis, Decoder, Event, Request as Gv3Request, Timing};
use gv3_protocol::trigger::{ArmSettings, Command, Request as TriggerRequest};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

const CAMERA_PIXELS: u8 = 1;
const HEADER: usize = 12;

/// A host's view of one device.
struct Host {
    device: SharedDevice,
    bus: Bus,
    next_id: u64,
    done: Vec<Completion>,
}

impl Host {
    fn new(device: &SharedDevice) -> Self {
        Self { device: Arc::clone(device), bus: Bus::default(), next_id: 0, done: Vec::new() }
    }

    fn request(&mut self, request: impl FnOnce(u64) -> Request) {
        self.next_id += 1;
        self.bus.handle(request(self.next_id), &mut *self.device.lock().unwrap(), &mut self.done).unwrap();
    }

    fn control(&mut self, setup: [u8; 8], data: &[u8]) -> Outcome {
        let setup = Setup::new(setup);
        self.request(|id| Request::Control { id, setup, data: data.to_vec() });
        self.done.pop().unwrap().outcome
    }

    fn out(&mut self, endpoint: u8, data: Vec<u8>) {
        let expected = Outcome::Taken(data.len() as u32);
        self.request(|id| Request::Out { id, endpoint, data });
        assert_eq!(self.done.pop().unwrap().outcome, expected);
    }

    /// What a transfer of `max_bytes` gets; none when it is taken back because there is nothing yet.
    fn take(&mut self, endpoint: u8, max_bytes: u32) -> Option<Vec<u8>> {
        self.request(|id| Request::In { id, endpoint, max_bytes });
        self.bus.pump(&mut *self.device.lock().unwrap(), 1 << 24, &mut self.done);
        match self.done.pop() {
            Some(Completion { outcome: Outcome::Data(data), .. }) => Some(data),
            Some(other) => panic!("{other:?}"),
            None => {
                let victim = self.next_id;
                self.request(|id| Request::Cancel { id, victim });
                self.done.clear();
                None
            }
        }
    }

    /// Commits the stream of the camera, as uvcvideo does.
    fn begin_stream(&mut self, interval: u32) {
        let mut probe = vec![1, 0, 1, 1];
        probe.extend(interval.to_le_bytes());
        probe.resize(26, 0);
        for selector in [1, 2] {
            assert_eq!(self.control([0x21, 1, 0, selector, 1, 0, 26, 0], &probe), Outcome::Taken(26));
        }
    }

    /// A payload of the camera, in transfers of 32 packets as uvcvideo has them.
    fn payload(&mut self, clock: &mut RigClock, now: &mut Instant) -> Vec<u8> {
        let mut payload = Vec::new();
        for _ in 0..2000 {
            while let Some(part) = self.take(CAMERA_PIXELS, 32 * 1024) {
                let is_short = part.len() < 32 * 1024;
                payload.extend(part);
                if is_short {
                    return payload;
                }
            }
            *now += clock.step(*now).max(Duration::from_micros(100));
        }
        panic!("no picture in 2000 steps");
    }
}

fn scanner(settings: &VirtualConfig, config: &RigConfig) -> VirtualScanner {
    VirtualScanner::new(config, settings, Arc::default()).unwrap()
}

fn camera_alone(faults: &[&str]) -> VirtualConfig {
    let faults = faults.iter().map(|f| f.parse().unwrap()).collect();
    VirtualConfig { devices: vec![DeviceKind::Camera], plays_itself: true, faults, ..VirtualConfig::default() }
}

/// The first pictures of the simulator in process.
fn simulated(config: &RigConfig, count: usize) -> Vec<Vec<u8>> {
    let mut rig = device::open(config).unwrap();
    rig.camera.configure(&config.camera_settings()).unwrap();
    rig.projector.load(&rig.sequence).unwrap();
    rig.camera.start().unwrap();
    rig.projector.play(&rig.timing).unwrap();
    (0..count).map(|_| rig.camera.next_frame(Instant::now()).unwrap().picture.pixels).collect()
}

fn presentation_nanos(payload: &[u8]) -> u64 {
    u64::from(u32::from_le_bytes(payload[2..6].try_into().unwrap())) * 100
}

#[test]
fn streamed_pictures_are_the_simulators() {
    let config = RigConfig::simulated();
    let VirtualScanner { devices, mut clock } = scanner(&camera_alone(&[]), &config);
    let (mut host, mut now) = (Host::new(&devices[0].1), Instant::now());
    let expected = simulated(&config, 8);
    // A second stream begins anew.
    for _ in 0..2 {
        host.begin_stream(55_555);
        let payloads: Vec<_> = (0..8).map(|_| host.payload(&mut clock, &mut now)).collect();
        for (k, (payload, pixels)) in payloads.iter().zip(&expected).enumerate() {
            assert_eq!((payload[0], payload[1] & 1), (HEADER as u8, k as u8 & 1), "picture {k}");
            assert_eq!(&payload[HEADER..], pixels, "picture {k}");
        }
        let times: Vec<_> = payloads.iter().map(|p| presentation_nanos(p)).collect();
        assert!(times.windows(2).all(|t| (t[1] - t[0]).abs_diff(5_555_556) <= 100), "{times:?}");
        assert_eq!(host.control([0x02, 1, 0, 0, 0x81, 0, 0, 0], &[]), Outcome::Taken(0));
        clock.step(now);
        assert_eq!(host.take(CAMERA_PIXELS, 1024), None);
    }
}

#[test]
fn time_waits_for_a_host_that_fetches_no_pictures() {
    let config = RigConfig::simulated();
    let VirtualScanner { devices, mut clock } = scanner(&camera_alone(&[]), &config);
    let (mut host, mut now) = (Host::new(&devices[0].1), Instant::now());
    host.begin_stream(55_555);
    for _ in 0..200 {
        now += clock.step(now).max(Duration::from_millis(5));
    }
    let expected = simulated(&config, 4);
    for pixels in expected {
        assert_eq!(host.payload(&mut clock, &mut now)[HEADER..], pixels);
    }
}

#[test]
fn faults_come_with_their_pulse() {
    let config = RigConfig::simulated();
    let faults = ["lost@1", "doubled@2", "short@4", "late@5", "unplug-camera@7"];
    let VirtualScanner { devices, mut clock } = scanner(&camera_alone(&faults), &config);
    let (mut host, mut now) = (Host::new(&devices[0].1), Instant::now());
    host.begin_stream(55_555);
    let payloads: Vec<_> = (0..7).map(|_| host.payload(&mut clock, &mut now)).collect();
    let expected = simulated(&config, 7);
    let order = [0, 2, 2, 3];
    for (payload, k) in payloads.iter().zip(order) {
        assert_eq!(payload[HEADER..], expected[k], "picture {k}");
    }
    assert_eq!(payloads[4].len(), (HEADER + 640 * 480) / 2);
    assert_ne!(payloads[5][HEADER..], expected[5]);
    assert_eq!(payloads[6][HEADER..], expected[6]);
    assert!(!devices[0].1.lock().unwrap().take_unplug());
    for _ in 0..50 {
        now += clock.step(now).max(Duration::from_millis(1));
    }
    assert!(devices[0].1.lock().unwrap().take_unplug());
    assert!(!devices[0].1.lock().unwrap().take_unplug());
}

#[test]
fn exposure_gain_and_size_are_the_cameras_own() {
    let config = RigConfig::simulated();
    let settings = VirtualConfig { camera_size_px: Some([320, 500]), ..camera_alone(&[]) };
    let VirtualScanner { devices, mut clock } = scanner(&settings, &config);
    let (mut host, mut now) = (Host::new(&devices[0].1), Instant::now());
    let get =
        |host: &mut Host, entity, selector, length| host.control([0xa1, 0x81, 0, selector, 0, entity, length, 0], &[]);
    assert_eq!(get(&mut host, 1, 4, 4), Outcome::Data(vec![50, 0, 0, 0]));
    assert_eq!(get(&mut host, 2, 4, 2), Outcome::Data(vec![16, 0]));
    assert_eq!(get(&mut host, 9, 4, 2), Outcome::Stall);
    host.begin_stream(55_555);
    let plain = host.payload(&mut clock, &mut now);
    assert_eq!(plain.len(), HEADER + 320 * 500);
    // Half the exposure at twice the gain; noise apart it is the same picture.
    assert_eq!(host.control([0x21, 1, 0, 4, 0, 1, 4, 0], &[25, 0, 0, 0]), Outcome::Taken(4));
    assert_eq!(host.control([0x21, 1, 0, 4, 0, 2, 2, 0], &[32, 0]), Outcome::Taken(2));
    assert_eq!(host.control([0x21, 1, 0, 4, 0, 1, 4, 0], &[0, 0, 0, 0]), Outcome::Stall);
    assert_eq!(host.control([0x02, 1, 0, 0, 0x81, 0, 0, 0], &[]), Outcome::Taken(0));
    clock.step(now);
    host.begin_stream(55_555);
    let amplified = host.payload(&mut clock, &mut now);
    // Where there is light enough for the noise to go both ways.
    let bright =
        |p: &[u8]| plain.iter().zip(p).skip(HEADER).filter(|(a, _)| **a > 40).map(|(_, b)| u64::from(*b)).sum();
    let (before, after): (u64, u64) = (bright(&plain), bright(&amplified));
    assert!(before > 100_000 && (before as f64 / after as f64 - 1.0).abs() < 0.03, "{before} {after}");
    assert!(amplified[HEADER..].iter().all(|v| v % 2 == 0 || *v == 255));
    assert!(plain[HEADER + 320 * 480..].iter().all(|v| *v == 0));
}

#[test]
fn projector_camera_and_trigger_share_one_time() {
    let mut config = RigConfig::simulated();
    config.timing.picture_period_nanos = 6_000_000;
    let VirtualScanner { devices, mut clock } = scanner(&VirtualConfig::default(), &config);
    let [mut camera, mut projector, mut trigger] = [0, 1, 2].map(|i| Host::new(&devices[i].1));
    let mut now = Instant::now();
    camera.begin_stream(60_000);
    play(&mut projector, &config);
    let ask = |id, command| TriggerRequest { id, command }.encode().as_bytes().to_vec();
    let settings = ArmSettings { period_nanos: 6_000_000, width_nanos: 100_000, report_every: 1 };
    trigger.out(2, ask(1, Command::Arm(settings)));
    trigger.out(2, ask(2, Command::Fire { count: 6 }));
    let expected = simulated(&config, 6);
    for (k, pixels) in expected.iter().enumerate() {
        assert_eq!(camera.payload(&mut clock, &mut now)[HEADER..], *pixels, "picture {k}");
    }
    for _ in 0..20 {
        now += clock.step(now).max(Duration::from_millis(1));
    }
    let lines = String::from_utf8(trigger.take(2, 4096).unwrap()).unwrap();
    let pulses: Vec<_> = lines.lines().filter(|l| l.starts_with("! pulse")).collect();
    assert_eq!(pulses.len(), 6, "{lines}");
    assert!(lines.contains("! done 6"), "{lines}");
    assert_eq!(camera.take(CAMERA_PIXELS, 1024), None);
    let mut decoder = Decoder::default();
    while let Some(bytes) = projector.take(2, 64) {
        decoder.push(&bytes);
    }
    let first = Event::decode(&decoder.next_message().unwrap()).unwrap();
    assert!(matches!(first, Event::Exposure(e) if e.trigger == 0 && e.pattern == 0), "{first:?}");
}

/// Sends the rig's sequence to the projector and has it play.
fn play(host: &mut Host, config: &RigConfig) {
    let sequence = &config.sequence;
    let pattern = |i: usize| Gv3Request::Pattern {
        index: i as u16,
        axis: Axis::Columns,
        levels: sequence.patterns[i].levels(sequence.length_px(i)),
    };
    let count = sequence.patterns.len();
    let mut requests: Vec<_> = (0..count).map(pattern).collect();
    requests.push(Gv3Request::Order((0..count as u16).collect()));
    let (period_nanos, exposure_nanos) = (config.timing.picture_period_nanos, config.timing.exposure_nanos);
    requests.push(Gv3Request::Timing(Timing { period_nanos, exposure_nanos }));
    requests.extend([Gv3Request::Arm, Gv3Request::Start]);
    for (i, request) in requests.iter().enumerate() {
        host.out(1, request.message(i as u16).encode());
        let mut decoder = Decoder::default();
        decoder.push(&host.take(1, 512).unwrap());
        request.decode_reply(&decoder.next_message().unwrap()).unwrap();
    }
}

#[test]
fn saved_inputs_of_the_fuzz_targets() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../daemon/fuzz/corpus");
    for (folder, check) in [("usbip", usb_exercise::usbip as fn(&[u8])), ("usbredir", usb_exercise::usbredir)] {
        let mut count = 0;
        for entry in std::fs::read_dir(corpus.join(folder)).unwrap() {
            let bytes = std::fs::read(entry.unwrap().path()).unwrap();
            check(&bytes);
            // Every prefix of it as well.
            (0..bytes.len().min(600)).for_each(|end| check(&bytes[..end]));
            count += 1;
        }
        assert!(count > 0, "{folder} has no inputs");
    }
}
