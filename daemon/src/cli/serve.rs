//! `gv3 serve`: the daemon.

use super::Outcome;
use crate::device::RigConfig;
use crate::live::{Live, LiveConfig};
use crate::server::{Notify, ReadConfig, Server, ServerConfig, Token};
use crate::store::SessionDirectory;
use anyhow::{Context, Result};
use clap::{ArgGroup, Args, ValueEnum};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use tokio::signal::unix::{SignalKind, signal};

/// Where the server listens when nothing is said.
pub const USUAL_ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8433);

/// Run the scanner as a service: recording on command, live view and sessions in the browser, metrics.
///
/// SIGHUP reads the configuration again, all of it or nothing. SIGTERM and Ctrl-C finish and verify a running recording,
/// then end.
#[derive(Debug, Args)]
#[command(
    group(ArgGroup::new("source").required(true).args(["config", "sim", "new_token"])),
    after_help = "Examples:\n  gv3 serve --sim\n  gv3 serve --config rig.toml --sessions /srv/scans\n  gv3 serve --new-token ~/.gv3-token\n  gv3 serve --config rig.toml --listen 0.0.0.0:8433 --token-file ~/.gv3-token"
)]
pub struct Serve {
    /// Rig file: camera, projector, patterns, calibration.
    #[arg(long, value_name = "RIG.toml")]
    config: Option<PathBuf>,
    /// The built-in simulated scanner instead of hardware.
    #[arg(long)]
    sim: bool,
    /// Address and port. Any other than this machine's own (127.0.0.1, ::1) needs --token-file.
    #[arg(long, default_value_t = USUAL_ADDRESS)]
    listen: SocketAddr,
    /// Folder of the sessions; otherwise that of the rig file, or `sessions`.
    #[arg(long, value_name = "DIR")]
    sessions: Option<PathBuf>,
    /// File with the secret that clients show; only its owner may read it.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Write a new secret into a new file, and end.
    #[arg(long, value_name = "FILE")]
    new_token: Option<PathBuf>,
    /// A name under which clients reach this machine, besides its own.
    #[arg(long = "host", value_name = "NAME")]
    hosts: Vec<String>,
    /// How messages are written.
    #[arg(long, value_enum, default_value_t = LogFormat::Text)]
    log_format: LogFormat,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LogFormat {
    /// Lines for people.
    Text,
    /// One JSON object a line.
    Json,
}

impl Serve {
    /// Whether messages are written as JSON.
    pub(super) fn logs_json(&self) -> bool {
        self.log_format == LogFormat::Json
    }

    pub(super) fn run(self) -> Result<Outcome> {
        if let Some(path) = &self.new_token {
            Token::create(path)?;
            return Ok(Outcome::done(format!("{}: a new token, readable by its owner", path.display())));
        }
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("gv3-server")
            .enable_all()
            .build()
            .context("the server's threads could not be started")?;
        let outcome = runtime.block_on(self.serve());
        // A replay or a job that still decodes is not waited for.
        runtime.shutdown_background();
        outcome
    }

    async fn serve(self) -> Result<Outcome> {
        // First: a signal that comes early is obeyed when all is there that it ends.
        let asked_to_stop = super::capture::asked_to_stop().context("signals cannot be caught")?;
        let mut hangups = signal(SignalKind::hangup()).context("SIGHUP cannot be caught")?;
        let notify = Notify::from_environment();
        let token = self.token_file.as_deref().map(Token::read).transpose()?;
        let read_config = self.read_config();
        let config = read_config()?;
        // Before the devices: two daemons are not to fight over them.
        let directory = SessionDirectory::open(&config.sessions.directory)?;
        let sessions = directory.path().to_path_buf();
        let server_config = ServerConfig { listen: self.listen, token, hosts: self.hosts };
        let live = Live::open(config)?;
        let server = Server::bind(server_config, live, directory, read_config, notify).await?;
        say_where(server.address(), &sessions);
        let reload = server.reload();
        tokio::spawn(async move {
            while hangups.recv().await.is_some() {
                reload.notify_one();
            }
        });
        server.run(asked_to_stop).await?;
        Ok(Outcome::done("stopped"))
    }

    fn read_config(&self) -> ReadConfig {
        let (path, sessions) = (self.config.clone(), self.sessions.clone());
        Arc::new(move || {
            let mut config = match &path {
                Some(path) => LiveConfig::read(path)?,
                None => LiveConfig::of(RigConfig::simulated()),
            };
            config.sessions.directory = sessions.clone().unwrap_or(config.sessions.directory);
            Ok(config)
        })
    }
}

/// Tells where the page is, and who else can see it.
fn say_where(address: SocketAddr, sessions: &std::path::Path) {
    tracing::info!("serving http://{address}/, sessions in {}", sessions.display());
    if !address.ip().is_loopback() {
        tracing::warn!(
            "{address} can be reached from other machines: whoever shows the token controls the scanner and reads, \
             renames and deletes every session. Traffic is not encrypted; outside a trusted network put TLS in front"
        );
    }
}
