//! `gv3 bench seek`: moments at random out of sessions that were just opened.

use crate::cli::Outcome;
use crate::cli::progress::bar;
use crate::measure::Output;
use crate::replay::Moments;
use anyhow::{Context, Result, bail};
use clap::Args;
use gv3_codec::StreamHeader;
use gv3_codec::bits::bytes::{ByteReader, put_varint};
use gv3_protocol::session::{GroupRecord, MetadataGroup, SessionMetadata, SessionReader, SessionWriter, SyncData};
use serde::Serialize;
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Ask a session for moments at random, each time as if it had just been opened, and print how long it took from opening the
/// file to the scan with its texture.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  gv3 bench seek smile.gv3\n  gv3 bench seek smile.gv3 --seconds 3600 --as mesh")]
pub(super) struct BenchSeek {
    /// Session to open.
    session: PathBuf,
    /// What to show.
    #[arg(long = "as", value_enum, default_value = "scan")]
    output: Output,
    /// Moments to ask for.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..))]
    moments: u32,
    /// Repeat the session in a temporary file until it is this long first.
    #[arg(long, value_parser = crate::cli::capture::seconds)]
    seconds: Option<f64>,
    /// Report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct SeekReport {
    seconds: f64,
    bytes: u64,
    groups: usize,
    moments: u32,
    median_ms: f64,
    p95_ms: f64,
    longest_ms: f64,
}

impl BenchSeek {
    pub(super) fn run(self) -> Result<Outcome> {
        let made = self.seconds.map(|seconds| repeated(&self.session, seconds)).transpose()?;
        let path = made.as_ref().map_or(self.session.as_path(), |file| file.path());
        let (groups, bytes) = (SessionReader::open(path)?.groups().to_vec(), std::fs::metadata(path)?.len());
        let [first, last] = [groups.first(), groups.last()].map(|g| g.map_or(0, |g| g.time_nanos));
        let bar = bar(u64::from(self.moments), "seek");
        let mut times_ms = Vec::new();
        for i in 0..self.moments {
            // The golden ratio spreads them evenly, whatever their number.
            let at = first + ((last - first) as f64 * (f64::from(i) * 0.618_033_988_749_895).fract()) as u64;
            let begin = Instant::now();
            let scan = Moments::open(path, self.output.played())?.scan_at(at)?;
            times_ms.push(begin.elapsed().as_secs_f64() * 1e3);
            drop(scan);
            bar.inc(1);
        }
        bar.finish_and_clear();
        times_ms.sort_by(f64::total_cmp);
        let at = |share: f64| times_ms[((times_ms.len() - 1) as f64 * share).round() as usize];
        let report = SeekReport {
            seconds: (last - first) as f64 * 1e-9,
            bytes,
            groups: groups.len(),
            moments: self.moments,
            median_ms: at(0.5),
            p95_ms: at(0.95),
            longest_ms: at(1.0),
        };
        Outcome::of(self.json, &report, || report.text())
    }
}

impl SeekReport {
    fn text(&self) -> String {
        let Self { seconds, bytes, groups, moments, median_ms, p95_ms, longest_ms } = self;
        format!(
            "{seconds:.0} s in {groups} groups, {:.1} MB; {moments} moments from opening the file on:\n  \
             median {median_ms:.0} ms, 95 % within {p95_ms:.0} ms, longest {longest_ms:.0} ms\n",
            *bytes as f64 * 1e-6
        )
    }
}

/// The session's groups again and again, a period after one another, in a temporary file.
fn repeated(session: &Path, seconds: f64) -> Result<tempfile::NamedTempFile> {
    let mut reader = SessionReader::open(session)?;
    let streams = reader.streams().len();
    if streams != 1 {
        bail!("{}: {streams} runs; a session of one run can be repeated", session.display());
    }
    let header = StreamHeader::decode(&reader.read_stream(0)?)?;
    let mut groups = Vec::new();
    for i in 0..reader.groups().len() {
        groups.push(reader.read_group(i)?);
    }
    let (Some(first), Some(last)) = (groups.first(), groups.last()) else {
        bail!("{}: no complete group", session.display());
    };
    let ticks = last.entry.key_tick + 1 - first.entry.first_tick;
    let times = (seconds * 1e9 / (ticks * header.scan_period_nanos) as f64).ceil() as u64;
    let file = tempfile::NamedTempFile::new()?;
    let metadata = SessionMetadata::new(header.mode.name(), "gv3 bench", 0);
    let mut writer = SessionWriter::create(Unsynced(file.reopen()?), &metadata)?;
    writer.write_stream(&header.encode())?;
    for shift in (0..times).map(|k| k * ticks) {
        for group in &groups {
            writer.write_group(GroupRecord {
                first_tick: group.entry.first_tick + shift,
                key_tick: group.entry.key_tick + shift,
                time_nanos: group.entry.time_nanos + shift * header.scan_period_nanos,
                geometry: &shifted(&group.geometry, shift).with_context(|| session.display().to_string())?,
                texture: group.texture.as_deref(),
                events: &[],
            })?;
        }
    }
    writer.finish(&MetadataGroup::new())?;
    Ok(file)
}

/// A group's payload with all ticks later: the first is absolute, the others follow it.
fn shifted(payload: &[u8], ticks: u64) -> Result<Vec<u8>> {
    let mut reader = ByteReader::new(payload, "group");
    let (count, first) = (reader.varint()?, reader.varint()?);
    let mut out = Vec::with_capacity(payload.len() + 8);
    put_varint(&mut out, count);
    put_varint(&mut out, first + ticks);
    out.extend_from_slice(reader.take(reader.remaining())?);
    Ok(out)
}

/// A file that nobody needs after a power cut.
struct Unsynced(File);

impl Write for Unsynced {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

impl Seek for Unsynced {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.0.seek(to)
    }
}

impl SyncData for Unsynced {
    fn sync_data(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gv3_codec::decode_stamps;
    use gv3_codec::shot::encoder::ShotConfig;

    #[test]
    fn all_stamps_of_a_group_are_shifted_and_the_rest_stays() {
        let header = ShotConfig::new(1000).header();
        let group = [2, 5, 4, 3, 0, 77, 88];
        let later = shifted(&group, 300).unwrap();
        assert_eq!(later[..1], group[..1]);
        assert_eq!(later[3..], group[2..], "one byte more for a tick above 127");
        let (before, after) = (decode_stamps(&header, &group).unwrap(), decode_stamps(&header, &later).unwrap());
        assert_eq!(before.iter().map(|s| (s.tick, s.time_nanos)).collect::<Vec<_>>(), [(5, 5002), (8, 8000)]);
        assert_eq!(after.iter().map(|s| (s.tick, s.time_nanos)).collect::<Vec<_>>(), [(305, 305_002), (308, 308_000)]);
        assert!(shifted(&group[..1], 1).is_err());
    }
}
