//! Streams from one V4L2 camera through the backend and tells what it saw; for the scripts in `tests/lab`.
//!
//! `camera_probe [--pictures N] [--period-ms T] [--size WxH] [--count-numbers] [--stale-first] [--outage] KEY=VALUE...` where
//! `KEY=VALUE` are lines of `[camera.v4l]`. Exit code 0 when the pictures came as the backend promises.

use anyhow::{Context, Result, bail, ensure};
use gv3::device::v4l_camera::V4lCamera;
use gv3::device::{Camera, CameraSettings, DeviceError, Frame, RigConfig, TriggerSource, V4lConfig};
use std::time::{Duration, Instant};

struct Wanted {
    pictures: u64,
    period: Duration,
    size_px: [u32; 2],
    /// The first eight bytes of every picture are the sender's number.
    counts_numbers: bool,
    /// The driver's first picture of a stream may be one of before, as v4l2loopback's is; it proves nothing.
    has_stale_first: bool,
    /// The camera is unplugged and plugged in again while it streams.
    has_outage: bool,
    table: String,
}

fn arguments() -> Result<Wanted> {
    let mut wanted = Wanted {
        pictures: 100,
        period: Duration::from_millis(40),
        size_px: [640, 480],
        counts_numbers: false,
        has_stale_first: false,
        has_outage: false,
        table: String::new(),
    };
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().context("a value is missing");
        match argument.as_str() {
            "--pictures" => wanted.pictures = value()?.parse()?,
            "--period-ms" => wanted.period = Duration::from_secs_f64(value()?.parse::<f64>()? * 1e-3),
            "--size" => {
                let text = value()?;
                let (width, height) = text.split_once('x').context("--size is WIDTHxHEIGHT")?;
                wanted.size_px = [width.parse()?, height.parse()?];
            }
            "--count-numbers" => wanted.counts_numbers = true,
            "--stale-first" => wanted.has_stale_first = true,
            "--outage" => wanted.has_outage = true,
            line if line.contains('=') => wanted.table.push_str(&format!("{line}\n")),
            other => bail!("unknown argument {other}"),
        }
    }
    Ok(wanted)
}

fn main() -> Result<()> {
    let wanted = arguments()?;
    let mut config = RigConfig::simulated();
    [config.camera.width_px, config.camera.height_px] = wanted.size_px;
    config.camera.v4l = Some(toml::from_str::<V4lConfig>(&wanted.table)?);
    let mut camera = V4lCamera::open(&config)?;
    println!("info {:?}", camera.info());
    let period_nanos = wanted.period.as_nanos() as u64;
    let set = camera.configure(&CameraSettings {
        width_px: wanted.size_px[0],
        height_px: wanted.size_px[1],
        exposure_nanos: period_nanos / 2 / 100_000 * 100_000,
        trigger: TriggerSource::Internal { period_nanos },
    })?;
    println!("set {set:?}");
    println!("setup {:?}", camera.setup());
    // Two runs: buffers and stream are taken and given back more than once.
    for run in 0..2 {
        camera.start()?;
        let seen = stream(&mut camera, &wanted, run == 0)?;
        camera.stop()?;
        println!("run {run}: {seen}; {:?}", camera.counts());
    }
    println!("OK");
    Ok(())
}

fn stream(camera: &mut V4lCamera, wanted: &Wanted, is_first: bool) -> Result<String> {
    let mut last: Option<Frame> = None;
    let (mut gaps, mut outages, mut timeouts, mut pictures, mut backwards) = (0, 0, 0, 0, 0);
    let begin = Instant::now();
    while pictures < wanted.pictures {
        ensure!(begin.elapsed() < Duration::from_secs(120), "only {pictures} pictures in two minutes");
        // Every 16th deadline is too short on purpose: a timeout must not harm the run.
        let patience = Duration::from_millis(if pictures % 16 == 3 && timeouts < 8 { 1 } else { 1500 });
        match camera.next_frame(Instant::now() + patience) {
            Ok(frame) => {
                pictures += 1;
                if pictures == 30 {
                    println!("streaming");
                }
                if let Some(last) = last.as_ref().filter(|_| pictures > 2 || !wanted.has_stale_first) {
                    gaps += follows(last, &frame, wanted.counts_numbers)?;
                    let is_back = frame.device_time_nanos <= last.device_time_nanos;
                    backwards += u64::from(is_back != (frame.sequence < last.sequence));
                }
                last = Some(frame);
            }
            Err(DeviceError::Timeout(_)) => timeouts += 1,
            Err(error @ DeviceError::Disconnected(_)) if wanted.has_outage && is_first => {
                println!("{error} after {pictures} pictures");
                outages += 1;
                wait_for_return(camera)?;
                last = None;
            }
            Err(error) => return Err(error.into()),
        }
    }
    ensure!(!(wanted.has_outage && is_first) || outages > 0, "the camera was never unplugged");
    // Times go with the numbers; the clock of an emulated machine may step when its host is busy.
    ensure!(backwards * 20 <= pictures, "{backwards} of {pictures} times go back");
    ensure!(timeouts > 0, "no deadline passed without a picture");
    let rate = pictures as f64 / begin.elapsed().as_secs_f64();
    Ok(format!(
        "{pictures} pictures at {rate:.1}/s, {gaps} missing, {timeouts} timeouts, {outages} outages, {backwards} times back"
    ))
}

fn wait_for_return(camera: &mut V4lCamera) -> Result<()> {
    let begin = Instant::now();
    loop {
        match camera.start() {
            Ok(()) => return Ok(()),
            Err(DeviceError::Disconnected(_)) if begin.elapsed() < Duration::from_secs(60) => {
                std::thread::sleep(Duration::from_millis(250));
            }
            Err(error) => return Err(error.into()),
        }
    }
}

/// Checks two frames in a row; gives the pictures that are missing between them.
fn follows(last: &Frame, frame: &Frame, counts_numbers: bool) -> Result<u64> {
    ensure!(frame.sequence != last.sequence, "number {} twice", frame.sequence);
    ensure!(frame.host_time_nanos >= frame.device_time_nanos, "picture {} is of the future", frame.sequence);
    let steps = frame.sequence as i64 - last.sequence as i64;
    if counts_numbers {
        let sent = sent_number(frame)? as i64 - sent_number(last)? as i64;
        // What the sender itself left out has no number of the driver's; the order must be the sender's.
        ensure!(sent.signum() == steps.signum() && sent.abs() >= steps.abs(), "{sent} sent, {steps} counted");
    }
    Ok((steps - 1).max(0) as u64)
}

/// The sender's number, in the first eight pixels. The other rows are all alike, unless the stride is wrong.
fn sent_number(frame: &Frame) -> Result<u64> {
    let head = frame.picture.pixels.first_chunk::<8>().context("a picture of less than eight pixels")?;
    let width = frame.picture.width_px as usize;
    let rows: Vec<&[u8]> = frame.picture.pixels.chunks(width).skip(1).collect();
    ensure!(rows.windows(2).all(|pair| pair[0] == pair[1]), "the rows of vertical fringes differ");
    Ok(u64::from_le_bytes(*head))
}
