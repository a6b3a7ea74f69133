//! The clock and the decoder of one replay.

use super::mesh_message::MeshMessages;
use super::scalars::{ScalarKind, Scalars};
use crate::measure::Output;
use crate::store::SessionPlayer;
use glam::Vec3;
use gv3_codec::Scan;
use gv3_codec::mesh::Bvh;
use serde::Deserialize;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc::Sender;

/// Messages on their way at one time.
pub const MAX_UNACKNOWLEDGED: u32 = 4;
/// Longest step of the clock between two pictures: a viewer that stalled goes on where it was.
const MAX_STEP: Duration = Duration::from_millis(250);
const FPS_LIMITS: (f64, f64) = (0.1, 120.0);
const SPEED_LIMIT: f64 = 100.0;
/// Farther than this from the other output, a distance is shown as this much, mm.
const MAX_ERROR_MM: f32 = 5.0;

/// What a viewer asks for; any of the fields.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Command {
    /// Shows this moment, seconds after the first scan.
    pub seek_seconds: Option<f64>,
    /// Speed from now on: 1 as it was, negative backwards, 0 stops.
    pub play: Option<f64>,
    /// Whether to begin again at the end.
    pub r#loop: Option<bool>,
    /// Pictures a second.
    pub fps: Option<f64>,
    /// The number shown with every vertex.
    pub scalars: Option<ScalarKind>,
    /// All messages up to this number have been taken.
    pub ack: Option<u32>,
}

/// State of one replay.
pub struct Playback {
    player: SessionPlayer,
    files: Vec<PathBuf>,
    /// What errors are measured against, opened when they are asked for.
    other: Option<(Output, Option<SessionPlayer>)>,
    messages: MeshMessages,
    at_seconds: f64,
    speed: f64,
    is_loop: bool,
    period: Duration,
    scalars: ScalarKind,
    acknowledged: u32,
    /// Something to show whatever the clock says.
    is_dirty: bool,
    shown: Instant,
}

impl Playback {
    /// Paused at the first scan.
    pub fn new(player: SessionPlayer, files: Vec<PathBuf>, max_vertices: usize) -> Self {
        let other = player.outputs().iter().find(|o| **o != player.output());
        Self {
            files,
            other: other.map(|o| (*o, None)),
            messages: MeshMessages::new(max_vertices, player.output() == Output::Mesh),
            player,
            at_seconds: 0.0,
            speed: 0.0,
            is_loop: false,
            period: Duration::from_secs_f64(1.0 / 30.0),
            scalars: ScalarKind::None,
            acknowledged: 0,
            is_dirty: true,
            shown: Instant::now(),
        }
    }

    /// Does what is asked; values out of range are brought into it.
    pub fn apply(&mut self, command: &Command, now: Instant) {
        if let Some(seconds) = command.seek_seconds.filter(|s| s.is_finite()) {
            (self.at_seconds, self.is_dirty) = (seconds.clamp(0.0, self.player.seconds()), true);
            self.shown = now;
        }
        if let Some(speed) = command.play.filter(|s| s.is_finite()) {
            if self.speed == 0.0 {
                self.shown = now;
            }
            self.speed = speed.clamp(-SPEED_LIMIT, SPEED_LIMIT);
        }
        if let Some(fps) = command.fps.filter(|f| f.is_finite()) {
            self.period = Duration::from_secs_f64(1.0 / fps.clamp(FPS_LIMITS.0, FPS_LIMITS.1));
        }
        if let Some(scalars) = command.scalars {
            (self.scalars, self.is_dirty) = (scalars, true);
        }
        self.is_loop = command.r#loop.unwrap_or(self.is_loop);
        let on_way = self.messages.sequence().wrapping_sub(self.acknowledged);
        // Only of what was sent; an older number says nothing new.
        let taken = command.ack.map_or(0, |ack| ack.wrapping_sub(self.acknowledged));
        if taken <= on_way {
            self.acknowledged = self.acknowledged.wrapping_add(taken);
        }
    }

    /// How long nothing is to be shown; `None` until a command comes.
    pub fn wait(&self, now: Instant) -> Option<Duration> {
        if self.messages.sequence().wrapping_sub(self.acknowledged) >= MAX_UNACKNOWLEDGED {
            None
        } else if self.is_dirty {
            Some(Duration::ZERO)
        } else {
            let is_playing = self.speed != 0.0;
            is_playing.then(|| (self.shown + self.period).saturating_duration_since(now))
        }
    }

    /// Moves the clock on and makes the message of that moment.
    ///
    /// # Errors
    /// In words: the session cannot be decoded there.
    pub fn show(&mut self, now: Instant) -> Result<Vec<u8>, String> {
        if !self.is_dirty {
            self.advance(now.saturating_duration_since(self.shown).min(MAX_STEP));
        }
        (self.is_dirty, self.shown) = (false, now);
        let time_nanos = self.player.first_nanos() + (self.at_seconds * 1e9).round() as u64;
        let scan = self.player.scan_at(time_nanos).map_err(|e| e.to_string())?;
        let scalars = self.scalars_of(&scan, time_nanos)?;
        Ok(self.messages.encode(&scan, self.at_seconds, |kept| scalars.map(|s| s.of(&scan, kept))))
    }

    fn advance(&mut self, step: Duration) {
        let length = self.player.seconds();
        let at = self.at_seconds + self.speed * step.as_secs_f64();
        if (0.0..=length).contains(&at) {
            self.at_seconds = at;
        } else if self.is_loop && length > 0.0 {
            self.at_seconds = at.rem_euclid(length);
        } else {
            (self.at_seconds, self.speed) = (at.clamp(0.0, length), 0.0);
        }
    }

    fn scalars_of(&mut self, scan: &Scan, time_nanos: u64) -> Result<Option<ScalarSource>, String> {
        match self.scalars {
            ScalarKind::None => Ok(None),
            ScalarKind::Depth => Ok(Some(ScalarSource::Depth)),
            ScalarKind::Motion if self.player.output() == Output::Mesh => {
                let before = time_nanos.saturating_sub(self.player.period_nanos()).max(self.player.first_nanos());
                let earlier = self.player.scan_at(before).map_err(|e| e.to_string())?.mesh;
                let is_same = earlier.triangles == scan.mesh.triangles;
                Ok(is_same.then_some(ScalarSource::Motion(earlier.positions_mm)))
            }
            ScalarKind::Motion => Ok(None),
            ScalarKind::Error => {
                let Some((output, player)) = &mut self.other else { return Ok(None) };
                if player.is_none() {
                    *player = Some(SessionPlayer::open(&self.files, Some(*output)).map_err(|e| e.to_string())?);
                }
                let other = player.as_mut().map(|p| p.scan_at(time_nanos)).transpose().map_err(|e| e.to_string())?;
                Ok(other.map(|other| ScalarSource::Error(Bvh::new(&other.mesh))))
            }
        }
    }
}

/// Where a vertex's number comes from.
enum ScalarSource {
    Depth,
    Motion(Vec<Vec3>),
    Error(Bvh),
}

impl ScalarSource {
    fn of(&self, scan: &Scan, kept: &[u32]) -> Scalars {
        let positions = kept.iter().map(|&v| (v as usize, scan.mesh.positions_mm[v as usize]));
        match self {
            Self::Depth => Scalars::depths(scan, kept),
            Self::Motion(earlier) => {
                Scalars::from_zero(ScalarKind::Motion, positions.map(|(v, p)| p.distance(earlier[v])).collect())
            }
            Self::Error(other) => {
                let distance = |p| other.nearest(p, MAX_ERROR_MM).map_or(MAX_ERROR_MM, |n| n.distance2_mm2.sqrt());
                Scalars::from_zero(ScalarKind::Error, positions.map(|(_, p)| distance(p)).collect())
            }
        }
    }
}

/// Plays until the viewer is gone.
///
/// # Errors
/// As [`Playback::show`].
pub fn play(
    playback: &mut Playback,
    commands: &Receiver<Command>,
    messages: &Sender<Result<Vec<u8>, String>>,
) -> Result<(), String> {
    loop {
        let next = match playback.wait(Instant::now()) {
            Some(wait) => commands.recv_timeout(wait),
            None => commands.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        match next {
            // All that wait, before anything is decoded: of a dragged slider only the last place counts.
            Ok(command) => std::iter::once(command)
                .chain(commands.try_iter())
                .for_each(|command| playback.apply(&command, Instant::now())),
            Err(RecvTimeoutError::Timeout) => {
                let message = playback.show(Instant::now())?;
                if messages.blocking_send(Ok(message)).is_err() {
                    return Ok(());
                }
            }
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        }
    }
}
