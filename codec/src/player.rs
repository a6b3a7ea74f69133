//! Plays a run of groups of either mode at any time.

use crate::{CodecError, Mode, Result, Scan, StreamHeader, seed, shot};

/// Gives the payloads of a group by index.
pub type Fetch<'a, E> = &'a mut dyn FnMut(usize) -> std::result::Result<Payloads, E>;

/// Payloads of a group: geometry, and texture if there is one.
pub type Payloads = (Vec<u8>, Option<Vec<u8>>);

/// What a player shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Output {
    /// Each scan as it was seen, on the pixels of its camera.
    #[default]
    Scan,
    /// The tracked mesh, with one connectivity a shot.
    Mesh,
}

/// Decoder of one run.
pub enum Player {
    /// Of the seed mode, which has one output.
    Seed(Box<seed::Player>),
    /// Of the default mode.
    Shots(Box<shot::player::Player>),
}

impl Player {
    /// A player of the groups whose keyframes have these times (increasing).
    ///
    /// # Errors
    /// [`CodecError::Stream`] without keyframes or when times do not increase.
    pub fn new(header: StreamHeader, key_times_nanos: Vec<u64>, output: Output) -> Result<Self> {
        Ok(match header.mode {
            Mode::Seed { .. } => Self::Seed(Box::new(seed::Player::new(header, key_times_nanos)?)),
            Mode::Shots(_) => Self::Shots(Box::new(shot::player::Player::new(header, key_times_nanos, output)?)),
        })
    }

    /// The scan at a time, held at the ends of the run. `fetch` gives the payloads (group, texture) of a group by index.
    ///
    /// # Errors
    /// What `fetch` returns, and the codec's own errors for payloads that do not fit.
    pub fn scan_at<E: From<CodecError>>(
        &mut self,
        time_nanos: u64,
        fetch: Fetch<'_, E>,
    ) -> std::result::Result<Scan, E> {
        match self {
            Self::Seed(player) => player.scan_at(time_nanos, fetch),
            Self::Shots(player) => player.scan_at(time_nanos, fetch),
        }
    }
}
