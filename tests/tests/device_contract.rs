//! What every camera and projector promises, run for each backend alike: through the traits, opened as programs open them.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3::device::dlpc350::{Dlpc350Config, LinkKind};
use gv3::device::gv3_usb::UsbTransportKind;
use gv3::device::sim::SceneConfig;
use gv3::device::{
    self, Backend, CameraSettings, DeviceError, Frame, Pace, ProjectorConfig, RecordedConfig, Rig, RigConfig,
    TriggerSource,
};
use gv3::pipeline::RawRecorder;
use gv3::pipeline::raw::run_rig;
use gv3::virtual_scanner::ProjectorKind;
use gv3_tests::virtual_rig;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::{Duration, Instant};

/// Frame sets in the recordings that the recorded backends play.
const SETS: u64 = 3;

fn simulated() -> RigConfig {
    let mut config = RigConfig::simulated();
    config.sim.scene = SceneConfig::Plane;
    config
}

/// A recording of a rig's first sets, and the rig that plays it.
fn recorded(folder: &Path, pace: Pace, is_loop: bool) -> RigConfig {
    let path = folder.join("raw");
    if !path.exists() {
        let config = simulated();
        let (rig, recorder) = RawRecorder::attach(device::open(&config).unwrap(), &config, &path).unwrap();
        run_rig(rig, Some(SETS), &AtomicBool::new(false), &AtomicU64::new(0)).unwrap();
        assert!(recorder.finish().unwrap().is_complete());
    }
    RigConfig::recorded(RecordedConfig { path, pace, is_loop }).unwrap()
}

/// A rig to be tried.
struct Subject {
    config: RigConfig,
    open: fn(&RigConfig) -> Rig,
    /// How far a picture's time may be off the schedule's: nothing in virtual time.
    tolerance_nanos: u64,
}

impl Subject {
    /// One that is opened as programs open it, in virtual time.
    fn of(config: &RigConfig) -> Self {
        Self { config: config.clone(), open: |config| device::open(config).unwrap(), tolerance_nanos: 0 }
    }

    fn open(&self) -> Rig {
        (self.open)(&self.config)
    }
}

fn playing(subject: &Subject) -> Rig {
    let (mut rig, config) = (subject.open(), &subject.config);
    rig.camera.configure(&config.camera_settings()).unwrap();
    rig.projector.load(&rig.sequence).unwrap();
    rig.camera.start().unwrap();
    rig.projector.play(&rig.timing).unwrap();
    rig
}

fn soon() -> Instant {
    Instant::now() + Duration::from_secs(20)
}

fn check_backend(subject: &Subject) {
    calls_out_of_order_are_errors_and_harm_nothing(subject);
    settings_are_told_as_they_are(subject);
    frames_are_stamped_in_order(subject);
    stopping_is_always_allowed(subject);
    silence_ends_at_the_deadline(subject);
    a_run_begins_anew(subject);
}

fn calls_out_of_order_are_errors_and_harm_nothing(subject: &Subject) {
    let mut rig = subject.open();
    assert!(matches!(rig.camera.next_frame(soon()), Err(DeviceError::State(_))));
    assert!(matches!(rig.camera.start(), Err(DeviceError::State(_))));
    assert!(matches!(rig.projector.play(&rig.timing), Err(DeviceError::State(_))));
    assert!(matches!(rig.projector.show(device::PatternIndex(0)), Err(DeviceError::State(_))));
    // The projector may come first.
    rig.projector.load(&rig.sequence).unwrap();
    rig.projector.play(&rig.timing).unwrap();
    assert!(matches!(rig.camera.next_frame(soon()), Err(DeviceError::State(_))));
    rig.camera.configure(&subject.config.camera_settings()).unwrap();
    rig.camera.start().unwrap();
    rig.camera.next_frame(soon()).unwrap();
}

fn settings_are_told_as_they_are(subject: &Subject) {
    let mut rig = subject.open();
    let (camera, projector) = (rig.camera.info(), rig.projector.info());
    let want = subject.config.camera_settings();
    assert_eq!([camera.width_px, camera.height_px], [want.width_px, want.height_px]);
    assert_eq!([projector.width_px, projector.height_px], [rig.sequence.width_px, rig.sequence.height_px]);
    assert!(!camera.model.is_empty() && !projector.model.is_empty());
    let set = rig.camera.configure(&want).unwrap();
    assert_eq!(set, want);
    assert_eq!(rig.camera.configure(&set).unwrap(), set);
    let wrong = CameraSettings { width_px: want.width_px / 2, ..want };
    assert!(rig.camera.configure(&wrong).unwrap_err().to_string().starts_with("camera.width_px"));
    let mut sequence = rig.sequence.clone();
    sequence.width_px += 1;
    assert!(matches!(rig.projector.load(&sequence), Err(DeviceError::Config { .. })));
    rig.projector.load(&rig.sequence).unwrap();
    let mut timing = rig.timing;
    timing.exposure_nanos = 0;
    assert!(matches!(rig.projector.play(&timing), Err(DeviceError::Config { .. })));
}

fn frames_are_stamped_in_order(subject: &Subject) {
    let mut rig = playing(subject);
    let count = rig.sequence.patterns.len() as u64;
    let frames: Vec<Frame> = (0..2 * count).map(|_| rig.camera.next_frame(soon()).unwrap()).collect();
    for (k, frame) in frames.iter().enumerate() {
        assert_eq!((frame.sequence, u64::from(frame.pattern.0)), (k as u64, k as u64 % count));
        assert_eq!(frame.exposure_nanos, rig.timing.exposure_nanos);
        assert!(frame.host_time_nanos >= frame.device_time_nanos);
        let size = [subject.config.camera.width_px, subject.config.camera.height_px];
        assert_eq!([frame.picture.width_px, frame.picture.height_px], size);
        assert_eq!(frame.picture.pixels.len(), (size[0] * size[1]) as usize);
    }
    for pair in frames.windows(2) {
        let step_nanos = pair[1].device_time_nanos - pair[0].device_time_nanos;
        assert!(step_nanos.abs_diff(rig.timing.picture_period_nanos) <= subject.tolerance_nanos, "{step_nanos}");
        assert!(pair[1].host_time_nanos > pair[0].host_time_nanos);
    }
}

fn stopping_is_always_allowed(subject: &Subject) {
    let mut rig = subject.open();
    for _ in 0..2 {
        rig.projector.stop().unwrap();
        rig.camera.stop().unwrap();
    }
    // A real device is one program's, and one rig's, at a time.
    drop(rig);
    let mut rig = playing(subject);
    rig.camera.next_frame(soon()).unwrap();
    for _ in 0..2 {
        rig.camera.stop().unwrap();
        rig.projector.stop().unwrap();
    }
    assert!(matches!(rig.camera.next_frame(soon()), Err(DeviceError::State(_))));
}

fn silence_ends_at_the_deadline(subject: &Subject) {
    let mut rig = playing(subject);
    rig.projector.stop().unwrap();
    let mut begin = Instant::now();
    // What a live camera had on its way comes first.
    for _ in 0..64 {
        begin = Instant::now();
        match rig.camera.next_frame(begin + Duration::from_millis(30)) {
            Ok(_) => {}
            Err(error) => {
                assert!(matches!(error, DeviceError::Timeout(_)), "{error}");
                break;
            }
        }
    }
    // Far beyond any scheduler's delay, far below a forgotten deadline.
    assert!(begin.elapsed() < Duration::from_secs(10));
    // A timeout does not end the run; another show of the projector's may, since its first picture is another.
    rig.projector.play(&rig.timing).unwrap();
    if let Err(error) = rig.camera.next_frame(soon()) {
        assert!(matches!(error, DeviceError::Disconnected(_)), "{error}");
        rig.camera.start().unwrap();
        rig.projector.play(&rig.timing).unwrap();
        rig.camera.next_frame(soon()).unwrap();
    }
}

fn a_run_begins_anew(subject: &Subject) {
    let mut rig = playing(subject);
    let first = rig.camera.next_frame(soon()).unwrap();
    rig.camera.next_frame(soon()).unwrap();
    rig.projector.stop().unwrap();
    rig.camera.stop().unwrap();
    rig.camera.start().unwrap();
    rig.projector.play(&rig.timing).unwrap();
    let again = rig.camera.next_frame(soon()).unwrap();
    assert_eq!((again.sequence, again.pattern), (first.sequence, first.pattern));
}

#[test]
fn the_simulated_backend_keeps_the_contract() {
    check_backend(&Subject::of(&simulated()));
}

#[test]
fn a_projector_behind_the_vendor_protocol_keeps_the_contract() {
    let mut config = simulated();
    config.projector = ProjectorConfig::of(Backend::Gv3Usb);
    config.projector.transport = Some(UsbTransportKind::Simulated);
    check_backend(&Subject::of(&config));
}

#[test]
fn the_recorded_backend_keeps_the_contract() {
    let folder = tempfile::tempdir().unwrap();
    for (pace, is_loop) in [(Pace::Fast, false), (Pace::Sensor, false), (Pace::Fast, true)] {
        check_backend(&Subject::of(&recorded(folder.path(), pace, is_loop)));
    }
}

/// The LightCrafter's driver, whose other end is emulated byte by byte and shines into the simulated world.
#[test]
fn the_dlpc350_backend_keeps_the_contract() {
    let mut config = simulated();
    config.projector.backend = device::Backend::Dlpc350;
    assert!(device::open(&config).err().unwrap().to_string().starts_with("projector.dlpc350: missing"));
    config.projector.dlpc350 = Some(Dlpc350Config { link: LinkKind::Emulated, ..Dlpc350Config::flash(7, 2) });
    // Its clock counts whole microseconds.
    config.timing.picture_period_nanos = 5_555_000;
    check_backend(&Subject::of(&config));
    config.projector.dlpc350 = Some(Dlpc350Config::flash(7, 2));
    assert!(device::open(&config).err().unwrap().to_string().starts_with("camera.backend"));
}

/// The virtual scanner's USB devices, in this process.
#[test]
fn the_virtual_scanner_keeps_the_contract() {
    let mut config = simulated();
    // Whole ticks of the camera's clock, and time enough to render on a busy machine.
    config.timing.picture_period_nanos = 12_000_000;
    let open = |config: &RigConfig| virtual_rig::open(config, ProjectorKind::Gv3);
    check_backend(&Subject { config: config.clone(), open, tolerance_nanos: 0 });
    config.projector.dlpc350 = Some(Dlpc350Config::flash(7, 2));
    let open = |config: &RigConfig| virtual_rig::open(config, ProjectorKind::Dlpc350);
    check_backend(&Subject { config, open, tolerance_nanos: 0 });
}

/// Whatever is plugged in: `GV3_RIG=rig.toml cargo test -p gv3-tests --features real-rig --test device_contract real_rig`.
#[cfg(feature = "real-rig")]
#[test]
fn the_real_rig_keeps_the_contract() {
    let path = std::env::var_os("GV3_RIG").expect("GV3_RIG names the rig's file");
    let config = RigConfig::read(Path::new(&path)).unwrap();
    let tolerance_nanos = config.timing.picture_period_nanos / 4;
    check_backend(&Subject { tolerance_nanos, ..Subject::of(&config) });
}

#[test]
fn a_recording_ends_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let mut rig = playing(&Subject::of(&recorded(folder.path(), Pace::Fast, false)));
    let count = SETS * rig.sequence.patterns.len() as u64;
    (0..count).for_each(|_| drop(rig.camera.next_frame(soon()).unwrap()));
    for _ in 0..2 {
        assert!(matches!(rig.camera.next_frame(soon()), Err(DeviceError::Ended(_))));
    }
    rig.projector.play(&rig.timing).unwrap();
    assert_eq!(rig.camera.next_frame(soon()).unwrap().sequence, 0);
}

#[test]
fn a_looped_recording_goes_on_without_a_seam() {
    let folder = tempfile::tempdir().unwrap();
    let mut rig = playing(&Subject::of(&recorded(folder.path(), Pace::Fast, true)));
    let count = SETS * rig.sequence.patterns.len() as u64;
    let frames: Vec<Frame> = (0..3 * count).map(|_| rig.camera.next_frame(soon()).unwrap()).collect();
    for pair in frames.windows(2) {
        assert_eq!(pair[1].sequence, pair[0].sequence + 1);
        assert_eq!(pair[1].device_time_nanos - pair[0].device_time_nanos, rig.timing.picture_period_nanos);
    }
    assert!(frames[0].picture == frames[count as usize].picture);
}

#[test]
fn the_sensors_pace_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let mut rig = playing(&Subject::of(&recorded(folder.path(), Pace::Sensor, false)));
    let begin = Instant::now();
    let period = Duration::from_nanos(rig.timing.picture_period_nanos);
    for k in 0..12 {
        rig.camera.next_frame(soon()).unwrap();
        // A clock of its own: a picture may come late on a busy machine, never early.
        assert!(begin.elapsed() + Duration::from_millis(1) >= period * k, "picture {k}");
    }
    // What is due later than the deadline is not lost by the timeout.
    assert!(matches!(rig.camera.next_frame(Instant::now() - period * 400), Err(DeviceError::Timeout(_))));
    assert_eq!(rig.camera.next_frame(soon()).unwrap().sequence, 12);
}

#[test]
fn a_recording_plays_only_what_was_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let config = recorded(folder.path(), Pace::Fast, false);
    let mut rig = device::open(&config).unwrap();
    let internal = TriggerSource::Internal { period_nanos: 10_000_000 };
    let error = rig.camera.configure(&CameraSettings { trigger: internal, ..config.camera_settings() }).unwrap_err();
    assert!(error.to_string().starts_with("camera.trigger"), "{error}");
    let mut sequence = rig.sequence.clone();
    sequence.patterns.swap(0, 1);
    assert!(rig.projector.load(&sequence).unwrap_err().to_string().contains("other patterns"));
    rig.projector.load(&rig.sequence).unwrap();
    let mut timing = rig.timing;
    timing.picture_period_nanos += 1;
    assert!(rig.projector.play(&timing).unwrap_err().to_string().starts_with("timing.picture_period_nanos"));
    let mut mixed = config;
    mixed.projector.backend = device::Backend::Simulated;
    assert!(device::open(&mixed).err().unwrap().to_string().starts_with("projector.backend"));
    mixed.projector.backend = device::Backend::Recorded;
    mixed.recorded = None;
    assert!(device::open(&mixed).err().unwrap().to_string().starts_with("recorded"));
}
