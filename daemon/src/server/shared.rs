//! What all requests share.

use super::counters::Counters;
use super::guard::Guard;
use super::jobs::Jobs;
use super::live_mesh::LiveMeshes;
use super::live_picture::LivePictures;
use super::problem::Problem;
use super::thumbnail::Thumbnails;
use crate::live::{Live, LiveConfig};
use crate::store::{SessionDirectory, SessionName};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Semaphore, watch};

/// WebSockets open at one time.
pub const MAX_SOCKETS: usize = 320;
/// Replays at one time: each has a decoder and a thread.
pub const MAX_REPLAYS: usize = 8;
/// Longest that a call of the engine or the disk is waited for.
const CALL_LIMIT: Duration = Duration::from_secs(60);

/// Reads the configuration anew.
pub type ReadConfig = Arc<dyn Fn() -> anyhow::Result<LiveConfig> + Send + Sync>;

/// State of the server.
pub struct Shared {
    /// The engine.
    pub live: Live,
    /// Sessions.
    pub directory: Arc<SessionDirectory>,
    /// Long work on sessions.
    pub jobs: Jobs,
    /// Who may ask.
    pub guard: Guard,
    /// What was asked.
    pub counters: Counters,
    /// The configuration's file.
    pub read_config: ReadConfig,
    /// Places for WebSockets.
    pub sockets: Arc<Semaphore>,
    /// Places for replays.
    pub replays: Arc<Semaphore>,
    /// Live surfaces coded for viewers.
    pub meshes: LiveMeshes,
    /// Pictures of sessions.
    pub thumbnails: Thumbnails,
    /// Live pictures coded for viewers.
    pub pictures: LivePictures,
    /// Newest status as JSON, twice a second.
    pub status_text: watch::Receiver<Arc<str>>,
    /// Becomes true when the server stops.
    pub stopping: watch::Receiver<bool>,
}

/// The state as handlers take it.
pub type State = axum::extract::State<Arc<Shared>>;

impl Shared {
    /// The session being recorded.
    pub fn recording(&self) -> Option<SessionName> {
        recording_of(&self.live)
    }

    /// Runs what blocks beside the server's own threads.
    ///
    /// # Errors
    /// The work's own problem, or that it takes too long.
    pub async fn blocking<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Self) -> Result<T, Problem> + Send + 'static,
    ) -> Result<T, Problem> {
        let shared = Arc::clone(self);
        let task = tokio::task::spawn_blocking(move || work(&shared));
        match tokio::time::timeout(CALL_LIMIT, task).await {
            Ok(joined) => joined?,
            Err(_) => Err(Problem::internal("no answer within 60 s; the log may say why")),
        }
    }
}

/// Name of the session that an engine records.
pub fn recording_of(live: &Live) -> Option<SessionName> {
    live.status().recording.and_then(|r| SessionName::new(&r.session).ok())
}
