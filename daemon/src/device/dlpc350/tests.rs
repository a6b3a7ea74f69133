//! The driver against the emulated projector: every byte of it, and every fault at every request.

use super::emulator::{Dlpc350Emulator, EmulatedLink, Fault, Shown};
use super::*;
use gv3_protocol::dlpc350::{Input, InputSource, Power, Reply, Report, Request, RequestAssembler, RequestKind};
use proptest::prelude::*;

/// A cable that notes what the host sends.
#[derive(Clone)]
struct Tap {
    link: EmulatedLink,
    sent: Arc<Mutex<Vec<Report>>>,
}

impl HidLink for Tap {
    fn write_report(&mut self, report: &Report) -> Result<(), LinkError> {
        self.sent.lock().unwrap().push(*report);
        self.link.write_report(report)
    }

    fn read_report(&mut self, timeout: Duration) -> Result<Report, LinkError> {
        self.link.read_report(timeout)
    }

    fn pause(&mut self, _time: Duration) {}
}

impl HidOpener for Tap {
    fn name(&self) -> String {
        self.link.name()
    }

    fn open(&mut self) -> Result<Box<dyn HidLink>, LinkError> {
        self.link.open().map(|_| Box::new(self.clone()) as Box<dyn HidLink>)
    }
}

fn tap() -> Tap {
    Tap { link: EmulatedLink::default(), sent: Arc::default() }
}

fn driver(config: &Dlpc350Config, tap: &Tap) -> Result<Driver, DeviceError> {
    Driver::open(config.clone(), Box::new(tap.clone()))
}

fn timing(period_us: u64, exposure_us: u64) -> SequenceTiming {
    SequenceTiming { picture_period_nanos: period_us * 1000, exposure_nanos: exposure_us * 1000 }
}

/// Twice three 7-bit patterns at 30 scans/s.
fn two_frequency(config: &Dlpc350Config) -> Program {
    Program::sequence(config, 6, &timing(5555, 5555)).unwrap()
}

fn video(bit_depth: u8) -> Dlpc350Config {
    Dlpc350Config { source: Source::Video, flash_images: Vec::new(), ..Dlpc350Config::flash(bit_depth, 1) }
}

/// Image and pattern numbers as shown.
fn shown(link: &EmulatedLink) -> Vec<(Option<u8>, u8)> {
    match link.device().shown() {
        Shown::Patterns { patterns, repeats: true, .. } => {
            patterns.iter().map(|p| (p.image, p.entry.pattern)).collect()
        }
        _ => Vec::new(),
    }
}

/// What was sent since the last call, reads left out, sequence numbers 0.
fn writes(tap: &Tap) -> Vec<String> {
    let reports = std::mem::take(&mut *tap.sent.lock().unwrap());
    let hex = |r: &Report| {
        let length = 4 + usize::from(r[2]);
        [&[r[0], 0], &r[2..length]].concat().iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ")
    };
    reports.iter().filter(|r| r[0] & 0x80 == 0).map(hex).collect()
}

#[test]
fn a_flash_sequence_is_set_up_as_ti_does_it() {
    let (tap, config) = (tap(), Dlpc350Config::flash(7, 2));
    let mut driver = driver(&config, &tap).unwrap();
    assert_eq!(
        writes(&tap),
        [
            "40 00 03 00 1b 1a 01",
            "40 00 03 00 24 1a 00",
            "40 00 03 00 07 1a 08",
            // Upside down: 255 - 60.
            "40 00 05 00 01 0b c3 c3 c3",
        ]
    );
    assert_eq!(tap.link.device().shown(), Shown::Dark);
    driver.play(two_frequency(&config)).unwrap();
    assert_eq!(
        writes(&tap),
        [
            "40 00 03 00 1b 1a 01",
            "40 00 03 00 24 1a 00",
            "40 00 03 00 22 1a 03",
            "40 00 06 00 31 1a 05 01 05 01",
            "40 00 0a 00 29 1a b3 15 00 00 b3 15 00 00",
            "40 00 03 00 23 1a 01",
            "40 00 05 00 1d 1a 00 bb bb",
            "40 00 04 00 1e 1a 00 bb",
            "40 00 03 00 33 1a 02",
            "40 00 03 00 32 1a 00",
            "40 00 14 00 34 1a 00 77 04 07 77 00 0b 77 00 03 77 04 07 77 00 0b 77 00",
            "40 00 03 00 33 1a 00",
            "40 00 03 00 33 1a 01",
            "40 00 03 00 32 1a 00",
            "40 00 04 00 34 1a 01 00",
            "40 00 03 00 33 1a 00",
            "40 00 03 00 1a 1a 00",
            "40 00 03 00 24 1a 02",
        ]
    );
    let images = [0, 1].map(Some);
    assert_eq!(shown(&tap.link), images.iter().flat_map(|&i| (0..3).map(move |p| (i, p))).collect::<Vec<_>>());
    driver.stop().unwrap();
    assert_eq!(tap.link.device().shown(), Shown::Dark);
}

#[test]
fn a_video_sequence_is_started_until_it_runs() {
    let (tap, config) = (tap(), video(7));
    let mut driver = driver(&config, &tap).unwrap();
    driver.play(Program::sequence(&config, 3, &timing(5555, 5000)).unwrap()).unwrap();
    let sent = writes(&tap);
    assert_eq!(sent.iter().filter(|r| r.ends_with("24 1a 02")).count(), 2);
    assert!(sent.contains(&"40 00 03 00 23 1a 00".into()) && sent.contains(&"40 00 03 00 22 1a 00".into()));
    // Black follows the exposure, 555 us before the next pattern.
    assert!(sent.contains(&"40 00 0b 00 34 1a 01 77 02 07 77 02 0b 77 02".into()));
    assert_eq!(shown(&tap.link), [(None, 0), (None, 1), (None, 2)]);
}

#[test]
fn one_pattern_stands_still() {
    let (tap, config) = (tap(), Dlpc350Config::flash(8, 20));
    *tap.link.device() = Dlpc350Emulator::new().with_flash_images(20);
    let mut driver = driver(&config, &tap).unwrap();
    for (index, expected) in [(0, (Some(0), 0)), (31, (Some(10), 1)), (59, (Some(19), 2))] {
        driver.play(Program::still(&config, index).unwrap()).unwrap();
        assert_eq!(shown(&tap.link), [expected]);
    }
    assert!(Program::still(&config, 60).unwrap_err().to_string().starts_with("projector.dlpc350.flash_images"));
    let mut driver = super::tests::driver(&video(8), &tap).unwrap();
    driver.play(Program::still(&video(8), 2).unwrap()).unwrap();
    assert_eq!(shown(&tap.link), [(None, 2)]);
}

#[test]
fn a_lost_mode_and_an_unplugged_cable_are_noticed_and_mended() {
    let (tap, config) = (tap(), Dlpc350Config::flash(7, 2));
    let mut driver = driver(&config, &tap).unwrap();
    driver.watch();
    assert_eq!(driver.counters, Dlpc350Counters::default());
    driver.play(two_frequency(&config)).unwrap();
    let playing = shown(&tap.link);
    driver.watch();
    assert_eq!(driver.counters, Dlpc350Counters::default());

    tap.link.device().hot_plug_video();
    assert_eq!(tap.link.device().shown(), Shown::Video);
    driver.watch();
    assert_eq!(driver.counters, Dlpc350Counters { modes_lost: 1, disconnects: 0, resumed: 1 });
    assert_eq!(shown(&tap.link), playing);

    tap.link.device().inject(Fault::Unplug);
    (0..3).for_each(|_| driver.watch());
    assert_eq!(driver.counters, Dlpc350Counters { modes_lost: 1, disconnects: 1, resumed: 1 });
    assert!(matches!(driver.play(two_frequency(&config)), Err(DeviceError::Disconnected(_))));
    // What could not be played is not played behind the caller's back.
    tap.link.device().plug_in();
    driver.watch();
    assert_eq!(tap.link.device().shown(), Shown::Video);
    driver.play(two_frequency(&config)).unwrap();
    tap.link.device().inject(Fault::Unplug);
    driver.watch();
    tap.link.device().plug_in();
    driver.watch();
    assert_eq!(driver.counters, Dlpc350Counters { modes_lost: 1, disconnects: 2, resumed: 2 });
    // Four starts and two disconnections, of which whoever has pictures of the run before is told.
    assert_eq!(driver.runs.runs(), 6);
    assert_eq!((shown(&tap.link), tap.link.device().led_current()), (playing, config.current()));
    driver.stop().unwrap();
    tap.link.device().hot_plug_video();
    driver.watch();
    assert_eq!(driver.counters.modes_lost, 1);
}

/// Whatever goes wrong once, at whichever request: an error or a sequence that runs, and then everything works again.
#[test]
fn every_fault_at_every_request_is_survived() {
    let config = Dlpc350Config::flash(7, 2);
    let count = {
        let tap = tap();
        driver(&config, &tap).unwrap().play(two_frequency(&config)).unwrap();
        tap.sent.lock().unwrap().len()
    };
    assert!(count > 30);
    let mut survived = 0;
    for fault in [Fault::Nack, Fault::Lost, Fault::Unanswered, Fault::StaleReply, Fault::Garbage, Fault::Unplug] {
        for at in 0..count {
            let mut link = EmulatedLink::default();
            let opener = FaultAt { link: link.clone(), fault, at, count: Arc::default() };
            let played = Driver::open(config.clone(), Box::new(opener))
                .and_then(|mut driver| driver.play(two_frequency(&config)).map(|()| driver));
            if played.is_ok() {
                survived += 1;
                assert_eq!(shown(&link).len(), 6, "{fault:?} at request {at}");
            } else {
                assert!(matches!(fault, Fault::Nack | Fault::Unplug), "{fault:?} at request {at}: {:?}", played.err());
            }
            if fault == Fault::Unplug {
                link.device().plug_in();
            }
            let mut driver = Driver::open(config.clone(), Box::new(link.clone())).unwrap();
            driver.play(two_frequency(&config)).unwrap();
            assert_eq!(shown(&link).len(), 6, "after {fault:?} at request {at}");
            link.read_report(Duration::ZERO).unwrap_err();
        }
    }
    assert!(survived >= 4 * count);
}

/// A cable on which one request goes wrong.
#[derive(Clone)]
struct FaultAt {
    link: EmulatedLink,
    fault: Fault,
    at: usize,
    count: Arc<Mutex<usize>>,
}

impl HidLink for FaultAt {
    fn write_report(&mut self, report: &Report) -> Result<(), LinkError> {
        let mut count = self.count.lock().unwrap();
        if *count == self.at {
            self.link.device().inject(self.fault);
        }
        *count += 1;
        self.link.write_report(report)
    }

    fn read_report(&mut self, timeout: Duration) -> Result<Report, LinkError> {
        self.link.read_report(timeout)
    }

    fn pause(&mut self, _time: Duration) {}
}

impl HidOpener for FaultAt {
    fn name(&self) -> String {
        self.link.name()
    }

    fn open(&mut self) -> Result<Box<dyn HidLink>, LinkError> {
        self.link.open().map(|_| Box::new(self.clone()) as Box<dyn HidLink>)
    }
}

/// Says one thing to a device that is not driven yet.
fn tell<R: gv3_protocol::dlpc350::Register>(link: &EmulatedLink, value: &R) {
    let mut device = link.device();
    device.output_report(&Request::write(0, value).reports().unwrap()[0]);
    assert!(!Reply::parse(&device.input_report().unwrap()).unwrap().is_nack);
}

#[test]
fn standby_and_test_patterns_are_left_behind() {
    let tap = tap();
    tell(&tap.link, &Power::Standby);
    tell(&tap.link, &InputSource { input: Input::TestPattern, port_width: 1 });
    driver(&Dlpc350Config::flash(8, 1), &tap).unwrap();
    assert_eq!(writes(&tap)[..2], ["40 00 03 00 00 02 00", "40 00 03 00 00 1a 08"]);
}

#[test]
fn flash_is_never_written() {
    let (tap, config) = (tap(), Dlpc350Config::flash(4, 1));
    let mut driver = driver(&config, &tap).unwrap();
    driver.play(Program::sequence(&config, 6, &timing(5000, 4000)).unwrap()).unwrap();
    driver.stop().unwrap();
    driver.firmware().unwrap();
    let mut requests = RequestAssembler::default();
    for report in tap.sent.lock().unwrap().iter() {
        let Some(request) = requests.push(report).unwrap() else { continue };
        // Program mode, reset and the boot loader's commands.
        assert!(![0x3001, 0x0802].contains(&request.command) && request.command > 0x00ff, "{:#06x}", request.command);
        assert!(request.kind != RequestKind::WriteUnanswered);
    }
}

#[test]
fn what_the_device_refuses_is_said_in_the_rigs_words() {
    let error = |config: Dlpc350Config, count, timing: SequenceTiming| {
        let tap = tap();
        let program = config.validate().and_then(|()| Program::sequence(&config, count, &timing));
        program.and_then(|p| driver(&config, &tap)?.play(p)).unwrap_err().to_string()
    };
    let flash = Dlpc350Config::flash;
    let images = error(flash(7, 1), 6, timing(5555, 5555));
    assert_eq!(images, "projector.dlpc350.flash_images: 1 named, but 6 patterns of 7 bits, 3 an image, need 2");
    assert!(error(flash(8, 3), 3, timing(8333, 8333)).starts_with("projector.dlpc350.flash_images: image 2, but"));
    let short = error(flash(8, 2), 6, timing(5555, 5555));
    assert!(short.starts_with("timing.exposure_nanos") && short.contains("8333 us"), "{short}");
    let gap = error(flash(7, 2), 6, timing(5555, 5500));
    assert!(gap.contains("give 5555 us of light, or 5325 us or less"), "{gap}");
    let buffers = error(flash(8, 3), 7, timing(9000, 9000));
    assert!(buffers.starts_with("timing.picture_period_nanos") && buffers.contains("56 bit planes"), "{buffers}");
    let planes = error(video(7), 6, timing(5555, 5555));
    assert!(planes.starts_with("sequence.patterns: 6 patterns, but a video frame carries 3"), "{planes}");
    let frame = error(video(7), 3, timing(5600, 5600));
    assert!(frame.starts_with("timing.picture_period_nanos") && frame.ends_with("give 5555555"), "{frame}");
    // The device has the last word: a shorter exposure than the guide's may be tried.
    let tried = Dlpc350Config { min_exposure_us: Some(4000), ..flash(7, 1) };
    let refused = error(tried, 3, timing(4200, 4200));
    assert!(refused.starts_with("timing.exposure_nanos: the projector refuses"), "{refused}");
}

#[test]
fn settings_that_cannot_work_are_named() {
    let error = |change: fn(&mut Dlpc350Config)| {
        let mut config = Dlpc350Config::flash(7, 2);
        change(&mut config);
        config.validate().unwrap_err().to_string()
    };
    assert!(error(|c| c.bit_depth = 5).contains("bit_depth: 5, expected 1, 4, 7 or 8"));
    let current = error(|c| c.led_current = [104, 135, 130]);
    assert!(current.contains("7.30 A in all, more than led_limit_a = 4.3"), "{current}");
    assert!(error(|c| c.led_limit_a = f64::NAN).contains("led_limit_a"));
    assert!(error(|c| c.flash_images.clear()).contains("flash_images: 0 images"));
    assert!(error(|c| c.video_hz = 0.0).contains("video_hz"));
    assert!(error(|c| c.trigger_out_1.falling_nanos = 3000).contains("trigger_out_1.falling_nanos: 3000"));
    assert!(error(|c| c.trigger_out_2.rising_nanos = -30_000).contains("trigger_out_2.rising_nanos"));
    // One colour alone may shine brighter.
    let blue =
        Dlpc350Config { light: Light::Blue, led_current: [255; 3], led_limit_a: 4.5, ..Dlpc350Config::flash(7, 2) };
    blue.validate().unwrap();
    let text = "source = \"flash\"\nbit_depth = 7\nflash_images = [0, 1]\ntrigger_out_1 = { inverted = true }";
    let read: Dlpc350Config = toml::from_str(text).unwrap();
    assert_eq!(
        Dlpc350Config { trigger_out_1: TriggerOut1Config::default(), ..read.clone() },
        Dlpc350Config::flash(7, 2)
    );
    assert!(read.trigger_out_1.inverted);
    assert_eq!(toml::from_str::<Dlpc350Config>(&toml::to_string(&read).unwrap()).unwrap(), read);
}

#[test]
fn trigger_outputs_are_set() {
    let (tap, mut config) = (tap(), Dlpc350Config::flash(7, 2));
    config.trigger_out_1 = TriggerOut1Config { inverted: true, rising_nanos: -5000, falling_nanos: 2000 };
    config.trigger_out_2 = TriggerOut2Config { inverted: true, rising_nanos: 1000 };
    driver(&config, &tap).unwrap().play(two_frequency(&config)).unwrap();
    assert_eq!(tap.link.device().trigger_outputs(), config.triggers().unwrap());
    let (one, _) = config.triggers().unwrap();
    assert!(one.inverted && (one.rising.nanos() + 5000.0).abs() < 54.0 && (one.falling.nanos() - 2000.0).abs() < 54.0);
}

#[test]
fn a_thread_watches() {
    let link = EmulatedLink::default();
    let config = Dlpc350Config::flash(7, 2);
    let opener = Box::new(link.clone());
    let mut projector = Dlpc350Projector::open_with(&config, opener, Duration::from_millis(1)).unwrap();
    assert!(projector.info().model.contains("firmware 4.4.0"), "{}", projector.info().model);
    projector.load(&PatternSequence::two_frequency([WIDTH_PX, HEIGHT_PX], 264.0, 22.0, 3)).unwrap();
    projector.play(&timing(5555, 5000)).unwrap();
    link.device().hot_plug_video();
    let give_up = std::time::Instant::now() + Duration::from_secs(30);
    while projector.counters().resumed == 0 {
        assert!(std::time::Instant::now() < give_up, "the lost mode was not noticed");
        std::thread::yield_now();
    }
    assert_eq!(shown(&link).len(), 6);
    drop(projector);
    assert_eq!(link.device().shown(), Shown::Dark);
}

proptest! {
    /// What our rules let through the device accepts, and shows as it was meant.
    #[test]
    fn accepted_programs_run(
        is_flash: bool, depth in 0usize..4, count in 1usize..70, period_us in 100u64..300_000, gap_us in 0u64..2000,
    ) {
        let bits = [1, 4, 7, 8][depth];
        let config = if is_flash { Dlpc350Config::flash(bits, 40) } else { video(bits) };
        let period_us = if is_flash { period_us } else { 16_666 / count as u64 };
        let timing = timing(period_us, period_us.saturating_sub(gap_us));
        let Ok(program) = Program::sequence(&config, count, &timing) else { return Ok(()) };
        let tap = tap();
        *tap.link.device() = Dlpc350Emulator::new().with_flash_images(40);
        driver(&config, &tap).unwrap().play(program).unwrap();
        let an_image = 24 / usize::from(bits);
        let expected: Vec<_> =
            (0..count).map(|i| (is_flash.then_some((i / an_image) as u8), (i % an_image) as u8)).collect();
        prop_assert_eq!(shown(&tap.link), expected);
    }

    /// The device stays a device under any bytes.
    #[test]
    fn the_emulator_survives_any_reports(
        bytes in prop::collection::vec((any::<[u8; 12]>(), any::<bool>()), 1..60), commands in prop::collection::vec(0usize..16, 60),
    ) {
        const COMMANDS: [u16; 16] = [
            0x1a24, 0x1a1b, 0x1a22, 0x1a23, 0x1a29, 0x1a31, 0x1a33, 0x1a32, 0x1a34, 0x1a1a, 0x1a1d, 0x0200, 0x0b01, 0x1a0c, 0x1a00, 0x3001,
        ];
        let mut device = Dlpc350Emulator::new();
        for ((payload, is_read), command) in bytes.iter().zip(&commands) {
            let kind = if *is_read { RequestKind::Read } else { RequestKind::Write };
            let request = Request { kind, sequence: payload[0], command: COMMANDS[*command], payload: payload[1..].to_vec() };
            device.output_report(&request.reports().unwrap()[0]);
            let reply = Reply::parse(&device.input_report().unwrap()).unwrap();
            prop_assert!(reply.answers(&request));
            device.shown();
        }
    }
}
