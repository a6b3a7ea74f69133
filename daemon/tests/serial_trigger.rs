//! The serial trigger controller against its model behind a pseudo-terminal.
#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3::device::serial_trigger::SerialTrigger;
use gv3::device::{self, DeviceError, RigConfig, Trigger, TriggerBackend, TriggerConfig, TriggerEvent};
use gv3::pipeline::raw::run_rig;
use gv3_protocol::trigger::TriggerModel;
use serialport::{SerialPort, TTYPort};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A model at the far end of a pseudo-terminal, in the time of the wall's clock.
struct Board {
    unplug: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Board {
    /// Plugs a board in under the name `link`. Every `damage`th line of it is damaged on its way, 0 for none.
    fn plug_in(link: &Path, damage: usize) -> Self {
        let (mut far, near) = TTYPort::pair().unwrap();
        far.set_timeout(Duration::from_millis(1)).unwrap();
        // A link is replaced at once, so that a port is never half there.
        let fresh = link.with_extension("new");
        std::os::unix::fs::symlink(near.name().unwrap(), &fresh).unwrap();
        std::fs::rename(&fresh, link).unwrap();
        let unplug = Arc::new(AtomicBool::new(false));
        let is_unplugged = Arc::clone(&unplug);
        let thread = std::thread::spawn(move || {
            // Kept open: without it the far end fails until the near one is opened.
            let _near = near;
            let (mut model, begin, mut lines) = (TriggerModel::new("pty-1"), Instant::now(), 0);
            while !is_unplugged.load(Ordering::Relaxed) {
                let mut bytes = [0; 64];
                let count = far.read(&mut bytes).unwrap_or(0);
                while model.advance(begin.elapsed().as_nanos() as u64).is_some() {}
                model.receive(&bytes[..count]);
                let mut said = model.take_output(usize::MAX);
                for byte in said.iter_mut().filter(|byte| **byte == b'*') {
                    lines += 1;
                    *byte = if damage > 0 && lines % damage == 0 { b'#' } else { b'*' };
                }
                if far.write_all(&said).is_err() {
                    return;
                }
            }
        });
        Self { unplug, thread: Some(thread) }
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        self.unplug.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

fn config(link: &Path) -> TriggerConfig {
    TriggerConfig {
        backend: TriggerBackend::Serial,
        port: Some(link.to_str().unwrap().into()),
        serial: None,
        baud: 115_200,
        width_nanos: 100_000,
        report_every: 1,
    }
}

fn place() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("port");
    (folder, link)
}

/// The next `count` pulses.
fn pulses(events: &std::sync::mpsc::Receiver<TriggerEvent>, count: usize) -> Vec<(u64, u64)> {
    let next = || match events.recv_timeout(Duration::from_secs(20)).unwrap() {
        TriggerEvent::Pulse { counter, time_nanos } => (counter, time_nanos),
        other => panic!("{other:?}"),
    };
    (0..count).map(|_| next()).collect()
}

#[test]
fn pulses_are_fired_and_told() {
    let (_folder, link) = place();
    let _board = Board::plug_in(&link, 0);
    let mut trigger = SerialTrigger::open(&config(&link)).unwrap();
    assert_eq!((trigger.info().model.as_str(), trigger.info().serial.as_str()), ("model", "pty-1"));
    let timing = RigConfig::simulated().timing;
    for _ in 0..2 {
        let events = trigger.events();
        let set = trigger.arm(&timing).unwrap();
        assert_eq!(set.picture_period_nanos, 5_555_500);
        let told = pulses(&events, 20);
        for (k, (counter, time_nanos)) in told.iter().enumerate() {
            assert_eq!((*counter, *time_nanos), (k as u64, told[0].1 + k as u64 * set.picture_period_nanos));
        }
        let fired = trigger.disarm().unwrap();
        assert!(fired >= 20);
        assert_eq!(events.try_iter().count() as u64, fired - 20);
        assert_eq!(trigger.disarm().unwrap(), fired);
    }
    let slow = device::SequenceTiming { picture_period_nanos: 20_000_000_000, exposure_nanos: 1 };
    assert!(trigger.arm(&slow).unwrap_err().to_string().starts_with("timing.picture_period_nanos"));
}

#[test]
fn damaged_lines_are_asked_for_again() {
    let (_folder, link) = place();
    let _board = Board::plug_in(&link, 3);
    let mut trigger = SerialTrigger::open(&config(&link)).unwrap();
    let events = trigger.events();
    trigger.arm(&RigConfig::simulated().timing).unwrap();
    let counters: Vec<u64> = pulses(&events, 20).iter().map(|(counter, _)| *counter).collect();
    // One in three reports is lost, and its counter with it.
    assert!(counters.windows(2).all(|pair| pair[0] < pair[1]) && counters[19] >= 25, "{counters:?}");
    assert!(trigger.disarm().unwrap() > counters[19]);
}

#[test]
fn a_controller_that_was_unplugged_is_found_again() {
    let (_folder, link) = place();
    let board = Board::plug_in(&link, 0);
    let mut trigger = SerialTrigger::open(&config(&link)).unwrap();
    let (events, timing) = (trigger.events(), RigConfig::simulated().timing);
    trigger.arm(&timing).unwrap();
    pulses(&events, 3);
    drop(board);
    std::fs::remove_file(&link).unwrap();
    let gone = trigger.disarm().unwrap_err();
    assert!(matches!(gone, DeviceError::Disconnected(_)), "{gone}");
    let _board = Board::plug_in(&link, 0);
    let end = Instant::now() + Duration::from_secs(20);
    while !matches!(events.recv_timeout(Duration::from_secs(20)).unwrap(), TriggerEvent::Restarted) {
        assert!(Instant::now() < end, "the controller's fresh start was not told");
    }
    trigger.arm(&timing).unwrap();
    assert_eq!(pulses(&events, 2).iter().map(|(counter, _)| *counter).collect::<Vec<_>>(), [0, 1]);
}

#[test]
fn a_controller_is_not_shared_with_another_program() {
    let (_folder, link) = place();
    let _board = Board::plug_in(&link, 0);
    let first = SerialTrigger::open(&config(&link)).unwrap();
    let error = SerialTrigger::open(&config(&link)).err().unwrap().to_string();
    assert!(error.starts_with("trigger: ") && error.contains("in use by another program"), "{error}");
    drop(first);
    SerialTrigger::open(&config(&link)).unwrap();
}

#[test]
fn what_is_no_controller_is_named() {
    let (_folder, link) = place();
    let error = |config: &TriggerConfig| SerialTrigger::open(config).err().unwrap().to_string();
    let missing = error(&config(&link));
    assert!(missing.starts_with("trigger: ") && missing.contains(link.to_str().unwrap()), "{missing}");
    let serial = TriggerConfig { port: None, serial: Some("no such".into()), ..config(&link) };
    assert!(error(&serial).contains("no port has a USB device of serial number \"no such\""));
    // A port behind which nothing speaks.
    let (_far, near) = TTYPort::pair().unwrap();
    let silent = TriggerConfig { port: near.name(), ..config(&link) };
    assert!(error(&silent).contains("no trigger controller answers"));
    let timing = RigConfig::simulated().timing;
    let field = |config: TriggerConfig| config.validate(&timing).unwrap_err().to_string();
    assert!(field(TriggerConfig { serial: Some("both".into()), ..config(&link) }).starts_with("trigger.port"));
    assert!(field(TriggerConfig { width_nanos: 6_000_000, ..config(&link) }).starts_with("trigger.width_nanos"));
    assert!(field(TriggerConfig { report_every: 0, ..config(&link) }).starts_with("trigger.report_every"));
    assert!(field(TriggerConfig { baud: 1, ..config(&link) }).starts_with("trigger.baud"));
}

#[test]
fn a_rig_with_a_trigger_takes_its_frame_sets_from_pulses() {
    let (_folder, link) = place();
    let _board = Board::plug_in(&link, 0);
    let mut rig_config = RigConfig::simulated();
    rig_config.sim.scene = device::sim::SceneConfig::Plane;
    rig_config.trigger = Some(config(&link));
    rig_config.validate().unwrap();
    let text = toml::to_string(&rig_config).unwrap();
    assert_eq!(toml::from_str::<RigConfig>(&text).unwrap(), rig_config);
    let rig = device::open(&rig_config).unwrap();
    let (sets, drops) = run_rig(rig, Some(3), &Default::default(), &Default::default()).unwrap();
    assert_eq!((sets, drops.sets()), (3, 0));
}
