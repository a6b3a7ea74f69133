//! A run of scans through the encoder, and back through the player.

use gv3::pipeline::record::write_group;
use gv3_codec::{CodecError, EncodedGroup, Encoder, EncoderConfig, Output, Player, Pushed, Scan, StreamHeader};
use gv3_protocol::AtomicFile;
use gv3_protocol::session::{MetadataGroup, SessionMetadata, SessionWriter};
use std::path::Path;

/// What an encoder made of a run of scans.
#[derive(Debug)]
pub struct CodedRun {
    /// Stream header.
    pub header: StreamHeader,
    /// Groups in time order.
    pub groups: Vec<EncodedGroup>,
    /// Ticks at which a keyframe was due but the scan could not be one.
    pub not_key: Vec<u64>,
}

impl CodedRun {
    /// Codes scans.
    ///
    /// # Errors
    /// The encoder's.
    pub fn new(config: EncoderConfig, scans: impl IntoIterator<Item = Scan>) -> Result<Self, CodecError> {
        let mut encoder = Encoder::new(config)?;
        let mut run = Self { header: encoder.header(), groups: Vec::new(), not_key: Vec::new() };
        for scan in scans {
            let tick = scan.tick;
            let Pushed { group, not_key, .. } = encoder.push(scan)?;
            run.groups.extend(group);
            run.not_key.extend(not_key.map(|_| tick));
        }
        run.groups.extend(encoder.finish()?);
        Ok(run)
    }

    /// Ticks of the keyframes.
    pub fn key_ticks(&self) -> Vec<u64> {
        self.groups.iter().map(|g| g.key.tick).collect()
    }

    /// The scan at a time, as a player shows it.
    ///
    /// # Errors
    /// The player's.
    pub fn play(&self, player: &mut Player, time_nanos: u64) -> Result<Scan, CodecError> {
        player.scan_at(time_nanos, &mut |i| Ok((self.groups[i].geometry.clone(), self.groups[i].texture.clone())))
    }

    /// A player of the run.
    ///
    /// # Errors
    /// The player's.
    pub fn player(&self) -> Result<Player, CodecError> {
        self.player_of(Output::Scan)
    }

    /// A player of one of the run's outputs.
    ///
    /// # Errors
    /// The player's.
    pub fn player_of(&self, output: Output) -> Result<Player, CodecError> {
        Player::new(self.header, self.groups.iter().map(|g| g.key.time_nanos).collect(), output)
    }

    /// Writes the run as a session.
    ///
    /// # Errors
    /// The writer's.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let metadata = SessionMetadata::new(self.header.mode.name(), "gv3-tests", 0);
        let mut writer = SessionWriter::create(AtomicFile::create(path, false)?, &metadata)?;
        writer.write_stream(&self.header.encode())?;
        for group in &self.groups {
            write_group(&mut writer, group, &[])?;
        }
        Ok(writer.finish(&MetadataGroup::new())?.commit()?)
    }
}
