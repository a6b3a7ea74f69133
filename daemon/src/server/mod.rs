//! The server of `gv3 serve`: control, sessions, live streams, replay, metrics and the page, over HTTP and WebSockets.
//!
//! `openapi.json` describes it all. Nothing a client does can hold up the capture: streams show the newest and skip the
//! rest, long work has one thread of low priority, and numbers and sizes of everything are bounded.

mod byte_range;
mod connection;
mod counters;
mod decimate;
mod guard;
mod input;
mod job_work;
mod jobs;
mod latest;
mod live_events;
mod live_groups;
mod live_mesh;
mod live_picture;
mod mesh_message;
mod metrics;
mod notify;
mod pace;
mod pages;
mod patient;
mod playback;
mod problem;
mod rate;
mod replay;
mod reports;
mod routes;
mod scalars;
mod scanner;
mod sessions;
mod shared;
mod socket;
mod thumbnail;
mod token;
mod upkeep;
mod zip;

#[cfg(test)]
mod tests;

pub use notify::Notify;
pub use shared::ReadConfig;
pub use token::{Token, TokenError};

use crate::live::Live;
use crate::store::SessionDirectory;
use counters::Counters;
use guard::Guard;
use jobs::Jobs;
use shared::{MAX_REPLAYS, MAX_SOCKETS, Shared};
use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use tokio::net::TcpListener;
use tokio::sync::{Notify as Wakeup, Semaphore, watch};

/// Where and for whom the server is.
#[derive(Debug, Clone)]
pub struct ServerConfig {
    /// Address; port 0 takes a free one.
    pub listen: SocketAddr,
    /// What clients must show; needed when the address is not a loopback one.
    pub token: Option<Token>,
    /// Host names besides this machine's own under which it is reached.
    pub hosts: Vec<String>,
}

/// Why the server does not start, or how it ended.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// Others could reach it without a token.
    #[error(
        "{0} can be reached from other machines, and whoever reaches it controls the scanner and reads every session: \
         give clients a secret (--token-file FILE; `gv3 serve --new-token FILE` makes one), or listen on 127.0.0.1"
    )]
    NoToken(SocketAddr),
    /// The address cannot be used.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's answer.
        source: std::io::Error,
    },
    /// The session directory cannot be used for jobs.
    #[error("cannot prepare the session directory: {0}")]
    Jobs(std::io::Error),
    /// The engine's last words.
    #[error("the scanner did not stop cleanly: {0}")]
    Engine(String),
}

/// A server that listens.
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    shared: Arc<Shared>,
    status: watch::Sender<Arc<str>>,
    stop: watch::Sender<bool>,
    notify: Arc<Notify>,
    reload: Arc<Wakeup>,
}

impl Server {
    /// Listens; nothing is answered yet.
    ///
    /// # Errors
    /// [`ServerError`]: no token for an address that others reach, the address is taken, or the directory refuses.
    pub async fn bind(
        config: ServerConfig,
        live: Live,
        directory: SessionDirectory,
        read_config: ReadConfig,
        notify: Notify,
    ) -> Result<Self, ServerError> {
        let ServerConfig { listen, token, hosts } = config;
        if !listen.ip().is_loopback() && token.is_none() {
            return Err(ServerError::NoToken(listen));
        }
        let failed = |source| ServerError::Listen { address: listen, source };
        let listener = TcpListener::bind(listen).await.map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let (status, status_text) = watch::channel(Arc::from("null"));
        let (stop, stopping) = watch::channel(false);
        let jobs = Jobs::start(directory.path()).map_err(ServerError::Jobs)?;
        let shared = Shared {
            live,
            directory: Arc::new(directory),
            jobs,
            guard: Guard::new(address, token, &hosts),
            counters: Counters::default(),
            read_config,
            sockets: Arc::new(Semaphore::new(MAX_SOCKETS)),
            replays: Arc::new(Semaphore::new(MAX_REPLAYS)),
            meshes: Default::default(),
            thumbnails: Default::default(),
            pictures: Default::default(),
            status_text,
            stopping,
        };
        let (notify, reload) = (Arc::new(notify), Arc::new(Wakeup::new()));
        Ok(Self { listener, address, shared: Arc::new(shared), status, stop, notify, reload })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What makes it read its configuration again.
    pub fn reload(&self) -> Arc<Wakeup> {
        Arc::clone(&self.reload)
    }

    /// Serves until `stop`, then finishes the recording, tells clients, closes, and releases the session directory.
    ///
    /// # Errors
    /// [`ServerError::Engine`] when the recording could not be finished and verified.
    pub async fn run(self, stop: impl Future<Output = ()>) -> Result<(), ServerError> {
        let Self { listener, shared, status, stop: stopping, notify, reload, .. } = self;
        let app = routes::app(&shared);
        let serving = tokio::spawn(connection::serve(listener, app, Arc::clone(&shared), shared.stopping.clone()));
        let upkeep = [
            tokio::spawn(upkeep::pulse(Arc::clone(&shared), status, Arc::clone(&notify))),
            tokio::spawn(upkeep::repair(Arc::clone(&shared))),
            tokio::spawn(upkeep::retain(Arc::clone(&shared))),
            tokio::spawn(upkeep::reload(Arc::clone(&shared), reload, Arc::clone(&notify))),
        ];
        notify.ready("ready");
        stop.await;
        tracing::info!("stopping");
        notify.stopping();
        shared.jobs.cancel_all();
        let live = shared.live.clone();
        // The recording first: what happens to clients matters less.
        let stopped = tokio::task::spawn_blocking(move || live.shut_down()).await;
        stopping.send_replace(true);
        for task in upkeep {
            task.abort();
            // Ended or aborted, it is over.
            let _ = task.await;
        }
        // Its connections end by themselves, or with the runtime.
        let _ = serving.await;
        shared.jobs.forget_results();
        shared.directory.release();
        match stopped {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err(ServerError::Engine(error.to_string())),
            Err(error) => Err(ServerError::Engine(error.to_string())),
        }
    }
}
