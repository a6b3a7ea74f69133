//! `gv3 encode`: a folder of scans becomes a session.

use super::Outcome;
use super::capture::stop_flag;
use super::progress::{bar, human_bytes};
use crate::files::{LandmarkTable, LoadedScan, Repairs, ScanFolder};
use crate::measure::binary_bytes;
use crate::pipeline::record::{session_metadata, write_group};
use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use gv3_codec::seed::{self, GivenLandmark, MAX_GIVEN_OFFSET_MM};
use gv3_codec::shot::encoder::ShotConfig;
use gv3_codec::{CodecError, EncodedGroup, Encoder, EncoderConfig, Pushed, Scan, StreamHeader};
use gv3_protocol::AtomicFile;
use gv3_protocol::session::{Event, EventKind, MetadataGroup, SessionWriter, key};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Scans read ahead of the encoder.
const READ_AHEAD: usize = 2;

/// Code a folder of scans, numbered OBJ or PLY files with a BMP or PNG picture each, into a session.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  gv3 encode recordings/smile -o smile.gv3\n  gv3 encode recordings/smile -o smile.gv3 --mode seed --landmarks smile.csv"
)]
pub struct Encode {
    /// Folder of scans, or a single scan.
    input: PathBuf,
    /// Session to write.
    #[arg(short, long)]
    out: PathBuf,
    /// How to code.
    #[arg(long, value_enum, default_value_t = ModeArgument::Default)]
    mode: ModeArgument,
    /// Landmarks on scans, CSV: scan,name,vertex,x,y,z (scan empty: all scans; x,y,z empty: the vertex, counted from 1).
    /// Those on two keyframes in a row join the tracked ones, and replace tracked ones nearby.
    #[arg(long, value_name = "CSV")]
    landmarks: Option<PathBuf>,
    /// Scans a second of the input; file numbers are ticks of this clock.
    #[arg(long, default_value_t = 30.0, value_parser = fps)]
    fps: f64,
    /// Error that is worth correcting, mm (default mode): sets what a bit may cost.
    #[arg(long, default_value_t = 0.1, value_parser = millimetres)]
    tolerance_mm: f64,
    /// Farthest that any pixel of a scan may be off across the surface, mm (default mode).
    #[arg(long, value_parser = millimetres)]
    max_error_mm: Option<f64>,
    /// Ticks from keyframe to keyframe.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u8).range(1..))]
    keyframe_interval: u8,
    /// Keep at most one vertex in this many in a keyframe (seed mode).
    #[arg(long, default_value_t = 6, value_parser = clap::value_parser!(u32).range(2..1000))]
    vertex_ratio: u32,
    /// Quality of key textures, 1 to 100 (seed mode).
    #[arg(long, default_value_t = 85, value_parser = clap::value_parser!(u8).range(1..=100))]
    texture_quality: u8,
    /// Cut open a closed surface where it faces away from the scanner, instead of refusing it.
    #[arg(long)]
    open_closed: bool,
    /// Replace an existing session.
    #[arg(long)]
    force: bool,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ModeArgument {
    /// Shots on the conformal disk, corrected in the camera's view.
    Default,
    /// The published scheme: decimated keyframes, conformal matching, spline morphing.
    Seed,
}

/// A rate of scans or pictures.
pub fn fps(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(f) if (0.001..=1e6).contains(&f) => Ok(f),
        _ => Err("a rate must lie between 0.001 and 1000000 a second".into()),
    }
}

/// A length of a sensible size.
fn millimetres(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if (0.005..=10.0).contains(&v) => Ok(v),
        _ => Err("give millimetres between 0.005 and 10".into()),
    }
}

/// What encoding did.
#[derive(Debug, Default, Serialize)]
struct EncodeReport {
    scans: u64,
    keyframes: u64,
    session_bytes: u64,
    input_bytes: u64,
    percent_of_input: f64,
    encode_ms_per_scan: f64,
    /// What became of given landmarks, over all keyframes.
    landmarks: Option<LandmarkReport>,
    /// What was mended or left out, with the file's name.
    notes: Vec<String>,
}

#[derive(Debug, Default, Serialize)]
struct LandmarkReport {
    /// Given for keyframes.
    given: usize,
    /// Of these, too far from the surface.
    off_surface: usize,
    /// Pairs with the keyframe before.
    paired: usize,
}

impl Encode {
    pub(super) fn run(self) -> Result<Outcome> {
        let folder = ScanFolder::open(&self.input)?;
        let landmarks = self.read_landmarks(&folder)?;
        let config = self.config();
        let period_nanos = config.header().scan_period_nanos;
        let stop = stop_flag()?;
        let mut job = Job::start(&self, &folder, config, landmarks)?;
        let bar = bar(folder.len() as u64, "encode");
        std::thread::scope(|scope| -> Result<()> {
            let (to_encoder, loaded) = sync_channel(READ_AHEAD);
            let folder = &folder;
            scope.spawn(move || {
                for i in 0..folder.len() {
                    // The encoder has gone when the channel is closed: it reports why.
                    if to_encoder.send((i, folder.load(i, period_nanos))).is_err() {
                        return;
                    }
                }
            });
            job.encode_all(folder, &loaded, &stop, || bar.inc(1))
        })?;
        bar.finish_and_clear();
        let report = job.finish(&self, &folder)?;
        Outcome::of(self.json, &report, || self.describe(&report))
    }

    fn config(&self) -> EncoderConfig {
        let period_nanos = (1e9 / self.fps).round() as u64;
        match self.mode {
            ModeArgument::Default => {
                let mut config = ShotConfig::new(period_nanos);
                config.keyframe_interval = self.keyframe_interval;
                config.set_tolerance_mm(self.tolerance_mm);
                config.max_error_mm = self.max_error_mm;
                config.repair.open_closed = self.open_closed;
                EncoderConfig::Shots(config)
            }
            ModeArgument::Seed => {
                let mut config = seed::EncoderConfig::new(period_nanos);
                config.header.keyframe_interval = self.keyframe_interval;
                config.vertex_ratio = self.vertex_ratio;
                config.texture_quality = self.texture_quality;
                config.repair.open_closed = self.open_closed;
                EncoderConfig::Seed(config)
            }
        }
    }

    /// Settings of the mode, as stored in the session.
    fn mode_settings(&self, header: &StreamHeader) -> Result<String> {
        Ok(match self.mode {
            ModeArgument::Default => {
                let bound = self.max_error_mm.map_or_else(String::new, |mm| format!("max_error_mm = {mm:?}\n"));
                format!("tolerance_mm = {:?}\n{bound}", self.tolerance_mm)
            }
            ModeArgument::Seed => format!(
                "vertex_ratio = {}\ntexture_quality = {}\nposition_step_mm = {:?}\n",
                self.vertex_ratio,
                self.texture_quality,
                header.position_step_mm()?
            ),
        })
    }

    fn read_landmarks(&self, folder: &ScanFolder) -> Result<Option<LandmarkTable>> {
        let Some(path) = &self.landmarks else { return Ok(None) };
        if self.mode == ModeArgument::Default {
            bail!("--landmarks: the default mode follows the texture by itself; give --mode seed to use landmarks");
        }
        let table = LandmarkTable::read(path)?;
        if !(0..folder.len()).any(|i| table.has_scan(folder.number(i))) {
            let (first, last) = (folder.number(0), folder.number(folder.len() - 1));
            bail!(
                "{}: no landmark is of a scan in {}, which are numbered {first} to {last}; give the numbers of the file \
                 names in the first column",
                path.display(),
                folder.path().display()
            );
        }
        Ok(Some(table))
    }

    fn describe(&self, report: &EncodeReport) -> String {
        let mut text = format!(
            "{}: {} scans, {} keyframes, {} of {} ({:.3} %), {:.1} ms a scan",
            self.out.display(),
            report.scans,
            report.keyframes,
            human_bytes(report.session_bytes),
            human_bytes(report.input_bytes),
            report.percent_of_input,
            report.encode_ms_per_scan
        );
        if let Some(LandmarkReport { given, off_surface, paired }) = report.landmarks {
            text.push_str(&format!(
                "\n  landmarks on keyframes: {given} given, {off_surface} of them off the surface, {paired} pairs"
            ));
        }
        for note in &report.notes {
            text.push_str("\n  ");
            text.push_str(note);
        }
        text
    }
}

/// An encoding under way.
struct Job {
    encoder: Encoder,
    writer: SessionWriter<AtomicFile>,
    landmarks: Option<LandmarkTable>,
    report: EncodeReport,
    events: Vec<Event>,
    time: Duration,
    binary_bytes: u64,
}

type Loaded = (usize, Result<LoadedScan, crate::files::FileError>);

impl Job {
    fn start(
        command: &Encode,
        folder: &ScanFolder,
        config: EncoderConfig,
        landmarks: Option<LandmarkTable>,
    ) -> Result<Self> {
        let created = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
        let metadata = session_metadata(&config, created);
        let encoder = Encoder::new(config)?;
        let header = encoder.header();
        let settings = format!(
            "fps = {:?}\nkeyframe_interval = {}\nmode = \"{}\"\n{}",
            command.fps,
            command.keyframe_interval,
            header.mode.name(),
            command.mode_settings(&header)?
        );
        let metadata = metadata.with_configuration(&settings);
        let mut writer = SessionWriter::create(AtomicFile::create(&command.out, command.force)?, &metadata)?;
        writer.write_stream(&header.encode())?;
        let report = EncodeReport { input_bytes: folder.raw_bytes(), ..Default::default() };
        let report = EncodeReport { landmarks: landmarks.as_ref().map(|_| LandmarkReport::default()), ..report };
        Ok(Self { encoder, writer, landmarks, report, events: Vec::new(), time: Duration::ZERO, binary_bytes: 0 })
    }

    fn encode_all(
        &mut self,
        folder: &ScanFolder,
        loaded: &Receiver<Loaded>,
        stop: &AtomicBool,
        step: impl Fn(),
    ) -> Result<()> {
        while let Ok((i, scan)) = loaded.recv() {
            // Ended here, the half-written file is removed.
            if stop.load(Ordering::Relaxed) {
                bail!("stopped; nothing is written");
            }
            let LoadedScan { scan, repairs } = scan?;
            self.note_repairs(&folder.name(i), &repairs);
            self.binary_bytes += binary_bytes(&scan);
            let given = match &self.landmarks {
                Some(table) => table.of_scan(folder.number(i), &scan.mesh)?,
                None => Vec::new(),
            };
            self.push(&folder.name(i), scan, &given)?;
            step();
        }
        Ok(())
    }

    fn push(&mut self, name: &str, scan: Scan, given: &[GivenLandmark]) -> Result<()> {
        let (tick, time_nanos) = (scan.tick, scan.time_nanos);
        let begin = Instant::now();
        let pushed = self.encoder.push_with_landmarks(scan, given);
        self.time += begin.elapsed();
        let Pushed { group, repair, not_key } = match pushed {
            Ok(pushed) => pushed,
            // A run cannot begin with a scan that is no surface; inside it one is left out and said so.
            Err(CodecError::Mesh(reason)) if self.report.keyframes > 0 => {
                self.note(tick, time_nanos, format!("{name}: left out: {reason}"));
                return Ok(());
            }
            Err(error) => return Err(error).with_context(|| name.to_string()),
        };
        if let Some(repair) = repair {
            self.report.notes.push(format!("{name}: {repair}"));
        }
        if let Some(error) = not_key {
            self.note(tick, time_nanos, format!("{name}: no keyframe, the next scan is tried: {error}"));
        }
        self.write(group)
    }

    fn note(&mut self, tick: u64, time_nanos: u64, message: String) {
        let kind = EventKind::Fault { source: "encode".into(), message: message.clone() };
        self.events.push(Event { time_nanos, tick, kind });
        self.report.notes.push(message);
    }

    fn note_repairs(&mut self, name: &str, repairs: &Repairs) {
        if !repairs.is_clean() {
            self.report.notes.push(format!("{name}: {repairs}"));
        }
    }

    fn write(&mut self, group: Option<EncodedGroup>) -> Result<()> {
        let Some(group) = group else { return Ok(()) };
        if let Some(report) = &mut self.report.landmarks {
            let counts = group.landmarks;
            report.given += counts.given;
            report.off_surface += counts.off_surface;
            report.paired += counts.paired;
            if counts.off_surface > 0 {
                self.report.notes.push(format!(
                    "keyframe at tick {}: {} of {} landmarks lie more than {MAX_GIVEN_OFFSET_MM} mm off the surface, \
                     left out",
                    group.key.tick, counts.off_surface, counts.given
                ));
            }
        }
        write_group(&mut self.writer, &group, &self.events)?;
        self.events.clear();
        self.report.scans += group.scans as u64;
        self.report.keyframes += 1;
        Ok(())
    }

    fn finish(mut self, command: &Encode, folder: &ScanFolder) -> Result<EncodeReport> {
        let begin = Instant::now();
        let encoder = std::mem::replace(&mut self.encoder, Encoder::new(EncoderConfig::new(1))?);
        let last = encoder.finish().context("the last scan cannot be a keyframe")?;
        self.time += begin.elapsed();
        self.write(last)?;
        if self.report.scans == 0 {
            bail!("{}: no scan could be coded", folder.path().display());
        }
        self.report.encode_ms_per_scan = self.time.as_secs_f64() * 1e3 / self.report.scans as f64;
        for event in &self.events {
            self.writer.write_event(event)?;
        }
        let statistics = MetadataGroup::new()
            .with(key::SCANS, self.report.scans)
            .with(key::KEYFRAMES, self.report.keyframes)
            .with(key::ENCODE_MS_PER_SCAN, format!("{:.3}", self.report.encode_ms_per_scan))
            .with(key::RAW_OBJ_BMP_BYTES, self.report.input_bytes)
            .with(key::RAW_BINARY_BYTES, self.binary_bytes);
        self.writer.finish(&statistics)?.commit()?;
        self.report.session_bytes = std::fs::metadata(&command.out)?.len();
        self.report.percent_of_input = 100.0 * self.report.session_bytes as f64 / self.report.input_bytes as f64;
        Ok(self.report)
    }
}
