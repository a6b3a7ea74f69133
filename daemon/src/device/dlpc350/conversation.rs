//! Requests with their answers, over a cable that loses, delays and garbles.

use super::link::{HidLink, LinkError};
use gv3_protocol::dlpc350::{Dlpc350Error, Register, Reply, Request};
use std::time::{Duration, Instant};
use tracing::debug;

/// How long the projector may take to answer; TI's own software waits as long.
const REPLY_TIMEOUT: Duration = Duration::from_secs(2);
/// How often a request is sent. All requests are reads or set a value, so one that was done already does no harm.
const ATTEMPTS: u32 = 2;

/// Why a request was not done.
#[derive(Debug, thiserror::Error)]
pub(super) enum TalkError {
    #[error("{name}: {source}")]
    Link { name: &'static str, source: LinkError },
    #[error("{0}: refused by the projector")]
    Refused(&'static str),
    #[error(transparent)]
    Protocol(#[from] Dlpc350Error),
}

/// The host's side of the cable.
pub(super) struct Conversation {
    link: Box<dyn HidLink>,
    sequence: u8,
}

impl Conversation {
    pub(super) fn new(link: Box<dyn HidLink>) -> Self {
        Self { link, sequence: 0 }
    }

    /// Sets a register and waits for the acknowledgement.
    pub(super) fn write<R: Register>(&mut self, value: &R) -> Result<(), TalkError> {
        self.ask(R::NAME, |sequence| Request::write(sequence, value)).map(drop)
    }

    /// Reads a register.
    pub(super) fn read<R: Register>(&mut self) -> Result<R, TalkError> {
        let data = self.ask(R::NAME, Request::read::<R>)?;
        Ok(R::decode(&data)?)
    }

    /// Lets time pass for the projector.
    pub(super) fn pause(&mut self, time: Duration) {
        self.link.pause(time);
    }

    fn ask(&mut self, name: &'static str, request: impl Fn(u8) -> Request) -> Result<Vec<u8>, TalkError> {
        let mut attempt = 1;
        loop {
            self.sequence = self.sequence.wrapping_add(1);
            let request = request(self.sequence);
            match self.send(&request) {
                Ok(Reply { is_nack: true, .. }) => return Err(TalkError::Refused(name)),
                Ok(reply) => return Ok(reply.data),
                Err(TalkError::Link { source: LinkError::Timeout(_), .. }) if attempt < ATTEMPTS => attempt += 1,
                Err(TalkError::Link { source, .. }) => return Err(TalkError::Link { name, source }),
                Err(other) => return Err(other),
            }
        }
    }

    fn send(&mut self, request: &Request) -> Result<Reply, TalkError> {
        let link_error = |source| TalkError::Link { name: "", source };
        for report in request.reports()? {
            self.link.write_report(&report).map_err(link_error)?;
        }
        let deadline = Instant::now() + REPLY_TIMEOUT;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let report = self.link.read_report(left).map_err(|e| match e {
                LinkError::Timeout(_) => link_error(LinkError::Timeout(REPLY_TIMEOUT)),
                other => link_error(other),
            })?;
            match Reply::parse(&report) {
                Ok(reply) if reply.answers(request) => return Ok(reply),
                Ok(reply) => debug!("an answer to request {} instead of {}", reply.sequence, request.sequence),
                Err(error) => debug!("a report that is no answer: {error}"),
            }
        }
    }
}
