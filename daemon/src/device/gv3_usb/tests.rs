//! The driver over the simulated cable.

use super::*;
use crate::device::{Camera, Exposure, sim::Gv3Device};
use gv3_protocol::gv3::{DeviceFault, PRODUCT_ID, VENDOR_ID};
use std::time::{Duration, Instant};

const SIZE_PX: [u32; 2] = [912, 1140];
const TIMING: SequenceTiming = SequenceTiming { picture_period_nanos: 5_555_556, exposure_nanos: 5_000_000 };

fn device() -> Gv3Device {
    Gv3Device::simulated(SIZE_PX, "T1")
}

fn sequence() -> PatternSequence {
    PatternSequence::two_frequency(SIZE_PX, 264.0, 22.0, 3)
}

fn opened() -> (Arc<Socket>, Gv3Projector) {
    let socket = Socket::new(device());
    let projector = Gv3Projector::open(socket.opener()).unwrap();
    (socket, projector)
}

fn soon() -> Instant {
    Instant::now() + Duration::from_secs(20)
}

/// Asks until it is so, for at most as long as no healthy machine takes.
fn wait_until(is_so: impl Fn() -> bool) {
    let deadline = soon();
    while !is_so() {
        assert!(Instant::now() < deadline, "not in time");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn what_is_loaded_arrives_to_the_level() {
    let (socket, mut projector) = opened();
    let info = projector.info();
    assert_eq!((info.serial.as_str(), info.width_px, info.height_px), ("T1", 912, 1140));
    let sequence = PatternSequence::gray_code(SIZE_PX, &[Direction::Columns, Direction::Rows]);
    projector.load(&sequence).unwrap();
    let sent: Vec<_> = socket.with_device(|d| d.patterns_in_order().cloned().collect()).unwrap();
    assert_eq!(sent.len(), sequence.patterns.len());
    for (i, pattern) in sent.iter().enumerate() {
        assert_eq!(pattern.levels, sequence.patterns[i].levels(sequence.length_px(i)));
        assert_eq!(pattern.axis == Axis::Rows, sequence.patterns[i].direction == Direction::Rows);
    }
    projector.show(PatternIndex(3)).unwrap();
    assert_eq!(socket.with_device(|d| d.light()).unwrap(), sim::Light::Still(3));
    assert!(matches!(projector.show(PatternIndex(sent.len() as u16)), Err(DeviceError::State(_))));
    projector.stop().unwrap();
    assert_eq!(socket.with_device(|d| d.light()).unwrap(), sim::Light::Dark);
}

#[test]
fn a_projector_let_go_of_is_dark() {
    let (socket, mut projector) = opened();
    projector.load(&sequence()).unwrap();
    projector.play(&TIMING).unwrap();
    drop(projector);
    assert_eq!(socket.with_device(|d| d.light()), Some(sim::Light::Dark));
}

#[test]
fn every_exposure_is_told_with_its_pattern_and_time() {
    let (_socket, mut projector) = opened();
    let feed = projector.exposures().unwrap();
    projector.load(&sequence()).unwrap();
    for _ in 0..2 {
        projector.play(&TIMING).unwrap();
        let told: Vec<Exposure> = (0..15).map(|_| feed.next(soon()).unwrap()).collect();
        for (k, exposure) in (0..).zip(&told) {
            assert_eq!((exposure.sequence, exposure.set, u64::from(exposure.pattern.0)), (k, k / 6, k % 6));
            assert_eq!(exposure.device_time_nanos, told[0].device_time_nanos + k * TIMING.picture_period_nanos);
            assert_eq!(exposure.exposure_nanos, TIMING.exposure_nanos);
        }
        assert_eq!(feed.lost(), 0);
    }
    projector.stop().unwrap();
}

#[test]
fn a_camera_in_its_light_sees_what_the_simulated_projector_shows() {
    let mut config = RigConfig::simulated();
    config.sim.scene = sim::SceneConfig::Plane;
    let frames = |config: &RigConfig| -> Vec<crate::device::Frame> {
        let mut rig = crate::device::open(config).unwrap();
        rig.camera.configure(&config.camera_settings()).unwrap();
        rig.projector.load(&rig.sequence).unwrap();
        rig.camera.start().unwrap();
        rig.projector.play(&rig.timing).unwrap();
        (0..6).map(|_| rig.camera.next_frame(soon()).unwrap()).collect()
    };
    let direct = frames(&config);
    config.projector = ProjectorConfig {
        transport: Some(UsbTransportKind::Simulated),
        ..ProjectorConfig::of(crate::device::Backend::Gv3Usb)
    };
    let (mut camera, mut projector) = open_simulated(&config).unwrap();
    let feed = projector.exposures().unwrap();
    for (a, b) in direct.iter().zip(frames(&config)) {
        assert_eq!((a.sequence, a.pattern), (b.sequence, b.pattern));
        assert!(a.picture == b.picture, "picture {}", a.sequence);
    }
    camera.configure(&config.camera_settings()).unwrap();
    projector.load(&config.sequence).unwrap();
    camera.start().unwrap();
    projector.play(&config.timing).unwrap();
    for _ in 0..8 {
        let (frame, exposure) = (camera.next_frame(soon()).unwrap(), feed.next(soon()).unwrap());
        assert_eq!((frame.sequence, frame.pattern), (exposure.sequence, exposure.pattern));
        assert_eq!(frame.device_time_nanos, exposure.device_time_nanos);
    }
}

#[test]
fn faults_of_the_cable_change_nothing_that_is_stored_or_shown() {
    use CableFault::{CorruptReply, CorruptRequest, EmptyReply, LostReply, LostRequest, ShortReply, StalledReply};
    let (socket, mut projector) = opened();
    // A request is tried three times.
    for faults in [[EmptyReply, StalledReply], [ShortReply, LostReply], [LostRequest, CorruptReply]] {
        socket.fail_next(faults);
        projector.load(&sequence()).unwrap();
    }
    socket.fail_next([CorruptRequest, LostReply]);
    projector.play(&TIMING).unwrap();
    let sent: Vec<_> = socket.with_device(|d| d.patterns_in_order().cloned().collect()).unwrap();
    for (i, pattern) in sent.iter().enumerate() {
        assert_eq!(pattern.levels, sequence().patterns[i].levels(912));
    }
    assert!(matches!(socket.with_device(|d| d.light()), Some(sim::Light::Playing { .. })));
    // A start whose reply is lost is not made twice, which would be refused.
    projector.stop().unwrap();
    assert_eq!(socket.with_device(|d| d.light()), Some(sim::Light::Dark));
}

#[test]
fn a_projector_that_is_pulled_out_while_playing_plays_again_when_it_is_back() {
    let (socket, mut projector) = opened();
    let feed = projector.exposures().unwrap();
    projector.load(&sequence()).unwrap();
    projector.play(&TIMING).unwrap();
    feed.next(soon()).unwrap();
    socket.unplug();
    std::thread::sleep(Duration::from_millis(20));
    socket.plug(device());
    wait_until(|| matches!(socket.with_device(|d| d.light()), Some(sim::Light::Playing { .. })));
    wait_until(|| feed.next(soon()).unwrap().sequence == 0);
    assert_eq!(feed.next(soon()).unwrap().sequence, 1);
    projector.stop().unwrap();
    assert_eq!(socket.with_device(|d| d.light()), Some(sim::Light::Dark));
}

#[test]
fn a_projector_pulled_out_in_mid_request_says_so_and_is_found_at_the_next() {
    let (socket, mut projector) = opened();
    projector.load(&sequence()).unwrap();
    socket.fail_next([CableFault::PulledOut]);
    assert!(matches!(projector.show(PatternIndex(1)), Err(DeviceError::Disconnected(_))));
    assert!(matches!(projector.show(PatternIndex(1)), Err(DeviceError::Disconnected(_))));
    assert!(matches!(projector.stop(), Err(DeviceError::Disconnected(_))));
    socket.plug(device());
    projector.show(PatternIndex(1)).unwrap();
    assert_eq!(socket.with_device(|d| d.light()), Some(sim::Light::Still(1)));
    assert_eq!(socket.with_device(|d| d.patterns_in_order().count()), Some(6));
}

#[test]
fn a_fault_of_the_device_is_named_and_left_by_the_next_run() {
    let (socket, mut projector) = opened();
    projector.load(&sequence()).unwrap();
    projector.play(&TIMING).unwrap();
    socket.with_device(|d| d.fail(DeviceFault::Temperature)).unwrap();
    let mut link = Link::open(&socket.opener()).unwrap();
    let error = link.ask(&Request::Arm).map_err(|e| device_error(explain(&mut link, e), "it")).unwrap_err().to_string();
    assert!(error.contains("too hot") && error.contains("91.0"), "{error}");
    projector.play(&TIMING).unwrap_err();
    projector.load(&sequence()).unwrap();
    projector.play(&TIMING).unwrap();
    assert!(matches!(socket.with_device(|d| d.light()), Some(sim::Light::Playing { .. })));
}

#[test]
fn what_the_device_cannot_do_is_an_error_that_names_the_field() {
    let (_socket, mut projector) = opened();
    let mut wide = sequence();
    wide.width_px += 1;
    assert!(projector.load(&wide).unwrap_err().to_string().starts_with("sequence.width_px"));
    projector.load(&sequence()).unwrap();
    let fast = SequenceTiming { picture_period_nanos: 4_000_000, exposure_nanos: 3_000_000 };
    assert!(projector.play(&fast).unwrap_err().to_string().starts_with("timing.picture_period_nanos"));
    let coarse = Socket::new(device().with_timing_step_nanos(1_000_000));
    let mut projector = Gv3Projector::open(coarse.opener()).unwrap();
    projector.load(&sequence()).unwrap();
    let error = projector.play(&TIMING).unwrap_err().to_string();
    assert!(error.starts_with("timing.picture_period_nanos") && error.contains("6000000"), "{error}");
    let fine = Socket::new(device().with_timing_step_nanos(1000));
    let mut projector = Gv3Projector::open(fine.opener()).unwrap();
    projector.load(&sequence()).unwrap();
    projector.play(&TIMING).unwrap();
}

#[test]
fn lost_events_are_counted() {
    let (socket, mut projector) = opened();
    let feed = projector.exposures().unwrap();
    projector.load(&sequence()).unwrap();
    projector.play(&TIMING).unwrap();
    let first = feed.next(soon()).unwrap();
    // The device's clock runs ahead by more exposures than its queue holds.
    let jump_nanos = 200 * TIMING.picture_period_nanos;
    socket.with_device(|d| d.advance_to(first.device_time_nanos + jump_nanos)).unwrap();
    wait_until(|| feed.lost() > 0 || feed.next(soon()).is_err());
    assert!((100..=200).contains(&feed.lost()), "{}", feed.lost());
}

#[test]
fn pipes_are_those_of_the_descriptors() {
    let mut device = device();
    let mut get = |kind: u8| device.handle_control([0x80, 6, 0, kind, 0, 0, 255, 0], &[]).unwrap();
    let (descriptor, configuration) = (get(1), get(2));
    assert_eq!(u16::from_le_bytes([descriptor[8], descriptor[9]]), VENDOR_ID);
    assert_eq!(u16::from_le_bytes([descriptor[10], descriptor[11]]), PRODUCT_ID);
    assert_eq!(configuration.len(), usize::from(configuration[2]));
    let (interface, endpoints) = configuration[9..].split_at(9);
    let endpoints: Vec<UsbEndpoint> = endpoints
        .chunks(7)
        .map(|e| UsbEndpoint { address: e[2], kind: e[3], packet_bytes: u16::from_le_bytes([e[4], e[5]]).into() })
        .collect();
    let pipes = UsbPipes::of_interface(interface[2], interface[5], &endpoints).unwrap();
    assert_eq!([pipes.out, pipes.reply, pipes.event], [Gv3Device::OUT, Gv3Device::IN, Gv3Device::EVENTS]);
    assert!(pipes.needs_empty_packet(1024) && !pipes.needs_empty_packet(1000));
    assert_eq!(pipes.reply_bytes(), 512);
    assert_eq!(UsbPipes::of_interface(0, 3, &endpoints), None);
    assert_eq!(UsbPipes::of_interface(0, 255, &endpoints[..2]), None);
}

#[cfg(any(feature = "nusb", feature = "rusb"))]
#[test]
fn the_projector_meant_is_picked_or_the_choice_is_told() {
    let found = |serials: &[&str]| -> Vec<(UsbPlace, usize)> {
        let place = |(i, s): (usize, &&str)| (UsbPlace::new("003", &[1, 1 + i as u8], Some((*s).into())), i);
        serials.iter().enumerate().map(place).collect()
    };
    let any = UsbSelector::default();
    assert!(matches!(any.pick(found(&[])), Err(UsbError::NotFound(_))));
    assert_eq!(any.pick(found(&["A"])).unwrap().1, 0);
    let error = any.pick(found(&["A", "B"])).unwrap_err().to_string();
    assert!(
        error.contains("A at 3-1.1") && error.contains("B at 3-1.2") && error.contains("projector.serial"),
        "{error}"
    );
    let b = UsbSelector { serial: Some("B".into()), bus_path: None };
    assert_eq!(b.pick(found(&["A", "B"])).unwrap().1, 1);
    let there = UsbSelector { serial: None, bus_path: Some("3-1.1".into()) };
    assert_eq!(there.pick(found(&["A", "B"])).unwrap().1, 0);
    let error = b.pick(found(&["A"])).unwrap_err().to_string();
    assert!(error.contains("projector B is not plugged in") && error.contains("A at 3-1.1"), "{error}");
}

#[test]
fn only_usb_projectors_have_a_place() {
    let error = |change: fn(&mut RigConfig)| {
        let mut config = RigConfig::simulated();
        change(&mut config);
        crate::device::open(&config).err().unwrap().to_string()
    };
    assert!(error(|c| c.projector.serial = Some("A".into())).starts_with("projector.serial"));
    assert!(error(|c| c.projector.transport = Some(UsbTransportKind::Nusb)).starts_with("projector.transport"));
    assert!(error(|c| c.projector.backend = crate::device::Backend::Gv3Usb).starts_with("camera.backend"));
    assert!(error(|c| c.camera.backend = crate::device::Backend::Gv3Usb).starts_with("camera.backend"));
    let text = "backend = \"gv3_usb\"\ntransport = \"rusb\"\nserial = \"A\"\n";
    let read: ProjectorConfig = toml::from_str(text).unwrap();
    assert_eq!((read.transport, toml::to_string(&read).unwrap().as_str()), (Some(UsbTransportKind::Rusb), text));
    assert!(toml::from_str::<ProjectorConfig>("backend = \"gv3_usb\"\nport = 3\n").is_err());
}
