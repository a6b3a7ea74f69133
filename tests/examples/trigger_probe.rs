//! Drives a trigger controller through the backend and tells what it saw; for the scripts in `tests/lab`.
//!
//! `trigger_probe board TTY` is a controller: the model behind a serial port, until it is ended. `trigger_probe host KEY=VALUE...`
//! is the other end, where `KEY=VALUE` are lines of `[trigger]`; with `--outage` the controller is unplugged and plugged in
//! again meanwhile. Exit code 0 when pulses came as the protocol promises.

use anyhow::{Context, Result, bail, ensure};
use gv3::device::serial_trigger::SerialTrigger;
use gv3::device::{DeviceError, SequenceTiming, Trigger, TriggerConfig, TriggerEvent};
use gv3_protocol::trigger::TriggerModel;
use std::io::{ErrorKind, Read, Write};
use std::time::{Duration, Instant};

const TIMING: SequenceTiming = SequenceTiming { picture_period_nanos: 5_555_556, exposure_nanos: 5_000_000 };

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["board", tty] => board(tty),
        ["host", "--outage", ref table @ ..] => host(table, true),
        ["host", ref table @ ..] => host(table, false),
        _ => bail!("usage: trigger_probe board TTY | host [--outage] KEY=VALUE..."),
    }
}

fn board(tty: &str) -> Result<()> {
    let mut port = serialport::new(tty, 115_200).timeout(Duration::from_millis(1)).open()?;
    let (mut model, begin) = (TriggerModel::new("lab-1"), Instant::now());
    loop {
        let mut bytes = [0; 64];
        let count = match port.read(&mut bytes) {
            Ok(count) => count,
            Err(e) if e.kind() == ErrorKind::TimedOut => 0,
            Err(e) => return Err(e.into()),
        };
        while model.advance(begin.elapsed().as_nanos() as u64).is_some() {}
        model.receive(&bytes[..count]);
        let said = model.take_output(4096);
        match port.write_all(&said) {
            Err(e) if e.kind() != ErrorKind::TimedOut => return Err(e.into()),
            _ => {}
        }
    }
}

fn host(table: &[&str], has_outage: bool) -> Result<()> {
    let mut config: TriggerConfig = toml::from_str(&format!("backend = \"serial\"\n{}", table.join("\n")))?;
    config.report_every = config.report_every.max(1);
    let mut trigger = SerialTrigger::open(&config)?;
    println!("info {:?}", trigger.info());
    let events = trigger.events();
    for run in 0..2 {
        let set = trigger.arm(&TIMING)?;
        let mut counters = Vec::new();
        let begin = Instant::now();
        while counters.len() < 400 {
            ensure!(begin.elapsed() < Duration::from_secs(60), "only {} pulses in a minute", counters.len());
            match events.recv_timeout(Duration::from_secs(5)).context("silence")? {
                TriggerEvent::Pulse { counter, time_nanos } => counters.push((counter, time_nanos)),
                TriggerEvent::Overrun { counter } => bail!("pulse {counter} is late"),
                TriggerEvent::Restarted => bail!("the controller began anew by itself"),
            }
        }
        for pair in counters.windows(2) {
            let steps = pair[1].0 - pair[0].0;
            ensure!(steps == u64::from(config.report_every), "pulse {} after {}", pair[1].0, pair[0].0);
            ensure!(pair[1].1 - pair[0].1 == steps * set.picture_period_nanos, "period at {}", pair[1].0);
        }
        ensure!(counters[0].0 == 0, "the first pulse told is {}", counters[0].0);
        let fired = trigger.disarm()?;
        events.try_iter().for_each(drop);
        println!("run {run}: {} pulses told of {fired}, period {} ns", counters.len(), set.picture_period_nanos);
    }
    if has_outage {
        outage(&mut trigger, &events)?;
    }
    println!("OK");
    Ok(())
}

fn outage(trigger: &mut SerialTrigger, events: &std::sync::mpsc::Receiver<TriggerEvent>) -> Result<()> {
    trigger.arm(&TIMING)?;
    println!("ready for the outage");
    let begin = Instant::now();
    loop {
        ensure!(begin.elapsed() < Duration::from_secs(60), "the outage was not told");
        if let Ok(TriggerEvent::Restarted) = events.recv_timeout(Duration::from_millis(200)) {
            break;
        }
    }
    println!("the controller began anew");
    while let Err(error) = trigger.arm(&TIMING) {
        ensure!(matches!(error, DeviceError::Disconnected(_) | DeviceError::Timeout(_)), "{error}");
        ensure!(begin.elapsed() < Duration::from_secs(60), "the controller did not come back: {error}");
        std::thread::sleep(Duration::from_millis(200));
    }
    let first = events.recv_timeout(Duration::from_secs(5))?;
    ensure!(matches!(first, TriggerEvent::Pulse { counter: 0, .. }), "{first:?} after the outage");
    trigger.disarm()?;
    Ok(())
}
