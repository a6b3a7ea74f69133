//! Tries a USB transport against a device: `usb_transports nusb|rusb pipes|projector [replug]`.
//!
//! `pipes` wants the laboratory's vendor device, which gives back what it is sent; `projector` wants one that speaks the gv3
//! protocol. With `replug` the device is to be pulled out and plugged in again when the program says so. Run by
//! `tests/lab/usb_transports.sh`.

use anyhow::{Context, Result, bail, ensure};
use gv3::device::gv3_usb::{self, NusbTransport, RusbTransport, UsbError, UsbSelector, UsbTransport, UsbTransportKind};
use gv3::device::{Backend, PatternIndex, Projector, ProjectorConfig, SequenceTiming};
use gv3::light::PatternSequence;
use std::time::{Duration, Instant};

const SECOND: Duration = Duration::from_secs(1);
/// How long a person or a script may take over a plug.
const PLUG_TIME: Duration = Duration::from_secs(30);

fn main() -> Result<()> {
    tracing_subscriber::fmt().with_max_level(tracing::Level::DEBUG).with_writer(std::io::stderr).init();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let kind = match arguments.first() {
        Some(&"nusb") => UsbTransportKind::Nusb,
        Some(&"rusb") => UsbTransportKind::Rusb,
        _ => bail!("expected nusb or rusb, then pipes or projector, then replug or nothing"),
    };
    let replug = arguments.get(2) == Some(&"replug");
    match arguments.get(1) {
        Some(&"pipes") => pipes(kind, replug)?,
        Some(&"projector") => projector(kind, replug)?,
        _ => bail!("expected pipes or projector behind {}", arguments[0]),
    }
    println!("OK {}", arguments.join(" "));
    Ok(())
}

fn open(kind: UsbTransportKind, selector: &UsbSelector) -> Result<Box<dyn UsbTransport>, UsbError> {
    Ok(match kind {
        UsbTransportKind::Rusb => Box::new(RusbTransport::open(selector)?),
        _ => Box::new(NusbTransport::open(selector)?),
    })
}

/// Control, bulk and interrupt; whole packets, empty ones, nothing at all, a stall.
fn pipes(kind: UsbTransportKind, replug: bool) -> Result<()> {
    let usb = open(kind, &UsbSelector::default())?;
    println!("{}", usb.place());
    ensure!(usb.control_in(1, 64, SECOND)? == b"lab-vendor-1", "control-in");
    let unknown = usb.control_in(0x7f, 64, SECOND);
    ensure!(unknown == Err(UsbError::Stall), "an unknown control request gives {unknown:?}");
    let counts: Vec<u8> = (0..5).map(|_| Ok(usb.read_event(SECOND)?[0])).collect::<Result<_, UsbError>>()?;
    ensure!(counts.is_sorted() && counts[0] != counts[4], "interrupt-in: {counts:?}");
    for bytes in [1, 511, 512, 513, 1024, 4000, 16_384] {
        echo(usb.as_ref(), bytes).with_context(|| format!("{bytes} bytes"))?;
    }
    let begin = Instant::now();
    let quiet = usb.read(Duration::from_millis(200));
    ensure!(quiet == Err(UsbError::Timeout) && begin.elapsed() >= Duration::from_millis(190), "quiet: {quiet:?}");
    stall(usb.as_ref())?;
    echo(usb.as_ref(), 700).context("after a stall")?;
    let (begin, count) = (Instant::now(), 300);
    (0..count).try_for_each(|_| echo(usb.as_ref(), 64))?;
    println!("{:.0} round trips/s of 64 bytes", f64::from(count) / begin.elapsed().as_secs_f64());
    if replug {
        let selector = UsbSelector { serial: usb.place().serial.clone(), bus_path: None };
        let seen = until_unplugged(usb.as_ref())?;
        println!("unplugged: {seen:?}");
        drop(usb);
        let again = again(kind, &selector)?;
        println!("found again: {}", again.place());
        echo(again.as_ref(), 1024).context("after plugging in again")?;
    }
    Ok(())
}

/// Sends a message and takes it back, with the zero-length packet that ends a message of whole packets.
fn echo(usb: &dyn UsbTransport, bytes: usize) -> Result<()> {
    let message: Vec<u8> = (0..bytes).map(|i| (i * 7 + i / 256) as u8).collect();
    usb.write(&message, SECOND)?;
    let mut back = Vec::new();
    while back.len() < bytes {
        back.extend(usb.read(SECOND)?);
    }
    ensure!(back == message, "other bytes came back");
    if bytes.is_multiple_of(512) {
        let end = usb.read(SECOND)?;
        ensure!(end.is_empty(), "{} bytes in place of an empty packet", end.len());
    }
    Ok(())
}

/// The device stalls a transfer that waits; the next ones must work again.
fn stall(usb: &dyn UsbTransport) -> Result<()> {
    std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(Duration::from_millis(200));
            usb.control_out(3, SECOND)
        });
        let stalled = usb.read(5 * SECOND);
        ensure!(stalled == Err(UsbError::Stall), "a stall gives {stalled:?}");
        Ok(())
    })
}

/// Reads until the device is gone; what is told before that is an error of the transfer at most.
fn until_unplugged(usb: &dyn UsbTransport) -> Result<Vec<UsbError>> {
    println!("UNPLUG");
    let (begin, mut seen) = (Instant::now(), Vec::new());
    while begin.elapsed() < PLUG_TIME {
        match usb.read(SECOND) {
            Ok(_) | Err(UsbError::Timeout) => {}
            Err(error) => {
                seen.push(error.clone());
                if error == UsbError::Disconnected {
                    return Ok(seen);
                }
                ensure!(seen.len() < 10, "{seen:?}");
            }
        }
    }
    bail!("it was not unplugged: {seen:?}")
}

fn again(kind: UsbTransportKind, selector: &UsbSelector) -> Result<Box<dyn UsbTransport>> {
    let begin = Instant::now();
    loop {
        match open(kind, selector) {
            Ok(usb) => return Ok(usb),
            Err(error) if begin.elapsed() > PLUG_TIME => return Err(error.into()),
            Err(_) => std::thread::sleep(Duration::from_millis(100)),
        }
    }
}

/// The driver: patterns up, sets played, every exposure told.
fn projector(kind: UsbTransportKind, replug: bool) -> Result<()> {
    let config = ProjectorConfig { transport: Some(kind), ..ProjectorConfig::of(Backend::Gv3Usb) };
    let mut projector = gv3_usb::open(&config)?;
    let info = projector.info();
    println!("{} {}, {} x {}", info.model, info.serial, info.width_px, info.height_px);
    let begin = Instant::now();
    projector.load(&PatternSequence::two_frequency([info.width_px, info.height_px], 264.0, 22.0, 3))?;
    println!("six patterns loaded in {:.1} ms", begin.elapsed().as_secs_f64() * 1e3);
    projector.show(PatternIndex(5))?;
    let period_nanos = info.min_period_nanos.max(5_555_556);
    let timing = SequenceTiming { picture_period_nanos: period_nanos, exposure_nanos: period_nanos * 9 / 10 };
    projector.play(&timing)?;
    let feed = projector.exposures().context("no exposures are told")?;
    for due in 0..180 {
        let told = feed.next(Instant::now() + 5 * SECOND)?;
        ensure!((told.sequence, u64::from(told.pattern.0)) == (due, due % 6), "exposure {due}: {told:?}");
    }
    ensure!(feed.lost() == 0, "{} exposures lost", feed.lost());
    if replug {
        println!("UNPLUG");
        let begin = Instant::now();
        let mut last = 180;
        loop {
            ensure!(begin.elapsed() < 2 * PLUG_TIME, "it did not play again");
            match feed.next(Instant::now() + SECOND) {
                Ok(told) if told.sequence < last && told.sequence == 0 => break,
                Ok(told) => last = told.sequence,
                Err(_) => {}
            }
        }
        println!("plays again");
    }
    projector.stop()?;
    Ok(())
}
