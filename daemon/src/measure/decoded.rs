//! What is judged: a session's outputs, or anything else that gives scans at the ticks of its input.

use super::MeasureError;
use crate::replay::{Replay, ReplayStamp};
use gv3_codec::{Mode, Scan};
use serde::{Deserialize, Serialize};

/// Decoded scans.
pub trait Decoded: Send {
    /// Scans in time order.
    fn stamps(&self) -> &[ReplayStamp];
    /// Nanoseconds of one tick.
    fn period_nanos(&self) -> u64;
    /// Decodes the scan of a stamp; asked for in time order, each once.
    ///
    /// # Errors
    /// [`MeasureError`] when it cannot be decoded.
    fn scan(&mut self, stamp: &ReplayStamp) -> Result<Scan, MeasureError>;
}

/// An output of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Output {
    /// Each scan as it was seen: the camera's pixels, holes and all.
    Scan,
    /// The tracked mesh, with one connectivity as long as the codec keeps it.
    Mesh,
}

impl Output {
    /// Outputs of sessions in a mode, the usual one first.
    pub fn of(mode: Mode) -> &'static [Self] {
        match mode {
            Mode::Seed { .. } => &[Self::Mesh],
            Mode::Shots(_) => &[Self::Scan, Self::Mesh],
        }
    }

    /// What a player is to show.
    pub fn played(self) -> gv3_codec::Output {
        match self {
            Self::Scan => gv3_codec::Output::Scan,
            Self::Mesh => gv3_codec::Output::Mesh,
        }
    }
}

/// One output of a session.
pub struct SessionOutput<'a> {
    replay: &'a mut Replay,
    output: Output,
}

impl<'a> SessionOutput<'a> {
    /// The output `wanted`, or the usual one.
    ///
    /// # Errors
    /// [`MeasureError::Mismatch`] when sessions of this mode have no such output.
    pub fn new(replay: &'a mut Replay, wanted: Option<Output>) -> Result<Self, MeasureError> {
        let mode = replay.header().mode;
        let outputs = Output::of(mode);
        let output = wanted.unwrap_or(outputs[0]);
        if !outputs.contains(&output) {
            let reason = format!("a session of mode {} has no output {output:?}; it has {outputs:?}", mode.name());
            return Err(MeasureError::Mismatch(reason.to_lowercase()));
        }
        replay.show(output.played())?;
        Ok(Self { replay, output })
    }

    /// Which output it is.
    pub fn output(&self) -> Output {
        self.output
    }

    /// The session.
    pub fn replay(&self) -> &Replay {
        self.replay
    }
}

impl Decoded for SessionOutput<'_> {
    fn stamps(&self) -> &[ReplayStamp] {
        self.replay.stamps()
    }
    fn period_nanos(&self) -> u64 {
        self.replay.header().scan_period_nanos
    }
    fn scan(&mut self, stamp: &ReplayStamp) -> Result<Scan, MeasureError> {
        Ok(self.replay.scan_at(stamp.time_nanos)?)
    }
}
